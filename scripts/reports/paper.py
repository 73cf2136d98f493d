"""The paper's experiments: trains three tasks with three algorithms, draws figures 3 to 7.

It takes an hour on two cores. Interrupted at any moment, it continues at the next start.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from quadrl.control import make as make_controller
from quadrl.learning.config import TrainConfig
from quadrl.learning.figures import COLOURS, STYLE, learning_curves, read_metrics, save, trajectory
from quadrl.learning.folder import METRICS
from quadrl.policy import Policy
from quadrl.rollout import fly, summarize
from quadrl.studies.crew import train_here
from quadrl.studies.plan import PlannedRun
from quadrl.weather import WEATHERS
from scripts.reports import evaluation, report
from scripts.reports.claims import judged
from scripts.reports.report import Result, factor, say, spread, table
from scripts.reports.trial import LABELS, LEVEL, SOLVED, WAYS, Trial, column, trials

TASKS = ("hover", "static_waypoint", "landing")
WINDY = tuple(name for name, weather in WEATHERS.items() if not weather.calm)
Line = tuple[Sequence[float], np.ndarray]
"""Where (n,), and values (seeds, n)."""


def main(
    jobs: int = 2,
    seeds: int = 5,
    episodes: int = 100,
    steps: int | None = None,
    name: str = "paper",
) -> None:
    """Train what is missing, measure, draw.

    Args:
        jobs: Trainings at the same time.
        seeds: Trainings of each task and algorithm.
        episodes: Episodes of each evaluation.
        steps: Control steps of each training; by default the task's own.
        name: Name of the result and of the folder of the runs.
    """
    began = time.perf_counter()
    # The paper's network; quadrl's own default for two of the tasks holds the goal.
    settings = {"steps": steps, "num_threads": 1 if jobs > 1 else 0, "holds_goal": False}
    runs = [
        PlannedRun(
            TrainConfig(task, algo=algo, seed=seed, **settings),
            report.RUNS / name / f"{task}-{algo}-{seed}",
        )
        for seed in range(seeds)  # seed by seed: one that is stopped has whole seeds
        for task in TASKS
        for algo in LABELS
    ]
    train_here(runs, jobs, episodes, say)
    result: Result = {"command": f"scripts/report paper --jobs {jobs}", "episodes": episodes}
    result["weathers"] = WINDY
    result["geometric"] = {task: yardstick(task, episodes) for task in TASKS}
    result["runs"] = []
    for run in runs:
        result["runs"].append(evaluation.measure(run, episodes=episodes, weathers=WINDY))
        say(f"{run.folder.name}: measured")
    draw(runs, report.rounded(result), report.IMAGES / name)
    report.save(name, result | {"wall_clock_s": time.perf_counter() - began})


def yardstick(task: str, episodes: int) -> Result:
    """The geometric controller, in calm air and in wind."""
    controller = make_controller("geometric", task)
    rollout = fly(controller, task, episodes=episodes)
    windy = [{"mean": evaluation.blown(controller, task, episodes, name)} for name in WINDY]
    mean = summarize(rollout) | {"smoothness": evaluation.smoothness(rollout)}
    return {"mean": mean, "windy": windy}


def draw(runs: list[PlannedRun], result: Result, folder: Path) -> None:
    """Figures 3 to 7 of the paper, and two of our own."""
    groups: dict[tuple[str, str], list[PlannedRun]] = {}
    for run in runs:
        groups.setdefault((run.config.task, run.config.algo), []).append(run)
    for number, task in enumerate(TASKS, 3):
        metrics = {a: [read_metrics(r.folder / METRICS) for r in groups[task, a]] for a in LABELS}
        learning_curves(metrics, task, folder / f"figure_{number}_{task}.png", clocks=("steps",))
    for number, task, algo in ((6, "static_waypoint", "ppo"), (7, "landing", "trpo")):
        rollout = fly(Policy.load(groups[task, algo][0].folder), task, episodes=8)
        title = f"{task}, {LABELS[algo]}, first seed: 8 flights, mean action"
        trajectory(rollout, title, folder / f"figure_{number}_{task}_{algo}.png")
    both = trials(result)
    axes = ("frequency [Hz]", "power of the body rate [rad²/s²/Hz]")
    lines({t.task: spectra(t) for t in both}, axes, folder / "smoothness.png", logarithmic=True)
    axes, levels = ("wind", "successful [share]"), ("calm", *result["weathers"])
    lines({t.task: wind_lines(t) for t in both}, axes, folder / "wind.png", ticks=levels)


def spectra(trial: Trial) -> dict[str, Line]:
    """Spectra of the body rate in successful flights; the mean power is not shown."""
    panel = {}
    for name, way, runs in by_way(trial)[:-1]:
        curves = [run[way]["smoothness"] for run in runs]
        values = np.array([curve["body_rate_spectrum"][1:] for curve in curves], dtype=float)
        panel[name] = curves[0]["frequency_hz"][1:], values
    return panel


def wind_lines(trial: Trial) -> dict[str, Line]:
    """Success in calm air and in one weather after the other."""
    panel = {}
    for name, way, runs in by_way(trial):
        shares = np.array(blown(runs, way)).T
        panel[name] = range(shares.shape[1]), shares
    return panel


def blown(runs: Sequence[Result], way: str, figure: str = "success_rate") -> list[list[float]]:
    """A figure of the runs in calm air and in each weather."""
    calm = [run[way][figure] for run in runs]
    windy = zip(*([air[way][figure] for air in run["windy"]] for run in runs), strict=True)
    return [calm, *map(list, windy)]


def by_way(trial: Trial) -> list[tuple[str, str, list[Result]]]:
    """Name, way and runs of everyone who flew; the geometric controller is the last."""
    rows = [(f"{LABELS[a]}, {way}", way, runs) for a, runs in trial.runs.items() for way in WAYS]
    return [*rows, ("geometric controller", "mean", [trial.geometric])]


def lines(
    panels: dict[str, dict[str, Line]],
    axes: tuple[str, str],
    path: Path,
    logarithmic: bool = False,
    ticks: Sequence[str] = (),
) -> None:
    """Figures over something, a panel each, with the range of the seeds; dashed if sampled."""
    figure = Figure(figsize=(3.6 * len(panels), 3.3), layout="constrained")
    colours = {LABELS[algo]: STYLE[name] for algo, name in COLOURS.items() if algo in LABELS}
    drawn = {}
    for axis, (task, panel) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        for label, (x, values) in panel.items():
            known = values[np.isfinite(values).all(axis=1)]
            if len(known):
                low, median, high = np.quantile(known, (0.0, 0.5, 1.0), axis=0)
                colour = colours.get(label.partition(",")[0], STYLE["grey"])
                axis.fill_between(x, low, high, color=colour, alpha=0.12, lw=0)
                dashes = "--" if label.endswith("sampled") else "-"
                drawn[label] = axis.plot(x, median, dashes, color=colour, lw=1.6)[0]
        axis.set(title=task, xlabel=axes[0], yscale="log" if logarithmic else "linear")
        if ticks:
            axis.set_xticks(range(len(ticks)), ticks)
        axis.grid(alpha=0.25)
    figure.supylabel(axes[1], fontsize=10)
    figure.legend(drawn.values(), drawn, loc="outside lower center", ncols=4, frameon=False)
    save(figure, path)


def made() -> str:
    """How it was made."""
    result = report.load("paper")
    seeds = sorted({run["seed"] for run in result["runs"]})
    training = sum(run["training_s"] for run in result["runs"]) / 60
    return (
        f"Made by `{result['command']}`: {len(result['runs'])} trainings, seeds {seeds[0]} to "
        f"{seeds[-1]}, {training:.0f} minutes of training, {result['wall_clock_s'] / 60:.0f} "
        "minutes of wall clock in all. The trainings flew in free flight. Every policy then flew "
        f"the same {result['episodes']} fresh episodes in MuJoCo. Figures are medians over the "
        "seeds, with the lowest and the highest in brackets. A seed is solved when at least "
        f"{100 * SOLVED:g} % of the episodes succeed with the mean action.  \n"
        f"{report.source(result)}"
    )


def well() -> str:
    """How well each flies."""
    rows = []
    for trial in trials(report.load("paper")):
        target = trial.precision
        for algo in (*LABELS, ""):
            runs = trial.runs[algo] if algo else [trial.geometric]
            solved = f"{trial.solved(algo)} of {len(runs)}" if algo else ""
            row = [trial.task, LABELS.get(algo, "geometric controller"), solved]
            row += [spread(column(runs, f"{way}.success_rate"), "%", 100) for way in WAYS]
            figures = [column(runs, f"{way}.{target.metric}") for way in WAYS]
            row += [spread(x, target.unit, factor(target), 2) for x in figures]
            row.append(spread(column(runs, "mean.return_mean"), digits=4))
            row.append(spread(trial.lost(algo), "%", 100, 2) if algo else "")
            rows.append(row)
    head = ["task", "policy", "seeds solved", "successful, mean action", "successful, sampled"]
    head += ["precision, mean action", "precision, sampled", "return, mean action"]
    return table([*head, "lost from best to final"], rows)


def smooth() -> str:
    """How smoothly each flies."""
    rows = []
    for trial in trials(report.load("paper")):
        for who, way, runs in by_way(trial):
            path = f"{way}.smoothness."
            figures = (
                spread(column(runs, path + figure), digits=2) for figure in evaluation.ROUGHNESS
            )
            wobble = spread(column(runs, path + "wobble_share"), "%", 100, 2)
            rows.append((trial.task, who, *figures, wobble))
    head = ["task", "policy", "actions [1/s]", "body rate [rad/s]", "its change [rad/s²]"]
    return table([*head, "jerk [m/s³]", "share over 2 Hz"], rows)


def sturdy() -> str:
    """How well each flies in wind."""
    rows, result = [], report.load("paper")
    for trial in trials(result):
        for name, way, runs in by_way(trial):
            shares = (spread(x, "%", 100) for x in blown(runs, way))
            errors = (spread(x, "cm", 100, 2) for x in blown(runs, way, "position_error_m")[1:3])
            rows.append((trial.task, name, *shares, *errors))
    levels = result["weathers"]
    errors = (f"error, {level}" for level in levels[:2])
    return table(("task", "policy", "calm", *levels, *errors), rows)


def claims() -> str:
    """Section 5, sentence by sentence."""
    return (
        "Each task says yes, no (the contrary) or neither, by the rule in the row. The measurement "
        "agrees when more than half of the tasks say yes, disagrees when more than half say no, "
        'and is mixed when both occur; otherwise the sentence is not shown. "Clearly" means a '
        f"one-sided test at the level {LEVEL:g}: Mann and Whitney's between two algorithms, the "
        "sign test seed by seed, the F test of two spreads, Fisher's test of solved seeds. With "
        f"five seeds only large differences pass.\n\n{judged(report.load('paper'))}"
    )


PARTS: report.Parts = {
    "paper-made": made,
    "paper-well": well,
    "paper-smooth": smooth,
    "paper-sturdy": sturdy,
    "paper-claims": claims,
}

if __name__ == "__main__":
    tyro.cli(main)
