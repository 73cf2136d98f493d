"""Trainings of several tasks, algorithms and seeds, each in a process of its own."""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

from quadrl.errors import QuadrlError
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import CONFIG, EVALUATION, FREE
from scripts.reports.report import ENVIRONMENT, say

POLL_SECONDS = 0.2
NAMED = ("algo", "seed", "variant", "steps", "vehicle", "engine", "memory", "num_threads")
PAIRED = ("observe", "vehicle_options")
"""Settings that the command of a run names, beside what disturbs and is observed: all others are
those of its task."""


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
            raise QuadrlError(f"{self.folder} holds a run with other settings than this study's")
        return (self.folder / EVALUATION).exists()

    def command(self, episodes: int) -> list[str]:
        """Begins it, or continues it."""
        known = {name.replace("_", "-"): getattr(self.config, name) for name in NAMED}
        named = [f"--{name}={value}" for name, value in known.items()]
        begin = [self.config.task, *named, f"--out={self.folder}"]
        for name in ("weather", "randomization", "aerodynamics"):
            if not (value := getattr(self.config, name)):
                continue
            text = value if isinstance(value, str) else json.dumps(value)
            begin.append(f"--{name}={text}")
        for name in PAIRED:
            if given := getattr(self.config, name):
                option = name.replace("_", "-")
                begin += [f"--{option}", *(f"{k}={json.dumps(v)}" for k, v in given.items())]
        again = ["--resume", str(self.folder)]
        setting = again if (self.folder / CONFIG).exists() else begin
        ending = ["--no-video", "--episodes", str(episodes)]
        return [sys.executable, "-m", "quadrl", "train", *setting, *ending]


def train(runs: Iterable[Run], jobs: int, episodes: int) -> None:
    """Train and evaluate the runs that are not done, and continue those that are half done.

    Args:
        runs: The runs.
        jobs: Processes at a time.
        episodes: Of the evaluation at the end of each.

    Raises:
        QuadrlError: A folder holds a run with other settings.
        SystemExit: A training failed.
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
                say(f"{run.folder.name}: begun, {len(waiting)} waiting")
            for process in [p for p in going if p.poll() is not None]:
                name, log = going.pop(process)
                if process.returncode:
                    last = (log.read_text().splitlines() or ["no output"])[-1]
                    failed.append(f"{name}: {last} (the rest is in {log})")
                say(failed[-1] if process.returncode else f"{name}: done")
            time.sleep(POLL_SECONDS)
    finally:
        for process in going:  # after a Ctrl-C: each run can be continued
            process.send_signal(signal.SIGINT)
        for process in going:
            process.wait()
    if failed:
        raise SystemExit("\n".join(["Not every training ended:", *failed]))


def _start(command: list[str], log: Path) -> subprocess.Popen:
    """Start a command in a session of its own: a Ctrl-C reaches it once, from `train`."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "w") as file:
        return subprocess.Popen(
            command,
            env=ENVIRONMENT | {"OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
