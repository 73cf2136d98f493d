"""References from files: columns by their names, smoothed, and kept as they fly."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.records import tuples
from quadrl.base.validation import choice, number, numbers, record
from quadrl.tasks.reference_rows import DEGREE, LONGEST, SHORTEST, check, in_thousandths, parsed
from quadrl.tasks.references import AXES, PIECE

# [m]: tolerance where the digits of a file are finer; the least; from when a distance is told.
FINE, FINEST, TOLD = 1e-4, 1e-6, 1e-3
# The deviation that noise may leave in the acceleration [m/s^2]; the widest band at first [rad/s].
QUIET, WIDEST = 0.005, 40.0
LOOSE, BETTER = 1.25, 0.7  # of the tolerance: near enough; of the distance before: worth a band
FILE = "a csv file: a line of names such as t,x,y,z,yaw (or x,y,z), then rows of numbers"


@dataclasses.dataclass(frozen=True)
class Recorded:
    """The curve of a file, as it flies: a spline of the fifth degree with even knots."""

    file: str  # its path, as it was given
    digest: str  # of the file
    tolerance: float  # [m], what was asked for; 0 for that of its digits
    seconds: float  # [s], when it ends
    spacing: float  # [s], between knots
    # Of the B-splines: x, y, z [m], and the heading from east [rad] where there is one.
    coefficients: tuple[tuple[float, ...], ...] = dataclasses.field(repr=False)

    def __post_init__(self) -> None:
        """Validate it, since the file that holds it may have been edited."""
        number("tolerance", self.tolerance, 0)
        number("seconds", self.seconds, SHORTEST, LONGEST)
        number("spacing", self.spacing, PIECE, LONGEST)
        sizes = {len(numbers("coefficients", row)) for row in self.coefficients}
        count = int(self.seconds / self.spacing) + 1 + DEGREE
        if len(self.coefficients) != count or sizes not in ({AXES}, {AXES + 1}):
            allowed = f"{count} rows of {AXES} or {AXES + 1} numbers"
            raise QuadrlError(name="coefficients", value=self.coefficients, allowed=allowed)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) [s] between pieces of a table, and points (n, 3 or 4) there."""
        from scipy.interpolate import BSpline  # slow to import

        whole = math.ceil(self.seconds / PIECE - 0.01)
        times = np.append(PIECE * np.arange(whole), self.seconds)
        knots = _knots(self.spacing, len(self.coefficients) - DEGREE)
        return times, np.asarray(BSpline(knots, np.array(self.coefficients), DEGREE)(times))


def recorded(name: str, given: Any, figures: tuple[str, ...], tolerance: float) -> Any:
    """The name of a figure as it is, or the curve of a file, of a record, or of its JSON.

    Raises:
        QuadrlError: It is none of these, or no reference; `name` is what it is called.
    """
    if isinstance(given, Mapping):
        try:
            given = record(name, tuples(dict(given)), Recorded)
            path = Path(given.file)
        except (TypeError, QuadrlError) as error:
            allowed = "as quadrl wrote it; name the csv file instead"
            raise QuadrlError(str(error), name=name, value="a record", allowed=allowed) from error
        if path.is_file() and _digest(path.read_bytes()) != given.digest:
            text = f"{name}: {path} is not the file whose curve is flown, which was recorded"
            warnings.warn(f"{text}; figure={path} takes the present one", QuadrlWarning, 2)
    elif isinstance(given, str) and given.endswith(".csv"):
        given = read(name, given, tolerance)
    elif not isinstance(given, Recorded):
        choice(name, given, [*figures, "the path of a .csv file"])
    if tolerance != (had := getattr(given, "tolerance", 0.0)):
        allowed = f"{had:g}, or with a csv file, which is named again"
        raise QuadrlError(name=f"{name}_tolerance", value=tolerance, allowed=allowed)
    return given


def read(name: str, path: str, tolerance: float) -> Recorded:
    """Read a csv file, for the arguments of `recorded`.

    Raises:
        QuadrlError: There is no such file, or its columns or numbers are no reference.
    """
    number(f"{name}_tolerance", tolerance, 0, 1)
    try:
        if not Path(path).is_file():  # reading a pipe would wait for ever
            raise OSError("there is no such file")
        whole = Path(path).read_bytes()
        times, rows = parsed(whole.decode("utf-8-sig"))
        check(times, rows)
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", "") or str(error).partition("\n")[0]
        allowed = getattr(error, "allowed", "") or FILE
        raise QuadrlError(reason, name=name, value=path, allowed=allowed) from error
    asked = max(tolerance, FINEST) if tolerance else _rounding(rows[:, :AXES])
    spacing, coefficients, passed = smoothed(times, rows, asked)
    if (off := _distance(passed - rows)) > max(LOOSE * asked, TOLD):
        text = f"{name}: the curve passes the rows of {path} at {1e3 * off:.2g} mm (root mean "
        text += f"square): they are noisy or have corners; figure_tolerance={off:.2g} says so"
        warnings.warn(text, QuadrlWarning, stacklevel=2)
    rounded = tuple(map(tuple, np.round(coefficients, 8).tolist()))
    return Recorded(path, _digest(whole), tolerance, float(times[-1]), spacing, rounded)


def smoothed(
    times: np.ndarray, rows: np.ndarray, tolerance: float
) -> tuple[float, np.ndarray, np.ndarray]:
    """Smooth rows (n, 3 or 4) at times (n,) [s] by a spline with a small fifth derivative.

    A spline through all rows would differentiate their noise. This one follows what changes within
    a band [rad/s], in which noise of a deviation s, in rows every h seconds, leaves an acceleration
    of s sqrt(h band^5 / (5 pi)). The band begins where that is QUIET, and grows until the rows are
    near enough, or come no nearer, since what is left is noise.

    Returns:
        The time between knots [s], coefficients (m, 3 or 4), and the curve (n, 3 or 4).
    """
    from scipy.interpolate import BSpline  # slow to import
    from scipy.sparse import diags_array, eye_array
    from scipy.sparse.linalg import spsolve

    step, nearest, best = times[-1] / (len(times) - 1), math.inf, (0.0, rows, rows)
    band = min(WIDEST, (5 * math.pi * AXES * (QUIET / tolerance) ** 2 / step) ** 0.2)
    while True:
        spacing = PIECE * max(1, int(2 / band / PIECE))
        count = int(times[-1] / spacing) + 1
        basis = BSpline.design_matrix(times, _knots(spacing, count), DEGREE)
        # Between two knots the derivative is a difference of coefficients, but for its unit.
        factors = [(-1.0) ** k * math.comb(DEGREE, k) for k in range(DEGREE + 1)]
        shape = count, count + DEGREE
        change: Any = diags_array(factors, offsets=[*range(DEGREE + 1)], shape=shape)  # type: ignore
        weight = spacing / step * (spacing * band) ** (-2 * DEGREE)
        # A little of the coefficients themselves, where a few rows leave more than one curve.
        little = 1e-12 * eye_array(count + DEGREE)
        normal = basis.T @ basis + weight * change.T @ change + little
        found: Any = spsolve(normal.tocsc(), basis.T @ rows)
        off = _distance(basis @ found - rows)
        if not off < BETTER * nearest:
            return best
        nearest, best = off, (spacing, found, basis @ found)
        if off <= LOOSE * tolerance:
            return best
        band *= 1.5


def _knots(spacing: float, count: int) -> np.ndarray:
    return spacing * np.arange(-DEGREE, count + DEGREE + 1)


def _distance(off: np.ndarray) -> float:
    """Root mean square of offsets (n, 3 or 4) in space [m]."""
    return math.sqrt((off[:, :AXES] ** 2).sum(axis=1).mean())


def _digest(whole: bytes) -> str:
    return hashlib.sha256(whole).hexdigest()[:16]


def _rounding(places: np.ndarray) -> float:
    """Root mean square of what rounding to millimetres takes away [m], or FINE with more digits."""
    varying = np.count_nonzero(np.ptp(places, axis=0))
    return max(FINE, 1e-3 * math.sqrt(varying / 12)) if in_thousandths(places) else FINE
