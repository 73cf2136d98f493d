"""What races through gates share: their state, the observation, and what a gate is worth."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar

import numpy as np

from quadrl.base.rotation import Array, namespace, norm, to_body, zeros
from quadrl.base.validation import number
from quadrl.control.reading import Reading
from quadrl.core import rewards
from quadrl.core.contact import touches_ground
from quadrl.core.observation import MOTION, ROTATION, ObservationTerm, observed_motion
from quadrl.core.snapshot import Rollout, statistic
from quadrl.core.task import EpisodeEnd, Snapshot, Task, TaskState, either
from quadrl.engines.state import Start
from quadrl.tasks.tracks import Track, crossing

# How the yardstick controllers fly: to a place so far behind a gate [m], and so fast there [m/s].
OVERSHOOT, CRUISE = 0.5, 2.0
ASTRAY = 5.0  # [m], farther from the next gate than where the last was passed
LOW = 0.8  # [m], above the ground, from which on down a flight costs more
FARTHEST_MISS = 1.0  # [m], from the edge of the opening, up to which a miss costs more


@dataclasses.dataclass(frozen=True)
class Course(TaskState):
    """The progress of a race; the goal is the centre of the next gate."""

    gate: Array  # (N,) number of the next gate, from 0
    through: Array  # (N, 3) unit vector through it
    left: Array  # (N, 3) unit vector to its left
    passed: Array  # (N,) gates so far
    time: Array  # (N,) [s] since the start, when the last of them was passed; 0 before
    position: Array  # (N, 3) [m], before this control step
    leg: Array  # (N,) [m], from where the last gate was passed to the next


@dataclasses.dataclass(frozen=True)
class GateRace(Task):
    """Fly through gates in order and in their direction; a task says where they are."""

    keeps_place = False
    on_ground: ClassVar[float] = -1.0
    """For how long after the start the ground ends no race [s]; below 0 it always does."""
    observation = {
        **ROTATION,
        **MOTION,
        "through": ObservationTerm(
            3, "1", "unit vector through the next gate, body frame", "R^T n"
        ),
        "next_goal": ObservationTerm(
            3, "m", "to the centre of the gate after next, body frame", "R^T (centre - p)"
        ),
        "next_through": ObservationTerm(
            3, "1", "unit vector through that gate, body frame", "R^T n"
        ),
    }

    time_limit: float = 30.0
    """Time limit of an episode [s]."""
    altitude: float = 0.0
    """Height of the origin of the track above the ground [m]; at least the height of the aircraft's
    centre when it stands on its feet."""
    progress_weight: float = 10.0
    """Reward per metre by which the distance to the centre of the next gate falls."""
    turn_weight: float = 0.1
    """Cost per rad/s of body rate, for each 0.05 s."""
    pass_weight: float = 10.0
    """Reward for each gate."""
    miss_weight: float = 50.0
    """Cost per metre by which the aircraft passes outside an opening, up to 1 m."""
    low_weight: float = 10.0
    """Cost per metre below 0.8 m above the ground, for each 0.05 s."""
    crash_weight: float = 100.0
    """Cost of a failure."""
    margin: float = 0.0
    """How far from the edge of an opening the aircraft's centre has to pass [m]."""
    laps: int = 1
    """Number of laps."""
    radius: float = 0.1
    """Largest distance from the start [m]."""
    tilt: float = 0.3
    """Largest tilt at the start [rad]."""
    flying: float = 0.0
    """Share of the episodes that begin in flight."""

    def __post_init__(self) -> None:
        """Validate the race."""
        super().__post_init__()
        least, most = (self.course.opening - self.course.frame) / 2, self.course.opening / 2
        number(f"{self.name} margin", self.margin, least, most)
        number(f"{self.name} flying", self.flying, 0, 1)
        number(f"{self.name} laps", self.laps, 1, whole=True)

    @functools.cached_property
    def course(self) -> Track:
        """The track that is flown, as it should be."""
        raise NotImplementedError

    def gate(self, task: Any, number: Array) -> tuple[Array, Array, Array]:
        """Gates with some numbers (N,): centres [m], and unit vectors through them and left."""
        raise NotImplementedError

    def remember(self, start: Start, drawn: Any) -> Course:
        """Where the aircraft begins, and how far that is from its gate."""
        leg = norm(drawn.goal - start.position)
        return dataclasses.replace(drawn, position=start.position, leg=leg)

    def update(self, before: Snapshot, now: Snapshot) -> Course:
        """Go on to the next gate when this one is passed."""
        task, (passes, _, _, share) = now.task, self._crossed(now)
        xp = namespace(task.gate)
        gate = xp.where(passes, self._following(task.gate), task.gate)
        goal, through, left = self.gate(task, gate)
        moment = now.time - (1 - share) * now.parameters.control_timestep
        return dataclasses.replace(
            task,
            goal=goal,
            gate=gate,
            through=through,
            left=left,
            passed=xp.where(passes, task.passed + 1, task.passed),
            time=xp.where(passes, moment, task.time),
            position=now.state.position + 0.0,
            leg=xp.where(passes, norm(goal - now.state.position), task.leg),
        )

    def observe(self, now: Snapshot) -> dict[str, Array]:
        """The aircraft's motion, and the next two gates as it sees them."""
        state, gate = now.state, now.task.gate
        goal, through, _ = self.gate(now.task, gate)
        next_goal, next_through, _ = self.gate(now.task, self._following(gate))
        seen = {
            "goal": goal - state.position,
            "through": through,
            "next_goal": next_goal - state.position,
            "next_through": next_through,
        }
        return {
            "rotation": state.rotation_entries,
            **observed_motion(now),
            **{name: to_body(state.rotation, vector) for name, vector in seen.items()},
        }

    def passage(self, before: Snapshot, now: Snapshot, end: EpisodeEnd) -> dict[str, Array]:
        """Terms of a reward: through the next gate, without turning more than it takes."""
        passes, _, missed, _ = self._crossed(now)
        below = namespace(missed).clip(LOW - now.state.height, 0.0, LOW)
        time = rewards.time_share(now.parameters)
        return {
            "turn": -self.turn_weight * time * now.potentials.angular_speed,
            "pass": rewards.once(self.pass_weight, passes, now),
            "miss": -self.miss_weight * missed,
            "low": -self.low_weight * time * below,
            "crash": rewards.once(-self.crash_weight, end.failed, now),
        }

    def terminated(self, now: Snapshot) -> dict[str, Array]:
        """Through the last gate or a frame, on the ground, or astray."""
        return self._failures(now) | {"finished": self._finished(now)}

    def succeeded(self, now: Snapshot, end: EpisodeEnd) -> Array:
        """Through every gate, and nothing else."""
        return end.terminated & self._finished(now) & ~either(self._failures(now))

    def guide(self, reading: Reading) -> tuple[Array, Array]:
        """Through the gate: straight to a place behind it."""
        away = namespace(reading.to_goal).clip(norm(reading.to_goal), 1e-9, None)[..., None]
        way = reading.to_goal / away
        return reading.to_goal + OVERSHOOT * way, CRUISE * way

    def metrics(self, rollout: Rollout) -> dict[str, float]:
        """Times of those that came through, and how many gates all of them passed."""
        passed, time = (rollout.remembered[name] for name in ("passed", "time"))
        count, done = len(self.course.gates), rollout.is_success
        passed, time = passed[:, done], time[:, done]
        ends = range(count, int(self.laps) * count + 1, count)
        at = [np.nanmin(np.where(passed == end, time, np.inf), 0) for end in ends]
        laps = np.diff([np.zeros(done.sum()), *at], axis=0)  # (laps, successful flights)
        flying = {"flying_lap_mean_s": statistic(np.mean, laps[1:])} if len(laps) > 1 else {}
        return {
            "race_time_mean_s": statistic(np.mean, at[-1]),
            "race_time_best_s": statistic(np.min, at[-1]),
            "gates_passed_mean": float(np.nanmax(rollout.remembered["passed"], 0).mean()),
            **flying,
        }

    def _following(self, gate: Array) -> Array:
        """Numbers (N,) of the gates after some."""
        last = float(len(self.course.gates) - 1)
        return namespace(gate).where(gate == last, zeros(gate), gate + 1)

    def _crossed(self, now: Snapshot) -> tuple[Array, Array, Array, Array]:
        """Whether this control step passes, hits or misses the next gate, (N,).

        Returns:
            Whether it is passed, and whether its frame is hit, bool; by how much the opening is
            missed [m], 0 where it is not; and the share of the control step that led there.
        """
        task, xp = now.task, namespace(now.task.gate)
        gate = now.task.goal, task.through, task.left
        forwards, backwards, aside, share = crossing(task.position, now.state.position, *gate)
        beside = aside - (self.course.opening / 2 - self.margin)
        struck = (beside > 0) & (aside < self.course.frame / 2 + self.margin)
        missed = xp.where(forwards, xp.clip(beside, 0.0, FARTHEST_MISS), zeros(beside))
        return forwards & (beside <= 0), (forwards | backwards) & struck, missed, share

    def _failures(self, now: Snapshot) -> dict[str, Array]:
        """Through a frame, on the ground, or astray, (N,) bool each."""
        astray = now.potentials.distance > now.task.leg + ASTRAY
        begun = (now.time > self.on_ground) | (now.task.passed > 0)
        ground = touches_ground(now, bounces=self.contact) & begun
        return {"frame": self._crossed(now)[1], "astray": astray, "ground": ground}

    def _finished(self, now: Snapshot) -> Array:
        """Whether this control step passes the last gate of the last lap, (N,) bool."""
        last = now.task.passed == self.laps * len(self.course.gates) - 1
        return last & self._crossed(now)[0]
