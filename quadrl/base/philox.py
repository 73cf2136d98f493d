"""Keyed random numbers in any array namespace; `engines/rng.py` draws the same ones in C.

Philox4x32-10 (Salmon, Moraes, Dror and Shaw, "Parallel Random Numbers: As Easy as 1, 2, 3", SC
2011) of a key (the seed of a row, 64 bits) and a counter (number, stream, episode).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, namespace
from quadrl.base.validation import number

MAX_SEED = (1 << 62) - 1
# Streams of an episode. A new purpose takes a new number, so that the others do not change.
START, PARAMETERS, SOLIDS, MEMBERS, POOL = 0, 1, 2, 3, 4
WEATHER, TURBULENCE = 8, 9  # drawn once an episode; drawn at each control step
NOISE, PUSHES, LINK = 16, 17, 18  # drawn at each control step
SENSORS = 1 << 30  # the first of two for each sensor, its noise and its bias
EVENTS = 1 << 31  # the first of one for each event
MAX_SEEDS = 1000
"""Largest number of seeds in a list."""
MASK = 0xFFFFFFFF
"""Of a 32-bit word."""
Seed = int | Sequence[int | None] | None
"""One seed for all rows, or one for each; None for a seed from the system, or for none."""


def seeds_of_rows(seed: Seed, rows: np.ndarray, count: int) -> tuple[np.ndarray, Any]:
    """Select the rows that get a seed, (m,), and the seed of each of them, (m,).

    Args:
        seed: Row i gets seed + i or, from a sequence, seed[i]; None in it leaves a row its own.
        rows: Numbers (n,) of the rows to seed.
        count: Number of all rows.

    Raises:
        QuadrlError: The seed of a row is not a whole number from 0 to `MAX_SEED`, or there are
            not `count` seeds.
    """
    if not isinstance(seed, (list, tuple, np.ndarray)):
        # The seed of the last row must not be too large either.
        return rows, number("seed", seed, 0, MAX_SEED - (count - 1), whole=True) + rows
    if len(seed) != count:
        allowed = f"a whole number, or a sequence of {count}"
        raise QuadrlError(name="seed", value=seed, allowed=allowed)
    own = [row for row in rows.tolist() if seed[row] is not None]
    found = [number("seed", seed[row], 0, MAX_SEED, whole=True) for row in own]
    return np.array(own, dtype=np.int64), found


def seeds(value: Any, largest: int) -> list[int]:
    """Different seeds: "0:5" for 0 to 4, "3,5,8", or a list of numbers.

    Raises:
        QuadrlError: They are no such numbers.
    """
    found: Any = cast(Any, value) if isinstance(value, (list, tuple)) else []
    whole: list[Any] = []
    try:
        if isinstance(value, str):
            first, colon, last = value.partition(":")
            found = range(int(first), int(last)) if colon else [*map(int, value.split(","))]
        whole = list(found) if len(found) <= MAX_SEEDS else []
    except (OverflowError, ValueError):
        pass
    known = all(type(seed) is int and 0 <= seed <= largest for seed in whole)
    if not whole or not known or len(set(whole)) < len(whole):
        allowed = f"FIRST:END such as 0:5, or numbers such as 3,5,8; at most {MAX_SEEDS}"
        raise QuadrlError(name="seeds", value=value, allowed=allowed)
    return whole


def philox(counter: tuple[Array, ...], key: tuple[Array, Array]) -> tuple[Array, ...]:
    """Compute the four 32-bit words of blocks.

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


def uniform_array_api(keys: Array, episodes: Array, stream: int, first: int, count: int) -> Array:
    """Draw the numbers of `engines.rng.uniform` in any array namespace."""
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
