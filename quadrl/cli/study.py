"""`quadrl study`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from quadrl.base.errors import QuadrlError
from quadrl.cli import choices
from quadrl.cli.console import console, going_on, make_table, own_files, print_json, say

LEFT_OUT = ("along the training", "turning", "circling")
"""Columns of the table for which a narrow terminal has no place."""


@choices.command
class Study:
    """Run the trainings of a study file, on all cores or on a Ray cluster, and summarize."""

    file: Positional[Path]
    """The study: a .toml or .json file of tasks, algorithms, settings and seeds."""
    jobs: int | None = None
    """Trainings at the same time, each with one thread; by default one per core."""
    out: Path | None = None
    """Folder of the run folders; by default runs/NAME, with the NAME of the file."""
    ray: str = ""
    """Address of the Ray cluster that runs the trainings, such as 10.0.0.1:6379; auto: the cluster
    of this machine; local: Ray on this machine alone."""

    compare: str = ""
    """Compare all pairs of algorithms and variants by a figure of study.json, such as success_rate
    or solved_after_steps: how often a seed of the one has the smaller figure."""
    json: bool = False
    """Print what study.json holds as one JSON object and nothing else."""

    def run(self) -> None:
        """Train what is missing, print the table, write the files."""
        given = {"jobs": self.jobs, "out": self.out, "ray": self.ray or None}
        carry_out(self.file, json=self.json, compare=self.compare, **given)


def carry_out(
    what: Path | Mapping[str, Any], *, json: bool = False, compare: str = "", **given: Any
) -> None:
    """Carry out a study, as `quadrl.study` takes it, and print what it reached."""
    from quadrl.learning.study import complaint, study

    on_line = (lambda line: None) if json else say
    with going_on():
        found = study(what, own=tuple(own_files), on_line=on_line, **given)
    compared = found.compare(compare) if compare else []
    if json:
        print_json(found.content | {"compared": [dataclasses.asdict(one) for one in compared]})
    else:
        columns, said = [*zip(*found.table, strict=True)], "with their 95 % intervals in brackets"
        if sum(max(map(len, column)) + 2 for column in columns) > console.width:
            kept = (column for column in columns if column[0] not in LEFT_OUT)
            columns = [[cell.partition(" (")[0] for cell in column] for column in kept]
            said = "whose 95 % intervals and other figures are in table.csv"
        names = [*(column[0] for column in columns), "seeds"]  # a table may be empty
        numbers = max(0, len(columns) - names.index("seeds"))
        console.print("", make_table([*zip(*columns, strict=True)], numbers=numbers))
        say(f"\nmeans over the seeds, {said}")
        if compared:
            head = ("the one", "the other", f"smaller {compare}", "verdict", "power")
            console.print("", make_table([head, *map(_row, compared)], numbers=3))
            say(f"\nchance that a seed of the one has the smaller {compare}, within a task;")
            say("power to show a chance of three in four, and to show no difference")
        say(f"in {found.folder}: table.csv, study.json, learning_curves_TASK.png, the runs")
    if found.failed:
        raise QuadrlError(complaint(found.failed))


def _row(one: Any) -> tuple[str, ...]:
    """A comparison in words."""
    chance = f"{one.chance:.2f} ({one.low:.2f} to {one.high:.2f})"
    power = f"{one.power_differs:.2f}, {one.power_equal:.2f}"
    return one.one, one.other, chance, one.verdict, power
