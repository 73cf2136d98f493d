"""Fly finished races many times: how fast, how surely, beside what others have published."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from quadrl.base.units import quantity
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.plotting import BLUE, GREY, ORANGE, save, styled, tidy
from quadrl.learning.config import TrainConfig
from scripts.reports import report
from scripts.reports.report import Parts, Result, say, table

EPISODES, IN_TIME, ENOUGH = 300, 6.0, 0.95  # flights of a row; [s] from rest, and share, asked for
RACES = {"one lap": {}, "three laps": {"laps": 3}, "one lap, margin 0.15 m": {"margin": 0.15}}
FIGURES = {
    "success_rate": "successful",
    "in_time_rate": f"within {IN_TIME:g} s",
    "race_time_mean_s": "time, mean",
    "race_time_best_s": "time, best",
    "flying_lap_mean_s": "lap in flight, mean",
}
# Song et al. 2023, Science Robotics 8, on split_s; commands are late there, and are not here.
PUBLISHED = {
    "reinforcement learning, nominal simulation": (1.0, 5.14),
    "reinforcement learning, realistic simulation": (1.0, 5.26),
    "reinforcement learning, flown": (0.85, 5.35),
    "time-optimal tracking, simulation": (0.44, 4.92),
    "contouring control, simulation": (0.76, 5.03),
}


def race(runs: Annotated[tuple[Path, ...], tyro.conf.Positional]) -> None:
    """Fly the policies of finished races, and the geometric controller.

    Args:
        runs: Run folders.
    """
    flyers: dict[str, Any] = {f"seed {TrainConfig.of_folder(run).seed}": run for run in runs}
    flyers["geometric controller"] = make_controller("geometric", "race", "racer")
    rows: list[Result] = []
    for name, flyer in flyers.items():
        given: Any = {} if isinstance(flyer, Path) else {"task": "race", "vehicle": "racer"}
        for kind, options in RACES.items():
            found = evaluate(flyer, episodes=EPISODES, task_options=options, **given)
            time = np.nanmax(found.rollout.remembered["time"], 0)
            within = (found.rollout.is_success & (time < IN_TIME)).mean()
            metrics = found.metrics | {"in_time_rate": float(within)}
            rows.append({"who": name, "race": kind} | {k: metrics.get(k) for k in FIGURES})
            say(rows[-1])
    report.save("race", {"episodes": EPISODES, "rows": rows})
    title = "One lap of split_s: quadrl (circles), Song et al. 2023 (squares)"
    own = [row for row in rows if row["race"] == "one lap"]
    save(picture(title, own, PUBLISHED, IN_TIME, ENOUGH), report.IMAGES / "race.png")


@styled
def picture(
    title: str,
    rows: Iterable[Result],
    published: Mapping[str, tuple[float, float]],
    in_time: float,
    enough: float,
) -> Figure:
    """Time from rest to the last gate, and the share of the flights that reach it.

    Args:
        title: What is flown, and by whom.
        rows: What policies of quadrl reached.
        published: Share and time [s] of others, by their name.
        in_time: What is asked for [s].
        enough: The share of the flights that is asked for.
    """
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axis: Any = figure.subplots()
    for k, (label, (success, time)) in enumerate(published.items()):
        axis.plot(time, 100 * success, "s", color=GREY)
        # The first to the left, since quadrl's are on its right; then above and below in turn.
        place, side = ((6, (-9, 5)[k % 2]), "left") if k else ((-6, -9), "right")
        how = {"textcoords": "offset points", "ha": side, "size": 7}
        axis.annotate(label, (time, 100 * success), place, **how)
    for row in rows:
        axis.plot(row["race_time_mean_s"], 100 * row["success_rate"], "o", color=BLUE)
    axis.axvline(in_time, color=ORANGE, lw=0.8)
    axis.axhline(100 * enough, color=ORANGE, lw=0.8)
    times = [in_time, *(time for _, time in published.values())]
    axis.set(xlabel="time [s]", ylabel="successful [%]", title=title)
    axis.set(xlim=(min(times) - 0.6, max(times) + 0.3), ylim=(40, 104))
    tidy(axis)
    return figure


def race_table() -> str:
    """Every policy, the controller and what is published."""
    result = report.load("race")
    rows = [
        (row["who"], row["race"], *(shown(name, row[name]) for name in FIGURES))
        for row in result["rows"]
    ]
    for who, (success, time) in PUBLISHED.items():
        figures = quantity("success_rate", success), "", shown("race_time_mean_s", time)
        rows.append((f"Song et al. 2023: {who}", "one lap", *figures, "", ""))
    head = ("who", "race", *FIGURES.values())
    return f"{table(head, rows)}\n\n{result['episodes']} flights a row. {report.source(result)}"


def shown(name: str, value: float | None) -> str:
    """A figure; hundredths of a second decide races."""
    if value is None:
        return ""
    return f"{value:.2f} s" if name.endswith("_s") else quantity(name, value)


PARTS: Parts = {"race": race_table}
