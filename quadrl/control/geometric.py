"""Geometric tracking control on SE(3), with the lag of the rotors in the design.

Lee, Leok and McClamroch, "Geometric Tracking Control of a Quadrotor UAV on SE(3)", CDC 2010. The
loops are those of `quadrl.control.loops`, flown at the control step; a task gives the setpoint
(`Task.guide`) and, where it needs them, gains of its own (`Task.gains`).
"""

from __future__ import annotations

import abc
import dataclasses
import math

import numpy as np

from quadrl.aircraft.aerodynamics import MOST_TAKEN
from quadrl.aircraft.parameters import Parameters, rows
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import Array
from quadrl.control.loops import MAX_HEADING_ERROR, Gains, Loops, turned
from quadrl.control.reading import Guide, Reading
from quadrl.engines.dynamics import ground_share


class Controller(abc.ABC):
    """A controller maps flat observations of a task to actions, as a policy does."""

    control_mode = "rotor"
    """The control mode of its actions."""

    def __init__(self, vehicle: Vehicle, task: Guide) -> None:
        """Take the aircraft, and the task that gives the setpoint."""
        self.vehicle, self.task = vehicle, task

    def __call__(self, observation: Array) -> Array:
        """Actions (..., R), within [-1, 1], for flat observations (..., size)."""
        rows = np.asarray(observation, dtype=np.float64)
        seen = rows.reshape(-1, rows.shape[-1])
        reading = Reading.of(seen, self.task.observation, self.vehicle, self.task.sensors)
        action = self.action(reading, *self.task.guide(reading))
        return action.reshape(*rows.shape[:-1], -1)

    @abc.abstractmethod
    def action(self, reading: Reading, offset: Array, velocity: Array) -> Array:
        """The action (N, R) that flies to a setpoint, which may move.

        Args:
            reading: The aircraft now.
            offset: Offset (N, 3) [m] of the setpoint, world frame.
            velocity: Velocity (N, 3) [m/s] of the setpoint, world frame.
        """


class GeometricController(Controller):
    """Position, velocity, attitude and body rate loops."""

    def __init__(self, vehicle: Vehicle, task: Guide, gains: Gains | None = None) -> None:
        """Place the poles, with the task's gains unless others are given."""
        super().__init__(vehicle, task)
        gains = gains or Gains(**task.gains)
        self._loops = Loops(vehicle, vehicle.control_timestep, "position", gains)
        self._parameters = Parameters.of(rows(vehicle))

    def action(self, reading: Reading, offset: Array, velocity: Array) -> Array:
        """The loops from the outermost to the innermost."""
        approach = self._loops.approach_velocity(offset, self._loops.gains.max_speed)
        heading = towards_east(reading.heading) if self.task.heading_matters else reading.heading
        error = reading.velocity - velocity - approach
        motion = self.task.feed_forward(reading)
        # The loops know rotors far from the ground: at what speeds those have the same lift.
        slower = self._slower(reading)
        reading = dataclasses.replace(reading, rotor_speed=reading.rotor_speed / slower)
        command = slower * self._loops.rotor_command(reading, error, heading, target_motion=motion)
        return np.clip((command - self.vehicle.hover_speed) / self.vehicle.action_scale, -1.0, 1.0)

    def _slower(self, reading: Reading) -> Array | float:
        """Rotor speeds over those of the same lift far from the ground, (N, R)."""
        if reading.height is None or not self.vehicle.aerodynamics.ground_effect:
            return 1.0
        origin = max(self.task.altitude, self.vehicle.ground_clearance)
        up, height = reading.rotation[..., 2, :], reading.height + origin
        taken = ground_share(self._parameters, up, height)
        return np.sqrt(1 - np.clip(taken, 0.0, MOST_TAKEN))


def towards_east(heading: Array) -> Array:
    """Unit vectors (N, 2): east, or the heading turned MAX_HEADING_ERROR towards it if farther."""
    cosine, sine = math.cos(MAX_HEADING_ERROR), math.sin(MAX_HEADING_ERROR)
    side = np.where(heading[:, 1] > 0, -sine, sine)
    nearer = turned(heading, np.stack([np.full_like(side, cosine), side], axis=-1))
    return np.where(heading[:, :1] > cosine, np.array([1.0, 0.0]), nearer)
