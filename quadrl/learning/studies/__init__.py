"""Studies: trainings of several tasks, algorithms, settings and seeds, on one or many machines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from quadrl.base.errors import QuadrlError
from quadrl.base.validation import number
from quadrl.learning.studies.crew import Local, complaint, train_all
from quadrl.learning.studies.plan import PlannedRun, parse_seeds, read_plan
from quadrl.learning.studies.table import StudyResult, summed_up

__all__ = ["MAX_JOBS", "PlannedRun", "StudyResult", "parse_seeds", "study"]
MAX_JOBS = 4096


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
        out: Folder of the run folders; by default runs/NAME, NAME that of the file.
        ray: Address of a Ray cluster that carries out the trainings (HOST:PORT, or "auto" for the
            one that this machine belongs to), or "local" for Ray on this machine.
        own: Python files that register tasks and aircraft of your own.
        on_line: Is told what happens, a line each.

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
    if ray is None:
        failed = train_all(plan.runs, Local(plan.episodes, jobs, own), on_line)
    else:
        from quadrl.learning.studies.cluster import on_ray

        with on_ray(ray, plan.episodes, jobs, own) as crew:
            failed = train_all(plan.runs, crew, on_line)
    found = summed_up(plan, failed)
    if not found.runs:
        raise QuadrlError(complaint(failed))
    found.save()
    return found
