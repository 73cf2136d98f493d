"""`quadrl study`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from quadrl.base.errors import QuadrlError
from quadrl.cli import choices
from quadrl.cli import console as shared
from quadrl.cli.console import console, going_on, make_table, print_json, say


@choices.command
class Study:
    """Carry out the trainings that a file names, on all cores or on a Ray cluster, and sum up."""

    file: Positional[Path]
    """The study: a .toml or .json file of tasks, algorithms, settings and seeds."""
    jobs: int | None = None
    """Trainings at the same time, each with one thread; by default one per core."""
    out: Path | None = None
    """Folder of the run folders; by default runs/NAME, NAME that of the file."""
    ray: str = ""
    """Address of a Ray cluster that carries out the trainings, such as 10.0.0.1:6379; auto for the
    one that this machine belongs to, local for Ray on this machine alone."""

    json: bool = False
    """Print what study.json holds as one JSON object and nothing else."""

    def run(self) -> None:
        """Train what is missing, print the table, write the files."""
        given = {"jobs": self.jobs, "out": self.out, "ray": self.ray or None}
        carry_out(self.file, json=self.json, **given)


def carry_out(what: Path | Mapping[str, Any], *, json: bool = False, **given: Any) -> None:
    """Carry out a study, as `quadrl.study` takes it, and print what it reached."""
    from quadrl.learning.study import complaint, study

    def on_line(line: str) -> None:
        if not json:
            say(line)

    with going_on():
        found = study(what, own=tuple(shared.own_files), on_line=on_line, **given)
    if json:
        print_json(found.content)
    else:
        head, *rows = found.table
        console.print("", make_table(head, rows, numbers=4))
        say("\nmeans over the seeds, with their 95 % intervals in brackets")
        say(f"in {found.folder}: table.csv, study.json, learning_curves_TASK.png, the runs")
    if found.failed:
        raise QuadrlError(complaint(found.failed))
