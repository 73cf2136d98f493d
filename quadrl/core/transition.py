"""One control step as pure functions of snapshots, in any array namespace and on any device."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from quadrl.aircraft.parameters import Parameters
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, namespace
from quadrl.conditions.world import World
from quadrl.core.rewards import total
from quadrl.core.task import EpisodeEnd, Snapshot, Task
from quadrl.engines.state import State

Observation = dict[str, Array]
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


def begin(
    task: Task,
    state: State,
    task_state: Any,
    parameters: Parameters,
    actions: int,
    world: World | None = None,
) -> tuple[Snapshot, Episode]:
    """The snapshot with which episodes begin.

    Args:
        task: The task.
        state: State of the aircraft, (n, ...).
        task_state: What the task remembers, (n, ...).
        parameters: Parameters of the aircraft.
        actions: Numbers in an action.
        world: The world about the aircraft; None where the task declares no solids.
    """
    xp = namespace(state.speed)
    time, *none = (0.0 * state.speed for _ in range(4))
    action = xp.stack([time] * actions, axis=-1)
    given = task_state, parameters, action, state.rotor_speed + 0.0, time
    now = Snapshot(state, *given, world=world)
    now.potentials = task.measure(now)
    return now, Episode(*none)


def finish(
    task: Task,
    clock: Clock,
    episode: Episode,
    before: Snapshot,
    state: State,
    action: Array,
    rotor_command: Array,
    diverged: Array,
    estimate: State | None = None,
    world: World | None = None,
    sensed: Mapping[str, Array] | None = None,
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
        estimate: The state that is observed; None for the true one, which all else looks at.
        world: The world about the aircraft; None where the task declares no solids.
        sensed: What the sensors give now, (N, size) by name.

    Returns:
        The snapshot after it, how far the episodes are, and the transition.
    """
    xp = namespace(state.speed)
    steps = episode.steps + 1.0
    time = steps * clock.control_timestep
    given = before.task, before.parameters, action, rotor_command, time
    now = Snapshot(state, *given, sensed=sensed or {}, world=world)
    now.potentials = task.measure(now)
    terminated = task.terminated(now) | diverged
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
    truth = task.observe(now)
    transition = Transition(
        observation=truth if estimate is None else observe(task, now, estimate),
        reward=total(terms),
        reward_terms=terms,
        terminated=terminated,
        truncated=truncated,
        is_success=end.succeeded,
        diverged=diverged,
        error=error + 0.0,  # its own, since a reset writes into the potentials
        truth=truth,
    )
    return now, Episode(steps, error_sum, final_sum), transition


def observe(task: Task, now: Snapshot, estimate: State) -> Observation:
    """The task's observation of a moment, of another state than the true one."""
    seen = dataclasses.replace(now, state=estimate)
    seen.potentials = task.measure(seen)
    return task.observe(seen)
