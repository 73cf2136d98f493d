"""The linear-quadratic regulator around hover, sampled at the control step, rotor lag included.

Far from hover the errors are limited, and actions are clipped like the geometric controller's:
with neither, 59 of 100 flights from up to 60 degrees of tilt recover; with both, all do.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import Array
from quadrl.base.validation import number
from quadrl.control.allocation import Allocation, columns, product
from quadrl.control.geometric import Controller
from quadrl.control.loops import MAX_HEADING_ERROR, limited, sampled, turned
from quadrl.control.reading import Guide, Reading

STATES = {
    "position": slice(0, 3),  # [m], from where it should be
    "velocity": slice(3, 6),  # [m/s], relative to that place
    "attitude": slice(6, 9),  # [rad], small angles about x, y, z
    "body_rate": slice(9, 12),  # [rad/s]
    "rotor_speed": slice(12, None),  # (R) [rad/s], from hover
}
"""The state x (N, 12 + R) of the linear model; position and velocity along the heading."""


@dataclasses.dataclass(frozen=True)
class Weights:
    """Deviations that cost 1 each (Bryson's rule); the cost is the sum of their squares.

    An action of 1 costs 1; the rotor speed itself costs nothing.
    """

    position: float = 0.25
    """[m]"""
    velocity: float = 1.0
    """[m/s]"""
    tilt: float = 0.5
    """[rad]"""
    heading: float = 1.0
    """[rad]"""
    body_rate: float = 3.0
    """[rad/s]"""
    max_offset: float = 0.8
    """Farther goals are flown to as if they were this far [m]: the model is one of small tilts."""
    max_speed: float = 1.2
    """Larger errors of the velocity count as this much [m/s]."""

    def __post_init__(self) -> None:
        """Validate the weights."""
        for name, value in vars(self).items():
            number(name, value, positive=True)


def linear_model(vehicle: Vehicle) -> tuple[Array, Array]:
    """A (12 + R, 12 + R) and B (12 + R, R) of dx/dt = A x + B a around hover, for actions a.

    A rotor has one lag here, the mean of those up and down.
    """
    size = 12 + vehicle.rotor_count
    a, b = np.zeros((size, size)), np.zeros((size, vehicle.rotor_count))
    position, velocity, attitude, body_rate, rotor_speed = STATES.values()
    a[position, velocity] = a[attitude, body_rate] = np.eye(3)
    # Turned about y (nose down) the thrust pulls ahead, about x (left side up) to the right.
    a[velocity, attitude] = GRAVITY * np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 0]])
    slope = 2 * vehicle.hover_speed * vehicle.mixer  # (4, R), of thrust and moments
    a[velocity.stop - 1, rotor_speed] = slope[0] / vehicle.mass
    a[body_rate, rotor_speed] = slope[1:] / np.array(vehicle.inertia)[:, None]
    lag = np.diag([(rotor.lag_up + rotor.lag_down) / 2 for rotor in vehicle.rotors])
    a[rotor_speed, rotor_speed] = -lag
    b[rotor_speed] = vehicle.action_scale * lag
    return a, b


class LQRController(Controller):
    """Linear state feedback."""

    def __init__(self, vehicle: Vehicle, task: Guide, weights: Weights | None = None) -> None:
        """Solve the Riccati equation, with the default weights unless others are given."""
        from scipy.linalg import solve_discrete_are  # slow to import

        super().__init__(vehicle, task)
        self.weights = w = weights or Weights()
        self.a, self.b = sampled(*linear_model(vehicle), vehicle.control_timestep)
        """The sampled model: x(k + 1) = a x(k) + b action(k)."""
        count = vehicle.rotor_count
        deviations = np.repeat(
            [w.position, w.velocity, w.tilt, w.heading, w.body_rate, np.inf], [3, 3, 2, 1, 3, count]
        )
        self.q, self.r = np.diag(deviations**-2), np.eye(count)
        """Weights of a state and of an action in the cost x' q x + action' r action."""
        self.p = solve_discrete_are(self.a, self.b, self.q, self.r)
        """The remaining cost from a state is x' p x."""
        weight = self.r + self.b.T @ self.p @ self.b
        self.gain = np.linalg.solve(weight, self.b.T @ self.p @ self.a)
        """(R, 12 + R): action = -gain x."""
        # (R,) squared rotor speed per action, around hover.
        slope = 2 * vehicle.hover_speed * vehicle.action_scale
        inverse = np.linalg.pinv(vehicle.mixer) / slope[:, None]
        self._feedback = -(vehicle.mixer * slope) @ self.gain  # (4, 12 + R), to thrust and moments
        self._allocation = Allocation(inverse, -np.ones(count), np.ones(count))

    def action(self, reading: Reading, offset: Array, velocity: Array) -> Array:
        """The feedback of limited errors, along the heading."""
        to_heading = reading.heading * np.array([1.0, -1.0])
        east, north = reading.heading.T
        turn = np.zeros_like(north)
        if self.task.heading_matters:
            turn = np.where(east > 0, north, np.where(north < 0, -1.0, 1.0))
            turn = np.clip(turn, -MAX_HEADING_ERROR, MAX_HEADING_ERROR)
        up = turned(reading.rotation[:, :, 2], to_heading)
        errors = (
            -turned(limited(offset, self.weights.max_offset), to_heading),
            turned(limited(reading.velocity - velocity, self.weights.max_speed), to_heading),
            np.stack([-up[:, 1], up[:, 0], turn], axis=-1),
            reading.body_rate,
            reading.rotor_speed - self.vehicle.hover_speed,
        )
        return self._allocation.mix(product(self._feedback, columns(*errors)))
