"""Where learning wins: curves of several algorithms, and policies beside the tuned controller."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from scipy.stats import qmc

from quadrl.base.units import quantity
from quadrl.control import Gains, GeometricController
from quadrl.evaluation.plotting import learning_curves, save
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly, scenario_of, summarize
from scripts.reports import report
from scripts.reports.report import Result, say, table
from scripts.reports.robustness import FRESH, UNSURE

ENOUGH, RATE, ERROR = 0.95, "success_rate", "position_error_m"
CLOCKS, LEVELS = ("steps", "processor"), ("success", "error")
CURVE = {"steps": "steps", "processor": "seconds", "success": RATE, "error": ERROR}
EIGHT: Any = {"figure": "lemniscate", "time_limit": 30.0}
FLOWN: dict[str, tuple[str, str, Any]] = {
    "recovery from 3 m": ("recovery", RATE, {}),
    "recovery from 1.5 m": ("recovery", RATE, {"lowest": 1.5, "highest": 1.5}),
    "eight of 15 s": ("trajectory", "settled_m", EIGHT | {"period": 15.0}),
    "eight of 5.5 s": ("trajectory", "settled_m", EIGHT | {"period": 5.5}),
    "eight of 3.5 s": ("trajectory", "settled_m", EIGHT | {"period": 3.5}),
}
TRIED, FIRST = 16, FRESH + 100_000  # settings of the controller; first episode to choose by
LOW, HIGH = (0.7, 0.5, 1.0, 0.3), (2.5, 1.0, 8.0, 1.5)
"""Of its bandwidth, its authority, its speed [m/s] and its tilt [rad]."""
ALONE = ("weather light", "weather moderate", "command_delay as in `full`", "lag as in `full`",
         "randomization full", "all together")  # fmt: skip
WORDS = {RATE: "successful", ERROR: "error, median", "settled_m": "distance, mean",
         "race_time_mean_s": "time, mean"}  # fmt: skip
GAINS = {"robust": "one set", "robustness": "for the row", "wins": "for the row", "race": "usual"}


def curves(file: Annotated[Path, tyro.conf.Positional]) -> None:
    """Keep and draw learning curves.

    Args:
        file: What docs/examples/learning_curve.py printed for each training, a line each.
    """
    rows, groups = [], {}
    for told in map(json.loads, file.read_text().splitlines()):
        columns = {name: [point[key] for point in told["curve"]] for name, key in CURVE.items()}
        rows.append({"task": told["task"], "algo": told["algo"], "seed": told["seed"]} | columns)
        algorithms = groups.setdefault(told["task"], {})
        algorithms.setdefault(told["algo"], []).append({k: np.array(x) for k, x in columns.items()})
    report.save("curves", {"rows": rows})
    for task, runs in groups.items():
        own, *_ = runs.pop("geometric")
        level = {name: float(own[name][0]) for name in LEVELS}
        figure = learning_curves(runs, task, CLOCKS, LEVELS, level)
        save(figure, report.IMAGES / "curves" / f"{task}_compared.png")


def curves_table() -> str:
    """What each training takes until it succeeds for good, and what it ends with."""
    result, groups = report.load("curves"), {}
    for row in result["rows"]:
        groups.setdefault((f"`{row['task']}`", row["algo"]), []).append(row)
    rows = []
    for key, runs in groups.items():
        whole = [f"{np.median([run[clock][-1] for run in runs]):,.0f}" for clock in CLOCKS]
        lasting = [", ".join(since(run, clock) for run in runs) for clock in CLOCKS]
        ends = [", ".join(quantity(CURVE[name], run[name][-1]) for run in runs) for name in LEVELS]
        rows.append((*key, *whole, *lasting, *ends) if len(runs) > 1 else (*key, *[""] * 4, *ends))
    head = ("task", "by", "control steps", "processor time [s]", "steps to success",
            "seconds to success", "successful at the end", "error at the end")  # fmt: skip
    return f"{table(head, rows)}\n\n{report.source(result)}"


def since(run: Result, clock: str) -> str:
    """When a training begins to succeed for good."""
    failing = [k for k, share in enumerate(run["success"]) if share < ENOUGH]
    later = run[clock][max(failing, default=-1) + 1 :]
    return f"{later[0]:,.{clock == 'processor':d}f}" if later else "never"


def wins(episodes: int = 1000) -> None:
    """Fly recoveries and eights: the policies that ship, and the controller tuned for each.

    Args:
        episodes: Flights of each.
    """
    rows, points = [], qmc.Halton(len(LOW), scramble=False).random(TRIED)[1:]
    settings = [Gains()]
    for band, *rest in qmc.scale(points, LOW, HIGH).tolist():
        settings.append(Gains(band, band, 1.0, *rest))
    for name, (task, metric, options) in FLOWN.items():
        policy = Policy.pretrained(task)
        scenario = scenario_of(policy, task_options=options, engine="free_flight")
        tried = [GeometricController(scenario.aircraft, scenario.task, x) for x in settings]
        first = [summarize(fly(x, scenario, episodes=100, seed=FIRST)) for x in tried]
        best = max(range(TRIED), key=lambda k: (first[k][RATE], -first[k][metric]))  # noqa: B023
        row: Result = {"condition": name, "task": task, "metric": metric}
        for who, flyer in (("policy", policy), ("controller", tried[best])):
            found = summarize(fly(flyer, scenario, episodes=episodes, seed=FRESH))
            row |= {who: found[metric], f"{who}_success": found[RATE]}
        rows.append(row | {"gains": vars(settings[best])})
        say(rows[-1])
    report.save("wins", {"episodes": episodes, "rows": rows})


def compared() -> Iterator[tuple[str, str, int, str, dict[str, Any]]]:
    """Condition, metric, flights, report, and by task what policy and tuned controller reach."""
    robust, alone, own, race = map(report.load, ("robust", "robustness", "wins", "race"))
    for name, key in (*((name, "success") for name in UNSURE), ("nothing", ERROR)):
        found: dict[str, Any] = {}
        for row in robust["rows"]:
            if row["condition"] == name:
                both = found.setdefault(row["task"], ([], []))
                both[row["seed"] == "controller"].append(row[key])
        means = {task: tuple(float(np.mean(x)) for x in both) for task, both in found.items()}
        yield name, RATE if key == "success" else key, robust["episodes"], "robust", means
    for name in ALONE:
        found = {row["task"]: (row["robust policy"], row["tuned controller"])
                 for row in alone["alone"] if row["condition"] == name}  # fmt: skip
        yield name, RATE, alone["episodes"], "robustness", found
    for row in own["rows"]:
        sides = {row["task"]: (row["policy"], row["controller"])}
        yield row["condition"], row["metric"], own["episodes"], "wins", sides
    laps = [row for row in race["rows"] if row["race"] == "one lap"]
    for metric in (RATE, "race_time_mean_s"):
        *policies, controller = (row[metric] for row in laps)
        sides = {"race": (float(np.mean(policies)), controller)}
        yield "one lap", metric, race["episodes"], "race", sides


def ahead(metric: str, flights: int, policy: float | None, controller: float | None) -> str:
    """Who is: by twice the standard error of a share, or by a tenth of another figure."""
    if policy is None or controller is None:  # none of its flights gets so far
        return "controller" if policy is None else "policy"
    gain, noise = controller - policy, max(policy, controller) / 10
    if metric == RATE:
        variance = policy * (1 - policy) + controller * (1 - controller)
        gain, noise = -gain, 2 * (variance / flights) ** 0.5
    return "level" if abs(gain) <= noise else "policy" if gain > 0 else "controller"


def wins_table() -> str:
    """Who is ahead, condition by condition."""
    rows = []
    for name, metric, flights, source, sides in compared():
        groups: dict[str, list[str]] = {"policy": [], "level": [], "controller": []}
        for task, both in sides.items():
            groups[ahead(metric, flights, *both)].append(task)
        told = (", ".join(quantity(metric, side[k]) for side in sides.values()) for k in (0, 1))
        who = [f"{who}: {', '.join(each)}" for who, each in groups.items() if each]
        first = f"{name} ({', '.join(sides)})" if len(sides) == 1 else name
        given = (GAINS[source], "; ".join(who), f"`scripts/report {source}`")
        rows.append((first, WORDS[metric], *told, *given))
    head = ("flown in", "figure", "policy", "controller", "its gains", "ahead", "measured by")
    return table(head, rows)


PARTS: report.Parts = {"curves": curves_table, "wins": wins_table}
