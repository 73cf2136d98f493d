"""Perching: touch a surface of any incline with the feet, gently, and stay on it."""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, namespace, norm, stack, to_body, zeros
from quadrl.base.validation import number
from quadrl.conditions.solids import Box, Pose, Solid
from quadrl.core import rewards
from quadrl.core.contact import touches_ground
from quadrl.core.observation import MOTION, ROTATION, ObservationTerm, observed_motion
from quadrl.core.task import EpisodeEnd, Potentials, Snapshot, Target, Task, TaskState, either
from quadrl.engines.rng import Rng
from quadrl.engines.state import Start
from quadrl.tasks.approach import Way, on_the_way

WALL = Box("wall", length=2.0, width=2.0, height=0.1, rgba=(0.62, 0.58, 0.52, 1.0), grip=12.0)
NEAR = 0.6  # [m], from the goal, where the attitude counts half
SPREAD = 0.2  # of what is beside a way, as a share of what is beside a start
WORST = 3.0  # times what a limit is exceeded by, or [m/s] of what strikes: more costs no more
OFF = 1.0  # [m], from the middle of the surface
ROOM = 0.3  # [m], between the surface and the centre of an aircraft at the start
NORMAL = ObservationTerm(3, "1", "unit vector out of the surface, body frame", "R^T normal")


@dataclasses.dataclass(frozen=True)
class Perch(TaskState):
    """Where to perch, and for how long the aircraft has been held."""

    normal: Array  # (N, 3) unit vector out of the surface
    rest: Array  # (N,) control steps


@dataclasses.dataclass(frozen=True)
class Perching(Task):
    """Perch on a surface; its middle is the origin of the task's frame."""

    name, version = "perching", 1
    compiled = True
    asks = "land with the feet on a surface, level to vertical, and stay on it"
    starts = (
        "2 to 3 m from the surface, in front of a wall and 45 degrees above a level one, up to 0.5 "
        "m off sideways and in height, at rest, facing it"
    )
    ends = (
        "on the surface for a second (success); a touch that is too slow, too fast, too tilted or "
        "with too much spin, or not with the feet; leaving the surface; on the ground; more than 6 "
        "m away"
    )
    solved = (
        "one second on the surface after a touch with 0.2 to 1 m/s into it, under 0.5 m/s along "
        "it, within 20 degrees and under 2 rad/s"
    )
    targets = (Target("success_rate", "successful", 0.95, True),)
    training = {
        "gamma": 0.98,
        "steps": 8_192_000,
        "vehicle_options": {"action_scale": 90.0},  # 35 rad/s cannot brake and turn at once
        # Most flights begin on the way: otherwise none would ever make a good touch. Some inclines
        # lie beyond those that are asked.
        "training_options": {
            "approach": 0.7,
            "least_incline": -0.1,
            "most_incline": 1.65,
            "rest_time": 0.3,
            "time_limit": 3.0,
        },
    }
    keeps_place = False
    contact = True
    observation = ROTATION | MOTION | {"normal": NORMAL}

    time_limit: float = 6.0
    """Time limit of an episode [s]."""
    least_incline: float = 0.0
    """Smallest incline of the surface [rad]."""
    most_incline: float = math.pi / 2
    """Largest incline of the surface [rad]: a vertical wall."""
    nearest: float = 2.0
    """Smallest distance of the start from the surface [m]."""
    farthest: float = 3.0
    """Largest distance of the start from the surface [m]."""
    aside: float = 0.5
    """Largest distance of the start to the sides, and above and below [m]."""
    approach: float = 0.0
    """Share of the episodes that begin during the approach, on a path to a good touch."""
    attitude_weight: float = 100.0
    """Reward per unit by which the chord from the body's z axis to the normal falls."""
    speed_weight: float = 20.0
    """Reward per m/s by which the speed falls, near the surface."""
    spin_weight: float = 5.0
    """Reward per rad/s by which the body rate falls, near the surface."""
    survival_weight: float = 0.0
    """Reward per 0.05 s; zero, since otherwise the policy would stay in the air."""
    time_weight: float = 4.0
    """Cost for each 0.05 s (in `perching` before the touch): without it, policies learn to wait in
    front of a wall."""
    success_weight: float = 250.0
    """Reward for staying on the surface."""
    touch_weight: float = 50.0
    """Cost of each limit of the touch that is exceeded, in proportion to the excess; and cost per
    m/s at which rotors or hull strike the surface."""
    failure_weight: float = 250.0
    """Cost of a failure."""
    least_touch: float = 0.2
    """Smallest speed of the touch into the surface [m/s]."""
    most_touch: float = 1.0
    """Largest speed of the touch into the surface [m/s]."""
    most_slip: float = 0.5
    """Largest speed of the touch along the surface [m/s]."""
    most_slant: float = math.radians(20.0)
    """Largest angle between the body's z axis and the normal at the touch [rad]."""
    most_spin: float = 2.0
    """Largest body rate at the touch [rad/s]."""
    rest_time: float = 1.0
    """How long the aircraft has to stay on the surface [s]."""
    max_distance: float = 6.0
    """Distance from the goal that ends the episode [m]."""

    def __post_init__(self) -> None:
        """Validate the ranges."""
        super().__post_init__()
        number(f"{self.name} most_incline", self.most_incline, self.least_incline, math.pi)
        incline = np.linspace(self.least_incline, self.most_incline)
        beside = self.aside * abs(np.cos(incline))  # by which a start may be nearer to the surface
        nearest = (ROOM + beside) / np.sin((math.pi / 2 + incline) / 2)
        number(f"{self.name} nearest", self.nearest, float(nearest.max()))
        number(f"{self.name} farthest", self.farthest, self.nearest, self.max_distance)
        number(f"{self.name} most_touch", self.most_touch, self.least_touch)
        if self.most_touch == self.least_touch:
            name, allowed = f"{self.name} most_touch", f"above least_touch, {self.least_touch:g}"
            raise QuadrlError(name=name, value=self.most_touch, allowed=allowed)
        for name in ("most_slip", "most_slant", "most_spin"):
            number(f"{self.name} {name}", getattr(self, name), positive=True)

    def solids(self) -> Sequence[Solid]:
        """The surface."""
        return [WALL]

    def place(self, rng: Rng, start: Start, state: TaskState) -> Mapping[str, Pose]:
        """Its middle at the origin, facing up and west."""
        normal = cast(Perch, state).normal
        incline = np.arctan2(-normal[..., 0], normal[..., 2])
        none = zeros(incline)
        turn = stack(np.cos(incline / 2), none, -np.sin(incline / 2), none)
        return {"wall": Pose(-WALL.height / 2 * normal, turn)}

    def begin(self, rng: Rng, parameters: Parameters) -> tuple[Start, Perch]:
        """At rest before the surface, facing it, or on the way; from above where it is level."""
        incline = rng.uniform(self.least_incline, self.most_incline)
        xp, none = namespace(incline), zeros(incline)
        normal = stack(-xp.sin(incline), none, xp.cos(incline))
        goal = -parameters.foot[..., 2:] * normal
        above = (math.pi / 2 - incline) / 2
        far = rng.uniform(self.nearest, self.farthest)
        before = far[..., None] * stack(-xp.cos(above), none, xp.sin(above))
        away = self.aside * rng.uniform(-1.0, 1.0, 3)
        away = stack(none, away[..., 1], away[..., 2])
        comes = (rng.uniform(0.0, 1.0) < self.approach)[..., None]
        way = on_the_way(rng, incline, (self.least_touch, self.most_touch))
        begun = Way(
            xp.where(comes, goal + way.position + SPREAD * away, before + away),
            xp.where(comes, way.velocity, zeros(way.velocity)),
            xp.where(comes[..., 0], way.pitch, none),
            xp.where(comes[..., 0], way.rate, none),
        )
        return begun.start(parameters), Perch(goal=goal, normal=normal, rest=none)

    def update(self, before: Snapshot, now: Snapshot) -> Perch:
        """Count the control steps on the surface."""
        task, xp = now.task, namespace(now.task.rest)
        return dataclasses.replace(task, rest=xp.where(now.held, task.rest + 1, task.rest))

    def measure(self, now: Snapshot) -> Potentials:
        """The attitude error is the chord from the body's z axis to the normal, at most 2.

        It and the speeds count near the surface: an aircraft that turns to a wall from afar falls,
        and a slow one never gets there with its feet ahead.
        """
        usual, chord = super().measure(now), norm(now.state.rotation[..., :, 2] - now.task.normal)
        near = 1 / (1 + (usual.distance / NEAR) * (usual.distance / NEAR))
        return dataclasses.replace(
            usual,
            attitude=2 - (2 - chord) * near,
            speed=near * usual.speed,
            angular_speed=near * usual.angular_speed,
        )

    def observe(self, now: Snapshot) -> dict[str, Array]:
        """The aircraft's motion, and the surface as it sees it."""
        state, normal = now.state, to_body(now.state.rotation, now.task.normal)
        return {"rotation": state.rotation_entries, **observed_motion(now), "normal": normal}

    def reward(self, before: Snapshot, now: Snapshot, end: EpisodeEnd) -> dict[str, Array]:
        """To the surface and aligned with it; and what the touch is worth."""
        xp, none = namespace(now.time), zeros(now.time)
        shares = (xp.clip(share - 1, 0, WORST) for share in self._shares(now))
        excess = xp.where(now.held & ~before.held, functools.reduce(operator.add, shares), none)
        excess = xp.where(self._struck(now), xp.clip(now.touch_speed, 0, WORST), excess)
        cost = self.time_weight * rewards.time_share(now.parameters)
        terms = "progress", "attitude", "speed", "spin", "control", "smoothness"
        return {
            **rewards.weighted(self, terms, before, now),
            "time": rewards.once(-cost, ~now.held, now),
            "touch": -self.touch_weight * excess,
            "success": rewards.once(self.success_weight, end.succeeded, now),
            "failure": rewards.once(-self.failure_weight, end.failed, now),
        }

    def terminated(self, now: Snapshot) -> dict[str, Array]:
        """Failed, or on the surface for long enough."""
        return self._failures(now) | {"perched": self._rested(now)}

    def succeeded(self, now: Snapshot, end: EpisodeEnd) -> Array:
        """At rest on the surface for long enough, after a good touch."""
        rested = end.terminated & self._rested(now) & now.state.at_rest
        return rested & ~either(self._failures(now))

    def _rested(self, now: Snapshot) -> Array:
        """Whether the aircraft has been on the surface for long enough, (N,) bool."""
        steps = now.task.rest + 1
        return now.held & (steps * now.parameters.control_timestep >= self.rest_time)

    def _failures(self, now: Snapshot) -> dict[str, Array]:
        """Touched otherwise than asked, off again, on the ground, or away, (N,) bool each."""
        xp = namespace(now.time)
        most = functools.reduce(xp.maximum, self._shares(now))
        off = now.held & (now.potentials.distance > OFF)
        away = now.potentials.distance > self.max_distance
        low = touches_ground(now, bounces=True)
        touch = {"bad_touch": now.held & (most > 1), "struck": self._struck(now)}
        return touch | {"off_again": off, "away": away, "ground": low}

    def _struck(self, now: Snapshot) -> Array:
        """Whether anything but the feet touches the surface first, (N,) bool."""
        return now.touched[..., 0] & ~now.held

    def _shares(self, now: Snapshot) -> list[Array]:
        """Speeds, tilt and spin of the touch, (N,) each as a share of what is allowed."""
        into, along, cosine, rate = (now.touch[..., k] for k in range(4))
        middle = (self.most_touch + self.least_touch) / 2
        half = (self.most_touch - self.least_touch) / 2
        slant = (1 - cosine) / (1 - math.cos(self.most_slant))
        return [abs(into - middle) / half, along / self.most_slip, slant, rate / self.most_spin]
