"""The domain `quadrotor` in the style of dm_control's suite.

`load` has the signature of `dm_control.suite.load`; `register` adds the domain to dm_control's own,
so that `dm_control.suite.load("quadrotor", "hover")` and TorchRL's `DMControlEnv` find it.
"""

from __future__ import annotations

import functools
import sys
from typing import TYPE_CHECKING, Any

from quadrl.base import validation
from quadrl.tasks import TASKS

if TYPE_CHECKING:
    from dm_control.rl import control

DOMAIN = "quadrotor"
SUITE: Any = None
"""The tasks that `register` adds, as dm_control keeps them; None before."""
BENCHMARKING: tuple[tuple[str, str], ...] = ()
"""Empty: dm_control demands that every reward of these lies in [0, 1]; the paper's do not."""

ALL_TASKS: tuple[tuple[str, str], ...]
"""(domain, task) pairs, as in dm_control.suite."""
TASKS_BY_DOMAIN: dict[str, tuple[str, ...]]
"""The task names of the domain."""


def load(
    domain_name: str,
    task_name: str,
    task_kwargs: dict[str, Any] | None = None,
    environment_kwargs: dict[str, Any] | None = None,
    visualize_reward: bool = False,
) -> control.Environment:
    """Load an environment as `dm_control.suite.load` does.

    Args:
        domain_name: "quadrotor".
        task_name: A name of the catalogue.
        task_kwargs: `random` (seed), `time_limit` [s], the conditions (`vehicle`, `weather` and the
            others, as `quadrl.core.scenario.Conditions` has them), and any option of the task.
        environment_kwargs: Those of `dm_control.rl.control.Environment`: `time_limit` and
            `control_timestep` [s], `n_sub_steps`, `flat_observation`, `legacy_step`.
        visualize_reward: Colour the aircraft by its reward, clipped to [0, 1].

    Raises:
        ImportError: dm-control is not installed.
        QuadrlError: Unknown name or impossible value.
    """
    from quadrl.envs.dm_control import make

    validation.choice("domain_name", domain_name, [DOMAIN])
    validation.choice("task_name", task_name, TASKS)
    given: Any = task_kwargs or {}
    environment = make(task_name, environment_kwargs=environment_kwargs, **given)
    environment.task.visualize_reward = visualize_reward
    return environment


def register() -> None:
    """Add the domain, with every task of the catalogue, to dm_control's own (idempotent).

    Raises:
        ImportError: dm-control is not installed.
    """
    from quadrl.envs.dm_control import make  # first: it says what it needs, and what draws

    from dm_control import suite  # isort: skip
    from dm_control.utils import containers  # isort: skip

    global SUITE
    SUITE = containers.TaggedTasks()
    for name in TASKS:
        factory = functools.partial(make, name)
        factory.__name__ = name  # type: ignore[attr-defined]
        SUITE.add()(factory)
    suite._DOMAINS[DOMAIN] = sys.modules[__name__]
    suite.ALL_TASKS = suite._get_tasks(tag=None)
    suite.BENCHMARKING = suite._get_tasks("benchmarking")
    suite.EASY, suite.HARD = suite._get_tasks("easy"), suite._get_tasks("hard")
    suite.EXTRA = tuple(sorted(set(suite.ALL_TASKS) - set(suite.BENCHMARKING)))
    suite.NO_REWARD_VIZ = suite._get_tasks("no_reward_visualization")
    suite.REWARD_VIZ = tuple(sorted(set(suite.ALL_TASKS) - set(suite.NO_REWARD_VIZ)))
    suite.TASKS_BY_DOMAIN = suite._get_tasks_by_domain(suite.ALL_TASKS)


def __getattr__(name: str) -> Any:
    """The two constants that grow when a task is registered."""
    if name == "ALL_TASKS":
        return tuple((DOMAIN, task) for task in TASKS)
    if name == "TASKS_BY_DOMAIN":
        return {DOMAIN: tuple(TASKS)}
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
