"""The rules that every task keeps, and the import of a user's file, whose tasks must keep them."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.util
import inspect
import itertools
import sys
import traceback
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base import records
from quadrl.base.docstrings import docstrings, source
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array
from quadrl.core.catalogue import TASKS
from quadrl.core.environment import Environment
from quadrl.core.snapshot import EpisodeEnd, Snapshot
from quadrl.core.task import Task
from quadrl.engines.rng import Rng
from quadrl.engines.state import State

PAPER = Vehicle()
ROWS = 4
COORDINATES = ("position", "quaternion", "velocity", "body_rate", "rotor_speed")


IMPORTED: dict[Path, str] = {}
"""The sha256 of each file that `import_own` has run, by its path."""


def import_own(path: Path) -> None:
    """Run a file, which registers the user's own tasks and aircraft.

    Raises:
        QuadrlError: There is no such file, or it fails, or a task in it breaks a rule; the message
            names the file and the line.
    """
    if not path.is_file():
        raise QuadrlError(name="--import", value=str(path), allowed="the path of a Python file")
    content, known = path.read_bytes(), set(TASKS)
    spec: Any = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    with _located(path):
        spec.loader.exec_module(module)
    for kind in [kind for name, kind in TASKS.items() if name not in known]:
        with _located(path, inspect.getsourcelines(kind)[1]):
            check_rules(kind)
    IMPORTED[path.resolve()] = hashlib.sha256(content).hexdigest()


@contextlib.contextmanager
def _located(path: Path, line: int | None = None) -> Generator[None]:
    """Report a failure with the last line of the user's file that led to it, or a given line."""
    try:
        yield
    except Exception as error:
        frames, cause = list[traceback.FrameSummary](), error
        while cause is not None:
            frames += traceback.extract_tb(cause.__traceback__)
            cause = cause.__cause__
        lines = [
            frame.lineno for frame in frames if Path(frame.filename).resolve() == path.resolve()
        ]
        line = error.lineno if isinstance(error, SyntaxError) else (lines or [line])[-1]
        where = f"{path}, line {line}" if line else str(path)
        # What a check of quadrl says is a sentence; what Python says needs its kind.
        said = error if isinstance(error, (AssertionError, QuadrlError)) else repr(error)
        raise QuadrlError(f"{where}: {said}") from error


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
    check_start(task)


def check_declaration(task: Task) -> None:
    """Names, units and options are written down."""
    kind = type(task)
    settings = vars(kind).get("__dataclass_params__")
    own = settings is not None and settings.frozen
    require(own, f"{kind.__name__} must be a frozen dataclass itself, not only its base")
    for attribute in ("name", "asks", "starts", "ends", "solved"):
        text = getattr(task, attribute, None)
        require(isinstance(text, str) and text, f"{kind.__name__}.{attribute} must be a text")
    for name, term in task.observation.items():
        said = term.size >= 1 and term.unit and term.meaning
        require(said, f"{task.name}: {name!r} needs a size, a unit and a meaning: {term}")
    for vehicle in ("paper", "hexa"):  # with four rotors and with six
        with blame(task, f"an environment of the vehicle {vehicle!r}"):
            Environment(task, vehicle=vehicle)
    documented = docstrings(kind)
    for field in dataclasses.fields(task) if source(kind) else ():
        text = documented.get(field.name)
        require(text, f"{task.name}: the option {field.name} needs a docstring")


def check_begin(task: Task, torch: Any = None) -> None:
    """A start follows from the random numbers alone, differs by row, and is the same in torch."""
    own = Parameters.of(parameters.rows(PAPER), PAPER.control_timestep)

    def begin(keys: Array, own: Parameters) -> dict[str, Array]:
        with blame(task, "begin"):
            start, state = task.begin(Rng(keys, 0 * keys), own)
            state = task.remember(start, state)
        return _named(start, "start") | _named(state, "task")

    keys = np.arange(ROWS)
    batch = begin(keys, own)
    require_equal(batch, begin(keys, own), f"{task.name}: begin gives two starts for one key")
    for i in range(ROWS):
        row = {name: value[i : i + 1] for name, value in batch.items()}
        message = f"{task.name}: begin of one aircraft and of a batch differ"
        require_equal(begin(keys[i : i + 1], own), row, message)
    varied = any(np.ptp(value, axis=0).any() for value in batch.values())
    require(varied, f"{task.name}: every episode begins alike")
    if torch:
        tensors = own.map(torch.tensor)
        _require_close(begin(torch.tensor(keys), tensors), batch, f"{task.name}: begin", 1e-9)
        meta = own.map(lambda array: torch.tensor(array, device="meta"))
        begin(torch.tensor(keys, device="meta"), meta)


def check_functions(task: Task, torch: Any = None) -> None:
    """Shapes are those declared; a row, a batch and torch get the same; no argument is changed."""
    with blame(task, "a reset"):
        environment = Environment(task, num_envs=ROWS, seed=1)
        environment.reset()
    before = _mapped(_frozen, environment.snapshot)
    with blame(task, "a step"):
        environment.step(varied_actions(1, ROWS, environment.action_size)[0])
    now = _mapped(_frozen, environment.snapshot)
    batch = _outputs(task, before, now)
    for i in range(ROWS):

        def row(array: np.ndarray, i: int = i) -> np.ndarray:
            return array[i : i + 1] if len(array) == ROWS else array

        alone = _outputs(task, _mapped(row, before), _mapped(row, now))
        message = f"{task.name}: one aircraft and a batch get different numbers"
        require_equal(alone, {k: value[i : i + 1] for k, value in batch.items()}, message)
    if torch:
        check_tensors(task, before, now, batch, torch)


def check_start(task: Task) -> None:
    """What it remembers of every step, it remembers of a start that `reset` is given, too."""
    with blame(task, "a reset from a given start"):
        environment = Environment(task, num_envs=ROWS, seed=1)
        environment.reset()
        drawn, more = environment.snapshot.state, 0.1 * np.arange(1.0, ROWS + 1)[:, None]
        start = {"position": drawn.position + more * [0.0, 0.0, 0.1]}  # where little can stand
        start |= {name: getattr(drawn, name) + more for name in ("velocity", "body_rate")}
        environment.reset(start=start)
        begun = _remembered(environment.snapshot)
        environment.step(np.zeros((ROWS, environment.action_size)))
        after = _remembered(environment.snapshot)
    for name, (own, value) in after.items():
        if np.array_equal(own, value) and np.ptp(value, axis=0).any():
            message = f"{name} after every step, but not at a start that reset was given"
            require(np.allclose(*begun[name]), f"{task.name}: {message}: make it in `remember`")


def _remembered(now: Snapshot) -> dict[str, tuple[Array, Array]]:
    """Copies of what a task remembers beside all of the same shape that it may be a copy of."""
    seen = records.arrays("state", now.state) | records.arrays("potentials", now.potentials)
    pairs = itertools.product(records.arrays("task", now.task).items(), seen.items())
    return {f"{name} is {other}": (x, y) for (name, x), (other, y) in pairs if x.shape == y.shape}


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
        require(kept, f"{task.name}: of float32, {name} becomes {value.dtype}")
    for name, value in given(device="meta").items():
        require(value.device.type == "meta", f"{task.name}: {name} leaves the device")
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
        real = {name: value for name, value in outputs.items() if value.requires_grad}
        require(real, f"{task.name}: with tensors, no output has a gradient")
        for name, value in real.items():
            with blame(task, f"backward of {name!r}"):
                found = torch.autograd.grad(
                    value.sum(), [*leaves.values()], retain_graph=True, allow_unused=True
                )
            for by, one in zip(leaves, found, strict=True):
                cure = (
                    f"by {by}; take lengths by quadrl.base.rotation.norm, whose gradient is 0 there"
                )
                finite = one is None or bool(one.isfinite().all())
                require(finite, f"{task.name}: {name!r} has no gradient {where} {cure}")


def varied_actions(steps: int, count: int, size: int = 4) -> np.ndarray:
    """(T, N, k) float32: row 0 holds still, 1 climbs, 2 dives, the others do anything."""
    actions = np.random.default_rng(7).uniform(-1, 1, (steps, count, size))
    actions[:, 0] *= 0.1
    actions[:, 1:2], actions[:, 2:3] = 1.0, -1.0
    return actions.astype(np.float32)


def _outputs(task: Task, before: Snapshot, now: Snapshot) -> dict[str, Array]:
    """What each function of a task gives, by name."""
    rows = f"{len(now.time)} rows of {type(now.time).__module__} arrays"
    with blame(task, f"a function of {rows}"):
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


def require(condition: object, message: str) -> None:
    """Report a fault unless the condition holds."""
    if not condition:
        raise AssertionError(message)


def require_equal(got: dict[str, Array], expected: dict[str, Array], message: str) -> None:
    """Report the first array that is not what is expected."""
    for name, value in expected.items():
        same = np.array_equal(got[name], value)
        require(same, f"{message}: {name} is {got[name]} and {value}")


def _require_close(
    got: dict[str, Array], expected: dict[str, Array], message: str, tolerance: float
) -> None:
    for name, value in expected.items():
        tensor = hasattr(got[name], "detach")
        require(tensor, f"{message} with tensors gives {name} as {type(got[name]).__name__}")
        found = got[name].detach().numpy()
        close = np.allclose(found, value, rtol=tolerance, atol=tolerance)
        require(
            close and found.shape == value.shape,
            f"{message} with tensors gives {name} = {got[name]}, with NumPy {value}",
        )


@contextlib.contextmanager
def blame(task: Task, what: str) -> Generator[None]:
    """Report an exception as a fault of the task."""
    try:
        yield
    except Exception as error:
        raise AssertionError(
            f"{task.name}: {what} fails: {type(error).__name__}: {error}"
        ) from error
