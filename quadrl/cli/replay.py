"""`quadrl replay`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from quadrl.aircraft.specification import resolve
from quadrl.base.extras import needed
from quadrl.cli import choices
from quadrl.cli.console import console, make_table, say
from quadrl.cli.flown import parse_options
from quadrl.evaluation.flight_log import flown
from quadrl.evaluation.logs.reading import read_log
from quadrl.evaluation.open_loop import HORIZONS, UNITS, judged, least_speed, stretch
from quadrl.evaluation.stand import stand_map


@choices.command
class Replay:
    """Fly a log's commands open loop beside what it measured, as a picture.

    Predictions of half a second follow each other; each begins with the measured state.
    """

    log: Positional[Path]
    """The log, of a kind that quadrl identify reads."""
    vehicle: choices.VehicleName = "crazyflie"
    """The aircraft. Its command map says what commands mean, where no stand does and the log has no
    rotor speeds."""
    vehicle_options: tuple[str, ...] = ()
    """Changed numbers of it, such as mass=0.034."""
    stand: Path | None = None
    """Table of a thrust stand: what commands mean."""
    motors: str = ""
    """Numbers of the log's motors in the order of the aircraft's, such as 4,1,3,2."""
    begin: float = 0.0
    """Time of the log [s] from which it is flown."""
    seconds: float = 10.0
    """For how long [s]."""
    out: Path | None = None
    """The picture. By default LOG_replay.png."""

    def run(self) -> None:
        """Print the errors, and draw."""
        vehicle = resolve(self.vehicle, parse_options(self.vehicle_options))
        with needed("drawing", "matplotlib"):
            from quadrl.evaluation.predictions import draw
        logs = read_log(self.log, self.motors)
        for one in logs:
            command_map = vehicle.command_map
            if self.stand is not None:
                command_map = stand_map(self.stand, one.battery is not None)
            log = flown(one, command_map)
            first = self.begin or float(log.time[0])
            where = stretch(log, first, first + self.seconds, least_speed(vehicle))
            print_errors(judged([where], {vehicle.name: vehicle}), log.name)
            out = self.out or Path("replay.png")
            if self.out is None or len(logs) > 1:
                out = out.with_name(f"{log.name}_{out.name}")
            say(f"wrote {draw(out, where, {vehicle.name: vehicle})}")


def print_errors(rows: Sequence[dict[str, Any]], where: str) -> None:
    """Print the errors of models, as `open_loop.judged` gives them."""
    say(f"mean errors of {rows[0]['windows']} predictions of {where}")
    table = [("error", "after", *(row["model"] for row in rows))]
    for name in (name for name in UNITS if rows[0][name]):
        for k, after in enumerate(HORIZONS):
            label = f"{name.replace('_', ' ')} [{UNITS[name]}]" if k == 0 else ""
            table.append((label, f"{after:g} s", *(f"{row[name][k]:.2g}" for row in rows)))
    console.print(make_table(table, numbers=len(rows)))
