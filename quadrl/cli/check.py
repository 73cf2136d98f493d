"""`quadrl check`."""

from __future__ import annotations

import dataclasses

from quadrl.cli import choices
from quadrl.cli.console import console, make_table, print_json
from quadrl.cli.flown import Conditioned
from quadrl.evaluation.check import check


@choices.command
class Check(Conditioned):
    """Check whether thrust, moments, steps and delays of an aircraft let a policy fly it."""

    task: choices.TaskName = "hover"
    """The task. Some tasks need a turn of the heading within their time limit."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print a row for each quantity."""
        found = check(task=self.task, **self.conditions())
        if self.json:
            rows = [dataclasses.asdict(row) for row in found.rows]
            print_json({"vehicle": found.vehicle.name, "rows": rows})
            return
        console.print(make_table(found.table))
