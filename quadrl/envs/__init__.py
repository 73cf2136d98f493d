"""The APIs, thin layers over the core: dm_control, Gymnasium, rsl_rl, SB3 and TorchRL."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from quadrl.envs.common import LAST
from quadrl.tasks import TASKS

if TYPE_CHECKING:
    from quadrl.envs import dm_control, gymnasium, rsl_rl, sb3, torchrl

__all__ = ["dm_control", "gymnasium", "register_ids", "rsl_rl", "sb3", "torchrl"]


def register_ids() -> None:
    """Register every task of the catalogue as quadrl/<CamelCase>-vN (idempotent)."""
    for name, task in TASKS.items():
        if (id := task.gymnasium_id()) not in gym.registry:
            gym.register(
                id=id,
                entry_point="quadrl.envs.gymnasium:make_one",
                vector_entry_point="quadrl.envs.gymnasium:QuadrotorVectorEnv",
                kwargs={"task": name},
                additional_wrappers=LAST,
                # The environment itself refuses a step before a reset and a bad action, and the
                # tests run Gymnasium's checks: the two wrappers would only cost time.
                order_enforce=False,
                disable_env_checker=True,
            )


def __getattr__(name: str) -> Any:
    """Import an API when it is first asked for: each brings a library of its own."""
    if name in __all__:
        return importlib.import_module(f"quadrl.envs.{name}")
    raise AttributeError(f"module 'quadrl.envs' has no attribute {name!r}")
