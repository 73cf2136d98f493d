"""Reinforcement learning for quadrotors on MuJoCo.

    import quadrl
    environment = quadrl.load("hover")                       # dm_control
    environment = gymnasium.make("quadrl/Hover-v0")          # Gymnasium
    environment = quadrl.envs.torchrl.QuadrotorEnv("hover")  # TorchRL

Importing it registers the Gymnasium ids; dm_control, torch and rendering come when they are used.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
import sys
import warnings
from typing import TYPE_CHECKING, Any

if sys.platform == "linux" and not any(
    os.environ.get(name) for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
):
    # Without a screen mujoco would choose GLFW at its import and fail at the first picture; asked
    # for a library that is not there, it would not even be imported.
    os.environ["MUJOCO_GL"] = "disabled"
    for _backend, _library in (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8")):
        with contextlib.suppress(OSError):
            ctypes.CDLL(_library)
            os.environ["MUJOCO_GL"] = _backend
            break
    if "mujoco" in sys.modules:
        warnings.warn(
            "mujoco was imported before quadrl on a machine without a screen; to render, import "
            "quadrl first or set MUJOCO_GL=egl",
            stacklevel=2,
        )

from quadrl import envs, tasks
from quadrl.envs.gymnasium import register_ids as _register_ids
from quadrl.policy import Policy
from quadrl.task import Task
from quadrl.vehicle import VEHICLES, Vehicle

if TYPE_CHECKING:
    from dm_control.rl import control

    from quadrl import rendering, suite

__version__ = "0.1.0"
__all__ = [
    "VEHICLES",
    "Policy",
    "Task",
    "Vehicle",
    "envs",
    "load",
    "register",
    "rendering",
    "suite",
    "tasks",
]

_register_ids()


def register(task: type[Task]) -> type[Task]:
    """Add a task to the catalogue and to every door; usable as a class decorator.

    Raises:
        ValueError: Another task has the name.
    """
    tasks.register(task)
    _register_ids()
    return task


def load(
    task_name: str,
    task_kwargs: dict[str, Any] | None = None,
    environment_kwargs: dict[str, Any] | None = None,
    visualize_reward: bool = False,
) -> control.Environment:
    """Load a task the dm_control way; see `quadrl.suite.load`."""
    from quadrl import suite

    return suite.load(suite.DOMAIN, task_name, task_kwargs, environment_kwargs, visualize_reward)


def __getattr__(name: str) -> Any:
    """Import `suite` and `rendering` when they are first asked for."""
    if name in ("suite", "rendering"):
        return importlib.import_module(f"quadrl.{name}")
    raise AttributeError(f"module 'quadrl' has no attribute {name!r}")
