"""Rows of a reference's file: columns by their names and units, as times, places and headings."""

from __future__ import annotations

import math
import re
import reprlib
import warnings
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.validation import MAX_OPTION
from quadrl.tasks.references import AXES, PIECE

# From one row of a file to the next [s], [m/s], [rad/s]; and all of it [s].
LONGEST_GAP, FASTEST, FASTEST_TURN, SHORTEST, LONGEST = 0.5, 20.0, 10.0, 0.1, 3600.0
SURE = 1e-6  # relative tolerance of a limit
DEGREE = 5  # of the splines
# Waypoints without times: largest speed [m/s], acceleration [m/s^2] and turn [rad/s].
LIMITS = 1.0, 3.0, 1.0
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
ANGLE = {"rad": 1.0, "deg": math.pi / 180}
PLACE, QUATERNION, POWERS = "(?:p|pos|position)?[._ ]?", ("qw", "qx", "qy", "qz"), range(8)
COLUMNS = {
    "t": ("t|time|timestamp", TIME),
    "x": (f"{PLACE}x|east", LENGTH),
    "y": (f"{PLACE}y|north", LENGTH),
    "z": (f"{PLACE}z|up|down", LENGTH),
    "yaw": ("yaw", ANGLE),
    **{key: (f"(?:q|quat|quaternion)[._ ]?{key[1]}", {"1": 1.0}) for key in QUATERNION},
    "duration": ("duration", TIME),
    **{f"{k}^{n}": (rf"{k}\^{n}", {"1": 1.0}) for k in (*"xyz", "yaw") for n in POWERS},
}
"""What a column may be called, maybe with a unit behind it, and what each unit is worth."""
# A column that may be the heading or the time is not passed over.
MISTAKEN = {
    "yaw": re.compile(r"(yaw|heading|psi|course|azimuth)(?!.*(rate|dot|vel|acc))"),
    "t": re.compile(r".*(time|stamp|sec|epoch|clock)|d?t[ _\[(]"),
}


def parsed(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) [s], and rows (n, 3 or 4): places [m], and maybe headings from east [rad]."""
    head, *lines = text.splitlines() or [""]
    columns = _columns(head)
    commas = (line.partition("#")[0].rstrip(", ").count(",") for line in lines)
    if max(commas, default=0) > head.count(","):
        raise QuadrlError(f"a row has more numbers than {head} has names")
    with warnings.catch_warnings(action="ignore"):  # there may be no rows
        places = [place for place, _, _ in columns.values()]
        found = np.loadtxt(lines, delimiter=",", usecols=places, ndmin=2)
    worth = [factor for _, factor, _ in columns.values()]
    for k in np.flatnonzero(~(np.abs(found * worth) <= MAX_OPTION).all(axis=1))[:1]:
        allowed = f"finite numbers of up to {MAX_OPTION:g}"
        raise QuadrlError(f"row {k + 1} is {reprlib.repr(found[k].tolist())}", allowed=allowed)
    if len(found) < (least := 5 if "t" in columns else 2 if "x" in columns else 1):
        raise QuadrlError(f"it has {len(found)} rows", allowed=f"{least} rows at least")
    table = dict(zip(columns, (found * worth).T, strict=True))
    if "x^0" in columns:
        return _polynomials(table)
    if "yaw" in columns and columns["yaw"][2] == "yaw":  # without a unit
        _check_radians(table["yaw"])
    elif "yaw" not in columns and table.keys() >= {*QUATERNION}:
        w, x, y, z = (table[key] for key in QUATERNION)
        table["yaw"] = np.arctan2(2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2)
    if "yaw" in table and columns["z"][1] < 0:  # beside "down" it is clockwise from north
        table["yaw"] = math.pi / 2 - table["yaw"]
    rows = np.stack([table[key] for key in (*"xyz", "yaw") if key in table], axis=-1)
    rows[:, AXES:] = np.unwrap(rows[:, AXES:], axis=0)
    if "t" not in columns:
        return _through(rows)
    times, even = table["t"], np.linspace(0.0, table["t"][-1], len(rows))
    rounded = in_thousandths(times) and np.abs(times - even).max() <= 1e-3
    return even if rounded else times, rows


def _columns(head: str) -> dict[str, tuple[int, float, str]]:
    """Where each known column is, what its unit is worth, and its name, from a line of names."""
    names = [name.strip(' "').lower() for name in head.lstrip("# ").split(",")]
    if re.match(r"[-+.\d]", names[0]):
        raise QuadrlError(f"its first line, {head}, has no names")
    found, others = dict[str, tuple[int, float, str]](), list[str]()
    for place, name in enumerate(names):
        for key, (called, units) in COLUMNS.items():
            unit = rf"(?:[_ ]*[_ \[(]({'|'.join(units)})[\])]?)?"
            if match := re.fullmatch(f"(?:{called}){unit}", name):
                if key in found:
                    both = f"its columns {found[key][2]} and {name} are the same"
                    raise QuadrlError(both, allowed="a file with one of them")
                worth = units.get(match[1], 1.0) * (-1.0 if name.startswith("down") else 1.0)
                found[key] = place, worth, name
                break
        else:
            others.append(name)
    needed = (
        [key for key in COLUMNS if key == "duration" or "^" in key] if "x^0" in found else "xyz"
    )
    if missing := [key for key in needed if key not in found]:
        raise QuadrlError(f"it has no column {missing[0]}, but {', '.join(names)}")
    for key in MISTAKEN.keys() - found.keys() if "x^0" not in found else ():
        for name in filter(MISTAKEN[key].match, others):
            called = ", ".join([key, *(f"{key}_{unit}" for unit in COLUMNS[key][1])])
            raise QuadrlError(f"its column {name} is not known", allowed=f"a file with {called}")
    return found


def _check_radians(yaw: np.ndarray) -> None:
    """Refuse a heading that must be in degrees, and warn of one that may be."""
    jump, most = np.flatnonzero(np.abs(np.diff(yaw)) > math.pi), np.abs(yaw).max()
    if len(jump) and most > 2 * math.pi + 0.01:
        k = jump[0]
        reason = f"from row {k + 1} to {k + 2} yaw jumps from {yaw[k]:g} to {yaw[k + 1]:g} rad"
        raise QuadrlError(reason, allowed="radians, or degrees in a column called yaw_deg")
    if most > 4 * math.pi:
        text = f"yaw is read in radians, up to {most:.3g}; call the column yaw_rad or yaw_deg"
        warnings.warn(text, QuadrlWarning, stacklevel=2)


def _polynomials(table: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) [s] and rows (n, 4) along polynomials, each with a duration (pieces,) [s]."""
    durations, ends = table["duration"], np.cumsum(table["duration"])
    for k in np.flatnonzero(durations <= 0)[:1]:
        raise QuadrlError(f"row {k + 1} takes {durations[k]:g} s", allowed="positive durations")
    times = _every_half_piece(ends[-1])
    piece = np.minimum(np.searchsorted(ends, times, side="right"), len(ends) - 1)
    powers = (times - (ends - durations)[piece]) ** np.arange(8)[:, None]
    factors = ([table[f"{k}^{n}"][piece] for n in POWERS] for k in (*"xyz", "yaw"))
    return times, np.stack([(powers * each).sum(axis=0) for each in factors], axis=-1)


def _through(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) [s] and rows (n, 3 or 4) from rest to rest through waypoints, within LIMITS.

    Times between waypoints are as their distances, the curve a spline of the fifth degree.
    """
    from scipy.interpolate import make_interp_spline  # slow to import

    way = np.linalg.norm(np.diff(rows[:, :AXES], axis=0), axis=1)
    for k in np.flatnonzero(way == 0)[:1]:
        raise QuadrlError(f"rows {k + 1} and {k + 2} are one place", allowed="places that differ")
    rest = [(k, np.zeros(rows.shape[1])) for k in (1, 2)]
    along = np.append(0.0, np.cumsum(way))
    curve: Any = make_interp_spline(along, rows, DEGREE, bc_type=(rest, rest))
    fine = np.linspace(0.0, along[-1], 20 * len(rows))
    speed, acceleration = (np.linalg.norm(curve(fine, k)[:, :AXES], axis=1).max() for k in (1, 2))
    turn = np.abs(curve(fine, 1)[:, AXES:]).max(initial=0.0)
    slower = max(speed / LIMITS[0], math.sqrt(acceleration / LIMITS[1]), turn / LIMITS[2])
    times = _every_half_piece(along[-1] * slower)
    return times, curve(times / slower)


def _every_half_piece(end: float) -> np.ndarray:
    if end > LONGEST:
        raise QuadrlError(f"it takes {end:g} s", allowed=f"{LONGEST:g} s long at most")
    return np.append(np.arange(0.0, max(end, PIECE / 2) - PIECE / 4, PIECE / 2), end)


def check(times: np.ndarray, rows: np.ndarray) -> None:
    """Refuse gaps and jumps."""
    if times[0] != 0:
        raise QuadrlError(f"row 1 is at {times[0]:g} s", allowed="from time 0 on")
    step = np.diff(times)
    for k in np.flatnonzero((step <= 0) | (step > LONGEST_GAP * (1 + SURE)))[:1]:
        reason = f"from row {k + 1} to {k + 2} it takes {apart(float(step[k]), LONGEST_GAP)} s"
        raise QuadrlError(reason, allowed=f"times that grow by up to {LONGEST_GAP:g} s")
    if not SHORTEST <= times[-1] <= LONGEST:
        allowed = f"between {SHORTEST:g} and {LONGEST:g} s long"
        raise QuadrlError(f"it takes {times[-1]:g} s", allowed=allowed)
    # Over a piece at least, since the last digits of dense rows are no speed.
    over = max(1, math.ceil(PIECE * len(step) / times[-1] - SURE))
    took, moved = times[over:] - times[:-over], np.abs(rows[over:] - rows[:-over])
    speed = np.linalg.norm(moved[:, :AXES], axis=1) / took
    turn = moved[:, AXES:].sum(axis=1) / took  # 0 without a heading
    for what, limit, unit in ((speed, FASTEST, "m/s"), (turn, FASTEST_TURN, "rad/s")):
        for k in np.flatnonzero(what > limit * (1 + SURE))[:1]:
            reason = f"from {times[k]:g} to {times[k + over]:g} s it goes at "
            reason += f"{apart(float(what[k]), limit)} {unit}"
            raise QuadrlError(reason, allowed=f"at up to {limit:g} {unit}")


def apart(value: float, limit: float) -> str:
    """A number in as many digits as tell it from a limit, three at least."""
    texts = ((f"{value:.{k}g}", f"{limit:.{k}g}") for k in range(3, 17))
    return next((one for one, other in texts if one != other), repr(value))


def in_thousandths(values: np.ndarray) -> bool:
    """Whether numbers have three digits behind the point, to rounding."""
    return bool(np.abs(values * 1e3 - np.round(values * 1e3)).max() < SURE)
