"""The folder of a run: making it, locking it, its configuration and its log; without torch."""

from __future__ import annotations

import csv
import fcntl
import hashlib
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadrl.errors import QuadrlError
from quadrl.files import read_sealed_json, write_sealed_json, write_whole
from quadrl.machine import processor_kind
from quadrl.policy import RUN as CONFIG
from quadrl.policy import RUN_FORMAT

METRICS = "metrics.csv"
EVENTS = "events"
EVALUATION = "evaluation.json"
"""A run with this file is trained and evaluated."""
LEARNING_CURVE = "learning_curve.png"
TRAJECTORY = "trajectory.png"
VIDEO = "flight.mp4"
FREE = ("num_threads", "checkpoint_seconds")
"""Settings that change no result."""
CHANGEABLE = (*FREE, "steps", "device")
"""Settings that a run may be continued with other values of."""


def free_folder(wanted: Path) -> Path:
    """The folder for a new run: the one that is wanted, numbered if it holds a run already."""
    number, path = 1, wanted
    while (path / CONFIG).exists():
        number += 1
        path = wanted.with_name(f"{wanted.name}-{number}")
    return path


def new_folder(path: Path) -> None:
    """Make the folder of a new run.

    Raises:
        QuadrlError: It holds a run already.
    """
    if (path / CONFIG).exists():
        raise QuadrlError(
            f"{path} already holds a run: choose another folder, or continue the run "
            f"(quadrl train --resume {path})"
        )
    path.mkdir(parents=True, exist_ok=True)


def lock_folder(path: Path) -> int:
    """Keep other trainings out of a folder while the returned descriptor is open.

    Raises:
        QuadrlError: Another training works in it.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise QuadrlError(
            f"another training works in {path}: wait for its end, stop it, or choose another folder"
        ) from error
    return descriptor


def write_json(path: Path, content: Any) -> None:
    """Write a file whole or not at all."""
    write_whole(path, json.dumps(content, indent=2).encode())


def run_of(config: Mapping[str, Any]) -> str:
    """What a run and its policies are known by: a digest of all that its result follows from."""
    free = (*CHANGEABLE, "run", "processors")
    fixed = {name: value for name, value in config.items() if name not in free}
    return hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:16]


def write_config(folder: Path, config: Mapping[str, Any], processors: Sequence[str] = ()) -> None:
    """Write the resolved configuration of a run, and the processor that it is trained on.

    Args:
        folder: Of the run.
        config: As `TrainConfig.resolved` gives it.
        processors: Those that it was trained on before.
    """
    kinds = {"run": run_of(config), "processors": [*dict.fromkeys((*processors, processor_kind()))]}
    write_sealed_json(folder / CONFIG, {**config, **kinds}, RUN_FORMAT)


def read_config(folder: Path) -> dict[str, Any]:
    """The resolved configuration of a run, as it was saved.

    Raises:
        QuadrlError: The folder holds no run, or its configuration cannot be read.
    """
    file = folder / CONFIG
    if not file.is_file():
        raise QuadrlError(f"{folder} holds no run: it has no {CONFIG}")
    config = read_sealed_json(file, RUN_FORMAT)
    if missing := {"task", "algo", "seed"} - set(config):
        raise QuadrlError(f"{file} is not the configuration of a run: it lacks {min(missing)}")
    return config


class Log:
    """metrics.csv and TensorBoard events; rows after the checkpoint are written again."""

    COLUMNS = (
        "iteration", "steps", "seconds", "episodes", "return", "length", "success", "survival",
        "reward", "error", "deviation", "critic_loss", "kl", "clip_fraction",
    )  # fmt: skip

    def __init__(self, folder: Path, iteration: int) -> None:
        """Open the files; keep the rows of the first `iteration` iterations."""
        from torch.utils.tensorboard import SummaryWriter

        path = folder / METRICS
        kept: list[list[str]] = []
        if path.exists():
            with open(path, newline="") as file:
                rows = list(csv.reader(file))[1:]
            kept = [row for row in rows if len(row) == len(self.COLUMNS)][:iteration]
        whole = io.StringIO(newline="")
        csv.writer(whole).writerows([list(self.COLUMNS), *kept])
        write_whole(path, whole.getvalue().encode())
        self._file = open(path, "a", newline="")  # noqa: SIM115 - closed by close
        self._writer = csv.writer(self._file)
        self._events = SummaryWriter(str(folder / EVENTS), purge_step=iteration + 1)

    def write(self, iteration: int, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Add the row of an iteration."""
        known = {"iteration": iteration, "steps": steps, "seconds": round(seconds, 3)} | metrics
        row = (known.get(name, "") for name in self.COLUMNS)
        self._writer.writerow([f"{v:.6g}" if isinstance(v, float) else v for v in row])
        self._file.flush()
        for name, value in metrics.items():
            self._events.add_scalar(name, value, iteration)

    def close(self) -> None:
        """Close the files."""
        self._file.close()
        self._events.close()
