"""Kills short trainings at random moments, and compares them with those that were left alone.

It exits with 1 if a killed training did not end as the one that was left alone, bit for bit.
"""

from __future__ import annotations

import multiprocessing
import random
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

import tyro

from quadrl.engines.mujoco import ENGINES
from quadrl.learning.config import ALGORITHM_CONFIGS, TrainConfig
from quadrl.learning.folder import CONFIG, METRICS
from quadrl.learning.train import Training
from quadrl.policy import FILE, Policy
from quadrl.rollout import fly, summarize
from scripts.reports import report
from scripts.reports.report import Result, say, table

DELAY = 1.2  # longest time from the start of a training to its kill [s]


def main(kills: int = 20, algorithms: tuple[str, ...] = tuple(ALGORITHM_CONFIGS)) -> None:
    """Kill, compare, write down.

    Args:
        kills: Kills of each algorithm and engine.
        algorithms: The algorithms.
    """
    rows = [killed(algo, engine, kills) for algo in algorithms for engine in ENGINES]
    report.save("kills", {"rows": rows})
    lost = sum(row["runs"] - row["equal"] for row in rows)
    sys.exit(f"{lost} killed runs did not end as the one that was left alone" if lost else None)


def killed(algo: str, engine: str, wanted: int) -> Result:
    """How often trainings were killed, and how many of them ended as if not."""
    kills = runs = equal = 0
    with tempfile.TemporaryDirectory() as scratch:
        start(whole := Path(scratch) / "alone", algo, engine).join()
        expected = outcome(whole)
        while kills < wanted:
            folder, runs, code = Path(scratch) / str(runs), runs + 1, -signal.SIGKILL
            while code == -signal.SIGKILL:
                process = start(folder, algo, engine)
                if kills < wanted:
                    process.join(random.uniform(0.0, DELAY))
                    process.kill()
                process.join()
                code = process.exitcode
                kills += code == -signal.SIGKILL
            equal += code == 0 and outcome(folder) == expected
    row = {"algo": algo, "engine": engine, "kills": kills, "runs": runs, "equal": equal}
    say(row)
    return row


def start(folder: Path, algo: str, engine: str) -> Any:
    """Begin or continue a short training of landing, that reaches the ground, in a process."""
    config = TrainConfig(
        "landing",
        algo=algo,
        engine=engine,
        num_envs=32,
        rollout=8,
        steps=32 * 8 * 60,
        task_options={"time_limit": 0.5, "start_height": 0.3},
        checkpoint_seconds=0.02,
        **{algo: {"minibatch": 128}},
    )
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["quadrl.learning.train"])  # so that no kill hits the imports
    process = context.Process(target=train, args=(config, folder))
    process.start()
    return process


def train(config: TrainConfig, folder: Path) -> None:
    """Begin a training, or continue it."""
    Training(config, folder, resume=(folder / CONFIG).exists()).run()


def outcome(folder: Path) -> tuple[bytes, list[list[str]], Result]:
    """What runs are compared by: the policy, the metrics without the clock, an evaluation."""
    lines = [line.split(",") for line in (folder / METRICS).read_text().splitlines()]
    clock = lines[0].index("seconds")
    metrics = [line[:clock] + line[clock + 1 :] for line in lines]
    task = TrainConfig.of_folder(folder).make_task()
    summary = summarize(fly(Policy.load(folder), task, episodes=8))
    return (folder / FILE).read_bytes(), metrics, summary


def shown() -> str:
    """Kills, and whether they changed anything."""
    result = report.load("kills")
    head = ("algorithm", "engine", "kills", "runs that were killed", "equal to the run left alone")
    rows = ((row["algo"].upper(), *list(row.values())[1:]) for row in result["rows"])
    return f"{table(head, rows)}\n\n{report.source(result)}"


PARTS: report.Parts = {"kills": shown}

if __name__ == "__main__":
    tyro.cli(main)
