"""Trainings in turn: each begins with the networks of the one before it, and all are one run.

The folder of the run is that of the last training. The earlier ones have folders of their own in
it, with all that a run has; they are read and continued like any other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.base.progress import Progress
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import (
    CHECKPOINT,
    CONFIG,
    EVALUATIONS,
    METRICS,
    earlier,
    new_folder,
    read_config,
    read_metrics,
    write_config,
)

Show = Callable[[Progress], None]
Heed = Callable[[Callable[..., None]], AbstractContextManager[Any]]


def folders(folder: Path) -> list[Path]:
    """The folders of the trainings of a run, in their order; the last one is its own."""
    count = len(read_config(folder).get("phases", ()))
    return [*(earlier(folder, k + 1) for k in range(count)), folder]


def shown(show: Show, number: int, config: TrainConfig) -> Show:
    """What shows the progress of one of the trainings of a run."""
    if not config.phases:
        return show
    said = f"phase {number} of {len(config.phases) + 1}"
    return lambda now: show(dataclasses.replace(now, phase=said))


def prepare(
    folder: Path, config: TrainConfig, kind_of: Any, *, resume: bool, show: Show, heed: Heed
) -> None:
    """Carry out what comes before a training, or what is left of it.

    Args:
        folder: Folder of the run.
        config: Settings of the training.
        kind_of: Gives the class of a training from its settings.
        resume: Whether the run was begun before.
        show: As `run.train_in` takes it.
        heed: As `run.train_in` takes it.

    Raises:
        QuadrlError: The folder cannot be used, or a training diverged.
    """
    if (folder / CHECKPOINT).exists() and resume:
        return  # its own training has begun
    if not resume:
        new_folder(folder)
        write_config(folder, config.resolved())
    before = config.from_run
    for number, phase in enumerate(config.earlier, 1):
        own, given = earlier(folder, number), phase.named() | {"from_run": before}
        if begun := (own / CONFIG).exists():  # more steps are asked of the last one
            given["steps"] = read_config(own)["steps"]
        settings = TrainConfig(**given, recorded=phase.recorded)
        training = kind_of(settings)(settings, own, resume=begun)
        with heed(training.ask):
            training.run(shown(show, number, config))
        before = str(own)


def seconds(folder: Path) -> float:
    """Wall clock of the trainings before a run's own [s]."""
    files = [own / METRICS for own in folders(folder)[:-1]]
    return sum(float(read_metrics(file)["seconds"][-1]) for file in files if file.exists())


def curve(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray] | None, list[float]]:
    """The metrics of a run, its evaluations or None, and where trainings end, in control steps.

    Steps and seconds go on from one training to the next. Columns are those of the last one.

    Raises:
        QuadrlError: The folder holds no run with metrics.
    """
    found = [own for own in folders(folder) if (own / METRICS).exists()] or [folder]
    tables: list[list[dict[str, np.ndarray]]] = [[], []]
    steps, seconds, ends = 0.0, 0.0, list[float]()
    for own in found:
        metrics = read_metrics(own / METRICS)
        files = (own / METRICS, own / EVALUATIONS)
        for table, file in zip(tables, files, strict=True):
            if file.exists():
                read = metrics if file == files[0] else read_metrics(file)
                later = {"steps": read["steps"] + steps, "seconds": read["seconds"] + seconds}
                table.append(read | later)
        steps, seconds = steps + metrics["steps"][-1], seconds + metrics["seconds"][-1]
        ends.append(float(steps))
    metrics, evaluated = (_joined(table) if table else None for table in tables)
    assert metrics is not None
    return metrics, evaluated, ends[:-1]


def _joined(tables: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Tables one after the other, with the columns of the last; NaN where one has no such."""
    return {
        name: np.concatenate(
            [table.get(name, np.full(len(table["steps"]), np.nan)) for table in tables]
        )
        for name in tables[-1]
    }
