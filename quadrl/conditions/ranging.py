"""Range finders: how far it is along rays from the aircraft, as sensors of the world measure it."""

from __future__ import annotations

import functools
from typing import Any, ClassVar

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, namespace
from quadrl.base.validation import number
from quadrl.conditions.sensor import Moment, Sensor, Sizes, register_sensor
from quadrl.engines.rays import MAX_RAYS, Frame, Rays

LEVEL = (1.0, 0.0, 0.0)


@register_sensor
class RangeFinder(Sensor):
    """Distances along rays to the nearest solid or to the ground, those to the right first.

    They fill a field of view evenly: `across` columns within `wide` and `up` rows within `high`,
    each ray in the middle of its cell; row by row, the lowest first, from the right to the left.
    """

    compiled = True
    name, unit = "range_finder", "m"
    exact: ClassVar[dict[str, float]] = {**Sensor.exact, "share": 0.0, "dropout": 0.0}
    formula = (
        "distance along each ray, reach where nothing is nearer; plus bias and noise where "
        "something is; reach where a sample is lost; within [0, reach], in whole steps of `step`; "
        "with log the natural logarithm of at least 0.01 m; with change, then what each is more "
        "than in the last sample, 0 at first"
    )

    across: int = 24
    """Rays side by side."""
    up: int = 1
    """Rows of them, one above the other."""
    wide: float = 360.0
    """Angle that they fill from side to side [deg]."""
    high: float = 0.0
    """Angle that they fill from bottom to top [deg]."""
    directions: tuple[tuple[float, float, float], ...] = ()
    """Directions of rays (x ahead, y to the left, z up) in place of those."""
    frame: Frame = "body"
    """What the rays turn with: the body, its heading alone (yaw), or nothing (world)."""
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where they begin, body frame, from the centre of mass [m]."""
    reach: float = 4.0
    """Largest distance that is seen [m]; where nothing is nearer it reads so."""
    share: float = 0.0
    """Standard deviation of the error of each sample as a share of the distance; beside `noise`."""
    dropout: float = 0.0
    """Share of samples of each ray in which it sees nothing."""
    step: float = 0.0
    """What distances are rounded to [m]; 0 for not at all."""
    log: bool = False
    """Whether logarithms of the distances are seen: what is near then counts for more."""
    change: bool = False
    """Whether it is seen, too, how much each has changed since the last sample."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        for name in ("across", "up"):
            number(f"{self.name} {name}", getattr(self, name), 1, MAX_RAYS, whole=True)
        number(f"{self.name} wide", self.wide, 0, 360)
        number(f"{self.name} high", self.high, 0, 180)
        for name in ("log", "change"):
            if not isinstance(given := getattr(self, name), bool):
                allowed = "True or False"
                raise QuadrlError(name=f"{self.name} {name}", value=given, allowed=allowed)
        _ = self.rays  # which are refused now

    @functools.cached_property
    def rays(self) -> Rays:  # type: ignore[override]
        """What is measured for it."""
        along: Any = self.directions
        if not len(along):
            a, e = (
                np.radians(size * ((np.arange(count) + 0.5) / count - 0.5))
                for size, count in ((self.wide, self.across), (self.high, self.up))
            )
            e, a = (angle.ravel() for angle in np.meshgrid(e, a, indexing="ij"))
            along = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
        errors = self.noise, self.share, self.dropout, self.step, self.log
        return Rays(along, self.reach, self.place, self.frame, *errors)

    def width(self, sizes: Sizes) -> int:
        """One number for each ray, and one for its change."""
        return self.rays.count * (1 + self.change)

    def drawn(self, width: int) -> int:
        """None: the errors are those of the rays."""
        return 0

    def sense(self, now: Moment) -> Array:
        """What the rays read, (n, B)."""
        return now.world.ranges(self.name)

    def sample(self, now: Moment, width: int) -> Array:
        """The same, and the change."""
        seen = self.sense(now)
        if not self.change:
            return seen
        last = seen if now.last is None else now.last[:, : self.rays.count]
        return namespace(seen).concatenate([seen, seen - last], axis=-1)


@register_sensor
class MultiRanger(RangeFinder):
    """Five beams of a Multi-ranger deck for a Crazyflie: ahead, left, behind, right, up.

    VL53L1x, which see 4 m; 20 Hz, millimetres.
    """

    compiled = True
    name = "multi_ranger"

    rate: float = 20.0
    directions: tuple[tuple[float, float, float], ...] = (
        LEVEL, (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0),
    )  # fmt: skip
    reach: float = 4.0
    step: float = 0.001


@register_sensor
class TimeOfFlight(RangeFinder):
    """A camera of 8 x 8 distances that looks ahead: VL53L5CX, 45 degrees, 4 m, 15 Hz."""

    compiled = True
    name = "time_of_flight"

    across: int = 8
    up: int = 8
    wide: float = 45.0
    high: float = 45.0
    rate: float = 15.0
    reach: float = 4.0
    step: float = 0.001


@register_sensor
class Ring(RangeFinder):
    """A level ring of 40 rays, as of a small scanning lidar that keeps its horizon."""

    compiled = True
    name = "ring"

    across: int = 40
    frame: Frame = "yaw"
    reach: float = 8.0


@register_sensor
class DepthImage(RangeFinder):
    """A depth image of 32 x 24 that looks ahead, as of a camera of 87 x 58 degrees."""

    compiled = True
    name = "depth_image"

    across: int = 32
    up: int = 24
    wide: float = 87.0
    high: float = 58.0
    reach: float = 6.0
