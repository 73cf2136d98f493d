"""A planned way onto a surface of any incline, flown with feedback: the yardstick of perching.

It ends in an arc at constant thrust, over which the nose pitches up, and touches the surface at the
speed and nearly in the attitude that are asked for; a polynomial leads to it from rest. The
geometric controller follows both, with their acceleration and jerk fed forward.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy.interpolate import BPoly

from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import Array
from quadrl.control import Gains, GeometricController
from quadrl.control.reading import Reading
from tasks.perching import Perching

STEEPEST = math.radians(80.0)
"""Largest pitch of a plan [rad]: at 90 degrees the nose points up, and there is no heading."""


@dataclasses.dataclass(frozen=True)
class Way:
    """What a plan is made of."""

    turn: float
    """How long the arc takes [s]."""
    thrust: float
    """Thrust of the arc [weights]."""
    into: float
    """Speed of the touch into the surface [m/s]."""
    lean: float
    """How far the aircraft leans forward where the arc begins [rad]."""
    short: float
    """How far before the surface it ends [m], since who flies it is ahead of it."""
    run_up: float
    """How long the polynomial takes [s]."""


class PitchUp(GeometricController):
    """The geometric controller along a planned way; it flies one batch of episodes."""

    def __init__(self, vehicle: Vehicle, task: Perching, gains: Gains, way: Way) -> None:
        """Take the aircraft, a task that asks for one incline, the gains, and the plan."""
        super().__init__(vehicle, task, gains)
        self._way, self._incline = way, task.least_incline
        self._plan: list[Array] = []  # position from the goal and its derivatives, (K, N, 3) each
        self._step = 0

    def action(self, reading: Reading, offset: Array, velocity: Array) -> Array:
        """The action (N, R) along the way from where the first reading saw the aircraft."""
        if not self._plan:
            self._plan = self._planned(-offset)
        moment = min(self._step, len(self._plan[0]) - 1)
        self._step += 1
        place, moving, acceleration, jerk = (values[moment] for values in self._plan)
        reading = dataclasses.replace(reading, target_motion=(acceleration, jerk))
        return super().action(reading, offset + place, moving)

    def _planned(self, start: Array) -> list[Array]:
        """Position from the goal, velocity, acceleration and jerk at each control step."""
        arc = self._arc()
        first = np.stack([start, 0 * start, 0 * start])
        last = np.stack([0 * start + values[0] for values in arc[:3]])
        run_up = BPoly.from_derivatives([0.0, self._way.run_up], [first, last])
        times = np.arange(0.0, self._way.run_up, self.vehicle.control_timestep)
        return [
            np.concatenate([run_up.derivative(order)(times), values[:, None] + 0 * start])
            for order, values in enumerate(arc)
        ]

    def _arc(self) -> tuple[Array, Array, Array, Array]:
        """The same of the arc, (K, 3) each, whose end is the goal at the speed of the touch."""
        way, step = self._way, self.vehicle.control_timestep
        last = min(self._incline, STEEPEST)
        share = np.linspace(0.0, 1.0, round(way.turn / step) + 1)
        pitch = (last + way.lean) * share * share * (3 - 2 * share) - way.lean
        rate = (last + way.lean) * 6 * share * (1 - share) / way.turn
        none = 0.0 * pitch
        across = np.stack([-np.sin(pitch), none, np.cos(pitch)], axis=-1)
        along = np.stack([np.cos(pitch), none, np.sin(pitch)], axis=-1)
        acceleration = GRAVITY * (way.thrust * across - np.array([0.0, 0.0, 1.0]))
        jerk = -GRAVITY * way.thrust * rate[:, None] * along
        normal = np.array([-math.sin(self._incline), 0.0, math.cos(self._incline)])
        velocity = -way.into * normal - step * _left(acceleration)
        return way.short * normal - step * _left(velocity), velocity, acceleration, jerk


def _left(values: Array) -> Array:
    """What is left of the integral over (K, 3) values at each of them, by the trapezoidal rule."""
    pieces = np.append((values[1:] + values[:-1]) / 2, np.zeros((1, 3)), axis=0)
    return np.cumsum(pieces[::-1], axis=0)[::-1]
