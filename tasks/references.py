"""References in time: sums of sines, and curves through points in tables of cubic pieces."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from quadrl.base.rotation import Array, namespace, stack
from quadrl.base.trace import look_up
from quadrl.core.snapshot import TaskState
from quadrl.engines.state import State

AXES, WAVES = 3, 2  # sines in each coordinate
PIECE = 0.02  # [s], length of a piece of a table


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
    count: int  # pieces of a track; in the last one it stands still
    turns: np.ndarray | None  # (count, 4) [rad/s^k], of a heading other than east; None for east

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

    def headed(self, quaternion: Array) -> Array:
        """Attitudes (N, 4), turned to the left by the heading of the reference at first."""
        if self.turns is None:
            return quaternion
        w, x, y, z = (quaternion[..., k] for k in range(4))
        heading, xp = self.heading(0 * w), namespace(w)
        cosine, sine = xp.cos(heading / 2), xp.sin(heading / 2)
        turned = cosine * w - sine * z, cosine * x - sine * y, cosine * y + sine * x
        return stack(*turned, cosine * z + sine * w)

    def off(self, state: State, time: Array) -> tuple[Array, Array]:
        """Sine and cosine (N,) of the angle from the heading of the reference to an aircraft's."""
        sine, cosine = state.sin_attitude[..., 2], state.cos_attitude[..., 2]
        if self.turns is None:
            return sine, cosine
        asked, xp = self.heading(time), namespace(time)
        east, north = xp.cos(asked), xp.sin(asked)
        return sine * east - cosine * north, cosine * east + sine * north

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


def pieces(
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
