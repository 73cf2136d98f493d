"""Race tracks: gates as arrays, and how an aircraft crosses their planes.

Known tracks are in assets/tracks, each with its source and licence.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources
import json
import math
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.primitives import Primitive
from quadrl.base.records import tuples
from quadrl.base.rotation import Array, cross, dot, namespace
from quadrl.base.validation import MAX_OPTION, choice, number, numbers

RUN_IN = 5.0
"""Distance of the start before the first gate of a track that names no start [m]."""
MAX_GATES = 500  # of a track of one's own: any two are looked at for whether they overlap
DEPTH = 0.03  # of the frames that are drawn, of their outer edge
NEXT, OTHER = (1.0, 0.55, 0.15, 1.0), (0.25, 0.45, 0.80, 1.0)


@dataclasses.dataclass(frozen=True)
class Track:
    """Square gates that are flown through in order, and again from the first."""

    name: str
    gates: tuple[tuple[float, ...], ...]
    """Centre x, y, z [m], task frame; heading and climb [deg] of the way through: from east
    counter-clockwise, from level up."""
    start: tuple[float, ...]
    """Where a race begins [m]."""
    opening: float
    """Edge of the openings [m]."""
    frame: float
    """Outer edge of the frames [m]."""
    poles: tuple[tuple[float, ...], ...] = ()
    """Poles beside the gates: x, y and the height of the top [m]."""

    def __post_init__(self) -> None:
        """Refuse a track that cannot be flown.

        Raises:
            QuadrlError: A number is impossible, or gates overlap.
        """
        number(f"{self.name} opening", self.opening, positive=True)
        number(f"{self.name} frame", self.frame, self.opening)
        for k, n in self._overlapping():
            what, centres = f"{self.name} gates {k + 1} and {n + 1}", self.centre[[k, n]]
            allowed = f"centres so far apart that frames of {self.frame:g} m do not overlap"
            raise QuadrlError(name=what, value=centres, allowed=allowed)

    @classmethod
    def of(
        cls, name: str, gates: Any = None, start: Any = (), opening: float = 0, frame: float = 0
    ) -> Track:
        """Make a known track, or one of own gates, with what differs from it.

        Args:
            name: A name of `NAMES`.
            gates: As `Track.gates`; None for those of the track.
            start: As `Track.start`; () for that of the track, or before the first of own gates.
            opening: As `Track.opening`; 0 for that of the track.
            frame: As `Track.frame`; 0 for that of the track.

        Raises:
            QuadrlError: The name is unknown, or what is given no track.
        """
        listed = known(choice("track", name, NAMES))
        size, rows = (-MAX_OPTION, MAX_OPTION), listed.gates
        if gates is not None:
            if isinstance(gates, str) or not hasattr(gates, "__len__") or not len(gates):
                allowed = "at least one row [x, y, z, heading, climb]"
                raise QuadrlError(name="gates", value=gates, allowed=allowed)
            number("number of gates", len(gates), 1, MAX_GATES, whole=True)
            rows = tuple(numbers(f"gates[{k}]", gate, 5, *size) for k, gate in enumerate(gates))
            name, listed = "own", dataclasses.replace(listed, start=_before(rows[0]))
        if len(numbers("start", start)):
            listed = dataclasses.replace(listed, start=numbers("start", start, 3, *size))
        return cls(name, rows, listed.start, opening or listed.opening, frame or listed.frame)

    @functools.cached_property
    def centre(self) -> np.ndarray:
        """Centres of the gates, (G, 3) [m]."""
        return _fixed([gate[:3] for gate in self.gates])

    @functools.cached_property
    def axes(self) -> np.ndarray:
        """Unit vectors through each gate, to its left and up along it, (G, 3, 3)."""
        heading, climb = np.radians([gate[3:] for gate in self.gates]).T
        zero = 0 * heading
        level = np.array([np.cos(heading), np.sin(heading), zero])
        through = level * np.cos(climb) + np.array([zero, zero, np.sin(climb)])
        left = np.array([-np.sin(heading), np.cos(heading), zero])
        return _fixed(np.stack([through.T, left.T, np.cross(through.T, left.T)], axis=1))

    def _overlapping(self) -> np.ndarray:
        """Pairs (n, 2) of gates whose frames, as they are drawn, no plane keeps apart."""
        first, second = np.triu_indices(len(self.gates), 1)
        one, other = self.axes[first], self.axes[second]
        off = self.centre[second] - self.centre[first]
        # Of boxes it is enough to look along their edges, and across any two of them.
        across = np.cross(one[:, :, None], other[:, None]).reshape(-1, 9, 3)
        ways = np.concatenate([one, other, across], axis=1)
        half = np.array([DEPTH, 1.0, 1.0]) * (self.frame / 2 - 1e-9)  # they may touch
        reach = sum(abs(ways @ axes.swapaxes(1, 2)) @ half for axes in (one, other))
        apart = (abs(ways @ off[..., None])[..., 0] > reach).any(axis=1)
        return np.stack([first, second], axis=1)[~apart]

    def drawn(self, following: int, centre: Any, axes: Any) -> Iterator[Primitive]:
        """The frames, that of the gate with a number in another colour.

        Args:
            following: The number.
            centre: Where gates stand, as `Track.centre`.
            axes: The same of `Track.axes`.
        """
        deep = DEPTH * self.frame / 2
        wide = max((self.frame - self.opening) / 4, deep / 2)
        for k, (middle, turned) in enumerate(zip(centre, axes, strict=True)):
            rgba, turn = NEXT if k == following else OTHER, attitude(turned)
            for across, size in ((1, (wide, self.frame / 2)), (2, (self.opening / 2, wide))):
                for side in (-1, 1):
                    place = middle + side * (self.opening / 2 + wide) * turned[across]
                    yield Primitive("box", (deep, *size), place, turn, rgba)


@functools.cache
def known(name: str) -> Track:
    """A track of assets/tracks."""
    read = tuples(json.loads((TRACKS / f"{name}.json").read_text()))
    size = read["opening"], read["frame"]
    return Track(name, read["gates"], read["start"], *size, read.get("poles", ()))


def attitude(axes: Any) -> tuple[float, ...]:
    """The quaternion w, x, y, z of what has its x, y and z axis along unit vectors (3, 3)."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.transpose(axes).ravel())
    return tuple(quaternion.tolist())


def _before(gate: tuple[float, ...]) -> tuple[float, ...]:
    """A start before a gate (x, y, z, heading, climb), as high [m]."""
    heading = math.radians(gate[3])
    return gate[0] - RUN_IN * math.cos(heading), gate[1] - RUN_IN * math.sin(heading), gate[2]


def _fixed(values: Any) -> np.ndarray:
    array = np.array(values)
    array.flags.writeable = False
    return array


def crossing(
    last: Array, position: Array, centre: Array, through: Array, left: Array
) -> tuple[Array, Array, Array, Array]:
    """How an aircraft that flies straight from one place to another crosses the plane of a gate.

    Args:
        last: The one place, (N, 3) [m].
        position: The other, (N, 3) [m].
        centre: Centre of the gate, (N, 3) [m].
        through: Unit vector through it, (N, 3).
        left: Unit vector to its left, (N, 3).

    Returns:
        Whether forwards, and whether backwards, (N,) bool; how far from the centre, (N,) [m], the
        larger of sideways and along the upright edges; on which share of the way, (N,). The latter
        two mean nothing where it does not cross it.
    """
    xp = namespace(position)
    up = cross(through, left)
    was, now = dot(last - centre, through), dot(position - centre, through)
    forwards, backwards = (was < 0) & (now >= 0), (was >= 0) & (now < 0)
    way = xp.where(forwards | backwards, now - was, xp.ones_like(was))
    share = -was / way
    point = last + share[..., None] * (position - last) - centre
    return forwards, backwards, xp.maximum(abs(dot(point, left)), abs(dot(point, up))), share


TRACKS = importlib.resources.files("quadrl") / "assets" / "tracks"
NAMES = tuple(
    name
    for name in sorted(file.name.removesuffix(".json") for file in TRACKS.iterdir())
    if not known(name).poles
)
"""Tracks that have gates and nothing else."""
