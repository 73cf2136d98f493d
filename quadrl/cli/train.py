"""`quadrl train`."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from quadrl.base.errors import QuadrlError, RenderingUnavailable
from quadrl.base.files import read_table
from quadrl.base.philox import seeds
from quadrl.base.progress import ProgressBar
from quadrl.base.records import tuples
from quadrl.base.signals import heeded
from quadrl.cli import choices
from quadrl.cli.console import again, console, make_table, reason, say
from quadrl.cli.flown import parsed
from quadrl.cli.parsing import trained
from quadrl.cli.study import carry_out
from quadrl.evaluation.rollout import MAX_SEED
from quadrl.learning import folder as names
from quadrl.learning.config import TrainConfig, prepare
from quadrl.learning.defaults import flat, merged
from quadrl.learning.train_settings import USUAL

if TYPE_CHECKING:
    from quadrl.learning.run import Run


FEW = 16  # aircraft: with less, most of the time goes into calls from Python


shown: dict[str, Any] = dict(flat(TrainConfig().named()))
"""The defaults that help shows, by the names of the settings."""


def show_defaults(words: Sequence[str]) -> None:
    """Let help show the defaults of the task, algorithm, aircraft and variant that words name."""
    task, given = trained(words)
    with contextlib.suppress(QuadrlError):  # the parser says what is wrong
        config = TrainConfig(task, **given)
        shown.clear()
        shown.update(flat(config.named()))


def _default(name: str) -> str:
    """The default of a setting, as help shows it."""
    options = (f"{k[len(name) + 1 :]}={v}" for k, v in shown.items() if k.startswith(f"{name}."))
    value = shown.get(name, tuple(options))
    text = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return "" if text in ("", "{}") else f"(default: {text})"


Settings: Any = choices.optional(TrainConfig, _default)
"""Only after everything is parsed does `TrainConfig` fill in the defaults of the task."""


@choices.command
class Train:
    """Train a policy from scratch, evaluate it, and write results and pictures to a run folder.

    The defaults shown are for hover, ppo and the aircraft paper. Give a task, --algo, --vehicle or
    --variant with --help to see theirs. --dry-run says where each setting comes from. --engine is
    that of the training; evaluations fly in mujoco.
    """

    settings: Annotated[Settings, arg(name="")]  # pyright: ignore[reportInvalidTypeForm]
    out: Path | None = None
    """Folder of the run; by default runs/TASK-ALGO-SEED, with a number added if that holds a run
    already. With --seeds the folder of the runs; by default runs/TASK-ALGO-seeds."""
    name: str = ""
    """Name of the run: its folder is runs/NAME."""
    config: Path | None = None
    """Begin with the settings of a run's config.json, or of a .toml or .json file with settings by
    name; options given beside it come on top."""
    resume: Path | None = None
    """Continue the run in this folder, with its own settings; --steps may be larger than at its
    start."""
    seeds: str = ""
    """Train several seeds as a study and summarize: 0:5 for 0 to 4, or 3,5,8. The same command
    resumes a stopped study."""
    video: bool = True
    """Draw a flight at the end (not with --seeds)."""
    dry_run: bool = False
    """Print every setting with its value and the layer of defaults it comes from; train nothing."""

    def run(self) -> None:
        """Train, sum up, draw."""
        if self.dry_run:
            given = dict.fromkeys(dict(flat(parsed(dataclasses.asdict(self.settings)))), "given")
            config, _ = self.prepared()
            rows = [
                (name, "-" if value in ("", {}) else str(value), given.get(name, origin))
                for name, value, origin in config.sources()
            ]
            console.print(make_table([("setting", "value", "from"), *rows]))
            return
        if self.seeds:
            self._study()
            return
        run = self._train(*self.prepared())
        _draw(run, video=self.video)
        _list_files(run)
        if run.misses:
            say(f"\n{run.misses}\n{run.causes}")

    def _given(self) -> tuple[str | None, Path | None, dict[str, Any]]:
        """The task, the folder and the other settings that are given.

        Raises:
            QuadrlError: They cannot be read, or do not go together.
        """
        settings = parsed(dataclasses.asdict(self.settings))
        if self.config:
            settings = merged(_of_file(self.config), settings)
        if self.name and (self.out or self.resume):
            allowed = "left out beside --out and --resume"
            raise QuadrlError(name="--name", value=self.name, allowed=allowed)
        out = Path("runs", self.name) if self.name else self.out
        return settings.pop("task", None), out, settings

    def prepared(self) -> tuple[TrainConfig, Path]:
        """The settings of the training, and its folder.

        Raises:
            QuadrlError: A setting is unknown or out of range.
        """
        task, out, settings = self._given()
        return prepare(task, out, self.resume, settings)

    def _study(self) -> None:
        """Train the seeds as a study of one configuration."""
        task, out, settings = self._given()
        for name, other in (("--seed", settings.get("seed")), ("--resume", self.resume)):
            if other is not None:
                raise QuadrlError(name=name, value=str(other), allowed="left out beside --seeds")
        given, config = seeds(self.seeds, MAX_SEED), TrainConfig(task or "hover", **settings)
        settings = {k: v for k, v in settings.items() if k not in ("algo", "episodes")}
        what = {"tasks": [config.task], "algorithms": [config.algo], "seeds": given,
                "episodes": config.episodes, "settings": settings}  # fmt: skip
        carry_out(what, out=out or Path("runs", f"{config.task}-{config.algo}-seeds"))

    def _train(self, config: TrainConfig, folder: Path) -> Run:
        """Train and evaluate, and print the result."""
        began = time.perf_counter()
        with console.status("importing torch and TorchRL"):
            from quadrl.learning.run import train_in, would_gain
        imports = time.perf_counter() - began
        if self.resume:
            say(f"continuing {folder}")
        elif gain := would_gain(config):
            say(gain)
        batch = config.num_envs * config.rollout
        if config.steps % batch:
            say(f"{config.iterations * batch:,} steps: whole batches of {batch:,}")
        go_on = f"continue it: {again('train --resume', folder)}"
        try:
            with ProgressBar(console) as bar:
                run = train_in(
                    folder,
                    config,
                    resume=self.resume is not None,
                    show=bar.show,
                    heed=heeded,
                )
        except KeyboardInterrupt as stop:
            stop.args = (f"stopped; the run is kept, {go_on}",)
            raise
        except OSError as error:
            kept = (folder / names.CONFIG).exists()
            advice = f"the run is kept, {go_on}" if kept else "choose another --out"
            raise QuadrlError(f"{reason(error)}; {advice}") from error
        say(f"\n{run.summary} (imports: {imports:.1f} s; engine: {config.base.engine})")
        say(f"{run.kept}\n")
        if run.lateness:
            say(f"{run.lateness}\n")
        if config.num_envs < FEW:
            say("Many aircraft train faster than few, with shorter rollouts: see --num-envs.\n")
        return run


def _of_file(path: Path) -> dict[str, Any]:
    """The settings in a run's config.json, or in a table.

    Raises:
        QuadrlError: It cannot be read, or is a configuration of another version.
    """
    if path.name != names.CONFIG:
        return tuples(read_table(path, "file of settings"))
    saved = names.read_config(path.parent)
    return tuples({name: saved[name] for name in USUAL if name in saved})


def _draw(run: Run, *, video: bool) -> None:
    """Draw the pictures of a run; Ctrl-C skips the rest of them."""
    with ProgressBar(console, lines=False) as bar:

        def on_frame(done: int, total: int) -> None:
            hint = " (Ctrl-C skips it)" if console.is_terminal else ""
            bar.update(done, total, f"drawing {names.VIDEO}{hint}")

        try:
            for _ in run.draw(video=video, on_frame=on_frame):
                pass
        except KeyboardInterrupt:
            say(f"skipped; to draw it later: {again('render', run.folder)}")
        except RenderingUnavailable as error:
            say(f"no video: {error}")


def _list_files(run: Run) -> None:
    """Print what is in the folder of a run, and what to try next."""
    folder = run.folder
    meanings = {
        "policy.safetensors": "the policy",
        names.LEARNING_CURVE: "return, success and error over the training",
        names.TRAJECTORY: "flights of the evaluation",
        names.VIDEO: "one of them on video",
        names.EVALUATION: "the metrics",
        names.EVALUATIONS: "what the mean action reached along the training",
        names.METRICS: f"the training, row by row; also: tensorboard --logdir {folder}",
        names.WANDB: f"W&B's files; from offline: wandb sync {folder}/{names.WANDB}/offline-run-*",
        names.WARNINGS: "MuJoCo's warnings in the training",
        names.CONFIG: "the resolved configuration",
        "checkpoint.safetensors": f"to continue: {again('train --resume', folder)} --steps N",
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
