"""Short manoeuvres that show whether a simulator means what quadrl means, before a policy flies.

All fly at once for a few milliseconds, in the simulator and in quadrl's own engine. Conventions
must agree; what the air does may be missing in one of them, but may not have the other sign.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import numpy as np

from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.engines.mujoco import BatchEngine

Advance = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""Motions (n, 13 + R), as in `Engine`, commands (n, R) [rad/s] and seconds to motions then."""
LEAST = 0.005  # [s]
FASTER = 1.05  # of one rotor
STEP = 1.1  # of the command, for the lag
HEIGHT = 10.0  # [m]: no ground effect is left, and single precision is
TURNED = (0.8, 0.3, -0.2, 0.4796)  # a quaternion whose parts cannot be confused
RATE = (1.0, -1.6, 0.6)  # [rad/s]
ROTORS, TILT, ALONG, UP, DOWN = (1, 2, 3, 4), 5, (6, 7, 8), 9, 10
"""Rows of the manoeuvres; row 0 hovers."""
NONE, ZERO = 0.02, 1e-3  # of the other side's, and in m/s^2 or rad/s^2: there is no such force
APART = 5.0  # ratio of time constants that no two aircraft of a kind have


@dataclasses.dataclass(frozen=True)
class Check:
    """What came of a manoeuvre."""

    name: str
    """What was flown, with the unit of the numbers."""
    here: list[float]
    """In quadrl."""
    there: list[float]
    """In the simulator."""
    wrong: str = ""
    """What is wrong; empty where nothing is."""


def told(numbers: Sequence[float]) -> str:
    """Numbers of a check as text."""
    return ", ".join(f"{round(x, 4) + 0.0:.2g}" for x in numbers)


def engine_of(vehicle: Vehicle) -> Advance:
    """Fly in the engine of quadrl, far above the ground."""

    @functools.cache
    def made(rows: int) -> BatchEngine:
        return BatchEngine(vehicle, rows, altitude=0.0, engine="free_flight")

    def advance(motion: np.ndarray, command: np.ndarray, seconds: float) -> np.ndarray:
        engine = made(len(motion))
        engine.qpos[:], engine.qvel[:], engine.act[:] = np.split(motion, [7, 13], axis=1)
        engine.command(command)
        engine.advance(round(seconds / vehicle.physics_timestep))
        return np.concatenate([engine.qpos, engine.qvel, engine.act], axis=1)

    return advance


def flown(vehicle: Vehicle, advance: Advance) -> tuple[np.ndarray, np.ndarray, float]:
    """Motions (11, 17) of the manoeuvres before and after, and for how long they were flown [s]."""
    hover, step = vehicle.hover_speed, vehicle.physics_timestep
    motion = np.zeros((11, 13 + len(hover)))
    motion[:, 2], motion[:, 3], motion[:, 13:] = HEIGHT, 1.0, hover
    for k in ROTORS:
        motion[k, 12 + k] *= FASTER
    motion[TILT, 3:7], motion[TILT, 10:13] = np.array(TURNED) / np.linalg.norm(TURNED), RATE
    motion[ALONG, (7, 8, 9)] = 1.0
    command = motion[:, 13:].copy()
    command[UP] *= STEP
    command[DOWN] /= STEP
    seconds = max(1, math.ceil(LEAST / step - 1e-9)) * step
    return motion, advance(motion, command, seconds), seconds


def checks(vehicle: Vehicle, advance: Advance) -> list[Check]:
    """Fly the manoeuvres in a simulator and in quadrl, without dead time, and compare.

    Args:
        vehicle: The aircraft in its air; four rotors.
        advance: The simulator with this aircraft, or with its own of the same kind.
    """
    begun, end, seconds = flown(vehicle, advance)
    _, own, _ = flown(vehicle, engine_of(vehicle))
    both = np.array([own - begun, end - begun]) / seconds  # (2, 11, 17)
    found: list[Check] = []

    def note(name: str, pair: np.ndarray, slack: float, wrong: str) -> None:
        close = np.abs(pair[1] - pair[0]).max() <= slack  # not where one is no number
        here, there = np.reshape(pair, (2, -1)).tolist()
        found.append(Check(name, here, there, "" if close else wrong))

    frames = "axes, units, or the order of numbers"
    note("way [m/s]", both[:, ALONG, (0, 1, 2)], 0.1, frames)
    note("hovering [m/s^2]", both[:, 0, 9:10], 0.02 * GRAVITY, "the thrust is not the weight")
    turned = "the order of the quaternion, or the frame of the body rate"
    note("turning [1/s]", both[:, TILT, 4:7], 0.1, turned)
    note("tilted [m/s^2]", both[:, TILT, 7:10], 0.05 * GRAVITY, "the quaternion is turned round")
    for k in ROTORS:
        pair = both[:, k, 10:13]
        differ = (np.sign(pair[0]) != np.sign(pair[1])) & (abs(pair[0]) > 0.01 * abs(pair[0]).max())
        wrong = "it is another rotor" if differ[:2].any() else "its spin" if differ[2] else ""
        note(f"rotor {k} [rad/s^2]", pair, -1.0, wrong)
    for name, unit, rows, columns in (
        ("drag along", "m/s^2", ALONG, (7, 8, 9)),
        ("flapping along", "rad/s^2", ALONG[:2], (11, 10)),
    ):
        for axis, row, column in zip("xyz", rows, columns, strict=False):
            ours, theirs = pair = both[:, row, column] - both[:, 0, column]
            least, most = sorted((abs(ours), abs(theirs)))
            wrong = "" if least <= max(NONE * most, ZERO) or ours * theirs > 0 else "the other sign"
            note(f"{name} {axis} [{unit}]", pair, -1.0, wrong)
    for name, row, share in (("up", UP, STEP - 1), ("down", DOWN, 1 / STEP - 1)):
        way = both[:, row, 13:].mean(axis=1) * seconds / (share * np.mean(vehicle.hover_speed))
        lag = -seconds / np.log(1 - np.clip(way, 1e-9, 1 - 1e-9))
        wrong = (
            ""
            if 1 / APART < lag[1] / lag[0] < APART
            else "a rate was taken for a time, or a time for it"
        )
        note(f"lag {name} [s]", lag, -1.0, wrong)
    return found
