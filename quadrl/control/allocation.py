"""Allocation: from thrust and moments to rotor speeds, within the limits of each rotor."""

from __future__ import annotations

import functools

import numpy as np

from quadrl.base.rotation import Array

TINY = 1e-12  # [N]


class Allocation:
    """Distributes thrust and moments, the wrench w, over R rotors: squares = inverse @ w.

    What does not fit between `low` and `high` is cut: yaw first, then thrust, then roll and pitch
    together, in their proportion. Numbers per rotor are kept in units of thrust, x = squares /
    inverse[:, 0], so that the same number for every rotor is thrust without a moment.
    """

    def __init__(self, inverse: Array, low: Array, high: Array) -> None:
        """Take the limits of the rotors.

        Args:
            inverse: (R, 4), a right inverse of the mixer: thrust [N] and moments about x, y, z
                [N m] to squares of the rotor speeds [rad^2/s^2]. Pure thrust turns every rotor.
            low: Smallest squares (R,).
            high: Largest squares (R,); pure thrust that lies between both exists.
        """
        self._unit = inverse[:, 0]  # (R,) squares per newton of thrust
        self._low, self._high = low / self._unit, high / self._unit  # (R,) [N]
        self._moments = moments = inverse[:, 1:] / self._unit[:, None]  # (R, 3) [1/m]
        # (R, R) [N]: by how much rotor j can carry more than rotor i.
        self._room = self._high - self._low[:, None]
        self.thrust = float(self._low.max()), float(self._high.min())
        """Smallest and largest thrust without a moment [N]."""
        self.moment: Array = 1 / np.maximum(self._excess(moments.T), self._excess(-moments.T))
        """(3,) Largest moments about x, y, z, each alone with a thrust that suits it [N m]."""

    def mix(self, wrench: Array) -> Array:
        """Squares of the rotor speeds (N, R) for thrust and moments (N, 4)."""
        tilt = product(self._moments[:, :2], wrench[:, 1:3])
        tilt = tilt / np.maximum(self._excess(tilt), 1.0)[:, None]
        least = (self._low - tilt).max(axis=-1, keepdims=True)
        most = (self._high - tilt).min(axis=-1, keepdims=True)
        carried = tilt + within(wrench[:, :1], least, most)
        yaw = product(self._moments[:, 2:], wrench[:, 3:])
        room = np.where(yaw > 0, self._high - carried, carried - self._low)
        share = ((room + TINY) / np.maximum(np.abs(yaw), TINY)).min(axis=-1, keepdims=True)
        carried = carried + within(share, 0.0, 1.0) * yaw
        return self._unit * within(carried, self._low, self._high)

    def _excess(self, tilt: Array) -> Array:
        """Largest (x_j - x_i) / room_ij over the rotors i and j, (N,), for x (N, R).

        A common thrust t with low <= x / s + t <= high exists if s is at least that.
        """
        share = (tilt[:, None, :] - tilt[:, :, None]) / self._room
        return share.max(axis=(1, 2))


def product(matrix: Array, vector: Array) -> Array:
    """Matrix (m, k) times vectors (N, k), (N, m), with the same bits in row i for every N.

    The order of the additions in BLAS and in NumPy's sum depends on N.
    """
    return functools.reduce(np.add, matrix.T[:, :, None] * vector.T[:, None]).T


def columns(*parts: Array) -> Array:
    """Vectors (N, k) side by side, each component contiguous in memory.

    NumPy's loops then run over the aircraft, not over the components.
    """
    return np.concatenate([part.T for part in parts]).T


def within(value: Array, low: Array | float, high: Array | float) -> Array:
    """A value clipped to limits; NumPy's own clip takes twice as long for N = 1."""
    return np.minimum(np.maximum(value, low), high)
