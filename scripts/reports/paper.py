"""The paper's experiments: trains three tasks with three algorithms, draws figures 3 to 7.

`scripts/report search` chooses the settings, `scripts/report tuning` the gains of the controller,
and `scripts/report noise` asks what training with noise is worth in wind. Interrupted at any
moment, it continues at the next start.
"""

from __future__ import annotations

import concurrent.futures
import functools
import math
import multiprocessing
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure
from PIL import Image

from quadrl.conditions.weather import WEATHERS
from quadrl.evaluation.card import wilson
from quadrl.evaluation.plotting import ALGORITHM_COLOURS, GREY, learning_curves, save, trajectory
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly, summarize
from quadrl.learning.folder import METRICS, read_metrics
from quadrl.learning.studies.crew import train_here
from quadrl.learning.studies.plan import PlannedRun
from scripts.reports import evaluation, report
from scripts.reports.claims import CLAIMS, judged
from scripts.reports.report import Result, factor, number, say, spread, table
from scripts.reports.search import LABELS, SOLVED, TASKS, planned
from scripts.reports.significance import (
    EFFECTS,
    LEVEL,
    improvement,
    improvement_interval,
    level_of,
    middle,
    middle_interval,
    mostly,
    power,
)
from scripts.reports.trial import WAYS, Trial, column, trials
from scripts.reports.tuning import tuned

SEEDS = tuple(range(285, 295))  # not used for tuning
WINDY = tuple(name for name, weather in WEATHERS.items() if not weather.calm)
PAIRS = (("ppo", "vpg"), ("trpo", "vpg"), ("trpo", "ppo"))
Line = tuple[Sequence[float], np.ndarray]
"""Where (n,), and values (seeds, n)."""


def main(
    jobs: int = 2,
    names: tuple[str, ...] = tuple(TASKS),
    seeds: tuple[int, ...] = SEEDS,
    episodes: int = 100,
    steps: int | None = None,
) -> None:
    """Train what is missing, measure, draw.

    Args:
        jobs: Trainings at the same time.
        names: The tasks.
        seeds: Of the trainings of each task and algorithm.
        episodes: Episodes of each evaluation.
        steps: Control steps of each training; by default those of the search.
    """
    runs = plan(names, seeds, {} if steps is None else {"steps": steps})
    train_here(runs, jobs, episodes, say)
    result: Result = {"command": f"scripts/report paper --jobs {jobs}", "episodes": episodes}
    result["weathers"] = WINDY
    result["geometric"] = {task: yardstick(task, episodes) for task in names}
    measured = functools.partial(evaluation.measure, episodes=episodes, weathers=WINDY)
    with concurrent.futures.ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        result["runs"] = list(pool.map(measured, runs))
    level = level_of(len(CLAIMS), len(names))
    result["power"] = {
        test.__name__: power(test, len(seeds) * (len(LABELS) if test is mostly else 1), level)
        for test in EFFECTS
    }
    draw(runs, report.rounded(result), report.IMAGES / "paper")
    report.save("paper", result)


def plan(names: Sequence[str], seeds: Sequence[int], given: dict[str, int]) -> list[PlannedRun]:
    """The trainings, seed by seed: an experiment that is stopped has whole seeds."""
    chosen = report.load("search")["tasks"]
    return [
        planned("paper", task, algo, seed, chosen[task][algo]["settings"] | given)
        for seed in seeds
        for task in names
        for algo in LABELS
    ]


def yardstick(task: str, episodes: int) -> Result:
    """The geometric controller, in calm air and in wind, with the gains tuned for each."""
    rollout = evaluation.flown(tuned(task, "nothing"), task, episodes)
    windy = [
        {"mean": evaluation.blown(tuned(task, f"weather {w}"), task, episodes, w)} for w in WINDY
    ]
    mean = summarize(rollout) | {"smoothness": evaluation.smoothness(rollout)}
    return {"mean": mean, "windy": windy}


def draw(runs: list[PlannedRun], result: Result, folder: Path) -> None:
    """Figures 3 to 7 of the paper, and two of our own."""
    groups: dict[tuple[str, str], list[PlannedRun]] = {}
    for run in runs:
        groups.setdefault((run.config.task, run.config.algo), []).append(run)
    for figure, task in enumerate(TASKS, 3):
        if runs_of := {a: groups[task, a] for a in LABELS if (task, a) in groups}:
            metrics = {
                LABELS[a].lower(): [read_metrics(run.folder / METRICS) for run in each]
                for a, each in runs_of.items()
            }
            path = folder / f"figure_{figure}_{task}.png"
            save(learning_curves(metrics, task, clocks=("steps",)), path)
    for figure, task, algo in ((6, "static_waypoint", "ppo"), (7, "landing", "trpo")):
        if (task, algo) in groups:
            rollout = fly(Policy.load(groups[task, algo][0].folder), task, episodes=8)
            title = f"{task}, {LABELS[algo]}, first seed: 8 flights, mean action"
            path = folder / f"figure_{figure}_{task}_{algo}.png"
            save(trajectory(rollout, title), path)
            Image.open(path).convert("RGB").quantize(256).save(path, optimize=True)
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
    colours = {label: ALGORITHM_COLOURS[algo] for algo, label in LABELS.items()}
    drawn = {}
    axes_of = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, (task, panel) in zip(axes_of, panels.items(), strict=True):
        for label, (x, values) in panel.items():
            known = values[np.isfinite(values).all(axis=1)]
            if len(known):
                low, median, high = np.quantile(known, (0.0, 0.5, 1.0), axis=0)
                colour = colours.get(label.partition(",")[0], GREY)
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
        f"Made by `{result['command']}`: {len(result['runs'])} trainings, test seeds {seeds[0]} to "
        f"{seeds[-1]}, {training:.0f} minutes of training, a process each. The trainings flew in "
        f"free flight. Every policy then flew the same {result['episodes']} fresh episodes. A seed "
        f"is solved when at least {100 * SOLVED:g} % of the episodes succeed with the mean "
        f"action.  \n{report.source(result)}"
    )


def well() -> str:
    """How well each flies."""
    rows = []
    for trial in trials(report.load("paper")):
        target = trial.precision
        for algo in (*LABELS, ""):
            runs = trial.runs[algo] if algo else [trial.geometric]
            row = [f"`{trial.task}`", LABELS.get(algo, "geometric controller")]
            if algo:
                count, seeds = sum(trial.solved(algo)), len(runs)
                low, high = wilson(count, seeds)
                row.append(f"{count} of {seeds} ({100 * low:.0f} to {100 * high:.0f} %)")
            else:
                row.append("")
            row += [centre(column(runs, f"{way}.success_rate"), "%", 100) for way in WAYS]
            figures = (column(runs, f"{way}.{target.metric}") for way in WAYS)
            row += [centre(worst(x), target.unit, factor(target), 2) for x in figures]
            heading = column(runs, "mean.heading_error_deg")
            row.append(centre(worst(heading), "°", 1, 2))
            row.append(spread(trial.lost(algo), "points", 100, 2) if algo else "")
            rows.append(row)
    head = ["task", "policy", "seeds solved", "successful, mean action", "successful, sampled"]
    head += ["precision, mean action", "precision, sampled", "heading error, mean action"]
    return table([*head, "success lost from best to final"], rows)


def worst(values: Sequence[float]) -> list[float]:
    """What no flight of a seed has reached counts as infinitely imprecise."""
    return [math.inf if math.isnan(x) and len(values) > 1 else x for x in values]


def centre(values: Sequence[float], unit: str, factor: float, digits: int = 3) -> str:
    """The interquartile mean of the seeds, and its 95 % interval."""
    scaled = [factor * x for x in values]
    if len(scaled) == 1 or len({*scaled}) == 1:
        return spread(scaled, unit, digits=digits)
    between = (number(x, digits) for x in middle_interval(scaled))
    return f"{number(middle(scaled), digits)} ({' to '.join(between)}) {unit}".replace(" °", "°")


def better() -> str:
    """How often a seed of one algorithm is better than a seed of another."""
    rows = []
    for trial in trials(report.load("paper")):
        for one, other in PAIRS:
            row = [f"`{trial.task}`", f"{LABELS[one]} over {LABELS[other]}"]
            success = [trial.column(algo, "mean.success_rate") for algo in (one, other)]
            errors = [[-x for x in trial.errors(algo, "mean")] for algo in (one, other)]
            for pair in (success, errors):
                low, high = improvement_interval(*pair)
                row.append(f"{improvement(*pair):.2f} ({low:.2f} to {high:.2f})")
            rows.append(row)
    return table(("task", "compared", "success", "precision"), rows)


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
    result = report.load("paper")
    level = level_of(len(CLAIMS), len(result["geometric"]))
    return (
        "Each task says yes, no (the contrary) or neither, by the rule in the row. The measurement "
        "agrees when more than half of the tasks say yes, disagrees when more than half say no, "
        'and is mixed when both occur; otherwise the sentence is not shown. "Clearly" means a '
        f"one-sided test of a task at the level {level:.3f}, so that any of the {len(CLAIMS)} "
        f"sentences gets a false verdict with a chance of {100 * LEVEL:g} % at most (Bonferroni; "
        "the trainings of the tasks are independent).\n\n"
        f"{judged(result)}"
    )


def powers() -> str:
    """What each test would see."""
    result = report.load("paper")
    tests = {"solved_more": "Fisher: seeds solved", "smaller": "Mann and Whitney: which is smaller"}
    tests |= {"steadier": "Brown and Forsythe: spread", "mostly": "sign test, seed by seed"}
    rows = []
    for test, (_, words) in EFFECTS.items():
        rows.append((tests[test.__name__], words, f"{result['power'][test.__name__]:.2f}"))
    return table(("test", "difference", "power in one task"), rows)


PARTS: report.Parts = {
    "paper-made": made,
    "paper-well": well,
    "paper-better": better,
    "paper-smooth": smooth,
    "paper-sturdy": sturdy,
    "paper-claims": claims,
    "paper-powers": powers,
}

if __name__ == "__main__":
    tyro.cli(main)
