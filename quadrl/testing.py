"""The contract of a task: what every engine and API relies on.

    from quadrl.testing import check_task
    check_task(MyTask)

A task that keeps it can be registered. The checks need no pytest; those of PyTorch, TorchRL and
dm_control are made where these are installed.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import logging
import unittest
import warnings
from collections.abc import Generator
from typing import Any

import numpy as np
import safetensors.numpy

from quadrl.core.environment import Environment
from quadrl.core.rules import ROWS, blame, check_rules, require, require_equal, varied_actions
from quadrl.core.task import Task
from quadrl.tasks import make

EPISODE = 2.4  # [s], the longest that is flown in the APIs
SEED = 3


def check_task(task: str | Task | type[Task]) -> None:
    """Check the whole contract of a task, alone and in every API.

    Args:
        task: A task, its class, or a name of the catalogue.

    Raises:
        AssertionError: The first fault that is found.
    """
    task = task() if isinstance(task, type) else make(task)
    check_rules(task, _optional("torch"))
    check_episodes(task)
    check_saving(task)
    if vars(type(task)).get("compiled"):
        check_compiled(task)
    short = task.replace(time_limit=min(task.time_limit, EPISODE))
    environment = Environment(short)
    steps = environment.time_limit_steps + 1  # past the end
    actions = varied_actions(steps, ROWS, environment.action_size)[:, 3]
    if _optional("dm_control"):
        check_flight(short, actions)
        check_dm_control(short, actions)
    check_gymnasium(short)
    if _optional("torchrl"):
        check_torchrl(short)


def check_episodes(task: Task) -> None:
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


def check_saving(task: Task) -> None:
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


def check_compiled(task: Task) -> None:
    """The step that the class has compiled gives what its functions give, episode after episode."""
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
        require_equal(given, row, f"{task.name}: dm_control and a batch differ")
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

    with warnings.catch_warnings(), blame(task, "Gymnasium's check_env"):
        warnings.simplefilter("error")
        for bound in ("minimum value is -infinity", "maximum value is infinity"):
            warnings.filterwarnings("ignore", f".*A Box observation space {bound}")
        check_env(QuadrotorEnv(task), skip_render_check=True)


def check_torchrl(task: Task) -> None:
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


def _optional(module: str) -> Any:
    return importlib.import_module(module) if importlib.util.find_spec(module) else None
