"""Trim: the attitude and the rotor speeds with which an aircraft hovers in wind."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import norm, rotation_matrix, stack
from quadrl.engines.dynamics import Motion, derivative, thrust_wrench
from quadrl.engines.state import Start

FASTEST, HIGH = 25.0, 1e3  # [m/s]; [m], where no ground is near
SPEEDS, BEARINGS = 51, 32
"""Winds in a table: speeds from 0 to FASTEST, and bearings all around the aircraft."""
ITERATIONS, SHARE = 16, 0.7
"""Share of the correction that each iteration makes. Lift grows faster than the square of the rotor
speed, so that the whole correction would oscillate."""
STILL, STEADY = 0.01, 0.1  # [m/s^2], [rad/s^2], below which an aircraft is in trim


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
    place = speed * (SPEEDS - 1) / FASTEST, across % math.tau * BEARINGS / math.tau
    (low, over), (left, beside) = ((np.floor(x).astype(int), x % 1.0) for x in place)
    low = np.minimum(low, SPEEDS)  # the last two rows of the table hold no trim
    table, found = _table(vehicle), 0.0
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


@functools.lru_cache(maxsize=8)
def _table(vehicle: Vehicle) -> np.ndarray:
    """Trims in winds up to FASTEST.

    Returns:
        (SPEEDS + 2, BEARINGS, 2 + R): the body's z axis along the wind and to its left, and squares
        of the rotor speeds over those of hover; NaN where there is no trim.
    """
    p = Parameters.of(parameters.rows(vehicle), vehicle.control_timestep)
    speed, bearing = np.meshgrid(
        np.linspace(0, FASTEST, SPEEDS), math.tau / BEARINGS * np.arange(BEARINGS), indexing="ij"
    )
    speed, bearing = speed.reshape(-1), bearing.reshape(-1)
    still = np.zeros((len(speed), 3))
    wind = stack(speed * np.cos(bearing), speed * np.sin(bearing), 0 * speed)
    level, high = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, HIGH])
    hover, most = vehicle.hover_speed**2, vehicle.max_speed**2
    east = north = 0 * speed
    square, allocation = hover + 0 * speed[:, None], np.linalg.pinv(vehicle.mixer).T
    balance = speed < 0
    for _ in range(ITERATIONS):
        quaternion, turning = _attitude(level + 0 * wind[:, :1], east, north), np.sqrt(square)
        motion = Motion(still + high, quaternion, still, still, turning)
        effects = vehicle.aerodynamics.effects
        rate = derivative(p, motion, turning, wind, -GRAVITY, effects)
        balance = (norm(rate.velocity) < STILL) & (norm(rate.body_rate) < STEADY)
        up = rotation_matrix(quaternion)[:, :, 2]
        lift = p.mass * ((rate.velocity + [0, 0, GRAVITY]) * up).sum(-1)
        # The force that would balance the others, if body z pointed along it.
        needed = lift[:, None] * up - p.mass[..., None] * rate.velocity
        force = norm(needed)
        east, north = needed[:, 0] / force, needed[:, 1] / force
        lacking = np.concatenate([(force - lift)[:, None], -rate.body_rate * p.inertia], axis=1)
        thrust = thrust_wrench(p, turning)[0][:, 2]
        per_square = np.clip(lift / np.maximum(thrust, 1e-12), 0.5, 2.0)
        square = square + SHARE * (lacking / per_square[:, None]) @ allocation
        square = np.clip(square, 0.0, most)
    found = np.concatenate([stack(*_turned(east, north, -bearing)), square / hover], axis=1)
    whole = np.where(balance[:, None], found, np.nan).reshape(SPEEDS, BEARINGS, -1)
    return np.concatenate([whole, np.full((2, *whole.shape[1:]), np.nan)])


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


def fastest_held(vehicle: Vehicle) -> float:
    """Fastest wind of the table [m/s] in which the aircraft can be trimmed, whatever the bearing.

    Unlike `held_wind` it includes the thrust that tilted rotors lose to the wind through them.
    """
    held = np.isfinite(_table(vehicle)[..., 0]).all(1)
    return FASTEST * (int(np.argmin(held)) - 1) / (SPEEDS - 1)
