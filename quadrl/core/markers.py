"""Shapes that tasks show beside the aircraft: goals, pads, paths, arrows."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal, TypeAlias, get_args

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.validation import choice

Rgba: TypeAlias = tuple[float, float, float, float]
Kind = Literal["goal", "sphere", "ring", "pad", "line", "arrow", "path"]
GOAL_RGBA: Rgba = (0.25, 0.92, 0.50, 0.28)


@dataclasses.dataclass(frozen=True)
class Marker:
    """A shape to be drawn. Tasks give it in their own frame, environments in the world frame."""

    kind: Kind
    """goal: a sphere with a core and a drop line to the ground. ring: a circle that lies flat. pad:
    a landing pad on the ground below its position. A ring or a pad with an `end` faces that point
    instead, and the pad then lies at its position."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre, or start of a line or an arrow [m]."""
    size: float = 0.1
    """Radius of a goal, sphere, ring or pad; width of a line, arrow or path [m]."""
    rgba: Rgba = GOAL_RGBA
    """Colour and opacity, each between 0 and 1."""
    end: tuple[float, float, float] | None = None
    """End of a line or an arrow [m]."""
    points: Sequence[Sequence[float]] | np.ndarray = ()
    """(n, 3) corners of a path [m]."""
    label: str = ""
    """Written at its position, or where a path begins."""

    def __post_init__(self) -> None:
        """Validate the kind and the end."""
        choice("kind", self.kind, get_args(Kind))
        if self.kind in ("line", "arrow") and self.end is None:
            raise QuadrlError(name="end", value=None, allowed=f"a point for a marker {self.kind!r}")

    def moved(self, offset: np.ndarray) -> Marker:
        """The same marker, shifted by an offset (3,) [m]."""
        position = tuple(np.add(self.position, offset))
        end = None if self.end is None else tuple(np.add(self.end, offset))
        points = np.add(self.points, offset) if len(self.points) else ()
        return dataclasses.replace(self, position=position, end=end, points=points)
