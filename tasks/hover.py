"""Hover: hold a static waypoint for the whole episode."""

from __future__ import annotations

import dataclasses

from quadrl.rotation import Array, namespace
from quadrl.state import Start, State
from quadrl.task import Draw, Errors, Fields, Measures, Task
from quadrl.vehicle import Vehicle


@dataclasses.dataclass(frozen=True)
class Hover(Task[Fields]):
    """Hold the origin of the task's frame, heading east."""

    name = "hover"
    asks = "hold a static waypoint for the whole episode, heading east"
    starts = "within 0.5 m of it, any heading, tilted up to 0.2 rad, at up to 0.3 m/s and 0.3 rad/s"
    ends = "more than 3 m away, on the ground, tilted past 90 degrees"
    solved = "in the air to the end, mean error of the last 2 s under 0.1 m"
    heading_matters = True

    radius: float = 0.5
    """Largest distance from the waypoint at the start [m]."""
    tilt: float = 0.2
    """Largest tilt at the start [rad]; the heading is any."""
    speed: float = 0.3
    """Largest speed at the start [m/s]."""
    spin: float = 0.3
    """Largest body rate at the start [rad/s]."""
    max_distance: float = 3.0
    """Distance from the waypoint that ends the episode [m]."""
    tolerance: float = 0.1
    """Largest final error that counts as success [m]."""

    def sample(self, draw: Draw, vehicle: Vehicle) -> tuple[Start, Fields]:
        """Near the waypoint, nearly level and slow; the rotors at hover speed."""
        position = draw.vector(self.radius)
        xp = namespace(position)
        start = Start(
            position=position,
            quaternion=draw.attitude(self.tilt),
            velocity=draw.vector(self.speed),
            body_rate=draw.vector(self.spin),
            rotor_speed=xp.full_like(draw.uniform(0, 1, 4), vehicle.hover_speed),
        )
        return start, Fields(goal=xp.zeros_like(position))

    def terminated(
        self, state: State, measures: Measures, fields: Fields, vehicle: Vehicle
    ) -> Array:
        """Away, on the ground or on its back."""
        away = measures.distance > self.max_distance
        return away | self.touches_ground(state, vehicle) | (state.cos_tilt < 0)

    def success(
        self, state: State, fields: Fields, errors: Errors, terminated: Array, truncated: Array
    ) -> Array:
        """Still flying at the end, and close."""
        return truncated & (errors.final < self.tolerance)
