"""What the policy of a training reaches along the way: evaluations.csv in the folder of a run."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quadrl.base.files import write_csv
from quadrl.base.progress import Progress
from quadrl.evaluation.evaluate import evaluate
from quadrl.learning.folder import EVALUATIONS, read_metrics

if TYPE_CHECKING:
    from quadrl.learning.train import Training

EPISODES = 50
SOLVED = 0.95
COLUMNS = {
    "success": "success_rate",
    "survival": "survival_rate",
    "error": "position_error_m",
    "return": "return_mean",
}
"""The columns beside steps and seconds, as metrics.csv has them, and figures of an evaluation."""


def evaluating(training: Training, show: Callable[[Progress], None]) -> Callable[[Progress], None]:
    """Evaluate the policy of the moment as often as the settings say; then `show` the progress.

    A success is that of the mean action in episodes of their own. metrics.csv has that of sampled
    actions in episodes that began up to two time limits of every aircraft ago.
    """
    config, file = training.config, training.folder / EVALUATIONS
    times = range(1, config.evaluations + 1)
    due = {max(1, round(time * config.iterations / config.evaluations)) for time in times}
    rows: list[Sequence[Any]] = []
    if file.exists():  # a row after the checkpoint is made again
        with open(file, newline="") as opened:
            rows += [row for row in [*csv.reader(opened)][1:] if int(row[0]) <= training.steps]

    def after(progress: Progress) -> None:
        if progress.iteration in due:
            policy = training.policy()
            found = evaluate(policy, config.scenario, episodes=EPISODES, engine="free_flight")
            reached = (found.metrics[of] for of in COLUMNS.values())
            rows.append([progress.steps, round(progress.seconds, 3), *reached])
            write_csv(file, ("steps", "seconds", *COLUMNS), rows)
        show(progress)

    return after


def along(folder: Path) -> dict[str, float | None]:
    """Figures without a ceiling of a run that was evaluated along the way; none of another.

    Returns:
        solved_after_steps: control steps after which its success stays at 95 % or above, None
        where it ends below; success_area: its mean over the training; success_lost: the largest
        of it less the last.
    """
    if not (folder / EVALUATIONS).exists():
        return {}
    curve = read_metrics(folder / EVALUATIONS)
    success, (below,) = curve["success"], np.nonzero(curve["success"] < SOLVED)
    after = curve["steps"][below[-1] + 1 if len(below) else 0 :]
    return {
        "solved_after_steps": float(after[0]) if len(after) else None,
        "success_area": float(success.mean()),
        "success_lost": float(success.max() - success[-1]),
    }
