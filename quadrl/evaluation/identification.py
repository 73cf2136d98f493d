"""An aircraft's numbers from its flights, as far as these tell them.

A fit that predicts well may still be wrong: under feedback a model that ignores its commands can
win. So every number has the bounds of physics, and `at_bounds` says which lean on theirs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.validation import choice, keys
from quadrl.evaluation.open_loop import LAGS, Window, differences, errors, fly, hold, measured

TRIMS = ("roll_trim", "pitch_trim", "yaw_trim")
BOUNDS = {
    "thrust": (0.5, 2.0),  # k_T and k_Q of all rotors: thrust over mass, at a command
    **dict.fromkeys(TRIMS, (0.8, 1.25)),  # k_T and k_Q of those that turn it one way, over others
    # With more than 1.87 times a Crazyflie has more than if its whole mass were at the rotors.
    **dict.fromkeys(("inertia_x", "inertia_y"), (0.5, 1.87)),
    "inertia_z": (0.5, 2.0),  # never more than the other two together
    "torque": (0.5, 2.0),  # k_Q over k_T; only over the inertia about z does it count in flight
    "lag_rate": (0.5, 2.0),  # k_c, up and down
    **dict.fromkeys(LAGS, (0.5, 2.0)),  # one of them
    "rotor_drag": (0.2, 5.0),
    **dict.fromkeys(("flapping_moment", "flapping_pitch", "rotor_inertia"), (0.1, 10.0)),
}
"""Numbers that can be fitted, and the least and the largest factor on the aircraft's own."""
AIR = ("rotor_drag", "flapping_moment", "flapping_pitch", "rotor_inertia")
"""Those of them that are fields of Aerodynamics."""

TIME = 0.1  # [s] after a window begins: long enough to move, and too short to tumble
MOST_STEPS = 12  # of a search over several quantities, which nears the least in half as many
NORMAL = 0.6745  # median of the size of a normal number over its standard deviation
VAGUE = 0.25  # standard error of a factor from which on it is not identified


def changed(vehicle: Vehicle, factors: Mapping[str, float]) -> Vehicle:
    """Make an aircraft with factors on its numbers.

    Raises:
        QuadrlError: A name is not one of BOUNDS, or the aircraft is impossible.
    """
    keys("factor", factors, BOUNDS)
    by = dict.fromkeys(BOUNDS, 1.0) | dict(factors)
    trims = np.array([[by[name]] for name in TRIMS]) ** vehicle.layout[1:]
    rotors = [
        dataclasses.replace(
            rotor,
            thrust_coefficient=rotor.thrust_coefficient * lift,
            torque_coefficient=rotor.torque_coefficient * lift * by["torque"],
            **{name: getattr(rotor, name) * by["lag_rate"] * by[name] for name in LAGS},
        )
        for rotor, lift in zip(vehicle.rotors, by["thrust"] * trims.prod(axis=0), strict=True)
    ]
    (x, y, z), air = vehicle.inertia, vehicle.aerodynamics
    x, y = x * by["inertia_x"], y * by["inertia_y"]
    inertia = x, y, min(z * by["inertia_z"], x + y)
    air = dataclasses.replace(air, **{name: getattr(air, name) * by[name] for name in AIR})
    return dataclasses.replace(vehicle, rotors=tuple(rotors), inertia=inertia, aerodynamics=air)


def fit(
    vehicle: Vehicle, where: Sequence[Window], free: Sequence[str], *quantities: str
) -> tuple[dict[str, float], dict[str, float]]:
    """Fit numbers of an aircraft to windows of its flights.

    Args:
        vehicle: The aircraft to begin with.
        where: Windows, others than those that judge the fit.
        free: Names of BOUNDS.
        *quantities: Names of the `differences` after TIME that count: what the numbers decide.
            Of several each axis counts by how well it is predicted.

    Returns:
        Factors on the numbers by name; and their standard errors, over them, which are the least
        that they can be, since neighbouring windows are alike.

    Raises:
        QuadrlError: A name is unknown, or the flights have no such quantity.
    """
    keys("factor", free, BOUNDS)
    truth = measured(where, (TIME,))
    scale = errors(hold(where, (TIME,)), truth)
    for quantity in quantities:
        choice("quantity", quantity, scale)

    def away(logarithms: np.ndarray) -> list[np.ndarray]:
        own = changed(vehicle, dict(zip(free, np.exp(logarithms), strict=True)))
        found = differences(fly(own, where, (TIME,)), truth)
        return [found[quantity].reshape(-1, 3) for quantity in quantities]

    def residuals(logarithms: np.ndarray) -> np.ndarray:
        parts = zip(away(logarithms), scales, strict=True)
        return np.concatenate([(part / scale).ravel() for part, scale in parts])

    bounds = np.log([BOUNDS[name] for name in free]).T
    how: dict[str, Any] = {"bounds": bounds, "loss": "soft_l1", "x_scale": 0.1, "diff_step": 1e-3}
    scales: list[np.ndarray] = [scale[quantity] for quantity in quantities]
    how |= {"ftol": 1e-4, "max_nfev": MOST_STEPS} if len(quantities) > 1 else {}
    found = least_squares(residuals, np.zeros(len(free)), **how)
    if len(quantities) > 1:
        scales = [np.median(np.abs(part), axis=0) / NORMAL for part in away(found.x)]
        found = least_squares(residuals, found.x, **how)
    variance = 2 * found.cost / (found.fun.size - len(free))
    spread = np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)) * variance)
    factors, vague = (zip(free, x.tolist(), strict=True) for x in (np.exp(found.x), spread))
    return dict(factors), dict(vague)


def at_bounds(factors: Mapping[str, float]) -> list[str]:
    """Numbers that only their bounds keep within physics; without any a fit is physical."""
    near = {name: np.abs(np.log(BOUNDS[name]) - np.log(x)) for name, x in factors.items()}
    return [name for name, distances in near.items() if distances.min() < 0.01]
