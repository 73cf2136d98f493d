"""What a training logs: metrics.csv, and the same figures for the programs that show them."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from quadrl.base.errors import QuadrlError
from quadrl.base.extras import needed
from quadrl.base.files import write_csv
from quadrl.learning.folder import EVENTS, METRICS, WANDB, read_rows

SHOWN = ("eval/success_rate", "steps_per_second")
"""Figures beside the settings in TensorBoard's table of runs."""


class Writer(Protocol):
    """A program that shows figures over the iterations of a training."""

    def __init__(self, folder: Path, iteration: int, settings: Mapping[str, Any]) -> None:
        """Begin, or go on after an iteration; settings by name are numbers, flags and texts."""

    def show(self, iteration: int, figures: Mapping[str, float]) -> None:
        """Add figures after an iteration, which may be an earlier one than those before."""

    def close(self) -> None:
        """Write what is left."""


class TensorBoard:
    """TensorBoard's events."""

    def __init__(self, folder: Path, iteration: int, settings: Mapping[str, Any]) -> None:
        from tensorboard.compat.proto import summary_pb2
        from torch.utils.tensorboard import SummaryWriter
        from torch.utils.tensorboard.summary import hparams

        self._events: Any = SummaryWriter(str(folder / EVENTS), purge_step=iteration + 1)
        self._protocol: Any = summary_pb2
        if not iteration:
            for part in hparams(dict(settings), dict.fromkeys(SHOWN, 0.0)):
                self._events.file_writer.add_summary(part)

    def show(self, iteration: int, figures: Mapping[str, float]) -> None:
        """Add figures in one record: one for each takes several times as long."""
        kind = self._protocol.Summary
        values = [kind.Value(tag=name, simple_value=value) for name, value in figures.items()]
        self._events.file_writer.add_summary(kind(value=values), iteration)

    def close(self) -> None:
        """Close the file."""
        self._events.close()


class WandB:
    """A run of W&B with the name of the folder, in the project that WANDB_PROJECT names.

    Its files are in the folder; with WANDB_MODE=offline that is all.
    """

    def __init__(self, folder: Path, iteration: int, settings: Mapping[str, Any]) -> None:
        import wandb

        # Their names end in the time and the run's identity.
        before = sorted((folder / WANDB).glob("*run-*")) if iteration else []
        try:
            self._run: Any = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "quadrl"),
                name=folder.absolute().name,
                dir=folder,
                config=dict(settings),
                id=before[-1].name.rpartition("-")[2] if before else None,
                resume="allow" if before and not _offline(wandb) else None,
                settings=wandb.Settings(console="off", silent=True),
            )
        except wandb.Error as error:
            raise _unusable(error) from error
        self._run.define_metric("*", step_metric="iteration")

    def show(self, iteration: int, figures: Mapping[str, float]) -> None:
        """Add figures; its own steps may only grow, so that the iteration is one of them."""
        self._run.log({"iteration": iteration, **figures})

    def close(self) -> None:
        """Send or write what is left."""
        self._run.finish()


WRITERS: dict[str, tuple[type[Writer], ...]] = {
    "tensorboard": (TensorBoard,),
    "wandb": (TensorBoard, WandB),
}
"""What the setting `log` may be."""


def check(log: str) -> None:
    """Refuse to log to W&B where that is not installed or nobody is logged in.

    Raises:
        QuadrlError: What to do about it.
    """
    if log != "wandb":
        return
    with needed("log = wandb", "wandb"):
        import wandb
    try:
        if not _offline(wandb):
            wandb.login()
    except wandb.Error as error:
        raise _unusable(error) from error


def _offline(wandb: Any) -> bool:
    return wandb.setup().settings.mode in ("offline", "disabled")


def _unusable(error: Exception) -> QuadrlError:
    said = str(error).partition("\n")[0]
    return QuadrlError(f"W&B cannot be used: {said} With WANDB_MODE=offline it needs no account")


class Log:
    """metrics.csv and what shows its figures; rows after the checkpoint are replaced."""

    COLUMNS = (
        "iteration", "steps", "seconds", "episodes", "return", "length", "success", "survival",
        "reward", "error", "deviation", "critic_loss", "kl", "clip_fraction",
    )  # fmt: skip

    def __init__(
        self,
        folder: Path,
        iteration: int,
        own: Sequence[str],
        settings: Mapping[str, Any],
        writers: str,
    ) -> None:
        """Open the files; keep the rows of the first `iteration` iterations.

        Args:
            folder: Folder of the run.
            iteration: Iterations so far.
            own: Names of metrics that are the task's own.
            settings: The settings by name.
            writers: A name of WRITERS.

        Raises:
            QuadrlError: W&B cannot be used.
        """
        plain = {k: v if isinstance(v, bool | int | float) else str(v) for k, v in settings.items()}
        self._writers = [kind(folder, iteration, plain) for kind in WRITERS[writers]]
        path = folder / METRICS
        self._columns = (*self.COLUMNS, *own)
        write_csv(path, self._columns, read_rows(path, self._columns)[:iteration])
        self._file = open(path, "a", newline="")  # noqa: SIM115 - closed by close
        self._rows = csv.writer(self._file)
        self._last = 0, 0.0  # steps and seconds

    def write(self, iteration: int, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Add the row of an iteration."""
        known = {"iteration": iteration, "steps": steps, "seconds": round(seconds, 3)} | metrics
        row = (known.get(name, "") for name in self._columns)
        self._rows.writerow([f"{v:.6g}" if isinstance(v, float) else v for v in row])
        self._file.flush()
        (last, before), self._last = self._last, (steps, seconds)
        if before:
            metrics = metrics | {"steps_per_second": (steps - last) / max(seconds - before, 1e-9)}
        self._show(iteration, metrics)

    def evaluated(self, iteration: int, figures: dict[str, float]) -> None:
        """Show an evaluation after an iteration."""
        self._show(iteration, {f"eval/{name}": value for name, value in figures.items()})

    def _show(self, iteration: int, figures: dict[str, float]) -> None:
        for writer in self._writers:
            writer.show(iteration, figures)

    def close(self) -> None:
        """Close the files."""
        self._file.close()
        for writer in self._writers:
            writer.close()
