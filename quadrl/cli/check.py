"""`quadrl check`."""

from __future__ import annotations

import dataclasses

from quadrl.cli import choices
from quadrl.cli.console import console, make_table
from quadrl.cli.flown import parse_named, parse_options
from quadrl.evaluation.checked import check


@choices.command
class Check:
    """Check an aircraft: what its thrust, moments, steps and delays leave to a policy."""

    vehicle: choices.VehicleName = "paper"
    """The aircraft."""
    vehicle_options: tuple[str, ...] = ()
    """Numbers of the aircraft that differ from it, such as mass=0.7 action_scale=90."""
    task: choices.TaskName = "hover"
    """The task; some ask for a turn of the heading within their time."""
    task_options: tuple[str, ...] = ()
    """Options of the task that differ from its defaults, such as time_limit=5."""
    randomization: choices.RandomizationName = ""
    """What is drawn for each aircraft, of which the worst is checked too: none, light or full, or
    JSON such as '{"mass": [0.8, 1.2]}'."""
    control_mode: choices.ControlModeName = "rotor"
    """Meaning of the actions: rotor, thrust_body_rate, velocity or position."""
    aerodynamics: str = ""
    """Effects of the air on the rotors: none, full, or names of single ones with commas between
    them; by default those of the aircraft."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print a row for each quantity."""
        found = check(
            self.vehicle,
            vehicle_options=parse_options(self.vehicle_options),
            task=self.task,
            randomization=parse_named("randomization", self.randomization) or None,
            control_mode=self.control_mode,
            aerodynamics=self.aerodynamics or None,
            **parse_options(self.task_options),
        )
        if self.json:
            rows = [dataclasses.asdict(row) for row in found.rows]
            console.print_json(data={"vehicle": found.vehicle.name, "rows": rows}, indent=None)
            return
        head, *rows = found.table
        console.print(make_table(head, rows))
