"""The contract of a task: what every door takes for granted.

    from quadrl.testing import check_task
    check_task(MyTask)

A task that keeps it can be registered. Needs no pytest; PyTorch and TorchRL are checked where they
are installed. `fly` flies a task through one of DOORS, and through bare `mj_step` for comparison.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.util
import unittest
import warnings
from collections.abc import Callable, Generator
from typing import Any

import mujoco
import numpy as np

from quadrl import interfaces, tasks
from quadrl.description import docstrings
from quadrl.environment import Environment
from quadrl.rotation import Array
from quadrl.simulation import BatchSimulation
from quadrl.state import Start, State
from quadrl.task import EPISODE_DRAWS, Draw, Errors, Fields, Measures, Outcome, Task, total
from quadrl.vehicle import ROTORS, Vehicle

Flight = dict[str, np.ndarray]
"""What T steps of N aircraft gave: arrays (T, N, ...) by name, resets in between left out."""
AIRCRAFT = 4
EPISODE = 2.4  # [s], the longest flown through the doors; a dive from 3 m ends before
VEHICLE = Vehicle()


def check_task(task: str | Task | type[Task]) -> None:
    """Check everything that a task has to be, and that every door flies it alike.

    Args:
        task: A task, its class, or a name of the catalogue.

    Raises:
        AssertionError: The first thing that is wrong.
    """
    task = task() if isinstance(task, type) else tasks.make(task)
    check_declaration(task)
    check_sample(task)
    check_functions(task)
    check_episodes(task)
    check_doors(task)


def check_declaration(task: Task) -> None:
    """Names, units and options are written down."""
    kind = type(task)
    settings = vars(kind).get("__dataclass_params__")
    _require(
        settings is not None and settings.frozen,
        f"{kind.__name__} is no frozen dataclass of its own",
    )
    for attribute in ("name", "asks", "starts", "ends", "solved"):
        text = getattr(task, attribute, None)
        _require(
            isinstance(text, str) and text, f"{kind.__name__}.{attribute} is no text: {text!r}"
        )
    for name, part in task.observation.items():
        said = part.size >= 1 and part.unit and part.meaning
        _require(said, f"{task.name}: the part {name!r} lacks a size, a unit or a meaning: {part}")
    documented = docstrings(kind)
    for field in dataclasses.fields(task):
        text = documented.get(field.name)
        _require(text, f"{task.name}: the option {field.name} has no docstring")


def check_sample(task: Task) -> None:
    """A start is made of the draw alone, varies with it, and is the same in a batch."""
    block = np.random.default_rng(0).random((AIRCRAFT, EPISODE_DRAWS))

    def sample(block: Array) -> dict[str, Array]:
        with _blame(task, f"sample with a draw of shape {tuple(block.shape)}"):
            start, fields = task.sample(Draw(block), VEHICLE)
        return _named(start=start, fields=fields)

    batch = sample(block)
    _require_equal(batch, sample(block), f"{task.name}: sample gives two starts for one draw")
    for i in range(AIRCRAFT):
        alone = sample(block[i])
        message = f"{task.name}: sample of one aircraft and of a batch differ"
        _require_equal(alone, {name: value[i] for name, value in batch.items()}, message)
    for name, value in batch.items():
        _require(np.isfinite(value).all(), f"{task.name}: sample gives {name} = {value}")
    length = np.linalg.norm(batch["start.quaternion"], axis=-1)
    _require(np.allclose(length, 1), f"{task.name}: a start's quaternion has length {length}")
    varied = any(np.ptp(value, axis=0).any() for value in batch.values())
    _require(varied, f"{task.name}: every episode begins alike")
    if torch := _optional("torch"):
        with_grad = sample(torch.tensor(block, requires_grad=True))
        _require_torch(with_grad, batch, f"{task.name}: sample")


def check_functions(task: Task) -> None:
    """Shapes are those declared; one aircraft, a batch and torch get the same; nothing is changed.

    Tensors come with a gradient asked for, which NumPy's functions refuse, as they would on a GPU.
    """
    block = np.random.default_rng(1).random((AIRCRAFT, EPISODE_DRAWS))
    altitude = task.origin_height(VEHICLE)
    simulation = BatchSimulation(VEHICLE, AIRCRAFT, altitude=altitude, contact=task.contact)
    start, fields = task.sample(Draw(block), VEHICLE)
    with _blame(task, "measure"):
        state = simulation.place(np.arange(AIRCRAFT), start)
        before = _mapped(np.array, task.measure(state, fields))
    simulation.ctrl[:] = command = VEHICLE.rotor_command(varied_actions(1, AIRCRAFT)[0])
    simulation.advance()
    simulation.read()
    state, fields = _mapped(_frozen, simulation.state), _mapped(_frozen, fields)

    records = before, state, fields
    batch = _outputs(task, records, command, (AIRCRAFT,))
    for i in range(AIRCRAFT):
        row = tuple(_mapped(lambda a, i=i: a[i], record) for record in records)
        alone = _outputs(task, row, command[i], ())
        message = f"{task.name}: one aircraft and a batch get different numbers"
        _require_equal(alone, {name: value[i] for name, value in batch.items()}, message)
    if torch := _optional("torch"):

        def tensor(array: np.ndarray) -> Any:  # noqa: ANN401 - a tensor
            return torch.tensor(array, requires_grad=array.dtype.kind == "f")

        tensors = tuple(_mapped(tensor, record) for record in records)
        got = _outputs(task, tensors, tensor(command), (AIRCRAFT,))
        _require_torch(got, batch, task.name)


def check_episodes(task: Task) -> None:
    """Whole episodes: finite numbers that vary, flags that agree, and an end."""
    environment = Environment(task, num_envs=AIRCRAFT, seed=1)
    with _blame(task, "a reset"):
        observations = [environment.flatten(environment.reset())]
    with _blame(task, "markers"):
        environment.markers()
    ended = np.zeros(AIRCRAFT, dtype=bool)
    for action in varied_actions(environment.horizon_steps, AIRCRAFT):
        with _blame(task, "a flight"):
            now = environment.step(action)
        observations.append(environment.flatten(now.observation))
        for name, value in (*now.reward_terms.items(), ("error", now.error)):
            _require(np.isfinite(value).all(), f"{task.name}: {name} = {value} in flight")
        _require((now.error >= 0).all(), f"{task.name}: an error of {now.error} is negative")
        same = np.array_equal(now.reward, total(now.reward_terms))
        _require(same, f"{task.name}: the reward is not the sum of its terms")
        over = np.logical_or(now.terminated, now.truncated)
        _require(not (now.terminated & now.truncated).any(), f"{task.name}: ended in two ways")
        _require((over | ~now.is_success).all(), f"{task.name}: a success before the end")
        ended |= over
        if over.any():
            observations.append(environment.flatten(environment.reset(over)))
    _require(ended.all(), f"{task.name}: an episode does not end within {task.horizon} s")
    flat = np.concatenate(observations)
    for name, columns in environment.layout.items():
        part = flat[:, columns]
        _require(np.isfinite(part).all(), f"{task.name}: the part {name!r} is not always finite")
        constant = np.flatnonzero(np.ptp(part, axis=0) == 0).tolist()
        _require(not constant, f"{task.name}: entries {constant} of the part {name!r} never change")


def check_doors(task: Task) -> None:
    """Every door gives the numbers of bare mj_step, and keeps the contract of its framework."""
    task = task.replace(horizon=min(task.horizon, EPISODE))
    actions = varied_actions(round(3.2 * task.horizon / VEHICLE.control_step), AIRCRAFT)
    expected = fly("mj_step", task, 3, actions)
    for door in DOORS:
        if door != "torchrl" or _optional("torchrl"):
            flight = fly(door, task, 3, actions)
            for name, value in flight.items():
                same = np.array_equal(value, expected[name].astype(value.dtype))
                _require(same, f"{task.name}: {name} through {door} is not that of mj_step")
    check_dm_control(task)
    check_gymnasium(task)
    if _optional("torchrl"):
        check_torchrl(task)


def check_dm_control(task: Task) -> None:
    """dm_env's own tests of an environment."""
    from dm_env.test_utils import EnvironmentTestMixin

    from quadrl import suite

    class Contract(EnvironmentTestMixin, unittest.TestCase):
        def make_object_under_test(self, **_: Any) -> Any:  # noqa: ANN401
            return suite.make(task, random=0)

        def make_action_sequence(self) -> Generator[np.ndarray]:
            horizon = round(task.horizon / VEHICLE.control_step)
            yield from varied_actions(horizon + 2, 1)[:, 0]  # past the end

    result = unittest.TestResult()
    unittest.defaultTestLoader.loadTestsFromTestCase(Contract).run(result)
    faults = [text for _, text in result.failures + result.errors]
    _require(result.testsRun >= 4, f"{task.name}: dm_env's tests did not run")
    _require(not faults, f"{task.name}: against dm_env's contract\n{''.join(faults)}")


def check_gymnasium(task: Task) -> None:
    """Gymnasium's own check, without a warning but of bounds, which the observation has none."""
    from gymnasium.utils.env_checker import check_env

    from quadrl.envs.gymnasium import QuadrotorEnv

    with _blame(task, "Gymnasium's check_env"), warnings.catch_warnings():
        warnings.simplefilter("error")
        for bound in ("minimum value is -infinity", "maximum value is infinity"):
            warnings.filterwarnings("ignore", f".*A Box observation space {bound}")
        check_env(QuadrotorEnv(task), skip_render_check=True)


def check_torchrl(task: Task) -> None:
    """TorchRL's own check of what is given against what is declared."""
    from torchrl.envs import check_env_specs

    from quadrl.envs.torchrl import QuadrotorEnv

    with _blame(task, "TorchRL's check_env_specs"):
        check_env_specs(QuadrotorEnv(task, AIRCRAFT, seed=0, reward_terms=True))


# ---------------------------------------------------------------------------------------- flights


def fly(door: str, task: Task, seed: int, actions: np.ndarray, action: str = "rotor") -> Flight:
    """Fly N aircraft through a door; aircraft i is seeded with seed + i.

    Args:
        door: A name of DOORS.
        task: The task.
        seed: Of the first aircraft.
        actions: (T, N, 4) float32; aircraft i takes actions[t, i] at its step t (no reset counts).
        action: What they mean, a name of `quadrl.interfaces.INTERFACES`.

    Returns:
        Arrays (T, N, ...): the state (17,) [qpos, qvel, act] and the observation that each action
        met, and the observation, reward and flags that it brought.
    """
    steps, count = actions.shape[:2]
    if door in SINGLE:
        logs = [list(SINGLE[door](task, seed + i, actions[:, i], action)) for i in range(count)]
    else:
        logs = [[] for _ in range(count)]
        for flown, *columns in VECTOR[door](task, seed, actions, action):
            for i in np.flatnonzero(flown):
                logs[i].append([column[i] for column in columns])
    return {
        name: np.array([[row[k] for row in log[:steps]] for log in logs]).swapaxes(0, 1)
        for k, name in enumerate(COLUMNS)
    }


def _mj_step(task: Task, seed: int, actions: np.ndarray, kind: str) -> Generator[tuple]:
    """Bare mj_step and the task's own functions: the numbers that every door has to give."""
    generator = np.random.default_rng(seed)
    origin = np.array([0.0, 0.0, task.origin_height(VEHICLE)])
    model = VEHICLE.compile(contact=task.contact)
    data = mujoco.MjData(model)
    interface = interfaces.make(kind, VEHICLE)
    settle = round(min(task.settle, task.horizon) / VEHICLE.control_step)
    errors: list[float] = []

    def seen() -> State:
        return State.of_coordinates(
            position=data.qpos[:3] - origin,
            quaternion=data.qpos[3:].copy(),
            velocity=data.qvel[:3].copy(),
            body_rate=data.qvel[3:].copy(),
            rotor_speed=data.act.copy(),
            time=np.float64(len(errors) * VEHICLE.control_step),
        )

    def begin() -> tuple[Fields, Measures, np.ndarray]:
        errors.clear()
        start, fields = task.sample(Draw(generator.random(EPISODE_DRAWS)), VEHICLE)
        mujoco.mj_resetData(model, data)
        data.qpos[:] = np.concatenate([start.position + origin, start.quaternion])
        data.qvel[:] = np.concatenate([start.velocity, start.body_rate])
        data.act[:] = start.rotor_speed
        measures = task.measure(seen(), fields)
        return fields, measures, _flat(task.observe(seen(), measures, fields, VEHICLE))

    fields, measures, observation = begin()
    for action in actions:
        met = np.concatenate([data.qpos, data.qvel, data.act]), observation
        setpoint = interface.setpoint(seen(), action.astype(np.float64))
        command = np.zeros(ROTORS)
        for _ in range(VEHICLE.substeps):
            data.ctrl[:] = interface.rotor_command(seen(), setpoint)
            command += data.ctrl / VEHICLE.substeps
            mujoco.mj_step(model, data)
        if not interface.has_loops:
            command = setpoint
        errors.append(0.0)  # counts the step: `seen` tells the time
        state = seen()
        now = task.measure(state, fields)
        terminated = task.terminated(state, now, fields, VEHICLE)
        truncated = (len(errors) * VEHICLE.control_step > task.horizon - 1e-9) & ~terminated
        errors[-1] = float(task.error(state, now, fields))
        final, mean = sum(errors[-settle:]) / settle, sum(errors) / len(errors)
        means = Errors(final=np.float64(final), mean=np.float64(mean))
        over = terminated | truncated
        success = over & task.success(state, fields, means, terminated, truncated)
        outcome = Outcome(failed=terminated & ~success, succeeded=success)
        reward = total(task.reward(measures, now, command, outcome, VEHICLE))
        fields = task.update(state, now, fields, VEHICLE)
        measures = task.measure(state, fields)
        observation = _flat(task.observe(state, measures, fields, VEHICLE))
        yield *met, observation, reward, terminated, truncated, success
        if over:
            fields, measures, observation = begin()


def _dm_control(task: Task, seed: int, actions: np.ndarray, kind: str) -> Generator[tuple]:
    from quadrl import suite

    environment = suite.make(task, random=seed, action=kind)
    now = environment.reset()
    for action in actions:
        met = environment.physics.get_state(), _flat(now.observation)
        now = environment.step(action)
        success = environment.task.transition.is_success
        ended = now.last() and now.discount == 0.0, now.last() and now.discount == 1.0
        yield *met, _flat(now.observation), now.reward, *ended, success
        if now.last():
            now = environment.step(action)  # begins the next episode


def _gymnasium(task: Task, seed: int, actions: np.ndarray, kind: str) -> Generator[tuple]:
    from quadrl.envs.gymnasium import QuadrotorEnv

    door = QuadrotorEnv(task, action=kind)
    observation, _ = door.reset(seed=seed)
    for action in actions:
        met = _state(door.environment), observation
        observation, reward, terminated, truncated, info = door.step(action)
        yield *met, observation, reward, terminated, truncated, info["is_success"]
        if terminated or truncated:
            observation, _ = door.reset()


def _gymnasium_vector(
    mode: str, task: Task, seed: int, actions: np.ndarray, kind: str
) -> Generator[tuple]:
    from quadrl.envs.gymnasium import QuadrotorVectorEnv

    steps, count = actions.shape[:2]
    door = QuadrotorVectorEnv(task, count, autoreset_mode=mode, action=kind)
    observation, _ = door.reset(seed=seed)
    turn, flown = np.zeros(count, dtype=int), np.ones(count, dtype=bool)
    while turn.min() < steps:
        met = _state(door.environment), observation
        action = actions[np.minimum(turn, steps - 1), range(count)]
        observation, reward, terminated, truncated, info = door.step(action)
        over, after, success = terminated | truncated, observation, info["is_success"]
        if mode == "SAME_STEP" and over.any():
            after = observation.copy()
            after[over] = np.stack(info["final_obs"][over])
            success = success | info["final_info"]["is_success"]
        yield flown, *met, after, reward, terminated, truncated, success
        turn += flown
        if mode == "NEXT_STEP":
            flown = ~over
        if mode == "DISABLED" and over.any():
            observation, _ = door.reset(options={"reset_mask": over})


def _torchrl(task: Task, seed: int, actions: np.ndarray, kind: str) -> Generator[tuple]:
    import torch

    from quadrl.envs.torchrl import QuadrotorEnv

    door = QuadrotorEnv(task, actions.shape[1], seed=seed, action=kind)
    met, everyone = door.reset(), np.ones(actions.shape[1], dtype=bool)
    for action in actions:
        state = _state(door.environment)
        now, later = door.step_and_maybe_reset(met.set("action", torch.from_numpy(action)))
        brought = [now["next", name][:, 0].numpy() for name in COLUMNS[3:]]
        observation = met["observation"].numpy(), now["next", "observation"].numpy()
        yield everyone, state, *observation, *brought
        met = later


COLUMNS = ("state", "observation", "next_observation", "reward", "terminated", "truncated")
COLUMNS += ("is_success",)
SINGLE = {"mj_step": _mj_step, "dm_control": _dm_control, "gymnasium": _gymnasium}
VECTOR: dict[str, Callable[..., Generator[tuple]]] = {
    f"gymnasium vector {mode}": functools.partial(_gymnasium_vector, mode)
    for mode in ("NEXT_STEP", "SAME_STEP", "DISABLED")
} | {"torchrl": _torchrl}
DOORS = (*SINGLE, *VECTOR)
"""Ways to fly: bare mj_step, and every door."""


# ---------------------------------------------------------------------------------------- helpers


def varied_actions(steps: int, count: int) -> np.ndarray:
    """(T, N, 4) float32: one holds still, one climbs, one dives, the others do anything."""
    actions = np.random.default_rng(7).uniform(-1, 1, (steps, count, ROTORS))
    actions[:, 0] *= 0.1
    actions[:, 1:2], actions[:, 2:3] = 1.0, -1.0
    return actions.astype(np.float32)


def _outputs(
    task: Task, records: tuple[Any, ...], command: Array, shape: tuple[int, ...]
) -> dict[str, Array]:
    """What each function of a task gives, by name; their shapes and names are checked.

    Args:
        task: The task.
        records: Measures before the step, State after it and Fields.
        command: (..., 4) of the rotors [rad/s].
        shape: What (...) is.
    """
    before, state, fields = records
    with _blame(task, f"a function on arrays of leading shape {shape}"):
        now = task.measure(state, fields)
        terminated = task.terminated(state, now, fields, VEHICLE)
        _require_array(task, "terminated", terminated, shape, "bool")
        error = task.error(state, now, fields)
        errors = Errors(final=error, mean=error)
        success = task.success(state, fields, errors, terminated, ~terminated)
        _require_array(task, "success", success, shape, "bool")
        outcome = Outcome(failed=terminated & ~success, succeeded=success)
        terms = task.reward(before, now, command, outcome, VEHICLE)
        seen = task.observe(state, now, fields, VEHICLE)
        updated = task.update(state, now, fields, VEHICLE)
    _require(bool(terms), f"{task.name}: the reward has no terms")
    for name, value in (terms | {"error": error}).items():
        _require_array(task, name, value, shape, "float")
    _require(list(seen) == list(task.observation), f"{task.name}: observe gives {list(seen)}")
    for name, part in task.observation.items():
        _require_array(task, f"the part {name!r}", seen[name], (*shape, part.size), "float")
    scalars = {"error": error, "terminated": terminated, "success": success}
    return scalars | terms | seen | _named(measures=now, fields=updated)


def _require_array(task: Task, name: str, value: Array, shape: tuple[int, ...], kind: str) -> None:
    """Raise unless a value is an array of a shape and of a kind of numbers."""
    array = hasattr(value, "shape") and hasattr(value, "dtype")
    _require(array, f"{task.name}: {name} is {value!r}, no array of {kind}")
    got = tuple(value.shape)
    _require(got == shape, f"{task.name}: {name} has shape {got}, {shape} is expected")
    _require(kind in str(value.dtype), f"{task.name}: {name} is {value.dtype}, not {kind}")


def _named(**records: Start | Fields | Measures) -> dict[str, Array]:
    return {
        f"{prefix}.{field.name}": getattr(record, field.name)
        for prefix, record in records.items()
        for field in dataclasses.fields(record)
    }


def _mapped(function: Callable[[Any], Any], record: Any) -> Any:  # noqa: ANN401 - any record
    """A record with a function applied to each of its arrays."""
    names = [field.name for field in dataclasses.fields(record)]
    return type(record)(**{name: function(getattr(record, name)) for name in names})


def _frozen(array: np.ndarray) -> np.ndarray:
    copy = np.array(array)
    copy.flags.writeable = False
    return copy


def _state(environment: Environment) -> np.ndarray:
    simulation = environment.simulation
    return np.concatenate([simulation.qpos, simulation.qvel, simulation.act], axis=-1)


def _flat(observation: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate(list(observation.values()))


def _optional(module: str) -> Any:  # noqa: ANN401 - a module
    return importlib.import_module(module) if importlib.util.find_spec(module) else None


def _require(condition: object, message: str) -> None:
    if not condition:
        raise AssertionError(message)


def _require_equal(got: dict[str, Array], expected: dict[str, Array], message: str) -> None:
    for name, value in expected.items():
        same = np.array_equal(got[name], value)
        _require(same, f"{message}: {name} is {got[name]} and {value}")


def _require_torch(got: dict[str, Array], expected: dict[str, Array], message: str) -> None:
    for name, value in expected.items():
        tensor = hasattr(got[name], "detach")
        _require(tensor, f"{message} with tensors gives {name} as {type(got[name]).__name__}")
        close = np.allclose(got[name].detach().numpy(), value, rtol=1e-9, atol=1e-9)
        _require(close, f"{message} with tensors gives {name} = {got[name]}, with NumPy {value}")


@contextlib.contextmanager
def _blame(task: Task, what: str) -> Generator[None]:
    """Turn an exception into the task's breach."""
    try:
        yield
    except AssertionError:
        raise
    except Exception as error:
        raise AssertionError(
            f"{task.name}: {what} fails: {type(error).__name__}: {error}"
        ) from error
