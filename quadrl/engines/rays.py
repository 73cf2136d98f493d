"""Rays from N aircraft: how far it is along each to a solid or to the ground, and what is read."""

from __future__ import annotations

import dataclasses
from statistics import NormalDist
from typing import Literal, get_args

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, rotation_matrix
from quadrl.base.validation import MAX_OPTION, choice, number, numbers
from quadrl.engines import native
from quadrl.engines.engine import Engine

Frame = Literal["body", "yaw", "world"]
"""What directions turn with, in the order of `native/rays.c`: the body, its heading, nothing."""
MAX_RAYS = 1024
LEAST = 0.01
"""Smallest distance whose logarithm is taken [m]."""


@dataclasses.dataclass(frozen=True, eq=False)
class Rays:
    """Rays of a sensor, the same on each aircraft, and the errors of what it reads.

    Raises:
        QuadrlError: A number is impossible, or a direction has no length.
    """

    along: Array
    """Directions (B, 3), made unit vectors."""
    reach: float
    """Largest distance that is seen [m]; where nothing is nearer it is what they give."""
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where they begin, body frame, from the centre of mass [m]."""
    frame: Frame = "body"
    noise: float = 0.0
    """Standard deviation of the error of a distance [m]."""
    share: float = 0.0
    """Another one, as a share of the distance."""
    dropout: float = 0.0
    """Share of the distances that are lost, and read as reach."""
    step: float = 0.0
    """What distances are rounded to [m]; 0 for not at all."""
    log: bool = False
    """Whether logarithms are read, of at least LEAST."""

    def __post_init__(self) -> None:
        """Validate the numbers."""
        choice("frame of rays", self.frame, get_args(Frame))
        object.__setattr__(self, "reach", number("reach of rays", self.reach, 1e-3, MAX_OPTION))
        place = numbers("place of rays", self.place, 3, -MAX_OPTION, MAX_OPTION)
        object.__setattr__(self, "place", place)
        for name, most in (("noise", MAX_OPTION), ("share", 1), ("dropout", 0.99), ("step", 100)):
            number(f"{name} of rays", getattr(self, name), 0, most)
        along = np.array(self.along, dtype=float)
        allowed = f"directions (B, 3) of a length, 1 to {MAX_RAYS} of them"
        if along.ndim != 2 or along.shape[1] != 3 or not 1 <= len(along) <= MAX_RAYS:
            raise QuadrlError(name="rays", value=self.along, allowed=allowed)
        length = np.linalg.norm(along, axis=1, keepdims=True)
        if not (np.isfinite(length) & (length > 0)).all():
            raise QuadrlError(name="rays", value=self.along, allowed=allowed)
        object.__setattr__(self, "along", along / length)

    @property
    def count(self) -> int:
        """How many, B."""
        return len(self.along)

    def measured(self, engine: Engine, rows: np.ndarray | None = None) -> np.ndarray:
        """Distances [m] from aircraft (n,) of an engine, or of all, to what is met, (n, B).

        The ground and a solid are met from outside; a ray that begins in a solid ends where it
        leaves it.
        """
        solids, measure = engine.solids, native.library().quadrl_rays
        if rows is None and engine.forked:
            rows = np.arange(engine.num_envs)  # this way takes no threads
        count = engine.num_envs if rows is None else len(rows)
        out = np.empty((count, self.count))
        along, numbers = np.ascontiguousarray(self.along.T), np.array([*self.place, self.reach])
        qpos, frame = engine.qpos, get_args(Frame).index(self.frame)
        # As `Finder` in native/rays.c.
        arrays = qpos, along, numbers, numbers[3:], solids.table if solids.table.size else None
        where = native.struct(*arrays, qpos.strides[0] // 8, len(solids.geoms), self.count, frame)
        about, into = where.ctypes.data, out.ctypes.data
        if rows is None:
            solids.threads.call(lambda first, end: measure(about, first, end, None, into))
        elif count:
            measure(about, 0, count, rows.ctypes.data, into)
        return out

    @property
    def azimuth(self) -> Array:
        """Angle of each to the left of straight ahead, (B,) [rad]."""
        return np.arctan2(self.along[:, 1], self.along[:, 0])

    @property
    def elevation(self) -> Array:
        """Angle of each above the level, (B,) [rad]."""
        return np.arcsin(self.along[:, 2])

    @property
    def drawn(self) -> int:
        """How many normal numbers the errors of an aircraft's distances take."""
        return self.count * (bool(self.noise or self.share) + bool(self.dropout))

    def read(self, distance: Array, bias: Array | float, normal: Array) -> np.ndarray:
        """What is read of distances (n, B) [m], with a lasting error [m] and normal numbers."""
        seen, nothing = distance + bias, distance >= self.reach
        if self.noise or self.share:
            deviation = np.hypot(self.noise, self.share * distance)
            seen = seen + deviation * normal[:, : self.count]
        if self.dropout:
            nothing = nothing | (normal[:, -self.count :] > NormalDist().inv_cdf(1 - self.dropout))
        if self.step:
            seen = self.step * np.floor(seen / self.step + 0.5)
        seen = np.where(nothing, self.reach, np.clip(seen, 0.0, self.reach))
        return np.log(np.maximum(seen, LEAST)) if self.log else seen

    def distance(self, read: Array) -> np.ndarray:
        """The distances (n, B) [m] that what is read stands for."""
        return np.exp(read) if self.log else read

    @property
    def sharp(self) -> Rays:
        """The same without errors."""
        return dataclasses.replace(self, noise=0.0, share=0.0, dropout=0.0)

    def ends(self, position: Array, quaternion: Array, distance: Array) -> np.ndarray:
        """Both ends of the rays of one aircraft, (B, 2, 3) [m], world frame.

        Args:
            position: Of its centre of mass, (3,) [m], world frame.
            quaternion: Its attitude, (4,).
            distance: What `measured` gave, (B,) [m].
        """
        body = rotation_matrix(quaternion)
        turn = {"body": body, "world": np.eye(3)}.get(self.frame)
        if turn is None:
            level = np.hypot(body[0, 0], body[1, 0])
            c, s = body[:2, 0] / level if level > 0 else (1.0, 0.0)
            turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        first = np.broadcast_to(position + body @ self.place, self.along.shape)
        return np.stack([first, first + distance[:, None] * (self.along @ turn.T)], axis=1)
