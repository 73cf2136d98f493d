"""Fly policies and the geometric controller through disturbances: `robust` and `robustness`.

The controller is the yardstick: its gains are tuned for each task and each disturbance. A
proportional one leaves a lasting error in a lasting wind or with a mass that it does not know, so
an integral of the position error is among the gains.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

import quadrl
from quadrl import tasks
from quadrl.aircraft.aerodynamics import EFFECTS
from quadrl.base.units import length, quantity
from quadrl.conditions.randomizations import RANDOMIZATIONS
from quadrl.control import Gains
from quadrl.control.integrating import Integrating
from quadrl.core.scenario import UNDISTURBED, Conditions, Scenario
from quadrl.evaluation.evaluate import setting
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.policy_file import FILE
from quadrl.evaluation.rollout import BEHAVIOUR, flights, fly, means_of_behaviour
from quadrl.learning.variants import WIDE
from scripts.reports import report
from scripts.reports.report import FIGURES, Result, Runs, block, grouped, say, table

SEEN: Conditions = {"observe": {"rotor_speed": "estimated"}}  # by controllers, as by the policies
NOISE = RANDOMIZATIONS["light"].noise  # of the state estimate
NEEDS_AIR = ("wind", "inflow")  # factors of what is off in calm air without effects
FRESH = 100_300  # first episode, beyond those that the gains were chosen by
ALL_TOGETHER: Conditions = {"weather": "light", "randomization": "full", "aerodynamics": "full"}
WAYS_OF = ("nothing", "50 ms of delay", "twice the lag", "uncertain", "all together")
"""Of which `ways_table` says how they fly."""
KEYS = ("task", "condition", "commit")


IN_CALM: Any = {**UNDISTURBED, "aerodynamics": "none"}
WIDER: Conditions = {"vehicle_options": {"action_scale": WIDE}}  # as the policies command
UNCERTAIN: Conditions = {  # unknown mass, late commands, an estimate with noise
    "weather": "light",
    "randomization": {"mass": (0.8, 1.2), "command_delay": 0.02, "noise": NOISE},
}
UNSURE: dict[str, Conditions] = {  # in which the policies for uncertain aircraft are flown
    "uncertain": UNCERTAIN,
    "uncertain, drag only": {**UNCERTAIN, "aerodynamics": "none"},
    "nothing": {},
    "50 ms of delay": {"randomization": {"command_delay": 0.05}},
    "half the lag": {"randomization": {"lag": 0.5}},
    "twice the lag": {"randomization": {"lag": 2.0}},
    "moderate weather": {"weather": "moderate"},
    "all together": ALL_TOGETHER,
}


def conditions() -> dict[str, Conditions]:
    """The disturbances by name: each alone, and all together."""
    drawn = RANDOMIZATIONS["full"].given().items()
    return {
        "nothing": {},
        **{f"aerodynamics {e}": {"aerodynamics": e} for e in (*EFFECTS, "full")},
        **{f"weather {w}": {"weather": w} for w in ("light", "moderate", "severe")},
        **{f"{k} as in `full`": {"randomization": {k: v}} for k, v in drawn if k not in NEEDS_AIR},
        **{f"randomization {n}": {"randomization": n} for n in ("light", "full")},
        "all together": ALL_TOGETHER,
    }


def tuned(task: str, name: str, condition: Conditions) -> Integrating:
    """The controller with the gains that were found for a task in a condition; for one flight."""
    gains = report.load("tuning")["tasks"][task]
    bandwidth, integral = gains.get(name) or gains["all together"]  # where none were
    scenario = Scenario.of(task, **IN_CALM | condition)
    own = Gains(**{**scenario.task.gains, "level": bandwidth, "height": bandwidth})
    return Integrating(scenario.aircraft, scenario.task, own, integral)


def flown(flyer: Any, task: str, condition: Conditions, episodes: int) -> Result:
    """What a policy, a known name or a tuned controller reaches in a condition."""
    made = tasks.make(task)
    engine = "mujoco" if made.contact else "free_flight"
    given: Any = IN_CALM | condition | {"engine": engine}
    given |= SEEN if flyer == "geometric" or isinstance(flyer, Integrating) else {}
    _, controller, scenario = setting(flyer, made, **given)
    each = flights(fly(controller, scenario, episodes=episodes, seed=FRESH))
    reached = {"success": float(each["success"].mean())}
    for name in ("position_error_m", *(name for name in BEHAVIOUR if name in each)):
        reached[name] = float(np.median(each[name]))
    return reached | {"least_height_m": means_of_behaviour(each)["least_height_m"]}


def robust(runs: Runs = (), episodes: int = 1000) -> None:
    """Fly policies for uncertain aircraft, of several seeds, beside the tuned controller.

    `quadrl train TASK --variant robust --seeds 645:650 --out runs/robust` trains those of a task.

    Args:
        runs: Run folders; what was measured of tasks that none of them has is kept. Without any,
            the controller alone flies, in every task.
        episodes: Flights of each seed in each condition.
    """
    trained = [Policy.load(run) for run in runs if (run / FILE).is_file()]
    only = [*dict.fromkeys(policy.task for policy in trained)] or report.load("tuning")["tasks"]
    before = [] if trained else report.load("robust")["rows"]

    def rows(task: str) -> dict[str, list[Result]]:
        seeds: Result = {str(x.metadata["seed"]): x for x in trained if x.task == task}
        known = [row for row in before if row["task"] == task and row["seed"] != "controller"]
        for seed in (*seeds, "controller"):
            for name, condition in UNSURE.items():
                condition = WIDER | {"aerodynamics": "full"} | condition
                flyer = seeds.get(seed) or tuned(task, "uncertain", condition)
                found = flown(flyer, task, condition, episodes)
                known.append({"seed": seed, "condition": name} | found)
            say(f"{task}, {seed}: {known[-1]}")
        return {"rows": known}

    cases = {task: partial(rows, task) for task in tasks.TASKS}
    report.gather("robust", "task", cases, only, episodes=episodes)


def robustness(only: tuple[str, ...] = (), episodes: int = 100) -> None:
    """Fly every policy that comes with quadrl, and the controllers, through disturbances; draw.

    Each disturbance alone, at graded levels and at the strength of the presets, and all together.

    Args:
        only: Names of tasks, beside what was measured of the others; by default all.
        episodes: Flights of each level and of each condition.
    """
    cases = {task: partial(withstood, task, episodes) for task in report.load("tuning")["tasks"]}
    report.gather("robustness", "task", cases, only, episodes=episodes)


def withstood(task: str, episodes: int) -> dict[str, list[Result]]:
    """Success of all four in each condition, and where half of the flights fail; drawn."""
    flyers: Result = {"policy": task, "robust policy": f"{task}_robust"}
    flyers["controller"], alone = "geometric", list[Result]()
    for name, condition in conditions().items():
        shares = {k: flown(flyer, task, condition, episodes) for k, flyer in flyers.items()}
        wider = WIDER | condition  # as the robust policy commands
        shares["tuned controller"] = flown(tuned(task, name, wider), task, wider, episodes)
        alone.append({"condition": name} | {k: found["success"] for k, found in shares.items()})
    card = quadrl.robustness(flyers, task, episodes=episodes)
    card.figure.save(report.IMAGES / "robustness" / f"{task}.png")
    card.maps.save(report.IMAGES / "robustness" / f"{task}_recovery.png")
    (_, *names), *levels = card.table
    half = [{"flown": x} | {row[0]: row[k + 1] for row in levels} for k, x in enumerate(names)]
    return {"half": half, "alone": alone}


def half_table() -> str:
    """Where half of the flights fail, for each task."""
    result = report.load("robustness")
    rows = [{k: x for k, x in row.items() if k != "commit"} for row in result["half"]]
    note = f"{result['episodes']} flights a level."
    return block(rows[0], (row.values() for row in rows), note, result, result["half"])


def alone_table() -> str:
    """Success in each condition where not every flight succeeds, a column for each task."""
    result, rows, always = report.load("robustness"), [], []
    known = [*grouped(result["alone"], "task")]
    for name, own in grouped(result["alone"], "condition").items():
        shares = {row["task"]: [f"{100 * row[x]:.0f}" for x in row if x not in KEYS] for row in own}
        if {share for each in shares.values() for share in each} == {"100"}:
            always.append(name)
            continue
        said = f"{name}, drag only" if name.startswith("weather") else name
        rows.append((said, *(" / ".join(shares[task]) for task in known)))
    note = f"Every flight of all four succeeds with {', '.join(always)}. "
    note += "Successful flights [%], policy / robust policy / controller / tuned controller; "
    note += f"{result['episodes']} flights each."
    return block(("disturbed by", *known), rows, note, result, result["alone"])


def over_seeds(result: Result) -> dict[tuple[str, bool, str], list[Result]]:
    """Rows of all seeds, by task, whether the tuned controller flew, and condition."""
    rows = (row | {"controller": row["seed"] == "controller"} for row in result["rows"])
    return grouped(rows, "task", "controller", "condition")


def robust_table() -> str:
    """Success and error of the policies for uncertain aircraft, over the seeds."""
    result, cells = report.load("robust"), {}
    for (task, controller, _), rows in over_seeds(result).items():
        names = ("success", "position_error_m", "yaw_rate_rad_s")
        shares, errors, turning = ([row[name] for row in rows] for name in names)
        words = f"{100 * np.mean(shares):.1f}"
        if len(shares) > 1:
            words += f" [{100 * min(shares):.1f}, {100 * max(shares):.1f}]"
        words += f", {length(np.median(errors))}, {np.median(turning):.2f} rad/s"
        who = "geometric controller, tuned" if controller else "robust policies"
        cells.setdefault((f"`{task}`", who), []).append(words)
    note = "Successful flights [%] of all seeds, in brackets the worst and the best; medians of "
    note += "the error and the yaw rate over the last 2 s. "
    note += f"{result['episodes']} flights for each seed and condition."
    rows = ((*key, *own) for key, own in cells.items())
    return block(("task", "flown by", *UNSURE), rows, note, result, result["rows"])


def ways_table() -> str:
    """How the policies for uncertain aircraft and the controller fly, beside where."""
    rows = []
    for (task, controller, condition), found in over_seeds(report.load("robust")).items():
        if condition not in WAYS_OF:
            continue
        cells = [f"`{task}`", "tuned controller" if controller else "robust policies", condition]
        for name in BEHAVIOUR:
            values = [row[name] for row in found if row.get(name) is not None]
            whole = min if name == "least_height_m" else np.median
            cells.append(quantity(name, whole(values)) if values else "")
        rows.append(cells)
    return table(("task", "flown by", "flown in", *map(FIGURES.get, BEHAVIOUR)), rows)


PARTS: report.Parts = {"robust": robust_table, "robust-ways": ways_table,
                       "robustness-half": half_table, "robustness-alone": alone_table}  # fmt: skip
