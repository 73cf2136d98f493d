"""How the air moves: mean wind, turbulence, a gust, and the unsteady lift of rotors that sink.

The definition, in any array namespace; `native/weather.c` does the same arithmetic in the same
order. `quadrl/weather.py` says what the weather is, and lets it blow.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadrl.aircraft.vehicle import MAX_ROTORS
from quadrl.base.rotation import Array, namespace, stack
from quadrl.rng import MASK, TURBULENCE, philox

REFERENCE = 6.096  # [m], 20 ft: the height of W20
FOOT = 0.3048  # [m]
LEAST_SPEED = 1.0  # [m/s], with which turbulence is carried past at least
"""Chosen: in weaker wind turbulence would stand still."""
WALK = ("keep", "rate", "first", "across", "second")  # of a filter of second order
FIXED = (
    "shear",  # [m/s], mean wind over ln(h/z0)
    "level_deviation",  # [m/s], of turbulence along the mean wind and to its left
    "upward_deviation",  # [m/s]
    *("along_keep", "along_fresh"),
    *(f"left_{name}" for name in WALK),
    *(f"up_{name}" for name in WALK),
    *("noise_keep", "noise_fresh"),
)
"""What follows from the weather alone."""
DRAWN = ("east", "north", "gust_start", "gust_east", "gust_north")
"""Direction of the mean wind; begin [s] and velocity [m/s] of the gust."""
NOISE = tuple(f"noise_{k}" for k in range(MAX_ROTORS))
FILTERS = ("along", "left", "left_lag", "up", "up_lag", *NOISE)
"""States of the filters, of unit variance."""
ROWS = (*FIXED, *DRAWN, "steps", *FILTERS)
"""Of the table of a process, a column for each aircraft; `steps` counts the control steps."""
Columns = dict[str, Array]
"""The rows of a table by name, (n,) each."""
BLOCKS = 3 + MAX_ROTORS // 2
"""Of four random words, for a step: five numbers of the turbulence, and one for each rotor."""
UNIT = math.sqrt(3.0) / 65536.0
LOG_TERMS, SINE_TERMS = 11, 11
"""Of the series, for an error of some 1e-16."""


def fixed_of(
    wind_speed: Any, roughness: float, altitude: float, timestep: float, noise_time: float
) -> dict[str, Any]:
    """The rows FIXED, numbers or (n,).

    Args:
        wind_speed: W20, a number or (n,) [m/s].
        roughness: z0 [m].
        altitude: Of the task [m], for the turbulence.
        timestep: Of the control [s].
        noise_time: Correlation time of the noise of the lift [s]; 0 for none.
    """
    shear = wind_speed / math.log(REFERENCE / roughness)
    height = min(max(altitude / FOOT, 10.0), 1000.0)  # [ft], where the formulas hold
    spread = 0.177 + 0.000823 * height
    lengths = {"along": height / spread**1.2 * FOOT, "up": height * FOOT}  # [m]
    speed = np.maximum(shear * math.log(max(height * FOOT / roughness, 1)), LEAST_SPEED)
    rows: dict[str, Any] = {"shear": shear, "upward_deviation": 0.1 * wind_speed}
    rows["level_deviation"] = rows["upward_deviation"] / spread**0.4
    rate = speed * timestep / lengths["along"]
    rows["along_keep"] = np.exp(-rate)
    rows["along_fresh"] = np.sqrt(-np.expm1(-2 * rate))
    rows |= _second_order("left", rate)
    rows |= _second_order("up", speed * timestep / lengths["up"])
    noise = timestep / noise_time if noise_time else math.inf
    return rows | {
        "noise_keep": math.exp(-noise),
        "noise_fresh": math.sqrt(-math.expm1(-2 * noise)),
    }


def _second_order(name: str, rate: Any) -> dict[str, Any]:
    """One step of x1' = -x1 + noise, x2' = -x2 + x1 over `rate` time constants.

    Covariances: of x1 1/2, of x1 and x2 1/4, of x2 1/4, before and after each step.
    """
    keep, square = np.exp(-rate), np.exp(-2 * rate)
    q11 = -np.expm1(-2 * rate) / 2
    q12 = (1 - (1 + 2 * rate) * square) / 4
    q22 = (1 - (1 + 2 * rate + 2 * rate**2) * square) / 4
    first = np.sqrt(q11)
    second = np.sqrt(np.maximum(q22 - q12 * q12 / q11, 0.0))
    values = keep, rate, first, q12 / first, second
    return {f"{name}_{part}": value for part, value in zip(WALK, values, strict=True)}


def normals(streams: tuple[Array, Array], steps: Array, first: int, count: int) -> list[Array]:
    """Random numbers `first`.. of some control steps, (n,) each, of mean 0 and variance 1.

    Each is the sum of four uniform ones of 16 bits. Through the filters it is close to Gauss's
    distribution: the wind has a kurtosis of 2.95.

    Args:
        streams: Keys and numbers of the episodes of the rows, (n,) int64.
        steps: (n,) float64, whole.
        first: Even.
        count: How many.
    """
    key, episode = streams
    xp = namespace(steps)
    made: list[Array] = []
    for block in range(first // 2, (first + count + 1) // 2):
        at = xp.astype(steps, xp.int64) * BLOCKS + block
        counter = (at & MASK, xp.zeros_like(key) + TURBULENCE, episode & MASK, episode >> 32 & MASK)
        words = philox(counter, (key & MASK, key >> 32 & MASK))
        for one, other in (words[:2], words[2:]):
            halves = (one & 0xFFFF) + (one >> 16) + (other & 0xFFFF) + (other >> 16)
            made.append(xp.astype(halves + (2 - 131072), xp.float64) * UNIT)
    return made[:count]


def begun(t: Columns, streams: tuple[Array, Array], rotors: int) -> Columns:
    """The rows with which episodes begin: filters as they are at any time."""
    n = normals(streams, 0.0 * t["shear"], 0, 5)
    half, eighth = math.sqrt(0.5), math.sqrt(0.125)
    t = t | {"steps": 0.0 * t["shear"], "along": n[0]}
    t |= {"left": half * n[1], "left_lag": eighth * (n[1] + n[2])}
    t |= {"up": half * n[3], "up_lag": eighth * (n[3] + n[4])}
    return t | dict(zip(NOISE, normals(streams, t["steps"], 6, rotors), strict=False))


def advanced(t: Columns, streams: tuple[Array, Array], rotors: int) -> Columns:
    """The rows after a control step.

    Args:
        t: The rows.
        streams: Keys and numbers of the episodes of the rows, (n,) int64.
        rotors: How many have a noise of their lift; 0 for none.
    """
    t = t | {"steps": t["steps"] + 1.0}
    n = normals(streams, t["steps"], 0, 5)
    t |= {"along": t["along_keep"] * t["along"] + t["along_fresh"] * n[0]}
    for name, one, other in (("left", n[1], n[2]), ("up", n[3], n[4])):
        keep, rate, first, across, second = (t[f"{name}_{part}"] for part in WALK)
        now, lag = t[name], t[f"{name}_lag"]
        t |= {
            name: keep * now + first * one,
            f"{name}_lag": keep * (lag + rate * now) + (across * one + second * other),
        }
    fresh = normals(streams, t["steps"], 6, rotors)
    return t | {
        name: t["noise_keep"] * t[name] + t["noise_fresh"] * number
        for name, number in zip(NOISE, fresh, strict=False)
    }


def blowing(
    t: Columns, height: Array, per_roughness: float, timestep: float, per_gust_time: float
) -> Array:
    """The wind (n, 3) [m/s], world frame.

    Args:
        t: The rows.
        height: (n,) [m], above the ground.
        per_roughness: 1/z0 [1/m].
        timestep: Of the control [s].
        per_gust_time: [1/s].
    """
    root = math.sqrt(3.0)
    left, up = (root * t[name] + (1 - root) * t[f"{name}_lag"] for name in ("left", "up"))
    along = t["shear"] * logarithm(height * per_roughness)
    along = along + t["level_deviation"] * t["along"]
    left = t["level_deviation"] * left
    share = (t["steps"] * timestep - t["gust_start"]) * per_gust_time
    pulse = half_wave(share)
    pulse = pulse * pulse  # (1 - cos) / 2 of the double angle
    # Plus zero, so that no zero is negative.
    return stack(
        t["east"] * along - t["north"] * left + t["gust_east"] * pulse + 0.0,
        t["north"] * along + t["east"] * left + t["gust_north"] * pulse + 0.0,
        t["upward_deviation"] * up + 0.0,
    )


def logarithm(x: Array) -> Array:
    """ln(max(x, 1)) to 1e-15, by operations that IEEE 754 rounds exactly."""
    xp = namespace(x)
    one = 0.0 * x + 1.0
    part, power = xp.frexp(xp.where(x > 1.0, x, one))
    low = part < math.sqrt(0.5)
    part, power = xp.where(low, 2.0 * part, part), power - xp.where(low, one, 0.0 * one)
    ratio = (part - 1.0) / (part + 1.0)
    square, total = ratio * ratio, 0.0
    for k in reversed(range(LOG_TERMS)):
        total = 1.0 / (2 * k + 1) + square * total
    return power * math.log(2.0) + 2.0 * ratio * total


def half_wave(share: Array) -> Array:
    """sin(pi share) for a share between 0 and 1, else 0; to 1e-15, as `logarithm`."""
    xp = namespace(share)
    nearer = xp.where(share < 1.0 - share, share, 1.0 - share)
    angle = math.pi * xp.where(nearer > 0.0, nearer, 0.0 * share)
    square, total = angle * angle, 1.0
    for k in reversed(range(1, SINE_TERMS)):
        total = 1.0 - square * (1.0 / (2 * k * (2 * k + 1))) * total
    return angle * total


def c_weather() -> str:
    """The rows of a table and the constants, in C."""
    rows = ", ".join(f"WEATHER_{name.upper()}" for name in ROWS)
    return (
        f"enum {{ {rows}, WEATHER_ROWS }};\n"
        f"enum {{ TURBULENCE = {TURBULENCE}, BLOCKS = {BLOCKS}, LOG_TERMS = {LOG_TERMS}, "
        f"SINE_TERMS = {SINE_TERMS} }};\n"
        f"#define NORMAL_UNIT {UNIT.hex()}\n"
    )
