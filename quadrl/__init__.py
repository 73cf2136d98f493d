"""Reinforcement learning for quadrotors on MuJoCo.

    import quadrl
    environment = quadrl.load("hover")                       # dm_control
    environment = gymnasium.make("quadrl/Hover-v0")          # Gymnasium
    environment = quadrl.envs.torchrl.QuadrotorEnv("hover")  # TorchRL
    run = quadrl.train("hover", seed=0)                      # as the command `quadrl train`
    quadrl.evaluate(run), quadrl.render(run), quadrl.plot(run)

The import registers the Gymnasium ids; dm_control, torch and rendering are imported on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from quadrl import envs, tasks
from quadrl.aircraft.aerodynamics import Aerodynamics
from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.rotors import Rotor, ring
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.extras import needed
from quadrl.base.shield import shield_triton
from quadrl.base.validation import registered
from quadrl.base.version import __version__ as __version__
from quadrl.conditions.observing import Observing
from quadrl.conditions.randomization import Randomization
from quadrl.conditions.randomizations import RANDOMIZATIONS
from quadrl.core.task import Task
from quadrl.evaluation.policy import Policy
from quadrl.learning.defaults import check_stated

if TYPE_CHECKING:
    from dm_control.rl.control import Environment as ControlEnvironment

    from quadrl import rendering, suite, testing
    from quadrl.deploy.export import export
    from quadrl.evaluation.check import check
    from quadrl.evaluation.evaluate import evaluate
    from quadrl.evaluation.robustness import robustness
    from quadrl.learning.run import train
    from quadrl.learning.show import plot, render
    from quadrl.learning.study import study

__all__ = [
    "RANDOMIZATIONS", "VEHICLES", "Aerodynamics", "Observing", "Policy", "Randomization", "Rotor",
    "Task", "Vehicle", "check", "envs", "evaluate", "export", "load", "plot", "register", "render",
    "rendering", "ring", "robustness", "study", "suite", "tasks", "testing", "train",
]  # fmt: skip
LAZY = {
    "train": "quadrl.learning.run",
    "evaluate": "quadrl.evaluation.evaluate",
    "render": "quadrl.learning.show",
    "plot": "quadrl.learning.show",
    "robustness": "quadrl.evaluation.robustness",
    "study": "quadrl.learning.study",
    "check": "quadrl.evaluation.check",
    "export": "quadrl.deploy.export",
}
"""Functions that are imported on first use, and their modules."""

envs.register_ids()
shield_triton()  # whoever imports triton later may have drawn before


def register(task: type[Task]) -> type[Task]:
    """Add a task to the catalogue and to every API; usable as a class decorator.

    Raises:
        QuadrlError: It is not a Task subclass with a name, another task has the name, or one of its
            settings of a training is unknown.
    """
    registered("task", task, Task, tasks.TASKS)
    check_stated(task)
    tasks.register(task)
    envs.register_ids()
    return task


def load(
    task_name: str,
    task_kwargs: dict[str, Any] | None = None,
    environment_kwargs: dict[str, Any] | None = None,
    visualize_reward: bool = False,
) -> ControlEnvironment:
    """Load a task as a dm_control environment; see `quadrl.suite.load`."""
    from quadrl import suite

    return suite.load(suite.DOMAIN, task_name, task_kwargs, environment_kwargs, visualize_reward)


def __dir__() -> list[str]:
    """List the public names, as tab completion shows them."""
    return [*__all__, "__version__"]


def __getattr__(name: str) -> Any:
    """Import on first use what brings more libraries."""
    if name in LAZY:
        with needed(f"quadrl.{name}"):
            return getattr(importlib.import_module(LAZY[name]), name)
    if name in ("suite", "rendering", "testing"):
        return importlib.import_module(f"quadrl.{name}")
    raise AttributeError(f"module 'quadrl' has no attribute {name!r}")
