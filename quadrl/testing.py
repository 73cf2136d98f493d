"""The contract of a task: what every engine and API relies on.

    from quadrl.testing import check_task
    check_task(MyTask)

A task that keeps it can be registered. The checks need no pytest; those of PyTorch, TorchRL and
dm_control are made where these are installed.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.util
import logging
import unittest
import warnings
from collections.abc import Callable, Generator
from typing import Any

import numpy as np
import safetensors.numpy

from quadrl.base.rotation import Array
from quadrl.core import rules
from quadrl.core.environment import Environment
from quadrl.core.faults import blame, require, require_equal
from quadrl.core.rules import ROWS, outputs
from quadrl.core.task import Task
from quadrl.engines.state import State

EPISODE = 2.4  # [s], the longest that is flown in the APIs
SEED = 3


def varied_actions(steps: int, count: int, size: int = 4) -> np.ndarray:
    """(T, N, k) float32: row 0 holds still, 1 climbs, 2 dives, the others do anything."""
    actions = np.random.default_rng(7).uniform(-1, 1, (steps, count, size))
    actions[:, 0] *= 0.1
    actions[:, 1:2], actions[:, 2:3] = 1.0, -1.0
    return actions.astype(np.float32)


def takes_tensors(task: Task) -> None:
    """The functions take tensors of both precisions and of any device, and have gradients."""
    if (torch := _optional("torch")) is None:
        return
    before, now = pair = rules.moments(task)
    expected = outputs(task, before, now)

    def tensor(array: np.ndarray, *, dtype: Any = None, device: str = "cpu") -> Any:
        return torch.tensor(array, dtype=dtype if array.dtype.kind == "f" else None, device=device)

    def given(**settings: Any) -> dict[str, Array]:
        mapped = functools.partial(rules.mapped, functools.partial(tensor, **settings))
        return outputs(task, *map(mapped, pair))

    keys, own = np.arange(ROWS), rules.seen_by(task)[0]
    begins = rules.starts(task, torch.from_numpy(keys), own.map(torch.tensor))
    _require_close(begins, rules.starts(task, keys, own), f"{task.name}: begin", 1e-9)
    meta = own.map(functools.partial(torch.tensor, device="meta"))
    rules.starts(task, torch.tensor(keys, device="meta"), meta)
    _require_close(given(), expected, task.name, 1e-9)
    single = given(dtype=torch.float32)
    _require_close(single, expected, task.name, 1e-3)
    for name, value in single.items():
        kept = not value.dtype.is_floating_point or value.dtype == torch.float32
        require(kept, f"{task.name}: of float32, {name} becomes {value.dtype}")
    for name, value in given(device="meta").items():
        require(value.device.type == "meta", f"{task.name}: {name} leaves the device")
    tensors = [rules.mapped(tensor, snapshot) for snapshot in pair]
    # Where the aircraft is, and where every distance is zero: at rest in the goal.
    goal = np.broadcast_to(np.asarray(task.goal(now)), now.state.position.shape)
    rest = np.zeros_like(now.state.velocity)
    level = np.broadcast_to([1.0, 0.0, 0.0, 0.0], now.state.quaternion.shape)
    still = {"position": goal, "quaternion": level, "velocity": rest, "body_rate": rest}
    height = float(now.state.height[0] - now.state.position[0, 2])
    for moved, where in (({}, "in flight"), (still, "at rest in the goal")):
        arrays = {name: moved.get(name, getattr(now.state, name)) for name in rules.COORDINATES}
        leaves = {k: torch.tensor(array, requires_grad=True) for k, array in arrays.items()}
        state = State.of_coordinates(**leaves, origin_height=height)
        gives = outputs(task, tensors[0], dataclasses.replace(tensors[1], state=state))
        real = {name: value for name, value in gives.items() if value.requires_grad}
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


def flies_whole_episodes(task: Task) -> None:
    """Whole episodes: finite numbers, and no entry of the observation that never changes."""
    environment = Environment(task, num_envs=ROWS, seed=1)
    seen, errors = [environment.flatten(environment.reset())], []
    with blame(task, "markers"):
        environment.markers()
    for action in varied_actions(environment.time_limit_steps, ROWS, environment.action_size):
        with blame(task, "a flight"):
            now = environment.step(action)
        seen.append(environment.flatten(now.observation))
        errors.append(now.error)
        over = np.logical_or(now.terminated, now.truncated)
        if over.any():
            seen.append(environment.flatten(environment.reset(over)))
    require(np.isfinite(errors).all(), f"{task.name}: an error is not finite")
    require(np.min(errors) >= 0, f"{task.name}: an error is negative")
    flat = np.concatenate(seen)
    for name, columns in environment.layout.items():
        term = flat[:, columns]
        require(np.isfinite(term).all(), f"{task.name}: {name!r} is not always finite")
        constant = np.flatnonzero(np.ptp(term, axis=0) == 0).tolist()
        require(not constant, f"{task.name}: entries {constant} of {name!r} never change")


def continues_from_a_save(task: Task) -> None:
    """What is saved in the middle of an episode can be stored, and another continues from it."""
    actions = varied_actions(6, ROWS, Environment(task).action_size)
    one, other = (Environment(task, num_envs=ROWS, seed=seed) for seed in (1, 2))
    one.reset()
    for action in actions[:3]:
        one.step(action)
    with blame(task, "saving and restoring"):
        stored = safetensors.numpy.load(safetensors.numpy.save(one.save()))
        other.restore(stored)
    for action in actions[3:]:
        got, expected = (environment.step(action) for environment in (other, one))
        seen = [{"reward": now.reward} | now.observation for now in (got, expected)]
        require_equal(seen[0], seen[1], f"{task.name}: a restored episode goes on otherwise")


def is_the_same_compiled(task: Task) -> None:
    """The step that the class has compiled gives what its functions give, episode after episode."""
    if not task.asks_compiled:
        return
    kind = dataclasses.dataclass(frozen=True)(type("Written", (type(task),), {"compiled": False}))
    options = {field.name: getattr(task, field.name) for field in dataclasses.fields(task)}
    pair = [Environment(one, num_envs=ROWS, seed=1) for one in (task, kind(**options))]
    for environment in pair:
        environment.reset()
    said = f"{task.name}: with `compiled = True` it gives something else than its functions"
    steps = 2 * pair[0].time_limit_steps
    for action in varied_actions(steps, ROWS, pair[0].action_size):
        with blame(task, "a flight"):
            got, expected = (environment.step(action) for environment in pair)
        for name in ("reward_terms", "observation"):
            require_equal(getattr(got, name), getattr(expected, name), f"{said}: {name}")
        for name in ("error", "terminated", "is_success"):
            one, other = ({name: getattr(done, name)} for done in (got, expected))
            require_equal(one, other, said)
        if (over := np.logical_or(expected.terminated, expected.truncated)).any():
            for environment in pair:
                environment.reset(over)


def flies_alone_as_in_a_batch(task: Task, actions: np.ndarray) -> None:
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
        require_equal(given, row, f"{task.name}: dm_control and a batch differ")
        if step.last():
            return


def keeps_dm_env(task: Task, actions: np.ndarray) -> None:
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


def keeps_gymnasium(task: Task) -> None:
    """Gymnasium's own check; only the warning that observations have no bounds may appear."""
    from gymnasium.utils.env_checker import check_env

    from quadrl.envs.gymnasium import QuadrotorEnv

    with warnings.catch_warnings(), blame(task, "Gymnasium's check_env"):
        warnings.simplefilter("error")
        for bound in ("minimum value is -infinity", "maximum value is infinity"):
            warnings.filterwarnings("ignore", f".*A Box observation space {bound}")
        check_env(QuadrotorEnv(task), skip_render_check=True)


def keeps_torchrl(task: Task) -> None:
    """TorchRL's own check of values against their specs."""
    from torchrl.envs import check_env_specs

    from quadrl.envs.torchrl import QuadrotorEnv

    log = logging.getLogger("torchrl")
    level = log.level
    log.setLevel(logging.WARNING)  # it would say in colour that all is well
    try:
        with blame(task, "TorchRL's check_env_specs"):
            check_env_specs(QuadrotorEnv(task, 3, seed=0, reward_terms=True))
    finally:
        log.setLevel(level)


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


def is_alike_in_every_api(task: Task) -> None:
    """Those of the APIs that are installed keep their own contracts with it, and give its numbers.

    It is flown past the end of an episode.
    """
    short = task.replace(time_limit=min(task.time_limit, EPISODE))
    environment = Environment(short)
    steps = environment.time_limit_steps + 1
    actions = varied_actions(steps, ROWS, environment.action_size)[:, 3]
    if _optional("dm_control"):
        flies_alone_as_in_a_batch(short, actions)
        keeps_dm_env(short, actions)
    keeps_gymnasium(short)
    if _optional("torchrl"):
        keeps_torchrl(short)


def _optional(module: str) -> Any:
    return importlib.import_module(module) if importlib.util.find_spec(module) else None


CLAUSES = (
    takes_tensors,
    flies_whole_episodes,
    continues_from_a_save,
    is_the_same_compiled,
    is_alike_in_every_api,
)
check_task: Callable[[str | Task | type[Task]], None]
check_task = functools.partial(rules.check_rules, clauses=CLAUSES)
"""Check the whole contract of a task, alone and in every API.

It takes a task, its class, or a name of the catalogue. The first fault that is found is an
AssertionError.
"""
