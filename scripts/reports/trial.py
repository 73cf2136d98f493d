"""The paper's experiment task by task, and the statistical tests that its claims need."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Iterable, Sequence
from typing import Any

from scipy import stats

from quadrl import tasks
from quadrl.task import Target
from scripts.reports.report import Result

LABELS = {"vpg": "GAE", "ppo": "PPO", "trpo": "TRPO"}
"""The algorithms, and what the paper calls them."""
OTHERS = ("ppo", "trpo")
WAYS = ("mean", "sampled")  # flown with the mean action, and with actions drawn from the policy
SOLVED = 0.95  # share of fresh episodes that succeed with the mean action, for a solved seed
LEVEL = 0.05  # of the statistical tests


@dataclasses.dataclass(frozen=True)
class Trial:
    """The part of the experiment that concerns one task."""

    task: str
    runs: dict[str, list[Result]]  # of each algorithm, its seeds
    geometric: Result  # the geometric controller in the same episodes

    def column(self, algo: str, path: str) -> list[float]:
        """A figure of each seed, such as "mean.return_mean"; NaN where it was not measured."""
        return column(self.runs[algo], path)

    def solved(self, algo: str) -> int:
        """How many seeds are solved."""
        return sum(x >= SOLVED for x in self.column(algo, "mean.success_rate"))

    def lost(self, algo: str) -> list[float]:
        """Return lost from best to final, over the way from first to the geometric controller's."""
        goal = self.geometric["mean"]["return_mean"]
        first, best, final = (self.column(algo, f"curve.{x}") for x in ("first", "best", "final"))
        ways = [max(goal - x, 1e-9) for x in first]
        return [(a - b) / way for a, b, way in zip(best, final, ways, strict=True)]

    @property
    def precision(self) -> Target:
        """What says how precisely it is flown: the first target that is no share of episodes."""
        return next(target for target in tasks.make(self.task).targets if target.unit != "%")


def trials(result: Result) -> list[Trial]:
    """The experiment, task by task."""
    named = {(task, a): [] for task in result["geometric"] for a in LABELS}
    for run in result["runs"]:
        named[run["task"], run["algo"]].append(run)
    return [Trial(t, {a: named[t, a] for a in LABELS}, g) for t, g in result["geometric"].items()]


def column(runs: Iterable[Result], path: str) -> list[float]:
    """A figure of each run, by the names on the way to it; NaN where it was not measured."""
    values = []
    for run in runs:
        value: Any = run
        for name in path.split("."):
            value = value.get(name) if value is not None else None
        values.append(math.nan if value is None else float(value))
    return values


# Tests: 1 yes, -1 the contrary, 0 neither.
def smaller(a: Sequence[float], b: Sequence[float]) -> int:
    """Whether the seeds of a are clearly smaller than those of b: Mann and Whitney, one-sided."""
    low, high = ([x for x in values if math.isfinite(x)] for values in (a, b))
    if not low or not high or len({*low, *high}) == 1:
        return 0
    sides = [stats.mannwhitneyu(low, high, alternative=side).pvalue for side in ("less", "greater")]
    return 1 if sides[0] < LEVEL else -1 if sides[1] < LEVEL else 0


def mostly(differences: Sequence[float]) -> int:
    """Whether the differences are clearly positive: the sign test."""
    signs = [x > 0 for x in differences if not math.isnan(x) and x != 0]
    for vote, hits in ((1, sum(signs)), (-1, len(signs) - sum(signs))):
        if signs and stats.binomtest(hits, len(signs), alternative="greater").pvalue < LEVEL:
            return vote
    return 0


def steadier(a: Sequence[float], b: Sequence[float]) -> int:
    """Whether a spreads clearly less than b: the F test of two variances."""
    variances = [statistics.variance(values) if len(values) > 1 else math.nan for values in (a, b)]
    for sign, (low, high) in ((1, variances), (-1, variances[::-1])):
        if high > 0 and high > low * stats.f.ppf(1 - LEVEL, len(a) - 1, len(b) - 1):
            return sign
    return 0


def consistent(trial: Trial, a: str, b: str) -> int:
    """Whether a is clearly more consistent over the seeds than b.

    It solves clearly more seeds (Fisher's exact test); or it solves no fewer and its return spreads
    clearly less.
    """
    counts = [trial.solved(algo) for algo in (a, b)]
    rows = [[n, len(trial.runs[x]) - n] for n, x in zip(counts, (a, b), strict=True)]
    for sign, side in ((1, "greater"), (-1, "less")):
        if stats.fisher_exact(rows, alternative=side)[1] < LEVEL:  # type: ignore[operator]
            return sign
    vote = steadier(*(trial.column(algo, "mean.return_mean") for algo in (a, b)))
    return vote if vote * (counts[0] - counts[1]) >= 0 else 0


def agreed(votes: Iterable[int]) -> int:
    """The vote that all cast, else 0."""
    different = set(votes)
    return different.pop() if len(different) == 1 else 0


def verdict(votes: Sequence[int]) -> str:
    """The votes of the tasks in words."""
    yes, no = votes.count(1), votes.count(-1)
    if 2 * max(yes, no) > len(votes):
        return "agrees" if yes > no else "disagrees"
    return "mixed" if yes and no else "not shown"
