"""The command `quadrl`: tasks, train, evaluate, render, plot, benchmark."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from quadrl import tasks
from quadrl.errors import QuadrlError
from quadrl.learning.config import (
    TrainConfig,
    parse_options,
    read_config,
    recipe,
    write_text,
)
from quadrl.policy import Policy, PolicyError
from quadrl.task import OptionError, Task, check_choices
from quadrl.vehicle import VEHICLES, Vehicle

if TYPE_CHECKING:
    from quadrl.learning.evaluate import Record
    from quadrl.learning.train import Progress

console = Console()
EVALUATION = "evaluation.json"
CURVE, TRAJECTORY, VIDEO = "learning_curve.png", "trajectory.png", "flight.mp4"
MAX_EPISODES = 100_000


@dataclasses.dataclass(frozen=True)
class Tasks:
    """List the tasks, or one of them in full."""

    task: tyro.conf.Positional[str] = ""
    """Name of a task; none for the list."""

    def run(self) -> None:
        """Print them."""
        if self.task:
            _describe(tasks.make(self.task))
            return
        table = Table(box=None, header_style="bold", padding=(0, 2, 1, 0))
        for column in ("task", "asks", "ends early", "success", "horizon"):
            table.add_column(column)
        for name, task in tasks.TASKS.items():
            horizon = f"{tasks.make(name).horizon:g} s"
            table.add_row(name, task.asks, task.ends, task.solved, horizon)
        console.print(table)
        console.print("[dim]quadrl tasks NAME shows one in full[/dim]")


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a policy from nothing, evaluate it and draw it, into a run folder."""

    config: tyro.conf.OmitArgPrefixes[TrainConfig]
    out: Path | None = None
    """Folder of the run; by default runs/TASK-ALGO-SEED. It must not hold a run."""
    resume: Path | None = None
    """Go on with the run in this folder, with its own configuration; nothing else is needed."""
    episodes: int = 100
    """Episodes of the evaluation at the end."""
    video: bool = True
    """Draw the flight at the end."""

    def run(self) -> None:
        """Train, evaluate, draw, sum up."""
        _check_episodes(self.episodes)
        began = time.perf_counter()
        with console.status("importing torch and TorchRL"):
            from quadrl.learning.train import Training
        imports = time.perf_counter() - began
        config = self.config
        folder = self.out or Path("runs") / f"{config.task}-{config.algo}-{config.seed}"
        if self.resume is not None:
            folder = self.resume
            config = TrainConfig.of_folder(folder)
        training = Training(config, folder, resume=self.resume is not None)
        if self.resume is not None:
            console.print(f"going on with {folder} at iteration {training.iteration}")
        with _ProgressBar(config) as bar:
            policy = training.run(bar.show)
        vehicle = VEHICLES[config.vehicle]
        judged, record = _evaluate(policy, config.task, config.options, vehicle, self.episodes)
        judged |= {"training_s": round(training.seconds, 2), "imports_s": round(imports, 2)}
        write_text(folder / EVALUATION, json.dumps(judged, indent=2))
        _draw_run(folder, config.task, record, vehicle, config.options, self.video)
        _sum_up(folder, config, judged)


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Fly the mean action of a policy through fresh episodes and judge it."""

    policy: tyro.conf.Positional[Path]
    """A run folder or a .safetensors file."""
    task: str = ""
    """Another task than the one it was trained for."""
    episodes: int = 100
    """Number of episodes."""
    seed: int = 0
    """Of the episodes."""
    task_options: tuple[str, ...] = ()
    """Fields of the task that differ from the training's, such as horizon=5."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print the figures."""
        _check_episodes(self.episodes)
        policy = Policy.load(self.policy)
        task, options, vehicle = _setting(policy, self.task, self.task_options)
        judged, _ = _evaluate(policy, task, options, vehicle, self.episodes, self.seed)
        if self.json:
            sys.stdout.write(json.dumps(judged) + "\n")
        else:
            console.print(_figures_table(judged))


@dataclasses.dataclass(frozen=True)
class Render:
    """Draw a flight of a policy as a video."""

    policy: tyro.conf.Positional[Path]
    """A run folder or a .safetensors file."""
    out: Path = Path("flight.mp4")
    """The video."""
    task: str = ""
    """Another task than the one it was trained for."""
    seed: int = 0
    """Of the episode."""
    task_options: tuple[str, ...] = ()
    """Fields of the task that differ from the training's."""
    camera: str = "follow"
    """follow, track, chase, onboard or fixed."""
    width: int = 848
    """[pixels]"""
    height: int = 480
    """[pixels]"""
    fps: float = 30.0
    """Frames a second."""

    def run(self) -> None:
        """Fly one episode and write the video."""
        from quadrl.learning.evaluate import EVALUATION_SEED, fly
        from quadrl.rendering import write_video

        policy = Policy.load(self.policy)
        task, options, vehicle = _setting(policy, self.task, self.task_options)
        made = tasks.make(task, **options)
        seed = EVALUATION_SEED + self.seed
        record = fly(policy, made, episodes=1, seed=seed, vehicle=vehicle)
        with console.status(f"drawing {self.out}"):
            write_video(
                record.flight(vehicle),
                vehicle.compile(contact=made.contact),
                self.out,
                camera=self.camera,
                width=self.width,
                height=self.height,
                fps=self.fps,
            )
        console.print(f"wrote {self.out}")


@dataclasses.dataclass(frozen=True)
class Plot:
    """Draw the learning curve of a run again."""

    run_folder: tyro.conf.Positional[Path]
    """The run folder."""
    out: Path | None = None
    """The picture; by default learning_curve.png in the run folder."""

    def run(self) -> None:
        """Write the picture."""
        console.print(f"wrote {_draw_curve(self.run_folder, self.out or self.run_folder / CURVE)}")


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Measure the speed of every layer in one run, as rates and as shares of bare mj_step."""

    num_envs: int = 1024
    """Aircraft in the batch."""
    seconds: float = 2.0
    """Of each measurement."""
    repeats: int = 3
    """Of each; the best counts."""
    task: str = "hover"
    """The task that is flown."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Measure and print."""
        from quadrl.benchmark import benchmark

        if self.seconds <= 0 or self.repeats < 1:
            raise OptionError("seconds must be positive and repeats at least 1")
        measured = benchmark(
            self.task, num_envs=self.num_envs, seconds=self.seconds, repeats=self.repeats
        )
        if self.json:
            sys.stdout.write(json.dumps(measured) + "\n")
            return
        table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
        for column in ("what", "control steps/s", "of bare mj_step"):
            table.add_column(column, justify="left" if column == "what" else "right")
        for row in measured["rates"]:
            table.add_row(row["what"], f"{row['rate']:,.0f}", f"{row['share']:.2f}")
        console.print(table)
        console.print(f"\nmemory of 4,096 aircraft: {measured['memory_mb']:.0f} MB")
        console.print(f"[dim]{measured['machine']}[/dim]")


COMMANDS = {
    "tasks": Tasks,
    "train": Train,
    "evaluate": Evaluate,
    "render": Render,
    "plot": Plot,
    "benchmark": Benchmark,
}


def main(arguments: list[str] | None = None) -> None:
    """Run the command; what the user can mend is one line on stderr and exit code 2."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        chosen = tyro.cli(
            _commands(arguments),
            args=arguments,
            prog="quadrl",
            description="Reinforcement learning for quadrotors on MuJoCo.",
        )
        chosen.run()
    except (QuadrlError, OSError) as error:
        if os.environ.get("QUADRL_TRACEBACK"):
            raise
        Console(stderr=True, highlight=False, soft_wrap=True).print(
            f"quadrl: {error}", markup=False
        )
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


class _ProgressBar:
    """Steps, steps/s, return, success and time left, redrawn in place (or a line now and then)."""

    LINE_SECONDS = 5.0  # between two lines where nothing can be redrawn

    def __init__(self, config: TrainConfig) -> None:
        from rich import progress

        self._progress = progress.Progress(
            progress.TextColumn("[bold]{task.fields[task_name]}"),
            progress.BarColumn(bar_width=24),
            progress.TextColumn("{task.fields[report]}"),
            progress.TimeRemainingColumn(compact=True),
            console=console,
            disable=not console.is_terminal,
        )
        self._task_name = f"{config.task} {config.algo}"
        self._begun: tuple[int, float] | None = None
        self._last_line = 0.0
        self._figures: dict[str, float] = {}

    def __enter__(self) -> _ProgressBar:
        self._progress.start()
        self._row = self._progress.add_task("", task_name=self._task_name, report="", total=None)
        return self

    def __exit__(self, *error: object) -> None:
        self._progress.stop()

    def show(self, now: Progress) -> None:
        """Redraw after an iteration."""
        if self._begun is None:
            self._begun = (now.iteration - 1, 0.0 if now.iteration == 1 else now.seconds)
        first, since = self._begun
        share = (now.iteration - first) / now.iteration if now.iteration else 1
        rate = now.steps * share / max(now.seconds - since, 1e-9)
        self._figures |= now.figures
        report = (
            f"{now.steps:>9,} steps  {rate:>7,.0f}/s  "
            f"return {self._figures.get('return', float('nan')):>7.0f}  "
            f"success {100 * self._figures.get('success', 0.0):>3.0f} %"
        )
        self._progress.update(
            self._row, completed=now.iteration, total=now.iterations, report=report
        )
        last = now.iteration == now.iterations
        if not console.is_terminal and (last or now.seconds - self._last_line > self.LINE_SECONDS):
            self._last_line = now.seconds
            console.print(
                f"{self._task_name}  {100 * now.iteration / now.iterations:3.0f} %  {report}"
            )


def _commands(arguments: list[str]) -> Any:
    """The commands; a task has its own defaults for `train`."""
    named = [a for a in arguments[1:2] if a in tasks.TASKS]
    train = Train(config=recipe(named[0] if named else "hover"))
    annotated = [
        Annotated[
            kind,
            tyro.conf.subcommand(name, default=train)
            if kind is Train
            else tyro.conf.subcommand(name),
        ]
        for name, kind in COMMANDS.items()
    ]
    union: Any = annotated[0]
    for kind in annotated[1:]:
        union = union | kind
    return union


def _check_episodes(episodes: int) -> None:
    if not 1 <= episodes <= MAX_EPISODES:
        raise OptionError(f"episodes = {episodes}: 1 to {MAX_EPISODES} is allowed")


def _setting(
    policy: Policy, task: str, pairs: tuple[str, ...]
) -> tuple[str, dict[str, Any], Vehicle]:
    """Task, options and aircraft to fly a policy with.

    Raises:
        PolicyError: The policy cannot see what the task shows.
    """
    same = task in ("", policy.task)
    name = policy.task if same else task
    made = tasks.make(name)
    size = sum(part.size for part in made.observation.values())
    if size != len(policy.mean):
        raise PolicyError(
            f"a policy for {policy.task} sees {len(policy.mean)} numbers, and the task {name} "
            f"shows {size}: train one with quadrl train {name}"
        )
    options = dict(policy.metadata.get("task_options", {})) if same else {}
    vehicle = str(policy.metadata.get("vehicle", "paper"))
    check_choices([vehicle], VEHICLES, "vehicle")
    return name, options | parse_options(pairs), VEHICLES[vehicle]


def _evaluate(
    policy: Policy,
    task: str,
    options: dict[str, Any],
    vehicle: Vehicle,
    episodes: int,
    seed: int = 0,
) -> tuple[dict[str, Any], Record]:
    from quadrl.learning.evaluate import EVALUATION_SEED, fly, judge

    made = tasks.make(task, **options)
    record = fly(policy, made, episodes=episodes, seed=EVALUATION_SEED + seed, vehicle=vehicle)
    return {"task": task, "seed": seed} | judge(record), record


def _draw_curve(folder: Path, path: Path) -> Path:
    from quadrl.learning.figures import learning_curve, read_metrics

    config = read_config(folder)
    title = f"{config['task']}, {config['algo'].upper()}, seed {config['seed']}"
    return learning_curve(read_metrics(folder / "metrics.csv"), title, path)


def _draw_run(
    folder: Path, task: str, record: Record, vehicle: Vehicle, options: dict[str, Any], video: bool
) -> None:
    """The pictures of a run; without a graphics library the video is left out and said so."""
    from quadrl.learning.figures import trajectory

    with console.status("drawing"):
        _draw_curve(folder, folder / CURVE)
        trajectory(record, f"{task}: mean action of the policy", folder / TRAJECTORY)
        if not video:
            return
        from quadrl.rendering import RenderingUnavailable, write_video

        made = tasks.make(task, **options)
        try:
            write_video(
                record.flight(vehicle), vehicle.compile(contact=made.contact), folder / VIDEO
            )
        except RenderingUnavailable as error:
            console.print(f"[yellow]no video:[/yellow] {error}")


def _figures_table(judged: dict[str, Any]) -> Table:
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    for name, value in judged.items():
        table.add_row(name, f"{value:.4g}" if isinstance(value, float) else str(value))
    return table


def _sum_up(folder: Path, config: TrainConfig, judged: dict[str, Any]) -> None:
    """What was reached, where the files lie, what to try next."""
    survived = 100 * judged["survival_rate"]
    console.print(
        f"\n[bold]{config.task}[/bold] trained with {config.algo.upper()} in "
        f"{judged['training_s']:.1f} s of wall clock from the first step to the saved policy "
        f"(imports: {judged['imports_s']:.1f} s)\n"
        f"{judged['episodes']} episodes with the mean action: {survived:.0f} % to the end, "
        f"{100 * judged['success_rate']:.0f} % successful, error over the last 2 s "
        f"{100 * judged['position_error_m']:.1f} cm\n"
    )
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 2))
    meanings = {
        "policy.safetensors": "the policy",
        CURVE: "return, success and error over the training",
        TRAJECTORY: "flights of the evaluation",
        VIDEO: "one of them on video",
        EVALUATION: "the figures",
        "metrics.csv": "the training, row by row; TensorBoard: tensorboard --logdir " + str(folder),
        "config.json": "the resolved configuration",
        "checkpoint.safetensors": "to go on: quadrl train --resume " + str(folder),
    }
    for name, meaning in meanings.items():
        if (folder / name).exists():
            table.add_row(str(folder / name), f"[dim]{meaning}[/dim]")
    console.print(table)
    console.print(
        f"\nnext: quadrl render {folder} --camera chase --seed 7\n"
        f"      quadrl evaluate {folder} --episodes 1000\n"
        f"      quadrl tasks"
    )


def _describe(task: Task) -> None:
    """One task in full."""
    console.print(f"[bold]{task.name}[/bold]: {task.asks}")
    console.print(f"ends early: {task.ends}; time limit {task.horizon:g} s")
    console.print(f"success: {task.solved}\n")
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for column in ("observation", "entries", "unit", "meaning"):
        table.add_column(column)
    first = 0
    for name, part in task.observation.items():
        last = first + part.size
        table.add_row(name, f"{first}..{last - 1}", part.unit, part.meaning)
        first = last
    console.print(table)
    console.print(
        "\naction: four numbers in -1..1, change of the rotor speed commands from hover\n"
    )
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for column in ("option", "default"):
        table.add_column(column)
    for field in dataclasses.fields(task):
        table.add_row(field.name, str(getattr(task, field.name)))
    console.print(table)
