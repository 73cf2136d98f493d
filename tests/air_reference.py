"""How the air moves, in any array namespace: the definition that `native/weather.c` is held to.

Mean wind, turbulence, a gust, and the unsteady lift of rotors that sink.
"""

from __future__ import annotations

import math

from quadrl.base.philox import MASK, TURBULENCE, philox
from quadrl.base.rotation import Array, namespace, stack
from quadrl.engines.air import BLOCKS, LOG_TERMS, LOWEST, NOISE, SINE_TERMS, WALK
from quadrl.engines.dynamics import clip

UNIT = math.sqrt(3.0) / 65536.0  # of the sum of four uniform numbers, for a variance of 1
Columns = dict[str, Array]
"""The rows of a table by name, (n,) each."""


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
        t["upward_deviation"] * clip(height * (1 / LOWEST), 0.0, 1.0) * up + 0.0,
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
