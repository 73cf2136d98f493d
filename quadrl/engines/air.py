"""Coefficients of the air's motion: mean wind, turbulence, a gust, and unsteady lift of rotors.

`native/weather.c` computes the motion itself; `quadrl/conditions/weather.py` has the parameters of
the weather and runs it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadrl.aircraft.vehicle import MAX_ROTORS
from quadrl.base.philox import TURBULENCE

REFERENCE = 6.096  # [m], 20 ft: the height of W20
FOOT = 0.3048  # [m]
LOWEST = 10 * FOOT
"""Lowest height for which the standard gives the turbulence [m]. Below it upward gusts fade in
proportion to the height, since no air blows through the ground (the law of the wall)."""
LEAST_SPEED = 1.0
"""Smallest speed [m/s] at which turbulence is carried past (chosen); in calm air it would stand
still."""
WALK = ("keep", "rate", "first", "across", "second")
"""Coefficients of a second-order filter."""
FIXED = (
    "shear",  # [m/s], mean wind over ln(h/z0)
    "level_deviation",  # [m/s], of turbulence along the mean wind and to its left
    "upward_deviation",  # [m/s], at LOWEST and above
    *("along_keep", "along_fresh"),
    *(f"left_{name}" for name in WALK),
    *(f"up_{name}" for name in WALK),
    *("noise_keep", "noise_fresh"),
)
"""Quantities that follow from the weather alone."""
DRAWN = ("east", "north", "gust_start", "gust_east", "gust_north")
"""Direction of the mean wind; start [s] and velocity [m/s] of the gust."""
NOISE = tuple(f"noise_{k}" for k in range(MAX_ROTORS))
FILTERS = ("along", "left", "left_lag", "up", "up_lag", *NOISE)
"""States of the filters, of unit variance."""
ROWS = (*FIXED, *DRAWN, "steps", *FILTERS)
"""Rows of the table of a `WeatherProcess`, which has a column for each aircraft; `steps` counts the
control steps."""
BLOCKS = 3 + MAX_ROTORS // 2
"""Blocks of four random words that a step takes: for five normal numbers of the turbulence, and one
for each rotor."""
LOG_TERMS, SINE_TERMS = 11, 11
"""Terms of the series, for an error of some 1e-16."""


def fixed_of(
    wind_speed: Any,
    roughness: float,
    altitude: float,
    timestep: float,
    noise_time: float,
    turbulence: float = 1.0,
) -> dict[str, Any]:
    """Compute the rows FIXED, numbers or (n,).

    Args:
        wind_speed: W20, a number or (n,) [m/s].
        roughness: z0 [m].
        altitude: Altitude of the task [m], for the turbulence.
        timestep: Control timestep [s].
        noise_time: Correlation time of the noise of the lift [s]; 0 for none.
        turbulence: Its deviation over the standard's.
    """
    shear = wind_speed / math.log(REFERENCE / roughness)
    height = min(max(altitude / FOOT, 10.0), 1000.0)  # [ft], where the formulas hold
    spread = 0.177 + 0.000823 * height
    lengths = {"along": height / spread**1.2 * FOOT, "up": height * FOOT}  # [m]
    speed = np.maximum(shear * math.log(max(height * FOOT / roughness, 1)), LEAST_SPEED)
    rows: dict[str, Any] = {"shear": shear, "upward_deviation": 0.1 * wind_speed * turbulence}
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


def mean_wind(wind_speed: Any, roughness: float, height: Any) -> Any:
    """The mean wind [m/s] at a height [m], numbers or (n,); W20 and z0 as in `fixed_of`."""
    shear = wind_speed / math.log(REFERENCE / roughness)
    return shear * np.log(np.maximum(height / roughness, 1.0))


def _second_order(name: str, rate: Any) -> dict[str, Any]:
    """Coefficients of a step of x1' = -x1 + noise, x2' = -x2 + x1 over `rate` time constants.

    The covariances of x1, of x1 and x2, and of x2 are 1/2, 1/4 and 1/4 before and after each step.
    """
    keep, square = np.exp(-rate), np.exp(-2 * rate)
    q11 = -np.expm1(-2 * rate) / 2
    q12 = (1 - (1 + 2 * rate) * square) / 4
    q22 = (1 - (1 + 2 * rate + 2 * rate**2) * square) / 4
    first = np.sqrt(q11)
    second = np.sqrt(np.maximum(q22 - q12 * q12 / q11, 0.0))
    values = keep, rate, first, q12 / first, second
    return {f"{name}_{part}": value for part, value in zip(WALK, values, strict=True)}


def c_weather() -> str:
    """The rows of a table and the constants, in C."""
    rows = ", ".join(f"WEATHER_{name.upper()}" for name in ROWS)
    return (
        f"enum {{ {rows}, WEATHER_ROWS }};\n"
        f"enum {{ TURBULENCE = {TURBULENCE}, BLOCKS = {BLOCKS}, LOG_TERMS = {LOG_TERMS}, "
        f"SINE_TERMS = {SINE_TERMS} }};\n"
        f"#define PER_LOWEST {(1 / LOWEST).hex()}\n"
    )
