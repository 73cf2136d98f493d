"""What `quadrl.testing.check_task` asks of a task in the APIs."""

from __future__ import annotations

import importlib.util
import unittest
import warnings
from collections.abc import Callable, Generator
from typing import Any

import numpy as np

from quadrl.environment import Environment
from quadrl.task import Task

SEED = 3
EPISODE = 2.4  # [s], the longest that is flown
NAMES = ("observation", "reward", "terminated", "truncated", "is_success")
Api = tuple[Callable[[], Any], Callable[[np.ndarray], tuple[Any, ...]]]
"""Of one aircraft: its reset gives an observation, its step what NAMES says."""


def check_apis(task: Task, actions: np.ndarray) -> None:
    """Every API gives the numbers of `Environment`, and passes the checks of its framework.

    Args:
        task: The task.
        actions: (T, k) float32, longer than an episode.

    Raises:
        AssertionError: The first fault that is found.
    """
    task = task.replace(time_limit=min(task.time_limit, EPISODE))
    apis = [_dm_control, _gymnasium, _gymnasium_vector]
    with_torch = importlib.util.find_spec("torchrl") is not None
    if with_torch:
        apis.append(_torchrl)
    flown = _fly(_core(task), actions)
    for api in apis:
        for given, own in zip(_fly(api(task), actions), flown, strict=False):
            for name, value, right in zip(NAMES, given, own, strict=False):
                if not np.array_equal(value, np.asarray(right).astype(np.asarray(value).dtype)):
                    found = f"{name} through {api.__name__[1:]} is {value}; Environment: {right}"
                    raise AssertionError(f"{task.name}: {found}")
    check_dm_control(task, actions[: len(flown) + 1])
    check_gymnasium(task)
    if with_torch:
        check_torchrl(task)


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

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for bound in ("minimum value is -infinity", "maximum value is infinity"):
            warnings.filterwarnings("ignore", f".*A Box observation space {bound}")
        try:
            check_env(QuadrotorEnv(task), skip_render_check=True)
        except Exception as error:
            raise AssertionError(f"{task.name}: against Gymnasium's check_env: {error}") from error


def check_torchrl(task: Task) -> None:
    """TorchRL's own check of what is given against what is declared."""
    from torchrl.envs import check_env_specs

    from quadrl.envs.torchrl import QuadrotorEnv

    try:
        check_env_specs(QuadrotorEnv(task, 3, seed=0, reward_terms=True))
    except Exception as error:
        raise AssertionError(f"{task.name}: against check_env_specs: {error}") from error


def _fly(api: Api, actions: np.ndarray) -> list[tuple[Any, ...]]:
    """The first observation, and what each step to the end of the episode gives."""
    begin, step = api
    flight: list[tuple[Any, ...]] = [(begin(),)]
    for action in actions:
        flight.append(step(action))
        if flight[-1][2] or flight[-1][3]:
            break
    return flight


def _core(task: Task) -> Api:
    environment = Environment(task, seed=SEED)

    def flat(observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.concatenate(list(observation.values()), axis=-1)[0]

    def step(action: np.ndarray) -> tuple[Any, ...]:
        now = environment.step(action[None])
        return flat(now.observation), *(getattr(now, name)[0] for name in NAMES[1:])

    return lambda: flat(environment.reset()), step


def _dm_control(task: Task) -> Api:
    from quadrl.envs import dm_control

    environment = dm_control.make(task, random=SEED)

    def flat(now: Any) -> np.ndarray:
        return np.concatenate(list(now.observation.values()))

    def step(action: np.ndarray) -> tuple[Any, ...]:
        now = environment.step(action)
        ended = now.last() and now.discount == 0.0, now.last() and now.discount == 1.0
        return flat(now), now.reward, *ended, environment.task.transition.is_success[0]

    return lambda: flat(environment.reset()), step


def _gymnasium(task: Task) -> Api:
    from quadrl.envs.gymnasium import QuadrotorEnv

    environment = QuadrotorEnv(task)

    def step(action: np.ndarray) -> tuple[Any, ...]:
        *values, info = environment.step(action)
        return *values, info["is_success"]

    return lambda: environment.reset(seed=SEED)[0], step


def _gymnasium_vector(task: Task) -> Api:
    from quadrl.envs.gymnasium import QuadrotorVectorEnv

    environment = QuadrotorVectorEnv(task, 2)

    def step(action: np.ndarray) -> tuple[Any, ...]:
        *values, info = environment.step(np.stack([0 * action, action]))
        return *(value[1] for value in values), info["is_success"][1]

    return lambda: environment.reset(seed=SEED - 1)[0][1], step


def _torchrl(task: Task) -> Api:
    import torch

    from quadrl.envs.torchrl import QuadrotorEnv

    environment = QuadrotorEnv(task, 2, seed=SEED - 1)

    def step(action: np.ndarray) -> tuple[Any, ...]:
        actions = torch.from_numpy(np.stack([0 * action, action]))
        now = environment.step(environment.fake_tensordict().set("action", actions))["next"]
        return now["observation"][1].numpy(), *(now[name][1].numpy()[0] for name in NAMES[1:])

    return lambda: environment.reset()["observation"][1].numpy(), step
