"""Fly a forest by policies and by planners that see the same: `forest`."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.base.rotation import Array
from quadrl.conditions.solids import Cylinder, Pose, Solid
from quadrl.control.modes import Velocity
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.engines.rng import Rng
from quadrl.engines.state import Start
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly
from quadrl.tasks.hover import Hover
from quadrl.tasks.navigation import LENGTH, Navigation
from scripts.reports import report
from scripts.reports.report import Result, say, table

TREES, SPEEDS = (18, 36, 54, 72), (1.0, 2.0, 3.0, 4.0, 6.0)
SEEDS = 910_000, 920_000, 930_000  # fresh ones; planners are tuned on TUNING
TUNING, TRIES = 300_000, 24
WORLDS: dict[str, dict[str, Any]] = {
    "8 walls": {"walls": 8},
    "12 balls": {"balls": 12},
    "12 balls that swing at 1 m/s": {"balls": 12, "ball_speed": 1.0},
}
"""What stands among 36 trees that no training had."""
UNCERTAIN = 36, 54  # trees, for the robust policy
STILL: dict[str, Any] = {}
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


def flown(
    flyer: Any, seed: int, episodes: int, conditions: Mapping[str, Any] = STILL, **options: Any
) -> Result:
    """Success and mean speed of a flyer in a forest."""
    given = FOREST | {**conditions}
    flights = fly(flyer, Navigation(**options), episodes=episodes, seed=seed, **given)
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


def forest(
    *policies: Path, robust: Path | None = None, episodes: int = 1000, planned_before: bool = False
) -> None:
    """Fly forests of every density and speed by policies and by tuned planners.

    Args:
        policies: Run folders, or files, of policies of the same settings.
        robust: The same of a robust one, which flies beside the first and the best planner in the
            conditions of its training; without one the last report's counts, with its flights.
        episodes: Flights of each seed and density; a fifth of them for each speed.
        planned_before: Whether the planners count as the last report tuned and flew them.
    """
    usual, rows = Navigation().slowest, list[Result]()
    before = report.load("forest") if planned_before or not robust else {"flights": []}
    planners = before["planners"] if planned_before else [*map(tuned, PLANNERS)]
    flyers: dict[str, Any] = {}
    for own in map(Policy.load, policies):
        flyers[f"policy, seed {own.metadata['seed']}"] = own
    for row in planners:
        planner = PLANNERS[row["planner"]][0]
        flyers[row["planner"]] = Flyer(planner, row["numbers"], Scenario.of(Navigation(), **FOREST))

    def note(**row: Any) -> None:
        rows.append(row)
        # After each: one that is stopped keeps what it has flown.
        report.save("forest", {"episodes": episodes, "planners": planners, "flights": rows})

    def kept(name: str, *, uncertain: bool) -> bool:
        """Take the flights of the last report, where they count; whether they do."""
        holds = planned_before if name in PLANNERS else name == "robust policy" and not robust
        own = (row for row in before["flights"] if row["flyer"] == name)
        rows.extend(row for row in own if holds and ("uncertain" in row) == uncertain)
        return holds

    for name, flyer in flyers.items():
        if kept(name, uncertain=False):
            continue
        for trees in TREES:
            for seed in SEEDS:
                got = flown(flyer, seed, episodes, trees=trees)
                note(flyer=name, trees=trees, asked=usual, seed=seed, **got)
        for asked in SPEEDS:
            given: Any = {"trees": 36, "slowest": asked, "fastest": asked}
            got = flown(flyer, SEEDS[0], episodes // 5, time_limit=40.0, **given)
            note(flyer=name, trees=36, asked=asked, seed=0, **got)
        for world, given in WORLDS.items():
            for seed in SEEDS:
                got = flown(flyer, seed, episodes, trees=36, **given)
                note(flyer=name, world=world, seed=seed, **got)
        say(rows[-1])
    sturdy = Policy.load(robust) if robust else Policy.pretrained("navigation_robust")
    named = "weather", "randomization", "aerodynamics"
    uncertain = {name: getattr(sturdy.scenario, name) for name in named}
    finder = {"range_finder": sturdy.scenario.observe.sensors["range_finder"]}
    best = max(planners, key=lambda row: row["success"])["planner"]
    beside = {name: flyers[name] for name in (next(iter(flyers)), best)}
    for name, flyer in {"robust policy": sturdy, **beside}.items():
        if kept(name, uncertain=True):
            continue
        own = uncertain if flyer is sturdy else uncertain | {"observe": {"sensors": finder}}
        for trees in UNCERTAIN:
            for seed in SEEDS:
                got = flown(flyer, seed, episodes, own, trees=trees)
                note(flyer=name, uncertain=trees, seed=seed, **got)
        say(rows[-1])
    report.save("forest", {"episodes": episodes, "planners": planners, "flights": rows})


@dataclasses.dataclass(frozen=True)
class Posts(Hover):
    """Hover amid posts, as many as a forest has."""

    name = "posts"
    compiled = True

    def solids(self) -> Sequence[Solid]:
        """A hundred."""
        return [Cylinder("post", radius=0.2, height=6.0, count=100)]

    def place(self, rng: Rng, start: Start, state: Any) -> Mapping[str, Pose]:
        """Anywhere from 1.5 to 10 m away."""
        angle, far = (rng.uniform(*ends, 100) for ends in ((0.0, 6.28), (1.5, 10.0)))
        return {"post": Pose(np.stack([far * np.cos(angle), far * np.sin(angle), 0 * far], -1))}


def rays(repeats: int = 50) -> None:
    """Measure a batch with range finders: 256 aircraft of 64 rays amid 100 posts.

    Args:
        repeats: Measurements, in turns with one of the rays alone; the fastest count.
    """
    observe = {"sensors": {"range_finder": {"across": 64, "reach": 8.0}}}
    environment = Environment(Posts(), num_envs=256, observe=observe, engine="free_flight")
    environment.reset()
    finder, action = environment.scene.rays["range_finder"], np.zeros((256, 4))

    def timed(call: Callable[[], Any], times: int = 20) -> float:
        begun = time.perf_counter()
        for _ in range(times):
            call()
        return (time.perf_counter() - begun) / times

    turns = list[tuple[float, float]]()
    for _ in range(repeats):
        environment.reset()
        step = timed(lambda: environment.step(action))
        turns.append((step, timed(lambda: finder.measured(environment.engine))))
    step, alone = map(min, zip(*turns, strict=True))
    report.save("rays", {"steps_per_s": 256 / step, "share": alone / step})


def rays_table() -> str:
    """How fast a batch with range finders is."""
    result = report.load("rays")
    said = f"{result['steps_per_s']:,.0f} control steps a second; rays take {result['share']:.0%}"
    return f"256 aircraft with 64 rays each amid 100 posts: {said}. {report.source(result)}"


def _cell(found: list[Result]) -> str:
    success = [100 * row["success"] for row in found]
    speed = np.mean([row["speed"] for row in found])
    return f"{np.mean(success):.1f} % ({min(success):.1f} to {max(success):.1f}), {speed:.2f} m/s"


def _by_flyer(key: str, values: Sequence[Any], flights: list[Result]) -> list[list[str]]:
    """A row for each that flies, a cell for each value of a key."""
    rows = list[list[str]]()
    for name in dict.fromkeys(row["flyer"] for row in flights):
        own = [row for row in flights if row["flyer"] == name and row["seed"]]
        found = ([row for row in own if row.get(key) == value] for value in values)
        rows.append([name, *map(_cell, found)])
    return rows


def forest_table() -> str:
    """Success in forests of every density, by what flies."""
    result = report.load("forest")
    flights = [row for row in result["flights"] if "asked" in row]
    head = ["flies", *(f"{trees} trees" for trees in TREES)]
    note = f"{len(SEEDS)} seeds of {result['episodes']} flights each: mean (range), mean speed."
    rows = _by_flyer("trees", TREES, flights)
    return f"{table(head, rows)}\n\n{note} {report.source(result)}"


def worlds_table() -> str:
    """Success where more than trees stands, by what flies."""
    flights = [row for row in report.load("forest")["flights"] if "world" in row]
    rows = _by_flyer("world", [*WORLDS], flights)
    return table(["flies", *WORLDS], rows)


def uncertain_table() -> str:
    """Success in the conditions of a robust training, by what flies."""
    flights = [row for row in report.load("forest")["flights"] if "uncertain" in row]
    rows = _by_flyer("uncertain", UNCERTAIN, flights)
    return table(["flies", *(f"{trees} trees" for trees in UNCERTAIN)], rows)


def speed_table() -> str:
    """Success and speed by the speed that is asked, in 36 trees."""
    result, rows = report.load("forest"), []
    for name in dict.fromkeys(row["flyer"] for row in result["flights"]):
        own = [r for r in result["flights"] if r["flyer"] == name and not r["seed"]]
        if not own:
            continue
        found = {r["asked"]: r for r in own}
        cells = (f"{100 * found[v]['success']:.0f} %, {found[v]['speed']:.1f} m/s" for v in SPEEDS)
        rows.append([name, *cells])
    return table(["flies", *(f"asked {v:g} m/s" for v in SPEEDS)], rows)


PARTS: report.Parts = {
    "forest": forest_table, "forest-worlds": worlds_table, "forest-uncertain": uncertain_table,
    "forest-speed": speed_table, "rays": rays_table,
}  # fmt: skip
