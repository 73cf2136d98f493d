"""One control step as pure functions of snapshots, in any array namespace and on any device."""

from __future__ import annotations

import dataclasses
from typing import Any

from quadrl.aircraft.parameters import Parameters
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, namespace
from quadrl.conditions.world import World
from quadrl.core.rewards import total
from quadrl.core.senses import Look
from quadrl.core.task import EpisodeEnd, Snapshot, Task, either, ends_of
from quadrl.engines.state import State

Observation = dict[str, Array]
TIME_LIMIT = "time_limit"
"""What the clock's end is called, beside the ends that tasks name."""
OFF = 0.05
"""Share of a time limit by which whole control steps may differ from it."""


@dataclasses.dataclass(frozen=True, slots=True)
class Clock:
    """The lengths of an episode."""

    control_timestep: float  # [s]
    time_limit_steps: int  # of the longest episode
    settle_steps: int  # before the time limit, over which the final error is taken

    @classmethod
    def of(cls, task: Task, control_timestep: float) -> Clock:
        """The clock of a task, in whole control steps [s].

        Raises:
            QuadrlError: The time limit is farther from whole control steps than it may be rounded.
        """
        limit = round(task.time_limit / control_timestep)
        if abs(limit * control_timestep - task.time_limit) > OFF * task.time_limit:
            raise QuadrlError(
                name=f"{task.name} time_limit",
                value=task.time_limit,
                allowed=f"whole control steps of {control_timestep:g} s",
            )
        settle = min(max(1, round(task.settle_time / control_timestep)), limit)
        return cls(control_timestep, limit, settle)

    def lengths(self, task: Task, now: Snapshot) -> tuple[Array | int, Array | int]:
        """The same of each row's episode, (N,) each where the task has them by row."""
        if (seconds := task.duration(now)) is None:
            return self.time_limit_steps, self.settle_steps
        limit, settle = (namespace(s).floor(s / self.control_timestep + 0.5) for s in seconds)
        return limit, settle


@dataclasses.dataclass(slots=True)
class Episode:
    """How far the episode of each row is, arrays (N,)."""

    steps: Array  # control steps
    error_sum: Array  # [m], of the task's error
    final_sum: Array  # [m], of those in the settle time


@dataclasses.dataclass(slots=True)
class Transition:
    """The result of one control step, arrays (N, ...), one row per aircraft.

    The entries of the observation are live views: copy them before the next step or reset.
    """

    observation: Observation
    """Named entries (N, k) in the task's order."""
    reward: Array
    """The sum of the terms."""
    reward_terms: dict[str, Array]
    """Named terms of the reward."""
    ends: dict[str, Array]
    """bool: what ends an episode before its time, by the task's names."""
    terminated: Array
    """bool: over by failure, or by success where the task says so."""
    truncated: Array
    """bool: over by the clock; never together with terminated."""
    is_success: Array
    """bool: over, and what was asked is done."""
    diverged: Array
    """bool: the simulation broke down, or flew faster than its step resolves; the state is the last
    good one, and terminated is set."""
    error: Array
    """The task's error [m]."""
    truth: Observation
    """The task's entries of the true state: the observation itself, unless that has errors, is late
    or has other entries."""

    @property
    def ended(self) -> dict[str, Array]:
        """How the episodes that are over ended, (N,) bool by name: each in one way, the first."""
        going, found = self.terminated | self.truncated, dict[str, Array]()
        own = {"diverged": self.diverged, **self.ends, TIME_LIMIT: self.truncated}
        for name, holds in own.items():
            found[name] = going & holds
            going = going & ~holds
        return found


def begin(
    task: Task,
    state: State,
    task_state: Any,
    parameters: Parameters,
    actions: int,
    world: World | None = None,
    look: Look | None = None,
) -> tuple[Snapshot, Episode, Observation]:
    """The snapshot with which episodes begin, and the first observation.

    Args:
        task: The task.
        state: State of the aircraft, (n, ...).
        task_state: What the task remembers, (n, ...).
        parameters: Parameters of the aircraft.
        actions: Numbers in an action.
        world: The world about the aircraft; None where the task declares no solids.
        look: What sensors see of it; None where the true state is observed.
    """
    xp = namespace(state.speed)
    time, *none = (0.0 * state.speed for _ in range(4))
    action = xp.stack([time] * actions, axis=-1)
    given = task_state, parameters, action, state.rotor_speed + 0.0, time
    estimate, sensed = look.sense() if look else (None, {})
    now = Snapshot(state, *given, sensed=sensed, world=world)
    now.potentials = task.measure(now)
    return now, Episode(*none), _observed(task, now, estimate, look)[0]


def finish(
    task: Task,
    clock: Clock,
    episode: Episode,
    before: Snapshot,
    state: State,
    action: Array,
    rotor_command: Array,
    diverged: Array,
    world: World | None = None,
    look: Look | None = None,
) -> tuple[Snapshot, Episode, Transition]:
    """The transition to a new state.

    Args:
        task: The task.
        clock: Clock of its episodes.
        episode: How far they were.
        before: The snapshot before the control step.
        state: After it.
        action: (N, k) that was taken.
        rotor_command: (N, R) [rad/s], mean over the control step.
        diverged: (N,) bool, where the simulation broke down.
        world: The world about the aircraft; None where the task declares no solids.
        look: What sensors see of it; None where the true state is observed.

    Returns:
        The snapshot after it, how far the episodes are, and the transition.
    """
    xp = namespace(state.speed)
    steps = episode.steps + 1.0
    time = steps * clock.control_timestep
    given = before.task, before.parameters, action, rotor_command, time
    estimate, sensed = look.sense(rotor_command) if look else (None, {})
    now = Snapshot(state, *given, sensed=sensed, world=world)
    now.potentials = task.measure(now)
    ends = ends_of(task, now)
    terminated = either(ends) | diverged
    limit, settle_steps = clock.lengths(task, now)
    truncated = (steps >= limit) & ~terminated
    error = task.error(now)
    error_sum = episode.error_sum + error
    settling = steps > limit - settle_steps
    final_sum = episode.final_sum + xp.where(settling, error, 0.0 * error)
    end = EpisodeEnd(terminated, truncated, steps, error_sum, final_sum, settle_steps)
    end.succeeded = (terminated | truncated) & task.succeeded(now, end) & ~diverged
    terms = task.reward(before, now, end)
    task_state = task.update(before, now)
    if task_state is not now.task:  # a goal may have moved on
        now = dataclasses.replace(now, task=task_state)
        now.potentials = task.measure(now)
    observation, truth = _observed(task, now, estimate, look)
    transition = Transition(
        observation=observation,
        reward=total(terms),
        reward_terms=terms,
        ends=ends,
        terminated=terminated,
        truncated=truncated,
        is_success=end.succeeded,
        diverged=diverged,
        error=error + 0.0,  # its own, since a reset writes into the potentials
        truth=truth,
    )
    return now, Episode(steps, error_sum, final_sum), transition


def _observed(
    task: Task, now: Snapshot, estimate: State | None, look: Look | None
) -> tuple[Observation, Observation]:
    """What policies observe, and the task's entries of the true state."""
    seen = truth = task.observe(now)
    if estimate is not None:
        guessed = dataclasses.replace(now, state=estimate)
        guessed.potentials = task.measure(guessed)
        seen = task.observe(guessed)
    return look.observe(seen, truth) if look else seen, truth
