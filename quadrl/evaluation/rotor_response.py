"""How rotors follow motor commands, from logs that have both: command map, lags, dead time."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from quadrl.aircraft.command_map import CommandMap
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.evaluation.logs.recording import Recording

PIECE = 0.5  # [s] that is predicted from a measured speed on
LONGEST_DEAD = 0.02  # [s]
SLOWEST = 0.3  # of hover: below it a rotor may be starting
SLOWEST_LAG = 0.5  # [1/s]
STEADY_BATTERY = 0.03  # standard deviation [V] up to which its effect cannot be told apart


@dataclasses.dataclass(frozen=True)
class Response:
    """How all rotors of an aircraft follow, in the mean."""

    command_map: CommandMap
    lag_up: float  # [1/s]
    lag_down: float  # [1/s]
    dead_time: float  # [s], in whole physics steps
    standard_errors: dict[str, float]  # of lag_up and lag_down, over them

    def of(self, vehicle: Vehicle) -> Vehicle:
        """Make an aircraft whose rotors follow so."""
        lags = {"lag_up": self.lag_up, "lag_down": self.lag_down}
        rotors = tuple(dataclasses.replace(rotor, **lags) for rotor in vehicle.rotors)
        own = {"dead_time": self.dead_time, "command_map": self.command_map}
        return dataclasses.replace(vehicle, rotors=rotors, **own)


def fit_response(logs: Sequence[Recording], vehicle: Vehicle) -> Response:
    """Fit the response to logs with commands and measured speeds.

    Dead time is one of the whole physics steps of the vehicle up to LONGEST_DEAD.

    Raises:
        QuadrlError: The logs are too short, or speeds do not rise with commands.
    """
    step, own = vehicle.physics_timestep, vehicle.rotors[0]
    most_late, long = round(LONGEST_DEAD / step), round(PIECE / step)
    moments = np.arange(-most_late, long) * step
    pieces = [_pieces(one, moments, SLOWEST * vehicle.hover_speed.mean()) for one in logs]
    sent, speed, volts = (np.concatenate(part) for part in zip(*pieces, strict=True))
    if not len(sent):
        raise QuadrlError(f"no {PIECE:g} s of the logs have commands and rotor speeds all along")
    speed, middle = speed[:, most_late:], float(volts.mean())
    steady = volts.std() < STEADY_BATTERY

    def proportional(slope: float, by_volt: float) -> float:
        """The part of the voltage; all of it where the voltage hardly changed."""
        return (slope / middle if middle else 0.0) if steady else by_volt

    def residuals(numbers: np.ndarray, late: int) -> np.ndarray:
        offset, slope, up, down, by_volt = numbers
        slopes = slope + proportional(slope, by_volt) * (volts - middle)
        goal = offset + slopes * sent[:, most_late - late :][:, :long]
        ways, found = (1 - np.exp(-step * up), 1 - np.exp(-step * down)), [speed[:, 0]]
        for wanted in np.moveaxis(goal, 1, 0)[:-1]:
            found.append(found[-1] + np.where(wanted > found[-1], *ways) * (wanted - found[-1]))
        return (np.stack(found, axis=1) - speed).ravel()

    slope, offset = np.polyfit(sent[:, most_late:].ravel(), speed.ravel(), 1)
    if slope <= 0:
        raise QuadrlError(
            f"rotors turn {-slope:.0f} rad/s slower at full command than at none, which no motor "
            "does: are m1, m2 and so on the same motors in commands and in speeds?"
        )
    begin = np.array([offset, slope, own.lag_up, own.lag_down, slope / (middle or 1.0)])
    high = np.array([np.inf, np.inf, 1 / step, 1 / step, np.inf])  # Vehicle allows no faster lag
    low = np.array([-np.inf, 0.0, SLOWEST_LAG, SLOWEST_LAG, 0.0])
    how = {"bounds": (low, high), "x_scale": np.maximum(np.abs(begin), 1.0), "ftol": 1e-5}
    begin = np.clip(begin, low, 0.99 * high)
    tried: dict[int, Any] = {}

    def cost(late: int) -> float:
        tried[late] = least_squares(residuals, begin, args=(late,), **how)
        return tried[late].cost

    late = lowest(cost, round(vehicle.dead_time / step), most_late)
    offset, slope, up, down, by_volt = tried[late].x.tolist()
    jacobian = tried[late].jac[:, : 4 if steady else 5]
    variance = 2 * tried[late].cost / (speed.size - jacobian.shape[1])
    spread = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)) * variance)
    errors = {"lag_up": float(spread[2] / up), "lag_down": float(spread[3] / down)}
    by_volt = proportional(slope, by_volt)
    command_map = CommandMap(offset, slope - by_volt * middle, by_volt)
    return Response(command_map, up, down, late * step, errors)


def lowest(cost: Callable[[int], float], now: int, most: int) -> int:
    """The whole number from 0 to `most` of the least cost, by steps downhill from one on."""
    known = functools.cache(cost)
    while (best := min((k for k in (now, now - 1, now + 1) if 0 <= k <= most), key=known)) != now:
        now = best
    return now


def _pieces(log: Recording, moments: np.ndarray, slowest: float) -> tuple[np.ndarray, ...]:
    """Commands and speeds (n, m, R) and voltages (n, 1, 1) of a log, where all are there."""
    pwm, speed = log.pwm, log.rotor_speed
    assert pwm is not None and speed is not None
    start = np.arange(log.time[0] - moments[0], log.time[-1] - moments[-1], PIECE)[:, None]
    rows = np.searchsorted(log.time, start + moments, side="right") - 1
    column = (np.interp(start + moments, log.time, one) for one in speed.T)
    speeds = np.stack([*column], axis=-1)
    volts = np.zeros((len(log.time), 1)) if log.battery is None else log.battery
    parts = pwm[rows], speeds, volts[rows].mean(axis=1, keepdims=True)
    sound = np.isfinite(parts[2][:, 0, 0]) & (speeds > slowest).all(axis=(1, 2))
    sound &= np.isfinite(parts[0]).all(axis=(1, 2))
    return tuple(part[sound] for part in parts)
