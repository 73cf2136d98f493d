"""Fly the paper's six tasks by one policy and by those of their own: `one_policy`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from quadrl.base.units import length, percent, quantity
from quadrl.core.catalogue import make
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.policy import Policy
from quadrl.learning.comparison import Comparison, compare
from scripts.reports import report
from scripts.reports.report import Result, Runs, block, grouped, say

SEED = 940_000  # of flights that no choice was made on
ALL, OWN = "all", "own"
"""Who flies: a policy that was trained for all tasks, or for the one."""


def one_policy(runs: Runs, episodes: int = 1000) -> None:
    """Fly each of the six tasks by the policies of runs of `quadrl train all`.

    Beside them stand the trainings of each task alone, as `training` measured them.

    Args:
        runs: Run folders, one for each training seed.
        episodes: Flights of each in each task.
    """
    rows, tasks = list[Result](), {part.name: part for part in make("all").parts}
    kept = ("success_rate", "survival_rate", "position_error_m", "yaw_rate_rad_s")
    for run in report.load("training")["runs"]:
        usual = {"vehicle": "paper", "engine": "free_flight", "algo": "ppo"}
        if run["task"] in tasks and usual.items() <= run.items():
            found = {key: run["metrics"][key] for key in kept}
            row = {"flies": OWN, "seed": run["seed"], "task": run["task"]}
            rows.append({**row, **found, "misses": {}})
    for policy in map(Policy.load, runs):
        for task, part in tasks.items():
            found = evaluate(policy, task, episodes=episodes, seed=SEED).metrics
            row = {"flies": ALL, "seed": policy.metadata["seed"], "task": task}
            short = {x.metric: found[x.metric] for x in part.asked if not x.met(found)}
            rows.append({**row, **{key: found[key] for key in kept}, "misses": short})
            say(rows[-1])
    report.save("one_policy", {"episodes": episodes, "flights": rows})


def one_policy_table() -> str:
    """Success and error in each task, by one policy and by the task's own, and what differs."""
    result, rows = report.load("one_policy"), []
    for task, own in grouped(result["flights"], "task").items():
        by = grouped(own, "flies")
        cells = [
            _over_trainings([row[figure] for row in by[who]], words)
            for who in (OWN, ALL)
            for figure, words in (("success_rate", percent), ("position_error_m", length))
        ]
        rows.append([f"`{task}`", *cells, compared(own, "position_error_m").verdict, _short(own)])
    head = ("task", "its own policy", "error", "one policy", "error", "error of the one")
    head += ("targets of the task that the one misses",)
    count = len(grouped(grouped(result["flights"], "flies")[ALL], "seed"))
    seeds = f"{count} trainings; of each task alone as in [all trainings](results.md#every-task)"
    whole = compared(result["flights"], "success_rate")
    flown = f"{result['episodes']:,} flights of each one policy: mean (range) of {seeds}."
    powers = f"{whole.power_differs:.2f} to see that one wins three times in four"
    powers += f", {whole.power_equal:.2f} to see that none does"
    said = f"Success over all tasks beside their own: {whole.verdict} (power {powers})."
    return block(head, rows, f"{flown} {said}", result)


def _short(own: list[Result]) -> str:
    """The targets of a task that a training of all misses, and by what."""
    of_all, said = [row for row in own if row["flies"] == ALL], list[str]()
    for target in make(own[0]["task"]).asked:
        missed = [x["misses"][target.metric] for x in of_all if target.metric in x["misses"]]
        if missed:
            worst = quantity(target.metric, min(missed) if target.at_least else max(missed))
            said.append(f"{target.words}: {len(missed)}, at worst {worst}, asked {target.asked}")
    return "; ".join(said) or "none"


def compared(flown: list[Result], figure: str) -> Comparison:
    """A figure of the trainings of all beside that of the trainings of each task alone."""
    runs = [
        {"task": row["task"], "algo": row["flies"], "variant": "", "metrics": row} for row in flown
    ]
    return compare(runs, figure, ALL, OWN)


def _over_trainings(values: list[float], words: Callable[[float], str]) -> str:
    """The mean of several trainings with their range; the value of one."""
    if len(values) == 1:
        return words(values[0])
    return f"{words(float(np.mean(values)))} ({words(min(values))} to {words(max(values))})"


PARTS: report.Parts = {"one-policy": one_policy_table}
