"""Whether seeds of one algorithm, or with one setting, reach more than those of another.

Seeds are compared within each task, and the tasks are combined by van Elteren's test (1960), which
with one task is Mann and Whitney's. Two one-sided tests show that there is no difference that
matters, which is more than the lack of evidence for one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from quadrl.base.errors import QuadrlError
from quadrl.base.validation import choice

LEVEL = 0.05
MARGIN = 0.25
"""Distance of a chance from one half that matters: a seed of the one wins three times in four."""
DRAWS = 1000
"""Simulated experiments by which a power is estimated."""
STEEPEST = 300.0
VERDICTS = ("smaller", "larger", "no difference", "undecided")
Pair = tuple[np.ndarray, np.ndarray]
"""Figures of the seeds of two, (..., m) and (..., n)."""


class Sums(NamedTuple):
    """The statistics of one experiment, (), or of each of many."""

    chance: np.ndarray
    """Probability that a seed of the one has the smaller figure; a tie counts as half."""
    score: np.ndarray
    """Standard deviations that the chance lies above one half, if there were no difference."""
    error: np.ndarray
    """Standard error of the chance."""

    def p_values(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """P values of "smaller", "larger", and, by two one-sided tests, of "no difference"."""
        room = (MARGIN - np.abs(self.chance - 0.5)) / self.error
        return stats.norm.sf(self.score), stats.norm.sf(-self.score), stats.norm.sf(room)

    def verdict(self, level: float) -> np.ndarray:
        """Indices in `VERDICTS`; each is false with a probability of `level` at most."""
        smaller, larger, equal = self.p_values()
        return np.select([smaller < level / 2, larger < level / 2, equal < level], [0, 1, 2], 3)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A figure of the seeds of `one` compared with that of the seeds of `other`."""

    figure: str
    one: str
    other: str
    seeds: dict[str, tuple[int, int]]
    """Number of seeds of each, by task."""
    by_task: dict[str, float]
    """The chance that a seed of the one has the smaller figure; a tie counts as half."""
    chance: float
    """The same over all tasks, with van Elteren's weights."""
    low: float
    """Lower end of its 95 % interval."""
    high: float
    p_smaller: float
    """One-sided p value of the verdict "smaller"."""
    p_larger: float
    p_equal: float
    """P value of the verdict "no difference": the chance is within `MARGIN` of one half."""
    verdict: str
    """One of `VERDICTS`."""
    power_differs: float
    """How often as many seeds show a difference if the chance is `MARGIN` above one half."""
    power_equal: float
    """How often they show that there is no difference if there is none."""


def compare(
    runs: Iterable[Mapping[str, Any]], figure: str, one: str, other: str, level: float = LEVEL
) -> Comparison:
    """Compare a figure of two algorithms, or of two variants, over the tasks of a study.

    Args:
        runs: As `StudyResult.runs` has them.
        figure: One of their metrics; None is larger than any number.
        one: An algorithm, with its variant behind it where it has one: "ppo wide".
        other: Another one.
        level: Chance of a false verdict; share it among comparisons that are judged together.

    Raises:
        QuadrlError: There is no such figure, algorithm or variant, or a task has fewer than two
            seeds of it.
    """
    found: dict[str, dict[str, list[float]]] = {}
    figures: dict[str, None] = {}
    for run in runs:
        value = run["metrics"].get(figure)
        known = math.inf if value is None or math.isnan(value) else float(value)
        found.setdefault(run["task"], {}).setdefault(arm(run), []).append(known)
        figures |= dict.fromkeys(run["metrics"])
    choice("figure", figure, figures)
    for name in (one, other):
        choice("compared", name, dict.fromkeys(x for arms in found.values() for x in arms))
        for task, arms in found.items():
            if (count := len(arms.get(name, ()))) < 2:
                raise QuadrlError(name=f"seeds of {name}, {task}", value=count, allowed="2 or more")
    pairs = {task: (np.array(arms[one]), np.array(arms[other])) for task, arms in found.items()}
    whole = sums([*pairs.values()])
    half = stats.norm.ppf(0.975) * whole.error
    return Comparison(
        figure,
        one,
        other,
        {task: (len(a), len(b)) for task, (a, b) in pairs.items()},
        {task: float(sums([pair]).chance) for task, pair in pairs.items()},
        float(whole.chance),
        float(np.maximum(0.0, whole.chance - half)),
        float(np.minimum(1.0, whole.chance + half)),
        *(float(p) for p in whole.p_values()),
        verdict=VERDICTS[int(whole.verdict(level))],
        power_differs=power([*pairs.values()], 0.5 + MARGIN, level),
        power_equal=power([*pairs.values()], 0.5, level),
    )


def arm(run: Mapping[str, Any]) -> str:
    """Name the algorithm of a run, and its variant."""
    return f"{run['algo']} {run['variant']}".strip()


def sums(pairs: Sequence[Pair]) -> Sums:
    """Compute the statistics from the figures of each task."""
    terms, weights = [], []
    for one, other in pairs:
        m, n = one.shape[-1], other.shape[-1]
        both, count = np.concatenate([one, other], -1), m + n
        smaller, equal = one[..., None] < other[..., None, :], one[..., None] == other[..., None, :]
        less = smaller + 0.5 * equal  # (..., m, n)
        same = (both[..., None] == both[..., None, :]).sum(-1)
        ties = (same**2 - 1).sum(-1) / (count * (count - 1))
        spread = less.mean(-1).var(-1, ddof=1) / m + less.mean(-2).var(-1, ddof=1) / n
        without_ties = (count + 1) / (12 * m * n)
        # If nearly all seeds are equal, few of them would seem to give the chance exactly.
        error = np.maximum(spread, without_ties)
        terms.append((less.mean((-2, -1)), without_ties - ties / (12 * m * n), error))
        weights.append(m * n / (count + 1))
    share = np.array(weights) / sum(weights)
    chance, usual, error = (
        np.tensordot(by, np.array(term), 1)
        for by, term in zip((share, share**2, share**2), zip(*terms, strict=True), strict=True)
    )
    score = np.divide(chance - 0.5, np.sqrt(usual), out=np.zeros_like(chance), where=usual > 0)
    return Sums(chance, score, np.sqrt(error))


def power(pairs: Sequence[Pair], chance: float, level: float = LEVEL) -> float:
    """Estimate how often as many seeds, with as many ties, get the right verdict.

    Both are drawn from all figures of a task. Their weights fall with the rank for the one and rise
    for the other, just so steeply that a seed of the one has the smaller figure with the chance.

    Args:
        pairs: Figures of each task, (m,) and (n,).
        chance: One half, if "no difference" is right, or more, if "smaller" is.
        level: As `compare` takes it.
    """
    rng, drawn = np.random.default_rng(0), []
    for a, b in pairs:
        ranks = stats.rankdata([*a, *b])
        steepness = _steepness(ranks, chance) if chance > 0.5 and np.ptp(ranks) else 0.0
        one = rng.choice(ranks, (DRAWS, len(a)), p=_falling(ranks, steepness))
        drawn.append((one, rng.choice(ranks, (DRAWS, len(b)), p=_falling(ranks, -steepness))))
    right = VERDICTS.index("smaller" if chance > 0.5 else "no difference")
    return float((sums(drawn).verdict(level) == right).mean())


def _falling(ranks: np.ndarray, steepness: float) -> np.ndarray:
    weight = np.exp(-steepness * (ranks - ranks.mean()) / len(ranks))
    return weight / weight.sum()


def _steepness(ranks: np.ndarray, chance: float) -> Any:
    """Find the steepness at which a rank with falling weights is below one with rising ones."""
    less = (ranks[:, None] < ranks) + 0.5 * (ranks[:, None] == ranks)

    def excess(steepness: float) -> float:
        return _falling(ranks, steepness) @ less @ _falling(ranks, -steepness) - chance

    return brentq(excess, 0.0, STEEPEST)
