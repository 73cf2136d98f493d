"""How far a box is from others and from upright poles, by separating axes (Gottschalk 1996)."""

from __future__ import annotations

import functools
from collections.abc import Sequence

from quadrl.base.rotation import Array, namespace

Numbers = Sequence[Array | float]
AXES = (0, 1, 2), (1, 2, 0), (2, 0, 1)  # each with the other two
PARALLEL = 1e-9  # [m]; edges that are parallel span no axis, and their gap would be a zero


def gap(
    off: Numbers, turn: Sequence[Sequence[Array]], half: Numbers, size: Numbers, round: float = 0.0
) -> Array:
    """Lower bound of the distance of two boxes, (N,) [m]; negative where they overlap alone.

    Args:
        off: Centre of the first along the axes of the second, (N,) each [m].
        turn: Its axes, too: turn[k][i] is the component of its axis i along axis k.
        half: Half its edges [m].
        size: Half those of the second [m].
        round: Radius [m] of a pole along axis 2 about the second; it is negative from 1 mm on where
            a corner of the first points at that.
    """
    xp, gaps = namespace(half[0]), list[Array]()
    for k, p, q in AXES:
        gaps.append(abs(off[k]) - size[k] - round - _reach(turn[k], half))
        own = [turn[i][k] for i in range(3)]
        along = off[0] * own[0] + off[1] * own[1] + off[2] * own[2]
        gaps.append(abs(along) - half[k] - round - _reach(own, size))
        for i, m, n in AXES:
            across = abs(off[q] * turn[p][i] - off[p] * turn[q][i])
            first = half[m] * abs(turn[k][n]) + half[n] * abs(turn[k][m])
            second = size[p] * abs(turn[q][i]) + size[q] * abs(turn[p][i])
            if round:
                second = second + round * xp.sqrt(turn[p][i] ** 2 + turn[q][i] ** 2)
            gaps.append(across - first - second - PARALLEL)
    if round:  # along the way to the pole
        away = xp.clip(xp.sqrt(off[0] * off[0] + off[1] * off[1]), PARALLEL, None)
        towards = [off[0] * turn[0][i] + off[1] * turn[1][i] for i in range(3)]
        gaps.append(away - _reach(towards, half) / away - round)
    return functools.reduce(xp.maximum, gaps)


def _reach(turn: Sequence[Array], half: Numbers) -> Array:
    """How far a box reaches along a direction, from the components of its axes there, (N,) [m]."""
    return half[0] * abs(turn[0]) + half[1] * abs(turn[1]) + half[2] * abs(turn[2])
