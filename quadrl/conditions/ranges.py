"""Numbers that episodes draw, each evenly within a range of its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from quadrl.base.rotation import Array

CORNER = "corner"
"""Name of the flag, 1 or 0, of the episodes in the share `Randomization.corners`."""
UPPER = 0.75  # share of a range where its corner begins
ROUNDING = 1e-9


class Ranges:
    """Named ranges of numbers, and the numbers (n, k) that episodes draw from them."""

    def __init__(
        self,
        ends: Mapping[str, tuple[float, float]],
        whole: Mapping[str, tuple[tuple[float, ...], float]],
        corners: float,
    ) -> None:
        """Lay out the numbers.

        Args:
            ends: Lowest and highest number by name; among them CORNER, lag and command_delay.
            whole: Fewest and most steps, and the length of a step, of those in whole steps.
            corners: Share of the episodes that draw lag and command_delay from the upper quarter.
        """
        self.names = tuple(ends)
        """Names of the drawn numbers. All are drawn, so that no range affects the other numbers."""
        self._whole = [(self.names.index(name), *given) for name, given in whole.items()]
        self._corners_share = corners
        self.low, self._high = np.array([*ends.values()]).T
        self._width = self._high - self.low
        self.spread = np.flatnonzero(self._width)
        """Indices of those that differ between aircraft."""

    def sample(self, shares: Array) -> Array:
        """Numbers (n, k), a column for each of `names`, from shares in [0, 1) of the ranges."""
        corner = self.columns(shares, CORNER) < self._corners_share
        if corner.any():
            shares = shares.copy()
            for name in ("lag", "command_delay"):
                share = self.columns(shares, name)
                share[:] = np.where(corner, UPPER + (1 - UPPER) * share, share)
        drawn = self.low + self._width * shares
        self.columns(drawn, CORNER)[:] = corner
        for k, (fewest, most), unit in self._whole:
            drawn[:, k] = (fewest + np.floor((most - fewest + 1) * shares[:, k])) * unit
        return drawn

    def contains(self, drawn: Array) -> bool:
        """Whether numbers (n, k) lie in their ranges."""
        room = ROUNDING * np.maximum(np.abs(self.low), np.abs(self._high))
        return bool(((drawn >= self.low - room) & (drawn <= self._high + room)).all())

    def columns(self, drawn: Array, name: str, count: int = 1) -> Array:
        """Columns (n, count) of drawn numbers, from the one of a name on."""
        first = self.names.index(name)
        return drawn[:, first : first + count]

    def scaled(self, drawn: Array) -> Array:
        """The numbers that differ (n, d), scaled to -1 at the lowest and 1 at the highest."""
        low, width = self.low[self.spread], self._width[self.spread]
        return 2 * (drawn[:, self.spread] - low) / width - 1

    def at(self, count: int, **columns: Any) -> Array:
        """Numbers (count, k): the given columns, each from a name on, and the lowest elsewhere."""
        drawn = np.tile(self.low, (count, 1))
        for name, values in columns.items():
            self.columns(drawn, name, np.atleast_1d(values).shape[-1])[:] = values
        return drawn
