"""Target following: keep a constant distance from a target that moves."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from quadrl.rotation import Array, namespace
from quadrl.state import Start, State
from quadrl.task import FULL_TURN, Draw, Errors, Fields, Marker, Measures, OptionError
from quadrl.tasks.moving_goal import MovingGoalTask
from quadrl.vehicle import Vehicle

if TYPE_CHECKING:
    from quadrl.learning.evaluate import Record

WAVES = 2  # sines in each coordinate of the target's path
AXES = 3
SLOWEST = 1e-6  # [rad/s]; the slower, the longer the waves, and the fewer digits are left
PATH: tuple[float, float, float, float] = (0.95, 0.55, 0.20, 0.35)


@dataclasses.dataclass
class Path(Fields):
    """The target's path: in each coordinate a sum of sines, from the origin of the frame."""

    amplitude: Array  # (..., AXES * WAVES) [m]
    frequency: Array  # (..., AXES * WAVES) [rad/s]
    phase: Array  # (..., AXES * WAVES) [rad]


@dataclasses.dataclass(frozen=True)
class TargetFollowing(MovingGoalTask[Path]):
    """Stay 1 m from a target on a smooth random path; from which side is free."""

    name = "target_following"
    asks = "keep 1 m from a target that moves along a smooth random path at up to 1.5 m/s"
    starts = "1 m beside the target, at rest and level, any heading"
    ends = "more than 5 m from the target, on the ground"
    solved = "in the air to the end, distance within 0.3 m of 1 m on average"

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

    def __post_init__(self) -> None:
        """Refuse a path that is none."""
        super().__post_init__()
        if not SLOWEST <= self.slowest <= self.fastest:
            raise OptionError(
                f"{self.name}: slowest = {self.slowest}, fastest = {self.fastest}: at least "
                f"{SLOWEST:g}, in this order, is allowed"
            )
        if not 0 <= self.climb_share <= 1:
            raise OptionError(f"{self.name}: climb_share = {self.climb_share}: 0 to 1 is allowed")

    def sample(self, draw: Draw, vehicle: Vehicle) -> tuple[Start, Path]:
        """At rest, beside the target, level, any heading."""
        side = draw.level_direction()
        xp = namespace(side)
        frequency = draw.uniform(self.slowest, self.fastest, AXES * WAVES)
        # The speeds of the sines of an axis add up to its limit at most, and the axes together
        # (east and north alike) to `target_speed`.
        climb = self.climb_share * self.target_speed
        along = ((self.target_speed**2 - climb**2) / 2) ** 0.5
        limit = xp.asarray(np.repeat([along, along, climb], WAVES) / WAVES)
        amplitude = draw.uniform(0.3, 1.0, AXES * WAVES) * limit / frequency
        start = draw.level_start(self.keep * side, vehicle)
        phase = draw.uniform(0.0, FULL_TURN, AXES * WAVES)
        origin = xp.zeros_like(side)
        return start, Path(goal=origin, amplitude=amplitude, frequency=frequency, phase=phase)

    def goal(self, state: State, fields: Path) -> Array:
        """The target itself."""
        return _position(fields, state.time)

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
        points = _position(fields, np.linspace(0.0, self.horizon, 160))
        return [Marker("path", size=0.008, rgba=PATH, points=points)]

    def figures(self, record: Record) -> dict[str, float]:
        """How well the distance is kept over the flight."""
        return {"distance_rms_m": float(np.sqrt(np.nanmean(record.error**2)))}


def _position(fields: Path, time: Array) -> Array:
    """Where the target is at a time (...) [s], (..., 3) [m], task frame."""
    xp = namespace(fields.phase)
    angle = fields.frequency * time[..., None] + fields.phase
    return _by_axis(fields.amplitude * (xp.sin(angle) - xp.sin(fields.phase)))


def _by_axis(waves: Array) -> Array:
    """Sum the sines of each axis: (..., AXES * WAVES) to (..., AXES)."""
    return waves[..., 0::WAVES] + waves[..., 1::WAVES]
