"""Keyed random numbers: any number of any stream, the same for one aircraft and for a batch.

Philox4x32-10 (Salmon, Moraes, Dror and Shaw, "Parallel Random Numbers: As Easy as 1, 2, 3", SC
2011) of a key (the seed of a row, 64 bits) and a counter (number, stream, episode). Row i of a
batch that is seeded with s has the key s + i, whatever its neighbours and the threads do, and no
generator has a state that would have to be saved. NumPy uses the C of `native/random.c`; `philox`
is its definition for every array namespace.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, namespace, quaternion_from_heading_and_tilt, stack
from quadrl.base.validation import number
from quadrl.state import Start

if TYPE_CHECKING:
    from quadrl.aircraft.parameters import Parameters

MAX_SEED = (1 << 62) - 1
FULL_TURN = 2 * math.pi
# Streams of an episode. A new purpose takes a new number, so that the others stay as they are.
START, PARAMETERS = 0, 1
WEATHER, TURBULENCE = 8, 9  # numbers of an episode; blocks of its control steps
NOISE, PUSHES = 16, 17  # blocks of its control steps
ADVANCE = 16
"""Numbers that are drawn at once, about as many as a start takes."""
MASK = 0xFFFFFFFF
"""Of a 32-bit word."""
Seed = int | Sequence[int | None] | None
"""Of all rows, or one for each; None for one from the system, or for none."""


def check_seed(seed: Any) -> int:
    """A seed as an int.

    Raises:
        QuadrlError: It is no whole number from 0 to `MAX_SEED`.
    """
    return number("seed", seed, 0, MAX_SEED, whole=True)


def seeds_of_rows(seed: Seed, rows: np.ndarray, count: int) -> tuple[np.ndarray, Any]:
    """Those of some rows (n,) that get a seed, and their seeds.

    Args:
        seed: Row i gets seed + i, or seed[i] unless that is None.
        rows: Numbers of rows.
        count: Number of all rows.

    Raises:
        QuadrlError: The seed of a row would be no whole number from 0 to `MAX_SEED`, or there are
            not `count` seeds.
    """
    if not isinstance(seed, (list, tuple, np.ndarray)):
        # The last row has a seed, too.
        return rows, number("seed", seed, 0, MAX_SEED - (count - 1), whole=True) + rows
    if len(seed) != count:
        allowed = f"a whole number, or a sequence of {count}"
        raise QuadrlError(name="seed", value=seed, allowed=allowed)
    own = [row for row in rows.tolist() if seed[row] is not None]
    return np.array(own, dtype=np.int64), [check_seed(seed[row]) for row in own]


def philox(counter: tuple[Array, ...], key: tuple[Array, Array]) -> tuple[Array, ...]:
    """The four 32-bit words of blocks.

    Args:
        counter: Four arrays of 32-bit words, held as int64.
        key: Two such arrays.

    Returns:
        Four arrays of 32-bit words, held as int64.
    """
    c0, c1, c2, c3 = counter
    low, high = key
    for _ in range(10):
        # The products wrap around as those of unsigned numbers do.
        p0, p1 = c0 * 0xD2511F53, c2 * 0xCD9E8D57
        c0, c1 = ((p1 >> 32) & MASK) ^ c1 ^ low, p1 & MASK
        c2, c3 = ((p0 >> 32) & MASK) ^ c3 ^ high, p0 & MASK
        low, high = (low + 0x9E3779B9) & MASK, (high + 0xBB67AE85) & MASK
    return c0, c1, c2, c3


def uniform(keys: Array, episodes: Array, stream: int, first: int, count: int) -> Array:
    """Numbers first..first+count-1 of streams, uniform in [0, 1), a multiple of 2^-32 each.

    Args:
        keys: (n,) int64, of the rows.
        episodes: (n,) int64.
        stream: Which stream of the episode.
        first: Number of the first one.
        count: How many.

    Returns:
        (n, count) float64.
    """
    if isinstance(keys, np.ndarray):
        from quadrl import native

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


def uniform_array_api(keys: Array, episodes: Array, stream: int, first: int, count: int) -> Array:
    """The definition of `uniform`, in any array namespace."""
    xp = namespace(keys)
    blocks = range(first // 4, (first + count - 1) // 4 + 1)
    words: list[Array] = []
    for block in blocks:
        zero = xp.zeros_like(keys)
        counter = (zero + block, zero + stream, episodes & MASK, (episodes >> 32) & MASK)
        words += philox(counter, (keys & MASK, (keys >> 32) & MASK))
    start = first - 4 * blocks[0]
    chosen = xp.stack(words[start : start + count], axis=-1)
    return xp.astype(chosen, xp.float64) * 2.0**-32


class Rng:
    """The random numbers of one stream of the episodes of n rows, taken one after the other."""

    def __init__(self, keys: Array, episodes: Array, stream: int = START) -> None:
        """Begin the stream.

        Args:
            keys: (n,) int64, of the rows.
            episodes: (n,) int64, numbers of the episodes.
            stream: START, PARAMETERS, ...
        """
        self._keys, self._episodes, self._stream = keys, episodes, stream
        self._drawn: Array = None  # (n, k) numbers of the stream from `_first` on
        self._first = self._end = self._used = 0

    def uniform(self, low: float, high: float, size: int | None = None) -> Array:
        """Uniform numbers in [low, high): (n,), or (n, size)."""
        count = 1 if size is None else size
        if self._used + count > self._end:  # more than are asked for: each call costs as much
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

        Args:
            position: (n, 3) [m], task frame.
            parameters: Of the aircraft.
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
    """Hover speeds of the rotors (n, R) [rad/s], a row per row of another array."""
    return parameters.rotor.hover_speed + namespace(like).zeros_like(like[..., :1])
