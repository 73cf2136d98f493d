"""What section 5 of the paper says, sentence by sentence, held against what was measured."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Sequence

from scripts.reports.evaluation import ROUGHNESS
from scripts.reports.report import Result, number, spread, table
from scripts.reports.trial import (
    LABELS,
    OTHERS,
    SOLVED,
    WAYS,
    Trial,
    agreed,
    column,
    consistent,
    mostly,
    smaller,
    steadier,
    trials,
    verdict,
)

COLLAPSED = 0.2  # loss from the best to the final return, over the way to the geometric controller

Vote = Callable[[Trial], tuple[int, str]]
CLAIMS: list[tuple[str, Vote]] = []
"""What the paper says, in our words; the vote, whose docstring says when a task counts as a yes."""


def claim(sentence: str) -> Callable[[Vote], Vote]:
    """Add a vote on a sentence to `CLAIMS`."""

    def add(vote: Vote) -> Vote:
        CLAIMS.append((sentence, vote))
        return vote

    return add


@claim("Overall, PPO and TRPO perform more consistently than GAE.")
def more_consistent(trial: Trial) -> tuple[int, str]:
    """Each solves clearly more seeds than GAE, or no fewer and its return spreads clearly less."""
    return agreed(consistent(trial, algo, "vpg") for algo in OTHERS), seeds(trial)


@claim("A policy whose actions are sampled does not reach a modern controller.")
def below_modern(trial: Trial) -> tuple[int, str]:
    """Sampled, it is less precise than the geometric controller in the same episodes."""
    target = trial.precision
    (yardstick,) = column([trial.geometric], f"mean.{target.metric}")
    values = {algo: trial.column(algo, f"sampled.{target.metric}") for algo in LABELS}
    # A policy that never landed has no touchdown: it counts as worse than any.
    worse = [(math.inf if math.isnan(x) else x) - yardstick for v in values.values() for x in v]
    texts = {algo: spread(x, digits=2) for algo, x in values.items()}
    return mostly(worse), f"{listed(texts)}, geometric {number(yardstick, 2)} ({target.metric})"


@claim("Sampling always leaves a small wobble.")
def wobble(trial: Trial) -> tuple[int, str]:
    """Body rate less its mean, last 2 s of successful flights: sampled above mean, seed by seed."""
    return sampled_above_mean(trial, "wobble_rad_s")


@claim("Stochastic policies should be robust to disturbances such as wind.")
def sturdier(trial: Trial) -> tuple[int, str]:
    """In wind, sampled actions lose less success than the mean action, solved seed by seed."""
    differences, texts = [], {}
    for algo, runs in trial.runs.items():
        solved = [run for run in runs if run["mean"]["success_rate"] >= SOLVED]
        mean, sampled = (
            [
                run[way]["success_rate"]
                - statistics.mean(level[way]["success_rate"] for level in run["windy"])
                for run in solved
            ]
            for way in WAYS
        )
        differences += [m - s for m, s in zip(mean, sampled, strict=True)]
        texts[algo] = f"{middle(mean, 100)} points lost mean, {middle(sampled, 100)} sampled"
    return mostly(differences), listed(texts)


@claim("The mean action flies more smoothly than sampled ones.")
def calmer(trial: Trial) -> tuple[int, str]:
    """Change of the actions per second in successful flights: sampled above mean, seed by seed."""
    return sampled_above_mean(trial, "action_variation_1_s")


@claim("Most of the goals can be learned.")
def learned(trial: Trial) -> tuple[int, str]:
    """An algorithm solves the task with more than half of the seeds."""
    return solved_by(trial, LABELS)


@claim("PPO is the most consistent of the three.")
def ppo_first(trial: Trial) -> tuple[int, str]:
    """As in the first row, against GAE and TRPO; no: one of them is clearly more consistent."""
    votes = [consistent(trial, "ppo", algo) for algo in ("vpg", "trpo")]
    return (-1 if -1 in votes else min(votes)), seeds(trial)


@claim("TRPO learns to fly more smoothly than PPO.")
def trpo_smoother(trial: Trial) -> tuple[int, str]:
    """Mean action, successful flights: clearly lower in most of four figures, higher in none."""
    votes, texts = [], []
    for name in ROUGHNESS:
        trpo, ppo = (trial.column(algo, f"mean.smoothness.{name}") for algo in ("trpo", "ppo"))
        votes.append(smaller(trpo, ppo))
        texts.append(f"{name} {middle(trpo)} against {middle(ppo)}")
    vote = {"agrees": 1, "disagrees": -1}.get(verdict(votes), 0)
    return (vote if -vote not in votes else 0), ", ".join(texts)


@claim("The reason may be that PPO's optimiser, Adam, finds sharper minima.")
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
    return smaller(losses["trpo"], losses["ppo"]), f"return lost: {listed(texts)}"


@claim("GAE learns most of the tasks.")
def gae_learns(trial: Trial) -> tuple[int, str]:
    """GAE solves the task with more than half of the seeds."""
    return solved_by(trial, ["vpg"])


@claim("GAE's performance varies more than that of the others.")
def gae_varies(trial: Trial) -> tuple[int, str]:
    """Its return spreads clearly more over the seeds than PPO's, and than TRPO's."""
    returns = {algo: trial.column(algo, "mean.return_mean") for algo in LABELS}
    return agreed(steadier(returns[algo], returns["vpg"]) for algo in OTHERS), seeds(trial)


@claim("GAE is prone to collapse during training.")
def gae_collapses(trial: Trial) -> tuple[int, str]:
    """From its best to its final return it loses clearly more than PPO, and than TRPO.

    Collapsed: more than 20 % of the way from the first return to the geometric controller's.
    """
    losses = {algo: trial.lost(algo) for algo in LABELS}
    texts = {
        algo: f"{spread(shares, '%', 100, 2)} lost, "
        f"{sum(x > COLLAPSED for x in shares)}/{len(shares)} collapsed"
        for algo, shares in losses.items()
    }
    return agreed(smaller(losses[algo], losses["vpg"]) for algo in OTHERS), listed(texts)


@claim("GAE may be less suited to flight control.")
def gae_worse(trial: Trial) -> tuple[int, str]:
    """Its return is clearly lower than PPO's, and than TRPO's."""
    returns = {algo: trial.column(algo, "mean.return_mean") for algo in LABELS}
    texts = {algo: spread(values) for algo, values in returns.items()}
    return agreed(smaller(returns["vpg"], returns[algo]) for algo in OTHERS), listed(texts)


def solved_by(trial: Trial, algorithms: Iterable[str]) -> tuple[int, str]:
    """Whether one of the algorithms solves the task with most seeds; the contrary: none does."""
    done = any(2 * trial.solved(algo) > len(trial.runs[algo]) for algo in algorithms)
    return (1 if done else -1), seeds(trial, algorithms)


def sampled_above_mean(trial: Trial, name: str) -> tuple[int, str]:
    """Whether a figure of the smoothness is larger with sampled actions than with the mean one."""
    differences, texts = [], {}
    for algo in LABELS:
        mean, sampled = (trial.column(algo, f"{way}.smoothness.{name}") for way in WAYS)
        differences += [s - m for s, m in zip(sampled, mean, strict=True)]
        texts[algo] = f"{middle(mean)} mean, {middle(sampled)} sampled"
    return mostly(differences), listed(texts)


def listed(texts: dict[str, str]) -> str:
    """A text for each algorithm."""
    return ", ".join(f"{LABELS[algo]} {text}" for algo, text in texts.items())


def seeds(trial: Trial, algorithms: Iterable[str] = LABELS) -> str:
    """Solved seeds and spread of the return, in words."""
    texts = {}
    for algo in algorithms:
        returns = trial.column(algo, "mean.return_mean")
        deviation = number(statistics.stdev(returns)) if len(returns) > 1 else "unknown"
        texts[algo] = f"{trial.solved(algo)}/{len(returns)} (spread {deviation})"
    return listed(texts)


def middle(values: Sequence[float], scale: float = 1.0) -> str:
    """The median of the seeds in two digits."""
    known = [scale * x for x in values if math.isfinite(x)]
    return number(statistics.median(known), 2) if known else "none"


def judged(result: Result) -> str:
    """A table of the sentences, with the verdicts and the numbers behind them."""
    rows = []
    for sentence, vote in CLAIMS:
        votes = {trial.task: vote(trial) for trial in trials(result)}
        said = "; ".join(f"{task}: {text}" for task, (_, text) in votes.items())
        rule = " ".join((vote.__doc__ or "").split())
        agreement = verdict([yes for yes, _ in votes.values()])
        rows.append((sentence, f"**{agreement}**", rule, said))
    return table(("sentence, in our words", "measured", "a task says yes when", "numbers"), rows)
