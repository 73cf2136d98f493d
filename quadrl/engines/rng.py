"""Keyed random numbers: any number of any stream, the same for one aircraft and for a batch.

Row i of a batch with seed s has the key s + i, whatever its neighbours and the threads do, and
no generator has a state to save. NumPy uses the C of `native/random.c`;
`quadrl.base.philox` draws the same numbers in every array namespace.
"""

from __future__ import annotations

import math

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.base.philox import START, uniform_array_api
from quadrl.base.rotation import Array, namespace, quaternion_from_heading_and_tilt, stack
from quadrl.engines import native
from quadrl.engines.state import Start

FULL_TURN = 2 * math.pi
ADVANCE = 16
"""Numbers that are drawn at once: about as many as a start takes."""


def uniform(keys: Array, episodes: Array, stream: int, first: int, count: int) -> Array:
    """Numbers first..first+count-1 of streams, uniform in [0, 1), a multiple of 2^-32 each.

    Args:
        keys: Keys (n,) int64 of the rows.
        episodes: Numbers (n,) int64 of the episodes.
        stream: Which stream of the episodes.
        first: Index of the first number.
        count: How many numbers.

    Returns:
        (n, count) float64.
    """
    if isinstance(keys, np.ndarray):
        words = np.array((keys, episodes), dtype=np.int64)
        out = np.empty((len(keys), count))
        if out.size:
            keys, values = native.address(words), native.address(out)
            episodes = keys + words.strides[0]
            native.library().quadrl_uniform(
                words.shape[1], keys, episodes, stream, first, count, values
            )
        return out
    return uniform_array_api(keys, episodes, stream, first, count)


def normal(keys: Array, episodes: Array, steps: Array, stream: int, count: int) -> np.ndarray:
    """Nearly normal numbers of a control step, of mean 0 and variance 1, between -3.5 and 3.5.

    Args:
        keys: Keys (n,) int64 of the rows.
        episodes: Numbers (n,) int64 of the episodes.
        steps: Control steps (n,) int64 since the start of the episodes.
        stream: Which stream of the episodes.
        count: How many numbers.

    Returns:
        (n, count) float64.
    """
    words, out = np.array((keys, episodes, steps), dtype=np.int64), np.empty((len(keys), count))
    places = (native.address(words) + k * words.strides[0] for k in range(3))
    native.library().quadrl_normal(len(keys), *places, stream, count, native.address(out))
    return out


class Rng:
    """A stream of random numbers for the episodes of n rows, taken in order."""

    def __init__(self, keys: Array, episodes: Array, stream: int = START) -> None:
        """Begin the stream.

        Args:
            keys: Keys (n,) int64 of the rows.
            episodes: Numbers (n,) int64 of the episodes.
            stream: Which stream: START, PARAMETERS, ...
        """
        self._keys, self._episodes, self._stream = keys, episodes, stream
        self._drawn: Array = None  # (n, k) numbers of the stream from `_first` on
        self._first = self._end = self._used = 0

    def stream(self, number: int) -> Rng:
        """Another stream of the same episodes, or the same one again, from its first number on."""
        return Rng(self._keys, self._episodes, number)

    def uniform(self, low: float, high: float, size: int | None = None) -> Array:
        """Uniform numbers in [low, high): (n,), or (n, size)."""
        count = 1 if size is None else size
        if self._used + count > self._end:  # several at once, since a call's cost is nearly fixed
            self._first, self._end = self._used, self._used + max(count, ADVANCE)
            many = self._end - self._first
            self._drawn = uniform(self._keys, self._episodes, self._stream, self._first, many)
        at = self._used - self._first
        self._used += count
        return low + (high - low) * self._drawn[..., at if size is None else slice(at, at + count)]

    def direction(self) -> Array:
        """Unit vectors (n, 3), evenly over the sphere."""
        height = self.uniform(-1.0, 1.0)
        heading = self.uniform(0.0, FULL_TURN)
        xp = namespace(height)
        level = xp.sqrt(1 - height * height)
        return stack(level * xp.cos(heading), level * xp.sin(heading), height)

    def level_direction(self) -> Array:
        """Unit vectors (n, 3), evenly around the horizon."""
        bearing = self.uniform(0.0, FULL_TURN)
        xp = namespace(bearing)
        return stack(xp.cos(bearing), xp.sin(bearing), xp.zeros_like(bearing))

    def vector(self, length: float, shortest: float = 0.0) -> Array:
        """Vectors (n, 3) of any direction, their length uniform in [shortest, length)."""
        return self.uniform(shortest, length)[..., None] * self.direction()

    def attitude(self, tilt: float, heading: float = FULL_TURN) -> Array:
        """Unit quaternions (n, 4): a heading up to `heading`, a tilt up to `tilt` [rad]."""
        return quaternion_from_heading_and_tilt(
            heading=self.uniform(0.0, heading),
            tilt=self.uniform(0.0, tilt),
            direction=self.uniform(0.0, FULL_TURN),
        )

    def level_start(
        self, position: Array, parameters: Parameters, velocity: Array | None = None
    ) -> Start:
        """A start at a position: level, any heading, the rotors at hover speed.

        In wind an environment begins one at rest in trim instead (`quadrl.control.trim`).

        Args:
            position: (n, 3) [m], task frame.
            parameters: Parameters of the aircraft.
            velocity: (n, 3) [m/s], world frame; None for at rest.
        """
        xp = namespace(position)
        rest = xp.zeros_like(position)
        return Start(
            position=position,
            quaternion=self.attitude(tilt=0.0),
            velocity=rest if velocity is None else velocity,
            body_rate=rest,
            rotor_speed=hovering(position, parameters),
        )


def hovering(like: Array, parameters: Parameters) -> Array:
    """Hover speeds of the rotors (n, R) [rad/s], for as many rows as another array has."""
    return parameters.rotor.hover_speed + namespace(like).zeros_like(like[..., :1])
