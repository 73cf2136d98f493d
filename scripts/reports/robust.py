"""Trains policies for uncertain aircraft in wind, and flies them beside the tuned controller.

`scripts/report tuning` tunes the controller. Interrupted at any moment, it continues at the next
start.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import tyro

from quadrl import tasks
from quadrl.aircraft.presets import resolve
from quadrl.conditions.randomization import Randomization
from quadrl.evaluation.card import wilson
from quadrl.evaluation.evaluate import setting
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import flights, fly
from quadrl.learning.config import TrainConfig
from quadrl.learning.defaults import WIDE
from quadrl.learning.studies.crew import train_here
from quadrl.learning.studies.plan import PlannedRun
from scripts.reports import report
from scripts.reports.evaluation import trained
from scripts.reports.report import Result, say, table
from scripts.reports.tuning import BOTH, FRESH, UNCERTAIN, tuned

SEEDS = (242, 243, 244, 245, 246)  # not used for tuning
# The settings of these were changed after the policies of SEEDS had been flown.
FRESH_SEEDS = {
    ("hover", "robust"): (263, 264, 265, 266, 267),
    ("random_waypoint", "robust"): (388, 389, 390, 391, 392),
}
EPISODES = 1000
FEWER: dict[str, Any] = {"steps": 1_638_400}
BLIND: dict[str, Any] = {"observe": {"action_history": 0, "disturbance": False}}
WAYS: dict[str, dict[str, Any]] = {
    "robust": {},
    "robust, fewer steps": FEWER,
    "memory in place of history and disturbance, fewer steps": FEWER | BLIND | {"memory": "gru"},
    "without history and disturbance, fewer steps": FEWER | BLIND,
}
"""Settings beside those of the variant robust; only hover is trained in all of them."""
CONTROLLER = "geometric controller, tuned"


def conditions() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """A name, effects of the air, and what disturbs the flights."""
    late = {name: Randomization(**given) for name, given in LATE.items()}
    yield "uncertain", "none", {"weather": "light", "randomization": UNCERTAIN}
    yield "uncertain, in full air", "full", {"weather": "light", "randomization": UNCERTAIN}
    yield "nothing", "none", {"weather": "calm", "randomization": "none"}
    for name, randomization in late.items():
        yield name, "none", {"weather": "calm", "randomization": randomization}
    yield "all together", "full", {"weather": "light", "randomization": "full"}


LATE: dict[str, Any] = {
    "50 ms of delay": {"command_delay": 0.05},
    "half the lag": {"lag": 0.5},
    "twice the lag": {"lag": 2.0},
}


def plan(task: str, way: str) -> list[PlannedRun]:
    """The trainings of a task in one way."""
    folder, name = report.RUNS / "robust", way.replace(",", "").replace(" ", "-")
    return [
        PlannedRun(
            TrainConfig(task, variant="robust", seed=seed, num_threads=1, **WAYS[way]),
            folder / f"{task}-{name}-{seed}",
        )
        for seed in FRESH_SEEDS.get((task, way), SEEDS)
    ]


def main(
    names: tuple[str, ...] = tuple(tasks.TASKS),
    ways: tuple[str, ...] = tuple(WAYS),
    seeds: int = len(SEEDS),
    jobs: int = 2,
) -> None:
    """Train what is missing, fly it, write it down after each task.

    Args:
        names: Names of the tasks; what was measured of others is kept.
        ways: Names of `WAYS`; tasks other than hover have the first one alone.
        seeds: How many of the seeds.
        jobs: Trainings at the same time.
    """
    found: Result = {"episodes": EPISODES, "tasks": {}}
    if (report.RESULTS / "robust.json").exists():
        found["tasks"] = report.load("robust")["tasks"]
    for task in names:
        entry = found["tasks"].setdefault(task, {})
        for way in ways if task == "hover" else ["robust"]:
            runs = plan(task, way)[:seeds]
            train_here(runs, jobs, 100, say)
            entry[way] = [
                trained(run) | {"flown": all_flown(Policy.load(run.folder), task)} for run in runs
            ]
        if task in BOTH:
            entry[CONTROLLER] = [{"flown": all_flown(None, task)}]
        report.save("robust", found)


def all_flown(policy: Policy | None, task: str) -> dict[str, Result]:
    """What a policy, or the tuned controller for None, reaches in each condition."""
    reached = {}
    for name, air, disturbed in conditions():
        vehicle = resolve(None, {"action_scale": WIDE}) if policy is None else None
        flown = policy or "geometric"
        _, controller, made, vehicle = setting(flown, task, vehicle, aerodynamics=air)
        if policy is None:
            controller = tuned(task, "uncertain", vehicle)
        given: Any = {"episodes": EPISODES, "vehicle": vehicle, "seed": FRESH, **disturbed}
        each = flights(fly(controller, made, engine=engine(made), **given))
        errors = np.quantile(each["position_error_m"], (0.5, 0.98))
        reached[name] = {"success": float(each["success"].mean()), "error_m": errors.tolist()}
        reached[name]["survival"] = float(each["survived"].mean())
        say(f"{task}, {'controller' if policy is None else policy}, {name}: {reached[name]}")
    return reached


def engine(task: Any) -> Any:
    """Free flight, unless the task touches the ground."""
    return "mujoco" if task.contact else "free_flight"


def results() -> str:
    """Success and error of each way to fly, over the seeds."""
    result = report.load("robust")
    names = [name for name, *_ in conditions()]
    rows = []
    for task, ways in result["tasks"].items():
        for k, (way, runs) in enumerate(ways.items()):
            cells = [shown([run["flown"][name] for run in runs], result) for name in names]
            rows.append((f"`{task}`" if k == 0 else "", way, len(runs), *cells))
    head = ("task", "flown by", "seeds", *names)
    note = (
        "Successful flights [%] of all seeds with their 95 % interval (Wilson), in brackets the "
        "worst and the best seed; median of the error over the last 2 s. "
        f"{result['episodes']} flights for each seed and condition."
    )
    return f"{table(head, rows)}\n\n{note} {report.source(result)}"


def shown(flown: list[Result], result: Result) -> str:
    """The figures of one condition."""
    shares = [one["success"] for one in flown]
    total = len(shares) * result["episodes"]
    low, high = wilson(round(sum(shares) * result["episodes"]), total)
    error = np.median([one["error_m"][0] for one in flown])
    words = f"{100 * np.mean(shares):.1f} ({100 * low:.1f} to {100 * high:.1f})"
    if len(shares) > 1:
        words += f" [{100 * min(shares):.1f}, {100 * max(shares):.1f}]"
    return f"{words}, {100 * error:.1f} cm"


PARTS: report.Parts = {"robust": results}

if __name__ == "__main__":
    tyro.cli(main)
