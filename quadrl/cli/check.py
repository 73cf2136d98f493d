"""`quadrl check`."""

from __future__ import annotations

import dataclasses

from tyro.conf import Positional

import quadrl
from quadrl.base.errors import QuadrlError
from quadrl.cli import choices
from quadrl.cli.console import console, make_table, print_json, say
from quadrl.cli.flown import Conditioned
from quadrl.core.catalogue import kind
from quadrl.evaluation.check import check


@choices.command
class Check(Conditioned):
    """Check whether thrust, moments, steps and delays of an aircraft let a policy fly it.

    A task of your own is checked, too: whether it keeps what every task must keep.
    """

    task: Positional[choices.TaskName] = "hover"
    """The task. Some tasks need a turn of the heading within their time limit."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print a row for each quantity."""
        own = kind(self.task)
        if is_own := not own.__module__.startswith("quadrl."):
            try:
                with console.status(f"flying {self.task} in every API"):
                    quadrl.testing.check_task(own)
            except AssertionError as error:
                raise QuadrlError(str(error)) from error
        found = check(task=self.task, **self.conditions())
        if self.json:
            rows = [dataclasses.asdict(row) for row in found.rows]
            print_json({"vehicle": found.vehicle.name, "rows": rows})
            return
        if is_own:
            say(f"{self.task} keeps what every task must keep\n")
        console.print(make_table(found.table))
