"""`quadrl plot`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from quadrl.base.errors import QuadrlError
from quadrl.cli.console import say
from quadrl.learning.folder import LEARNING_CURVE, METRICS, read_config


@dataclasses.dataclass(frozen=True)
class Plot:
    """Draw the learning curve of one run, or the curves of several runs in one picture."""

    run_folders: Positional[tuple[Path, ...]]
    """Run folders. Several are overlaid: a picture for each task, a curve for each algorithm with
    the spread over its runs."""
    out: Path | None = None
    """Output file; its ending (png, pdf, svg) sets the format; by default learning_curve.png in the
    run folder, or, of several runs, learning_curves_TASK.png here."""

    def run(self) -> None:
        """Write the pictures."""
        if not self.run_folders:
            raise QuadrlError("give a run folder, or several: quadrl plot runs/*")
        if len(self.run_folders) == 1:
            from quadrl.learning.figures import learning_curve

            (folder,) = self.run_folders
            paths = [learning_curve(folder, self.out or folder / LEARNING_CURVE)]
        else:
            paths = _overlay(self.run_folders, self.out)
        for path in paths:
            say(f"wrote {path}")


def _overlay(folders: tuple[Path, ...], out: Path | None) -> list[Path]:
    """Draw a picture for each task of several runs; the name stands where there is one task only.

    Raises:
        QuadrlError: None of the folders holds a run that has begun.
    """
    from quadrl.learning.figures import learning_curves, read_metrics

    runs: dict[str, dict[str, list[Any]]] = {}
    for folder in folders:
        try:
            config, metrics = read_config(folder), read_metrics(folder / METRICS)
        except QuadrlError as error:
            say(f"left out: {error}")
            continue
        runs.setdefault(config["task"], {}).setdefault(config["algo"], []).append(metrics)
    if not runs:
        raise QuadrlError(f"none of the {len(folders)} folders holds a run to plot")
    base = out or Path("learning_curves.png")
    paths = {task: base.with_name(f"{base.stem}_{task}{base.suffix}") for task in runs}
    if out and len(runs) == 1:
        paths = dict.fromkeys(runs, out)
    return [learning_curves(groups, task, paths[task]) for task, groups in runs.items()]
