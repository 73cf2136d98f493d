"""Draws the learning curves of each task over its seeds, from folders of trainings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tyro

from quadrl.base.errors import QuadrlError
from quadrl.evaluation.plotting import learning_curves, save
from quadrl.learning.folder import EVALUATION, METRICS, read_config, read_metrics
from scripts.reports import report
from scripts.reports.report import say


def main(runs: Path = report.RUNS / "training") -> None:
    """Draw docs/images/curves/TASK.png for every task that has trainings.

    Args:
        runs: Folder of run folders; those of the paper's aircraft in free flight that are done
            count.
    """
    found: dict[str, dict[str, dict[int, Any]]] = {}
    for folder in sorted(runs.iterdir()):
        try:
            config, metrics = read_config(folder), read_metrics(folder / METRICS)
        except QuadrlError as error:
            say(f"left out: {error}")
            continue
        usual = (config["vehicle"], config["engine"]) == ("paper", "free_flight")
        if usual and (folder / EVALUATION).exists():
            found.setdefault(config["task"], {}).setdefault(config["algo"], {})[config["seed"]] = (
                metrics
            )
    if not found:
        raise SystemExit(f"no training in {runs} is done")
    for task, algos in found.items():
        groups = {algo: list(by_seed.values()) for algo, by_seed in algos.items()}
        path = report.IMAGES / "curves" / f"{task}.png"
        save(learning_curves(groups, task, clocks=("steps",)), path)
    report.save("curves", {
        "tasks": {
            task: {algo: sorted(by_seed) for algo, by_seed in algos.items()}
            for task, algos in found.items()
        }
    })  # fmt: skip


if __name__ == "__main__":
    tyro.cli(main)
