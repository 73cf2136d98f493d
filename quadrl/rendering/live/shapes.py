"""Markers taken apart into balls, discs, lines and words; and the blades of a drawn model."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import mujoco
import numpy as np

from quadrl.base.rotation import Array
from quadrl.core.markers import Marker
from quadrl.rendering.scene import CIRCLE, PAD_RGBA

# The letter H on a pad of radius 1, as strokes.
LETTER = np.array([[(-1, -2, 0), (-1, 2, 0)], [(1, -2, 0), (1, 2, 0)], [(-1, 0, 0), (1, 0, 0)]])
HEAD = np.array([(-1, 0, -3), (1, 0, -3), (0, -1, -3), (0, 1, -3)])  # of an arrow


@dataclasses.dataclass(frozen=True)
class Sketch:
    """Markers as balls, discs, lines and words."""

    balls: Array  # (n, 8) centre and radius [m], colour and opacity (0 to 1)
    discs: Array  # (n, 12) centre [m], quaternion, radius [m], colour and opacity
    lines: Array  # (n, 2, 3) [m]
    colours: Array  # (n, 2, 3) of the lines, 0 to 1
    labels: tuple[tuple[str, tuple[float, float, float]], ...]  # and where they stand [m]


def sketch(markers: Sequence[tuple[Marker, Array]]) -> Sketch:
    """Markers, each with an offset (3,) [m], taken apart."""
    balls, discs, labels = [], [], []
    strokes = [np.zeros((0, 2, 3))]
    colours = [np.zeros((0, 2, 3))]
    for marker, offset in markers:
        marker = marker.moved(offset)
        position, rgba = np.array(marker.position, dtype=float), marker.rgba
        if marker.kind in ("goal", "sphere"):
            balls.append((*position, marker.size, *rgba))
        if marker.kind == "goal":
            balls.append((*position, 0.22 * marker.size, *rgba[:3], min(1.0, 3 * rgba[3])))
        if marker.kind == "pad":
            place = position if marker.end else position * (1, 1, 0)
            discs.append((*place, *_facing(marker), marker.size, *PAD_RGBA))
        if marker.label:
            above = position + (0, 0, 1.5 * marker.size)
            labels.append((marker.label, (above[0], above[1], above[2])))
        for line in _strokes(marker, position):
            strokes.append(np.stack([line[:-1], line[1:]], axis=1))
            colours.append(np.broadcast_to(rgba[:3], strokes[-1].shape))
    return Sketch(
        np.array(balls).reshape(-1, 8),
        np.array(discs).reshape(-1, 12),
        np.concatenate(strokes),
        np.concatenate(colours),
        tuple(labels),
    )


def _strokes(marker: Marker, position: Array) -> list[Array]:
    """The lines (n, 3) [m] of a marker."""
    size, axes = marker.size, np.empty(9)
    mujoco.mju_quat2Mat(axes, _facing(marker))
    axes = axes.reshape(3, 3)
    if marker.kind == "goal":
        foot = position * (1, 1, 0) + (0, 0, 0.02)  # [m], clear of the ground from afar
        # Pieces shorter than a pixel would not be seen in a browser.
        return [np.array([foot, position]), foot + 1.8 * size * CIRCLE[::3]]
    if marker.kind == "ring":
        return [position + size * CIRCLE @ axes.T]
    if marker.kind == "pad":
        centre = (position if marker.end else position * (1, 1, 0)) + axes @ (0, 0, 0.02)
        circles = [centre + share * size * CIRCLE @ axes.T for share in (1.0, 0.62)]
        return circles + [centre + size * (0.17 * stroke) @ axes.T for stroke in LETTER]
    if marker.kind == "path":
        return [np.asarray(marker.points, dtype=float)]
    if marker.kind in ("line", "arrow"):
        end = np.array(marker.end, dtype=float)
        barbs = end + 2 * size * HEAD @ axes.T if marker.kind == "arrow" else []
        return [np.array([position, end]), *(np.array([end, barb]) for barb in barbs)]
    return []


def _facing(marker: Marker) -> Array:
    """Quaternion (4,) that turns z towards the marker's end; upright where there is none."""
    quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    if marker.end is not None:
        mujoco.mju_quatZ2Vec(quaternion, np.subtract(marker.end, marker.position))
    return quaternion


def blade_ids(model: mujoco.MjModel, rotor: int) -> list[int]:
    """The geoms that turn with a rotor."""
    return [model.geom(f"rotor_{rotor + 1}_blade_{side}").id for side in "ab"]


def turn_blades(model: mujoco.MjModel, data: mujoco.MjData, rotor: int, angle: float) -> None:
    """Turn the blades of a rotor about its axis by an angle [rad] in data that is to be drawn."""
    hub = model.geom(f"rotor_{rotor + 1}_hub").id
    axes, turn = data.geom_xmat[hub].reshape(3, 3), np.empty(9)
    mujoco.mju_quat2Mat(turn, np.array([math.cos(angle / 2), 0, 0, math.sin(angle / 2)]))
    turn = axes @ turn.reshape(3, 3) @ axes.T
    for blade in blade_ids(model, rotor):
        data.geom_xpos[blade] = data.geom_xpos[hub] + turn @ (
            data.geom_xpos[blade] - data.geom_xpos[hub]
        )
        data.geom_xmat[blade] = (turn @ data.geom_xmat[blade].reshape(3, 3)).ravel()
