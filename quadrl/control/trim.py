"""Trim: the attitude and the rotor speeds with which an aircraft hovers in wind."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import norm, stack
from quadrl.engines.dynamics import Motion, derivative
from quadrl.engines.state import Start

FASTEST, STEP, BEARINGS = 30.0, 0.5, 32
"""Winds in a table: from 0 to FASTEST in steps [m/s], and from all around the aircraft."""
HIGH = 1e3  # [m], where no ground is near
SOUND = 340.0  # [m/s]
CLOSE = 0.02  # [m/s], to which the strongest wind that is held is found
ITERATIONS, NUDGE, STEEPEST = 10, 1e-6, 0.999
"""Newton's method: how often, how far it moves an unknown to see what follows, the largest sine of
a tilt."""
BALANCED = 1e-5
"""Acceleration over that of gravity, and of turning over g / size, below which it is in trim."""
SURE = 1e-9
"""Tolerance for rounding, relative."""


def trimmed(vehicle: Vehicle, start: Start, wind: np.ndarray) -> Start:
    """Starts of which those that are at rest and level are trimmed; the heading stays.

    The trim is that of the specified aircraft, away from the ground. In calm air, and where the
    rotors cannot hold the aircraft in the wind, a start stays as it is.

    Args:
        vehicle: The aircraft in its air.
        start: Arrays (n, k).
        wind: Wind (n, 2) [m/s] towards east and north.
    """
    speed = norm(wind)
    tilt, turn = start.quaternion[:, 1:3], 2 * np.arctan2(*start.quaternion[:, [3, 0]].T)
    moves = np.concatenate([tilt, start.velocity, start.body_rate], axis=1)
    across = np.arctan2(wind[:, 1], wind[:, 0]) - turn
    place = speed / STEP, across % math.tau * BEARINGS / math.tau
    (low, over), (left, beside) = ((np.floor(x).astype(int), x % 1.0) for x in place)
    table, found = _table(vehicle), 0.0
    low = np.minimum(low, len(table) - 2)  # the last two rows of the table hold no trim
    for i, along in enumerate((1 - over, over)):
        for k, around in enumerate((1 - beside, beside)):
            part = table[low + i, (left + k) % BEARINGS]
            found = found + (along * around)[:, None] * part
    chosen = (~moves.any(1) & (speed > 0) & np.isfinite(found).all(1))[:, None]
    found = np.where(chosen, found, 0.0)
    quaternion = _attitude(start.quaternion, *_turned(found[:, 0], found[:, 1], across))
    rotor_speed = start.rotor_speed * np.sqrt(found[:, 2:])
    return dataclasses.replace(
        start,
        quaternion=np.where(chosen, quaternion, start.quaternion),
        rotor_speed=np.where(chosen, rotor_speed, start.rotor_speed),
    )


class Balances:
    """Attitudes and rotor speeds without limits that hold an aircraft in winds from all around.

    The unknowns (BEARINGS, 6) are the components of the body's z axis along x and y of the level
    aircraft, and thrust and moments beyond those of hover, over the weight and the weight times the
    size; NaN where Newton's method has found no balance.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        """Begin in calm air."""
        self._vehicle = vehicle
        self._parameters = Parameters.of(parameters.rows(vehicle), vehicle.control_timestep)
        weight, size = vehicle.mass * GRAVITY, vehicle.size
        self._units = np.linalg.pinv(vehicle.mixer) * (weight * np.array([1.0, size, size, size]))
        self._accelerations = np.repeat([GRAVITY, GRAVITY / size], 3)
        self._bearing = math.tau / BEARINGS * np.arange(BEARINGS)
        self._rising = [np.zeros((BEARINGS, 6))]  # in winds of 0, STEP, ...

    def rising(self) -> Iterator[tuple[float, np.ndarray]]:
        """Winds of 0, STEP, ... [m/s] and the unknowns, until there is no balance from any side.

        From one wind to the next they go on as they have changed so far.
        """
        for step in itertools.count():
            if step == len(self._rising):
                last, before, first = (self._rising[max(step - k, 0)] for k in (1, 2, 3))
                self._rising.append(self.at(step * STEP, 3 * last - 3 * before + first))
            if not np.isfinite(self._rising[step]).any():
                return
            yield step * STEP, self._rising[step]

    def at(self, speed: float, guess: np.ndarray) -> np.ndarray:
        """The unknowns in a wind [m/s], by Newton's method from a guess."""
        wind = speed * stack(np.cos(self._bearing), np.sin(self._bearing), 0 * self._bearing)
        nudges = np.concatenate([np.zeros((1, 6)), NUDGE * np.eye(6)])[:, None]
        unknown, balance = guess + 0.0, np.zeros(BEARINGS, dtype=bool)
        for _ in range(ITERATIONS):
            tilt = norm(unknown[:, :2])[:, None]
            unknown[:, :2] *= np.minimum(1.0, STEEPEST / np.maximum(tilt, STEEPEST))
            found = self._lacking(unknown + nudges, wind)
            balance = (abs(found[0]) < BALANCED).all(-1)
            if balance[np.isfinite(guess).all(-1)].all():
                break
            slopes = np.moveaxis(found[1:] - found[0], 0, -1) / NUDGE
            slopes[~np.isfinite(slopes).all((1, 2))] = np.eye(6)
            unknown = unknown - (np.linalg.pinv(slopes) @ found[0][..., None])[..., 0]
        return np.where(balance[:, None], unknown, np.nan)

    def _lacking(self, unknown: np.ndarray, wind: np.ndarray) -> np.ndarray:
        """Accelerations and angular ones that are left, over BALANCED's, (k, BEARINGS, 6)."""
        flat, winds = unknown.reshape(-1, 6), np.tile(wind, (len(unknown), 1))
        still, level = np.zeros((len(flat), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(flat), 1))
        quaternion = _attitude(level, flat[:, 0], flat[:, 1])
        turning = np.sqrt(np.maximum(self.squares(flat), 0.0))
        motion = Motion(still + [0.0, 0.0, HIGH], quaternion, still, still, turning)
        effects = self._vehicle.aerodynamics.effects
        rate = derivative(self._parameters, motion, turning, winds, -GRAVITY, effects)
        both = np.concatenate([rate.velocity, rate.body_rate], axis=1) / self._accelerations
        return both.reshape(unknown.shape)

    def squares(self, unknown: np.ndarray) -> np.ndarray:
        """Squares (n, R) of the rotor speeds [rad^2/s^2]."""
        return self._vehicle.hover_speed**2 + unknown[:, 2:] @ self._units.T

    def tilt(self, unknown: np.ndarray) -> np.ndarray:
        """The body's z axis along the wind and to its left, (BEARINGS, 2)."""
        return stack(*_turned(unknown[:, 0], unknown[:, 1], -self._bearing))


_balances = functools.lru_cache(maxsize=32)(Balances)


@functools.lru_cache(maxsize=32)
def _table(vehicle: Vehicle) -> np.ndarray:
    """Trims in winds of 0, STEP, ... up to FASTEST that the rotors hold at their limits.

    Returns:
        (S + 2, BEARINGS, 2 + R): the body's z axis along the wind and to its left, and squares of
        the rotor speeds over those of hover; NaN where there is no trim, as in the last two rows.
    """
    balances, rows = _balances(vehicle), list[np.ndarray]()
    for _, unknown in itertools.takewhile(lambda one: one[0] <= FASTEST, balances.rising()):
        square = balances.squares(unknown)
        held = ((square >= 0) & (square <= vehicle.max_speed**2)).all(-1, keepdims=True)
        found = np.concatenate([balances.tilt(unknown), square / vehicle.hover_speed**2], axis=1)
        rows.append(np.where(held, found, np.nan))
    return np.concatenate([rows, np.full((2, *rows[0].shape), np.nan)])


def _turned(x: np.ndarray, y: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A vector in the plane, turned to the left by an angle [rad]."""
    return np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y


def _attitude(level: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Attitudes (n, 4) that have the yaw (Z-Y-X angles) of level ones (n, 4).

    Their body z axis has components x and y (n,) along the x and y axes of the level ones.
    """
    w, z = level[:, 0], level[:, 3]
    roll, pitch = -np.arcsin(y), np.arctan2(x, np.sqrt(1 - np.minimum(x * x + y * y, 1.0)))
    a, b, c, d = np.cos(roll / 2), np.sin(roll / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    return stack(
        w * c * a + z * d * b, w * c * b - z * d * a, w * d * a + z * c * b, z * c * a - w * d * b
    )


@functools.lru_cache(maxsize=32)
def held_wind(vehicle: Vehicle, low: tuple[float, ...], high: tuple[float, ...]) -> float:
    """Strongest steady wind [m/s] in which the aircraft can be trimmed, whatever the bearing.

    It counts drag, the lift that tilted rotors lose to the wind through them, and the moments. inf
    where it is beyond the speed of sound.

    Args:
        vehicle: The aircraft in its air.
        low: Lowest speed of each rotor [rad/s].
        high: Highest speed of each rotor [rad/s].
    """
    balances = _balances(vehicle)

    def holds(unknown: np.ndarray) -> bool:
        square, room = balances.squares(unknown), SURE * np.square(high)
        within = (square >= np.square(low) - room) & (square <= np.square(high) + room)
        return bool(within.all())

    held, last, fast = 0.0, None, math.inf
    for speed, unknown in balances.rising():
        if speed > SOUND:
            return math.inf
        if not holds(unknown):
            fast = speed
            break
        held, last = speed, unknown
    if last is None:
        return 0.0
    fast = min(fast, held + STEP)
    while fast - held > CLOSE:
        middle = (held + fast) / 2
        found = balances.at(middle, last)
        held, last, fast = (middle, found, fast) if holds(found) else (held, last, middle)
    return held
