"""The folder of a run: making it, locking it, its configuration and its tables; without torch."""

from __future__ import annotations

import contextlib
import csv
import functools
import hashlib
import json
import os
import socket
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.files import NO_LOCKS, lock, read_sealed_json, write_sealed_json
from quadrl.base.machine import processor_kind
from quadrl.core.record import sealed_imports
from quadrl.evaluation.policy_file import RUN as CONFIG
from quadrl.evaluation.policy_file import RUN_FORMAT

CHECKPOINT = "checkpoint.safetensors"
METRICS = "metrics.csv"
EVALUATIONS = "evaluations.csv"
"""Evaluations of the mean action during the training."""
EVENTS = "events"
WANDB = "wandb"
EVALUATION = "evaluation.json"
"""A run with this file is trained and evaluated."""
LEARNING_CURVE = "learning_curve.png"
TRAJECTORY = "trajectory.png"
VIDEO = "flight.mp4"
WARNINGS = "warnings.txt"
"""MuJoCo's warnings during the training, if there were any."""
LOCK = "training.lock"
"""Host and process of the training that works here, if the file system has no locks."""
FIGURES = {
    "success": "success_rate",
    "survival": "survival_rate",
    "error": "position_error_m",
    "return": "return_mean",
}
"""Columns of `EVALUATIONS`, means over the episodes, and the metric of `quadrl.evaluate`."""
FREE = ("num_threads", "checkpoint_seconds", "evaluations", "keep", "log", "checkpoint_every",
        "episodes")  # fmt: skip
"""Settings that do not change what is trained."""
CHANGEABLE = (*FREE, "steps", "until", "device")
"""Settings that may have other values when a run is continued."""
DRAWN = {"steps", "seconds", "return", "success", "error", "survival"}
"""Columns of the metrics that a plot needs."""


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


def lock_folder(path: Path) -> Callable[[], None]:
    """Keep other trainings out of a folder until the returned function is called.

    If the file system has no locks, a file in the folder does it, with a warning.

    Raises:
        QuadrlError: Another training works in it.
    """
    try:
        return functools.partial(os.close, lock(path))
    except BlockingIOError as error:
        raise QuadrlError(
            f"another training works in {path}: wait for its end, stop it, or choose another folder"
        ) from error
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    file = (path / LOCK).absolute()
    _make_lock(file)
    text = f"the file system of {path} has no locks: {LOCK} in it keeps other trainings out"
    warnings.warn(text, QuadrlWarning, stacklevel=2)
    return functools.partial(_remove_lock, file)


_HELD: set[Path] = set()
"""Lock files of this process."""


def _make_lock(file: Path) -> None:
    """Write a lock file, and replace one whose process died on this host.

    Raises:
        QuadrlError: There is one whose process is alive, or may be.
    """
    with contextlib.suppress(FileNotFoundError):
        if _is_dead(file):
            file.unlink()
    try:
        with open(file, "x") as opened:
            opened.write(_owner())
    except FileExistsError as error:
        host, _, process = file.read_text(errors="replace").strip().partition(" ")
        who = f"process {process} on {host}, by {file}"
        raise QuadrlError(
            f"another training works in {file.parent} ({who}): wait for its end, stop it, or "
            "choose another folder; if that process is gone, delete the file"
        ) from error
    _HELD.add(file)


def _is_dead(file: Path) -> bool:
    """Whether a lock file belongs to a process of this host that has ended."""
    text = file.read_text(errors="replace")
    host, _, process = text.strip().partition(" ")
    if host != socket.gethostname() or not process.isdecimal():
        return False
    if text == _owner():  # of this process, or of an earlier one with its number
        return file not in _HELD
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):  # it is alive, and of another user
        pass
    return False


def _remove_lock(file: Path) -> None:
    """Remove a lock file if this process made it; a child process may call this, too."""
    _HELD.discard(file)
    with contextlib.suppress(OSError):
        if file.read_text(errors="replace") == _owner():
            file.unlink()


def _owner() -> str:
    return f"{socket.gethostname()} {os.getpid()}\n"


def run_of(config: Mapping[str, Any]) -> str:
    """The identity of a run and its policies: a digest of all settings that decide its result."""
    free = (*CHANGEABLE, "run", "processors", "imports")
    fixed = {name: value for name, value in config.items() if name not in free}
    return hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:16]


def earlier(folder: Path, number: int) -> Path:
    """The folder of a training, from 1 on, that comes before the last one of a run."""
    return folder / f"phase_{number}"


def is_earlier(folder: Path) -> bool:
    """Whether a folder is that of such a training."""
    return folder.name.startswith("phase_") and (folder.parent / CONFIG).exists()


def write_config(folder: Path, config: Mapping[str, Any], processors: Sequence[str] = ()) -> None:
    """Write the resolved configuration of a run, its files of `--import` and its processor.

    Args:
        folder: Folder of the run.
        config: As `TrainConfig.resolved` gives it.
        processors: Those that it was trained on earlier.
    """
    kinds = {"run": run_of(config), "processors": [*dict.fromkeys((*processors, processor_kind()))]}
    kinds["imports"] = sealed_imports()
    write_sealed_json(folder / CONFIG, {**config, **kinds}, RUN_FORMAT)


def read_config(folder: Path) -> dict[str, Any]:
    """Read the resolved configuration of a run, as it was saved.

    Raises:
        QuadrlError: The folder holds no run, or its configuration cannot be read.
    """
    file = folder / CONFIG
    if not file.is_file():
        raise QuadrlError(f"{folder} holds no run: it has no {CONFIG}")
    config = read_sealed_json(file, RUN_FORMAT)
    if missing := {"task", "algo", "seed", "scenario"} - set(config):
        raise QuadrlError(f"{file} is not the configuration of a run: it lacks {min(missing)}")
    return config


def read_rows(path: Path, columns: Sequence[str]) -> list[list[str]]:
    """Read the rows of a table, without its head or a row that a kill cut off; [] of no file."""
    if not path.exists():
        return []
    with open(path, newline="") as file:
        return [row for row in [*csv.reader(file)][1:] if len(row) == len(columns)]


def read_metrics(path: Path) -> dict[str, np.ndarray]:
    """Read the columns of a metrics.csv, (iterations,) each; missing values are NaN.

    Raises:
        QuadrlError: The file is missing, empty or malformed.
    """
    if not path.is_file():
        raise QuadrlError(f"nothing to plot: there is no {path}")
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise QuadrlError(f"nothing to plot yet: {path} has no rows")
    try:
        metrics = {
            name: np.array([float(row[name]) if row[name] else np.nan for row in rows])
            for name in rows[0]
        }
    except (TypeError, ValueError) as error:
        raise QuadrlError(f"{path} is malformed: {error}") from error
    if missing := DRAWN - set(metrics):
        raise QuadrlError(f"{path} has no column {', '.join(sorted(missing))}")
    return metrics
