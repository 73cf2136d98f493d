"""Straight and level: keep a direction, an altitude and a speed for as long as possible."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.base.rotation import Array, namespace, norm
from quadrl.base.validation import number
from quadrl.control.reading import Reading
from quadrl.core import rewards
from quadrl.core.contact import touches_ground
from quadrl.core.markers import Marker
from quadrl.core.observation import OBSERVATION, TARGET_VELOCITY
from quadrl.core.snapshot import Rollout, statistic
from quadrl.core.task import TURNING, EpisodeEnd, Potentials, Snapshot, Target, Task, TaskState
from quadrl.engines.rng import Rng
from quadrl.engines.state import Start

LINE = (0.25, 0.55, 0.95, 0.45)


@dataclasses.dataclass(frozen=True)
class Line(TaskState):
    """The line to fly; it passes through the origin of the task's frame."""

    direction: Array  # (N, 3) unit vector, level, world frame


@dataclasses.dataclass(frozen=True)
class StraightAndLevel(Task):
    """Fly along a line at a set speed; the goal runs ahead of the aircraft on the line."""

    name = "straight_and_level"
    compiled = True
    asks = "fly in a constant direction at constant altitude and 2 m/s for as long as possible"
    starts = "on a line in any direction, level, at 0 to 2 m/s along it, any heading"
    ends = "more than 0.7 m off the altitude or 3 m off the line, on the ground"
    solved = "in the air until the end, near the altitude and the line"
    targets = (
        Target("survival_rate", "flown to the end", 0.99, True),
        Target("altitude_rms_m", "altitude error, RMS", 0.05),
        Target("cross_track_rms_m", "off the line, RMS", 0.10),
        Target("speed_error_share", "speed error", 0.05),
        TURNING,
    )
    training = {"gamma": 0.94, "steps": 1_966_080}
    # With the task's own weight a lasting turn of 0.3 rad/s costs next to nothing.
    training_with = {"ppo": {"training_options": {"spin_weight": 10.0}}}
    observation = OBSERVATION | TARGET_VELOCITY
    # With the task's own weight it flies a lasting 7 % too slow.
    variants = {"robust": {"task_options": {"speed_weight": 20.0}}}
    keeps_place = False

    time_limit: float = 20.0
    """Time limit of an episode [s]."""
    speed_weight: float = 10.0
    """Reward for each m/s by which the speed relative to the line's velocity falls; with 20 the
    aircraft accelerates so hard that it may tip over."""
    line_speed: float = 2.0
    """Speed along the line [m/s]."""
    lead: float = 1.0
    """How far the goal is ahead of the aircraft's projection on the line [m]."""
    max_altitude_error: float = 0.7
    """Altitude error that ends the episode [m]."""
    max_offset: float = 3.0
    """Distance off the line that ends the episode [m]."""

    def __post_init__(self) -> None:
        """Validate the speed."""
        super().__post_init__()
        number(f"{self.name} line_speed", self.line_speed, positive=True)

    def begin(self, rng: Rng, parameters: Parameters) -> tuple[Start, Line]:
        """On a line of any heading, at rest or up to the set speed along it."""
        direction = rng.level_direction()
        velocity = rng.uniform(0.0, self.line_speed)[..., None] * direction
        origin = namespace(direction).zeros_like(direction)
        start = rng.level_start(origin, parameters, velocity)
        return start, Line(goal=direction * self.lead, direction=direction)

    def goal(self, now: Snapshot) -> Array:
        """The point of the line ahead of the aircraft's projection."""
        direction, position = now.task.direction, now.state.position
        along = position[..., 0] * direction[..., 0] + position[..., 1] * direction[..., 1]
        return (along + self.lead)[..., None] * direction

    def target_velocity(self, now: Snapshot) -> Array:
        """The velocity along the line."""
        return self.line_speed * now.task.direction

    def measure(self, now: Snapshot) -> Potentials:
        """The distance is that from the line: the goal itself is never reached."""
        potentials = super().measure(now)
        offset = potentials.to_goal - self.lead * now.task.direction
        return dataclasses.replace(potentials, distance=norm(offset))

    def reward(self, before: Snapshot, now: Snapshot, end: EpisodeEnd) -> dict[str, Array]:
        """Nearer to the line, level, nearer to its velocity, at little effort, in the air."""
        terms = "progress", "attitude", "speed", "spin", "control", "survival", "smoothness"
        return rewards.weighted(self, terms, before, now)

    def terminated(self, now: Snapshot) -> dict[str, Array]:
        """Off the altitude, off the line or on the ground."""
        high = abs(now.state.position[..., 2]) > self.max_altitude_error
        off = now.potentials.distance > self.max_offset
        return {"off_altitude": high, "off_line": off, "ground": touches_ground(now)}

    def succeeded(self, now: Snapshot, end: EpisodeEnd) -> Array:
        """Whether it flew to the end."""
        return end.truncated

    def guide(self, reading: Reading) -> tuple[Array, Array]:
        """To the nearest point of the line through the goal, and along it at its velocity."""
        xp, line = namespace(reading.to_goal), reading.target_velocity
        along = line / xp.clip(norm(line), 1e-9, None)[..., None]
        ahead = xp.sum(reading.to_goal * along, axis=-1, keepdims=True)
        return reading.to_goal - ahead * along, line

    def markers(self, now: Snapshot) -> Sequence[Marker]:
        """The line, and posts that show its altitude."""
        direction = np.asarray(now.task.direction[0])
        length = self.line_speed * self.time_limit + 5.0
        line = Marker("line", tuple(-10.0 * direction), 0.008, LINE, end=tuple(length * direction))
        feet = [tuple(k * direction - (0, 0, self.altitude)) for k in range(0, int(length), 2)]
        posts = [Marker("line", foot, 0.004, LINE, end=(*foot[:2], 0.0)) for foot in feet]
        return [line, *posts]

    def metrics(self, rollout: Rollout) -> dict[str, float]:
        """Altitude and cross-track error over the flight, speed error over its second half."""
        position, goal = rollout.position[1:], rollout.goal[1:, :, :2]
        ahead = rollout.goal[1:] - position
        direction = goal / np.linalg.norm(goal, axis=-1, keepdims=True)
        across = ahead[..., 0] * direction[..., 1] - ahead[..., 1] * direction[..., 0]
        speed = (rollout.velocity[1:, :, :2] * direction).sum(-1)[len(rollout.error) // 2 :]
        flown = speed[:, np.isfinite(speed).any(0)]
        off = np.abs(np.nanmean(flown, 0) / self.line_speed - 1)
        return {
            "altitude_rms_m": float(np.sqrt(np.nanmean(position[..., 2] ** 2))),
            "cross_track_rms_m": float(np.sqrt(np.nanmean(across**2))),
            "speed_error_share": statistic(np.mean, off),
        }
