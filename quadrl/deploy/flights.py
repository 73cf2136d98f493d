"""Generate C for whole flights from quadrl's own functions, for the page in the browser.

A task, an aircraft and the geometric controller are called with symbols (`quadrl.base.trace`), as
the compiled step of `quadrl.core.compiled` is, and become C functions per task and aircraft:

    begin      the start of an episode, from numbers that were drawn
    first      its first observation
    step       the transition after the physics, with the next observation
    command    the commands to the rotors of an action
    geometric  the action of the geometric controller
    place      the solids of an episode, from numbers that were drawn
    aimed      the setpoint of the loops that a task is trained with, of an action
    looped     their commands to the rotors for the next physics step
    follow     the modelled rotor speeds after a control step with those commands
    rest       the disturbance that is felt at the start of an episode
    feel       that after a control step

Each takes the memory of one flight (`flight_memory.py`), an array of doubles. The
observation is computed from the rotor speeds in `modelled`: JavaScript puts the true ones there
where it does not call `follow`. What C measures of solids stands in `clearance` and `ranges`; none
is ever touched here, since MuJoCo alone computes that.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from quadrl.aircraft.specification import resolve
from quadrl.aircraft.vehicle import commanded
from quadrl.base import records
from quadrl.base.rotation import Array, rotation_matrix, to_body
from quadrl.conditions.sensor import Memory
from quadrl.conditions.sensors import RotorSpeed, felt, moving
from quadrl.conditions.solids import Pose
from quadrl.control.geometric import GeometricController
from quadrl.control.mode import ControlMode
from quadrl.control.modes import kind
from quadrl.control.reading import Reading
from quadrl.core.environment import Environment
from quadrl.core.program import Draws
from quadrl.core.senses import Look
from quadrl.core.snapshot import Snapshot
from quadrl.core.transition import Clock, Episode, Observation, Transition, begin, finish
from quadrl.deploy.flight_memory import LAYOUT, PARTS, FlightMemory
from quadrl.engines.state import Start, State

FUNCTION = """void {name}(double* m) {{
    static const double c[] = {{{constants}}};
    (void)c;
    {body}
}}
"""


class _Modelled(Look):
    """A look at a state that is estimated already."""

    def __init__(self, estimate: State) -> None:
        self._estimate = estimate

    def sense(self, command: Array | None = None) -> tuple[State, dict[str, Array]]:
        return self._estimate, {}

    def observe(self, entries: Mapping[str, Array], truth: Mapping[str, Array]) -> Observation:
        return {**entries}


def write(environment: Environment) -> tuple[str, int]:
    """Trace the functions for the task and the aircraft of an environment.

    Returns:
        The C, and how many random numbers a start takes.
    """
    task, vehicle, origin = environment.task, environment.vehicle, environment.origin
    timestep, rotors = vehicle.control_timestep, vehicle.rotor_count
    clock = Clock.of(task, timestep)
    functions: list[str] = []

    def emit(name: str, memory: FlightMemory, **parts: Any) -> None:
        outputs = {}
        for part, values in parts.items():
            numbers = _flat(values)
            assert len(numbers) <= PARTS[part], part
            outputs |= {f"m[{LAYOUT[part] + k}]": value for k, value in enumerate(numbers)}
        body, name = memory.trace.body(outputs), f"{task.name}_{vehicle.name}_{name}"
        # Writing the body may add constants.
        constants = ", ".join(repr(float(number)) for number in (*memory.trace.constants, 0.0))
        functions.append(FUNCTION.format(name=name, constants=constants, body=body))

    def given(now: Snapshot, episode: Episode, done: Transition | None = None) -> dict[str, Any]:
        """The results of a first observation or of a step, by the part they are written to."""
        goal, seen, error = task.goal(now) + origin, {**task.observe(now)}, task.error(now)
        reward, *flags = [0.0] * 4
        if done:
            seen, error, reward = {**done.observation}, done.error, done.reward[0]
            flags = [part[0] for part in (done.terminated, done.truncated, done.is_success)]
        ranges = {name: now.world.ranges(name) for name in environment.scene.rays if now.world}
        return {
            "kept": [*_row(now.task), *_row(now.potentials), *_row(episode), *_flat(now.time)],
            "observation": [x for term in (seen | ranges).values() for x in _flat(term)],
            **memory.aim(now, seen, begins=done is None),
            "commanded": now.rotor_command,
            "given": [*_flat(error), reward, *_flat(goal), *flags],
        }

    memory = FlightMemory(environment)
    draws = Draws(functools.partial(memory.read, "drawn"))
    start, task_state = task.begin(draws, memory.parameters())
    placed = np.concatenate([start.position + origin, start.quaternion], axis=-1)
    motion = np.concatenate([start.velocity, start.body_rate], axis=-1)
    places = {"qpos": placed, "qvel": motion, "act": start.rotor_speed}
    emit("begin", memory, **places, kept=_row(task.remember(start, task_state)))

    memory = FlightMemory(environment)
    parameters, state = memory.parameters(), memory.estimate()
    remembered, _ = memory.kept(task_state)
    known = remembered, parameters, environment.action_size, memory.world(environment)
    now, episode, _ = begin(task, state, *known)
    emit("first", memory, **given(now, episode))

    memory = FlightMemory(environment)
    parameters, state = memory.parameters(), memory.state()
    remembered, measured, episode, time = memory.kept(task_state, now.potentials, episode)
    world = memory.world(environment)
    last: Any = remembered, parameters, None, memory.read("commanded", rotors), time, measured
    before = Snapshot(None, *last, world=world)  # type: ignore[arg-type]
    action, command = memory.read("action", rotors), memory.read("ctrl", rotors)
    flag = np.array([f"m[{LAYOUT['diverged']}] != 0"], object)
    diverged = memory.trace.inputs(flag, is_flag=True)
    taken = action, command, diverged, world, _Modelled(memory.estimate())
    emit("step", memory, **given(*finish(task, clock, episode, before, state, *taken)))

    memory = FlightMemory(environment)
    action, scale = memory.read("action", rotors), memory.read("scale", 1)
    emit("command", memory, ctrl=commanded(action, vehicle.hover_speed, scale, vehicle.max_speed))

    memory = FlightMemory(environment)
    # As `Environment.flatten` gives it, without what is seen along rays, which come last.
    own = environment.size - sum(rays.count for rays in environment.scene.rays.values())
    observation = memory.read("observation", own, "(double)(float)m[{}]")
    controller = GeometricController(vehicle, task)
    reading = Reading.of(observation, task.observation, vehicle)
    emit("geometric", memory, action=controller.action(reading, *task.guide(reading)))

    memory = FlightMemory(environment)
    followed: Memory = {"speed": memory.read("modelled", rotors)}
    taken = memory.parameters(), memory.read("ctrl", rotors), timestep
    followed = RotorSpeed(source="estimated").follow(followed, *taken)
    emit("follow", memory, modelled=followed["speed"])

    for name in ("rest", "feel"):
        memory = FlightMemory(environment)
        state = memory.estimate()
        motion = moving(memory.parameters(), state)
        disturbance = np.zeros((1, 3))
        if name == "feel":
            last = memory.read("moving", 6)
            disturbance, share = memory.read("disturbance", 3), memory.read("share", 1)
            disturbance = felt(disturbance, last, motion, timestep, share)
        seen = to_body(state.rotation, disturbance)
        emit(name, memory, moving=motion, disturbance=disturbance, felt=seen)
    used = draws.used
    if environment.scene.solids:
        memory = FlightMemory(environment)
        draws = Draws(functools.partial(memory.read, "drawn"))
        parts = (
            np.split(memory.read("qpos", 7), [3], axis=1),
            np.split(memory.read("qvel", 6), 2, 1),
        )
        (position, quaternion), (velocity, rate) = parts
        speeds = memory.read("act", rotors)
        begun = Start(position - origin, quaternion, velocity, rate, speeds)
        solids = _solids(environment, task.place(draws, begun, memory.kept(task_state)[0]))
        emit("place", memory, solids=solids)
        used = max(used, draws.used)

    if mode := loops_of(environment):
        memory = FlightMemory(environment)
        setpoint = mode.setpoint(memory.state(), memory.read("action", mode.size))
        emit("aimed", memory, setpoint=setpoint)
        memory = FlightMemory(environment)
        wanted = memory.read("setpoint", setpoint.shape[1])
        emit("looped", memory, ctrl=mode.rotor_command(memory.state(), wanted))
    return "\n".join(functions), used


def loops_of(environment: Environment) -> ControlMode | None:
    """The control mode that policies for the task and the aircraft are trained with, if it loops.

    Of the aircraft that the task is trained on it has the action scale of the training.
    """
    training, vehicle = environment.task.training, environment.vehicle
    mode = kind(training.get("control_mode", "rotor"))
    if not mode.has_loops:
        return None
    own = vehicle.name == environment.task.trained_on
    return mode(resolve(vehicle, training.get("vehicle_options") if own else None))


def _solids(environment: Environment, placed: Mapping[str, Pose]) -> list[Any]:
    """Solids that stay, as `Solid` of solids.h has them, their numbers side by side."""
    made: list[Any] = []
    for solid in environment.scene.solids:
        count, pose = solid.count or 1, placed.get(solid.name)
        position = np.tile(np.array(solid.position, object), (1, count, 1))
        turn = np.tile([1.0, 0.0, 0.0, 0.0], (1, count, 1))
        if pose is not None:
            position = np.reshape(pose.position, (1, count, 3))
            turn = turn if pose.quaternion is None else np.reshape(pose.quaternion, (1, count, 4))
            if pose.size is not None:
                solid = solid.sized(np.reshape(pose.size, (1, count, len(solid.lengths))))
        position, rotation = position + environment.origin, rotation_matrix(turn)
        for k in range(count):
            for part in solid.parts:
                assert part.offset == (0.0, 0.0, 0.0), solid.name
                size = [np.broadcast_to(number, (1, count))[0, k] for number in part.size]
                made += [float(part.kind), *size, *_flat(position[0, k]), *_flat(rotation[0, k])]
    return made


def _row(record: Any) -> list[Any]:
    """The numbers of a record's arrays, one after the other."""
    return [x for array in records.leaves(record) for x in _flat(array)]


def _flat(values: Array | Iterable[Any]) -> list[Any]:
    return list(np.asarray(values, dtype=object).ravel())
