"""Sensors of the motion, the rotors and the air, each with its own errors, delay and rate.

A sensor is a frozen dataclass: its fields are its options, its methods are pure functions of a
`Moment`. To add one, register a class with a name and `sense`. Others sense where to fly
(`targets`), what was before (`views`) and along rays (`ranging`). In a control step they are read
in order: rotor speeds, the state estimate, measurements; then, after the task's functions, the
task's entries, the history, and what the critic alone sees.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.rotors import GRAVITY, MAX
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, namespace, norm, stack, to_body, to_world
from quadrl.base.validation import choice, number
from quadrl.conditions.sensor import SENSORS as SENSORS
from quadrl.conditions.sensor import Memory, Moment, Sensor, Sizes, register_sensor
from quadrl.conditions.sensor import make as make
from quadrl.engines.dynamics import thrust_wrench
from quadrl.engines.state import State

WEIGHT = np.array([0.0, 0.0, -GRAVITY])


@register_sensor
class RotorSpeed(Sensor):
    """Rotor speeds, for the estimate."""

    compiled = True
    name, unit, measured, shown = "rotor_speed", "rad/s", False, False
    formula = (
        "source true: speed as measured. estimated: speed = hover_speed as an episode begins, and "
        "in each control step speed += (1 - exp(-T lag)) (asked - speed), asked = min(command, "
        "max_speed), lag = lag_up where asked > speed, else lag_down; at once: neither dead_time "
        "nor a delay is in it. Where loops command the rotors, T is the physics_timestep"
    )

    source: Literal["true", "estimated"] = "true"
    """True, or what follows from the commands with the lag that is specified."""
    entry: bool = True
    """Whether the task's entry of them is seen."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        choice("rotor_speed source", self.source, ("true", "estimated"))

    @property
    def hides(self) -> tuple[str, ...]:
        """The task's entry, unless `entry` is true."""
        return () if self.entry else ("rotor_speed",)

    def width(self, sizes: Sizes) -> int:
        """One for each rotor."""
        return sizes.rotors

    def begin(self, now: Moment) -> Memory:
        """A model starts from hover: no aircraft knows its true speeds."""
        hover, shape = now.parameters.rotor.hover_speed, now.true.rotor_speed.shape
        return {} if self.source == "true" else {"speed": np.broadcast_to(hover, shape)}

    @property
    def follows(self) -> bool:
        """Whether they are modelled."""
        return self.source == "estimated"

    def follow(
        self, memory: Memory, specified: Parameters, command: Array, seconds: float
    ) -> Memory:
        """Each speed approaches its command, up to the rotor's largest speed."""
        speed, rotor = memory["speed"], specified.rotor
        goal = np.minimum(command, rotor.max_speed)
        up, down = (1 - np.exp(-seconds * lag) for lag in (rotor.lag_up, rotor.lag_down))
        return {"speed": speed + np.where(goal > speed, up, down) * (goal - speed)}

    def sense(self, now: Moment) -> Array:
        """The true or modelled speeds."""
        return now.true.rotor_speed if self.source == "true" else now.memory["speed"]

    def tell(self, now: Moment, seen: Array) -> None:
        """Give the speeds to the estimate."""
        now.rotor_speed = seen


@register_sensor
class StateEstimate(Sensor):
    """Coordinates of the state as they are estimated on board, which all that is seen follows from.

    Its errors are the randomization's `noise` and `bias`, three of each of position, attitude,
    velocity and body rate. Its age is `observation_delay`, that of the body rate `rate_delay`.
    """

    compiled = True
    name, unit, measured, shown = "estimate", "", False, False
    formula = (
        "position, attitude, velocity and body rate as estimated on board; their errors and ages "
        "in training are those of the scenario's randomization"
    )

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        for name in ("noise", "bias"):
            if value := getattr(self, name):
                allowed = f"0; its errors are `{name}` of the randomization"
                raise QuadrlError(name=f"estimate {name}", value=value, allowed=allowed)

    def width(self, sizes: Sizes) -> int:
        """Position, quaternion, velocity, body rate, rotor speeds."""
        return 13 + sizes.rotors

    def sense(self, now: Moment) -> Array:
        """The coordinates of the drawn ages with errors; the attitude is turned by small angles."""
        xp, aged, errors = namespace(now.aged), now.aged, now.errors
        a, b, c = (errors[:, k] / 2 for k in (3, 4, 5))  # about the axes of the body
        w, x, y, z = (aged[:, k] for k in (3, 4, 5, 6))
        turned = stack(
            w - x * a - y * b - z * c,
            x + w * a + y * c - z * b,
            y + w * b + z * a - x * c,
            z + w * c + x * b - y * a,
        )
        turned = turned / norm(turned)[:, None]
        turns = (a != 0) | (b != 0) | (c != 0)  # else it keeps every bit
        attitude = xp.where(turns[:, None], turned, aged[:, 3:7])
        parts = aged[:, :3] + errors[:, :3], attitude, aged[:, 7:] + errors[:, 6:], now.rotor_speed
        return xp.concatenate(parts, axis=1)

    def tell(self, now: Moment, seen: Array) -> None:
        """Make the estimate the state that the other sensors and the task see."""
        now.state = self.state(seen, now.origin)

    @staticmethod
    def state(seen: Array, origin: Array) -> State:
        """The state of what is seen (n, 13 + R), in a frame with an origin (3,) [m]."""
        parts = (seen[:, first:last] for first, last in ((3, 7), (7, 10), (10, 13), (13, None)))
        return State.of_coordinates(seen[:, :3] - origin, *parts, origin_height=float(origin[2]))


@register_sensor
class Entries(Sensor):
    """The task's own entries of the observation."""

    compiled = True
    name, unit, last = "state", "", True
    formula = "the task's entries of the estimated state, side by side"

    def width(self, sizes: Sizes) -> int:
        """All entries that are seen."""
        return sizes.entries

    def sense(self, now: Moment) -> Array:
        """The entries as the task gives them."""
        return now.entries


@register_sensor
class RelativeRotorSpeed(Sensor):
    """Rotor speeds less that of hover, over that of hover; in the place of the task's own entry."""

    compiled = True
    name = "relative_rotor_speed"
    formula = "speed / hover_speed - 1, speed of the sensor rotor_speed"

    @property
    def hides(self) -> tuple[str, ...]:
        """The task's entry, which is relative to the largest speed."""
        return ("rotor_speed",)

    def width(self, sizes: Sizes) -> int:
        """One for each rotor."""
        return sizes.rotors

    def sense(self, now: Moment) -> Array:
        """From the estimate, whose speeds the sensor `rotor_speed` gives."""
        return now.state.rotor_speed / now.parameters.rotor.hover_speed - 1.0


@register_sensor
class Rotation(Sensor):
    """Rotation matrix from body to world, row by row."""

    compiled = True
    name, size, formula = "rotation", 9, "R, row by row"

    def sense(self, now: Moment) -> Array:
        """From the estimated attitude."""
        return now.state.rotation_entries


@register_sensor
class Airspeed(Sensor):
    """Velocity through the air, body frame."""

    compiled = True
    name, size, unit, formula = "airspeed", 3, "m/s", "R^T (v - wind)"

    def sense(self, now: Moment) -> Array:
        """From the estimated velocity."""
        return to_body(now.state.rotation, now.state.velocity - now.wind)


@register_sensor
class Clearance(Sensor):
    """Free distance to the nearest solid or to the ground, whichever is nearer."""

    compiled = True
    name, unit = "clearance", "m"
    formula = "least of: distance to the nearest solid, height of the lowest part, reach"

    reach: float = 10.0
    """Largest distance that is seen [m]; all that is farther away reads so."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        number("clearance reach", self.reach, 0, MAX)

    def sense(self, now: Moment) -> Array:
        """As it is measured from the true state."""
        free = np.minimum(now.world.clearance, now.above_ground)
        return np.minimum(free, self.reach)[:, None]


@register_sensor
class Disturbance(Sensor):
    """Acceleration that weight and specified thrust do not explain, body frame."""

    compiled = True
    name, size, unit = "disturbance", 3, "m/s^2"
    formula = (
        "R^T felt; felt = 0 as an episode begins, and after each control step felt += share "
        "((v - last v) / T - (thrust + last thrust) / 2 - (0, 0, -9.81) - felt), "
        "share = 1 - exp(-T / smoothing), or 1 with smoothing 0; thrust = R sum(thrust_coefficient "
        "speed^2 axis) / mass, of the rotors as specified, speed of the sensor rotor_speed"
    )

    smoothing: float = 0.1
    """Time constant of its low pass [s]; with 0 it is what the last control step shows."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        number("disturbance smoothing", self.smoothing, 0, MAX)

    def share(self, timestep: float) -> float:
        """The share of a change that is felt within a control step [s]."""
        return 1 - math.exp(-timestep / self.smoothing) if self.smoothing else 1.0

    def begin(self, now: Moment) -> Memory:
        """Nothing is felt yet."""
        motion = moving(now.parameters, now.state)
        return {"motion": motion, "felt": np.zeros((len(motion), 3))}

    def update(self, now: Moment) -> Memory:
        """Smooth the acceleration of the last control step."""
        last, motion = now.memory["motion"], moving(now.parameters, now.state)
        timestep = float(now.parameters.control_timestep)
        share = self.share(timestep)
        return {"motion": motion, "felt": felt(now.memory["felt"], last, motion, timestep, share)}

    def sense(self, now: Moment) -> Array:
        """The smoothed acceleration in the body frame."""
        return to_body(now.state.rotation, now.memory["felt"])


def moving(specified: Parameters, state: State) -> Array:
    """Velocity [m/s] and the acceleration by the specified thrust [m/s^2], (n, 6), world frame."""
    force, _ = thrust_wrench(specified, state.rotor_speed)
    thrust = to_world(state.rotation, force / specified.mass[:, None])
    return np.concatenate([state.velocity, thrust], axis=-1)


def felt(
    disturbance: Array, last: Array, now: Array, timestep: float, share: Array | float
) -> Array:
    """The acceleration that weight and specified thrust do not explain, smoothed.

    Args:
        disturbance: The last result, (n, 3) [m/s^2], world frame.
        last: Result of `moving` a control step ago, (n, 6).
        now: Its present result.
        timestep: Control timestep [s].
        share: Share of a change that is felt within it, as `Disturbance.share`.
    """
    rate = (now[:, :3] - last[:, :3]) / timestep
    rate = rate - (0.5 * (now[:, 3:] + last[:, 3:]) + WEIGHT)
    return disturbance + share * (rate - disturbance)
