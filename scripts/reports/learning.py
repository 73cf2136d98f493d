"""Where learning wins: policies beside the tuned controller."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from quadrl.base.units import quantity
from scripts.reports import report
from scripts.reports.robustness import UNSURE

RATE, ERROR = "success_rate", "position_error_m"
ALONE = ("weather light", "weather moderate", "command_delay as in `full`", "lag as in `full`",
         "randomization full", "all together")  # fmt: skip
WORDS = {RATE: "successful", ERROR: "error, median", "settled_m": "distance, mean",
         "race_time_mean_s": "time, mean"}  # fmt: skip
GAINS = {
    "robust": "one set",
    "robustness": "for the row",
    "missions": "for the row",
    "race": "usual",
}
# Where the programs of finished reports are.
FINISHED = {"race": " at 6fa4e93", "missions": " at af7f29c"}


def compared() -> Iterator[tuple[str, str, int, str, dict[str, Any]]]:
    """Condition, metric, flights, report, and by task what policy and tuned controller reach."""
    robust, alone, own, race = map(report.load, ("robust", "robustness", "missions", "race"))
    for name, key in (*((name, "success") for name in UNSURE), ("nothing", ERROR)):
        found: dict[str, Any] = {}
        for row in robust["rows"]:
            if row["condition"] == name:
                both = found.setdefault(row["task"], ([], []))
                both[row["seed"] == "controller"].append(row[key])
        means = {task: tuple(map(np.mean, both)) for task, both in found.items()}
        yield name, RATE if key == "success" else key, robust["episodes"], "robust", means
    for name in ALONE:
        found = {row["task"]: (row["robust policy"], row["tuned controller"])
                 for row in alone["alone"] if row["condition"] == name}  # fmt: skip
        yield name, RATE, alone["episodes"], "robustness", found
    for row in own["rows"]:
        if row["who"] == "controller":
            metric = row["metric"]
            policies = [x[metric] for x in own["rows"]
                        if x["condition"] == row["condition"] and x is not row]  # fmt: skip
            mean = None if None in policies else np.mean(policies)
            sides = {row["task"]: (mean, row[metric])}
            yield row["condition"], metric, own["episodes"], "missions", sides
    laps = [row for row in race["rows"] if row["race"] == "one lap"]
    for metric in (RATE, "race_time_mean_s"):
        *policies, controller = (row[metric] for row in laps)
        yield "one lap", metric, race["episodes"], "race", {"race": (np.mean(policies), controller)}


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
        command = f"`scripts/report {source}`" + FINISHED.get(source, "")
        rows.append((first, WORDS[metric], *told, GAINS[source], "; ".join(who), command))
    head = ("flown in", "figure", "policy", "controller", "its gains", "ahead", "measured by")
    return report.table(head, rows)


PARTS: report.Parts = {"wins": wins_table}
