"""The state of rows of aircraft, by name."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, norm, rotation_matrix, sin_cos_attitude, to_body
from quadrl.base.trace import Trace
from quadrl.base.validation import keys

SIZES = {
    "position": 3,
    "quaternion": 4,
    "rotation": 9,
    "sin_attitude": 3,
    "cos_attitude": 3,
    "velocity": 3,
    "body_velocity": 3,
    "body_rate": 3,
    "height": 1,
    "speed": 1,
    "angular_speed": 1,
    "level_error": 1,
    "east_error": 1,
    "rotor_speed": 0,  # one per rotor: last, since their number differs
}
"""Rows of the table that `native/state.c` fills, in their order."""
FIRST = dict(zip(SIZES, np.cumsum([0, *SIZES.values()]).tolist(), strict=False))
"""First row of each quantity."""
SOURCE = """enum {{ {rows} }};
static inline void write_state(const double* restrict qpos, const double* restrict qvel,
                               const double* restrict origin, int64_t columns,
                               double* restrict out) {{
  static const double c[] = {{{constants}}};
    {body}
}}
"""
REST_SPEED, REST_TURN = 0.05, 0.1  # [m/s], [rad/s]: a slower aircraft is at rest


@dataclasses.dataclass(frozen=True, slots=True)
class State:
    """What a task sees of the aircraft; arrays (N, ...).

    A state that an engine hands out is made of views of live buffers, valid for one more step.
    """

    position: Array  # (N, 3) [m], world, from the origin of the task's frame
    quaternion: Array  # (N, 4) (w, x, y, z), body to world
    rotation: Array  # (N, 3, 3) body to world
    sin_attitude: Array  # (N, 3) sine of roll, pitch, yaw (Z-Y-X)
    cos_attitude: Array  # (N, 3) cosine of roll, pitch, yaw
    velocity: Array  # (N, 3) [m/s], world frame
    body_velocity: Array  # (N, 3) [m/s], body frame
    body_rate: Array  # (N, 3) [rad/s], angular velocity in the body frame
    height: Array  # (N,) [m], of the centre of mass above the ground
    speed: Array  # (N,) [m/s]
    angular_speed: Array  # (N,) [rad/s]
    level_error: Array  # (N,) |sin zeta| + |cos zeta - 1| of roll and pitch
    east_error: Array  # (N,) the same of roll, pitch and yaw
    rotor_speed: Array  # (N, R) [rad/s]

    @property
    def cos_tilt(self) -> Array:
        """Cosine of the angle between the body's z axis and the vertical, (N,)."""
        return self.rotation[..., 2, 2]

    @property
    def rotation_entries(self) -> Array:
        """The rotation matrix row by row, (N, 9)."""
        return self.rotation.reshape(*self.speed.shape, 9)

    @property
    def at_rest(self) -> Array:
        """Whether it neither moves nor turns, (N,) bool."""
        return (self.speed < REST_SPEED) & (self.angular_speed < REST_TURN)

    @classmethod
    def of_table(cls, table: np.ndarray) -> State:
        """Named views of a table (rows, N).

        Rows are contiguous over the aircraft, so that NumPy's loops run over all of them at once.
        """
        parts = {}
        for name, size in SIZES.items():
            rows = table[FIRST[name] :] if not size else table[FIRST[name] : FIRST[name] + size]
            parts[name] = rows[0] if size == 1 else rows.T
        parts["rotation"] = parts["rotation"].T.reshape(3, 3, -1).transpose(2, 0, 1)
        return cls(**parts)

    @classmethod
    def of_coordinates(
        cls,
        position: Array,
        quaternion: Array,
        velocity: Array,
        body_rate: Array,
        rotor_speed: Array,
        origin_height: float,
    ) -> State:
        """The state of coordinates in any array namespace; the C kernel is generated from it.

        Args:
            position: (N, 3) [m], task frame.
            quaternion: (N, 4) (w, x, y, z), body to world.
            velocity: (N, 3) [m/s], world frame.
            body_rate: (N, 3) [rad/s], body frame.
            rotor_speed: (N, R) [rad/s].
            origin_height: Height of the origin of the task's frame above the ground [m].
        """
        rotation = rotation_matrix(quaternion)
        sines, cosines = sin_cos_attitude(rotation)
        return cls(
            position=position,
            quaternion=quaternion,
            rotation=rotation,
            sin_attitude=sines,
            cos_attitude=cosines,
            velocity=velocity,
            body_velocity=to_body(rotation, velocity),
            body_rate=body_rate,
            height=position[..., 2] + origin_height,
            speed=norm(velocity),
            angular_speed=norm(body_rate),
            level_error=norm(sines[..., :2]) + norm(cosines[..., :2] - 1),
            east_error=norm(sines) + norm(cosines - 1),
            rotor_speed=rotor_speed,
        )


@dataclasses.dataclass(frozen=True, slots=True)
class Start:
    """How episodes begin, arrays (n, k)."""

    position: Array  # (n, 3) [m], world, from the origin of the task's frame
    quaternion: Array  # (n, 4) (w, x, y, z), body to world
    velocity: Array  # (n, 3) [m/s], world frame
    body_rate: Array  # (n, 3) [rad/s], body frame
    rotor_speed: Array  # (n, R) [rad/s]

    def replaced(self, given: Mapping[str, Any], rows: np.ndarray, count: int) -> Start:
        """A start with some arrays replaced by given ones, (count, k) or (k,), at rows (n,).

        Raises:
            QuadrlError: Unknown name, wrong shape, or a quaternion of length 0.
        """
        if not given:
            return self
        keys("start", given, [field.name for field in dataclasses.fields(self)])
        arrays: dict[str, np.ndarray] = {}
        for name, value in given.items():
            size = getattr(self, name).shape[-1]
            try:
                arrays[name] = np.broadcast_to(np.asarray(value, float), (count, size))[rows]
            except (TypeError, ValueError):
                allowed = f"numbers of shape ({size},) or ({count}, {size})"
                raise QuadrlError(name=name, value=value, allowed=allowed) from None
        if "quaternion" in arrays:
            length = norm(arrays["quaternion"])[:, None]
            if not (length > 0).all():
                allowed = "of a length above 0"
                raise QuadrlError(name="quaternion", value=given["quaternion"], allowed=allowed)
            arrays["quaternion"] = arrays["quaternion"] / length
        return dataclasses.replace(self, **arrays)


@functools.cache
def c_state() -> str:
    """C of the rows of the table, and of the function that fills those of an aircraft."""
    trace, sizes = Trace(), {"qpos": 7, "qvel": 6, "origin": 3}
    qpos, qvel, origin = (trace.read(f"{k}[{{}}]", np.arange(n)[None]) for k, n in sizes.items())
    rotors = qvel[:, :0]  # none, since their number is not known here
    parts = qpos[:, :3] - origin, qpos[:, 3:], qvel[:, :3], qvel[:, 3:], rotors
    state = State.of_coordinates(*parts, origin_height=origin[0, 2])
    values = [value for name in SIZES for value in getattr(state, name).flat]
    body = trace.body({f"out[{k} * columns]": value for k, value in enumerate(values)})
    rows = ", ".join(f"ROW_{name.upper()} = {first}" for name, first in FIRST.items())
    constants = ", ".join(map(float.hex, trace.constants))
    return SOURCE.format(rows=rows, constants=constants, body=body)


def padded(count: int) -> int:
    """Columns of a table for N aircraft: a cache line more avoids set conflicts between rows.

    A few aircraft have no such conflicts, and NumPy is faster on contiguous arrays.
    """
    return count + 8 * (1 + count // 8 % 2) if count > 8 else count


class Frame:
    """A table of the state with its named views and its address."""

    def __init__(self, count: int, rotors: int) -> None:
        self.columns = padded(count)
        self.table = np.zeros((FIRST["rotor_speed"] + rotors, self.columns))[:, :count]
        self.state = State.of_table(self.table)
        self.address = self.table.ctypes.data
