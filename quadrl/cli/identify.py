"""`quadrl identify`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.specification import FILE, resolve
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.extras import needed
from quadrl.base.files import in_a_folder, write_json
from quadrl.base.records import as_json
from quadrl.cli import choices
from quadrl.cli.console import again, console, make_table, say
from quadrl.cli.flown import parse_options
from quadrl.cli.replay import print_errors
from quadrl.evaluation.identify import Identified, identify
from quadrl.evaluation.logs.reading import read_log
from quadrl.evaluation.open_loop import LAGS, least_speed, stretch
from quadrl.evaluation.stand import Stand, read_stand, stand_map

PICTURED = 5.0  # [s]
OF_ROTORS = {
    "thrust": ("thrust_coefficient", "N s^2"),
    "torque": ("torque_coefficient", "N m s^2"),
    **{name: (name, "1/s") for name in LAGS},
}
"""Fields of a rotor and their units, by what is fitted."""
OF_AIR = {"rotor_drag": "N s^2/m", "flapping_moment": "N s^2", "flapping_pitch": "",
          "rotor_inertia": "kg m^2"}  # fmt: skip
"""Units of fields of Aerodynamics."""


@choices.command
class Identify:
    """Fit an aircraft to logs of its flights, and write it as a file for --vehicle.

    docs/flights.md says what a log needs. With --stand and no log, read the thrust stand's table.
    """

    logs: Positional[tuple[Path, ...]] = ()
    """Logs: csv, npz, ULog, Betaflight blackbox, rosbag, binary of a Crazyflie's microSD card."""
    vehicle: choices.VehicleName = "crazyflie"
    """The aircraft to begin with; its mass and arms are taken as true."""
    vehicle_options: tuple[str, ...] = ()
    """Numbers of it that are known better, such as mass=0.034."""
    stand: Path | None = None
    """Table of a thrust stand, csv: pwm, vbat [V], rpm1 [rpm] and so on, thrust [N] or weight [g]
    of all of them, torque [N m], current [A]."""
    motors: str = ""
    """Numbers of the log's motors in the order of the aircraft's, such as 4,1,3,2."""
    out: Path | None = None
    """The file, which names the aircraft. By default VEHICLE_identified.json."""

    def run(self) -> None:
        """Fit, print, write the file and pictures."""
        given = resolve(self.vehicle, parse_options(self.vehicle_options))
        out = in_a_folder(self.out or Path(f"{given.name}_identified{FILE}"))
        if out.suffix != FILE:
            raise QuadrlError(name="out", value=str(out), allowed=f"a name that ends in {FILE}")
        dataclasses.replace(given, name=out.stem)  # whether it can be a name
        if out.stem in VEHICLES and out.stem != given.name or given == VEHICLES.get(out.stem):
            allowed = f"another name: quadrl has an aircraft {out.stem}"
            raise QuadrlError(name="out", value=str(out), allowed=allowed)
        if not self.logs:
            if self.stand is None:
                raise QuadrlError("give a log, or several: quadrl identify LOG...; or --stand FILE")
            made, found = self._by_stand(given, out.stem, self.stand)
            write_json(out, {"vehicle": as_json(made), "stand": as_json(found)})
        else:
            logs = [one for path in self.logs for one in read_log(path, self.motors)]
            fitted = identify(logs, given, out.stem, self.stand)
            _print(fitted)
            own = {"logs": [str(path) for path in self.logs], "begun_with": given.name}
            names = ("factors", "standard_errors", "not_identified", "answer", "table")
            own |= {name: as_json(getattr(fitted, name)) for name in names}
            write_json(out, {"vehicle": as_json(fitted.vehicle), "identified": own})
            _draw(fitted, out)
        say(f"wrote {out}; next:\n  {again(f'check --vehicle {out}')}")
        say(f"  {again(f'train hover --vehicle {out}')}")

    def _by_stand(self, given: Vehicle, name: str, path: Path) -> tuple[Vehicle, Stand]:
        found = read_stand(path)
        command_map = None
        for battery in (True, False):
            try:
                command_map = command_map or stand_map(path, battery)
            except QuadrlError:  # it has no such column
                continue
        made = dataclasses.replace(found.of(given), name=name, command_map=command_map)
        rows: list[tuple[str, ...]] = [("number", "on the stand", made.name, given.name)]
        for what, text, key in (
            ("thrust coefficient [N s^2]", found.thrust_coefficient, "thrust_coefficient"),
            ("torque coefficient [N m s^2]", found.torque_coefficient, "torque_coefficient"),
            ("largest speed [rad/s]", found.max_speed, "max_speed"),
            ("current at it [A]", found.current, ""),
        ):
            cells = (f"{getattr(x.rotors[0], key):.4g}" if key else "" for x in (made, given))
            rows.append((what, "not measured" if text is None else f"{text:.4g}", *cells))
        console.print(make_table(rows, numbers=3))
        say(f"thrust less that of the coefficient: {found.residual:.1%} of the largest, rms")
        if command_map is not None:
            say(f"rotor speed by command: {command_map}")
        return made, found


def _print(found: Identified) -> None:
    own, rows = found.vehicle, [("identified", "value", "factor", "standard error")]
    for name, wrong in found.standard_errors.items():
        factor = f"{found.factors[name]:.3f}" if name in found.factors else ""
        rows.append((name, _value(own, name), factor, f"{100 * wrong:.1f} %"))
    console.print(make_table(rows, numbers=3))
    reasons: dict[str, list[str]] = {}
    for name, why in found.not_identified.items():
        reasons.setdefault(why, []).append(name)
    for why, names in reasons.items():
        say(f"not identified, left as given: {', '.join(names)} ({why})")
    say(f"dead time: {1000 * own.dead_time:g} ms")
    if own.command_map is not None:
        say(f"rotor speed by command: {own.command_map}")
    say(
        f"one rotor 5 % faster turns it {found.answer:.2f} times as fast as thrust, arm and inertia"
    )
    say("")
    print_errors(found.table, "pieces held out")


def _value(vehicle: Vehicle, name: str) -> str:
    """A number of an aircraft with its unit; of its rotors the mean."""
    field, unit = OF_ROTORS.get(name, ("", ""))
    if field:
        return f"{np.mean([getattr(rotor, field) for rotor in vehicle.rotors]):.4g} {unit}"
    if name.startswith("inertia_"):
        return f"{vehicle.inertia['xyz'.index(name[-1])]:.4g} kg m^2"
    unit = OF_AIR.get(name)
    return "" if unit is None else f"{getattr(vehicle.aerodynamics, name):.4g} {unit}"


def _draw(found: Identified, out: Path) -> None:
    """Write a picture of each log beside the file: its middle, as far as it was held out."""
    with needed("drawing", "matplotlib"):
        from quadrl.evaluation.predictions import draw
    models = {name: found.models[name] for name in ("as given", "fitted")}
    for log, start in found.held_out:
        first = float(start[len(start) // 2])
        first -= first % PICTURED
        where = stretch(log, first, first + PICTURED, least_speed(found.vehicle))
        say(f"wrote {draw(out.with_name(f'{out.stem}_{log.name}.png'), where, models)}")
