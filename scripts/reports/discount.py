"""Hover rewarded by differences of potentials and by their integral, with several discounts.

Both have the same discounted sum at hover's own discount, but for a constant.
"""

from __future__ import annotations

import concurrent.futures
import itertools
import multiprocessing
import statistics
import tempfile
from pathlib import Path
from typing import Any

import tyro

import quadrl
from quadrl import tasks
from quadrl.base.rotation import Array
from quadrl.learning.config import TrainConfig
from quadrl.learning.train import Training
from quadrl.rollout import EVALUATION_SEED, flights, fly
from quadrl.snapshot import Snapshot
from quadrl.task import EpisodeEnd
from quadrl.tasks.hover import Hover
from scripts.reports import report
from scripts.reports.report import Result, number, say, table

OWN = Hover.training["gamma"]
DISCOUNTS = (OWN, 0.95, 0.98)
SEEDS = (370, 371, 372, 373, 374)  # not used for tuning
FLIGHTS = 1000
BUDGETS: tuple[dict[str, Any], ...] = ({}, {"steps": 819_200, "ppo": {"learning_rate": 4e-3}})
"""The settings of hover, and more steps that are smaller."""


class HoverIntegral(Hover):
    """Hover that is paid for where it is, not for what it gains."""

    name = "hover_integral"

    def reward(self, before: Snapshot, now: Snapshot, end: EpisodeEnd) -> dict[str, Array]:
        """Of each potential, 1 - gamma of it in place of the difference."""
        at, share = now.potentials, OWN - 1
        return super().reward(before, now, end) | {
            "progress": share * self.progress_weight * at.distance,
            "attitude": share * self.attitude_weight * at.attitude,
            "speed": share * self.speed_weight * at.speed,
            "spin": share * self.spin_weight * at.angular_speed,
        }


REWARDS = {Hover.name: "differences", HoverIntegral.name: "integral"}


def main(jobs: int = 2) -> None:
    """Train, fly, write it down.

    Args:
        jobs: Trainings at the same time.
    """
    cases = list(itertools.product(BUDGETS, REWARDS, DISCOUNTS, SEEDS))
    with concurrent.futures.ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        rows = list(pool.map(flown, *zip(*cases, strict=True)))
    report.save(
        "discount", {"command": "scripts/report discount", "flights": FLIGHTS, "rows": rows}
    )


def flown(budget: dict[str, Any], task: str, gamma: float, seed: int) -> Result:
    """What the policy of a training reaches in hover."""
    if HoverIntegral.name not in tasks.TASKS:  # only here: it is no task of the pages
        quadrl.register(HoverIntegral)
    config = TrainConfig(task, gamma=gamma, seed=seed, num_threads=1, **budget)
    with tempfile.TemporaryDirectory() as folder:
        policy = Training(config, Path(folder) / "run").run()
    settings: Any = {"episodes": FLIGHTS, "seed": EVALUATION_SEED, "engine": "free_flight"}
    each = flights(fly(policy, Hover(), **settings))
    row = {"reward": REWARDS[task], "steps": config.steps, "gamma": gamma, "seed": seed}
    row["learning_rate"] = config.ppo.learning_rate
    row |= {"failed": int((~each["success"]).sum())}
    row |= {"position_error_m": float(each["position_error_m"].mean())}
    say(row)
    return row


def discount() -> str:
    """Each reward and discount, over the seeds."""
    result = report.load("discount")
    rows = []
    names = ("reward", "steps", "learning_rate", "gamma")
    for key, found in itertools.groupby(result["rows"], lambda row: [row[x] for x in names]):
        each = list(found)
        errors = [1000 * row["position_error_m"] for row in each]
        failed = ", ".join(str(row["failed"]) for row in each)
        error = f"{number(statistics.median(errors), 2)} (worst {number(max(errors), 2)})"
        rows.append((key[0], f"{key[1]:,}", *key[2:], failed, error))
    head = ("reward", "control steps", "learning rate", "discount", "failed flights, seed by seed")
    note = f"{result['flights']:,} flights for each of the seeds {SEEDS[0]} to {SEEDS[-1]}."
    return f"{table((*head, 'error [mm], median'), rows)}\n\n{note} {report.source(result)}"


PARTS: report.Parts = {"discount": discount}

if __name__ == "__main__":
    tyro.cli(main)
