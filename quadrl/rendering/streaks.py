"""Wind that can be seen: streaks around the aircraft that drift with the air."""

from __future__ import annotations

import math

import numpy as np

from quadrl.base.rotation import Array
from quadrl.core.markers import Marker

COUNT = 60
BOX = np.array([2.3, 2.3, 1.7])  # [m], around an aircraft with scale 1, that the streaks fill
SECONDS = 0.05  # of the wind's way, that a streak is long
LONGEST = 0.8  # [m]
WIDTH = 0.0017  # [m]
TAIL = (0.25, 0.55, 1.0)  # opacity from the tail to the head, which leads
COLOUR, OPACITY = (0.92, 0.97, 1.0), 0.8
STILL = 0.1  # [m/s], under which nothing is shown
# Evenly in the unit cube: multiples of the powers of the root of x^4 = x + 1 (Roberts 2018).
_PLACES = np.arange(1, COUNT + 1)[:, None] * 1.2207440846057596 ** -np.arange(1.0, 4.0) % 1.0


def streaks(position: Array, wind: Array, drift: Array, scale: float) -> tuple[Marker, ...]:
    """What shows the wind around an aircraft.

    Args:
        position: (3,) [m], of the aircraft, world frame.
        wind: (3,) [m/s], world frame.
        drift: (3,) [m], how far the air has come since the flight began.
        scale: Of the aircraft, see `quadrl.rendering.camera.aircraft_scale`.
    """
    speed = float(np.linalg.norm(wind))
    if speed < STILL:
        return ()
    box = BOX * math.sqrt(scale)
    # A streak that leaves the box comes in again on its other side; it fades towards the sides.
    place = (_PLACES * box + drift - position) % box - box / 2
    fading = np.clip(3.0 * (1.0 - np.abs(2 * place / box)), 0.0, 1.0).prod(axis=1)
    way = wind * min(SECONDS, LONGEST / speed) * math.sqrt(scale)
    heads = position + place
    shown = (fading > 0.02) & (np.minimum(heads[:, 2], (heads - way)[:, 2]) > 0.0)
    markers, parts = [], len(TAIL)
    for head, fade in zip(heads[shown], fading[shown].tolist(), strict=True):
        for k, share in enumerate(TAIL):
            points = head - way * ((parts - k) / parts), head - way * ((parts - k - 1) / parts)
            rgba = (*COLOUR, OPACITY * fade * share)
            markers.append(Marker("path", points=points, size=WIDTH * scale, rgba=rgba))
    return tuple(markers)
