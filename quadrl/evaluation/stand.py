"""A thrust stand's table: what motor commands mean, and what rotors lift."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np

from quadrl.aircraft.command_map import CommandMap
from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.evaluation.logs.table import FULL_PWM, columns_of, name_and_unit

FIELDS = {
    "pwm": {"": 1 / FULL_PWM, "pwm": 1 / FULL_PWM, "share": 1.0},
    "vbat": {"V": 1.0},
    "rpm": {"": 2 * math.pi / 60, "rpm": 2 * math.pi / 60},
    "thrust": {"N": 1.0, "g": GRAVITY / 1000},
    "torque": {"N m": 1.0, "mN m": 1e-3},
    "current": {"A": 1.0},
}
"""Units of the columns of a table, and what a number of one is in SI units."""
ALIASES = {"weight": "thrust", "i": "current"}
"""Other names of columns."""


@dataclasses.dataclass(frozen=True)
class Stand:
    """Numbers of a rotor, as means over all on the stand."""

    thrust_coefficient: float
    """k_T [N s^2/rad^2]."""
    torque_coefficient: float | None
    """k_Q [N m s^2/rad^2]; None where torque was not measured."""
    max_speed: float
    """[rad/s], the largest of the table."""
    current: float | None
    """[A] of all rotors at that speed."""
    residual: float
    """Root mean square of measured thrust less that of k_T, over the largest thrust."""

    def of(self, vehicle: Vehicle) -> Vehicle:
        """Make an aircraft with these rotors."""
        own = {"thrust_coefficient": self.thrust_coefficient, "max_speed": self.max_speed}
        ratio = vehicle.rotors[0].torque_coefficient / vehicle.rotors[0].thrust_coefficient
        own["torque_coefficient"] = self.torque_coefficient or ratio * self.thrust_coefficient
        rotors = tuple(dataclasses.replace(rotor, **own) for rotor in vehicle.rotors)
        return dataclasses.replace(vehicle, rotors=rotors)


def read_stand(path: Path) -> Stand:
    """Read k_T, k_Q and the largest speed off a table.

    Raises:
        QuadrlError: It has no rotor speeds or no thrust, or no rotor turns.
    """
    columns = _columns(path)
    if "thrust" not in columns:
        raise QuadrlError(f"{path} has no column thrust [N] or weight [g]")
    speeds = columns["rpm"]
    turning, squares = speeds.min(axis=1) > 0, (speeds**2).sum(axis=1)
    fastest = int(np.argmax(squares))

    def over_squares(values: np.ndarray) -> float:
        still = (
            values[~turning].mean() if not turning.all() else 0.0
        )  # what the scale shows at rest
        return float((values - still)[turning] @ squares[turning] / (squares**2)[turning].sum())

    thrust = columns["thrust"][:, 0]
    k_t = over_squares(thrust)
    away = (thrust - (thrust[~turning].mean() if not turning.all() else 0.0)) - k_t * squares
    return Stand(
        k_t,
        over_squares(np.abs(columns["torque"][:, 0])) if "torque" in columns else None,
        float(speeds.mean(axis=1)[fastest]),
        float(columns["current"][fastest, 0]) if "current" in columns else None,
        float(np.sqrt((away[turning] ** 2).mean()) / np.abs(thrust).max()),
    )


def torque_ratio(path: Path) -> float | None:
    """Torque over thrust [m]; None where one was not measured."""
    columns = _columns(path)
    if not {"thrust", "torque"} <= {*columns}:
        return None
    return float(np.abs(columns["torque"]).sum() / np.abs(columns["thrust"]).sum())


def stand_map(path: Path, battery: bool) -> CommandMap:
    """What a motor command means, as a line through the speeds of turning rotors.

    Args:
        path: A csv file, with columns `pwm`, `vbat[V]` and `rpm1` and so on.
        battery: Whether the line is over PWM times volts, or over PWM alone.

    Raises:
        QuadrlError: A column is missing, or no rotor turns.
    """
    columns = _columns(path)
    for name in ("pwm", *["vbat"] * battery):
        if name not in columns:
            named = f"{name}{' [V]' * (name == 'vbat')}"
            raise QuadrlError(f"{path} has no column {named}: what commands mean is unknown")
    driven = columns["pwm"] * (columns["vbat"] if battery else 1.0)
    turning = columns["rpm"].min(axis=1) > 0
    slope, offset = np.polyfit(driven[turning, 0], columns["rpm"][turning].mean(axis=1), 1)
    return CommandMap(float(offset), 0.0 if battery else float(slope), float(slope) * battery)


def _columns(path: Path) -> dict[str, np.ndarray]:
    """Columns (n, k) in SI units by the names of FIELDS; those of several rotors beside another."""
    found: dict[str, list[np.ndarray]] = {}
    for label, column in columns_of(path).items():
        name, unit, _ = name_and_unit(label)
        name = name.rstrip("0123456789")
        name = ALIASES.get(name, name)
        if (factor := FIELDS.get(name, {}).get(unit)) is not None:
            found.setdefault(name, []).append(column * factor)
    if "rpm" not in found or not (np.min(found["rpm"], axis=0) > 0).any():
        raise QuadrlError(f"{path} has no turning rotors: give columns rpm, or rpm1 and so on")
    return {name: np.stack(columns, axis=1) for name, columns in found.items()}
