"""The contract of a task: what every engine and API takes for granted.

    from quadrl.testing import check_task
    check_task(MyTask)

A task that keeps it can be registered. The checks need no pytest; those of PyTorch and TorchRL are
made where these are installed. The file is longer than others because the checks of a task's
functions and those of its flights share their samples, and stand in the order in which they run.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import importlib.util
import unittest
import warnings
from collections.abc import Callable, Generator
from typing import Any

import numpy as np
import safetensors.numpy

from quadrl import tasks
from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base import records
from quadrl.base.rotation import Array
from quadrl.description import docstrings, source
from quadrl.environment import Environment
from quadrl.rng import Rng
from quadrl.snapshot import EpisodeEnd, Snapshot
from quadrl.state import State
from quadrl.task import Task

PAPER = Vehicle()
ROWS = 4
EPISODE = 2.4  # [s], the longest that is flown in the APIs
SEED = 3
COORDINATES = ("position", "quaternion", "velocity", "body_rate", "rotor_speed")


def check_task(task: str | Task | type[Task]) -> None:
    """Check everything that a task has to be, alone and in every API.

    Args:
        task: A task, its class, or a name of the catalogue.

    Raises:
        AssertionError: The first fault that is found.
    """
    task = task() if isinstance(task, type) else tasks.make(task)
    check_rules(task, _optional("torch"))
    check_episodes(task)
    check_saving(task)
    short = task.replace(time_limit=min(task.time_limit, EPISODE))
    environment = Environment(short)
    steps = environment.time_limit_steps + 1  # past the end
    actions = varied_actions(steps, ROWS, environment.action_size)[:, 3]
    check_flight(short, actions)
    check_dm_control(short, actions)
    check_gymnasium(short)
    if _optional("torchrl"):
        check_torchrl(short)


def check_rules(task: Task | type[Task], torch: Any = None) -> None:
    """Check in about a second what can be checked without flying: declarations and functions.

    Args:
        task: A task or its class.
        torch: The module, to check the functions with tensors as well.

    Raises:
        AssertionError: The first fault that is found.
    """
    task = task() if isinstance(task, type) else task
    check_declaration(task)
    check_begin(task, torch)
    check_functions(task, torch)


def check_declaration(task: Task) -> None:
    """Names, units and options are written down."""
    kind = type(task)
    settings = vars(kind).get("__dataclass_params__")
    own = settings is not None and settings.frozen
    _require(own, f"{kind.__name__} must be a frozen dataclass itself, not only its base")
    for attribute in ("name", "asks", "starts", "ends", "solved"):
        text = getattr(task, attribute, None)
        _require(isinstance(text, str) and text, f"{kind.__name__}.{attribute} must be a text")
    for name, term in task.observation.items():
        said = term.size >= 1 and term.unit and term.meaning
        _require(said, f"{task.name}: {name!r} needs a size, a unit and a meaning: {term}")
    for vehicle in ("paper", "hexa"):  # with four rotors and with six
        with _blame(task, f"an environment of the vehicle {vehicle!r}"):
            Environment(task, vehicle=vehicle)
    documented = docstrings(kind)
    for field in dataclasses.fields(task) if source(kind) else ():
        text = documented.get(field.name)
        _require(text, f"{task.name}: the option {field.name} needs a docstring")


def check_begin(task: Task, torch: Any = None) -> None:
    """A start follows from the random numbers alone, differs by row, and is the same in torch."""
    own = Parameters.of(parameters.rows(PAPER), PAPER.control_timestep)

    def begin(keys: Array, own: Parameters) -> dict[str, Array]:
        with _blame(task, "begin"):
            start, state = task.begin(Rng(keys, 0 * keys), own)
        return _named(start, "start") | _named(state, "task")

    keys = np.arange(ROWS)
    batch = begin(keys, own)
    _require_equal(batch, begin(keys, own), f"{task.name}: begin gives two starts for one key")
    for i in range(ROWS):
        row = {name: value[i : i + 1] for name, value in batch.items()}
        message = f"{task.name}: begin of one aircraft and of a batch differ"
        _require_equal(begin(keys[i : i + 1], own), row, message)
    varied = any(np.ptp(value, axis=0).any() for value in batch.values())
    _require(varied, f"{task.name}: every episode begins alike")
    if torch:
        tensors = own.map(torch.tensor)
        _require_close(begin(torch.tensor(keys), tensors), batch, f"{task.name}: begin", 1e-9)
        meta = own.map(lambda array: torch.tensor(array, device="meta"))
        begin(torch.tensor(keys, device="meta"), meta)


def check_functions(task: Task, torch: Any = None) -> None:
    """Shapes are those declared; a row, a batch and torch get the same; no argument is changed."""
    with _blame(task, "a reset"):
        environment = Environment(task, num_envs=ROWS, seed=1)
        environment.reset()
    before = _mapped(_frozen, environment.snapshot)
    with _blame(task, "a step"):
        environment.step(varied_actions(1, ROWS, environment.action_size)[0])
    now = _mapped(_frozen, environment.snapshot)
    batch = _outputs(task, before, now)
    for i in range(ROWS):

        def row(array: np.ndarray, i: int = i) -> np.ndarray:
            return array[i : i + 1] if len(array) == ROWS else array

        alone = _outputs(task, _mapped(row, before), _mapped(row, now))
        message = f"{task.name}: one aircraft and a batch get different numbers"
        _require_equal(alone, {k: value[i : i + 1] for k, value in batch.items()}, message)
    if torch:
        check_tensors(task, before, now, batch, torch)


def check_tensors(
    task: Task, before: Snapshot, now: Snapshot, expected: dict[str, Array], torch: Any
) -> None:
    """The functions take tensors of both precisions and of any device, and have gradients."""

    def tensor(array: np.ndarray, *, dtype: Any = None, device: str = "cpu") -> Any:
        return torch.tensor(array, dtype=dtype if array.dtype.kind == "f" else None, device=device)

    def given(**settings: Any) -> dict[str, Array]:
        return _outputs(task, *(_mapped(functools.partial(tensor, **settings), s) for s in pair))

    pair = before, now
    _require_close(given(), expected, task.name, 1e-9)
    single = given(dtype=torch.float32)
    _require_close(single, expected, task.name, 1e-3)
    for name, value in single.items():
        kept = not value.dtype.is_floating_point or value.dtype == torch.float32
        _require(kept, f"{task.name}: of float32, {name} becomes {value.dtype}")
    for name, value in given(device="meta").items():
        _require(value.device.type == "meta", f"{task.name}: {name} leaves the device")
    tensors = [_mapped(tensor, snapshot) for snapshot in pair]
    # Where the aircraft is, and where every distance is zero: at rest in the goal.
    goal = np.broadcast_to(np.asarray(task.goal(now)), now.state.position.shape)
    rest = np.zeros_like(now.state.velocity)
    level = np.broadcast_to([1.0, 0.0, 0.0, 0.0], now.state.quaternion.shape)
    still = {"position": goal, "quaternion": level, "velocity": rest, "body_rate": rest}
    height = float(now.state.height[0] - now.state.position[0, 2])
    for moved, where in (({}, "in flight"), (still, "at rest in the goal")):
        arrays = {name: moved.get(name, getattr(now.state, name)) for name in COORDINATES}
        leaves = {k: torch.tensor(array, requires_grad=True) for k, array in arrays.items()}
        state = State.of_coordinates(**leaves, origin_height=height)
        outputs = _outputs(task, tensors[0], dataclasses.replace(tensors[1], state=state))
        real = [value.sum() for value in outputs.values() if value.requires_grad]
        _require(real, f"{task.name}: with tensors, no output has a gradient")
        with _blame(task, "backward"):
            sum(real).backward()  # type: ignore[union-attr]
        for name, leaf in leaves.items():
            finite = leaf.grad is None or bool(leaf.grad.isfinite().all())
            _require(finite, f"{task.name}: the gradient by {name} {where} is {leaf.grad}")


def check_episodes(task: Task) -> None:
    """Whole episodes: finite numbers, and no entry of the observation that never changes."""
    environment = Environment(task, num_envs=ROWS, seed=1)
    seen, errors = [environment.flatten(environment.reset())], []
    with _blame(task, "markers"):
        environment.markers()
    for action in varied_actions(environment.time_limit_steps, ROWS, environment.action_size):
        with _blame(task, "a flight"):
            now = environment.step(action)
        seen.append(environment.flatten(now.observation))
        errors.append(now.error)
        over = np.logical_or(now.terminated, now.truncated)
        if over.any():
            seen.append(environment.flatten(environment.reset(over)))
    _require(np.isfinite(errors).all(), f"{task.name}: an error is not finite")
    _require(np.min(errors) >= 0, f"{task.name}: an error is negative")
    flat = np.concatenate(seen)
    for name, columns in environment.layout.items():
        term = flat[:, columns]
        _require(np.isfinite(term).all(), f"{task.name}: {name!r} is not always finite")
        constant = np.flatnonzero(np.ptp(term, axis=0) == 0).tolist()
        _require(not constant, f"{task.name}: entries {constant} of {name!r} never change")


def check_saving(task: Task) -> None:
    """What is saved in the middle of an episode can be stored, and another continues from it."""
    actions = varied_actions(6, ROWS, Environment(task).action_size)
    one, other = (Environment(task, num_envs=ROWS, seed=seed) for seed in (1, 2))
    one.reset()
    for action in actions[:3]:
        one.step(action)
    with _blame(task, "saving and restoring"):
        stored = safetensors.numpy.load(safetensors.numpy.save(one.save()))
        other.restore(stored)
    for action in actions[3:]:
        got, expected = (environment.step(action) for environment in (other, one))
        seen = [{"reward": now.reward} | now.observation for now in (got, expected)]
        _require_equal(seen[0], seen[1], f"{task.name}: a restored episode goes on otherwise")


def check_flight(task: Task, actions: np.ndarray) -> None:
    """Alone in dm_control's drawn model an aircraft flies as in a batch of the lean one.

    Args:
        task: The task.
        actions: (T, k); the flight ends with the episode.

    Raises:
        AssertionError: The first difference that is found.
    """
    from quadrl.envs import dm_control

    batch = Environment(task, num_envs=2, seed=SEED - 1)
    alone = dm_control.make(task, random=SEED)
    batch.reset()
    alone.reset()
    for action in actions:
        now, step = batch.step(np.stack([0 * action, action])), alone.step(action)
        own = now.observation | {"reward": now.reward, "discount": 1.0 - now.terminated}
        own["last"] = now.terminated | now.truncated
        given = step.observation | {"reward": step.reward, "discount": step.discount}
        given["last"] = step.last()
        row = {name: value[1] for name, value in own.items()}
        _require_equal(given, row, f"{task.name}: dm_control and a batch differ")
        if step.last():
            return


def check_dm_control(task: Task, actions: np.ndarray) -> None:
    """dm_env's own tests of an environment; the actions (T, k) should lead past an end."""
    from dm_env.test_utils import EnvironmentTestMixin

    from quadrl.envs import dm_control

    class Contract(EnvironmentTestMixin, unittest.TestCase):
        def make_object_under_test(self, **_: Any) -> Any:
            return dm_control.make(task, random=0)

        def make_action_sequence(self) -> Generator[np.ndarray]:
            yield from actions

    result = unittest.TestResult()
    unittest.defaultTestLoader.loadTestsFromTestCase(Contract).run(result)
    faults = [text for _, text in result.failures + result.errors]
    if faults or result.testsRun < 4:
        raise AssertionError(f"{task.name}: against dm_env's contract\n{''.join(faults)}")


def check_gymnasium(task: Task) -> None:
    """Gymnasium's own check; only the warning that observations have no bounds may appear."""
    from gymnasium.utils.env_checker import check_env

    from quadrl.envs.gymnasium import QuadrotorEnv

    with warnings.catch_warnings(), _blame(task, "Gymnasium's check_env"):
        warnings.simplefilter("error")
        for bound in ("minimum value is -infinity", "maximum value is infinity"):
            warnings.filterwarnings("ignore", f".*A Box observation space {bound}")
        check_env(QuadrotorEnv(task), skip_render_check=True)


def check_torchrl(task: Task) -> None:
    """TorchRL's own check of what is given against what is declared."""
    from torchrl.envs import check_env_specs

    from quadrl.envs.torchrl import QuadrotorEnv

    with _blame(task, "TorchRL's check_env_specs"):
        check_env_specs(QuadrotorEnv(task, 3, seed=0, reward_terms=True))


def varied_actions(steps: int, count: int, size: int = 4) -> np.ndarray:
    """(T, N, k) float32: row 0 holds still, 1 climbs, 2 dives, the others do anything."""
    actions = np.random.default_rng(7).uniform(-1, 1, (steps, count, size))
    actions[:, 0] *= 0.1
    actions[:, 1:2], actions[:, 2:3] = 1.0, -1.0
    return actions.astype(np.float32)


def _outputs(task: Task, before: Snapshot, now: Snapshot) -> dict[str, Array]:
    """What each function of a task gives, by name."""
    rows = f"{len(now.time)} rows of {type(now.time).__module__} arrays"
    with _blame(task, f"a function of {rows}"):
        now = dataclasses.replace(now, potentials=task.measure(now))
        terminated, error = task.terminated(now), task.error(now)
        end = EpisodeEnd(terminated, ~terminated, 0 * error + 1, error, error, 1)
        end.succeeded = succeeded = task.succeeded(now, end)
        terms, seen = task.reward(before, now, end), task.observe(now)
        updated = task.update(before, now)
    outputs = {"error": error, "terminated": terminated, "succeeded": succeeded, **terms, **seen}
    return outputs | _named(now.potentials, "potentials") | _named(updated, "task")


def _named(record: Any, prefix: str) -> dict[str, Array]:
    fields = dataclasses.fields(record)
    return {f"{prefix}.{field.name}": getattr(record, field.name) for field in fields}


def _mapped(function: Callable[[Any], Any], now: Snapshot) -> Snapshot:
    """A snapshot with a function applied to every array in it."""
    mapped = records.mapped(function, now)
    mapped.parameters = now.parameters.map(function)
    return mapped


def _frozen(array: np.ndarray) -> np.ndarray:
    copy = np.array(array)
    copy.flags.writeable = False
    return copy


def _optional(module: str) -> Any:
    return importlib.import_module(module) if importlib.util.find_spec(module) else None


def _require(condition: object, message: str) -> None:
    if not condition:
        raise AssertionError(message)


def _require_equal(got: dict[str, Array], expected: dict[str, Array], message: str) -> None:
    for name, value in expected.items():
        same = np.array_equal(got[name], value)
        _require(same, f"{message}: {name} is {got[name]} and {value}")


def _require_close(
    got: dict[str, Array], expected: dict[str, Array], message: str, tolerance: float
) -> None:
    for name, value in expected.items():
        tensor = hasattr(got[name], "detach")
        _require(tensor, f"{message} with tensors gives {name} as {type(got[name]).__name__}")
        found = got[name].detach().numpy()
        close = np.allclose(found, value, rtol=tolerance, atol=tolerance)
        _require(
            close and found.shape == value.shape,
            f"{message} with tensors gives {name} = {got[name]}, with NumPy {value}",
        )


@contextlib.contextmanager
def _blame(task: Task, what: str) -> Generator[None]:
    """Report an exception as a fault of the task."""
    try:
        yield
    except Exception as error:
        raise AssertionError(
            f"{task.name}: {what} fails: {type(error).__name__}: {error}"
        ) from error
