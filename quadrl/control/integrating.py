"""The geometric controller with an integral of the position error.

A proportional controller leaves a lasting error in a lasting wind, or with a mass that it does not
know. The sum of past errors takes it away.
"""

from __future__ import annotations

import numpy as np

from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import Array, norm
from quadrl.control.geometric import GeometricController
from quadrl.control.loops import Gains
from quadrl.control.reading import Guide, Reading

NEAR, MOST = 0.5, 1.0  # [m]: errors within are summed up, a long way is none; the largest sum


class Integrating(GeometricController):
    """The geometric controller, towards a place beyond the goal by the sum of past errors."""

    def __init__(self, vehicle: Vehicle, task: Guide, gains: Gains, integral: float) -> None:
        """Take the gains, and the rate of the integral [1/s]; it flies one batch of episodes."""
        super().__init__(vehicle, task, gains)
        self._rate = integral * vehicle.control_timestep
        self._sum: Array | float = 0.0  # (N, 3) [m], world frame

    def action(self, reading: Reading, offset: Array, velocity: Array) -> Array:
        """The action (N, R) towards a place at an offset, which moves at a velocity."""
        near = (norm(offset) < NEAR)[:, None]
        self._sum = np.clip(self._sum + self._rate * near * offset, -MOST, MOST)
        return super().action(reading, offset + self._sum, velocity)
