"""Random waypoint: fly to a point drawn anew for every episode, and hover there."""

from __future__ import annotations

import dataclasses

from quadrl.rotation import namespace
from quadrl.state import Start
from quadrl.task import Draw, Fields
from quadrl.tasks.waypoints import WaypointTask
from quadrl.vehicle import Vehicle


@dataclasses.dataclass(frozen=True)
class RandomWaypoint(WaypointTask[Fields]):
    """Fly to a waypoint in a shell around the start and hold it; the heading is free."""

    name = "random_waypoint"
    asks = "fly to a waypoint drawn 1 to 2.5 m away, then hover on it until the end"
    starts = "at rest and level at the origin, any heading"
    ends = "more than 5 m from the waypoint, on the ground"
    solved = "in the air to the end, mean error of the last 2 s under 0.1 m"

    nearest: float = 1.0
    """Smallest distance of the waypoint from the start [m]."""
    farthest: float = 2.5
    """Largest distance of the waypoint from the start [m]."""

    def sample(self, draw: Draw, vehicle: Vehicle) -> tuple[Start, Fields]:
        """At rest at the origin, level, any heading."""
        goal = draw.vector(self.farthest, shortest=self.nearest)
        origin = namespace(goal).zeros_like(goal)
        return draw.level_start(origin, vehicle), Fields(goal=goal)
