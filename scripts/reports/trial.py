"""The paper's experiment task by task, and how its claims are judged."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from quadrl.core.task import Target
from scripts.reports import significance
from scripts.reports.report import Result
from scripts.reports.search import LABELS, SOLVED, precision

OTHERS = ("ppo", "trpo")
WAYS = ("mean", "sampled")  # flown with the mean action, and with actions drawn from the policy
COLLAPSED = 0.2  # share of successful episodes that is lost from the best of a training to its end


@dataclasses.dataclass(frozen=True)
class Trial:
    """The part of the experiment that concerns one task."""

    task: str
    runs: dict[str, list[Result]]  # of each algorithm, its seeds
    geometric: Result  # the geometric controller in the same episodes
    level: float  # of the tests

    def column(self, algo: str, path: str) -> list[float]:
        """A figure of each seed, such as "mean.return_mean"; NaN where it was not measured."""
        return column(self.runs[algo], path)

    def solved(self, algo: str) -> list[int]:
        """Of each seed, 1 for a solved one and 0 for another."""
        return [int(x >= SOLVED) for x in self.column(algo, "mean.success_rate")]

    def lost(self, algo: str) -> list[float]:
        """Success lost in training, from the best to the end, of each seed."""
        best, final = (self.column(algo, f"curve.{x}") for x in ("best", "final"))
        return [a - b for a, b in zip(best, final, strict=True)]

    def errors(self, algo: str, way: str) -> list[float]:
        """How imprecisely each seed flies; infinitely where no flight gets so far."""
        values = self.column(algo, f"{way}.{self.precision.metric}")
        return [math.inf if math.isnan(x) else x for x in values]

    def test(self, how: Callable[..., int], *samples: Sequence[float]) -> int:
        """The vote of a test of `significance` at this trial's level."""
        return how(*samples, self.level)

    def consistent(self, a: str, b: str) -> int:
        """Whether a is clearly more consistent over the seeds than b.

        It solves clearly more seeds; or it solves no fewer and its return spreads clearly less.
        """
        solved = self.solved(a), self.solved(b)
        if vote := self.test(significance.solved_more, *solved):
            return vote
        returns = (self.column(algo, "mean.return_mean") for algo in (a, b))
        vote = self.test(significance.steadier, *returns)
        return vote if vote * (sum(solved[0]) - sum(solved[1])) >= 0 else 0

    @property
    def precision(self) -> Target:
        """What says how precisely it is flown."""
        return precision(self.task)


def trials(result: Result, level: float = significance.LEVEL) -> list[Trial]:
    """The experiment, task by task."""
    named = {(task, a): [] for task in result["geometric"] for a in LABELS}
    for run in result["runs"]:
        named[run["task"], run["algo"]].append(run)
    return [
        Trial(t, {a: named[t, a] for a in LABELS}, g, level) for t, g in result["geometric"].items()
    ]


def column(runs: Iterable[Result], path: str) -> list[float]:
    """A figure of each run, by the names on the way to it; NaN where it was not measured."""
    values = []
    for run in runs:
        value: Any = run
        for name in path.split("."):
            value = value.get(name) if value is not None else None
        values.append(math.nan if value is None else float(value))
    return values


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
