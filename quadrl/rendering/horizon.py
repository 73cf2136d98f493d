"""An artificial horizon: the attitude as a pilot sees it, from inside the aircraft."""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from quadrl.base.rotation import Array, roll_pitch_yaw

FIELD = 50.0  # [deg] of pitch from the middle to the edge
LADDER = (-40, -20, 20, 40)  # [deg], of the short lines
SKY, GROUND, LIGHT = (72, 128, 198), (116, 86, 60), (240, 243, 248)
SYMBOL, RIM = (255, 176, 56), (30, 37, 48)  # of the aircraft that stays, and of the edge


def horizon(size: int, attitude: Array) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Draw an artificial horizon.

    Args:
        size: Diameter [pixels].
        attitude: (w, x, y, z), world frame.

    Returns:
        Colours (size, size, 3), and how much each pixel covers what is below, (size, size).
    """
    roll, pitch, _ = roll_pitch_yaw(attitude)
    across, up, fixed, cover = _dial(size)
    soft = functools.partial(_soft, pixel=2.0 / size)
    along = math.cos(roll) * across + math.sin(roll) * up
    above = math.cos(roll) * up - math.sin(roll) * across
    height = above + math.degrees(pitch) / FIELD
    colours = _blend(np.broadcast_to(np.array(GROUND, float), (size, size, 3)), SKY, soft(height))
    ladder = [soft(0.012 - abs(height - k / FIELD)) * soft(0.2 - abs(along)) for k in LADDER]
    colours = _blend(colours, LIGHT, 0.75 * np.clip(sum(ladder), 0, 1))
    colours = _blend(colours, LIGHT, soft(0.018 - abs(height)))
    colours = _blend(colours, LIGHT, soft(0.055 - np.hypot(along, above - 0.8)))  # up
    for colour, mask in fixed:
        colours = _blend(colours, colour, mask)
    return colours.round().astype(np.uint8), cover


@functools.lru_cache(maxsize=8)
def _dial(size: int) -> tuple[Array, Array, list[tuple[tuple[int, ...], Array]], Array]:
    """Coordinates of the pixels to the right and up, -1 to 1; colours and masks that stay."""
    place = (2 * np.arange(size) + 1) / size - 1
    across, up = np.meshgrid(place, -place)
    radius, soft = np.hypot(across, up), functools.partial(_soft, pixel=2.0 / size)
    wing = soft(0.045 - abs(up)) * soft(0.17 - abs(abs(across) - 0.45))
    mark = soft(0.035 - abs(across)) * soft(up - 0.86)
    fixed = [(RIM, soft(radius - 0.93)), (SYMBOL, np.maximum(wing, soft(0.07 - radius)))]
    cover = np.round(255 * soft(1.0 - radius)).astype(np.uint8)
    return across, up, [*fixed, (SYMBOL, mark)], cover


def _soft(inside: Array, pixel: float) -> Array:
    """1 where something is positive, 0 where it is not, and in between over a pixel."""
    return np.clip(inside / pixel + 0.5, 0.0, 1.0)


def _blend(colours: Array, colour: tuple[int, ...], share: Array) -> Array:
    return colours + share[..., None] * (np.array(colour, float) - colours)
