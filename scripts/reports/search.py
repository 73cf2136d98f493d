"""Settings for the paper's experiments: one search for each algorithm and task, of the same size.

Every algorithm gets as many settings, drawn in the same way from ranges of the same width, the same
tuning seeds and the same criterion. Interrupted at any moment, it continues at the next start.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import tyro
from scipy.stats import qmc

from quadrl import tasks
from quadrl.core.task import Target
from quadrl.learning.config import TrainConfig
from quadrl.learning.defaults import merged
from quadrl.learning.folder import EVALUATION
from quadrl.learning.studies.crew import train_here
from quadrl.learning.studies.plan import PlannedRun
from scripts.reports import report
from scripts.reports.report import Result, factor, number, say, table

TASKS = {"hover": 204_800, "static_waypoint": 655_360, "landing": 2_621_440}
"""Control steps of each training by its task: enough for the plain policy gradient."""
LABELS = {"vpg": "GAE", "ppo": "PPO", "trpo": "TRPO"}
"""The algorithms, and what the paper calls them."""
SOLVED = 0.95  # share of episodes that succeed with the mean action, for a solved seed
SETTINGS = 16
FINALISTS = 3
FIRST, AGAIN = 300, 301
"""Tuning seeds: of all settings, and of the finalists as well."""
EPISODES = 100
BATCHES = ((32, 8), (64, 8), (128, 8), (128, 16), (256, 16))
"""Aircraft and control steps in a batch."""
LAMBDAS = (0.9, 0.95, 0.97, 0.99)
RATES = (6e-4, 2e-2)  # of policies
BOUNDS = (2e-3, 2e-3 * RATES[1] / RATES[0])  # of the KL divergence of a step
CRITIC_RATES = (1e-3, 2e-2)
EPOCHS = (3, 10)


def settings(algo: str, number: int) -> dict[str, Any]:
    """One of the settings that are tried.

    Args:
        algo: Name of the algorithm.
        number: From 0 to SETTINGS - 1: a point of a Halton sequence, the same for each algorithm.

    Returns:
        Settings of `TrainConfig`: batch and lambda, how far the policy goes at a time, and a second
        number of the algorithm.
    """
    points = qmc.Halton(4, rng=np.random.default_rng(0)).random(SETTINGS)
    batch, step, second, lam = points[number].tolist()
    num_envs, rollout = BATCHES[int(batch * len(BATCHES))]
    shared = {"num_envs": num_envs, "rollout": rollout}
    shared["gae_lambda"] = LAMBDAS[int(lam * len(LAMBDAS))]
    if algo == "ppo":
        epochs = EPOCHS[0] + int(second * (EPOCHS[1] - EPOCHS[0] + 1))
        own = {"learning_rate": between(step, RATES), "epochs": epochs}
    else:
        name, ends = ("max_kl", BOUNDS) if algo == "trpo" else ("learning_rate", RATES)
        own = {name: between(step, ends), "critic_rate": between(second, CRITIC_RATES)}
    return shared | {algo: own}


def between(share: float, ends: tuple[float, float]) -> float:
    """A number between two others, evenly in its logarithm, in two digits."""
    low, high = ends
    return float(f"{low * (high / low) ** share:.1e}")


def planned(
    where: str, task: str, algo: str, seed: int, chosen: dict[str, Any], name: str = ""
) -> PlannedRun:
    """A training with the paper's network; quadrl's own default for two tasks holds the goal.

    Args:
        where: Folder of the run folders.
        task: Name of the task.
        algo: Name of the algorithm.
        seed: Of the training.
        chosen: Settings that differ from the task's own.
        name: Of the settings.
    """
    fixed: dict[str, Any] = {"seed": seed, "num_threads": 1, "holds_goal": False}
    fixed["ppo"] = {"beta2": 0.999}  # as all of Adam is in the other two
    asked = tasks.make(task)
    fixed["training_options"] = {
        name: getattr(asked, name) for name in TrainConfig(task).training_options
    }
    config = TrainConfig(task, algo=algo, **merged({"steps": TASKS[task]}, fixed, chosen))
    words = (task, algo, *filter(None, [name]), str(seed))
    return PlannedRun(config, report.RUNS / where / "-".join(words), name)


def tried(task: str, algo: str, numbers: Iterable[int], seed: int) -> list[PlannedRun]:
    """Trainings with some of the settings."""
    return [
        planned("search", task, algo, seed, settings(algo, n), f"setting{n:02}") for n in numbers
    ]


def main(jobs: int = 2, names: tuple[str, ...] = tuple(TASKS)) -> None:
    """Train what is missing, choose, write it down after each task.

    Args:
        jobs: Trainings at the same time.
        names: The tasks; what was found for others is kept.
    """
    found: Result = {"command": "scripts/report search", "episodes": EPISODES, "tasks": {}}
    if (report.RESULTS / "search.json").exists():
        found["tasks"] = report.load("search")["tasks"]
    for task in names:
        first = {algo: tried(task, algo, range(SETTINGS), FIRST) for algo in LABELS}
        train_here(itertools.chain(*first.values()), jobs, EPISODES, say)
        reached = {algo: [figures(task, run) for run in runs] for algo, runs in first.items()}
        best = {
            algo: sorted(range(SETTINGS), key=lambda n: worth([each[n]]), reverse=True)[:FINALISTS]
            for algo, each in reached.items()
        }
        again = {algo: tried(task, algo, numbers, AGAIN) for algo, numbers in best.items()}
        train_here(itertools.chain(*again.values()), jobs, EPISODES, say)
        found["tasks"][task] = {}
        for algo, numbers in best.items():
            seconds = [figures(task, run) for run in again[algo]]
            both = {n: [reached[algo][n], x] for n, x in zip(numbers, seconds, strict=True)}
            chosen = max(both, key=lambda n: worth(both[n]))
            say(f"{task}, {algo}: setting {chosen}, {both[chosen]}")
            found["tasks"][task][algo] = {
                "chosen": chosen,
                "settings": settings(algo, chosen),
                "finalists": {str(n): each for n, each in both.items()},
                "tried": [
                    settings(algo, n) | {"reached": reached[algo][n]} for n in range(SETTINGS)
                ],
                "training_s": sum(map(seconds_of, (*first[algo], *again[algo]))),
                "steps": first[algo][0].config.steps,
            }
        report.save("search", found)


def precision(task: str) -> Target:
    """What says how precisely a task is flown: its first target that is no share of episodes."""
    return next(target for target in tasks.make(task).targets if target.unit != "%")


def figures(task: str, run: PlannedRun) -> tuple[float, float]:
    """Share of successful episodes, and error, of a finished training."""
    metrics = json.loads((run.folder / EVALUATION).read_text())
    error = metrics[precision(task).metric]
    return metrics["success_rate"], error if error is not None and error >= 0 else math.inf


def worth(each: list[tuple[float, float]]) -> tuple[float, float]:
    """What settings are compared by, more is better: mean success, then mean error."""
    success, error = np.mean(each, axis=0)
    return success.item(), -error.item()


def seconds_of(run: PlannedRun) -> float:
    """How long a finished training took."""
    return json.loads((run.folder / EVALUATION).read_text())["training_s"]


def chosen() -> str:
    """What was chosen for each task and algorithm."""
    result, rows = report.load("search"), []
    for task, algorithms in result["tasks"].items():
        target = precision(task)
        for algo, found in algorithms.items():
            own = found["settings"]
            words = [f"{own['num_envs']} x {own['rollout']}", own["gae_lambda"]]
            words.append(", ".join(f"{name} {value:g}" for name, value in own[algo].items()))
            solved = sum(one["reached"][0] >= SOLVED for one in found["tried"])
            best = found["finalists"][str(found["chosen"])]
            success = " and ".join(f"{100 * share:.0f} %" for share, _ in best)
            error = " and ".join(
                number(None if x is None else factor(target) * x, 2) for _, x in best
            )
            row = (f"`{task}`", LABELS[algo], *words, f"{solved} of {len(found['tried'])}")
            rows.append((*row, f"{success}, {error} {target.unit}"))
    head = ("task", "algorithm", "batch", "lambda", "its own settings", "settings that solve it")
    seeds = f"chosen: success and precision with the tuning seeds {FIRST} and {AGAIN}"
    return f"{table((*head, seeds), rows)}\n\n{report.source(result)}"


PARTS: report.Parts = {"search": chosen}

if __name__ == "__main__":
    tyro.cli(main)
