"""Trains every task with its defaults, and hover in both engines and on every aircraft.

Run it on a machine that does nothing else; it takes about half an hour on two cores. Interrupted at
any moment, it continues at the next start.
"""

from __future__ import annotations

import tyro

from quadrl import VEHICLES, tasks
from quadrl.engines.mujoco import ENGINES
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import Controller, fly, summarize
from quadrl.learning.config import TrainConfig
from quadrl.learning.studies.crew import train_here
from quadrl.learning.studies.plan import PlannedRun
from scripts.reports import evaluation, report
from scripts.reports.report import Result, asked, factor, number, say, table

HOVER_SEEDS = (225, 226, 227, 228, 229)  # not used for tuning, like those below
SEEDS = (385, 386, 387)
EPISODES = 100
LONGEST = 300.0  # [s] that a training of any task may take


def plan(jobs: int) -> dict[int, list[PlannedRun]]:
    """The trainings, by how many are made at the same time."""
    folder = report.RUNS / "training"
    alone = [
        TrainConfig("hover", engine=engine, seed=seed) for engine in ENGINES for seed in HOVER_SEEDS
    ]
    pairs = [(task, "paper") for task in tasks.TASKS if task != "hover"]
    pairs += [("hover", vehicle) for vehicle in VEHICLES if vehicle != "paper"]
    together = [
        TrainConfig(task, vehicle=vehicle, seed=seed, num_threads=1)
        for task, vehicle in pairs
        for seed in SEEDS
    ]
    name = "{0.task}-{0.vehicle}-{0.engine}-{0.seed}".format
    return {
        k: [PlannedRun(c, folder / name(c)) for c in x] for k, x in ((1, alone), (jobs, together))
    }


def main(jobs: int = 2, only: tuple[str, ...] = ()) -> None:
    """Train what is missing, evaluate it, write it down.

    Args:
        jobs: Trainings at the same time, of those whose wall clock is not compared.
        only: Names of tasks, beside what was measured of the others; by default all.
    """
    planned = {
        k: [run for run in runs if not only or run.config.task in only]
        for k, runs in plan(jobs).items()
    }
    for jobs, runs in planned.items():
        train_here(runs, jobs, EPISODES, say)
    found = []
    for run in (run for runs in planned.values() for run in runs):
        known = evaluation.trained(run)
        known |= flown(Policy.load(run.folder), known["task"], known["vehicle"])
        found.append(known | {"commit": report.commit()})
    yardstick = [
        flown(make_controller("geometric", *pair), *pair)
        for pair in dict.fromkeys((run["task"], run["vehicle"]) for run in found)
    ]
    whole: Result = {"episodes": EPISODES, "yardstick": yardstick, "runs": found}
    if only:
        for part in ("yardstick", "runs"):
            whole[part] += report.others("training", part, only)
    report.save("training", whole)


def flown(controller: Controller, task: str, vehicle: str) -> Result:
    """What a controller, or the mean action of a policy, reaches in MuJoCo."""
    rollout = fly(controller, task, episodes=EPISODES, vehicle=vehicle)
    return {"task": task, "vehicle": vehicle, "metrics": summarize(rollout)}


def hover() -> str:
    """Hover, in both engines and on every aircraft."""
    result = report.load("training")
    runs = [run for run in result["runs"] if run["task"] == "hover"]
    rows = []
    for run in runs:
        metrics = run["metrics"]
        row = [run["vehicle"], run["engine"], run["seed"], f"{run['steps']:,}"]
        row += [f"{run['training_s']:.1f} s"]
        row += [f"{100 * metrics[name]:.0f} %" for name in ("survival_rate", "success_rate")]
        row += [f"{1000 * metrics['position_error_m']:.2f} mm"]
        rows.append([*row, f"{metrics['heading_error_deg']:.1f} deg"])
    head = ["aircraft", "engine", "seed", "control steps", "training", "flown to the end"]
    head += ["successful", "error", "heading off east"]
    known = [row for row in result["yardstick"] if row["task"] == "hover"]
    error = max(1000 * row["metrics"]["position_error_m"] for row in known)
    success = min(100 * row["metrics"]["success_rate"] for row in known)
    note = f"The geometric controller, in the same episodes and with every aircraft: {success:.0f} "
    note += f"% successful, largest error {number(error)} mm."
    return f"{table(head, rows)}\n\n{note}  \n{report.source(result | report.commits(runs))}"


def suite() -> str:
    """Every task beside what counts as solved and the geometric controller."""
    result = report.load("training")
    rows: list[tuple[str, ...]] = []
    for name in tasks.TASKS:
        own, _ = reached(result, name)
        rows += [(f"`{name}`" if k == 0 else "", *row) for k, row in enumerate(own)]
    seeds = ("first seed", "second seed", "third seed")
    return table(("task", "figure", "asked", *seeds, "geometric controller"), rows)


def reached(result: Result, name: str) -> tuple[list[tuple[str, ...]], list[int]]:
    """What a task asks beside what each seed reached, and the seeds.

    Raises:
        FileNotFoundError: The task was not trained.
    """
    task, rows = tasks.TASKS[name], []
    runs, known = (
        [row for row in result[part] if (row["task"], row["vehicle"]) == (name, "paper")]
        for part in ("runs", "yardstick")
    )
    runs = [run for run in runs if run["engine"] == "free_flight"][: len(SEEDS)]
    if not runs:
        raise FileNotFoundError(name)
    for target in task.targets:
        metrics = (each["metrics"][target.metric] for each in (*runs, *known))
        cells = (number(value and factor(target) * value) for value in metrics)
        rows.append((target.words, asked(target), *cells))
    seeds = [run["seed"] for run in runs]
    words = f"training, {runs[0]['steps']:,} steps, seeds {', '.join(map(str, seeds))}"
    took = (f"{run['training_s']:.0f} s" for run in runs)
    rows.append((words, f"at most {LONGEST:.0f} s", *took, ""))
    return rows, seeds


PARTS: report.Parts = {"training-hover": hover, "training-suite": suite}

if __name__ == "__main__":
    tyro.cli(main)
