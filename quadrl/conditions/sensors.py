"""Sensors: estimates, measurements and histories, each with its own errors, delay and rate.

A sensor is a frozen dataclass: its fields are its options, its methods are pure functions of a
`Moment`. To add one, register a class with a name and `sense`. In a control step sensors are read
in order: rotor speeds, the state estimate, measurements; then, after the task's functions, the
task's entries, the history, and what the critic alone sees.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.quadrotor import as_x, turned
from quadrl.aircraft.rotors import GRAVITY, MAX
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, namespace, norm, stack, to_body, to_world
from quadrl.base.validation import choice, number
from quadrl.conditions.sensor import SENSORS as SENSORS
from quadrl.conditions.sensor import Memory, Moment, Sensor, Sizes, register_sensor
from quadrl.conditions.sensor import make as make
from quadrl.engines.dynamics import thrust_wrench
from quadrl.engines.state import State

LONGEST_HISTORY = 1000
WEIGHT = np.array([0.0, 0.0, -GRAVITY])
MOTION = 3  # numbers of `Standard` before its flags


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


@register_sensor
class Aim(Sensor):
    """From the aircraft to a place beyond the goal by the sum of past offsets, body frame.

    It replaces the goal and the position: a policy that flies to this place as to a goal comes to
    rest at the goal itself under any constant force, since the place moves on until then.
    """

    compiled = True
    name, size, unit, last = "aim", 3, "m", True
    formula = (
        "R^T (goal - p + sum); sum = 0 as an episode begins, and after each control step, where "
        "|goal - p| < near, sum += gain T (goal - p); then each number of sum is clipped to "
        "[-most, most]"
    )

    gain: float = 0.5
    """What the place moves on in a second, of the offset [1/s]."""
    near: float = 0.5
    """Longer offsets [m] are ways and are not summed up."""
    most: float = 1.0
    """Largest distance of the place from the goal along each axis of the world [m]."""
    beside_goal: bool = False
    """Whether the goal is seen, too: then who learns can answer a gust, whose offset passes, and a
    lasting force each in its own way."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        for name in ("gain", "near", "most"):
            number(f"aim {name}", getattr(self, name), 0, MAX)
        given: Any = self.beside_goal
        if not isinstance(given, bool):
            raise QuadrlError(name="aim beside_goal", value=given, allowed="True or False")

    @property
    def hides(self) -> tuple[str, ...]:
        """The entries that tell where the goal is."""
        return ("position",) if self.beside_goal else ("position", "goal")

    def begin(self, now: Moment) -> Memory:
        """The sum is zero."""
        return {"sum": np.zeros((len(now.wind), self.size))}

    def update(self, now: Moment) -> Memory:
        """Add the offset to the sum if it is short."""
        offset = to_world(now.state.rotation, now.estimated["goal"])
        added = np.where(norm(offset)[:, None] < self.near, offset, 0.0)
        seconds = float(now.parameters.control_timestep)
        summed = now.memory["sum"] + self.gain * seconds * added
        return {"sum": np.clip(summed, -self.most, self.most)}

    def sense(self, now: Moment) -> Array:
        """The goal of the estimated state, plus the sum in the body frame."""
        return now.estimated["goal"] + to_body(now.state.rotation, now.memory["sum"])


@register_sensor
class Offset(Sensor):
    """Position from the goal and velocity, world frame, clipped: how PX4's mc_raptor sees them."""

    compiled = True
    name, size, unit, last = "offset", 6, "m, m/s", True
    formula = "p - goal, each number clipped to [-near, near]; v, to [-slow, slow]"

    near: float = 0.5
    """Largest distance along each axis that is seen [m]."""
    slow: float = 1.0
    """Largest speed along each axis that is seen [m/s]."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        for name in ("near", "slow"):
            number(f"offset {name}", getattr(self, name), 0, MAX)

    @property
    def hides(self) -> tuple[str, ...]:
        """The entries that tell the same and more."""
        return "position", "sin_attitude", "cos_attitude", "velocity", "goal"

    def sense(self, now: Moment) -> Array:
        """Both as they are estimated."""
        way = to_world(now.state.rotation, now.estimated["goal"])
        parts = (
            np.clip(-way, -self.near, self.near),
            np.clip(now.state.velocity, -self.slow, self.slow),
        )
        return np.concatenate(parts, axis=-1)


@register_sensor
class Level(Sensor):
    """What a quadrotor sees without a heading, in the frame in which its rotors are an X.

    The goal moves on by the sum of past offsets, as in `Aim`, and the yaw rate by that of the turns
    so far: then a policy comes to rest at the goal without knowing how strong its rotors are.
    """

    compiled = True
    name, size, unit, last = "level", 12, "1, m, m/s, rad/s", True
    formula = (
        "side by side, each turned into the frame of the X: R^T (0, 0, 1); R^T (goal - p + sum), "
        "each number clipped to [-near, near]; R^T v; body rate + (0, 0, gain turn). sum and turn "
        "are 0 as an episode begins; after each control step turn += T (body rate about z), and "
        "sum += gain T (goal - p) where |goal - p| < near; then each number of both is clipped to "
        "[-most, most]"
    )

    near: float = 0.6
    """Largest distance along each axis that is seen, and longest offset that is summed up [m]."""
    gain: float = 0.5
    """What a second adds to the sum, of the offset [1/s]; the weight of the turns, too."""
    most: float = 1.0
    """Largest number of the sum [m] and of the turn [rad]."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        for name in ("near", "gain", "most"):
            number(f"level {name}", getattr(self, name), 0, MAX)

    @property
    def hides(self) -> tuple[str, ...]:
        """The entries that tell the same, or a heading."""
        return "position", "sin_attitude", "cos_attitude", "velocity", "body_rate", "goal"

    def begin(self, now: Moment) -> Memory:
        """Both are zero."""
        return {"sum": np.zeros((len(now.wind), 3)), "turn": np.zeros((len(now.wind), 1))}

    def update(self, now: Moment) -> Memory:
        """Add the offset to the sum if it is short, and the yaw rate to the turn."""
        offset = to_world(now.state.rotation, now.estimated["goal"])
        added = np.where(norm(offset)[:, None] < self.near, offset, 0.0)
        seconds = float(now.parameters.control_timestep)
        summed = now.memory["sum"] + self.gain * seconds * added
        turn = now.memory["turn"] + seconds * now.state.body_rate[:, 2:]
        return {
            "sum": np.clip(summed, -self.most, self.most),
            "turn": np.clip(turn, -self.most, self.most),
        }

    def sense(self, now: Moment) -> Array:
        """From the estimated state, in the frame of the X of the specified aircraft."""
        rotor, state = now.parameters.rotor, now.state
        _, turn = as_x(rotor.position[0], rotor.spin[0])
        aim = now.estimated["goal"] + to_body(state.rotation, now.memory["sum"])
        rate = state.body_rate
        rate = np.concatenate([rate[:, :2], rate[:, 2:] + self.gain * now.memory["turn"]], axis=-1)
        seen = state.rotation[..., 2, :], np.clip(aim, -self.near, self.near), state.body_velocity
        return np.concatenate([turned(part, turn) for part in (*seen, rate)], axis=-1)


@register_sensor
class Airframe(Sensor):
    """What its rotors can do, as a quadrotor in an X: the normalised allocation matrix."""

    name, size, unit, measured = "airframe", 16, "log(g), log(rad/s^2)", False
    formula = (
        "ln of what each rotor gives at its largest speed: acceleration [g] along z, and the sizes "
        "of the angular accelerations [rad/s^2] about x, y, z of the X"
    )
    compiled = True

    def sense(self, now: Moment) -> Array:
        """Of the aircraft as it was drawn."""
        return now.airframe


@register_sensor
class Standard(Sensor):
    """What is asked, in the same numbers for several tasks: how a target moves, and which task.

    One policy can then fly each of them by its own name, and the same numbers where they are drawn.
    """

    compiled = True
    name, last = "standard", True
    formula = (
        "the task's entry target_velocity, zeros without one; then for each name of tasks 1 where "
        "it is the task's, else 0"
    )

    tasks: tuple[str, ...] = (
        "hover",
        "static_waypoint",
        "random_waypoint",
        "straight_and_level",
        "landing",
        "target_following",
    )
    """Names of the tasks that it knows."""

    @property
    def hides(self) -> tuple[str, ...]:
        """The entries in whose place it stands."""
        return "target_velocity", "task"

    def check(self, tasks: tuple[str, ...]) -> None:
        """Refuse a task that is not among those that it knows."""
        for task in tasks:
            if task not in self.tasks:
                raise QuadrlError(name="standard tasks", value=self.tasks, allowed=f"with {task}")

    def width(self, sizes: Sizes) -> int:
        """A velocity, and a flag for each task."""
        return MOTION + len(self.tasks)

    def sense(self, now: Moment) -> Array:
        """From the entries that it hides."""
        xp, seen = namespace(now.wind), now.estimated
        zeros, one = 0.0 * now.wind, 0.0 * now.wind[:, :1] + 1.0
        drawn = seen.get("task", one)
        flags = (
            sum((drawn[:, k, None] for k, name in enumerate(now.tasks) if name == known), 0.0 * one)
            for known in self.tasks
        )
        return xp.concatenate([seen.get("target_velocity", zeros), *flags], axis=-1)


@dataclasses.dataclass(frozen=True)
class History(Sensor):
    """The last of something, the newest first."""

    measured = False

    length: int = 1
    """How many; zeros before the first."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        number(f"{self.name} length", self.length, 1, LONGEST_HISTORY, whole=True)


@register_sensor
class ActionHistory(History):
    """The last actions, the newest first."""

    compiled = True
    name = "action_history"
    formula = "the last `length` actions, clipped to [-1, 1], the newest first; zeros before them"

    def width(self, sizes: Sizes) -> int:
        """All numbers of all actions."""
        return self.length * sizes.actions

    def begin(self, now: Moment) -> Memory:
        """Zeros: no action was taken yet."""
        return {"actions": np.zeros((len(now.action), self.length * now.action.shape[1]))}

    def update(self, now: Moment) -> Memory:
        """Put the last action before the others, of which the oldest is dropped."""
        return {"actions": pushed(now.memory["actions"], np.clip(now.action, -1.0, 1.0))}

    def sense(self, now: Moment) -> Array:
        """The actions, clipped to [-1, 1]."""
        return now.memory["actions"]


@register_sensor
class ObservationHistory(History):
    """The observations before, the newest first; the first one stands for those before it."""

    compiled = True
    name, unit, last = "observation_history", "", True
    formula = (
        "the `length` observations before the present one, without histories, the newest first; "
        "the first one stands for those before it"
    )

    def width(self, sizes: Sizes) -> int:
        """All numbers of all observations."""
        return self.length * sizes.observed

    def begin(self, now: Moment) -> Memory:
        """The first observation, repeated."""
        return {"past": np.tile(now.observed, 1 + self.length)}

    def update(self, now: Moment) -> Memory:
        """Put the present one before the others, of which the oldest is dropped."""
        return {"past": pushed(now.memory["past"], now.observed)}

    def sense(self, now: Moment) -> Array:
        """The observations before the present one."""
        return now.memory["past"][:, now.observed.shape[1] :]


@register_sensor
class Privileged(Sensor):
    """For the critic alone: the task's true entries, what was drawn, what events do, and the wind.

    What was drawn lies between -1 and 1 in its range; what events do is 0 where it is nothing, as
    `Events.seen` gives it; the wind [m/s] is in the body frame.
    """

    compiled = True
    name, unit, measured, shown, last = "privileged", "", False, False, True

    def width(self, sizes: Sizes) -> int:
        """All of these."""
        return sizes.truth + sizes.drawn + sizes.happening + 3

    def sense(self, now: Moment) -> Array:
        """The true entries, what was drawn, what happens and the wind, side by side."""
        wind = to_body(now.true.rotation, now.wind)
        return np.concatenate([*now.truth.values(), now.drawn, now.happening, wind], axis=-1)


def pushed(past: Array, newest: Array) -> Array:
    """Past numbers (n, k) with the newest (n, m) before them; the oldest m are dropped."""
    return np.concatenate([newest, past[:, : -newest.shape[1]]], axis=-1)


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
