"""Random waypoint: fly to a point drawn anew for every episode, and hover there."""

from __future__ import annotations

import dataclasses

from quadrl.contact import touches_ground
from quadrl.parameters import Parameters
from quadrl.rng import Rng
from quadrl.rotation import Array, namespace
from quadrl.state import Start
from quadrl.task import EpisodeEnd, Snapshot, Target, Task, TaskState


@dataclasses.dataclass(frozen=True)
class RandomWaypoint(Task):
    """Fly to a waypoint in a shell around the start and hold it; the heading is free."""

    name = "random_waypoint"
    asks = "fly to a waypoint drawn 1 to 2.5 m away, then hover on it until the end"
    starts = "at rest and level at the origin, any heading"
    ends = "more than 5 m from the waypoint, on the ground"
    solved = "in the air to the end, mean error of the last 2 s under 0.1 m"
    targets = (
        Target("success_rate", "successful", 0.99, True),
        Target("position_error_m", "error over the last 2 s", 0.06, unit="cm"),
    )
    # Some of those that practise up to 2.5 m fail at its edge: 13, 44 and 9 of 10,000 flights with
    # seeds 280 to 282. With practice up to 3 m fewer do: 0, 0, 0, 4 and 8 with seeds 375 to 379.
    training = {"steps": 3_276_800, "holds_goal": True, "practice": {"farthest": 3.0}}
    training_with = {"apg": {"steps": 102_400, "holds_goal": False}}
    variants = {"robust": {"steps": 4_096_000, "practice": {"farthest": 2.5}}}

    nearest: float = 1.0
    """Smallest distance of the waypoint from the start [m]."""
    farthest: float = 2.5
    """Largest distance of the waypoint from the start [m]."""
    max_distance: float = 5.0
    """Distance from the waypoint that ends the episode [m]."""
    tolerance: float = 0.1
    """Largest final error that counts as success [m]."""

    def begin(self, rng: Rng, parameters: Parameters) -> tuple[Start, TaskState]:
        """At rest at the origin, level, any heading."""
        goal = rng.vector(self.farthest, shortest=self.nearest)
        origin = namespace(goal).zeros_like(goal)
        return rng.level_start(origin, parameters), TaskState(goal=goal)

    def terminated(self, now: Snapshot) -> Array:
        """Far away or on the ground."""
        return (now.potentials.distance > self.max_distance) | touches_ground(now)

    def succeeded(self, now: Snapshot, end: EpisodeEnd) -> Array:
        """Still flying at the end, and close."""
        return end.truncated & (end.final_error < self.tolerance)
