"""Approaches to a surface: how controllers come down to a pad, and states on the way to a touch."""

from __future__ import annotations

import math
from typing import NamedTuple

from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.rotors import GRAVITY
from quadrl.base.rotation import Array, namespace, norm, stack, zeros
from quadrl.control.reading import Reading
from quadrl.engines.rng import Rng, hovering
from quadrl.engines.state import Start

# How the yardstick controllers come down.
DESCENT_RATE = 0.8  # [1/s], sink speed over the height
TOUCHDOWN_SPEED = 0.2  # [m/s]
MAX_DESCENT_SPEED = 1.2  # [m/s]
WAITING_HEIGHT = 0.5  # [m], where they wait for the heading
RATE, THRUST, DIVE = (1.5, 3.5), (0.75, 1.1), 0.5  # [rad/s], [weights], [rad]: ways to a touch


class Way(NamedTuple):
    """States of aircraft in the plane of their approach, east and up."""

    position: Array  # (N, 3) [m]
    velocity: Array  # (N, 3) [m/s]
    pitch: Array  # (N,) [rad], nose up
    rate: Array  # (N,) [rad/s], of the pitch

    def start(self, parameters: Parameters) -> Start:
        """The same with the rotors at hover speed."""
        xp, none = namespace(self.pitch), zeros(self.pitch)
        return Start(
            position=self.position,
            quaternion=stack(xp.cos(self.pitch / 2), none, -xp.sin(self.pitch / 2), none),
            velocity=self.velocity,
            body_rate=stack(none, -self.rate, none),
            rotor_speed=hovering(self.position, parameters),
        )


def descent(reading: Reading, heading: float) -> tuple[Array, Array]:
    """Down to a pad, as `Task.guide` gives it; it lands heading at most so far off east [rad]."""
    xp = namespace(reading.to_goal)
    height = xp.clip(-reading.to_goal[..., 2], 0.0, None)
    aside = norm(reading.to_goal[..., :2])
    sink = xp.clip(DESCENT_RATE * height + TOUCHDOWN_SPEED, None, MAX_DESCENT_SPEED)
    sink = sink * xp.clip(1.5 - aside / (0.2 + 0.2 * height), 0.0, 1.0)  # within a cone
    wide, narrow = math.cos(2 * heading), math.cos(heading)
    east = reading.rotation[..., 0, 0]  # of the unit vector along body x
    turned = xp.clip((east - wide) / (narrow - wide), 0.0, 1.0)
    sink = xp.where(height > WAITING_HEIGHT, sink, sink * turned)
    zero = xp.zeros_like(sink)
    offset = stack(reading.to_goal[..., 0], reading.to_goal[..., 1], zero)
    return offset, stack(zero, zero, -sink)


def on_the_way(rng: Rng, incline: Array, into: tuple[float, float]) -> Way:
    """States some time before good touches, their positions from where those are.

    They lead there at a constant pitch rate and a constant thrust, so that their motion in the
    plane of the approach can be integrated backwards by hand.

    Args:
        rng: Draws them.
        incline: (N,) [rad], of the surface, and the pitch of the touch.
        into: Smallest and largest speed of the touch into the surface [m/s].
    """
    xp, none = namespace(incline), zeros(incline)
    rate, thrust = rng.uniform(*RATE), GRAVITY * rng.uniform(*THRUST)
    speed = rng.uniform(*into)
    time = rng.uniform(0.1, 1.0) * (incline + DIVE) / rate
    pitch = incline - rate * time
    # Integrals of sine and cosine of the pitch over the time that is left, and over that again.
    sine = (xp.cos(pitch) - xp.cos(incline)) / rate
    cosine = (xp.sin(incline) - xp.sin(pitch)) / rate
    sines = (cosine - time * xp.cos(incline)) / rate
    cosines = (time * xp.sin(incline) - sine) / rate
    last_x, last_z = speed * xp.sin(incline), -speed * xp.cos(incline)
    fall = GRAVITY * time
    velocity = stack(last_x + thrust * sine, none, last_z - thrust * cosine + fall)
    x = -last_x * time - thrust * sines
    z = -last_z * time + thrust * cosines - fall * time / 2
    return Way(stack(x, none, z), velocity, pitch, rate)
