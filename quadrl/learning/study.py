"""Studies: trainings of several tasks, algorithms, settings and seeds, and what they reached."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.files import write_whole
from quadrl.base.validation import number
from quadrl.evaluation.evaluate import html_table
from quadrl.learning.cluster import on_ray
from quadrl.learning.executor import Local, complaint, train_all
from quadrl.learning.folder import EVALUATION, METRICS, read_metrics, write_json
from quadrl.learning.plan import Plan, PlannedRun, read_plan

MAX_JOBS = 4096
FIGURES = {"success_rate": (0.0, 1.0), "position_error_m": (0.0, math.inf),
           "training_s": (0.0, math.inf)}  # fmt: skip
"""What is compared, and the range in which it lies."""
TABLE, STUDY = "table.csv", "study.json"
GROUP = ("task", "algo", "variant")
CONFIDENCE = 0.95


@dataclasses.dataclass(frozen=True, repr=False)
class StudyResult:
    """The trainings of a study that are done, and what they reached over their seeds."""

    folder: Path
    """Holds the run folders, table.csv, study.json and the pictures."""
    runs: tuple[dict[str, Any], ...]
    """Of each training that is done: name, task, algo, variant, seed, and its metrics."""
    rows: tuple[dict[str, Any], ...]
    """Of each task, algorithm and variant: seeds, and of `success_rate`, `position_error_m` over
    the last 2 s and `training_s` the mean over the seeds, with its 95 % interval `_low`, `_high`
    (None with one seed)."""
    failed: dict[str, str]
    """Why trainings failed, by name."""

    @property
    def table(self) -> list[tuple[str, ...]]:
        """Rows of text, the head first."""
        head = (*GROUP, "seeds", "successful", "error over the last 2 s", "training")
        lines = []
        for row in self.rows:
            shown = (
                _between(row, name, factor, unit)
                for name, factor, unit in (
                    ("success_rate", 100, "%"),
                    ("position_error_m", 100, "cm"),
                    ("training_s", 1, "s"),
                )
            )
            lines.append((*(str(row[name]) for name in GROUP), str(row["seeds"]), *shown))
        return [head, *lines]

    def __repr__(self) -> str:
        many = f"{len(self.runs)} trainings in {self.folder}"
        return f"{many}, {len(self.failed)} failed" if self.failed else many

    def _repr_html_(self) -> str:
        return html_table(self.table)

    def save(self) -> list[Path]:
        """Write table.csv, study.json, and the learning curves of each task.

        Returns:
            The files.
        """
        text = io.StringIO(newline="")
        rows = csv.DictWriter(text, [*GROUP, "seeds", *_columns()])
        rows.writeheader()
        rows.writerows(self.rows)
        write_whole(self.folder / TABLE, text.getvalue().encode())
        content = {"rows": self.rows, "runs": self.runs, "failed": self.failed}
        write_json(self.folder / STUDY, json.loads(json.dumps(content), parse_constant=_nothing))
        return [self.folder / TABLE, self.folder / STUDY, *self._draw()]

    def _draw(self) -> list[Path]:
        """A picture for each task, with a curve for each algorithm and variant."""
        from quadrl.evaluation.plotting import learning_curves, save

        tasks: dict[str, dict[str, list[Any]]] = {}
        for run in self.runs:
            label = f"{run['algo']} {run['variant']}".strip()
            metrics = read_metrics(self.folder / run["name"] / METRICS)
            tasks.setdefault(run["task"], {}).setdefault(label, []).append(metrics)
        drawn = []
        for task, groups in tasks.items():
            # In the shortest trainings no episode ends: there is no curve to draw.
            if any(np.isfinite(m["return"]).any() for runs in groups.values() for m in runs):
                path = self.folder / f"learning_curves_{task}.png"
                drawn.append(save(learning_curves(groups, task), path))
        return drawn


def study(
    what: str | Path | Mapping[str, Any],
    *,
    jobs: int | None = None,
    out: str | Path | None = None,
    ray: str | None = None,
    own: tuple[Path, ...] = (),
    on_line: Callable[[str], None] = print,
) -> StudyResult:
    """Carry out all trainings of a study, or those that are missing; `quadrl study` in Python.

    Each training has a process and a run folder of its own, and ends with the same policy, bit for
    bit, as `quadrl.train` with the same settings. A training whose process or machine dies goes on
    from its last checkpoint. A study that is stopped goes on when it is called again.

    Args:
        what: A study file (.toml or .json), or a dict with the same keys: `tasks`, `algorithms`,
            `seeds`, `episodes`, `settings`, `variants`.
        jobs: Trainings at a time; by default one per core.
        out: Folder of the run folders; by default runs/NAME, NAME that of the file. With Ray all
            machines share it.
        ray: Address of a Ray cluster that carries out the trainings (HOST:PORT, or "auto" for the
            one that this machine belongs to), or "local" for Ray on this machine.
        own: Python files that register tasks and aircraft of your own.
        on_line: Is called with what happens, a line each.

    Returns:
        What the trainings reached. One that failed is in its `failed`.

    Raises:
        QuadrlError: The study cannot be read, a folder holds a run with other settings, or Ray
            cannot be used; nothing was begun.
    """
    plan = read_plan(what, None if out is None else Path(out))
    if jobs is not None:
        number("jobs", jobs, 1, MAX_JOBS, whole=True)
    for run in plan.runs:
        _ = run.done  # refuses other settings before anything starts
    here = contextlib.nullcontext(Local(plan.episodes, jobs, own))
    with on_ray(ray, plan.episodes, jobs, own) if ray else here as executor:
        failed = train_all(plan.runs, executor, on_line)
    found = sum_up(plan, failed)
    if not found.runs:
        raise QuadrlError(complaint(failed))
    found.save()
    return found


def sum_up(plan: Plan, failed: dict[str, str]) -> StudyResult:
    """Sum up what the finished trainings reached."""
    done = [run for run in plan.runs if run.done]
    runs = tuple(_known(run) for run in done)
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for run in runs:
        groups.setdefault(tuple(run[name] for name in GROUP), []).append(run)
    rows = []
    for key, members in groups.items():
        row = dict(zip(GROUP, key, strict=True)) | {"seeds": len(members)}
        for name, span in FIGURES.items():
            values = [run["metrics"][name] for run in members]
            row |= dict(zip(_columns(name), interval(values, *span), strict=True))
        rows.append(row)
    return StudyResult(plan.folder, runs, tuple(rows), failed)


def interval(
    values: Sequence[float | None], low: float = -math.inf, high: float = math.inf
) -> tuple[float | None, float | None, float | None]:
    """The mean of the seeds and its 95 % interval by Student's t, within a range.

    Values that are missing or not finite are left out; with a single one there is no interval.
    """
    from scipy.stats import t

    known = np.array([x for x in values if x is not None and math.isfinite(x)], dtype=float)
    if not len(known):
        return None, None, None
    mean = float(known.mean())
    if len(known) == 1:
        return mean, None, None
    half = t.ppf((1 + CONFIDENCE) / 2, len(known) - 1) * known.std(ddof=1) / math.sqrt(len(known))
    return mean, max(low, mean - float(half)), min(high, mean + float(half))


def _known(run: PlannedRun) -> dict[str, Any]:
    config = run.config
    known = {"name": run.name, "task": config.task, "algo": config.algo, "variant": run.variant}
    metrics = json.loads((run.folder / EVALUATION).read_text())
    return known | {"seed": config.seed, "metrics": metrics, "settings": dataclasses.asdict(config)}


def _columns(*names: str) -> list[str]:
    return [f"{name}{end}" for name in names or FIGURES for end in ("", "_low", "_high")]


def _between(row: dict[str, Any], name: str, factor: float, unit: str) -> str:
    mean, low, high = (row[column] for column in _columns(name))
    if mean is None:
        return "none"
    around = "" if low is None else f" ({factor * low:.3g} to {factor * high:.3g})"
    return f"{factor * mean:.3g} {unit}{around}"


def _nothing(constant: str) -> None:
    """JSON has no NaN."""
