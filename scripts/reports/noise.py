"""Whether noise in training makes policies withstand wind, as the paper expects.

Hover is trained with and without noise of the state estimate, in calm air and in wind, and each
policy flies in wind with its mean action and with actions that it draws.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import tyro

from quadrl.conditions.randomization import RANDOMIZATIONS, Randomization
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly, summarize
from quadrl.learning.config import TrainConfig
from quadrl.learning.studies.crew import train_here
from quadrl.learning.studies.plan import PlannedRun
from scripts.reports import report
from scripts.reports.evaluation import NOISE_SEED
from scripts.reports.report import Result, say, table

TASK = "hover"
SEEDS = tuple(range(250, 260))  # not used for tuning
EPISODES = 500
NOISE = Randomization(noise=RANDOMIZATIONS["full"].noise)
TRAINED: dict[str, dict[str, Any]] = {
    "neither": {},
    "noise": {"randomization": NOISE},
    "wind": {"weather": "light"},
    "both": {"randomization": NOISE, "weather": "light"},
}
"""Settings of the trainings by what they have."""
ACTIONS = ("mean", "sampled")
WEATHER = "light"
DRAWS = 10_000  # of the bootstrap
QUESTIONS = (
    ("Noise in training, in calm air", ("noise", "mean"), ("neither", "mean")),
    ("Noise in training, in wind", ("both", "mean"), ("wind", "mean")),
    ("Wind in training", ("wind", "mean"), ("neither", "mean")),
    ("Sampled in place of mean action", ("neither", "sampled"), ("neither", "mean")),
    ("The same, trained with both", ("both", "sampled"), ("both", "mean")),
)
"""Each compares the first with the second."""


def plan(name: str) -> list[PlannedRun]:
    """The trainings of one kind."""
    folder = report.RUNS / "noise"
    return [
        PlannedRun(
            TrainConfig(TASK, seed=seed, num_threads=1, **TRAINED[name]), folder / f"{name}-{seed}"
        )
        for seed in SEEDS
    ]


def main(jobs: int = 2) -> None:
    """Train what is missing, fly it, write it down.

    Args:
        jobs: Trainings at the same time.
    """
    runs = {name: plan(name) for name in TRAINED}
    train_here(itertools.chain(*runs.values()), jobs, 20, say)
    found: Result = {"episodes": EPISODES, "weather": WEATHER, "seeds": SEEDS, "success": {}}
    for name, action in itertools.product(TRAINED, ACTIONS):
        policies = [Policy.load(run.folder) for run in runs[name]]
        shares = [flown(policy, action) for policy in policies]
        found["success"][f"{name}, {action}"] = shares
    report.save("noise", found)


def flown(policy: Policy, action: str) -> float:
    """Share of successful flights in wind, of an aircraft whose state is known."""
    controller: Any = policy if action == "mean" else policy.flying(EPISODES, NOISE_SEED)
    given: Any = {"weather": WEATHER, "randomization": "none", "engine": "free_flight"}
    return summarize(fly(controller, TASK, episodes=EPISODES, **given))["success_rate"]


def chance(difference: np.ndarray) -> float:
    """How often the mean is as far from zero with any signs: an exact permutation test of pairs.

    Args:
        difference: Of the two policies of each seed, (n,).
    """
    signs = np.array([*itertools.product((-1, 1), repeat=len(difference))])
    means = np.abs((signs * difference).mean(axis=1))
    return float((means >= abs(difference.mean()) - 1e-12).mean())


def interval(difference: np.ndarray) -> Any:
    """The 95 % interval of the mean (bootstrap over the seeds)."""
    drawn = np.random.default_rng(0).choice(difference, (DRAWS, len(difference)))
    return np.quantile(drawn.mean(axis=1), (0.025, 0.975))


def shares() -> str:
    """Success in wind by training and action."""
    result = report.load("noise")
    rows = []
    for name in TRAINED:
        cells = []
        for action in ACTIONS:
            each = 100 * np.array(result["success"][f"{name}, {action}"])
            cells.append(f"{each.mean():.1f} ({each.min():.1f} to {each.max():.1f})")
        rows.append((name, *cells))
    head = ("trained with", "mean action", "sampled action")
    note = (
        f"Successful flights [%] of hover in the weather {result['weather']}: mean of "
        f"{len(result['seeds'])} seeds, worst and best seed; {result['episodes']} flights each."
    )
    return f"{table(head, rows)}\n\n{note} {report.source(result)}"


def verdicts() -> str:
    """What each question's answer is, corrected for their number (Holm)."""
    result = report.load("noise")
    rows = []
    for question, *pair in QUESTIONS:
        one, other = (100 * np.array(result["success"][", ".join(which)]) for which in pair)
        mean, (low, high) = (one - other).mean(), interval(one - other)
        words = f"{mean:+.1f} ({low:+.1f} to {high:+.1f})"
        rows.append((question, words, chance(one - other), mean))
    order = sorted(range(len(rows)), key=lambda k: rows[k][2])
    worst, corrected = 0.0, {}
    for rank, k in enumerate(order):
        worst = max(worst, min(1.0, (len(rows) - rank) * rows[k][2]))
        corrected[k] = worst
    lines = []
    for k, (question, words, _, difference) in enumerate(rows):
        clear = "more" if difference > 0 else "less"
        verdict = clear if corrected[k] < 0.05 else "no difference that these seeds show"
        lines.append((question, words, f"{corrected[k]:.4f}", verdict))
    head = ("compared", "difference in success [points], 95 % interval", "p (Holm)", "success")
    return table(head, lines)


PARTS: report.Parts = {"noise-shares": shares, "noise-verdicts": verdicts}

if __name__ == "__main__":
    tyro.cli(main)
