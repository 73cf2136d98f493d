"""One control step as pure functions of snapshots, in any array namespace and on any device."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import SOLIDS
from quadrl.base.rotation import Array, namespace, square_norm
from quadrl.conditions import sensor
from quadrl.conditions.scene import Scene, Surroundings
from quadrl.conditions.sensor import Sizes
from quadrl.core.rewards import total
from quadrl.core.task import EpisodeEnd, Snapshot, Task
from quadrl.engines.rng import Rng
from quadrl.engines.state import SIZES, Start, State

Observation = dict[str, Array]
SAMPLE = 64  # episodes that are begun to check a task
STARTS = "such that episodes begin within the bounds that end them"

OFF = 0.05
"""Share of a time limit by which whole control steps may differ from it."""


@dataclasses.dataclass(frozen=True, slots=True)
class Clock:
    """The lengths of an episode."""

    control_timestep: float  # [s]
    time_limit_steps: int
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
    around: Surroundings | None = None,
) -> tuple[Snapshot, Episode]:
    """The snapshot with which episodes begin.

    Args:
        task: The task.
        state: State of the aircraft, (n, ...).
        task_state: What the task remembers, (n, ...).
        parameters: Parameters of the aircraft.
        actions: Numbers in an action.
        around: The solids about the aircraft; None where there are none.
    """
    xp = namespace(state.speed)
    time, *none = (0.0 * state.speed for _ in range(4))
    action = xp.stack([time] * actions, axis=-1)
    given = task_state, parameters, action, state.rotor_speed + 0.0, time
    now = Snapshot(state, *given, around=around)
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
    around: Surroundings | None = None,
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
        around: The solids about the aircraft; None where there are none.
        sensed: What the sensors give now, (N, size) by name.

    Returns:
        The snapshot after it, how far the episodes are, and the transition.
    """
    xp = namespace(state.speed)
    steps = episode.steps + 1.0
    time = steps * clock.control_timestep
    given = before.task, before.parameters, action, rotor_command, time
    now = Snapshot(state, *given, sensed=sensed or {}, around=around)
    now.potentials = task.measure(now)
    terminated = task.terminated(now) | diverged
    truncated = (steps >= clock.time_limit_steps) & ~terminated
    error = task.error(now)
    error_sum = episode.error_sum + error
    settling = steps > clock.time_limit_steps - clock.settle_steps
    final_sum = episode.final_sum + xp.where(settling, error, 0.0 * error)
    end = EpisodeEnd(terminated, truncated, steps, error_sum, final_sum, clock.settle_steps)
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


def check_reward(task: Task, done: Transition) -> None:
    """Refuse a reward that is not finite.

    Raises:
        QuadrlError: The message names the aircraft and has the terms of its reward.
    """
    sound = np.isfinite(done.reward)
    if np.count_nonzero(sound) < len(sound):
        row = int(np.argmin(sound))
        values = {name: float(term[row]) for name, term in done.reward_terms.items()}
        name = f"{task.name} reward of aircraft {row}"
        raise QuadrlError(name=name, value=values, allowed="finite in every term")


def check_task(
    task: Task, parameters: Parameters, actions: int, origin_height: float
) -> tuple[str, ...]:
    """Begin a few episodes, and refuse a task whose functions return what no task may return.

    Args:
        task: The task.
        parameters: Parameters of the aircraft, one row.
        actions: Numbers in an action.
        origin_height: Height of the origin of the task's frame above the ground [m].

    Returns:
        Names of the reward's terms, in their order.

    Raises:
        QuadrlError: The message names the function.
    """
    task.check(parameters)
    rows, rotors = SAMPLE, parameters.rotor.hover_speed.shape[-1]
    keys = np.arange(rows)
    begun = task.begin(Rng(keys, 0 * keys), parameters)
    given: Any = begun
    if not isinstance(given, tuple) or not isinstance(given[0], Start):
        raise QuadrlError(name=f"{task.name} begin", value=begun, allowed="a Start and a TaskState")
    start, task_state = begun
    coordinates = {f.name: getattr(start, f.name) for f in dataclasses.fields(start)}
    for name, array in coordinates.items():
        _check_array(task, f"{name} of begin", array, (rows, SIZES[name] or rotors), "f")
    for field in dataclasses.fields(task_state := task.remember(start, task_state)):
        value: Any = getattr(task_state, field.name)
        if not isinstance(value, np.ndarray) or cast(Array, value).shape[:1] != (rows,):
            name, allowed = f"{task.name} {field.name} of begin", f"an array ({rows}, ...)"
            raise QuadrlError(name=name, value=value, allowed=allowed)
    if not (abs(square_norm(start.quaternion) - 1) < 1e-6).all():
        name = f"{task.name} quaternion of begin"
        raise QuadrlError(name=name, value=start.quaternion, allowed="of norm 1")
    scene = Scene(task.solids())
    scene.poses(task.place(Rng(keys, 0 * keys, SOLIDS), start, task_state), rows, np.zeros(3))
    around = scene.nothing_near(rows) if scene.solids else None
    state = State.of_coordinates(**coordinates, origin_height=origin_height)
    now, _ = begin(task, state, task_state, parameters, actions, around)
    for name, options in task.sensors.items():
        made = sensor.make(name, options)
        if made.shown and not made.last:
            now.sensed = {**now.sensed, name: np.zeros((rows, made.width(Sizes(rotors, actions))))}
    terminated = task.terminated(now)
    _check_array(task, "terminated", terminated, (rows,), "b")
    if terminated.any():
        changed = {f.name: getattr(task, f.name) for f in dataclasses.fields(task)}
        changed = {k: v for k, v in changed.items() if str(v) != str(getattr(type(task), k, ""))}
        reason = f"{terminated.sum()} of {rows} episodes would end where they begin"
        name = f"{task.name} {'options' if changed else 'begin'}"
        raise QuadrlError(reason, name=name, value=changed or task, allowed=STARTS)
    error = task.error(now)
    _check_array(task, "error", error, (rows,), "f")
    end = EpisodeEnd(terminated, ~terminated, error + 1, error, error, 1, terminated)
    _check_array(task, "succeeded", task.succeeded(now, end), (rows,), "b")
    terms = task.reward(now, now, end)
    if not terms:
        raise QuadrlError(name=f"{task.name} reward", value=terms, allowed="at least one term")
    for name, term in terms.items():
        _check_array(task, f"reward term {name!r}", term, (rows,), "f")
    observation = task.observe(now)
    if list(observation) != list(task.observation):
        allowed = f"the declared terms in their order: {', '.join(task.observation)}"
        raise QuadrlError(name=f"{task.name} observe", value=list(observation), allowed=allowed)
    for name, term in task.observation.items():
        shape = (rows, term.width(rotors))
        _check_array(task, f"observation {name!r}", observation[name], shape, "f")
    task.update(now, now)  # so that a fault of any function shows before symbols call it
    return tuple(terms)


def _check_array(task: Task, what: str, value: Any, shape: tuple[int, ...], kind: str) -> None:
    found = (tuple(getattr(value, "shape", ())), str(getattr(value, "dtype", type(value).__name__)))
    if found[0] != shape or ("bool" if kind == "b" else "float") not in found[1]:
        allowed = f"an array of {'bool' if kind == 'b' else 'floating-point numbers'} {shape}"
        reason, name = f"it is {found[1]} {found[0]}", f"{task.name} {what}"
        raise QuadrlError(reason, name=name, value=value, allowed=allowed)
