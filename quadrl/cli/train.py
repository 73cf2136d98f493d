"""`quadrl train`."""

from __future__ import annotations

import dataclasses
import time
import typing
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from quadrl.cli.console import again, console, reason, say
from quadrl.cli.flown import parse_options
from quadrl.cli.progress import ProgressBar
from quadrl.description import docstrings
from quadrl.errors import QuadrlError
from quadrl.learning import folder as names
from quadrl.learning.config import TrainConfig


def optional(config: type) -> type:
    """A dataclass with the fields of another, all None by default: "not given".

    Only after everything is parsed does `TrainConfig` fill in the defaults of the task.
    """
    hints, texts, fields = typing.get_type_hints(config), docstrings(config), []
    for field in dataclasses.fields(config):
        kind, help_text = hints[field.name], texts[field.name]
        if dataclasses.is_dataclass(kind):
            inner: Any = optional(typing.cast(type, kind))
            factory = dataclasses.field(default_factory=inner)
            fields.append((field.name, Annotated[inner, arg(help=help_text)], factory))
            continue
        default: Any = field.default
        shown = " ".join(map(str, default)) if isinstance(default, tuple) else default
        if field.name == "task_options":
            kind, shown = tuple[str, ...], "none"
        hint = arg(help=help_text, help_behavior_hint=f"(default: {shown})")
        if field.name == "task":
            fields.append((field.name, Annotated[Positional[str], hint], field.default))
        else:
            fields.append((field.name, Annotated[kind | None, hint], None))
    return dataclasses.make_dataclass(f"{config.__name__}Settings", fields, frozen=True)


Settings: Any = optional(TrainConfig)


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a policy from scratch, evaluate it, and write results and pictures to a run folder.

    The defaults shown are for ppo and the aircraft paper. A task, vpg or another aircraft may have
    others: quadrl tasks TASK lists those of a task.
    """

    settings: Annotated[Settings, arg(name="")]  # pyright: ignore[reportInvalidTypeForm]
    out: Path | None = None
    """Folder of the run; by default runs/TASK-ALGO-SEED. It must not hold a run."""
    resume: Path | None = None
    """Continue the run in this folder, with its own settings; other settings are ignored."""
    episodes: int = 100
    """Episodes of the evaluation at the end."""
    video: bool = True
    """Draw a flight at the end."""

    def run(self) -> None:
        """Train, evaluate, draw, sum up."""
        config, folder = None, self.resume
        if folder is None:
            settings = dataclasses.asdict(self.settings)
            options = parse_options(settings.pop("task_options") or ())
            config = TrainConfig(**settings, task_options=options or None)
            named = Path("runs") / f"{config.task}-{config.algo}-{config.seed}"
            folder = self.out or named
        began = time.perf_counter()
        with console.status("importing torch and TorchRL"):
            from quadrl.learning.run import train
        imports = time.perf_counter() - began
        go_on = f"continue it: {again('train --resume', folder)}"
        try:
            with ProgressBar() as bar:
                config, metrics = train(
                    config,
                    folder,
                    episodes=self.episodes,
                    video=self.video,
                    on_progress=bar.show,
                    report=say,
                )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"stopped; the run is kept, {go_on}") from None
        except OSError as error:
            kept = (folder / names.CONFIG).exists()
            advice = f"the run is kept, {go_on}" if kept else "choose another --out"
            raise QuadrlError(f"{reason(error)}; {advice}") from error
        _sum_up(folder, config, metrics, imports)


def _sum_up(folder: Path, config: TrainConfig, metrics: dict[str, Any], imports: float) -> None:
    """Print the result, the files and what to try next."""
    console.print(
        f"\n[bold]{config.task}[/bold] trained with {config.algo.upper()} in "
        f"{metrics['training_s']:.1f} s of wall clock from the first step to the saved policy "
        f"(imports: {imports:.1f} s; engine: {config.engine})\n"
        f"{metrics['episodes']} episodes in MuJoCo with the mean action: "
        f"{100 * metrics['survival_rate']:.0f} % to the end, "
        f"{100 * metrics['success_rate']:.0f} % successful, error over the last 2 s "
        f"{100 * metrics['position_error_m']:.1f} cm\n"
    )
    meanings = {
        "policy.safetensors": "the policy",
        names.LEARNING_CURVE: "return, success and error over the training",
        names.TRAJECTORY: "flights of the evaluation",
        names.VIDEO: "one of them on video",
        names.EVALUATION: "the metrics",
        names.METRICS: f"the training, row by row; also: tensorboard --logdir {folder}",
        names.CONFIG: "the resolved configuration",
        "checkpoint.safetensors": f"to continue: {again('train --resume', folder)}",
    }
    say(f"in {folder}")
    for name, meaning in meanings.items():
        if (folder / name).exists():
            say(f"  {name:<22}  {meaning}")
    say(
        f"\nnext: {again('render', folder)} --camera chase --seed 7\n"
        f"      {again('evaluate', folder)} --episodes 1000\n"
        f"      {again('tasks')}"
    )
