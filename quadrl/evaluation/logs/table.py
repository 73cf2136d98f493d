"""Logs as tables: csv and npz, with the name and the unit of each column; docs/flights.md says how.

And the archives of docs/data, each of several flights.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from quadrl.aircraft.rotors import GRAVITY
from quadrl.base.errors import QuadrlError
from quadrl.evaluation.logs.recording import Recording, together

FULL_PWM = 65535
MOTORS = "m1 m2 m3 m4 m5 m6 m7 m8"
DEGREE = math.pi / 180
COLUMNS = {
    "time": ("t", {"s": 1.0, "ms": 1e-3, "us": 1e-6}),
    "pwm": (MOTORS, {"pwm": 1 / FULL_PWM, "share": 1.0}),
    "rotor_speed": (MOTORS, {"rpm": 2 * math.pi / 60, "rad/s": 1.0}),
    "body_rate": ("gyro_x gyro_y gyro_z", {"rad/s": 1.0, "deg/s": DEGREE}),
    "acceleration": ("acc_x acc_y acc_z", {"m/s^2": 1.0, "g": GRAVITY}),
    "velocity": ("vx vy vz", {"m/s": 1.0}),
    "quaternion": ("qw qx qy qz", {"1": 1.0}),
    "angles": ("roll pitch yaw", {"rad": 1.0, "deg": DEGREE}),
    "position": ("x y z", {"m": 1.0, "mm": 1e-3}),
    "battery": ("battery", {"V": 1.0, "mV": 1e-3}),
}
"""Names of columns, and what a number of a unit is in SI units, by what they are part of."""


def read_csv(path: Path) -> Iterator[Recording]:
    """Read a .csv file with a head, such as `t [s], m1 [pwm], ..., gyro_x [deg/s], ...`."""
    yield recording(path, columns_of(path))


def read_npz(path: Path) -> Iterator[Recording]:
    """Read an .npz file: an array (T,) by the label of each column, or an archive of docs/data."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = dict(archive)
    except (ValueError, OSError, EOFError) as error:
        raise QuadrlError(f"{path} is no npz file: {error}") from None
    if any(key.endswith("_pwm") for key in found):
        yield from archived(found)
    else:
        yield recording(path, found)


def columns_of(path: Path) -> dict[str, np.ndarray]:
    """Columns (n,) of numbers of a .csv file by their labels.

    Raises:
        QuadrlError: It is empty, or no such table.
    """
    try:
        with open(path, newline="", encoding="utf-8") as file:
            head, text = next(csv.reader(file), []), file.read()
        table = np.genfromtxt(text.splitlines() or ["nan"], delimiter=",", ndmin=2)
    except (ValueError, csv.Error):
        raise QuadrlError(f"{path} is no table: a head, and as many cells in each row") from None
    if table.shape[1] != len(head):
        many = f"{len(head)} names and {table.shape[1]} columns of numbers"
        raise QuadrlError(f"{path} is no table: it has {many}")
    return dict(zip(head, table.T, strict=True))


def name_and_unit(label: str) -> tuple[str, str, bool]:
    """The name and the unit of a label such as `x [m]`, and whether it has one."""
    name, bracket, unit = (part.strip(" ]") for part in label.partition("["))
    return name, unit, bool(bracket)


def recording(path: Path, columns: Mapping[str, np.ndarray]) -> Recording:
    """Make a recording of columns (T,) by their labels; others than those of COLUMNS stay out.

    Raises:
        QuadrlError: A column has no unit or another one, or some of a part are missing.
    """
    parts: dict[str, dict[str, np.ndarray]] = {}
    for label, column in columns.items():
        name, unit, has = name_and_unit(label)
        kinds = {part: units for part, (names, units) in COLUMNS.items() if name in names.split()}
        unit = unit if has or "quaternion" not in kinds else "1"
        part = next((part for part, units in kinds.items() if unit in units), None)
        if kinds and part is None:
            allowed = ", ".join(f"{name} [{u}]" for units in kinds.values() for u in units)
            raise QuadrlError(f"{path}: the column {label.strip()!r} must be one of {allowed}")
        if part is not None:
            parts.setdefault(part, {})[name] = np.asarray(column, float) * kinds[part][unit]
    for part, own in parts.items():
        names = COLUMNS[part][0].split()
        needed = names[: max(len(own), 4)] if part in ("pwm", "rotor_speed") else names
        if missing := [name for name in needed if name not in own]:
            raise QuadrlError(f"{path}: beside {', '.join(own)} a column {missing[0]} is missing")
    if "time" not in parts:
        raise QuadrlError(f"{path}: a column t [s] is missing, the time")
    time = parts.pop("time")["t"]
    ordered = {p: [own[n] for n in COLUMNS[p][0].split() if n in own] for p, own in parts.items()}
    return together(path.stem, {p: (time, np.stack(x, axis=1)) for p, x in ordered.items()})


def archived(found: Mapping[str, np.ndarray]) -> Iterator[Recording]:
    """The flights of an archive; README.txt of docs/data says which arrays it holds."""
    for name in (key.removesuffix("_pwm") for key in found if key.endswith("_pwm")):
        pwm = found[f"{name}_pwm"] / FULL_PWM
        if (time := found.get(f"{name}_t")) is None:
            time = found[f"{name}_t0"] + np.arange(len(pwm)) / found["rate"]
        parts = {"pwm": pwm, "body_rate": found[f"{name}_gyro"] * found.get("gyro_scale", 1.0)}
        others = ("position", "quaternion", "velocity", "battery")
        parts |= {key: found[f"{name}_{key}"] for key in others if f"{name}_{key}" in found}
        if f"{name}_acc" in found:
            parts["acceleration"] = found[f"{name}_acc"] * found.get("acc_scale", 1.0)
        yield together(name, {key: (time, part) for key, part in parts.items()})
