"""A study: trainings of several tasks, algorithms and seeds, each in a process of its own."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from quadrl.errors import QuadrlError
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import CONFIG, EVALUATION, FREE

POLL_SECONDS = 0.2


@dataclasses.dataclass(frozen=True)
class Run:
    """One training of a study."""

    config: TrainConfig
    folder: Path

    @property
    def done(self) -> bool:
        """Whether it is trained and evaluated.

        Raises:
            QuadrlError: The folder holds a run with other settings.
        """
        if not (self.folder / CONFIG).exists():
            return False
        free = {name: getattr(TrainConfig, name) for name in FREE}
        found = TrainConfig.of_folder(self.folder)
        if dataclasses.replace(found, **free) != dataclasses.replace(self.config, **free):
            raise QuadrlError(
                f"{self.folder} holds a run with other settings than this study's; choose "
                "another --out"
            )
        return (self.folder / EVALUATION).exists()

    def command(self, episodes: int) -> list[str]:
        """Arguments of `quadrl` that begin it, or continue it."""
        config = self.config
        ending = ["--no-video", "--episodes", str(episodes)]
        if (self.folder / CONFIG).exists():
            return ["train", "--resume", str(self.folder), *ending]
        named = {
            "--algo": config.algo,
            "--seed": config.seed,
            "--steps": config.steps,
            "--vehicle": config.vehicle,
            "--engine": config.engine,
            "--num-threads": config.num_threads,
            "--out": self.folder,
        }
        return ["train", config.task, *(str(word) for p in named.items() for word in p), *ending]


def plan(
    out: Path,
    tasks: Iterable[str],
    algorithms: Iterable[str],
    seeds: Iterable[int],
    **settings: Any,
) -> list[Run]:
    """The runs of a study, seed by seed, so that a study that is stopped has whole seeds.

    Args:
        out: Folder of the run folders.
        tasks: Names of tasks.
        algorithms: Names of algorithms.
        seeds: Of the trainings.
        **settings: Other settings of `TrainConfig` that `Run.command` names: steps, num_threads.
    """
    return [
        Run(TrainConfig(task, algo=algo, seed=seed, **settings), out / f"{task}-{algo}-{seed}")
        for seed in seeds
        for task in tasks
        for algo in algorithms
    ]


def train(
    runs: Iterable[Run], jobs: int, *, episodes: int, report: Callable[[str], None]
) -> list[str]:
    """Train and evaluate the runs that are not done, and continue those that are half done.

    Args:
        runs: The runs.
        jobs: Processes at a time.
        episodes: Of the evaluation at the end of each.
        report: Is told, in a line, what begins and ends.

    Returns:
        A line for each run that failed.

    Raises:
        QuadrlError: A folder holds a run with other settings.
    """
    waiting = [run for run in runs if not run.done]
    going: dict[subprocess.Popen, tuple[str, Path]] = {}
    failed: list[str] = []
    try:
        while waiting or going:
            while waiting and len(going) < jobs:
                run = waiting.pop(0)
                log = run.folder.parent / "logs" / f"{run.folder.name}.txt"
                going[_start(run.command(episodes), log)] = run.folder.name, log
                report(f"{run.folder.name}: begun, {len(waiting)} waiting")
            for process in [p for p in going if p.poll() is not None]:
                name, log = going.pop(process)
                if process.returncode:
                    last = (log.read_text().splitlines() or ["no output"])[-1]
                    failed.append(f"{name}: {last} (the rest is in {log})")
                report(failed[-1] if process.returncode else f"{name}: done")
            time.sleep(POLL_SECONDS)
    finally:
        for process in going:  # after a Ctrl-C: each run can be continued
            process.send_signal(signal.SIGINT)
        for process in going:
            process.wait()
    return failed


def _start(arguments: list[str], log: Path) -> subprocess.Popen:
    """Start the command in a session of its own: a Ctrl-C reaches it once, from `train`."""
    log.parent.mkdir(parents=True, exist_ok=True)
    paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    with open(log, "w") as file:
        return subprocess.Popen(
            [sys.executable, "-m", "quadrl", *arguments],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
