"""Fly a forest by policies and by planners that see the same: `forest`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.base.rotation import Array
from quadrl.control.modes import Velocity
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly
from quadrl.tasks.navigation import LENGTH, Navigation
from scripts.reports import report
from scripts.reports.report import Result, say, table

TREES, SPEEDS = (18, 36, 54, 72), (1.0, 2.0, 3.0, 4.0, 6.0)
SEEDS = 910_000, 920_000, 930_000  # fresh ones; planners are tuned on TUNING
TUNING, TRIES = 300_000, 24
FOREST: dict[str, Any] = {
    "control_mode": "velocity", "vehicle_options": {"action_scale": 90.0}, "engine": "free_flight",
}  # fmt: skip


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
    for time in p["horizon"] * np.array([0.25, 0.5, 0.75, 1.0]):
        share = p["lag"] * (1 - np.exp(-time / p["lag"]))
        at = asked * time + change * share  # a velocity is reached with a lag
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


def flown(flyer: Any, seed: int, episodes: int, **options: Any) -> Result:
    """Success and mean speed of a flyer in a forest."""
    flights = fly(flyer, Navigation(**options), episodes=episodes, seed=seed, **FOREST)
    speed = LENGTH / flights.success_time.mean() if flights.is_success.any() else 0.0
    return {"success": float(flights.is_success.mean()), "speed": float(speed)}


def tuned(name: str) -> Result:
    """The best numbers of a planner among many, in forests of 36 and 54 trees."""
    planner, ends = PLANNERS[name]
    drawn, best = np.random.default_rng(0), {"success": -1.0}
    for k in range(TRIES):
        numbers = {key: float(np.exp(drawn.uniform(*np.log(np.maximum(pair, 0.01)))))
                   for key, pair in ends.items()}  # fmt: skip
        flyer = Flyer(planner, numbers, Scenario.of(Navigation(), **FOREST))
        success = sum(flown(flyer, TUNING, 32, trees=t)["success"] for t in (36, 54)) / 2
        if success > best["success"]:
            best = {"planner": name, "numbers": numbers, "success": success}
            say(f"{name}: {success:.3f} at try {k + 1}")
    return best


def forest(policy: Path, episodes: int = 1000) -> None:
    """Fly forests of every density and speed by a policy and by tuned planners.

    Args:
        policy: A run folder, or the file of a policy.
        episodes: Flights of each seed and density; a fifth of them for each speed.
    """
    own, usual, rows = Policy.load(policy), Navigation().slowest, list[Result]()
    planners = [tuned(name) for name in PLANNERS]
    flyers: dict[str, Any] = {"policy": own}
    for row in planners:
        planner = PLANNERS[row["planner"]][0]
        flyers[row["planner"]] = Flyer(planner, row["numbers"], Scenario.of(Navigation(), **FOREST))
    for name, flyer in flyers.items():
        for trees in TREES:
            for seed in SEEDS:
                got = flown(flyer, seed, episodes, trees=trees)
                rows.append({"flyer": name, "trees": trees, "asked": usual, "seed": seed, **got})
            for asked in SPEEDS:
                given: Any = {"trees": trees, "slowest": asked, "fastest": asked}
                got = flown(flyer, SEEDS[0], episodes // 5, time_limit=40.0, **given)
                rows.append({"flyer": name, "trees": trees, "asked": asked, "seed": 0, **got})
            say(rows[-1])
        # After each: one that is stopped keeps what it has flown.
        report.save("forest", {"episodes": episodes, "planners": planners, "flights": rows})


def forest_table() -> str:
    """Success in forests of every density, by what flies."""
    result = report.load("forest")
    rows = []
    for name in dict.fromkeys(row["flyer"] for row in result["flights"]):
        own = [row for row in result["flights"] if row["flyer"] == name and row["seed"]]
        cells = []
        for trees in TREES:
            found = [row for row in own if row["trees"] == trees]
            success = [100 * row["success"] for row in found]
            speed = np.mean([row["speed"] for row in found])
            cells.append(f"{np.mean(success):.1f} % ({min(success):.1f} to {max(success):.1f}), "
                         f"{speed:.2f} m/s")  # fmt: skip
        rows.append([name, *cells])
    head = ["flies", *(f"{trees} trees" for trees in TREES)]
    note = f"{len(SEEDS)} seeds of {result['episodes']} flights each: mean (range), mean speed."
    return f"{table(head, rows)}\n\n{note} {report.source(result)}"


def speed_table() -> str:
    """Success and speed by the speed that is asked, in 36 trees."""
    result, rows = report.load("forest"), []
    for name in dict.fromkeys(row["flyer"] for row in result["flights"]):
        own = [r for r in result["flights"] if r["flyer"] == name and r["trees"] == 36]
        found = {r["asked"]: r for r in own if not r["seed"]}
        cells = (f"{100 * found[v]['success']:.0f} %, {found[v]['speed']:.1f} m/s" for v in SPEEDS)
        rows.append([name, *cells])
    return table(["flies", *(f"asked {v:g} m/s" for v in SPEEDS)], rows)


PARTS: report.Parts = {"forest": forest_table, "forest-speed": speed_table}
