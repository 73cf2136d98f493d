"""Train every task and fly the policies: `training` and `speed`.

Run them on a machine that does nothing else. Interrupted at any moment, they continue at the next
start.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable
from pathlib import Path

from quadrl import VEHICLES, tasks
from quadrl.base.units import length, quantity
from quadrl.engines.engine import ENGINES
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.plotting import learning_curves, save
from quadrl.evaluation.rollout import BEHAVIOUR, summarize
from quadrl.learning import benchmark
from quadrl.learning.config import TrainConfig
from quadrl.learning.executor import Local, PlannedRun, complaint, train_all
from quadrl.learning.folder import EVALUATION, METRICS, read_metrics
from scripts.reports import report
from scripts.reports.report import FIGURES, Result, asked, say, table

# Seeds are not those that settings were chosen with.
HOVER_SEEDS, SEEDS = (225, 226, 227, 228, 229), (385, 386, 387)
EPISODES = 100  # of an evaluation
LONGEST = {"race": 3600, "lsy_race": 3600} | dict.fromkeys(
    ("recovery", "trajectory", "perching", "deck_landing"), 600
)
"""Seconds that a training may take; 300 of any other task."""


def trained(run: PlannedRun) -> Result:
    """What a finished run was: its settings, steps and seconds; and what it reached."""
    config = run.config
    known = {name: getattr(config, name) for name in ("task", "vehicle", "engine", "algo", "seed")}
    took = json.loads((run.folder / EVALUATION).read_text())["training_s"]
    steps = config.iterations * config.num_envs * config.rollout
    return known | {"steps": steps, "training_s": took, "metrics": flown(run.folder, config)}


def flown(flyer: str | Path, config: TrainConfig) -> Result:
    """What a controller, or the mean action of a run's policy, reaches where a training aims."""
    return summarize(evaluate(flyer, config.scenario, episodes=EPISODES).rollout)


def runs_of(configs: Iterable[TrainConfig], jobs: int) -> list[PlannedRun]:
    """The trainings in runs/training; those that are missing are made."""
    name = "{0.task}-{0.vehicle}-{0.engine}-{0.algo}-{0.seed}".format
    runs = [PlannedRun(config, report.RUNS / "training" / name(config)) for config in configs]
    if failed := train_all(runs, Local(EPISODES, jobs), say):
        raise SystemExit(complaint(failed))
    return runs


def training(jobs: int = 2, only: tuple[str, ...] = ()) -> None:
    """Train every task with its defaults, hover in both engines and on every aircraft; draw.

    Args:
        jobs: Trainings at the same time, of those whose wall clock is not compared.
        only: Names of tasks, beside what was measured of the others; by default all.
    """
    wanted = [task for task in tasks.TASKS if not only or task in only]
    hovers = "hover" in wanted
    both = itertools.product(ENGINES, HOVER_SEEDS if hovers else ())
    alone = [TrainConfig("hover", engine=engine, seed=seed) for engine, seed in both]
    kinds = [{"vehicle": name} for name in VEHICLES if hovers and name != "paper"]
    kinds += [{"task": task} for task in wanted if task != "hover"]
    each = itertools.product(kinds, SEEDS)
    together = [TrainConfig(**kind, seed=seed, num_threads=1) for kind, seed in each]
    runs = runs_of(alone, 1) + runs_of(together, jobs)
    yardstick: dict[tuple[str, str], Result] = {}
    for run in runs:
        task, vehicle = run.config.task, run.config.vehicle
        if (task, vehicle) not in yardstick:
            metrics = flown("geometric", run.config)
            yardstick[task, vehicle] = {"task": task, "vehicle": vehicle, "metrics": metrics}
    for name in wanted:
        task = tasks.TASKS[name]
        folders = f"{name}-{task.trained_on}-free_flight-{task.trained_by}-*"
        own = sorted((report.RUNS / "training").glob(folders))
        metrics = {task.trained_by: [read_metrics(folder / METRICS) for folder in own]}
        path = report.IMAGES / "curves" / f"{name}.png"
        save(learning_curves(metrics, name, clocks=("steps",)), path)
    rows = {"yardstick": [*yardstick.values()], "runs": [trained(run) for run in runs]}
    report.save("training", {"episodes": EPISODES} | report.beside("training", rows, only))


def speed() -> None:
    """Keep a benchmark for the pages: a hundred measurements of each layer."""
    report.save("speed", benchmark.benchmark("hover", repeats=100, seconds=0.2))


def hover_table() -> str:
    """Hover, in both engines and on every aircraft."""
    result = report.load("training")
    runs, own = ([x for x in result[k] if x["task"] == "hover"] for k in ("runs", "yardstick"))
    rows = []
    for run in runs:
        got = run["metrics"]
        row = [run["vehicle"], run["engine"], run["seed"], f"{run['steps']:,}"]
        row += [f"{run['training_s']:.1f} s"]
        row += [f"{100 * got[name]:.0f} %" for name in ("survival_rate", "success_rate")]
        row += [length(got["position_error_m"]), f"{got['heading_error_deg']:.1f} deg"]
        row += [quantity(name, got[name]) for name in BEHAVIOUR]
        rows.append(row)
    head = ("aircraft", "engine", "seed", "control steps", "training", "flown to the end",
            "successful", "error", "heading off east",
            *(FIGURES[name] for name in BEHAVIOUR))  # fmt: skip
    error = max(row["metrics"]["position_error_m"] for row in own)
    success = min(100 * row["metrics"]["success_rate"] for row in own)
    note = f"The geometric controller, in the same episodes and with every aircraft: {success:.0f} "
    note += f"% successful, largest error {length(error)}."
    return f"{table(head, rows)}\n\n{note}  \n{report.source(result, runs)}"


def suite_table() -> str:
    """Every task beside what counts as solved and the geometric controller."""
    rows = []
    for name in tasks.TASKS:
        own, seeds = reached(name)
        rows += [(f"`{name}`" if k == 0 else "", *row) for k, row in enumerate(own) if seeds]
    seeds = ("first seed", "second seed", "third seed")
    return table(("task", "figure", "asked", *seeds, "geometric controller"), rows)


def reached_table(name: str) -> str:
    """What a task asks beside what each seed reached."""
    rows, seeds = reached(name)
    controller = ["geometric controller"] if seeds else []
    return table(("figure", "asked", *(f"seed {seed}" for seed in seeds), *controller), rows)


def reached(name: str) -> tuple[list[tuple[str, ...]], list[int]]:
    """What a task asks and what each seed and the controller reached, and the seeds."""
    result, task = report.load("training"), tasks.TASKS[name]
    runs, known = (
        [row for row in result[part] if (row["task"], row["vehicle"]) == (name, task.trained_on)]
        for part in ("runs", "yardstick")
    )
    runs = [run for run in runs if run["engine"] == "free_flight"][: len(SEEDS)]
    rows = []
    for target in task.targets:
        cells = []
        for metrics in (each["metrics"] for each in (*runs, *known)):
            # Older trainings were not asked for all.
            value = metrics.get(target.metric, "not measured")
            cells.append(quantity(target.metric, value))
        rows.append((target.words, asked(target), *cells))
    seeds = [run["seed"] for run in runs]
    if runs:
        words = f"training, {runs[0]['steps']:,} steps, seeds {', '.join(map(str, seeds))}"
        took = (f"{run['training_s']:.0f} s" for run in runs)
        rows.append((words, f"at most {LONGEST.get(name, 300)} s", *took, ""))
    return rows, seeds


def speed_table() -> str:
    """Every layer."""
    result = report.load("speed")
    head, *rows = benchmark.rows(result)
    return f"{table(head, rows)}\n\n{report.source(result)}"


PARTS: report.Parts = {"training-hover": hover_table, "training-suite": suite_table,
                       "speed": speed_table}  # fmt: skip
