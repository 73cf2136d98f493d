"""Flies every policy that comes with quadrl, and the geometric controller, through disturbances.

Each disturbance alone, at graded levels and at the strength of the presets, and all together.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import tyro

import quadrl
from quadrl import tasks
from quadrl.aerodynamics import EFFECTS
from quadrl.card import Card
from quadrl.evaluation import setting
from quadrl.randomization import RANDOMIZATIONS, Randomization
from quadrl.rollout import fly, summarize
from quadrl.weather import Weather
from scripts.reports import report
from scripts.reports.report import Result, say, table

CONTROLLER = "geometric"
NEEDS_AIR = ("wind", "inflow")  # factors of what is off in calm air without effects
SHOWN = ("success_rate", "position_error_m")
PICTURES = report.IMAGES / "robustness"


def conditions() -> Iterator[tuple[str, str | None, dict[str, Any]]]:
    """A name, effects of the air, and what disturbs the flights."""
    calm = {"weather": Weather(), "randomization": Randomization()}
    yield "nothing", "none", calm
    for effect in (*EFFECTS, "full"):
        yield f"aerodynamics {effect}", effect, calm
    for weather in ("light", "moderate"):
        yield f"weather {weather}", "none", calm | {"weather": weather}
    full = RANDOMIZATIONS["full"]
    for name in full.given():
        if name not in NEEDS_AIR:
            given: Any = {name: getattr(full, name)}
            yield f"{name} as in `full`", "none", calm | {"randomization": Randomization(**given)}
    for name in ("light", "full"):
        yield f"randomization {name}", "none", calm | {"randomization": RANDOMIZATIONS[name]}
    yield "all together", "full", {"weather": "light", "randomization": full}


def main(only: tuple[str, ...] = (), episodes: int = 100) -> None:
    """Fly, draw, and write down after each task.

    Args:
        only: Names of tasks, beside what was measured of the others; by default all.
        episodes: Flights of each level and of each condition.
    """
    found: Result = {"episodes": episodes, "cards": {}, "conditions": {}}
    if only:
        before = report.load("robustness")
        found |= {name: before[name] for name in ("cards", "conditions")}
    for task in only or tasks.TASKS:
        say(task)
        found["conditions"][task] = {
            name: [one(known, task, air, disturbed, episodes) for known in flyers(task).values()]
            for name, air, disturbed in conditions()
        }
        card = quadrl.robustness(flyers(task), task, episodes=episodes, aerodynamics="none")
        PICTURES.mkdir(parents=True, exist_ok=True)
        card.figure.save(PICTURES / f"{task}.png")
        card.maps.save(PICTURES / f"{task}_recovery.png")
        found["cards"][task] = card.found
        report.save("robustness", found)


def flyers(task: str) -> dict[str, str]:
    """The policies that come with quadrl for a task, and the controller, by their words."""
    return {"policy": task, "robust policy": f"{task}_robust", "controller": CONTROLLER}


def one(flown: str, task: str, air: str | None, disturbed: dict[str, Any], episodes: int) -> Result:
    """What the policy or the controller reaches in one condition."""
    _, controller, made, vehicle = setting(flown, task, aerodynamics=air)
    engine: Any = "mujoco" if made.contact else "free_flight"
    given = {"episodes": episodes, "vehicle": vehicle, "engine": engine, **disturbed}
    reached = summarize(fly(controller, made, **given))
    return {name: reached[name] for name in SHOWN}


def half() -> str:
    """Where half of the flights fail, for each task."""
    result, rows, head = report.load("robustness"), [], []
    for task, found in result["cards"].items():
        first, *rest = Card(found).table
        head = ["task", "flown", *(row[0] for row in rest)]
        for k, flown in enumerate(first[1:], start=1):
            rows.append((task, flown, *(row[k] for row in rest)))
    return f"{table(head, rows)}\n\n{result['episodes']} flights a level. {report.source(result)}"


def alone() -> str:
    """Success in each condition, a column for each task."""
    result = report.load("robustness")
    known = result["conditions"]
    rows = []
    for name in next(iter(known.values())):
        shares = ([f"{100 * one['success_rate']:.0f}" for one in of[name]] for of in known.values())
        rows.append((name, *(" / ".join(pair) for pair in shares)))
    flown = " / ".join(flyers(""))
    note = f"Successful flights [%], {flown}; {result['episodes']} flights each."
    return f"{table(('disturbed by', *known), rows)}\n\n{note} {report.source(result)}"


PARTS: report.Parts = {"robustness-half": half, "robustness-alone": alone}

if __name__ == "__main__":
    tyro.cli(main)
