"""Flies every policy that comes with quadrl, and the geometric controller, through disturbances.

Each disturbance alone, at graded levels and at the strength of the presets, and all together.
`scripts/report tuning` tunes the controller for each of these conditions.
"""

from __future__ import annotations

import tyro

import quadrl
from quadrl import tasks
from quadrl.evaluation.card import Card
from quadrl.evaluation.evaluate import setting
from scripts.reports import report, tuning
from scripts.reports.report import Result, say, table

CONTROLLER = "geometric"
TUNED = "tuned controller"
PICTURES = report.IMAGES / "robustness"


def main(only: tuple[str, ...] = (), episodes: int = 100, cards: bool = True) -> None:
    """Fly, draw, and write down after each task.

    Args:
        only: Names of tasks, beside what was measured of the others; by default all.
        episodes: Flights of each level and of each condition.
        cards: Whether the cards and maps are measured, too; else they stay as they are.
    """
    found: Result = {"episodes": episodes, "cards": {}, "conditions": {}}
    if only or not cards:
        before = report.load("robustness")
        found |= {name: before[name] for name in ("cards", "conditions")}
    for task in only or tasks.TASKS:
        say(task)
        found["conditions"][task] = {
            name: [one(known, task, name, episodes) for known in (*flyers(task).values(), TUNED)]
            for name in tuning.conditions(task)
            if name != "uncertain"
        }
        if cards:
            card = quadrl.robustness(flyers(task), task, episodes=episodes, aerodynamics="none")
            PICTURES.mkdir(parents=True, exist_ok=True)
            card.figure.save(PICTURES / f"{task}.png")
            card.maps.save(PICTURES / f"{task}_recovery.png")
            found["cards"][task] = card.found
        report.save("robustness", found)


def flyers(task: str) -> dict[str, str]:
    """The policies that come with quadrl for a task, and the controller, by their words."""
    return {"policy": task, "robust policy": f"{task}_robust", "controller": CONTROLLER}


def one(known: str, task: str, name: str, episodes: int) -> Result:
    """What a policy or a controller reaches in one condition; a policy with its own aircraft."""
    condition = tuning.conditions(task)[name]
    if known == TUNED:
        return tuning.flown(tuning.tuned(task, name), task, condition, episodes, tuning.FRESH)
    _, controller, _, vehicle = setting(known, task, aerodynamics=condition.aerodynamics)
    return tuning.flown(controller, task, condition, episodes, tuning.FRESH, vehicle)


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
    flown = " / ".join((*flyers(""), TUNED))
    note = f"Successful flights [%], {flown}; {result['episodes']} flights each."
    return f"{table(('disturbed by', *known), rows)}\n\n{note} {report.source(result)}"


PARTS: report.Parts = {"robustness-half": half, "robustness-alone": alone}

if __name__ == "__main__":
    tyro.cli(main)
