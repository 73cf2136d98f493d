"""What section 5 of the paper says, sentence by sentence, held against what was measured."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from scipy import stats

from scripts.reports import noise, report
from scripts.reports.evaluation import ROUGHNESS
from scripts.reports.report import Result, number, spread, table
from scripts.reports.significance import level_of, mostly, smaller, solved_more, steadier
from scripts.reports.trial import (
    COLLAPSED,
    LABELS,
    OTHERS,
    WAYS,
    Trial,
    agreed,
    column,
    trials,
    verdict,
)

Vote = Callable[[Trial], tuple[int, str] | None]


@dataclasses.dataclass(frozen=True)
class Claim:
    """A sentence, and how it is judged."""

    sentence: str
    """What the paper says, in our words."""
    vote: Vote
    """1, -1 or 0 of a task and its numbers; None where the sentence is not asked. The docstring
    says when a task counts as a yes."""
    test: Callable[..., int] | None
    """The test that decides."""
    together: int
    """How many comparisons must say yes for that of a task."""


CLAIMS: list[Claim] = []


def claim(
    sentence: str, test: Callable[..., int] | None = None, together: int = 1
) -> Callable[[Vote], Vote]:
    """Add a vote on a sentence to `CLAIMS`."""

    def add(vote: Vote) -> Vote:
        CLAIMS.append(Claim(sentence, vote, test, together))
        return vote

    return add


@claim("Overall, PPO and TRPO perform more consistently than GAE.", solved_more, 2)
def more_consistent(trial: Trial) -> tuple[int, str]:
    """Each solves clearly more seeds than GAE, or no fewer and its return spreads clearly less."""
    return agreed(trial.consistent(algo, "vpg") for algo in OTHERS), seeds(trial)


@claim("A policy whose actions are sampled does not reach a modern controller.", mostly)
def below_modern(trial: Trial) -> tuple[int, str]:
    """Sampled, it is less precise than the geometric controller in the same episodes."""
    target = trial.precision
    (yardstick,) = column([trial.geometric], f"mean.{target.metric}")
    values = {algo: trial.errors(algo, "sampled") for algo in LABELS}
    worse = [x - yardstick for each in values.values() for x in each]
    texts = {algo: spread(x, digits=2) for algo, x in values.items()}
    return trial.test(
        mostly, worse
    ), f"{listed(texts)}, geometric {number(yardstick, 2)} ({target.metric})"


@claim("Sampling always leaves a small wobble.", mostly)
def wobble(trial: Trial) -> tuple[int, str]:
    """Body rate less its mean, last 2 s of successful flights: sampled above mean, seed by seed."""
    return sampled_above_mean(trial, "wobble_rad_s")


@claim("Stochastic policies should be robust to disturbances such as wind.")
def sturdier(trial: Trial) -> tuple[int, str] | None:
    """Trained with noise, they succeed clearly more often in wind than trained without.

    An exact permutation test of the seeds, of hover alone; the paper's policies became stochastic
    by training, so that drawing actions from a policy in flight is another question.
    """
    if trial.task != noise.TASK:
        return None
    found = report.load("noise")["success"]
    with_it, without = (100 * np.array(found[f"{name}, mean"]) for name in ("noise", "neither"))
    difference = with_it - without
    clear = noise.chance(difference) / 2 < level_of(len(CLAIMS), tasks=1)
    low, high = noise.interval(difference)
    text = f"{without.mean():.1f} % without, {with_it.mean():.1f} % with noise"
    text += f" (difference {difference.mean():+.1f} points, {low:+.1f} to {high:+.1f})"
    return int(clear) * int(np.sign(difference.mean())), text


@claim("The mean action flies more smoothly than sampled ones.", mostly)
def calmer(trial: Trial) -> tuple[int, str]:
    """Change of the actions per second in successful flights: sampled above mean, seed by seed."""
    return sampled_above_mean(trial, "action_variation_1_s")


@claim("Most of the goals can be learned.", mostly)
def learned(trial: Trial) -> tuple[int, str]:
    """An algorithm solves clearly more than half of the seeds; no: each clearly fewer."""
    return solved_by(trial, LABELS)


@claim("PPO is the most consistent of the three.", solved_more, 2)
def ppo_first(trial: Trial) -> tuple[int, str]:
    """As in the first row, against GAE and TRPO; no: one of them is clearly more consistent."""
    votes = [trial.consistent("ppo", algo) for algo in ("vpg", "trpo")]
    return (-1 if -1 in votes else min(votes)), seeds(trial)


@claim("TRPO learns to fly more smoothly than PPO.", smaller)
def trpo_smoother(trial: Trial) -> tuple[int, str]:
    """Mean action, successful flights: clearly lower in most of four figures, higher in none."""
    votes, texts = [], []
    for name in ROUGHNESS:
        trpo, ppo = (trial.column(algo, f"mean.smoothness.{name}") for algo in ("trpo", "ppo"))
        votes.append(trial.test(smaller, trpo, ppo))
        texts.append(f"{name} {middle(trpo)} against {middle(ppo)}")
    vote = {"agrees": 1, "disagrees": -1}.get(verdict(votes), 0)
    return (vote if -vote not in votes else 0), ", ".join(texts)


@claim("The reason may be that PPO's optimiser, Adam, finds sharper minima.", smaller)
def ppo_sharper(trial: Trial) -> tuple[int, str]:
    """With noise of 20 % on each neuron's weights PPO loses clearly more return than TRPO.

    This would not show that sharp minima cause the roughness.
    """
    losses = {}
    for algo in ("ppo", "trpo"):
        paths = ("mean.return_mean", "return_noisy_weights")
        flown, noisy = (trial.column(algo, path) for path in paths)
        losses[algo] = [a - b for a, b in zip(flown, noisy, strict=True)]
    texts = {algo: spread(values, digits=2) for algo, values in losses.items()}
    return trial.test(smaller, losses["trpo"], losses["ppo"]), f"return lost: {listed(texts)}"


@claim("GAE learns most of the tasks.", mostly)
def gae_learns(trial: Trial) -> tuple[int, str]:
    """GAE solves clearly more than half of the seeds."""
    return solved_by(trial, ["vpg"])


@claim("GAE's performance varies more than that of the others.", steadier, 2)
def gae_varies(trial: Trial) -> tuple[int, str]:
    """Its return spreads clearly more over the seeds than PPO's, and than TRPO's."""
    returns = {algo: trial.column(algo, "mean.return_mean") for algo in LABELS}
    votes = (trial.test(steadier, returns[algo], returns["vpg"]) for algo in OTHERS)
    return agreed(votes), seeds(trial)


@claim("GAE is prone to collapse during training.", smaller, 2)
def gae_collapses(trial: Trial) -> tuple[int, str]:
    """From the best of its training to the end it loses clearly more success than PPO and TRPO."""
    losses = {algo: trial.lost(algo) for algo in LABELS}
    texts = {
        algo: f"{spread(shares, 'points', 100, 2)} lost, "
        f"{sum(x > COLLAPSED for x in shares)}/{len(shares)} collapsed"
        for algo, shares in losses.items()
    }
    votes = (trial.test(smaller, losses[algo], losses["vpg"]) for algo in OTHERS)
    return agreed(votes), listed(texts)


@claim("GAE may be less suited to flight control.", smaller, 2)
def gae_worse(trial: Trial) -> tuple[int, str]:
    """It succeeds clearly less often than PPO, and than TRPO."""
    shares = {algo: trial.column(algo, "mean.success_rate") for algo in LABELS}
    texts = {algo: spread(values, "%", 100) for algo, values in shares.items()}
    votes = (trial.test(smaller, shares["vpg"], shares[algo]) for algo in OTHERS)
    return agreed(votes), listed(texts)


def solved_by(trial: Trial, algorithms: Iterable[str]) -> tuple[int, str]:
    """Whether one of the algorithms solves clearly more than half of the seeds."""
    votes = [
        trial.test(mostly, [2 * solved - 1 for solved in trial.solved(algo)]) for algo in algorithms
    ]
    return max(votes), seeds(trial, algorithms)


def sampled_above_mean(trial: Trial, name: str) -> tuple[int, str]:
    """Whether a figure of the smoothness is larger with sampled actions than with the mean one."""
    differences, texts = [], {}
    for algo in LABELS:
        mean, sampled = (trial.column(algo, f"{way}.smoothness.{name}") for way in WAYS)
        differences += [s - m for s, m in zip(sampled, mean, strict=True)]
        texts[algo] = f"{middle(mean)} mean, {middle(sampled)} sampled"
    return trial.test(mostly, differences), listed(texts)


def listed(texts: dict[str, str]) -> str:
    """A text for each algorithm."""
    return ", ".join(f"{LABELS[algo]} {text}" for algo, text in texts.items())


def seeds(trial: Trial, algorithms: Iterable[str] = LABELS) -> str:
    """Solved seeds and spread of the return, in words."""
    texts = {}
    for algo in algorithms:
        returns = trial.column(algo, "mean.return_mean")
        deviation = number(statistics.stdev(returns)) if len(returns) > 1 else "unknown"
        texts[algo] = f"{sum(trial.solved(algo))}/{len(returns)} (spread {deviation})"
    return listed(texts)


def middle(values: Sequence[float], scale: float = 1.0) -> str:
    """The median of the seeds in two digits."""
    known = [scale * x for x in values if math.isfinite(x)]
    return number(statistics.median(known), 2) if known else "none"


def judged(result: Result) -> str:
    """A table of the sentences, with the verdicts and the numbers behind them."""
    rows = []
    level = level_of(len(CLAIMS), tasks=len(result["geometric"]))
    for each in CLAIMS:
        found = {trial.task: each.vote(trial) for trial in trials(result, level)}
        votes = {task: vote for task, vote in found.items() if vote is not None}
        said = "; ".join(f"{task}: {text}" for task, (_, text) in votes.items())
        rule = " ".join((each.vote.__doc__ or "").split())
        agreement = verdict([yes for yes, _ in votes.values()])
        words = f"**{agreement}**"
        if agreement == "not shown" and each.test:
            words += f" (power {power_of(each, result):.2f})"
        rows.append((each.sentence, words, rule, said))
    return table(("sentence, in our words", "measured", "a task says yes when", "numbers"), rows)


def power_of(each: Claim, result: Result) -> float:
    """How often most tasks say yes where all of them have the difference of the test."""
    assert each.test
    task = result["power"][each.test.__name__] ** each.together
    tasks = len(result["geometric"])
    return float(stats.binom.sf(tasks // 2, tasks, task))
