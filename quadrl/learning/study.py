"""Studies: trainings of several tasks, algorithms, settings and seeds, and what they reached.

A study continues where it was stopped, since each of its trainings does: see `executor`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.extras import needed
from quadrl.base.files import write_csv, write_json
from quadrl.base.units import quantity
from quadrl.base.validation import number
from quadrl.evaluation.evaluate import html_table
from quadrl.learning.cluster import on_ray
from quadrl.learning.comparison import LEVEL, Comparison, arm, compare
from quadrl.learning.executor import Local, complaint, train_all
from quadrl.learning.folder import EVALUATION, EVALUATIONS, read_metrics
from quadrl.learning.plan import Plan, read_plan
from quadrl.learning.show import curves

MAX_JOBS = 4096
FIGURES = {
    "success_rate": 1.0,
    "success_area": 1.0,
    "position_error_m": math.inf,
    "yaw_rate_rad_s": math.inf,
    "circling_m_s": math.inf,
    "training_s": math.inf,
}
"""Figures of the table, and the largest value of each; the least is zero."""
TABLE, STUDY = "table.csv", "study.json"
GROUP = ("task", "algo", "variant")
CONFIDENCE = 0.95
SOLVED = 0.95
"""The success from which on a policy counts as solving its task, for `solved_after_steps`."""


@dataclasses.dataclass(frozen=True, repr=False)
class StudyResult:
    """The finished trainings of a study, and what they reached over their seeds."""

    folder: Path
    """Holds the run folders, table.csv, study.json and the pictures."""
    runs: tuple[dict[str, Any], ...]
    """A row a training: name, task, algo, variant, seed, scenario, metrics and settings."""
    rows: tuple[dict[str, Any], ...]
    """A row for each task, algorithm and variant: seeds, and of `success_rate`, `success_area`
    (its mean along the training), `position_error_m` over the last 2 s, `yaw_rate_rad_s`,
    `circling_m_s` and `training_s` the mean over the seeds, with its 95 % interval `_low`, `_high`
    (None with one seed, or where there is no figure)."""
    failed: dict[str, str]
    """Why trainings failed, by name."""

    @property
    def table(self) -> list[tuple[str, ...]]:
        """The rows as text, the head first."""
        known = [name for name in (*GROUP, "seeds") if any(row[name] for row in self.rows)]
        head = (*known, "successful", "along the training", "error over the last 2 s", "turning",
                "circling", "training")  # fmt: skip
        figures = ([_text(row, name) for name in FIGURES] for row in self.rows)
        named = ([str(row[name]) for name in known] for row in self.rows)
        return [head, *((*one, *other) for one, other in zip(named, figures, strict=True))]

    def __repr__(self) -> str:
        many = f"{len(self.runs)} trainings in {self.folder}"
        return f"{many}, {len(self.failed)} failed" if self.failed else many

    def _repr_html_(self) -> str:
        return html_table(self.table)

    def compare(self, figure: str) -> list[Comparison]:
        """Compare a metric of `runs` for every two algorithms and variants, within each task.

        The verdicts are those of `quadrl.learning.comparison`; the probability that any of them is
        false is 5 % at most.

        Raises:
            QuadrlError: There is no such metric, or fewer than two seeds.
        """
        arms = [*itertools.combinations(dict.fromkeys(map(arm, self.runs)), 2)]
        return [compare(self.runs, figure, *two, LEVEL / len(arms)) for two in arms]

    @property
    def content(self) -> dict[str, Any]:
        """The rows, the runs and the failures as study.json has them."""
        content = {"rows": self.rows, "runs": self.runs, "failed": self.failed}
        # JSON has no NaN.
        return json.loads(json.dumps(content), parse_constant=lambda constant: None)

    def save(self, on_line: Callable[[str], None] = lambda line: None) -> list[Path]:
        """Write table.csv, study.json, and the learning curves of each task; returns the paths.

        Args:
            on_line: Called with a line about each run or task of which there is no curve.
        """
        head = [*GROUP, "seeds", *itertools.chain(*map(_columns, FIGURES))]
        write_csv(self.folder / TABLE, head, ([row[name] for name in head] for row in self.rows))
        write_json(self.folder / STUDY, self.content)
        return [self.folder / TABLE, self.folder / STUDY, *self._draw(on_line)]

    def _draw(self, on_line: Callable[[str], None]) -> list[Path]:
        """Draw a picture for each task, with a curve for each algorithm and variant."""
        from quadrl.evaluation.plotting import save

        labels = {self.folder / run["name"]: arm(run) for run in self.runs}
        # In very short trainings no episode ends, so there is no curve to draw.
        figures = curves(labels, on_missing=lambda error: on_line(f"left out: {error}"))
        return [
            save(figure, self.folder / f"learning_curves_{task}.png")
            for task, figure in figures.items()
        ]


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
    bit, as `quadrl.train` with the same settings. If its process or machine dies, it continues from
    its last checkpoint. A study that is stopped continues when it is called again.

    Args:
        what: A study file (.toml or .json), or a dict with the same keys: `tasks`, `algorithms`,
            `seeds`, `episodes`, `settings`, `variants`.
        jobs: Trainings at a time; by default one per core.
        out: Folder of the run folders; by default runs/NAME, NAME that of the file. With Ray all
            machines share it.
        ray: Address of a Ray cluster that carries out the trainings (HOST:PORT, or "auto" for the
            one that this machine belongs to), or "local" for Ray on this machine.
        own: Python files that register tasks and aircraft of your own. With Ray all machines have
            them under these paths.
        on_line: Called with a line about each event.

    Returns:
        What the trainings reached; those that failed are in its `failed`.

    Raises:
        QuadrlError: The study cannot be read, a folder holds a run with other settings, or Ray
            cannot be used, before anything was begun; or all trainings failed.
    """
    with needed("quadrl.study", "torch", "torchrl", "matplotlib"):
        plan = read_plan(what, None if out is None else Path(out))
    if jobs is not None:
        number("jobs", jobs, 1, MAX_JOBS, whole=True)
    here = Local(jobs, own)
    with on_ray(ray, here) if ray else contextlib.nullcontext(here) as executor:
        failed = train_all(plan.runs, executor, on_line)
    found = sum_up(plan, failed)
    if not found.runs:
        raise QuadrlError(complaint(failed))
    found.save(on_line)
    return found


def sum_up(plan: Plan, failed: dict[str, str]) -> StudyResult:
    """Sum up what the finished trainings reached."""
    runs: list[dict[str, Any]] = []
    for run in plan.runs:
        if run.done:
            config, metrics = run.config, json.loads((run.folder / EVALUATION).read_text())
            metrics |= along(run.folder)
            known = {"name": run.name, "task": config.task, "algo": config.algo}
            known |= {"variant": run.variant, "seed": config.seed}
            known |= {"scenario": metrics.pop("scenario"), "metrics": metrics}
            runs.append(known | {"settings": dataclasses.asdict(config)})
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for run in runs:
        groups.setdefault(tuple(run[name] for name in GROUP), []).append(run)
    rows = []
    for key, members in groups.items():
        row = dict(zip(GROUP, key, strict=True)) | {"seeds": len(members)}
        for name, most in FIGURES.items():
            values = [run["metrics"].get(name) for run in members]
            row |= dict(zip(_columns(name), interval(values, 0.0, most), strict=True))
        rows.append(row)
    return StudyResult(plan.folder, tuple(runs), tuple(rows), failed)


def along(folder: Path) -> dict[str, float | None]:
    """Compute figures without a ceiling of a run that was evaluated during its training.

    Returns:
        solved_after_steps: control steps after which its success stays at 95 % or above, None
        where it ends below; success_area: its mean over the training; success_lost: the largest
        of it minus the last. Of a run without evaluations there are no figures.
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


def interval(
    values: Sequence[float | None], low: float = -math.inf, high: float = math.inf
) -> tuple[float | None, float | None, float | None]:
    """Compute the mean of the seeds and its 95 % interval by Student's t, within a range.

    Values that are missing or not finite are left out; a single value has no interval.
    """
    from scipy.stats import t

    known = [x for x in values if x is not None and math.isfinite(x)]
    if len(known) < 2:
        return (known[0] if known else None), None, None
    mean, deviation = statistics.fmean(known), statistics.stdev(known)
    half = float(t.ppf((1 + CONFIDENCE) / 2, len(known) - 1)) * deviation / math.sqrt(len(known))
    return mean, max(low, mean - half), min(high, mean + half)


def _columns(name: str) -> list[str]:
    return [name, f"{name}_low", f"{name}_high"]


def _text(row: dict[str, Any], name: str) -> str:
    """Write a mean and its interval."""
    mean, low, high = (row[column] for column in _columns(name))
    if mean is None:
        return "none"
    around = "" if low is None else f" ({quantity(name, low)} to {quantity(name, high)})"
    return f"{quantity(name, mean)}{around}"
