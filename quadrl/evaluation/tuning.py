"""Tune a controller by random search, so that a policy is compared with the best of many."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from quadrl.evaluation.in_flight import Controller

Settings = dict[str, float]
"""Numbers of a controller by name."""


class Tuned(NamedTuple):
    """The best settings that were found."""

    settings: Settings
    score: tuple[float, ...]
    """What `judge` said of a controller with them."""


def tuned(
    make: Callable[[Settings], Controller],
    between: Mapping[str, tuple[float, float]],
    judge: Callable[[Controller], tuple[float, ...]],
    *,
    tries: int,
    usual: Mapping[str, float] | None = None,
    seed: int = 0,
) -> Tuned:
    """Draw settings evenly in logarithms, and keep those with the highest score.

    Judge in other episodes than those that the controller is then compared in.

    Args:
        make: Makes a controller from settings.
        between: Lowest and highest value of each setting.
        judge: Gives a score; of equal ones the first counts, and no number is the lowest.
        tries: How many settings are judged.
        usual: Settings that are judged first, in place of the first that are drawn.
        seed: Of the draws.
    """
    low, high = np.log(np.maximum([*between.values()], 0.01)).T
    drawn, found = np.random.default_rng(seed), list[Tuned]()
    for k in range(tries):
        values = np.exp(drawn.uniform(low, high)).tolist()
        settings = dict(usual) if usual and k == 0 else dict(zip(between, values, strict=True))
        score = tuple(x if x == x else -np.inf for x in judge(make(settings)))
        found.append(Tuned(settings, score))
    return max(found, key=lambda each: each.score)
