"""`quadrl study`."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from tyro.conf import Positional

from quadrl.base.errors import QuadrlError
from quadrl.cli import choices
from quadrl.cli import console as shared
from quadrl.cli.console import console, make_table, say


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

    def run(self) -> None:
        """Train what is missing, print the table, write the files."""
        from quadrl.learning.executor import complaint
        from quadrl.learning.study import study

        try:
            found = study(
                self.file,
                jobs=self.jobs,
                out=self.out,
                ray=self.ray or None,
                own=tuple(shared.own_files),
                on_line=say,
            )
        except KeyboardInterrupt:
            words = shlex.join(["quadrl", *sys.argv[1:]])
            raise KeyboardInterrupt(f"stopped; the same command goes on: {words}") from None
        head, *rows = found.table
        console.print("", make_table(head, rows, numbers=4))
        say("\nmeans over the seeds, with their 95 % intervals in brackets")
        say(f"in {found.folder}: table.csv, study.json, learning_curves_TASK.png, the runs")
        if found.failed:
            raise QuadrlError(complaint(found.failed))
