"""What acts on N aircraft in flight: weather, randomization, events, and what the observer keeps.

An environment calls each of its processes at the same moments, in their order, and saves and
restores their arrays under their names.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from quadrl.conditions.sampler import Drawn


class Process(abc.ABC):
    """Acts on N aircraft from their resets on. Its random numbers follow from seed and episode."""

    name: ClassVar[str]
    """Begins the names of its arrays in a saved environment."""

    def begin(self, rows: np.ndarray, keys: np.ndarray, episodes: np.ndarray, drawn: Drawn) -> None:
        """Begin episodes (n,), after the aircraft were placed.

        Args:
            rows: Numbers (n,) of the aircraft.
            keys: Their seeds, (n,) int64.
            episodes: Numbers (n,) int64 of the episodes.
            drawn: What these have drawn from the randomization.
        """
        return

    def act(self) -> None:
        """Act on all aircraft before the physics of a control step."""
        return

    @abc.abstractmethod
    def save(self) -> dict[str, np.ndarray]:
        """Copies of all arrays that the next steps depend on, by name."""

    def fitted(self, saved: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """A saved environment with what `save` did not give when it was saved."""
        return saved

    def check(self, saved: Mapping[str, np.ndarray]) -> None:
        """Refuse arrays of a saved environment, by their whole names, that no flight leads to.

        Names, shapes and kinds are those of `save`.

        Raises:
            QuadrlError: The message names the array.
        """
        return

    @abc.abstractmethod
    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        """Restore what `save` returned."""
