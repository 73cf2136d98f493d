"""The state of one aircraft or of many, by name."""

from __future__ import annotations

import dataclasses

import numpy as np

from quadrl.rotation import (
    Array,
    namespace,
    norm,
    rotation_matrix,
    sin_cos_attitude,
    to_body,
)

ROWS = {
    "position": slice(0, 3),
    "quaternion": slice(3, 7),
    "rotation": slice(7, 16),
    "sin_attitude": slice(16, 19),
    "cos_attitude": slice(19, 22),
    "velocity": slice(22, 25),
    "body_velocity": slice(25, 28),
    "body_rate": slice(28, 31),
    "rotor_speed": slice(31, 35),
    "speed": 35,
    "spin": 36,
    "level_error": 37,
    "east_error": 38,
    "time": 39,
}
"""Where each quantity stands in the table that `native/state.c` fills (time is not its)."""
TABLE_ROWS = 40
REST_SPEED, REST_SPIN = 0.05, 0.1  # [m/s], [rad/s]: slower is at rest


@dataclasses.dataclass(frozen=True, slots=True)
class State:
    """What a task sees of the aircraft; arrays of shape (..., k) that share the leading shape.

    A state that a simulation hands out shows its live table: it holds until the next but one step.
    """

    position: Array  # (..., 3) [m], world, from the origin of the task's frame
    quaternion: Array  # (..., 4) (w, x, y, z), body to world
    rotation: Array  # (..., 3, 3) body to world
    sin_attitude: Array  # (..., 3) sine of roll, pitch, yaw (Z-Y-X)
    cos_attitude: Array  # (..., 3) cosine of roll, pitch, yaw
    velocity: Array  # (..., 3) [m/s], world frame
    body_velocity: Array  # (..., 3) [m/s], body frame
    body_rate: Array  # (..., 3) [rad/s], angular velocity in the body frame
    rotor_speed: Array  # (..., 4) [rad/s]
    speed: Array  # (...) [m/s]
    spin: Array  # (...) [rad/s]
    level_error: Array  # (...) |sin zeta| + |cos zeta - 1| of roll and pitch
    east_error: Array  # (...) the same of roll, pitch and yaw
    time: Array  # (...) [s], since the start of the episode

    @property
    def cos_tilt(self) -> Array:
        """Cosine of the angle between the body's z axis and the vertical, (...)."""
        return self.rotation[..., 2, 2][()]  # a scalar, of one aircraft

    @property
    def at_rest(self) -> Array:
        """Whether it neither moves nor turns, (...) bool."""
        return (self.speed < REST_SPEED) & (self.spin < REST_SPIN)

    @classmethod
    def of_table(cls, table: np.ndarray) -> State:
        """Named views of a (TABLE_ROWS,) or (TABLE_ROWS, n) table: columns are aircraft.

        Rows are contiguous over the aircraft, so that NumPy's loops run over all of them at once.
        """
        # A row alone is an array without axes for one aircraft, hence the ellipsis.
        parts = {name: table[rows, ...].T for name, rows in ROWS.items()}
        matrix = table[ROWS["rotation"]].reshape(3, 3, *table.shape[1:])
        parts["rotation"] = matrix.transpose(2, 0, 1) if table.ndim > 1 else matrix
        return cls(**parts)

    @classmethod
    def of_coordinates(
        cls,
        position: Array,
        quaternion: Array,
        velocity: Array,
        body_rate: Array,
        rotor_speed: Array,
        time: Array,
    ) -> State:
        """The same from coordinates in any array namespace; the definition of the C kernel."""
        xp = namespace(position)
        rotation = rotation_matrix(quaternion)
        sines, cosines = sin_cos_attitude(rotation)
        return cls(
            position=xp.asarray(position),
            quaternion=quaternion,
            rotation=rotation,
            sin_attitude=sines,
            cos_attitude=cosines,
            velocity=velocity,
            body_velocity=to_body(rotation, velocity),
            body_rate=body_rate,
            rotor_speed=rotor_speed,
            speed=norm(velocity),
            spin=norm(body_rate),
            level_error=norm(sines[..., :2]) + norm(cosines[..., :2] - 1),
            east_error=norm(sines) + norm(cosines - 1),
            time=time,
        )


@dataclasses.dataclass(frozen=True)
class Start:
    """How an episode begins, arrays (..., k)."""

    position: Array  # (..., 3) [m], world, from the origin of the task's frame
    quaternion: Array  # (..., 4) (w, x, y, z), body to world
    velocity: Array  # (..., 3) [m/s], world frame
    body_rate: Array  # (..., 3) [rad/s], body frame
    rotor_speed: Array  # (..., 4) [rad/s]
