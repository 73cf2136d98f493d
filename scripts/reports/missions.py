"""Fly finished missions many times, seed by seed, beside the tuned geometric controller."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro
from matplotlib.figure import Figure

from quadrl import tasks
from quadrl.base.units import quantity
from quadrl.control import Gains, GeometricController
from quadrl.evaluation.plotting import BLUE, GREY, ORANGE, save, styled, tidy
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly, scenario_of, summarize
from quadrl.learning.config import TrainConfig
from scripts.reports import report
from scripts.reports.pitch_up import PitchUp, Way
from scripts.reports.report import Parts, Result, say, table
from scripts.reports.robustness import FRESH

EPISODES = 300
RATE, SETTLED = "success_rate", "settled_m"
EIGHT: Any = {"figure": "lemniscate", "time_limit": 30.0}
SEAS = {2: (0.1, 0.5), 3: (0.5, 1.25), 4: (1.25, 2.5), 5: (2.5, 4.0)}
"""Significant wave heights of the sea states [m], WMO code table 3700."""
EIGHT_GAINS = Gains(1.7125, 1.7125, 1.0, 0.51852, 6.88, 0.66735)
DECK_GAINS = Gains(2.0125, 2.0125, 1.0, 0.73333, 4.08, 0.21224)
NOISY_DECK_GAINS = Gains(1.45, 1.45, 1.0, 0.6, 2.4, 0.28571)
WAYS = {
    0: (1.53, Way(0.57, 1.13, 0.53, 0.02, 0.09, 2.29)),
    30: (1.77, Way(0.75, 1.0, 0.6, 0.22, 0.02, 2.51)),
    60: (1.56, Way(0.72, 0.89, 0.46, 0.13, 0.09, 2.35)),
    90: (1.51, Way(0.71, 0.98, 0.34, 0.17, 0.19, 2.12)),
}
"""The same for perching, with the plan, by the incline of the surface [degrees]."""


@dataclasses.dataclass(frozen=True)
class Mission:
    """A condition that policies are flown in."""

    task: str
    metric: str
    options: Mapping[str, Any]
    gains: Gains
    """The best of sixteen of the controller, chosen in 100 flights apart."""
    randomization: Mapping[str, Any] = dataclasses.field(default_factory=dict[str, Any])
    """What of the aircraft is drawn, and the noise of the state estimate."""
    way: Way | None = None
    """The plan that the controller flies along, chosen with the gains; None where the task says
    where to be."""


SEEN = {"noise": {"position": 0.02, "attitude": 0.005, "velocity": 0.05, "body_rate": 0.01}}
"""Standard deviations [m], [rad], [m/s], [rad/s] with which a deck is seen from an aircraft."""
LSY = "level 2"
PUBLISHED = {"first": (1.0, 3.419), "second": (0.5, 4.652), "third": (0.55, 4.896)}
"""Of that level, in the competition's simulator: share of 20 flights, mean time of those [s]."""
PUSHED = {"pushes": {"rate": 500.0, "velocity": 0.0171}}
"""What ten forces of up to 0.1 N along each axis for 0.002 s do to the brushless Crazyflie, on
average: at each control step."""
WEIGHED = {"mass": (0.865, 1.135), "inertia": (0.96, 1.04), **PUSHED}
"""5 g and 1e-6 kg m^2 of it, up and down: of levels 1 and 2."""
FLOWN: dict[str, Mission] = {
    "recovery from 3 m": Mission(
        "recovery", RATE, {}, Gains(1.4875, 1.4875, 1.0, 0.90741, 7.16, 0.34898)
    ),
    "recovery from 1.5 m": Mission("recovery", RATE, {"lowest": 1.5, "highest": 1.5}, Gains()),
    **{
        f"eight of {period:g} s": Mission(
            "trajectory", SETTLED, EIGHT | {"period": period}, EIGHT_GAINS
        )
        for period in (15.0, 5.5, 3.5)
    },
    **{
        name: Mission("trajectory", SETTLED, {"figure": figure}, EIGHT_GAINS)
        for name, figure in {
            **{same: same for same in ("zigzag", "pentagram", "polynomial")},
            "vertical figure": "vertical",
        }.items()
    },
    **{
        f"perching at {incline} degrees": Mission(
            "perching",
            RATE,
            dict.fromkeys(("least_incline", "most_incline"), math.radians(incline)),
            Gains(level, level, max_speed=4.0, max_tilt=0.5),
            way=way,
        )
        for incline, (level, way) in WAYS.items()
    },
    **{
        f"sea state {state}{told}": Mission(
            "deck_landing", RATE, {"lowest_waves": low, "highest_waves": high}, gains, drawn
        )
        for told, gains, drawn in (
            ("", DECK_GAINS, {}),
            (", seen with noise", NOISY_DECK_GAINS, SEEN),
        )
        for state, (low, high) in SEAS.items()
    },
    **{
        f"level {level}": Mission("lsy_race", RATE, {"level": level}, Gains(), drawn)
        for level, drawn in enumerate((PUSHED, WEIGHED, WEIGHED))
    },
}
"""Every condition by its name."""
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
    "race_time_mean_s": "time, mean",
    "race_time_best_s": "time, best",
    "gates_passed_mean": "gates passed, mean",
    "yaw_rate_rad_s": "turning",
}


def missions(runs: Annotated[tuple[Path, ...], tyro.conf.Positional]) -> None:
    """Fly the policies of finished missions.

    Args:
        runs: Run folders: what their tasks ask is flown, beside what was measured of the others;
            without any, all is flown by the policies that ship.
    """
    rows: list[Result] = []
    own = {run: TrainConfig.of_folder(run) for run in runs}
    wanted = {config.task for config in own.values()}
    for name, mission in FLOWN.items():
        if own and mission.task not in wanted:
            continue
        flyers: dict[str, Any] = {
            f"seed {config.seed}": Policy.load(run)
            for run, config in own.items()
            if config.task == mission.task
        } or {"policy that ships": Policy.pretrained(mission.task)}
        (first, *_) = flyers.values()
        given: Any = {"task_options": mission.options, "randomization": mission.randomization}
        scenario = scenario_of(first, **given, engine="free_flight")
        own_gains: Any = scenario.aircraft, scenario.task, mission.gains
        flyers["controller"] = (
            PitchUp(*own_gains, mission.way) if mission.way else GeometricController(*own_gains)
        )
        for who, flyer in flyers.items():
            found = summarize(fly(flyer, scenario, episodes=EPISODES, seed=FRESH))
            row = {"condition": name, "task": mission.task, "metric": mission.metric, "who": who}
            rows.append(row | {figure: found.get(figure) for figure in FIGURES})
            say(rows[-1])
    beside = report.beside("missions", {"rows": rows}, wanted)
    report.save("missions", {"episodes": EPISODES} | beside)
    raced = [r for r in beside["rows"] if r["condition"] == LSY and r["who"] != "controller"]
    save(lsy_picture(raced), report.IMAGES / "lsy_race.png")


@styled
def lsy_picture(raced: Iterable[Result]) -> Figure:
    """Time from rest to the last gate, and the share of the flights that reach it."""
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axis: Any = figure.subplots()
    for k, (label, (success, time)) in enumerate(PUBLISHED.items()):
        axis.plot(time, 100 * success, "s", color=GREY)
        # The first to the left, since quadrl's are on its right; then above and below in turn.
        place, side = ((6, (-9, 5)[k % 2]), "left") if k else ((-6, -9), "right")
        how = {"textcoords": "offset points", "ha": side, "size": 7}
        axis.annotate(label, (time, 100 * success), place, **how)
    for row in raced:
        axis.plot(row["race_time_mean_s"], 100 * row[RATE], "o", color=BLUE)
    success, time = (target.limit for target in tasks.TASKS["lsy_race"].targets)
    axis.axvline(time, color=ORANGE, lw=0.8)
    axis.axhline(100 * success, color=ORANGE, lw=0.8)
    title = "LSY's course, level 2: quadrl (circles), the final of summer 2026 (squares)"
    axis.set(xlabel="time [s]", ylabel="successful [%]", title=title)
    axis.set(xlim=(2.82, 5.8), ylim=(40, 104))
    tidy(axis)
    return figure


def missions_table(task: str) -> str:
    """Every policy of a task, and the controller, condition by condition."""
    result = report.load("missions")
    own = [row for row in result["rows"] if row["task"] == task]
    told = {name: text for name, text in FIGURES.items() if any(row.get(name) for row in own)}
    rows = [(row["condition"], row["who"], *(shown(n, row.get(n)) for n in told)) for row in own]
    head = ("flown", "by", *told.values())
    return (
        f"{table(head, rows)}\n\n{result['episodes']} flights a row. {report.source(result, own)}"
    )


def shown(name: str, value: float | None) -> str:
    """A figure; none where no flight got so far."""
    if value is not None and name.startswith("race_time"):
        return f"{value:.2f} s"  # hundredths of a second decide races
    return "none" if value is None else quantity(name, value)


PARTS: Parts = {
    f"missions-{task}": functools.partial(missions_table, task)
    for task in ("trajectory", "perching", "deck_landing", "lsy_race")
}
