"""Sensors of where to fly: the goal as policies see it that fly several tasks or any quadrotor.

With them come the aircraft itself, in the numbers that such policies know it by, and the task.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadrl.aircraft.quadrotor import as_x, turned
from quadrl.aircraft.rotors import MAX
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, namespace, norm, to_body, to_world
from quadrl.base.validation import number
from quadrl.conditions.sensor import Memory, Moment, Sensor, Sizes, register_sensor

MOTION = 3  # numbers of `Standard` before its flags


def summed(now: Moment, near: float, gain: float, most: float) -> Array:
    """The sum of past offsets from the goal (n, 3) [m], world frame, after a control step.

    Args:
        now: The end of the step; its memory has the `sum` before.
        near: Longer offsets [m] are ways and are not summed up.
        gain: What a second adds, of the offset [1/s].
        most: Largest number of the sum [m].
    """
    offset = to_world(now.state.rotation, now.estimated["goal"])
    added = np.where(norm(offset)[:, None] < near, offset, 0.0)
    seconds = float(now.parameters.control_timestep)
    return np.clip(now.memory["sum"] + gain * seconds * added, -most, most)


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
        return {"sum": summed(now, self.near, self.gain, self.most)}

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
        seconds = float(now.parameters.control_timestep)
        turn = now.memory["turn"] + seconds * now.state.body_rate[:, 2:]
        return {
            "sum": summed(now, self.near, self.gain, self.most),
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
