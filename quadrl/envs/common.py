"""What the APIs share: an environment from one set of keywords, and entries of `info`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Unpack

import numpy as np
from gymnasium.envs.registration import WrapperSpec

from quadrl.core.environment import Environment
from quadrl.core.scenario import Conditions, Scenario
from quadrl.core.task import Task

OWN = ("num_threads", "seed", "reward_terms")
"""Keywords of every API beside those of a scenario."""
PICTURE = ("width", "height", "camera")
"""Keywords of the pictures that an API draws."""


def make(
    task: str | Task | Scenario,
    num_envs: int,
    also: Iterable[str] = (),
    *,
    seed: int | None = None,
    num_threads: int = 0,
    **conditions: Unpack[Conditions],
) -> Environment:
    """Make an environment.

    Args:
        task: A name of the catalogue, a task, or a whole scenario.
        num_envs: Number of aircraft, N.
        also: Keywords that the API takes itself.
        seed: Row i is seeded with seed + i; None for one from the system.
        num_threads: Threads of the simulation; 0 for every core.
        **conditions: `vehicle`, `weather`, `randomization` and the others, as
            `quadrl.core.scenario.Conditions` has them, and options of the task.

    Raises:
        QuadrlError: Unknown name or impossible value.
    """
    scenario = Scenario.of(task, [*OWN, *also], **conditions)
    return Environment(scenario, num_envs=num_envs, seed=seed, num_threads=num_threads)


class ForOne(tuple[WrapperSpec, ...]):
    """Wrappers that `gym.make` applies last; to `make_vec`, which refuses any, it is empty."""

    def __len__(self) -> int:
        return 0

    def __ne__(self, other: object) -> bool:
        return other != ()


LAST = ForOne([WrapperSpec("TaskLimit", "quadrl.envs.gymnasium:limited", {})])


class Changing:
    """An API whose environment may be changed: by `change`, or by assigning to an option."""

    environment: Environment

    def change(self, **conditions: Any) -> None:
        """Change options before the next reset, as `quadrl.core.environment.Environment.change`."""
        self.environment.change(**conditions)

    def __setattr__(self, name: str, value: Any) -> None:
        """Change an option: as an attribute alone it would do nothing."""
        own: Environment | None = vars(self).get("environment")
        if own is not None and name[0] != "_" and name in own.options:
            self.change(**{name: value})
        else:
            super().__setattr__(name, value)


def episode_info(environment: Environment) -> dict[str, np.ndarray]:
    """Entries of `info` that last for an episode, arrays (N, k); by default there are none.

    Returns:
        drawn: what was drawn for each aircraft, with names; privileged: for the critic alone.
    """
    values: dict[str, np.ndarray] = {}
    if environment.randomizer.active and (shown := environment.randomizer.shown()):
        values["drawn"] = Named(shown)
    if (privileged := environment.privileged) is not None:
        values["privileged"] = privileged.astype(np.float32)
    return values


class Named(np.ndarray):
    """Numbers (k,) or (N, k) in an array whose last axis has names, such as terms of a reward.

    `terms["progress"]` and `terms.items()` work as in a dict; clients that read numbers alone, as
    TorchRL's, see the array.
    """

    names: tuple[str, ...]

    def __new__(cls, terms: Mapping[str, np.ndarray]) -> Named:
        """Stack numbers, each () or (N,)."""
        stacked = np.array([*terms.values()]).T.view(cls)  # a quarter of the time of `stack`
        stacked.names = tuple(terms)
        return stacked

    def __array_finalize__(self, other: Any) -> None:
        self.names = getattr(other, "names", ())

    def __reduce__(self) -> Any:
        return Named, (dict(self.items()),)

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, str):
            if key not in self.names:
                raise KeyError(f"{key}; the names are {', '.join(self.names)}")
            return self.view(np.ndarray)[..., self.names.index(key)]
        return super().__getitem__(key)

    def keys(self) -> tuple[str, ...]:
        """The names."""
        return self.names

    def values(self) -> list[np.ndarray]:
        """The numbers."""
        return [self[name] for name in self.names]

    def items(self) -> list[tuple[str, np.ndarray]]:
        """Names and numbers."""
        return list(zip(self.names, self.values(), strict=True))
