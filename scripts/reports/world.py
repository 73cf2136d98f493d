"""Fly what the field flies, and set what was published beside it: `world`.

The controllers know what the policies know, and are tuned for their row with other seeds than they
are flown with.
"""

from __future__ import annotations

import dataclasses
import runpy
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from quadrl.base.units import percent, quantity
from quadrl.control import Gains, GeometricController
from quadrl.core.scenario import Conditions, Scenario
from quadrl.deploy.crosscheck import LATE
from quadrl.deploy.foundation_policy import Facing, commanding, installed
from quadrl.evaluation.card import wilson
from quadrl.evaluation.in_flight import Controller, scenario_of
from quadrl.evaluation.planners import PLANNERS, Flyer
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly, summarize
from quadrl.evaluation.tuning import tuned
from scripts.reports import any_aircraft, report
from scripts.reports.report import Result, block

SEED, TUNING = 980_000, 310_000  # of flights that no choice was made on, and of those that tune
TRIES, TRIED = 40, 32  # settings that are drawn for a row, and flights of each
BETWEEN = {
    "level": (0.4, 3.0), "height": (0.4, 3.0), "heading": (0.4, 2.0), "authority": (0.4, 1.0),
    "max_speed": (0.5, 15.0), "max_tilt": (0.2, 1.4),
}  # fmt: skip
"""Gains of the geometric controller, drawn evenly in logarithms."""
KNOWN = "crazyflie_brushless"  # the preset that RAPTOR's policy holds best here
NONE = "none by this definition"


@dataclasses.dataclass(frozen=True)
class Row:
    """What is flown."""

    task: str
    figures: tuple[str, ...]
    """Beside success; the first decides between settings that succeed as often."""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict[str, Any])
    """Of the task."""
    conditions: Conditions = dataclasses.field(default_factory=Conditions)
    yardstick: str = "geometric"
    raptor: bool = False
    """Whether RAPTOR's policy can fly it: it comes to a place, or follows one."""
    tries: int = TRIES
    """Settings of the controller that are tried."""
    said: str = ""
    """Of the controller, behind its figures."""
    published: str = NONE


SONG = "5.14 s, 100 %, nominal simulation, 40 ms late; 5.35 s, 85 %, flown (Song et al. 2023)"
LATE_AND_HEAVY: Conditions = {"randomization": {"command_delay": 0.04, "mass": (0.9, 1.1)}}
EIGHTS = ("settled_m", "distance_m")
ROWS: dict[str, Row] = {
    # RAPTOR's policy is told no heading.
    "hover": Row("hover", ("position_error_m",), {"any_heading": True}, raptor=True),
    "figure eight of 5.5 s": Row(
        "trajectory", EIGHTS, {"figure": "lemniscate", "period": 5.5}, raptor=True,
        published="under 5 cm up to 2 m/s, flown, Crazyflie (arXiv 2503.09622)",
    ),
    "figure eight of 3.5 s": Row(
        "trajectory", EIGHTS, {"figure": "lemniscate", "period": 3.5}, raptor=True,
    ),
    "Split-S": Row("race", ("race_time_mean_s",), published=SONG),
    "Split-S, 40 ms late, 10 % of mass": Row(
        "race", ("race_time_mean_s",), conditions=LATE_AND_HEAVY, published=SONG
    ),
    "lsy level 2, summer 2026": Row(
        "lsy_race", ("race_time_mean_s",),
        published="3.42 s, 100 %, and 4.65 s, 50 %: first and second, its simulator",
    ),
    "recovery, 3 m up": Row("recovery", (), yardstick="TurnOver", raptor=True),
    "recovery, 1.5 m up": Row(
        "recovery", (), {"lowest": 1.5, "highest": 1.5}, yardstick="TurnOver", raptor=True
    ),
    "perching": Row(
        "perching", (), said=", without a plan; 100 % with one for each incline (commit af7f29c)"
    ),
    "deck, sea states 2 to 5": Row(  # each try takes minutes
        "deck_landing", ("touchdown_speed_median_m_s",), tries=6, said=", the best of 6 sets"
    ),
    "forest, 36 trees": Row("navigation", (), {"trees": 36}, yardstick="sampler"),
    "forest, 54 trees": Row("navigation", (), {"trees": 54}, yardstick="sampler"),
}  # fmt: skip
ANY = "any quadrotor, real air, 20 ms late"
ANY_PUBLISHED = "ten aircraft, 32 g to 2.4 kg, flown (arXiv 2509.11481)"


def world(only: tuple[str, ...] = (), episodes: int = 1000, beside: int = 100) -> None:
    """Fly each row by quadrl's policy, by a tuned controller, and by RAPTOR's published policy.

    RAPTOR's flies if the package foundation-policy is there, which quadrl does not need.

    Args:
        only: Names of rows, beside what was measured of the others; by default all.
        episodes: Flights of each but RAPTOR's policy.
        beside: Flights of RAPTOR's policy: the first of those.
    """
    there = beside if installed() else 0
    made = {name: partial(_row, row) for name, row in ROWS.items()} | {ANY: _any}

    def rows(name: str) -> dict[str, list[Result]]:
        return {"rows": [{"flights": episodes, "beside": beside, **made[name](episodes, there)}]}

    report.gather("world", "flown", {name: partial(rows, name) for name in made}, only)


def _row(row: Row, episodes: int, beside: int) -> Result:
    """What each who flies a row reaches: success and the figures."""
    policy = Policy.pretrained(row.task)
    task = policy.scenario.task  # among solids free flight is MuJoCo near each
    engine = "mujoco" if task.contact and not task.solids() else "free_flight"
    given: Any = {"engine": engine, "task_options": row.options, **row.conditions}
    scenario = scenario_of(policy, **given)
    yardstick, settings = _tuned(row, scenario)
    found: Result = {"policy": _flown(row, policy, scenario, episodes)}
    found["yardstick"] = _flown(row, yardstick, _seen_by(yardstick, scenario), episodes)
    found |= {"settings": settings, "raptor": {}}
    if row.raptor and beside:
        own = commanding(Scenario.of(scenario, vehicle=KNOWN, aerodynamics=None))
        found["raptor"] = _flown(row, Facing(own), own, beside)
    return found


def _any(episodes: int, beside: int) -> Result:
    """The same of drawn aircraft, for which no controller is tuned: none is told which it flies."""
    policy, found = Policy.pretrained("hover", variant="any"), Result()
    for who, count in {"policy": episodes, "raptor": beside}.items():
        drawn = [any_aircraft.DRAWN + layout for layout in any_aircraft.LAYOUTS]
        given = ("any" if who == "policy" else who, "full", LATE, count // len(drawn))
        rows = [any_aircraft.flown(policy, given[0], of, *given[1:]) for of in drawn if count]
        means = {x: np.mean([row[x] for row in rows]) for x in ("success_rate", "position_error_m")}
        found[who] = {x: float(mean) for x, mean in means.items()} if rows else {}
    return found | {"yardstick": {}, "settings": {}}


def _flown(
    row: Row, flyer: Controller, scenario: Scenario, episodes: int, seed: int = SEED
) -> Result:
    found = summarize(fly(flyer, scenario, episodes=episodes, seed=seed))
    return {name: found[name] for name in ("success_rate", *row.figures)}


def _seen_by(yardstick: Controller, scenario: Scenario) -> Scenario:
    """The scenario of a controller that reads the task's own observation and commands rotors."""
    if isinstance(yardstick, Flyer):
        return scenario
    return Scenario.of(scenario, control_mode="rotor", observe={})


def _tuned(row: Row, scenario: Scenario) -> tuple[Controller, Result]:
    """The controller of a row with the best of the settings that are drawn, and these.

    Those of the other controllers were tuned before, by `forest` and for docs/examples.
    """
    if row.yardstick == "sampler":
        name = "short-horizon sampler"
        (numbers,) = (
            x["numbers"] for x in report.load("forest")["planners"] if x["planner"] == name
        )
        return Flyer(PLANNERS[name][0], numbers, scenario), numbers
    if row.yardstick != "geometric":
        kinds = runpy.run_path(str(report.DOCS / "examples" / "yardsticks.py"))
        return kinds[row.yardstick](scenario.aircraft, scenario.task), {}

    def made(settings: Mapping[str, float]) -> Controller:
        return GeometricController(scenario.aircraft, scenario.task, Gains(**settings))

    def reached(flyer: Controller) -> tuple[float, ...]:
        found = _flown(row, flyer, _seen_by(flyer, scenario), TRIED, TUNING)
        return found["success_rate"], *(-found[name] for name in row.figures[:1])

    usual = dataclasses.asdict(Gains(**scenario.task.gains))
    best = tuned(made, BETWEEN, reached, tries=min(TRIES, row.tries), usual=usual).settings
    return made(best), dataclasses.asdict(Gains(**best))


def world_table() -> str:
    """Each row by who flies it, and what was published."""
    result, rows = report.load("world"), []
    called = {"sampler": " (sampler)", "TurnOver": " (turns over)"}
    for row in result["rows"]:
        own = ROWS.get(row["flown"])
        flown = {"policy": "flights", "yardstick": "flights", "raptor": "beside"}
        cells = [_cell(row[who], row[many]) for who, many in flown.items()]
        cells[1] += own.said or called.get(own.yardstick, "") if own else ""
        published = own.published if own else ANY_PUBLISHED
        if own and own.task == "lsy_race":
            published += f", where ours has {percent(_in_its_simulator())}"
        rows.append((row["flown"], *cells, published))
    head = ("flown", "quadrl's policy", "tuned controller", "RAPTOR's policy", "published")
    counts = " or ".join(f"{n:,}" for n in sorted({row["flights"] for row in result["rows"]}))
    beside = result["rows"][0]["beside"]
    note = f"{counts} fresh flights each, {beside} of RAPTOR's; 95 % intervals."
    return block(head, rows, note, result, result["rows"])


def _in_its_simulator() -> float:
    """Success of the policy for `lsy_race` on its aircraft, by crazyflow's physics."""
    kept = report.load("crosscheck")["race"]
    own = [row for row in kept if row["flown_in"] != "quadrl" and row["aircraft"] != "matched"]
    return own[0]["success_rate"]


def _cell(found: Result, flights: int) -> str:
    """Success with its interval, and the figures."""
    if not found:
        return ""
    low, high = wilson(found["success_rate"] * flights, flights)
    said = f"{percent(found['success_rate'])} ({100 * low:.0f} to {100 * high:.0f})"
    names = {"distance_m": " from rest", "settled_m": " settled"}
    more = [f"{quantity(k, v)}{names.get(k, '')}" for k, v in found.items()
            if k != "success_rate" and v is not None]  # fmt: skip
    return ", ".join([said, *more])


PARTS: report.Parts = {"world": world_table}
