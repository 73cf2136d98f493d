"""What the two waypoint tasks share: fly to a point, then hover there until the end."""

from __future__ import annotations

import dataclasses

from quadrl.rotation import Array
from quadrl.state import State
from quadrl.task import Errors, FieldsT, Measures, Task
from quadrl.vehicle import Vehicle


@dataclasses.dataclass(frozen=True)
class WaypointTask(Task[FieldsT]):
    """Fly to the goal and hold it."""

    max_distance: float = 5.0
    """Distance from the current waypoint that ends the episode [m]."""
    tolerance: float = 0.1
    """Largest final error that counts as success [m]."""

    def terminated(
        self, state: State, measures: Measures, fields: FieldsT, vehicle: Vehicle
    ) -> Array:
        """Far away or on the ground."""
        return (measures.distance > self.max_distance) | self.touches_ground(state, vehicle)

    def success(
        self, state: State, fields: FieldsT, errors: Errors, terminated: Array, truncated: Array
    ) -> Array:
        """Still flying at the end, and close."""
        return truncated & (errors.final < self.tolerance)
