"""Readings: flat observations decoded for controllers and for `Task.guide`."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

import numpy as np

from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, heading_of, norm, rotation_of_angles, to_world

Motion = tuple[Array, Array]
"""Acceleration [m/s^2] and jerk [m/s^3] of a target, (N, 3) each, world frame."""

NO_SENSORS: Mapping[str, Any] = {}


@dataclasses.dataclass(frozen=True)
class Reading:
    """The quantities in a flat observation, in the frames that controllers use."""

    rotation: Array  # (N, 3, 3), body to world
    velocity: Array  # (N, 3) [m/s], world frame
    body_rate: Array  # (N, 3) [rad/s], body frame
    rotor_speed: Array  # (N, R) [rad/s]
    to_goal: Array  # (N, 3) [m], from the aircraft to the goal, world frame
    target_velocity: Array  # (N, 3) [m/s], world frame; zero where nothing moves
    target_motion: Motion | None = None  # of the target; None where it is not observed
    height: Array | None = None  # (N,) [m] over the task's origin; None where it is not observed

    @classmethod
    def of(
        cls,
        observation: Array,
        terms: Mapping[str, Any],
        vehicle: Vehicle,
        sensors: Mapping[str, Any] = NO_SENSORS,
    ) -> Reading:
        """Decode the flat observation (N, size) of a task by its observation terms.

        Args:
            observation: Flat observations.
            terms: The task's own, in order.
            vehicle: The aircraft.
            sensors: The task's own; what they measure follows its terms and is left out.

        Raises:
            QuadrlError: The observation has another size.
        """
        widths = [term.width(vehicle.rotor_count) for term in terms.values()]
        ends = np.cumsum(widths)
        if sensors:
            observation = observation[:, : ends[-1]]
        if observation.shape[1] != ends[-1]:
            size, allowed = observation.shape[1], f"{ends[-1]} for this task and aircraft"
            raise QuadrlError(name="observation size", value=size, allowed=allowed)
        term = dict(zip(terms, np.split(observation, ends[:-1], axis=-1), strict=True))
        if "rotation" in term:
            rotation = term["rotation"].reshape(-1, 3, 3)
        else:
            rotation = rotation_of_angles(term["sin_attitude"], term["cos_attitude"])
        velocity = to_world(rotation, term["velocity"])
        relative = to_world(rotation, term.get("target_velocity", -term["velocity"]))
        ahead = [
            to_world(rotation, term[k]) for k in ("target_acceleration", "target_jerk") if k in term
        ]
        return cls(
            rotation=rotation,
            velocity=velocity,
            body_rate=term["body_rate"],
            rotor_speed=term["rotor_speed"] * vehicle.max_speed,
            to_goal=to_world(rotation, term["goal"]),
            target_velocity=velocity + relative,
            target_motion=(ahead[0], ahead[1]) if ahead else None,
            height=term["position"][..., 2] if "position" in term else None,
        )

    @functools.cached_property
    def heading(self) -> Array:
        """Unit vectors (N, 2), east and north, of where body x points; east if up or down."""
        return heading_of(self.rotation)

    @property
    def speed(self) -> Array:
        """(N,) [m/s]."""
        return norm(self.velocity)

    @property
    def angular_speed(self) -> Array:
        """(N,) [rad/s]."""
        return norm(self.body_rate)


class Guide(Protocol):
    """The part of a task that controllers use; `quadrl.core.task.Task` implements it."""

    observation: ClassVar[dict[str, Any]]
    """The terms of the flat observation."""
    sensors: ClassVar[dict[str, Any]]
    """The sensors that follow them."""
    gains: ClassVar[dict[str, float]]
    """Gains of the geometric controller that differ from its defaults."""
    heading_matters: ClassVar[bool]
    """Whether to head east."""

    @property
    def altitude(self) -> float:
        """Height of the origin of the task's frame above the ground [m]."""
        ...

    def guide(self, reading: Reading) -> tuple[Array, Array]:
        """The setpoint: its offset (N, 3) [m] from the aircraft and its velocity (N, 3) [m/s]."""
        ...

    def feed_forward(self, reading: Reading) -> Motion | None:
        """Acceleration and jerk of the setpoint; None where they are not known."""
        ...
