"""Fly finished missions many times, seed by seed, beside the tuned geometric controller."""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Annotated, Any

import tyro

from quadrl.base.units import quantity
from quadrl.control import Gains, GeometricController
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly, scenario_of, summarize
from quadrl.learning.config import TrainConfig
from scripts.reports import report
from scripts.reports.report import Parts, Result, say, table
from scripts.reports.robustness import FRESH

EPISODES = 300
RATE, SETTLED = "success_rate", "settled_m"
EIGHT: Any = {"figure": "lemniscate", "time_limit": 30.0}
EIGHT_GAINS = Gains(1.7125, 1.7125, 1.0, 0.51852, 6.88, 0.66735)
SEAS = {2: (0.1, 0.5), 3: (0.5, 1.25), 4: (1.25, 2.5), 5: (2.5, 4.0)}
"""Significant wave heights of the sea states [m], WMO code table 3700."""
FLOWN: dict[str, tuple[str, str, Any, Gains | None]] = {
    "recovery from 3 m": ("recovery", RATE, {}, Gains(1.4875, 1.4875, 1.0, 0.90741, 7.16, 0.34898)),
    "recovery from 1.5 m": ("recovery", RATE, {"lowest": 1.5, "highest": 1.5}, Gains()),
    "eight of 15 s": ("trajectory", SETTLED, EIGHT | {"period": 15.0}, EIGHT_GAINS),
    "eight of 5.5 s": ("trajectory", SETTLED, EIGHT | {"period": 5.5}, EIGHT_GAINS),
    "eight of 3.5 s": ("trajectory", SETTLED, EIGHT | {"period": 3.5}, EIGHT_GAINS),
    "zigzag": ("trajectory", SETTLED, {"figure": "zigzag"}, EIGHT_GAINS),
    "pentagram": ("trajectory", SETTLED, {"figure": "pentagram"}, EIGHT_GAINS),
    "polynomial": ("trajectory", SETTLED, {"figure": "polynomial"}, EIGHT_GAINS),
    "vertical figure": ("trajectory", SETTLED, {"figure": "vertical"}, EIGHT_GAINS),
    **{
        f"perching at {incline:.0f} degrees": (
            "perching",
            RATE,
            dict.fromkeys(("least_incline", "most_incline"), math.radians(incline)),
            None,
        )
        for incline in (0, 30, 60, 90)
    },
    **{
        f"deck in sea state {state}": (
            "deck_landing",
            RATE,
            {"lowest_waves": lowest, "highest_waves": highest},
            Gains(),
        )
        for state, (lowest, highest) in SEAS.items()
    },
}
"""Condition: its task, what counts, its options, and the best of sixteen gains of the controller,
chosen in 100 flights apart; None where it cannot do what is asked."""
FIGURES = {
    RATE: "successful",
    "survival_rate": "in the air to the end",
    "distance_m": "distance, from rest",
    SETTLED: "distance, settled",
    "touchdown_speed_median_m_s": "touchdown, median",
    "touchdown_speed_max_m_s": "hardest",
    "touchdown_tilt_median_deg": "tilt",
    "miss_median_m": "off the pad's middle",
    "landing_time_mean_s": "after",
    "yaw_rate_rad_s": "turning",
}


def missions(runs: Annotated[tuple[Path, ...], tyro.conf.Positional]) -> None:
    """Fly the policies of finished missions.

    Args:
        runs: Run folders; a task has the rows of all of its runs, or of the policy that ships.
    """
    rows: list[Result] = []
    own = {run: TrainConfig.of_folder(run) for run in runs}
    for name, (task, metric, options, gains) in FLOWN.items():
        flyers: dict[str, Any] = {
            f"seed {config.seed}": Policy.load(run)
            for run, config in own.items()
            if config.task == task
        } or {"policy that ships": Policy.pretrained(task)}
        (first, *_) = flyers.values()
        scenario = scenario_of(first, task_options=options, engine="free_flight")
        if gains is not None:
            flyers["controller"] = GeometricController(scenario.aircraft, scenario.task, gains)
        for who, flyer in flyers.items():
            found = summarize(fly(flyer, scenario, episodes=EPISODES, seed=FRESH))
            row = {"condition": name, "task": task, "metric": metric, "who": who}
            rows.append(row | {figure: found.get(figure) for figure in FIGURES})
            say(rows[-1])
    report.save("missions", {"episodes": EPISODES, "rows": rows})


def missions_table(task: str) -> str:
    """Every policy of a task, and the controller, condition by condition."""
    result = report.load("missions")
    own = [row for row in result["rows"] if row["task"] == task]
    told = {name: text for name, text in FIGURES.items() if any(row.get(name) for row in own)}
    rows = [(row["condition"], row["who"], *(shown(n, row.get(n)) for n in told)) for row in own]
    head = ("flown", "by", *told.values())
    return f"{table(head, rows)}\n\n{result['episodes']} flights a row. {report.source(result)}"


def shown(name: str, value: float | None) -> str:
    """A figure; none where no flight got so far."""
    return "none" if value is None else quantity(name, value)


PARTS: Parts = {
    f"missions-{task}": functools.partial(missions_table, task)
    for task in ("trajectory", "perching", "deck_landing")
}
