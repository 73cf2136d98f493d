"""Solids that a task can declare, and poses that it can give them in each episode."""

from __future__ import annotations

import abc
import copy
import dataclasses
from typing import Any, cast

import mujoco
import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, cross, namespace
from quadrl.base.validation import MAX_OPTION, number, numbers

Vector = tuple[float, float, float]
MIN_LENGTH = 1 / MAX_OPTION  # [m]
MAX_COUNT = 10_000


@dataclasses.dataclass(frozen=True)
class Part:
    """A geom of a solid."""

    kind: mujoco.mjtGeom
    size: Vector
    """As MuJoCo has it: radius; radius and half the height; halves of the edges [m]."""
    offset: Vector = (0.0, 0.0, 0.0)
    """Offset of its centre from the solid's, in the solid's frame [m]."""


@dataclasses.dataclass(frozen=True)
class Solid(abc.ABC):
    """An object that an aircraft can hit."""

    name: str
    """Name by which the task places it."""
    _: dataclasses.KW_ONLY
    position: Vector = (0.0, 0.0, 0.0)
    """Position of its centre where `Task.place` says nothing, task frame [m]."""
    rgba: tuple[float, float, float, float] = (0.55, 0.58, 0.62, 1.0)
    """Colour and opacity, each between 0 and 1."""
    grip: float = 0.0
    """With how many times its weight it holds an aircraft whose feet touch it; none by default. The
    rotors of who is held stop for the rest of the episode."""
    count: int | None = None
    """How many there are of the kind, which are placed together; None for a single one, whose
    arrays have no axis of them."""

    def __post_init__(self) -> None:
        """Validate the name, the numbers and the lengths."""
        if not isinstance(name := cast(Any, self.name), str) or not name.isidentifier():
            raise QuadrlError(name="solid", value=self.name, allowed="a name such as 'post'")
        for name, size, *ends in (("position", 3, -MAX_OPTION, MAX_OPTION), ("rgba", 4, 0, 1)):
            given = numbers(f"{self.name} {name}", getattr(self, name), size, *ends)
            object.__setattr__(self, name, given)
        number(f"{self.name} grip", self.grip, 0, MAX_OPTION)
        if self.count is not None:
            number(f"{self.name} count", self.count, 1, MAX_COUNT, whole=True)
        for name in self.lengths:
            number(f"{self.name} {name}", getattr(self, name), MIN_LENGTH, MAX_OPTION)

    @property
    def lengths(self) -> tuple[str, ...]:
        """Names of its lengths, in the order of a `Pose.size`."""
        fields = dataclasses.fields(self)
        return tuple(f.name for f in fields if f.type in ("float", float) and f.name != "grip")

    def sized(self, size: np.ndarray) -> Solid:
        """The same with lengths (..., k) [m]: its parts have sizes and offsets of arrays (...)."""
        made = copy.copy(self)
        for name, length in zip(self.lengths, np.moveaxis(size, -1, 0), strict=True):
            object.__setattr__(made, name, length)
        return made

    @property
    @abc.abstractmethod
    def parts(self) -> tuple[Part, ...]:
        """The geoms that make up the solid."""


@dataclasses.dataclass(frozen=True)
class Sphere(Solid):
    """A ball."""

    radius: float = 0.2
    """[m]"""

    @property
    def parts(self) -> tuple[Part, ...]:
        """One sphere."""
        return (Part(mujoco.mjtGeom.mjGEOM_SPHERE, (self.radius, 0.0, 0.0)),)


@dataclasses.dataclass(frozen=True)
class Cylinder(Solid):
    """A post, a tree, or, lower than wide, a pad; upright unless it is turned."""

    radius: float = 0.1
    """[m]"""
    height: float = 2.0
    """[m]"""

    @property
    def parts(self) -> tuple[Part, ...]:
        """One cylinder."""
        size = (self.radius, self.height / 2, 0.0)
        return (Part(mujoco.mjtGeom.mjGEOM_CYLINDER, size),)


@dataclasses.dataclass(frozen=True)
class Capsule(Solid):
    """A post, a branch or a cable with round ends; upright unless it is turned."""

    radius: float = 0.1
    """[m]"""
    length: float = 2.0
    """Between the middles of its ends [m]."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """One capsule."""
        size = (self.radius, self.length / 2, 0.0)
        return (Part(mujoco.mjtGeom.mjGEOM_CAPSULE, size),)


@dataclasses.dataclass(frozen=True)
class Box(Solid):
    """A block, a wall or a floor."""

    length: float = 1.0
    """Along x [m]."""
    width: float = 1.0
    """Along y [m]."""
    height: float = 1.0
    """Along z [m]."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """One box."""
        size = (self.length / 2, self.width / 2, self.height / 2)
        return (Part(mujoco.mjtGeom.mjGEOM_BOX, size),)


@dataclasses.dataclass(frozen=True)
class Gate(Solid):
    """A square frame to fly through, along its x axis."""

    opening: float = 1.0
    """Edge of what is free [m]."""
    frame: float = 0.1
    """Width and depth of its bars [m]."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """Four bars."""
        half, reach = self.frame / 2, (self.opening + self.frame) / 2
        box, whole = mujoco.mjtGeom.mjGEOM_BOX, self.opening / 2 + self.frame
        level, upright = (half, whole, half), (half, half, self.opening / 2)
        return (
            Part(box, level, (0.0, 0.0, reach)),
            Part(box, level, (0.0, 0.0, -reach)),
            Part(box, upright, (0.0, reach, 0.0)),
            Part(box, upright, (0.0, -reach, 0.0)),
        )


@dataclasses.dataclass(frozen=True)
class Pose:
    """Where a solid stands in each episode, and how large it is.

    Those of a solid with a `count` have one more axis: (n, count, ...).
    """

    position: Array  # (n, 3) [m] of its centre, task frame
    quaternion: Array = None  # (n, 4) (w, x, y, z); None for upright, its x axis to the east
    size: Array = None  # (n, k) [m], its lengths in their order; None for the declared ones


def heading(angle: Array) -> Array:
    """Quaternions (n, 4) of solids turned by angles (n,) [rad] from the east to the north."""
    xp = namespace(angle)
    none = xp.zeros_like(angle)
    return xp.stack([xp.cos(angle / 2), none, none, xp.sin(angle / 2)], axis=-1)


def write_pose(solid: Solid, pose: Pose, origin: np.ndarray, made: np.ndarray) -> None:
    """Write poses into upright ones (n, count, P, 7 or 13) of the P parts of a kind of solid.

    Args:
        solid: The solid.
        pose: Its poses, which are validated.
        origin: Origin (3,) [m] of the task frame in the world frame.
        made: What is written into; with sizes it has 13 numbers a part.

    Raises:
        QuadrlError: An array has the wrong shape, or numbers that no pose has.
    """
    rows, count, _, size = made.shape
    each = (rows,) if solid.count is None else (rows, count)
    place = _checked(f"position of {solid.name}", pose.position, (*each, 3))
    turn, own = None, solid
    if pose.quaternion is not None:
        turn = _unit(f"quaternion of {solid.name}", pose.quaternion, (*each, 4))
        turn = turn.reshape(rows, count, 4)
    if pose.size is not None:
        name = f"size of {solid.name} ({', '.join(solid.lengths)})"
        if size == 7:
            allowed = "None in `move` where `place` gives none"
            raise QuadrlError(name=name, value=pose.size, allowed=allowed)
        lengths = _checked(name, pose.size, (*each, len(solid.lengths)), MIN_LENGTH)
        own = solid.sized(lengths.reshape(rows, count, -1))
    for k, part in enumerate(own.parts):
        at = made[:, :, k]
        if pose.size is not None:
            at[..., 7:] = np.stack(np.broadcast_arrays(*part.size, *part.offset), axis=-1)
        for j, centre in enumerate(np.moveaxis(place.reshape(rows, count, 3), -1, 0)):
            np.add(centre, origin[j], out=at[..., j])  # in long loops, of all solids
        offset = at[..., 10:] if size > 7 else np.asarray(part.offset, dtype=float)
        if offset.any():
            at[..., :3] += offset if turn is None else _rotated(turn, offset)
        if turn is not None:
            at[..., 3:7] = turn


def _checked(
    name: str, given: Any, shape: tuple[int, ...], least: float = -MAX_OPTION
) -> np.ndarray:
    """Numbers of a shape, each between `least` and `MAX_OPTION`."""
    try:
        found = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        found = np.zeros(0)
    # NaN, as the least of all, is no number from `least` on.
    if found.shape != shape or not (found.min() >= least and found.max() <= MAX_OPTION):
        allowed = f"an array {shape} of numbers between {least:g} and {MAX_OPTION:g}"
        raise QuadrlError(name=name, value=given, allowed=allowed)
    return found


def _unit(name: str, given: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Unit quaternions (..., 4), from such whose length may be off by 1 %."""
    turn = _checked(name, given, shape)
    length = np.linalg.norm(turn, axis=-1, keepdims=True)
    wrong = abs(length[..., 0] - 1) > 0.01
    if wrong.any():
        raise QuadrlError(name=name, value=turn[wrong][0], allowed="(w, x, y, z) of length 1")
    return turn / length


def _rotated(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A vector (3,) or vectors (..., 3) turned by unit quaternions (..., 4)."""
    w, axis = quaternion[..., :1], quaternion[..., 1:]
    twice = 2 * cross(axis, vector)
    return vector + w * twice + cross(axis, twice)
