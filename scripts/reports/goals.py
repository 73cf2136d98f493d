"""What PPO and APG reach with fresh seeds: success in many flights, precision, and wall clock.

Run it on a machine that does nothing else: the trainings are made one after the other, on all
cores. Interrupted at any moment, it continues at the next start.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from torchrl.objectives import ClipPPOLoss

from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import EVALUATION_SEED, flights, fly
from quadrl.learning.config import TrainConfig
from quadrl.learning.fused import USUAL
from quadrl.learning.studies.crew import train_here
from quadrl.learning.studies.plan import PlannedRun
from quadrl.learning.train import Training
from scripts.reports import report
from scripts.reports.evaluation import trained
from scripts.reports.report import Result, number, say, table

SEEDS = (305, 306, 307, 308, 309)  # not used for tuning
# The settings of these were changed after the policies of SEEDS had been flown.
FRESH_SEEDS = {
    ("hover", "ppo"): (355, 356, 357, 358, 359),
    ("hover", "apg"): (340, 341, 342, 343, 344),
    ("random_waypoint", "ppo"): (380, 381, 382, 383, 384),
}
AIRBORNE = ("hover", "static_waypoint", "random_waypoint", "straight_and_level", "target_following")
TASKS = {"ppo": AIRBORNE, "apg": AIRBORNE}
FLIGHTS = 1000
MANY = {("random_waypoint", "ppo"): 10_000}
TOGETHER = 1000  # flights in a batch
PAIRS = 5  # trainings with each loss, in turn
LOSSES = ("fused_s", "usual_s")


def main(only: tuple[str, ...] = ()) -> None:
    """Train what is missing, fly it, write it down.

    Args:
        only: Names of tasks, beside what was measured of the others; by default all.
    """
    runs = [
        PlannedRun(
            TrainConfig(task, algo=algo, seed=seed), report.RUNS / "goals" / f"{task}-{algo}-{seed}"
        )
        for algo, names in TASKS.items()
        for task in names
        if not only or task in only
        for seed in FRESH_SEEDS.get((task, algo), SEEDS)
    ]
    train_here(runs, 1, 20, say)
    found = [trained(run) | flown(run) | {"commit": report.commit()} for run in runs]
    if only:
        found += report.others("goals", "runs", only)
        places = [(algo, task) for algo, names in TASKS.items() for task in names]
        found.sort(key=lambda run: places.index((run["algo"], run["task"])))
    took = [
        {name: update_seconds(fused=name == "fused_s") for name in LOSSES} for _ in range(PAIRS)
    ]
    updates = {name: statistics.median(pair[name] for pair in took) for name in LOSSES}
    report.save("goals", {"command": "scripts/report goals", "runs": found, "updates": updates})


def update_seconds(*, fused: bool) -> float:
    """Processor time of all updates of a training of hover, with the fused loss or TorchRL's."""
    with tempfile.TemporaryDirectory() as folder:
        training = Training(TrainConfig("hover"), Path(folder) / "run")
        algorithm: Any = training.algorithm
        if not fused:
            algorithm.loss = ClipPPOLoss(
                training.actor, training.critic, entropy_bonus=False, **USUAL
            )
        update, seconds = algorithm.update, []

        def timed(*given: Any) -> dict[str, float]:
            started = time.thread_time()
            metrics = update(*given)
            seconds.append(time.thread_time() - started)
            return metrics

        algorithm.update = timed
        training.run()
    return sum(seconds)


def flown(run: PlannedRun) -> Result:
    """What the mean action of a finished training reaches in free flight."""
    policy, config = Policy.load(run.folder), run.config
    total = MANY.get((config.task, config.algo), FLIGHTS)
    each = [
        flights(
            fly(
                policy,
                config.task,
                episodes=min(TOGETHER, total - first),
                seed=EVALUATION_SEED + first,
                engine="free_flight",
            )
        )
        for first in range(0, total, TOGETHER)
    ]
    reached: Result = {"flights": total, "failed": sum(int((~x["success"]).sum()) for x in each)}
    for name in ("position_error_m", "heading_error_deg"):
        if name in each[0]:
            reached[name] = float(np.concatenate([x[name] for x in each]).mean())
    say(f"{run.name}: {reached}")
    return reached


def goals() -> str:
    """Each task and algorithm, its seeds beside each other."""
    result = report.load("goals")
    groups: dict[tuple[str, str], list[Result]] = {}
    for run in result["runs"]:
        groups.setdefault((run["task"], run["algo"]), []).append(run)
    rows = []
    for (task, algo), runs in groups.items():
        error = (number(1000 * run["position_error_m"], 2) for run in runs)
        off = [number(run["heading_error_deg"], 2) for run in runs if "heading_error_deg" in run]
        took = [run["training_s"] for run in runs]
        failed = ", ".join(str(run["failed"]) for run in runs)
        seeds = f"{runs[0]['seed']} to {runs[-1]['seed']}"
        time = f"{statistics.median(took):.1f} s ({min(took):.1f} to {max(took):.1f})"
        cells = (seeds, f"{runs[0]['steps']:,}", time)
        cells += (f"{failed} of {runs[0]['flights']:,}", ", ".join(error), ", ".join(off))
        rows.append((f"`{task}`", algo, *cells))
    head = (
        "task",
        "algorithm",
        "seeds",
        "control steps",
        "training, median and range",
        "failed flights, seed by seed",
    )
    head += ("error [mm]", "heading error [deg]")
    source = report.source(result | report.commits(result["runs"]))
    updates = result["updates"]
    note = (
        "Errors are means over all flights, also failed ones. All updates of a training of hover "
        f"take PPO {updates['fused_s']:.1f} s of one processor, and {updates['usual_s']:.1f} s "
        "with TorchRL's own loss in place of the [fused one](training.md#a-trained-policy)."
    )
    return f"{table(head, rows)}\n\n{note} {source}"


PARTS: report.Parts = {"goals": goals}

if __name__ == "__main__":
    tyro.cli(main)
