"""Statistical tests of a few seeds, each with its power, and intervals of what they reached.

After Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice":
interquartile means and probabilities of improvement with bootstrap intervals.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy import stats
from scipy.optimize import brentq

LEVEL = 0.05
"""Chance that any of the sentences that are judged together gets a false verdict."""
CONFIDENCE = 0.95
DRAWS = 1000  # of bootstraps, and of experiments by which a power is estimated
TRIM = 0.25  # on each side of an interquartile mean
# What the power is given for. Where the effect is smaller, it is smaller as well.
SHIFT = 0.9  # chance that a seed of one is below a seed of the other
RATIO = 3.0  # of two spreads
SHARE = 0.8  # of pairs that differ in the same direction
SOLVING = (0.95, 0.5)  # chances that a seed is solved


def level_of(sentences: int, tasks: int) -> float:
    """The one-sided level of the test of one task.

    A sentence gets a verdict when more than half of the tasks say the same. Their trainings are
    independent, so that many err together less often than one; what remains is corrected for the
    number of sentences (Bonferroni).

    Args:
        sentences: That are judged together.
        tasks: By which each of them is judged.
    """

    def excess(level: float) -> float:
        return 2 * float(stats.binom.sf(tasks // 2, tasks, level)) - LEVEL / sentences

    return float(brentq(excess, 0.0, 0.5))


# Tests: 1 yes, -1 the contrary, 0 neither.
def smaller(a: Sequence[float], b: Sequence[float], level: float) -> int:
    """Whether the seeds of a are clearly smaller than those of b: Mann and Whitney, one-sided."""
    low, high = ([x for x in values if not math.isnan(x)] for values in (a, b))
    if not low or not high or len({*low, *high}) == 1:
        return 0
    sides = [stats.mannwhitneyu(low, high, alternative=side).pvalue for side in ("less", "greater")]
    return 1 if sides[0] < level else -1 if sides[1] < level else 0


def mostly(differences: Sequence[float], level: float) -> int:
    """Whether the differences are clearly positive: the sign test."""
    signs = [x > 0 for x in differences if not math.isnan(x) and x != 0]
    for vote, hits in ((1, sum(signs)), (-1, len(signs) - sum(signs))):
        if signs and stats.binomtest(hits, len(signs), alternative="greater").pvalue < level:
            return vote
    return 0


def steadier(a: Sequence[float], b: Sequence[float], level: float) -> int:
    """Whether a spreads clearly less than b: Brown and Forsythe's test.

    It needs no normal distribution, as the F test of two variances does.
    """
    away = [np.abs(np.subtract(x, np.median(x))) for x in (a, b)]
    means = [x.mean() for x in away]
    if means[0] == means[1] or not any(np.ptp(x) > 0 for x in away):
        return 0
    both_sides = stats.levene(a, b, center="median").pvalue
    return (1 if means[0] < means[1] else -1) if both_sides / 2 < level else 0


def solved_more(a: Sequence[float], b: Sequence[float], level: float) -> int:
    """Whether a (1 for a solved seed, 0 for another) has clearly more than b: Fisher's test."""
    counts = [[sum(x), len(x) - sum(x)] for x in (a, b)]
    for vote, side in ((1, "greater"), (-1, "less")):
        if stats.fisher_exact(counts, alternative=side)[1] < level:  # type: ignore[operator]
            return vote
    return 0


def _shifted(n: int, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    way = math.sqrt(2) * stats.norm.ppf(SHIFT)
    return draw.standard_normal(n), draw.standard_normal(n) + way


def _wider(n: int, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return draw.standard_normal(n), RATIO * draw.standard_normal(n)


def _solved(n: int, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    often, seldom = (draw.random(n) < share for share in SOLVING)
    return often.astype(int), seldom.astype(int)


def _signs(n: int, draw: np.random.Generator) -> tuple[np.ndarray]:
    return (np.where(draw.random(n) < SHARE, 1.0, -1.0),)


EFFECTS = {
    smaller: (_shifted, f"a seed of one is below a seed of the other in {100 * SHIFT:g} %"),
    steadier: (_wider, f"one spreads {RATIO:g} times as much as the other"),
    solved_more: (
        _solved,
        f"one solves {100 * SOLVING[0]:g} % of its seeds, the other {100 * SOLVING[1]:g} %",
    ),
    mostly: (_signs, f"{100 * SHARE:g} % of the seeds differ in the same direction"),
}
"""How a difference that matters is drawn, and in words."""


@functools.cache
def power(test: Callable[..., int], seeds: int, level: float) -> float:
    """How often a test says yes where there is the difference of `EFFECTS`.

    Args:
        test: One of those above.
        seeds: Of each of the two; for the sign test, all differences.
        level: As the test takes it.
    """
    draw = np.random.default_rng(0)
    found = [test(*EFFECTS[test][0](seeds, draw), level) == 1 for _ in range(DRAWS)]
    return float(np.mean(found))


def middle(values: Sequence[float]) -> float:
    """The interquartile mean; infinite values count as the worst."""
    kept = stats.trimboth(np.sort(values), TRIM)
    return float(kept.mean())


def middle_interval(values: Sequence[float]) -> tuple[float, float]:
    """The 95 % interval of the interquartile mean: bootstrap over the seeds."""
    drawn = np.random.default_rng(0).choice(np.asarray(values, float), (DRAWS, len(values)))
    return _between([middle(x) for x in drawn])


def improvement(a: Sequence[float], b: Sequence[float]) -> float:
    """The chance that a seed of a is above a seed of b; a tie counts as half."""
    one, other = np.asarray(a, float)[:, None], np.asarray(b, float)
    return float(((one > other) + 0.5 * (one == other)).mean())


def improvement_interval(a: Sequence[float], b: Sequence[float]) -> tuple[float, float]:
    """The 95 % interval of the chance of an improvement: bootstrap over the seeds of each."""
    draw = np.random.default_rng(0)
    pairs = ((draw.choice(a, len(a)), draw.choice(b, len(b))) for _ in range(DRAWS))
    return _between([improvement(*pair) for pair in pairs])


def _between(values: Sequence[float]) -> tuple[float, float]:
    low, high = np.quantile(values, ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2), method="nearest")
    return float(low), float(high)
