"""Static waypoints: fly to fixed points in order, then hover on the last."""

from __future__ import annotations

import dataclasses
import reprlib
from collections.abc import Sequence

import numpy as np

from quadrl.rotation import Array, namespace
from quadrl.state import Start, State
from quadrl.task import Draw, Errors, Fields, Marker, Measures, OptionError
from quadrl.tasks.waypoints import WaypointTask
from quadrl.vehicle import Vehicle

WAITING: tuple[float, float, float, float] = (0.25, 0.55, 0.95, 0.30)


@dataclasses.dataclass
class Route(Fields):
    """Where the aircraft is on its route."""

    leg: Array  # (...) number of the current waypoint, from 0


@dataclasses.dataclass(frozen=True)
class StaticWaypoint(WaypointTask[Route]):
    """Fly to a list of waypoints in order, heading east, and hold the last."""

    name = "static_waypoint"
    asks = (
        "fly to fixed waypoints in order (one, 1.5 m away, unless others are given), then hover on "
        "the last until the end, heading east"
    )
    starts = "at rest at the origin, heading east, disturbed by up to 0.05 rad, m/s and rad/s"
    ends = "more than 5 m from the current waypoint, on the ground"
    solved = "in the air to the end, mean error of the last 2 s under 0.1 m, on the last waypoint"
    heading_matters = True

    waypoints: tuple[tuple[float, float, float], ...] = ((1.0, 1.0, 0.5),)
    """Where to fly, in order [m], task frame."""
    reach: float = 0.2
    """Distance at which a waypoint counts as reached and the next one is the goal [m]."""
    disturbance: float = 0.05
    """Largest tilt [rad], speed [m/s] and body rate [rad/s] at the start."""

    def __post_init__(self) -> None:
        """Refuse a route that is none."""
        try:
            points = tuple(tuple(map(float, point)) for point in self.waypoints)
        except (TypeError, ValueError, OverflowError):
            points = ()
        if not points or any(len(point) != 3 for point in points):
            raise OptionError(
                f"waypoints = {reprlib.repr(self.waypoints)}: at least one point of three "
                "coordinates is expected"
            )
        object.__setattr__(self, "waypoints", points)
        super().__post_init__()

    def sample(self, draw: Draw, vehicle: Vehicle) -> tuple[Start, Route]:
        """At rest at the origin, heading east, slightly disturbed."""
        velocity = draw.vector(self.disturbance)
        xp = namespace(velocity)
        position = xp.zeros_like(velocity)
        start = Start(
            position=position,
            quaternion=draw.attitude(self.disturbance, heading=0.0),
            velocity=velocity,
            body_rate=draw.vector(self.disturbance),
            rotor_speed=xp.full_like(draw.uniform(0, 1, 4), vehicle.hover_speed),
        )
        leg = xp.zeros_like(position[..., 0])
        return start, Route(goal=position + _point(self.waypoints[0], position), leg=leg)

    def update(self, state: State, measures: Measures, fields: Route, vehicle: Vehicle) -> Route:
        """On to the next waypoint when this one is reached."""
        xp = namespace(fields.goal)
        last = len(self.waypoints) - 1
        onward = (measures.distance < self.reach) & (fields.leg < last)
        if not onward.any():
            return fields
        leg = fields.leg + xp.where(onward, 1.0, 0.0)
        goal = fields.goal
        for number, waypoint in enumerate(self.waypoints):
            here = (onward & (leg == number))[..., None]
            goal = xp.where(here, _point(waypoint, goal), goal)
        return Route(goal=goal, leg=leg)

    def success(
        self, state: State, fields: Route, errors: Errors, terminated: Array, truncated: Array
    ) -> Array:
        """Still flying at the end, and close to the last waypoint."""
        close = super().success(state, fields, errors, terminated, truncated)
        return close & (fields.leg == len(self.waypoints) - 1)

    def markers(self, fields: Route) -> Sequence[Marker]:
        """The route, and the waypoints that are still to come, by number."""
        route = np.array([(0.0, 0.0, 0.0), *self.waypoints])
        later = [k for k in range(len(self.waypoints)) if k > fields.leg]
        spheres = [
            Marker("sphere", self.waypoints[k], 0.06, WAITING, label=str(k + 1)) for k in later
        ]
        return [Marker("path", size=0.004, rgba=WAITING, points=route), *spheres]


def _point(waypoint: tuple[float, float, float], like: Array) -> Array:
    """A waypoint (3,) as an array of the kind of another."""
    if isinstance(like, np.ndarray):
        return np.array(waypoint)
    return namespace(like).asarray(waypoint, dtype=like.dtype, device=like.device)
