"""Fly a forest by policies and by planners that see the same: `forest` and `rays`."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.conditions.solids import Cylinder, Pose, Solid
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.engines.rng import Rng
from quadrl.engines.state import Start
from quadrl.evaluation.in_flight import Controller
from quadrl.evaluation.planners import PLANNERS, Flyer
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly
from quadrl.evaluation.tuning import tuned
from quadrl.tasks.hover import Hover
from quadrl.tasks.navigation import LENGTH, Navigation
from scripts.reports import report
from scripts.reports.report import Result, block, grouped

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
ROBUST = "robust policy"
FOREST: dict[str, Any] = {
    "control_mode": "velocity", "vehicle_options": {"action_scale": 90.0}, "engine": "free_flight",
}  # fmt: skip


def flown(flyer: Controller, seed: int, episodes: int, **conditions: Any) -> Result:
    """Success and mean speed of a flyer in a forest."""
    flights = fly(flyer, Navigation(), episodes=episodes, seed=seed, **FOREST | conditions)
    speed = LENGTH / flights.success_time.mean() if flights.is_success.any() else 0.0
    return {"success": float(flights.is_success.mean()), "speed": float(speed)}


def planner(name: str, numbers: Mapping[str, float]) -> Flyer:
    """A planner with its numbers, in a forest."""
    return Flyer(PLANNERS[name][0], numbers, Scenario.of(Navigation(), **FOREST))


def planned(name: str) -> Result:
    """The best numbers of a planner among many, in forests of 36 and 54 trees."""

    def success(flyer: Controller) -> tuple[float]:
        in_each = (
            flown(flyer, TUNING, 32, task_options={"trees": t})["success"] for t in UNCERTAIN
        )
        return (sum(in_each) / len(UNCERTAIN),)

    best = tuned(partial(planner, name), PLANNERS[name][1], success, tries=TRIES)
    return {"planner": name, "numbers": best.settings, "success": best.score[0]}


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
    planners = report.load("forest")["planners"] if planned_before else [*map(planned, PLANNERS)]
    flyers: dict[str, Controller] = {}
    for own in map(Policy.load, policies):
        flyers[f"policy, seed {own.metadata['seed']}"] = own
    new = [*flyers, *PLANNERS] if not planned_before else [*flyers]
    new += [ROBUST] if robust else []
    flyers |= {row["planner"]: planner(row["planner"], row["numbers"]) for row in planners}
    best = max(planners, key=lambda row: row["success"])["planner"]
    sturdy = Policy.load(robust) if robust else Policy.pretrained("navigation_robust")
    named = "weather", "randomization", "aerodynamics"
    uncertain = {name: getattr(sturdy.scenario, name) for name in named}
    finder = {"range_finder": sturdy.scenario.observe.sensors["range_finder"]}
    beside = dict.fromkeys((next(iter(flyers)), best), uncertain | {"observe": {"sensors": finder}})

    def rows(name: str) -> dict[str, list[Result]]:
        flies = cases(name != ROBUST, (beside | {ROBUST: uncertain}).get(name))
        flyer, found = (flyers | {ROBUST: sturdy})[name], list[Result]()
        for what, seed, share, given in flies:
            got = flown(flyer, seed or SEEDS[0], episodes // share, **given)
            found.append({**what, "seed": seed, **got})
        return {"flights": found}

    flies = {name: partial(rows, name) for name in (ROBUST, *flyers)}
    report.gather("forest", "flyer", flies, new, episodes=episodes, planners=planners)


def cases(
    still: bool, uncertain: Mapping[str, Any] | None
) -> Iterator[tuple[Result, int, int, dict[str, Any]]]:
    """What a row says, its seed (0 for one of several speeds), the part of the flights, and where.

    Args:
        still: Whether where nothing is uncertain.
        uncertain: Conditions of the uncertain ones; None for none of them.
    """
    usual = Navigation().slowest
    for trees in TREES if still else ():
        for seed in SEEDS:
            yield {"trees": trees, "asked": usual}, seed, 1, {"task_options": {"trees": trees}}
    for asked in SPEEDS if still else ():
        given = {"trees": 36, "slowest": asked, "fastest": asked, "time_limit": 40.0}
        yield {"trees": 36, "asked": asked}, 0, 5, {"task_options": given}
    for world, given in WORLDS.items() if still else ():
        for seed in SEEDS:
            yield {"world": world}, seed, 1, {"task_options": {"trees": 36, **given}}
    for trees in UNCERTAIN if uncertain else ():
        for seed in SEEDS:
            given = {"task_options": {"trees": trees}, **(uncertain or {})}
            yield {"uncertain": trees}, seed, 1, given


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


def _several(found: Sequence[Result]) -> str:
    """Success and speed over the seeds."""
    success = [100 * row["success"] for row in found]
    speed = np.mean([row["speed"] for row in found])
    return f"{np.mean(success):.1f} % ({min(success):.1f} to {max(success):.1f}), {speed:.2f} m/s"


def _one(found: Sequence[Result]) -> str:
    """Success and speed of one row."""
    return f"{100 * found[0]['success']:.0f} %, {found[0]['speed']:.1f} m/s"


def by_flyer(
    key: str, values: Mapping[Any, str], cell: Callable[[Sequence[Result]], str] = _several
) -> str:
    """Success by who flies and the values of a key, with their heads; in several speeds by `_one`.

    What more than trees stands in the way, and what is uncertain, has the densities in rows of its
    own.
    """
    result = report.load("forest")
    seeded = [row for row in result["flights"] if bool(row["seed"]) == (cell is _several)]
    rows = list[list[str]]()
    for name, own in grouped((row for row in seeded if key in row), "flyer").items():
        found = grouped(own, key)
        rows.append([name, *(cell(found[value]) for value in values)])
    note = f"{len(SEEDS)} seeds of {result['episodes']} flights each: mean (range), mean speed."
    return block(["flies", *values.values()], rows, *([note, result] if key == "trees" else []))


def trees(values: Sequence[int]) -> dict[int, str]:
    """Densities with their heads."""
    return {value: f"{value} trees" for value in values}


PARTS: report.Parts = {
    "forest": partial(by_flyer, "trees", trees(TREES)),
    "forest-worlds": partial(by_flyer, "world", {name: name for name in WORLDS}),
    "forest-uncertain": partial(by_flyer, "uncertain", trees(UNCERTAIN)),
    "forest-speed": partial(by_flyer, "asked", {v: f"asked {v:g} m/s" for v in SPEEDS}, _one),
    "rays": rays_table,
}
