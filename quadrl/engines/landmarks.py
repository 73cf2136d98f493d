"""What is painted on the ground: a compass rose, two axes, and a number at each metre of them.

Letters and numbers stand upright for whoever looks east, as the cameras do at first.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

Point = tuple[float, float]
Mesh = tuple[np.ndarray, np.ndarray]

HEIGHT = 0.001  # [m] above the ground: below the pads, and far enough not to flicker
REACH = 10  # [m], length of each half of an axis
STROKE, LETTER = 0.035, 0.24  # [m], width of a line and height of a letter
ROSE, NEEDLE, WAIST = 0.90, 0.82, 0.11  # [m], radius of the ring, and of the needles
TICK, BESIDE = 0.07, 0.26  # [m], half of a tick; from an axis to the middle of its numbers
EAST, NORTH = np.array([1.0, 0.0]), np.array([0.0, 1.0])

# Lines through points of a grid that is 4 wide and 6 high.
GLYPHS: dict[str, tuple[tuple[Point, ...], ...]] = {
    "0": (((0, 1), (0, 5), (1, 6), (3, 6), (4, 5), (4, 1), (3, 0), (1, 0), (0, 1)),),
    "1": (((0.8, 4.8), (2, 6), (2, 0)), ((0.8, 0), (3.2, 0))),
    "2": (((0, 5), (1, 6), (3, 6), (4, 5), (4, 4), (0, 0), (4, 0)),),
    "3": (((0, 6), (4, 6), (2, 3.5), (3, 3.5), (4, 2.5), (4, 1), (3, 0), (1, 0), (0, 1)),),
    "4": (((3, 0), (3, 6), (0, 2), (4, 2)),),
    "5": (((4, 6), (0, 6), (0, 3.5), (3, 3.5), (4, 2.5), (4, 1), (3, 0), (0, 0)),),
    "6": (((3.6, 6), (2, 6), (0, 4), (0, 1), (1, 0), (3, 0), (4, 1), (4, 2.4), (3, 3.4),
           (0, 3.4)),),
    "7": (((0, 6), (4, 6), (1.5, 0)),),
    "8": (((1, 3.2), (0, 4.2), (0, 5), (1, 6), (3, 6), (4, 5), (4, 4.2), (3, 3.2), (1, 3.2),
           (0, 2.2), (0, 1), (1, 0), (3, 0), (4, 1), (4, 2.2), (3, 3.2)),),
    "9": (((0.4, 0), (2, 0), (4, 2), (4, 5), (3, 6), (1, 6), (0, 5), (0, 3.6), (1, 2.6),
           (4, 2.6)),),
    "m": (((0, 0), (0, 4)), ((0, 3), (1, 4), (2, 3), (2, 0)), ((2, 3), (3, 4), (4, 3), (4, 0))),
    "N": (((0, 0), (0, 6), (4, 0), (4, 6)),),
    "E": (((4, 0), (0, 0), (0, 6), (4, 6)), ((0, 3), (3.2, 3))),
    "S": (((0, 1), (1, 0), (3, 0), (4, 1), (4, 2.2), (3, 3), (1, 3), (0, 3.8), (0, 5), (1, 6),
           (3, 6), (4, 5)),),
    "W": (((0, 6), (1, 0), (2, 4), (3, 0), (4, 6)),),
}  # fmt: skip


@functools.cache
def meshes() -> dict[str, Mesh]:
    """Vertices (n, 3) [m], world frame, and triangles (m, 3): the marks, and those of north."""
    marks, north = Paint(), Paint()
    angle = np.linspace(0, 2 * np.pi, 97)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    inner, outer = (ROSE - STROKE / 2) * circle, (ROSE + STROKE / 2) * circle
    for k in range(len(angle) - 1):
        marks.fill([inner[k], outer[k], outer[k + 1], inner[k + 1]])
    for letter, way in (("N", NORTH), ("E", EAST), ("S", -NORTH), ("W", -EAST)):
        paint, side = (north if letter == "N" else marks), np.array([way[1], -way[0]])
        paint.text(letter, (ROSE + 0.25) * way)
        tip, left, right = NEEDLE * way, WAIST * (way - side), WAIST * (way + side)
        paint.fill([(0.0, 0.0), tip, left])
        paint.line([(0.0, 0.0), right, tip], 0.6 * STROKE)
        # Of the axes the halves to the east and to the north begin beyond their letters.
        marks.line([(ROSE + 0.5) * way, (REACH + 0.3) * way])
        for metre in range(2, REACH + 1):
            at = metre * way
            marks.line([at - TICK * side, at + TICK * side])
            beside = BESIDE * (-NORTH if abs(way[0]) else -EAST)
            marks.text(f"{metre} m" if metre == REACH else str(metre), at + beside)
    return {"marks": marks.mesh(), "north": north.mesh()}


class Paint:
    """Triangles on the ground, all of them facing up."""

    def __init__(self) -> None:
        """Begin with none."""
        self._points: list[np.ndarray] = []
        self._faces: list[tuple[int, int, int]] = []

    def fill(self, corners: Sequence[Point | np.ndarray]) -> None:
        """A convex shape."""
        points = np.asarray(corners, dtype=float)
        x, y = (points - points.mean(0)).T
        first = len(self._points)
        if (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() < 0:
            points = points[::-1]
        self._points += [np.append(point, HEIGHT) for point in points]
        self._faces += [(first, first + k, first + k + 1) for k in range(1, len(points) - 1)]

    def line(
        self, points: Sequence[Point | np.ndarray] | np.ndarray, width: float = STROKE
    ) -> None:
        """Connect points (n, 2) [m]."""
        points = np.asarray(points, dtype=float)
        for start, end in zip(points[:-1], points[1:], strict=True):
            along = (end - start) / np.linalg.norm(end - start) * (width / 2)
            aside = np.array([-along[1], along[0]])
            start, end = start - 0.5 * along, end + 0.5 * along  # closes the corners
            self.fill([start + aside, start - aside, end - aside, end + aside])

    def text(self, text: str, centre: np.ndarray) -> None:
        """Write letters, upright for whoever looks east."""
        unit = LETTER / 6
        for k, letter in enumerate(text):
            shift = 6 * (k - (len(text) - 1) / 2) - 2
            for line in GLYPHS.get(letter, ()):
                right, up = (np.array(line) + (shift, -3)).T * unit
                self.line(centre + np.stack([up, -right], axis=-1), 0.75 * STROKE)

    def mesh(self) -> Mesh:
        """Vertices and triangles."""
        return np.array(self._points), np.array(self._faces)
