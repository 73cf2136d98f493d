"""Straight and level: keep a direction, an altitude and a speed for as long as possible."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from quadrl.rotation import Array, namespace, norm
from quadrl.state import Start, State
from quadrl.task import Draw, Errors, Fields, Marker, Measures, OptionError
from quadrl.tasks.moving_goal import MovingGoalTask
from quadrl.vehicle import Vehicle

if TYPE_CHECKING:
    from quadrl.learning.evaluate import Record

LINE: tuple[float, float, float, float] = (0.25, 0.55, 0.95, 0.45)


@dataclasses.dataclass
class Line(Fields):
    """The line to fly; it passes through the origin of the task's frame."""

    direction: Array  # (..., 3) unit vector, level, world frame


@dataclasses.dataclass(frozen=True)
class StraightAndLevel(MovingGoalTask[Line]):
    """Fly along a line at a set speed; the goal runs ahead of the aircraft on the line."""

    name = "straight_and_level"
    asks = "fly in a constant direction at constant altitude and 2 m/s for as long as possible"
    starts = "on a line in any direction, level, at 0 to 2 m/s along it, any heading"
    ends = "more than 0.7 m off the altitude or 3 m off the line, on the ground"
    solved = "in the air, on altitude and near the line to the end"

    speed_weight: float = 10.0
    """Reward for a m/s lost of the speed relative to the line's; with 20 it speeds up so hard that
    it may tip over."""
    line_speed: float = 2.0
    """Speed along the line [m/s]."""
    lead: float = 1.0
    """How far the goal is ahead of the aircraft's projection on the line [m]."""
    max_altitude_error: float = 0.7
    """Altitude error that ends the episode [m]."""
    max_offset: float = 3.0
    """Distance off the line that ends the episode [m]."""

    def __post_init__(self) -> None:
        """Refuse a line that is not flown."""
        super().__post_init__()
        if self.line_speed <= 0:
            raise OptionError(f"{self.name}: line_speed = {self.line_speed} must be positive")

    def sample(self, draw: Draw, vehicle: Vehicle) -> tuple[Start, Line]:
        """On a line of any heading, at rest or up to the set speed along it."""
        direction = draw.level_direction()
        velocity = draw.uniform(0.0, self.line_speed)[..., None] * direction
        origin = namespace(direction).zeros_like(direction)
        start = draw.level_start(origin, vehicle, velocity)
        return start, Line(goal=direction * self.lead, direction=direction)

    def goal(self, state: State, fields: Line) -> Array:
        """The point of the line ahead of the aircraft's projection."""
        east, north = fields.direction[..., 0], fields.direction[..., 1]
        along = state.position[..., 0] * east + state.position[..., 1] * north
        return (along + self.lead)[..., None] * fields.direction

    def target_velocity(self, state: State, fields: Line) -> Array:
        """The line's."""
        return self.line_speed * fields.direction

    def measure(self, state: State, fields: Line) -> Measures:
        """The distance is that from the line: the goal itself is never reached."""
        measures = super().measure(state, fields)
        offset = measures.to_goal - self.lead * fields.direction
        return dataclasses.replace(measures, distance=norm(offset))

    def terminated(self, state: State, measures: Measures, fields: Line, vehicle: Vehicle) -> Array:
        """Off the altitude, off the line or on the ground."""
        height = state.position[..., 2]
        return (
            (abs(height) > self.max_altitude_error)
            | (measures.distance > self.max_offset)
            | self.touches_ground(state, vehicle)
        )

    def success(
        self, state: State, fields: Line, errors: Errors, terminated: Array, truncated: Array
    ) -> Array:
        """To the end."""
        return truncated

    def markers(self, fields: Line) -> Sequence[Marker]:
        """The line, and posts that show its altitude."""
        direction, length = np.asarray(fields.direction), self.line_speed * self.horizon + 5.0
        line = Marker("line", tuple(-10.0 * direction), 0.008, LINE, end=tuple(length * direction))
        feet = [tuple(k * direction - (0, 0, self.altitude)) for k in range(0, int(length), 2)]
        posts = [Marker("line", foot, 0.004, LINE, end=(*foot[:2], 0.0)) for foot in feet]
        return [line, *posts]

    def figures(self, record: Record) -> dict[str, float]:
        """Altitude and cross-track error over the flight, speed error over its second half."""
        ahead = record.goal - record.position
        direction = record.goal[..., :2] / np.linalg.norm(record.goal[..., :2], axis=-1)[..., None]
        across = ahead[..., 0] * direction[..., 1] - ahead[..., 1] * direction[..., 0]
        speed = (record.velocity[..., :2] * direction).sum(-1)[len(record.error) // 2 :]
        return {
            "altitude_rms_m": float(np.sqrt(np.nanmean(record.position[..., 2] ** 2))),
            "cross_track_rms_m": float(np.sqrt(np.nanmean(across**2))),
            "speed_error_share": float(
                np.nanmean(np.abs(np.nanmean(speed, 0) / self.line_speed - 1))
                if np.isfinite(speed).any()
                else np.nan
            ),
        }
