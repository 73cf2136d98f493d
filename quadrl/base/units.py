"""Quantities as text, with two or three digits and a fitting unit."""

from __future__ import annotations

import math
from collections.abc import Sequence

UNITS = {"_rad_s": "rad/s", "_m_s": "m/s", "_deg": "°", "_s": "s"}
"""Units by the end of a metric's name; lengths (`_m`) and shares have their own functions."""

SHARES = ("_rate", "_share", "success_area")
"""Ends of the names of metrics that are shown in percent."""

LENGTHS = (("m", 1.0), ("cm", 1e-2), ("mm", 1e-3), ("µm", 1e-6))
"""Units of length and their sizes [m], the largest first."""


def quantity(name: str, value: object) -> str:
    """A metric as text, with the unit that its name ends in.

    Args:
        name: The metric's name, such as `position_error_m`, `success_rate` or `yaw_rate_rad_s`.
        value: A number in the unit of the name, or None or NaN for no number; anything but a
            float is shown as it is.
    """
    if value is None or value != value:
        return "none"
    if not isinstance(value, float):
        return str(value)
    if name.endswith("_m"):
        return length(value)
    for end, unit in UNITS.items():
        if name.endswith(end):
            return f"{digits(value)} {unit}"
    return percent(value) if name.endswith(SHARES) else digits(value)


def length(metres: float, units: Sequence[tuple[str, float]] = LENGTHS) -> str:
    """A length [m] in the unit that gives two or three digits: µm, mm, cm or m."""
    size = abs(metres)
    # What would be rounded up to the next unit is shown in it: 0.999 mm is 1.0 mm.
    fitting = (unit for unit in units if size >= 0.9995 * unit[1])
    name, unit = next(fitting, units[-1])
    if name == "µm" and 0.0 < size < 0.05 * unit:
        return "under 0.1 µm"
    return f"{digits(metres / unit)} {name}"


def percent(share: float) -> str:
    """A share in percent; only 1 is shown as 100 %, and only 0 as 0 %."""
    if not 0.0 < share < 1.0:
        return f"{100 * share:.0f} %"
    rest = max(1e-9, round(100.0 * min(share, 1.0 - share), 9))
    places = max(0, math.ceil(-math.log10(rest)))
    return f"{100 * share:.{places}f} %"


def digits(value: float) -> str:
    """A number with two digits, or all those before the point; with three decimals at most."""
    if not math.isfinite(value) or value == 0.0:
        return f"{value:g}"
    if abs(value) < 0.0005:
        return "under 0.001"
    places = 1 - math.floor(math.log10(abs(value)))
    return f"{value:,.{min(3, max(0, places))}f}"


def duration(seconds: float) -> str:
    """A time in whole seconds, minutes or hours: 40 s, 12:05 min, 3:20 h."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    small, unit = (whole, "min") if whole < 3600 else (whole // 60, "h")
    return f"{small // 60}:{small % 60:02} {unit}"
