"""Planners that see what a policy of `navigation` sees: yardsticks in a forest.

Three classical ways through solids by the same level rays: to the freest direction, away from what
is near, and the best of velocities that are held for a while. `Flyer` flies any of them, or one of
your own, and `quadrl.evaluation.tuning` finds its numbers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from quadrl.base.rotation import Array
from quadrl.control.modes import Velocity
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario


@dataclasses.dataclass(frozen=True)
class Sight:
    """What a planner sees, N aircraft and K rays, level, along the heading."""

    angle: Array  # (K,) [rad] of the rays, to the left
    distance: Array  # (N, K) [m]
    reach: float  # [m]
    velocity: Array  # (N, 2) [m/s]
    wanted: Array  # (N,) [m/s]
    east: Array  # (N,) [rad], the way to go

    def beside(self, angle: Array) -> tuple[Array, Array]:
        """Where what is seen lies from ways (C,) [rad]: along and across each, (N, C, K) [m]."""
        apart = self.angle - angle[:, None]
        along, across = (f(apart)[None] * self.distance[:, None] for f in (np.cos, np.sin))
        return along, abs(across)

    @property
    def seen(self) -> Array:
        """Whether a ray meets anything, (N, K) bool."""
        return self.distance < self.reach - 1e-6


Planner = Callable[[Sight, Mapping[str, float]], Array]
"""Gives the level velocity (N, 2) [m/s] along and across the heading, from numbers of its own."""


def freest(sight: Sight, p: Mapping[str, float]) -> Array:
    """Along the ray with the longest free way, less what leads astray; slower where it is short."""
    along, across = sight.beside(sight.angle)
    blocks = (across < p["width"]) & (along > 0) & sight.seen[:, None]
    free = np.where(blocks, along, p["look"]).min(axis=-1).clip(0.0, p["look"])  # (N, C)
    astray = abs(sight.angle - sight.east[:, None])
    best = (free / p["look"] - p["turn"] * astray).argmax(axis=-1)
    room = np.take_along_axis(free, best[:, None], axis=1)[:, 0]
    speed = sight.wanted * np.clip(room / p["brake"], 0.2, 1.0)
    return speed[:, None] * np.stack([np.cos(sight.angle[best]), np.sin(sight.angle[best])], -1)


def potential(sight: Sight, p: Mapping[str, float]) -> Array:
    """Pulled ahead, pushed away by all that is near."""
    near = np.maximum(sight.distance - p["radius"], 0.05)
    push = p["push"] * np.maximum(1 / near - 1 / p["range"], 0.0) ** p["power"] / len(sight.angle)
    push = np.where(sight.seen, push, 0.0)
    force = np.stack([np.cos(sight.east), np.sin(sight.east)], axis=-1)
    rays = np.stack([np.cos(sight.angle), np.sin(sight.angle)], axis=-1)
    force = force - (push[..., None] * rays).sum(axis=1)
    length = np.maximum(np.linalg.norm(force, axis=-1, keepdims=True), 1e-9)
    return sight.wanted[:, None] * force / length * np.minimum(length, 1.0)


def sampler(sight: Sight, p: Mapping[str, float]) -> Array:
    """The best of velocities in every direction that were held for a while."""
    shares = np.array([0.25, 0.5, 0.75, 1.0])
    angle = np.tile(sight.angle, len(shares))
    speed = np.repeat(shares, len(sight.angle))[None] * sight.wanted[:, None]  # (N, C)
    asked = speed[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    cost, change = -0.0 * speed, sight.velocity[:, None] - asked
    rays = np.stack([np.cos(sight.angle), np.sin(sight.angle)], axis=-1)
    points = sight.distance[..., None] * rays  # (N, K, 2)
    far = np.where(sight.seen, sight.distance, np.inf)[:, None] ** 2
    for seconds in p["horizon"] * np.array([0.25, 0.5, 0.75, 1.0]):
        share = p["lag"] * (1 - np.exp(-seconds / p["lag"]))
        at = asked * seconds + change * share  # a velocity is reached with a lag
        # |at - point|^2, multiplied out: a matrix product takes a tenth of the time.
        away = (far - 2 * at @ points.swapaxes(1, 2)).min(axis=-1) + (at**2).sum(axis=-1)
        away = np.sqrt(np.maximum(away, 0.0))
        cost = cost + np.exp(-(away - p["radius"]) / p["soft"]).clip(0.0, 1e3)
    way = np.stack([np.cos(sight.east), np.sin(sight.east)], axis=-1)[:, None]
    ahead = (asked * way).sum(axis=-1) / np.maximum(sight.wanted, 1e-9)[:, None]
    best = (p["ahead"] * ahead - cost).argmax(axis=-1)
    return np.take_along_axis(asked, best[:, None, None], axis=1)[:, 0]


PLANNERS: dict[str, tuple[Planner, dict[str, tuple[float, float]]]] = {
    "freest direction": (
        freest, {"width": (0.4, 1.2), "look": (2, 7.9), "turn": (0.05, 1), "brake": (0.5, 5)},
    ),
    "potential field": (
        potential, {"radius": (0.0, 0.6), "push": (0.5, 30), "range": (1, 6), "power": (0.5, 3)},
    ),
    "short-horizon sampler": (
        sampler,
        {"horizon": (0.8, 4), "lag": (0.2, 1.0), "radius": (0.3, 0.9), "soft": (0.05, 0.5),
         "ahead": (0.2, 4)},
    ),
}  # fmt: skip
"""Planners, and between what their numbers are drawn, evenly in logarithms, to tune them."""


class Flyer:
    """Flies a planner's velocities, level and heading east, in the task's observations."""

    control_mode = "velocity"

    def __init__(self, planner: Planner, numbers: Mapping[str, float], scenario: Scenario) -> None:
        """Look up where the entries of the observation stand."""
        environment = Environment(scenario, num_envs=1)
        self._plan, self._numbers, self._places = planner, numbers, environment.layout
        self._scale = Velocity(environment.vehicle).scale
        rays = environment.scene.rays["range_finder"]
        self._angle, self._reach = np.arctan2(rays.along[:, 1], rays.along[:, 0]), rays.reach

    def __call__(self, observation: Array) -> Array:
        """Actions (N, 4) for flat observations (N, size)."""
        seen = {name: observation[:, place] for name, place in self._places.items()}
        heading = np.arctan2(seen["sin_attitude"][:, 2], seen["cos_attitude"][:, 2])
        sight = Sight(
            self._angle, np.exp(seen["range_finder"]), self._reach, seen["velocity"][:, :2],
            seen["wanted"][:, 0], -heading,
        )  # fmt: skip
        up, turn = 1.5 * seen["goal"][:, 2], -1.5 * heading
        velocity = np.column_stack([self._plan(sight, self._numbers), up, turn])
        return np.clip(velocity / self._scale, -1.0, 1.0)
