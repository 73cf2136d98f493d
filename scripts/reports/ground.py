"""Landing with ground effect, with the paper's action scale and with a wider one."""

from __future__ import annotations

from typing import Any

import numpy as np
import tyro

from quadrl import tasks
from quadrl.aircraft.presets import resolve, with_effects
from quadrl.aircraft.vehicle import Vehicle
from quadrl.control import make as make_controller
from quadrl.learning.config import TrainConfig
from quadrl.learning.defaults import WIDE
from quadrl.policy import Policy
from quadrl.rollout import fly, summarize
from quadrl.studies.crew import train_here
from quadrl.studies.plan import PlannedRun
from scripts.reports import report
from scripts.reports.report import Result, say, table

TASK, EFFECT = "landing", "ground_effect"
SEEDS = (260, 261, 262)  # not used for tuning
EPISODES = 500
USUAL = Vehicle().action_scale
SHOWN = {
    "success_rate": ("successful [%]", 100),
    "crash_rate": ("crashes [%]", 100),
    "touchdown_speed_median_m_s": ("touchdown, median [m/s]", 1),
    "position_error_m": ("error [cm]", 100),
}
CONTROLLER = "geometric controller"


def plan() -> list[PlannedRun]:
    """The trainings with the wide action scale."""
    given: Any = {"aerodynamics": EFFECT, "vehicle_options": {"action_scale": WIDE}}
    folder = report.RUNS / "ground"
    return [
        PlannedRun(
            TrainConfig(TASK, seed=seed, num_threads=1, **given), folder / f"{WIDE:g}-{seed}"
        )
        for seed in SEEDS
    ]


def main(jobs: int = 2) -> None:
    """Train what is missing, fly it, write it down.

    Args:
        jobs: Trainings at the same time.
    """
    runs = plan()
    train_here(runs, jobs, 20, say)
    usual, wide = (resolve(None, {"action_scale": scale}) for scale in (USUAL, WIDE))
    trained = [Policy.load(run.folder) for run in runs]
    rows: list[tuple[str, Vehicle, list[Any]]] = [
        (CONTROLLER, usual, [make_controller("geometric", tasks.make(TASK), usual)]),
        ("policy that comes with quadrl, trained without", usual, [Policy.pretrained(TASK)]),
        (CONTROLLER, wide, [make_controller("geometric", tasks.make(TASK), wide)]),
        (f"policies trained with it, {len(trained)} seeds", wide, trained),
    ]
    found: Result = {"episodes": EPISODES, "seeds": SEEDS, "rows": []}
    for name, vehicle, controllers in rows:
        reached = [landed(each, vehicle) for each in controllers]
        row = {"scale": vehicle.action_scale, "flown": name, "reached": reached}
        found["rows"].append(row)
    report.save("ground", found)


def landed(controller: Any, vehicle: Vehicle) -> Result:
    """What is reached in ground effect, in calm air."""
    aircraft = with_effects(vehicle, EFFECT)
    reached = summarize(fly(controller, TASK, episodes=EPISODES, vehicle=aircraft))
    return {name: reached[name] for name in SHOWN}


def ground() -> str:
    """What lands."""
    result = report.load("ground")
    rows = []
    for row in result["rows"]:
        cells = []
        for name, (_, factor) in SHOWN.items():
            values = factor * np.array([one[name] for one in row["reached"]], float)
            spread = f" ({values.min():.3g} to {values.max():.3g})" if len(values) > 1 else ""
            none = np.isnan(values).any()  # it never touched down
            cells.append("none" if none else f"{values.mean():.3g}{spread}")
        rows.append((f"{row['scale']:g}", row["flown"], *cells))
    head = ("action scale [rad/s]", "flown by", *(words for words, _ in SHOWN.values()))
    note = f"{result['episodes']} landings each; mean, lowest and highest of the seeds."
    return f"{table(head, rows)}\n\n{note} {report.source(result)}"


PARTS: report.Parts = {"ground": ground}

if __name__ == "__main__":
    tyro.cli(main)
