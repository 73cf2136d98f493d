"""Geometric tracking control on SE(3), with the lag of the rotors in the design.

Lee, Leok and McClamroch, "Geometric Tracking Control of a Quadrotor UAV on SE(3)", CDC 2010. The
loops are those of `quadrl.loops`, flown at the control step; here stands how each task is flown.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from quadrl.loops import MAX_TURN, Gains, Loops, heading_of
from quadrl.rotation import norm, to_world
from quadrl.task import OBSERVATION, OptionError, Task
from quadrl.vehicle import Vehicle

DESCENT_RATE = 0.8  # [1/s], sink speed of a landing over its height
TOUCHDOWN_SPEED = 0.2  # [m/s]
MAX_DESCENT_SPEED = 1.2  # [m/s]


@dataclasses.dataclass(frozen=True)
class Reading:
    """What a flat observation says, in the frames that controllers use."""

    rotation: np.ndarray  # (..., 3, 3), body to world
    velocity: np.ndarray  # (..., 3) [m/s], world frame
    body_rate: np.ndarray  # (..., 3) [rad/s], body frame
    rotor_speed: np.ndarray  # (..., 4) [rad/s]
    to_goal: np.ndarray  # (..., 3) [m], from the aircraft to the goal, world frame
    target_velocity: np.ndarray  # (..., 3) [m/s], world frame; zero where nothing moves

    @classmethod
    def of(cls, observation: np.ndarray, task: Task | None, vehicle: Vehicle) -> Reading:
        """Read the observation (..., size) of a task; None for the parts that all tasks have.

        Raises:
            OptionError: The observation has another size.
        """
        parts = OBSERVATION if task is None else task.observation
        ends = np.cumsum([part.size for part in parts.values()])
        observation = np.asarray(observation, dtype=np.float64)
        if observation.shape[-1:] != (ends[-1],):
            raise OptionError(f"observation {observation.shape}: (..., {ends[-1]}) is expected")
        part = dict(zip(parts, np.split(observation, ends[:-1], axis=-1), strict=True))
        rotation = rotation_of_angles(part["sin_attitude"], part["cos_attitude"])
        velocity = to_world(rotation, part["velocity"])
        relative = to_world(rotation, part.get("target_velocity", -part["velocity"]))
        return cls(
            rotation=rotation,
            velocity=velocity,
            body_rate=part["body_rate"],
            rotor_speed=part["rotor_speed"] * vehicle.max_speed,
            to_goal=to_world(rotation, part["goal"]),
            target_velocity=velocity + relative,
        )

    @property
    def heading(self) -> np.ndarray:
        """Unit vectors (..., 2), east and north, of where body x points; east if up or down."""
        return heading_of(self.rotation)


@dataclasses.dataclass(frozen=True)
class Setpoint:
    """Where to be and how fast, now."""

    offset: np.ndarray  # (..., 3) [m], from the aircraft to where it should be, world frame
    velocity: np.ndarray  # (..., 3) [m/s], of that place, world frame


def fly_to_goal(reading: Reading, task: Task | None) -> Setpoint:
    """To the goal, and along with it where it moves."""
    return Setpoint(reading.to_goal, reading.target_velocity)


def follow_line(reading: Reading, task: Task | None) -> Setpoint:
    """To the nearest point of the line through the goal, and along it at its velocity."""
    line = reading.target_velocity
    along = line / np.maximum(norm(line), 1e-9)[..., None]
    ahead = np.sum(reading.to_goal * along, axis=-1, keepdims=True)
    return Setpoint(reading.to_goal - ahead * along, line)


def keep_distance(reading: Reading, task: Task | None) -> Setpoint:
    """To the nearest point at the task's distance from the target, and along with the target."""
    share = getattr(task, "keep", 1.0) / np.maximum(norm(reading.to_goal), 1e-9)
    return Setpoint(reading.to_goal * (1 - share)[..., None], reading.target_velocity)


def descend(reading: Reading, task: Task | None) -> Setpoint:
    """Over the pad, and down on it, slower the lower; it presses on when the pad is reached."""
    height = np.maximum(-reading.to_goal[..., 2], 0.0)
    aside = norm(reading.to_goal[..., :2])
    sink = np.minimum(DESCENT_RATE * height + TOUCHDOWN_SPEED, MAX_DESCENT_SPEED)
    sink = sink * np.clip(1.5 - aside / (0.2 + 0.2 * height), 0.0, 1.0)  # within a cone
    zero = np.zeros_like(sink)
    offset = np.stack([reading.to_goal[..., 0], reading.to_goal[..., 1], zero], axis=-1)
    return Setpoint(offset, np.stack([zero, zero, -sink], axis=-1))


Guidance = Callable[[Reading, Task | None], Setpoint]
GUIDANCE: dict[str, Guidance] = {
    "straight_and_level": follow_line,
    "target_following": keep_distance,
    "landing": descend,
}
"""How the tasks are flown that ask for more than to fly to the goal."""


def guidance(task: Task | None) -> Guidance:
    """What a task is flown with; None flies to the goal."""
    return fly_to_goal if task is None else GUIDANCE.get(task.name, fly_to_goal)


class GeometricController:
    """Flat observations of a task to actions, for aircraft of any leading shape."""

    action = "rotor"
    """The action interface that it flies with."""

    def __init__(
        self, vehicle: Vehicle, task: Task | None = None, gains: Gains | None = None
    ) -> None:
        """Place the poles.

        Args:
            vehicle: The aircraft.
            task: Says where to be and whether to head east; None flies to the goal, at any heading.
            gains: Bandwidths and limits; None for the defaults.
        """
        self.vehicle, self.task = vehicle, task
        self._loops = Loops(vehicle, vehicle.control_step, "position", gains)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The action (..., 4), within [-1, 1], for a flat observation (..., size)."""
        reading, loops = Reading.of(observation, self.task, self.vehicle), self._loops
        setpoint = guidance(self.task)(reading, self.task)
        approach = loops.approach(setpoint.offset, loops.gains.max_speed)
        force = loops.specific_force(
            reading.velocity, reading.velocity - setpoint.velocity - approach
        )
        heading = reading.heading
        if self.task is not None and self.task.heading_matters:
            heading = towards_east(heading)
        body_rate = loops.attitude_rate(reading.rotation, force, heading)
        thrust = loops.thrust(reading.rotation, force)
        command = loops.rotor_command(reading, thrust, body_rate)
        return np.clip((command - self.vehicle.hover_speed) / self.vehicle.action_scale, -1.0, 1.0)


def towards_east(heading: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 2): east, or where it is farther the heading turned by MAX_TURN to it."""
    east, north = heading[..., 0], heading[..., 1]
    cosine, sine = math.cos(MAX_TURN), np.where(north > 0, -1.0, 1.0) * math.sin(MAX_TURN)
    turned = np.stack([cosine * east - sine * north, sine * east + cosine * north], axis=-1)
    return np.where((east > cosine)[..., None], np.array([1.0, 0.0]), turned)


def rotation_of_angles(sines: np.ndarray, cosines: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3), body to world, of sines and cosines (..., 3) of roll, pitch, yaw."""
    (sr, sp, sy), (cr, cp, cy) = np.moveaxis(sines, -1, 0), np.moveaxis(cosines, -1, 0)
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
