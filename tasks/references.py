"""References in time: sums of sines, and curves through points in tables of cubic pieces."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, namespace, stack
from quadrl.base.trace import look_up
from quadrl.base.validation import choice
from quadrl.core.snapshot import TaskState

AXES, WAVES = 3, 2  # sines in each coordinate
SINES = {
    # SimpleFlight: 2 m x 1 m, begun in the crossing, where it is fastest.
    "lemniscate": (5.5, ((1.0, 1, math.pi), (0.5, 2, math.pi), (0.0, 1, 0.0))),
    # crazyflow: east and up.
    "vertical": (10.0, ((1.0, 1, 0.0), (0.0, 1, 0.0), (0.5, 2, 0.0))),
}
"""Figures of one sine in each coordinate: the usual period [s]; amplitude [m], turns in a period,
and phase [rad] of each."""
FIGURES = ("random", *SINES, "zigzag", "pentagram", "polynomial")
PIECE = 0.02  # [s], length of a piece of a table
TRACKS, SEED = 32, 0  # curves of a figure that is drawn once and for all
LONGEST_GAP, FASTEST = 0.5, 20.0  # [s], [m/s], from one row of a file to the next
FILE = "a csv file: a line of names, then at least 4 rows of time [s], x, y, z [m], maybe yaw [rad]"


@dataclasses.dataclass(frozen=True)
class Sines(TaskState):
    """A sum of sines in each coordinate."""

    amplitude: Array  # (N, AXES * WAVES) [m]
    frequency: Array  # (N, AXES * WAVES) [rad/s]
    phase: Array  # (N, AXES * WAVES) [rad]


@dataclasses.dataclass(frozen=True)
class Reference(Sines):
    """The reference of an episode; `goal` is the middle of its figure."""

    track: Array  # (N,), which curve of the table


@dataclasses.dataclass(frozen=True)
class Table:
    """Curves in cubic pieces of PIECE seconds; a sum of sines needs none, and has a single one."""

    pieces: np.ndarray  # (tracks * count, 4, AXES) [m/s^k], factors of t^0 to t^3; read-only
    count: int = 1  # pieces of a track; in the last one it stands still
    turns: np.ndarray | None = None  # (count, 4) [rad/s^k], of a heading other than east

    @classmethod
    def of(cls, figure: str, seconds: float, name: str) -> Table:
        """Make the curves of a figure, or the one of a csv file.

        Args:
            figure: One of FIGURES, or a path.
            seconds: For which it is flown.
            name: What a refusal calls the figure.

        Raises:
            QuadrlError: There is no such figure or file, or the file has a gap or a jump.
        """
        pieces, count, turns = np.zeros((1, 4, AXES)), 1, None
        if figure in ("zigzag", "pentagram"):
            points = _drawn(1.0, 1.5, 0.0, seconds) if figure == "zigzag" else _star(seconds)
            pieces, count = _pieces(*points, 1, seconds)
        elif figure == "polynomial":
            pieces, count = _pieces(*_drawn(1.5, 4.0, 0.5, seconds), 5, seconds)
        elif figure not in FIGURES:
            if not figure.endswith(".csv"):
                choice(name, figure, [*FIGURES, "the path of a .csv file"])
            times, rows = _read(name, figure)
            pieces, count = _pieces(times, rows[..., :AXES], 3, seconds)
            if rows.shape[-1] > AXES:
                turns = _pieces(times, np.unwrap(rows[..., AXES:], axis=1), 3, seconds)[0][..., 0]
                turns.flags.writeable = False
        pieces.flags.writeable = False
        return cls(pieces, count, turns)

    def at(self, reference: Reference, time: Array, order: int = 0) -> Array:
        """References at times (N,) [s], or derivatives of an order to 3, (N, 3) [m/s^order]."""
        if self.count == 1:
            xp = namespace(time)
            angle = reference.frequency * time[..., None] + reference.phase
            size = reference.amplitude
            for _ in range(order):
                size = size * reference.frequency
            waves = size * (xp.cos(angle) if order % 2 else xp.sin(angle))
            waves = -waves if order > 1 else waves
            value = by_axis(waves)
            return value if order else reference.goal + value
        return self._polynomial(self.pieces, reference.track * self.count, time, order)

    def heading(self, time: Array) -> Array:
        """Heading of the reference at times (N,) [rad], from east."""
        if self.turns is None:
            return 0 * time
        return self._polynomial(self.turns[..., None], 0 * time, time)[..., 0]

    def _polynomial(self, pieces: np.ndarray, first: Array, time: Array, order: int = 0) -> Array:
        """Derivatives (N, k) of pieces (n, 4, k), of a track that begins with some piece (N,)."""
        xp, last = namespace(time), self.count - 1
        step = xp.floor(time / PIECE)
        step = xp.where(step < last, step, 0 * step + last)
        piece = look_up(pieces, first + step)
        since, value = (time - PIECE * step)[..., None], 0 * piece[..., 0, :]
        for k in range(3, order - 1, -1):
            value = value * since + math.perm(k, order) * piece[..., k, :]
        return value


def by_axis(waves: Array) -> Array:
    """Sum the sines of each axis: (N, AXES * WAVES) to (N, AXES)."""
    return stack(*(waves[..., k] + waves[..., k + 1] for k in range(0, AXES * WAVES, WAVES)))


def sines(figure: str, period: float, zero: Array) -> tuple[Array, Array, Array]:
    """Amplitude, frequency and phase of a figure, none for one of a table; for zeros (N,)."""
    waves = SINES[figure][1] if figure in SINES else ((0.0, 1, 0.0),) * AXES
    turn = math.tau / period  # [rad/s]
    pairs = (((size, turns * turn, phase), (0.0, turn, 0.0)) for size, turns, phase in waves)
    rows = zip(*(wave for pair in pairs for wave in pair), strict=True)
    amplitude, frequency, phase = (stack(*(zero + x for x in row)) for row in rows)
    return amplitude, frequency, phase


def _pieces(
    times: np.ndarray, points: np.ndarray, degree: int, seconds: float
) -> tuple[np.ndarray, int]:
    """Splines of a degree through points (tracks, n, k) at times (tracks, n) [s]."""
    from scipy.interpolate import make_interp_spline  # slow to import

    count, tracks = math.ceil(seconds / PIECE) + 1, list[np.ndarray]()
    axes = points.shape[-1]
    rest = [(1, np.zeros(axes)), (2, np.zeros(axes))]
    for when, where in zip(times, points, strict=True):
        ends = (rest, rest) if degree > 3 else None
        curve: Any = make_interp_spline(when, where, degree, bc_type=ends)
        at, pieces = np.arange(count) * PIECE, np.zeros((count, 4, axes))
        for k in range(min(degree, 3) + 1):
            slope: Any = curve.derivative(k) if k else curve
            pieces[:, k] = slope(np.minimum(at, when[-1])) / math.factorial(k)
        pieces[at > when[-1] - PIECE / 2, 1:] = 0.0
        pieces[-1, 1:] = 0.0
        tracks.append(pieces)
    return np.concatenate(tracks), count


def _drawn(
    shortest: float, longest: float, height: float, seconds: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points within 1 m east and north and a height up, with legs of some duration [s]."""
    draw, count = np.random.default_rng(SEED), math.ceil(seconds / shortest) + 6
    # In whole pieces: a corner is where two of them meet.
    shape = TRACKS, count
    steps = draw.integers(round(shortest / PIECE), round(longest / PIECE), shape, endpoint=True)
    times = PIECE * np.cumsum(steps, axis=1)
    return times - times[:, :1], draw.uniform(-1, 1, (*shape, AXES)) * [1.0, 1.0, height]


def _star(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """SimpleFlight's pentagram, within 0.7 m, at 1 m/s, again and again."""
    leg = PIECE * round(2 * 0.7 * math.sin(math.tau / 5) / PIECE)  # whole pieces
    corner = np.arange(math.ceil(seconds / leg) + 2)
    angle = math.pi / 2 + 2 * math.tau / 5 * corner
    points = 0.7 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return leg * corner[None], points[None]


def _read(name: str, path: str) -> tuple[np.ndarray, np.ndarray]:
    try:
        rows = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    except (OSError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise QuadrlError(reason, name=name, value=path, allowed=FILE) from error
    whole = rows.shape[1] in (4, 5) and len(rows) >= 4 and np.isfinite(rows).all()
    if not whole or rows[0, 0] != 0:
        reason = f"it has {len(rows)} rows of {rows.shape[1]} numbers"
        allowed = f"{FILE}, finite and from time 0 on"
        raise QuadrlError(reason, name=name, value=path, allowed=allowed)
    step = np.diff(rows[:, 0])
    speed = np.linalg.norm(np.diff(rows[:, 1:4], axis=0), axis=1) / np.maximum(step, 1e-9)
    wrong = (step <= 0) | (step > LONGEST_GAP) | (speed > FASTEST)
    for k in np.flatnonzero(wrong)[:1]:
        reason = f"from row {k + 1} to {k + 2} it takes {step[k]:.3g} s at {speed[k]:.3g} m/s"
        allowed = f"steps of up to {LONGEST_GAP:g} s at up to {FASTEST:g} m/s"
        raise QuadrlError(reason, name=name, value=path, allowed=allowed)
    return rows[None, :, 0], rows[None, :, 1:]
