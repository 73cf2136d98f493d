"""Shapes to be drawn. Every picture is a list of them, whichever library draws it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from quadrl.base.rotation import Array

Shape = Literal[
    "sphere", "ellipsoid", "box", "cylinder", "capsule", "mesh", "arrow", "line", "label"
]
Numbers: TypeAlias = Sequence[float] | Array


class Mesh(NamedTuple):
    """Triangles that several primitives may share."""

    name: str
    vertices: Array  # (n, 3) [m]
    faces: Array  # (m, 3) numbers of vertices


@dataclasses.dataclass(frozen=True, eq=False)
class Primitive:
    """One shape, in the frame of what it belongs to."""

    shape: Shape
    size: Numbers | float = (0.1, 0.1, 0.1)
    """As MuJoCo gives it [m]: radius; radii; half extents; radius and half length. Of an arrow or a
    line: half of its width; of a line also (n,), at each point. Of a label: the radius of what it
    names."""
    position: Numbers = (0.0, 0.0, 0.0)
    """Centre [m]."""
    quaternion: Numbers = (1.0, 0.0, 0.0, 0.0)
    """Attitude (w, x, y, z); the axis of a cylinder or a capsule is z."""
    rgba: Numbers = (0.5, 0.5, 0.5, 1.0)
    """Colour and opacity, 0 to 1; of a line also (n, 4), from each point on."""
    glow: float = 1.0
    """Share of the colour that needs no light; what glows with all of it casts no shadow."""
    shine: float = 0.5
    """How narrow highlights are, 0 to 1."""
    points: Array | Sequence[Numbers] = ()
    """(n, 3) [m]: of a line, or the two ends of an arrow."""
    mesh: Mesh | None = None
    """Triangles of the shape "mesh"."""
    name: str = ""
    """Name of a part; the text of a label."""

    def moved(self, offset: Array) -> Primitive:
        """The same primitive, shifted by an offset (3,) [m]."""
        position, points = np.add(self.position, offset), self.points
        points = np.add(points, offset) if len(points) else ()
        return dataclasses.replace(self, position=position, points=points)
