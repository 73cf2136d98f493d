"""C of whole flights, for a page that flies them: what quadrl's own functions compute.

A task, an aircraft and the geometric controller are called with symbols (`quadrl.base.trace`), as
the compiled step of `quadrl.compiled` is, and become C functions per task and aircraft:

    begin      the start of an episode, from numbers that were drawn
    first      its first observation
    step       the transition after the physics, with the next observation
    command    the commands to the rotors of an action
    geometric  the action of the geometric controller
    rest       the disturbance that is felt at the start of an episode
    feel       that after a control step

Each takes the memory of one flight, an array of doubles whose parts are named in `LAYOUT`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from quadrl.aircraft.parameters import AIR, AIRCRAFT, ROW_SIZE, Parameters
from quadrl.aircraft.vehicle import MAX_ROTORS, commanded
from quadrl.base import records
from quadrl.base.rotation import Array, to_body
from quadrl.base.trace import Trace
from quadrl.control.geometric import GeometricController
from quadrl.environment import Environment
from quadrl.observer import felt, moving
from quadrl.reading import Reading
from quadrl.rng import Rng
from quadrl.snapshot import Potentials, Snapshot
from quadrl.state import FIRST, State
from quadrl.task import total
from quadrl.transition import Clock, Episode, begin, finish

PARTS = {
    "parameters": ROW_SIZE,  # the aircraft's row
    "limits": 2,  # its largest speed [m/s] and spin [rad/s]: as in `Rows` of state.c
    "world": 3,  # physics step [s], gravity along z [m/s^2], floor [m]: `World` of free_flight.c
    "origin": 3,  # of the task's frame [m], world
    "drawn": 64,  # random numbers of the start
    "qpos": 7,
    "qvel": 6,
    "act": MAX_ROTORS,
    "ctrl": MAX_ROTORS,
    "warm": 6,
    "wind": AIR,
    "state": FIRST["rotor_speed"] + MAX_ROTORS,  # as native/state.c fills it
    "kept": 64,  # what the task remembers, the distances, how far the episode is
    "action": MAX_ROTORS,
    "diverged": 1,
    "observation": 64,
    "scale": 1,  # of actions [rad/s]: Vehicle.action_scale, or that of a policy's training
    "moving": 6,  # as quadrl.observer.moving gives it
    "disturbance": 3,  # [m/s^2], world frame
    "felt": 3,  # the same in the body frame, as policies see it
    "given": 8,  # error [m], reward, goal (3) [m, world], terminated, truncated, is_success
    "keys": 1,  # of the random numbers, an int64 each
    "episodes": 1,
    "near": 1,  # a byte: as in `Rows` of free_flight.c
    "flight_rows": 8,  # that `Rows`, for pointers of 32 bits
    "state_rows": 8,  # `Rows` of state.c
}
"""Numbers in each part of a flight's memory."""
LAYOUT = dict(zip(PARTS, np.cumsum([0, *PARTS.values()]).tolist(), strict=False))
"""Where each part begins."""


class Draws(Rng):
    """Random numbers that are symbols."""

    def __init__(self, trace: Trace) -> None:
        """Begin with the first number."""
        self.used, self._trace = 0, trace

    def uniform(self, low: float, high: float, size: int | None = None) -> Array:
        """Numbers in [low, high): (1,), or (1, size)."""
        count = 1 if size is None else size
        drawn = read(self._trace, "drawn")(np.arange(self.used, self.used + count)[None])
        self.used += count
        return low + (high - low) * (drawn[..., 0] if size is None else drawn)


@dataclasses.dataclass(frozen=True)
class Written:
    """The functions of a task with an aircraft."""

    source: str
    """C."""
    drawn: int
    """Random numbers that a start takes."""


def write(environment: Environment) -> Written:
    """The functions for the task and the aircraft of an environment."""
    task, vehicle = environment.task, environment.vehicle
    timestep = vehicle.control_timestep
    settle = max(1, round(task.settle_time / timestep))
    clock = Clock(timestep, environment.time_limit_steps, settle)
    rotors, origin = vehicle.rotor_count, environment.origin
    prefix = f"{task.name}_{vehicle.name}"
    bodies: dict[str, tuple[Trace, dict[str, Any]]] = {}

    trace = Trace()
    draws = Draws(trace)
    start, task_state = task.begin(draws, _parameters(trace, timestep, rotors))
    placed = np.concatenate([start.position + origin, start.quaternion], axis=-1)
    motion = np.concatenate([start.velocity, start.body_rate], axis=-1)
    places = {"qpos": placed, "qvel": motion, "act": start.rotor_speed}
    bodies["begin"] = trace, _stores(places) | _stores({"kept": _row(task_state)})

    trace = Trace()
    parameters, state = _parameters(trace, timestep, rotors), _state(trace, rotors)
    remembered = _kept(trace, task_state)[0]
    now, episode = begin(task, state, remembered, parameters, environment.action_size)
    bodies["first"] = trace, _outputs(environment, now, episode)

    trace = Trace()
    parameters, state = _parameters(trace, timestep, rotors), _state(trace, rotors)
    remembered, measured, episode, time = _kept(trace, task_state)
    before = Snapshot(None, remembered, parameters, None, None, time, measured)  # type: ignore[arg-type]
    action, command = (read(trace, name)(np.arange(rotors)[None]) for name in ("action", "ctrl"))
    diverged = trace.inputs(np.array([f"m[{LAYOUT['diverged']}] != 0"], object), is_flag=True)
    now, episode, done = finish(task, clock, episode, before, state, action, command, diverged)
    flags = done.terminated, done.truncated, done.is_success
    bodies["step"] = trace, _outputs(environment, now, episode, total(done.reward_terms), *flags)

    trace = Trace()
    action, scale = (read(trace, name) for name in ("action", "scale"))
    given = action(np.arange(rotors)[None]), vehicle.hover_speed, scale(np.zeros((1, 1)))
    command = commanded(*given, vehicle.max_speed)
    bodies["command"] = trace, _stores({"ctrl": command})

    trace = Trace()
    # As `Environment.flatten` gives it.
    place = f"(double)(float)m[{{}} + {LAYOUT['observation']}]"
    observation = _read(trace, place)(np.arange(environment.size)[None])
    controller = GeometricController(vehicle, task)
    reading = Reading.of(observation, task.observation, vehicle)
    bodies["geometric"] = (
        trace,
        _stores({"action": controller.action(reading, *task.guide(reading))}),
    )

    for name in ("rest", "feel"):
        trace = Trace()
        state, numbers = _state(trace, rotors), np.arange(6)[None]
        now = moving(_parameters(trace, timestep, rotors), state)
        disturbance = np.zeros((1, 3))
        if name == "feel":
            last, before = read(trace, "moving")(numbers), read(trace, "disturbance")
            disturbance = felt(before(numbers[:, :3]), last, now, timestep)
        seen = to_body(state.rotation, disturbance)
        outputs = {"moving": now, "disturbance": disturbance, "felt": seen}
        bodies[name] = trace, _stores(outputs)

    functions = (function(f"{prefix}_{name}", *body) for name, body in bodies.items())
    return Written("\n".join(functions), draws.used)


def function(name: str, trace: Trace, outputs: Mapping[str, Any]) -> str:
    """The C function that computes some outputs."""
    body = trace.body(outputs)
    constants = ", ".join(repr(float(number)) for number in (*trace.constants, 0.0))
    return (
        f"void {name}(double* m) {{\n"
        f"    static const double c[] = {{{constants}}};\n"
        f"    (void)c;\n    {body}\n}}\n"
    )


def read(trace: Trace, part: str) -> Callable[[Array], Array]:
    """The symbols of the numbers of a part, by their places in it."""
    return _read(trace, f"m[{{}} + {LAYOUT[part]}]")


def _read(trace: Trace, place: str) -> Callable[[Array], Array]:
    text = np.frompyfunc(lambda number: place.format(int(number)), 1, 1)
    return lambda numbers: trace.inputs(text(numbers))


def _parameters(trace: Trace, timestep: float, rotors: int) -> Parameters:
    """Of the aircraft's row, each number saying where it stands."""
    places = np.arange(float(ROW_SIZE)).view(AIRCRAFT)
    return Parameters.of(places, timestep, rotors).map(read(trace, "parameters"))


def _state(trace: Trace, rotors: int) -> State:
    places = np.arange(FIRST["rotor_speed"] + rotors)[:, None]
    return records.mapped(read(trace, "state"), State.of_table(places))


def _kept(trace: Trace, task_state: Any) -> tuple[Any, Potentials, Episode, Array]:
    """What the task remembers, the distances and the episode of the step before, and its time."""
    symbols, first, parts = read(trace, "kept"), 0, []
    shapes = {name: getattr(task_state, name).shape[1:] for name in _names(type(task_state))}
    for kind, sizes in (
        (type(task_state), shapes),
        (Potentials, {"to_goal": (3,)}),
        (Episode, {}),
    ):
        values = {}
        for name in _names(kind):
            shape = sizes.get(name, ())
            size = int(np.prod(shape))
            values[name] = symbols(np.arange(first, first + size).reshape(1, *shape))
            first += size
        parts.append(kind(**values))
    return (*parts, symbols(np.array([first])))


def _outputs(
    environment: Environment, now: Snapshot, episode: Episode, *done: Array
) -> dict[str, Any]:
    """Where everything goes that a first observation or a step gives."""
    kept = [*_row(now.task), *_row(now.potentials), *_row(episode), *_flat(now.time)]
    error = environment.task.error(now)
    observation = [x for term in environment.task.observe(now).values() for x in _flat(term)]
    zeros = [0.0] * 4
    reward, *flags = [part[0] for part in done] if done else zeros
    goal = _flat(environment.task.goal(now) + environment.origin)
    given = [*_flat(error), reward, *goal, *flags]
    return _stores({"kept": kept, "observation": observation, "given": given})


def _stores(parts: Mapping[str, Any]) -> dict[str, Any]:
    """The C expressions that name where the numbers of parts go."""
    found = {}
    for part, values in parts.items():
        values = _flat(values)
        assert len(values) <= PARTS[part], part
        found |= {f"m[{LAYOUT[part] + k}]": value for k, value in enumerate(values)}
    return found


def _row(record: Any) -> list[Any]:
    """The numbers of a record's arrays, one after the other."""
    return [x for name in _names(type(record)) for x in _flat(getattr(record, name))]


def _flat(values: Array | Iterable[Any]) -> list[Any]:
    return list(np.asarray(values, dtype=object).ravel())


def _names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))
