"""Fly the policies of trainings, and measure the speed of each layer: `training` and `speed`."""

from __future__ import annotations

import json
import statistics
from functools import partial
from pathlib import Path

from quadrl import VEHICLES, tasks
from quadrl.base.units import length, quantity
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.plotting import save
from quadrl.evaluation.rollout import BEHAVIOUR, summarize
from quadrl.learning import benchmark
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import EVALUATION
from quadrl.learning.show import curves
from scripts.reports import report
from scripts.reports.report import FIGURES, Result, Runs, block, table

EPISODES = 100  # of an evaluation
LONGEST = {"race": 3600, "lsy_race": 3600} | dict.fromkeys(
    ("recovery", "trajectory", "perching", "deck_landing"), 600
)
"""Seconds that a training may take; 300 of any other task."""


def training(runs: Runs) -> None:
    """Fly the policies of trainings beside the geometric controller, and draw the trainings.

    docs/studies/training.sh makes those of the pages: `scripts/report training runs/training/*/*`.

    Args:
        runs: Run folders; what was measured of tasks that none of them has is kept.
    """
    configs = {run: TrainConfig.of_folder(run) for run in runs if (run / EVALUATION).is_file()}
    usual = [run for run, config in configs.items() if is_usual(config)]
    for task, figure in curves(usual, clocks=("steps",)).items():
        save(figure, report.IMAGES / "curves" / f"{task}.png")

    def rows(task: str) -> dict[str, list[Result]]:
        found, yardstick = list[Result](), dict[str, Result]()
        for run, config in configs.items():
            if config.task != task:
                continue
            whole = config.named()
            known = {name: whole[name] for name in ("vehicle", "engine", "algo", "seed")}
            took = json.loads((run / EVALUATION).read_text())["training_s"]
            known["steps"] = config.iterations * config.num_envs * config.rollout
            found.append(known | {"training_s": took, "metrics": flown(run, config)})
            if (vehicle := whole["vehicle"]) not in yardstick:
                metrics = flown("geometric", config)
                yardstick[vehicle] = {"vehicle": vehicle, "metrics": metrics}
        found.sort(key=lambda row: ([*VEHICLES].index(row["vehicle"]), row["engine"], row["seed"]))
        return {"yardstick": [*yardstick.values()], "runs": found}

    cases = {task: partial(rows, task) for task in tasks.TASKS}
    only = {config.task for config in configs.values()}
    report.gather("training", "task", cases, only, episodes=EPISODES)


def is_usual(config: TrainConfig) -> bool:
    """Whether a training flies freely on the aircraft that its task is trained on."""
    whole = config.named()
    own = tasks.TASKS[config.task].trained_on, "free_flight"
    return (whole["vehicle"], whole["engine"]) == own


def flown(flyer: str | Path, config: TrainConfig) -> Result:
    """What a controller, or the mean action of a run's policy, reaches where a training aims."""
    return summarize(evaluate(flyer, config.scenario, episodes=EPISODES).rollout)


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
    return f"{block(head, rows, note)}  \n{report.source(result, runs)}"


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
    runs = [run for run in runs if run["engine"] == "free_flight"][:3]  # of hover there are five
    rows = []
    for target in task.targets:  # older trainings were not asked for all
        values = (x["metrics"].get(target.metric, "not measured") for x in (*runs, *known))
        cells = (quantity(target.metric, value) for value in values)
        rows.append((target.words, target.asked, *cells))
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
    return block(head, rows, "", result)


def claim() -> str:
    """What hover takes and reaches, beside the command that shows it."""
    result = report.load("training")
    usual = {"task": "hover", "vehicle": "paper", "engine": "free_flight"}
    runs = [run for run in result["runs"] if usual.items() <= run.items()]
    took = [run["training_s"] for run in runs]
    error = [1000 * run["metrics"]["position_error_m"] for run in runs]
    solved = sum(run["metrics"]["success_rate"] == 1 for run in runs)
    cells = (
        "`quadrl train hover`",
        f"{statistics.median(took):.1f} s ({min(took):.1f} to {max(took):.1f} s)",
        f"100 % of {result['episodes']} fresh episodes with {solved} of {len(took)} seeds",
        f"{min(error):.1g} to {max(error):.1g} mm",
    )
    head = ("command", "from nothing to the policy", "success", "error over the last 2 s")
    where = f"{result['machine']['cores']} CPU cores without a GPU, in free flight"
    words = f"*Median and range of the seeds, on {where}. [All trainings](results.md).*"
    return block(head, [cells], words)


PARTS: report.Parts = {"claim": claim, "training-hover": hover_table,
                       "training-suite": suite_table, "speed": speed_table}  # fmt: skip
