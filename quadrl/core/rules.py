"""The rules that every task keeps: all checks of what its functions declare and give.

An environment checks the values of a task when it is made, and a file of `--import` is checked
without a flight. `quadrl.testing` adds clauses: tensors, whole flights, and every API.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable
from typing import Any, cast

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.base import records
from quadrl.base.docstrings import docstrings, source
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import SOLIDS
from quadrl.base.rotation import Array, square_norm
from quadrl.conditions import sensor
from quadrl.conditions.scene import Scene
from quadrl.conditions.sensor import Sizes
from quadrl.core.catalogue import make
from quadrl.core.faults import blame, require, require_equal
from quadrl.core.scenario import Scenario
from quadrl.core.snapshot import EpisodeEnd, Snapshot
from quadrl.core.task import Task, either, ends_of
from quadrl.engines.rng import Rng
from quadrl.engines.state import SIZES, Start, State

ROWS, SAMPLE = 4, 64  # episodes that are begun to compare rows, and to look at values
COORDINATES = ("position", "quaternion", "velocity", "body_rate", "rotor_speed")


def seen_by(task: Task, vehicle: str = "paper") -> tuple[Parameters, int, float]:
    """What a task is told by an environment of an aircraft, as `begun` takes it."""
    flown = Scenario.of(task, vehicle=vehicle)
    own = Parameters.of(parameters.rows(flown.aircraft), flown.vehicle.control_timestep)
    return own, flown.vehicle.rotor_count, flown.altitude


def check_rules(task: str | Task | type[Task], clauses: Iterable[Any] = ()) -> None:
    """Check declarations and functions of a task, then what else a contract has.

    Args:
        task: A task, its class, or a name of the catalogue.
        clauses: Functions that raise an AssertionError where a task does not keep them.

    Raises:
        AssertionError: The first fault that is found.
    """
    made = task() if isinstance(task, type) else make(task)
    for check in (check_declaration, check_begin, check_functions, check_start, *clauses):
        check(made)


def check_declaration(task: Task) -> None:
    """Names, units and options are written down."""
    kind = type(task)
    own = getattr(vars(kind).get("__dataclass_params__"), "frozen", False)
    require(own, f"{kind.__name__} must be a frozen dataclass itself, not only its base")
    for attribute in ("name", "asks", "starts", "ends", "solved"):
        text = getattr(task, attribute, None)
        require(isinstance(text, str) and text, f"{kind.__name__}.{attribute} must be a text")
    for name, term in task.observation.items():
        said = term.size >= 1 and term.unit and term.meaning
        require(said, f"{task.name}: {name!r} needs a size, a unit and a meaning: {term}")
    for vehicle in ("paper", "hexa"):  # with four rotors and with six
        with blame(task, f"an environment of the vehicle {vehicle!r}"):
            check_values(task, *seen_by(task, vehicle))
            Scenario.of(task, vehicle=vehicle).compile_model(drawn=False)
    documented = docstrings(kind)
    for field in dataclasses.fields(task) if source(kind) else ():
        require(
            documented.get(field.name), f"{task.name}: the option {field.name} needs a docstring"
        )


def begun(
    task: Task, own: Parameters, actions: int, height: float, rows: int = ROWS, moved: float = 0.0
) -> Snapshot:
    """The first moment of episodes.

    Args:
        task: The task.
        own: Parameters of the aircraft, one row.
        actions: Numbers in an action.
        height: Height of the origin of the task's frame above the ground [m].
        rows: Number of episodes.
        moved: How much farther, faster and later each row is than the one before it.

    Raises:
        QuadrlError: `begin` gives what no task may give; the message names it.
    """
    task.check(own)
    keys, rotors = np.arange(rows), own.rotor.hover_speed.shape[-1]
    drawn: Any = task.begin(Rng(keys, 0 * keys), own)
    if not isinstance(drawn, tuple) or not isinstance(cast(Any, drawn)[0], Start):
        raise QuadrlError(name=f"{task.name} begin", value=drawn, allowed="a Start and a TaskState")
    start, task_state = cast(tuple[Start, Any], drawn)
    coordinates = {name: getattr(start, name) for name in COORDINATES}
    for name, array in coordinates.items():
        _check_array(task, f"{name} of begin", array, (rows, SIZES[name] or rotors), "f")
    more = moved * np.arange(1.0, rows + 1)[:, None]
    coordinates |= {name: coordinates[name] + more for name in ("velocity", "body_rate")}
    coordinates["position"] = start.position + more * [0.0, 0.0, 0.1]  # where little can stand
    start = dataclasses.replace(start, **coordinates)
    task_state = task.remember(start, task_state)
    for field, value in records.named(task_state).items():
        if not isinstance(value, np.ndarray) or cast(Array, value).shape[:1] != (rows,):
            name, allowed = f"{task.name} {field} of begin", f"an array ({rows}, ...)"
            raise QuadrlError(name=name, value=value, allowed=allowed)
    if not (abs(square_norm(start.quaternion) - 1) < 1e-6).all():
        name = f"{task.name} quaternion of begin"
        raise QuadrlError(name=name, value=start.quaternion, allowed="of norm 1")
    sensors = {name: sensor.make(name, options) for name, options in task.sensors.items()}
    scene = Scene(task.solids(), {name: made.rays for name, made in sensors.items()})
    scene.poses(task.place(Rng(keys, 0 * keys, SOLIDS), start, task_state), rows, np.zeros(3))
    world = scene.nothing_near(rows) if scene.solids or scene.rays else None
    state = State.of_coordinates(**coordinates, origin_height=height)
    acts = more + np.zeros(actions), start.rotor_speed + 0.0, more[:, 0]
    now = Snapshot(state, task_state, own, *acts, world=world)
    now.potentials = task.measure(now)
    for name, made in sensors.items():
        if made.shown and not made.last:
            now.sensed = {**now.sensed, name: np.zeros((rows, made.width(Sizes(rotors, actions))))}
    return now


def check_values(
    task: Task, own: Parameters, actions: int, height: float
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Begin a few episodes, and refuse a task whose functions return what no task may return.

    The arguments are those of `begun`.

    Returns:
        Names of the reward's terms, in their order, and of the ends.

    Raises:
        QuadrlError: The message names the function.
    """
    now = begun(task, own, actions, height, rows := SAMPLE)
    if not (ends := ends_of(task, now)):
        raise QuadrlError(name=f"{task.name} terminated", value=ends, allowed="at least one end")
    for name, holds in ends.items():
        _check_array(task, f"terminated {name!r}", holds, (rows,), "b")
    if (terminated := either(ends)).any():
        changed = {f.name: getattr(task, f.name) for f in dataclasses.fields(task)}
        changed = {k: v for k, v in changed.items() if str(v) != str(getattr(type(task), k, ""))}
        reason = f"{terminated.sum()} of {rows} episodes would end where they begin"
        name = f"{task.name} {'options' if changed else 'begin'}"
        allowed = "such that episodes begin within the bounds that end them"
        raise QuadrlError(reason, name=name, value=changed or task, allowed=allowed)
    error = task.error(now)
    _check_array(task, "error", error, (rows,), "f")
    end = EpisodeEnd(terminated, ~terminated, error + 1, error, error, 1, terminated)
    _check_array(task, "succeeded", task.succeeded(now, end), (rows,), "b")
    for seconds in task.duration(now) or ():
        _check_array(task, "duration", seconds, (rows,), "f")
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
        shape = (rows, term.width(own.rotor.hover_speed.shape[-1]))
        _check_array(task, f"observation {name!r}", observation[name], shape, "f")
    task.update(now, now)  # so that a fault of any function shows before symbols call it
    return tuple(terms), tuple(ends)


def check_reward(task: Task, done: Any) -> None:
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


def starts(task: Task, keys: Array, own: Parameters) -> dict[str, Array]:
    """What `begin` and `remember` of a task give for random numbers, by name."""
    with blame(task, "begin"):
        start, state = task.begin(Rng(keys, 0 * keys), own)
        state = task.remember(start, state)
    return records.named(start, "start.") | records.named(state, "task.")


def check_begin(task: Task) -> None:
    """A start follows from the random numbers alone, and differs by row."""
    begin, keys, own = functools.partial(starts, task), np.arange(ROWS), seen_by(task)[0]
    batch = begin(keys, own)
    require_equal(batch, begin(keys, own), f"{task.name}: begin gives two starts for one key")
    for one in (slice(i, i + 1) for i in range(ROWS)):
        row = {name: value[one] for name, value in batch.items()}
        message = f"{task.name}: begin of one aircraft and of a batch differ"
        require_equal(begin(keys[one], own), row, message)
    varied = any(np.ptp(value, axis=0).any() for value in batch.values())
    require(varied, f"{task.name}: every episode begins alike")


def moments(task: Task) -> tuple[Snapshot, Snapshot]:
    """Two moments of the same episodes, which nothing may change."""
    with blame(task, "a start"):
        before, now = (begun(task, *seen_by(task), moved=moved) for moved in (0.0, 0.1))
    now.task = before.task
    frozen = functools.partial(mapped, lambda array: np.broadcast_to(array, array.shape))
    return frozen(before), frozen(now)


def check_functions(task: Task) -> None:
    """A row and a batch get the same numbers, and no argument is changed."""
    batch = outputs(task, *(pair := moments(task)))
    for one in (slice(i, i + 1) for i in range(ROWS)):
        row = functools.partial(mapped, lambda x, one=one: x[one] if len(x) == ROWS else x)
        message = f"{task.name}: one aircraft and a batch get different numbers"
        own = {name: value[one] for name, value in batch.items()}
        require_equal(outputs(task, *map(row, pair)), own, message)


def check_start(task: Task) -> None:
    """What it remembers of every step, it remembers of a start that `reset` is given, too."""
    for part in task.parts:  # of several, only the rows of a part remember what is its own
        with blame(part, "a given start"):
            now, later = (begun(part, *seen_by(part), moved=moved) for moved in (0.1, 0.2))
            first, later.task = _remembered(now), part.update(now, later)
            later.potentials = part.measure(later)
        for name, (own, value) in _remembered(later).items():
            if np.array_equal(own, value) and np.ptp(value, axis=0).any():
                message = f"{name} after every step, but not at a start that reset was given"
                require(np.allclose(*first[name]), f"{part.name}: {message}: make it in `remember`")


def _remembered(now: Snapshot) -> dict[str, tuple[Array, Array]]:
    """Copies of what a task remembers beside all of the same shape that it may be a copy of."""
    seen = records.arrays("state", now.state) | records.arrays("potentials", now.potentials)
    pairs = itertools.product(records.arrays("task", now.task).items(), seen.items())
    return {f"{name} is {other}": (x, y) for (name, x), (other, y) in pairs if x.shape == y.shape}


def outputs(task: Task, before: Snapshot, now: Snapshot) -> dict[str, Array]:
    """What each function of a task gives, by name."""
    rows = f"{len(now.time)} rows of {type(now.time).__module__} arrays"
    with blame(task, f"a function of {rows}"):
        now = dataclasses.replace(now, potentials=task.measure(now))
        terminated, error = either(ends_of(task, now)), task.error(now)
        end = EpisodeEnd(terminated, ~terminated, 0 * error + 1, error, error, 1)
        end.succeeded = succeeded = task.succeeded(now, end)
        terms, seen = task.reward(before, now, end), task.observe(now)
        updated = task.update(before, now)
    outputs = {"error": error, "terminated": terminated, "succeeded": succeeded, **terms, **seen}
    return outputs | records.named(now.potentials, "potentials.") | records.named(updated, "task.")


def mapped(function: Callable[[Any], Any], now: Snapshot) -> Snapshot:
    """A snapshot with a function applied to every array in it."""
    mapped = records.mapped(function, now)
    mapped.parameters = now.parameters.map(function)
    return mapped


def _check_array(task: Task, what: str, value: Any, shape: tuple[int, ...], kind: str) -> None:
    found = (tuple(getattr(value, "shape", ())), str(getattr(value, "dtype", type(value).__name__)))
    if found[0] != shape or ("bool" if kind == "b" else "float") not in found[1]:
        allowed = f"an array of {'bool' if kind == 'b' else 'floating-point numbers'} {shape}"
        reason, name = f"it is {found[1]} {found[0]}", f"{task.name} {what}"
        raise QuadrlError(reason, name=name, value=value, allowed=allowed)
