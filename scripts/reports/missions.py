"""Fly the LSY race level by level, beside the controller, and draw it beside the competition."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from matplotlib.figure import Figure

from quadrl import tasks
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.plotting import BLUE, GREY, ORANGE, save, styled, tidy
from quadrl.evaluation.policy import Policy
from quadrl.learning.config import TrainConfig
from scripts.reports import report
from scripts.reports.report import Result, Runs, say
from scripts.reports.robustness import FRESH

EPISODES, TASK, RATE = 300, "lsy_race", "success_rate"
PUBLISHED = {"first": (1.0, 3.419), "second": (0.5, 4.652), "third": (0.55, 4.896)}
"""Of level 2, in the competition's simulator: share of 20 flights, mean time of those [s]."""
FIGURES = (RATE, "survival_rate", "race_time_mean_s", "race_time_best_s", "gates_passed_mean",
           "yaw_rate_rad_s")  # fmt: skip


def missions(runs: Runs = ()) -> None:
    """Fly the policies of runs, or the one that ships, with the aircraft and pushes of the task."""
    usual = TrainConfig(TASK)
    drawn = usual.scenario.randomization.given()
    flyers: dict[str, Any] = {f"seed {TrainConfig.of_folder(x).seed}": Policy.load(x) for x in runs}
    flyers = flyers or {"policy that ships": Policy.pretrained(TASK)}
    rows: list[Result] = []
    for level in (0, 1, 2):
        kept = {"pushes": drawn["pushes"]} if level == 0 else drawn
        given: Any = {"task_options": {"level": level}, "randomization": kept}
        given |= {name: getattr(usual, name) for name in ("vehicle", "aerodynamics")}
        given["vehicle_options"] = usual.vehicle_options
        for who, flyer in (flyers | {"controller": "geometric"}).items():
            found = evaluate(
                flyer, TASK, engine="free_flight", episodes=EPISODES, seed=FRESH, **given
            )
            row = {"condition": f"level {level}", "task": TASK, "metric": RATE, "who": who}
            rows.append(row | {figure: found.metrics.get(figure) for figure in FIGURES})
            say(rows[-1])
    before = report.load("missions")
    columns = before["rows"][0]
    rows = [{name: row.get(name) for name in columns} | {"commit": report.commit()} for row in rows]
    kept = [row for row in before["rows"] if row["task"] != TASK]
    report.save("missions", before | {"rows": kept + rows})
    raced = [row for row in rows if row["condition"] == "level 2" and row["who"] != "controller"]
    save(picture(raced), report.IMAGES / "lsy_race.png")


@styled
def picture(raced: Iterable[Result]) -> Figure:
    """Time from rest to the last gate, and the share of the flights that reach it."""
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axis: Any = figure.subplots()
    for k, (label, (success, time)) in enumerate(PUBLISHED.items()):
        axis.plot(time, 100 * success, "s", color=GREY)
        place, side = ((6, (-9, 5)[k % 2]), "left") if k else ((-6, -9), "right")
        how = {"textcoords": "offset points", "ha": side, "size": 7}
        axis.annotate(label, (time, 100 * success), place, **how)
    for row in raced:
        axis.plot(row["race_time_mean_s"], 100 * row[RATE], "o", color=BLUE)
    success, time = (target.limit for target in tasks.TASKS[TASK].targets)
    axis.axvline(time, color=ORANGE, lw=0.8)
    axis.axhline(100 * success, color=ORANGE, lw=0.8)
    axis.set_title(
        "LSY's course, level 2, by the competition's collision box and on its aircraft:\n"
        "quadrl in its own simulator (circles), the final of summer 2026 (squares)"
    )
    axis.set(xlabel="time [s]", ylabel="successful [%]", xlim=(2.82, 5.8), ylim=(40, 104))
    tidy(axis)
    return figure
