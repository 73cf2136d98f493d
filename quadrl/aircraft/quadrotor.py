"""Every quadrotor as an X: a plus is one that is turned by 45 degrees.

A frame turned about the body's z axis has its x axis between two rotors, of which the right one
spins counter-clockwise. Its rotors are named clockwise from there, as a Crazyflie's motors are: in
front on the right, behind on the right, behind on the left, in front on the left.
"""

from __future__ import annotations

import math

import numpy as np

from quadrl.aircraft.parameters import rows
from quadrl.aircraft.rotors import mixer
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array

PLACES = "ahead on the right", "behind on the right", "behind on the left", "ahead on the left"
SPINS = (1.0, -1.0, 1.0, -1.0)
EIGHTH = math.pi / 4
ASKEW = math.radians(15.0)
"""Largest angle between an arm and its place in an X or a plus [rad]."""


def as_x(position: Array, spin: Array) -> tuple[list[int], float]:
    """The order of the rotors of an X, and how the frame in which they are one is turned.

    Args:
        position: (R, 3) [m], body frame.
        spin: (R,) 1 or -1, as `Rotor.spin`.

    Returns:
        Indices of the rotors in the order of PLACES; angle [rad] about z, a multiple of pi / 4, in
        (-3 pi / 4, 3 pi / 4].

    Raises:
        QuadrlError: They are no four rotors in an X or a plus whose spins alternate.
    """
    bearing = np.arctan2(position[:, 1], position[:, 0])  # [rad], counter-clockwise from ahead
    # Of those that spin so, the one with the least turn is the one ahead on the right.
    off = np.where(spin > 0, np.abs(bearing + EIGHTH - 1e-9), np.inf)
    first = int(off.argmin())
    order = np.argsort((bearing[first] - bearing) % (2 * math.pi))
    turn = EIGHTH * round((float(bearing[first]) + EIGHTH) / EIGHTH)
    at = turn - EIGHTH - 2 * EIGHTH * np.arange(len(spin))  # [rad], where each belongs
    askew = np.abs((bearing[order] - at + math.pi) % (2 * math.pi) - math.pi).max()
    if len(spin) != len(SPINS) or not np.array_equal(spin[order], SPINS) or askew > ASKEW:
        degrees = np.degrees(bearing).round().tolist()
        allowed = "four in an X or a plus, of which neighbours spin in opposite directions"
        raise QuadrlError(name="bearings of rotors [deg]", value=degrees, allowed=allowed)
    return order.tolist(), turn


def turned(vector: Array, turn: float) -> Array:
    """Vectors (..., 3) of the body frame in one that is turned about z by an angle [rad]."""
    cosine, sine = round(math.cos(turn), 15), round(math.sin(turn), 15)
    ahead, left = vector[..., 0], vector[..., 1]
    return np.stack(
        [cosine * ahead + sine * left, cosine * left - sine * ahead, vector[..., 2]], axis=-1
    )


def authority(table: np.ndarray) -> Array:
    """The normalised allocation matrix of rows of quadrotors (n,), as an X, (n, 16).

    Logarithms of what each rotor gives at its largest speed: the acceleration [g] along z, and the
    angular accelerations [rad/s^2] about the axes of the X; the four of a rotor side by side. Signs
    are left out, since those of an X are known.
    """
    rotor = table["rotor"][:, : len(SPINS)]
    order, turn = as_x(rotor["position"][0], rotor["spin"][0])
    wrench = mixer(rotor) * (rotor["max_speed"] ** 2)[:, None]  # (n, 4, 4) [N], [N m]
    weight = table["mass"] * 9.81
    matrix = wrench.swapaxes(1, 2)[:, order]  # (n, rotor, force and moments)
    lift = matrix[..., :1] / weight[:, None, None]
    spun = turned(matrix[..., 1:] / table["inertia"][:, None], turn)
    whole = np.concatenate([lift, spun], axis=-1).reshape(len(table), -1)
    return np.log(np.maximum(np.abs(whole), 1e-3))


def sizes_of(vehicle: Vehicle) -> dict[str, float]:
    """The sizes of a quadrotor by the names and in the units of a randomization's `sizes`.

    Raises:
        QuadrlError: Its rotors are no X and no plus.
    """
    table = rows(vehicle)
    lift, roll, pitch, _ = np.exp(authority(table)).reshape(4, 4).mean(0).tolist()
    rotor = table["rotor"][0, : vehicle.rotor_count]
    rates = np.log([rotor["lag_up"], rotor["lag_down"]])
    return {
        "mass": vehicle.mass,
        "thrust_to_weight": 4 * lift,
        "angular_acceleration": 2 * math.sqrt(roll * pitch),
        "lag": math.exp(-rates.mean()),
    }
