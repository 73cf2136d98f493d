"""What a user gives as an aircraft: its name, its file, some of its numbers, or a Vehicle."""

# pyright: reportUnnecessaryIsInstance=false
# What users give is checked, whatever its annotation promises.
from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from quadrl.aircraft.aerodynamics import Aerodynamics
from quadrl.aircraft.command_map import CommandMap
from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.rotors import Rotor
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.files import read_table
from quadrl.base.validation import IN_A_FILE, choice, keys, record

OPTIONS = (
    "mass inertia drag_coefficient moment_coefficient action_scale control_timestep dead_time"
).split()
"""Fields that may differ from an aircraft's without making another one of it."""
FILE = ".json"
"""What the name of a file of an aircraft ends in."""
_READ: set[str] = set()


def of_file(path: str | Path) -> str:
    """Make the aircraft of a file known by its name, as `quadrl identify` writes it.

    The file is JSON, a mapping with a field `vehicle`, and in it the fields of a Vehicle.

    Returns:
        The name.

    Raises:
        QuadrlError: There is no such file, it holds no aircraft, or another one has the name.
    """
    if not Path(path).is_file():
        allowed = f"a name ({', '.join(VEHICLES)}) or a file that exists"
        raise QuadrlError(name="vehicle", value=str(path), allowed=allowed)
    fields = read_table(Path(path), "vehicle").get("vehicle")
    if not isinstance(fields, dict):
        raise QuadrlError(f"{path} holds no aircraft: it needs a field vehicle with its numbers")
    made = _of_fields(cast(dict[str, Any], fields), whole=False)
    if made.name not in _READ and VEHICLES.get(made.name, made) != made:
        allowed = "one that no other aircraft has: change it in the file"
        raise QuadrlError(name=f"name in {path}", value=made.name, allowed=allowed)
    _READ.add(made.name)
    VEHICLES[made.name] = made
    return made.name


def resolve(
    vehicle: Vehicle | str | Mapping[str, Any] | None,
    options: Mapping[str, Any] | None = None,
    *,
    whole: bool = False,
) -> Vehicle:
    """Make a vehicle from a name, a mapping of fields or a vehicle; None is the paper's.

    Args:
        vehicle: The vehicle, its name, or that of its file (`of_file`); fields are changes to the
            known one of their `name`, else the paper's.
        options: Numbers that differ from it, by their fields' names.
        whole: Whether a mapping is all of an aircraft: a field that it lacks has its default then.

    Raises:
        QuadrlError: It is something else, a name is unknown, or a number impossible.
    """
    if isinstance(vehicle, str) and vehicle.endswith(FILE):
        vehicle = of_file(vehicle)
    if isinstance(vehicle, str):
        vehicle = VEHICLES[choice("vehicle", vehicle, VEHICLES, IN_A_FILE)]
    if isinstance(vehicle, Mapping):
        vehicle = _of_fields(vehicle, whole)
    vehicle = VEHICLES["paper"] if vehicle is None else vehicle
    if not isinstance(vehicle, Vehicle):
        allowed = f"a Vehicle or a name ({', '.join(VEHICLES)})"
        raise QuadrlError(name="vehicle", value=vehicle, allowed=allowed)
    keys("vehicle option", options or {}, OPTIONS)
    return dataclasses.replace(vehicle, **options) if options else vehicle


def _of_fields(given: Mapping[str, Any], whole: bool) -> Vehicle:
    """A vehicle from all its fields, or from those that differ from a known one's, as in JSON."""
    keys("field of vehicle", given, [field.name for field in dataclasses.fields(Vehicle)])
    changes = dict(given)
    rotors: Sequence[Any] | None = changes.get("rotors")
    if isinstance(rotors, (list, tuple)):
        changes["rotors"] = tuple(record("rotors", rotor, Rotor) for rotor in rotors)
    if "aerodynamics" in changes:
        changes["aerodynamics"] = record("aerodynamics", changes["aerodynamics"], Aerodynamics)
    if "command_map" in changes:
        changes["command_map"] = record("command_map", changes["command_map"], CommandMap)
    known = VEHICLES.get(str(changes.get("name")), VEHICLES["paper"])
    return dataclasses.replace(Vehicle() if whole else known, **changes)


def check_known(vehicle: Vehicle) -> None:
    """Refuse a vehicle with the name of a preset whose full set is for other rotors.

    Raises:
        QuadrlError: The vehicle has the name of a preset, but other discs or another thrust.
    """

    def rotors(one: Vehicle) -> list[tuple[float, str]]:
        density = one.aerodynamics.air_density
        return [(r.disc, f"{r.thrust_coefficient / density:.9g}") for r in one.rotors]

    known = VEHICLES.get(vehicle.name)
    if known and rotors(known) != rotors(vehicle):
        reason = "its rotors are not those of the aircraft that quadrl knows by this name"
        raise QuadrlError(reason, name="vehicle", value=vehicle.name, allowed="another name")
