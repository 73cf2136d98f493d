"""Static waypoints: fly to fixed points in order, then hover on the last."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, namespace, stack
from quadrl.base.validation import MAX_OPTION, numbers
from quadrl.core import rewards
from quadrl.core.contact import touches_ground
from quadrl.core.markers import Marker
from quadrl.core.task import STILL, EpisodeEnd, Snapshot, Target, Task, TaskState, heads_east
from quadrl.engines.rng import Rng, hovering
from quadrl.engines.state import Start

WAITING = (0.25, 0.55, 0.95, 0.30)


@dataclasses.dataclass(frozen=True)
class Route(TaskState):
    """Where the aircraft is on its route."""

    leg: Array  # (N,) number of the current waypoint, from 0


@dataclasses.dataclass(frozen=True)
class StaticWaypoint(Task):
    """Fly to a list of waypoints in order, heading east, and hold the last."""

    name = "static_waypoint"
    compiled = True
    asks = (
        "fly to fixed waypoints in order (default: one, 1.5 m away), then hover on the last until "
        "the end, heading east"
    )
    starts = "at rest at the origin, heading east, disturbed by up to 0.05 rad, m/s and rad/s"
    ends = "more than 5 m from the current waypoint, on the ground"
    solved = (
        "in the air until the end, mean error of the last 2 s under 0.1 m, on the last waypoint, "
        "within 10 degrees of east"
    )
    targets = (
        Target("success_rate", "successful", 1.0, True),
        Target("position_error_m", "error over the last 2 s", 0.05),
        Target("heading_error_deg", "off east", 5.0),
        *STILL,
    )
    training = {"gamma": 0.9, "holds_goal": True, "ppo": {"learning_rate": 8e-3}}
    training_with = {"apg": {"steps": 153_600, "holds_goal": False}}
    heading_matters = True

    waypoints: tuple[tuple[float, float, float], ...] = ((1.0, 1.0, 0.5),)
    """Waypoints in order [m], task frame."""
    reach: float = 0.2
    """Distance at which a waypoint counts as reached and the next one is the goal [m]."""
    disturbance: float = 0.05
    """Largest tilt [rad], speed [m/s] and body rate [rad/s] at the start."""
    max_distance: float = 5.0
    """Distance from the current waypoint that ends the episode [m]."""
    tolerance: float = 0.1
    """Largest final error that counts as success [m]."""
    heading_tolerance: float = math.radians(10.0)
    """Largest angle off east at the end that counts as success [rad]."""

    def __post_init__(self) -> None:
        """Validate the route."""
        name, route = f"{self.name} waypoints", self.waypoints
        listed = isinstance(route, (Sequence, np.ndarray)) and not isinstance(route, str)
        if not listed or not len(route):
            raise QuadrlError(name=name, value=route, allowed="at least one point [x, y, z]")
        points = tuple(numbers(name, point, 3, -MAX_OPTION, MAX_OPTION) for point in route)
        object.__setattr__(self, "waypoints", points)
        super().__post_init__()

    def begin(self, rng: Rng, parameters: Parameters) -> tuple[Start, Route]:
        """At rest at the origin, heading east, slightly disturbed."""
        velocity = rng.vector(self.disturbance)
        position = namespace(velocity).zeros_like(velocity)
        start = Start(
            position=position,
            quaternion=rng.attitude(self.disturbance, heading=0.0),
            velocity=velocity,
            body_rate=rng.vector(self.disturbance),
            rotor_speed=hovering(position, parameters),
        )
        return start, Route(goal=self._waypoint(0, position), leg=position[..., 0])

    def update(self, before: Snapshot, now: Snapshot) -> Route:
        """Advance to the next waypoint when this one is reached."""
        xp, task = namespace(now.task.goal), now.task
        onward = (now.potentials.distance < self.reach) & (task.leg < len(self.waypoints) - 1)
        goal = task.goal
        for number in range(1, len(self.waypoints)):
            here = (onward & (task.leg == number - 1))[..., None]
            goal = xp.where(here, self._waypoint(number, goal), goal)
        return Route(goal=goal, leg=xp.where(onward, task.leg + 1, task.leg))

    def reward(self, before: Snapshot, now: Snapshot, end: EpisodeEnd) -> dict[str, Array]:
        """Nearer to the waypoint, level and heading east, slower, at little effort, in the air."""
        terms = "progress", "attitude", "speed", "spin", "control", "survival", "smoothness"
        return rewards.weighted(self, terms, before, now)

    def terminated(self, now: Snapshot) -> dict[str, Array]:
        """Far away or on the ground."""
        away = now.potentials.distance > self.max_distance
        return {"away": away, "ground": touches_ground(now)}

    def succeeded(self, now: Snapshot, end: EpisodeEnd) -> Array:
        """Still flying at the end, close to the last waypoint, and heading east."""
        last = now.task.leg == len(self.waypoints) - 1
        close = end.final_error < self.tolerance
        return end.truncated & close & last & heads_east(now, self.heading_tolerance)

    def markers(self, now: Snapshot) -> Sequence[Marker]:
        """The route, and the waypoints that are still to come, by number."""
        route = np.array([(0.0, 0.0, 0.0), *self.waypoints])
        later = [k for k in range(len(self.waypoints)) if k > now.task.leg[0]]
        spheres = [
            Marker("sphere", self.waypoints[k], 0.06, WAITING, label=str(k + 1)) for k in later
        ]
        return [Marker("path", size=0.004, rgba=WAITING, points=route), *spheres]

    def _waypoint(self, number: int, like: Array) -> Array:
        """A waypoint, a row per row of another array (N, 3)."""
        return stack(*(0 * like[..., 0] + x for x in self.waypoints[number]))
