"""Target following: keep a constant distance from a target that moves."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from quadrl.rotation import Array, namespace
from quadrl.state import Start, State
from quadrl.task import (
    FULL_TURN,
    OBSERVATION,
    TARGET_VELOCITY,
    Draw,
    Errors,
    Fields,
    Marker,
    Measures,
    Task,
)
from quadrl.vehicle import Vehicle

if TYPE_CHECKING:
    from quadrl.learning.evaluate import Record

WAVES = 2  # sines in each coordinate of the target's path
AXES = 3
PATH: tuple[float, float, float, float] = (0.95, 0.55, 0.20, 0.35)


@dataclasses.dataclass
class Path(Fields):
    """The target's path: in each coordinate a sum of sines, from the origin of the frame."""

    amplitude: Array  # (..., AXES * WAVES) [m]
    frequency: Array  # (..., AXES * WAVES) [rad/s]
    phase: Array  # (..., AXES * WAVES) [rad]


@dataclasses.dataclass(frozen=True)
class TargetFollowing(Task[Path]):
    """Stay 1 m from a target on a smooth random path; from which side is free."""

    name = "target_following"
    asks = "keep 1 m from a target that moves along a smooth random path at up to 1.5 m/s"
    starts = "1 m from the target, at rest, any heading"
    ends = "more than 5 m from the target, on the ground"
    solved = "in the air to the end, distance within 0.3 m of 1 m on average"
    observation = OBSERVATION | TARGET_VELOCITY

    horizon: float = 20.0
    """Time limit of an episode [s]."""
    speed_weight: float = 20.0
    """Reward for a m/s lost of the speed relative to the target."""
    keep: float = 1.0
    """Distance to keep [m]."""
    target_speed: float = 1.5
    """The target is never faster [m/s]."""
    climb_share: float = 0.2
    """Share of that speed that it climbs and sinks with at most."""
    slowest: float = 0.25
    """Smallest angular frequency of the target's sines [rad/s]."""
    fastest: float = 0.75
    """Largest angular frequency of the target's sines [rad/s]."""
    max_distance: float = 5.0
    """Distance from the target that ends the episode [m]."""
    tolerance: float = 0.3
    """Largest mean error of the distance that counts as success [m]."""

    def sample(self, draw: Draw, vehicle: Vehicle) -> tuple[Start, Path]:
        """At rest, beside the target, level, any heading."""
        bearing = draw.uniform(0.0, FULL_TURN)
        xp = namespace(bearing)
        level = xp.zeros_like(bearing)
        side = xp.stack([xp.cos(bearing), xp.sin(bearing), level], axis=-1)
        frequency = draw.uniform(self.slowest, self.fastest, AXES * WAVES)
        # The speeds of the sines of an axis add up to its limit at most, and the axes together
        # (east and north alike) to `target_speed`.
        climb = self.climb_share * self.target_speed
        along = ((self.target_speed**2 - climb**2) / 2) ** 0.5
        limit = xp.asarray(np.repeat([along, along, climb], WAVES) / WAVES)
        amplitude = draw.uniform(0.3, 1.0, AXES * WAVES) * limit / frequency
        rest = xp.zeros_like(side)
        start = Start(
            position=self.keep * side,
            quaternion=draw.attitude(tilt=0.0),
            velocity=rest,
            body_rate=rest,
            rotor_speed=xp.full_like(draw.uniform(0, 1, 4), vehicle.hover_speed),
        )
        phase = draw.uniform(0.0, FULL_TURN, AXES * WAVES)
        return start, Path(goal=rest, amplitude=amplitude, frequency=frequency, phase=phase)

    def goal(self, state: State, fields: Path) -> Array:
        """The target itself."""
        xp = namespace(fields.phase)
        angle = fields.frequency * state.time[..., None] + fields.phase
        return _by_axis(fields.amplitude * (xp.sin(angle) - xp.sin(fields.phase)))

    def target_velocity(self, state: State, fields: Path) -> Array:
        """Of the target."""
        xp = namespace(fields.phase)
        angle = fields.frequency * state.time[..., None] + fields.phase
        return _by_axis(fields.amplitude * fields.frequency * xp.cos(angle))

    def measure(self, state: State, fields: Path) -> Measures:
        """The distance left is that to the sphere around the target."""
        measures = super().measure(state, fields)
        return dataclasses.replace(measures, distance=abs(measures.distance - self.keep))

    def terminated(self, state: State, measures: Measures, fields: Path, vehicle: Vehicle) -> Array:
        """Too far from the target, or on the ground."""
        lost = measures.distance > self.max_distance - self.keep
        return lost | self.touches_ground(state, vehicle)

    def success(
        self, state: State, fields: Path, errors: Errors, terminated: Array, truncated: Array
    ) -> Array:
        """To the end, and near the distance on average."""
        return truncated & (errors.mean < self.tolerance)

    def markers(self, fields: Path) -> Sequence[Marker]:
        """The path of the target."""
        time = np.linspace(0.0, self.horizon, 160)[:, None]
        angle = fields.frequency * time + fields.phase
        points = _by_axis(fields.amplitude * (np.sin(angle) - np.sin(fields.phase)))
        return [Marker("path", size=0.008, rgba=PATH, points=points)]

    def figures(self, record: Record) -> dict[str, float]:
        """How well the distance is kept over the flight."""
        return {"distance_rms_m": float(np.sqrt(np.nanmean(record.error**2)))}


def _by_axis(waves: Array) -> Array:
    """Sum the sines of each axis: (..., AXES * WAVES) to (..., AXES)."""
    return waves[..., 0::WAVES] + waves[..., 1::WAVES]
