"""The command `quadrl`: tasks, train, evaluate, render, plot, benchmark."""

from __future__ import annotations

import dataclasses
import importlib.util
import itertools
import json
import os
import shlex
import sys
import time
from collections.abc import Container, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from quadrl import tasks
from quadrl.description import describe, observation_rows, option_rows, reward_rows
from quadrl.errors import QuadrlError
from quadrl.learning.config import (
    ALGORITHMS,
    CONFIG,
    RunError,
    TrainConfig,
    make_task,
    parse_options,
    read_config,
    recipe,
    write_text,
)
from quadrl.policy import Policy, PolicyError
from quadrl.task import OptionError, Task, check_choices
from quadrl.vehicle import VEHICLES, Vehicle

if TYPE_CHECKING:
    from quadrl.learning.evaluate import Controller, Record
    from quadrl.learning.train import Progress

console = Console()
EVALUATION = "evaluation.json"
CURVE, TRAJECTORY, VIDEO = "learning_curve.png", "trajectory.png", "flight.mp4"
MAX_EPISODES = 100_000


@dataclasses.dataclass(frozen=True)
class Tasks:
    """List the tasks, or one of them in full."""

    task: tyro.conf.Positional[str] = ""
    """Name of a task, to show it alone and with its options; none for all."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print what they ask, start from, end with, show, take and reward."""
        chosen = [self.task] if self.task else list(tasks.TASKS)
        described = [describe(tasks.make(name)) for name in chosen]
        if self.json:
            whole = {task.name: dataclasses.asdict(task) for task in described}
            sys.stdout.write(json.dumps(whole[self.task] if self.task else whole) + "\n")
            return
        table = _table(("task", "", ""))
        for task in described:
            said = {
                "asks": task.asks,
                "start": task.starts,
                "ends early": task.ends,
                "solved": task.solved,
                "horizon": f"{task.horizon:g} s",
            }
            for row, (what, text) in enumerate(said.items()):
                table.add_row("" if row else task.name, what, text)
            table.add_row()
        console.print(table)
        console.print(_table(*observation_rows(described)))
        console.print(f"\n[bold]action[/bold]  {escape(described[0].action)}\n", highlight=False)
        console.print(_table(*reward_rows(described)))
        if self.task:
            console.print("", _table(*option_rows(described[0])))
        else:
            _say("\nquadrl tasks NAME shows the options of one")


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a policy from nothing, evaluate it and draw it, into a run folder."""

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
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
            _say(f"going on with {folder} at iteration {training.iteration}")
        go_on = f"go on with it: {_again('train --resume', folder)}"
        try:
            with _ProgressBar(config) as bar:
                policy = training.run(bar.show)
            vehicle = VEHICLES[config.vehicle]
            task = make_task(config.task, config.options)
            judged, record = _evaluate(policy, task, vehicle, self.episodes)
            judged |= {"training_s": round(training.seconds, 2), "imports_s": round(imports, 2)}
            write_text(folder / EVALUATION, json.dumps(judged, indent=2))
            _draw_run(folder, config.task, record, vehicle, self.video)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"stopped; the run is kept, {go_on}") from None
        except OSError as error:
            raise RunError(f"{_reason(error)}; the run is kept, {go_on}") from error
        _sum_up(folder, config, judged)


@dataclasses.dataclass(frozen=True)
class _Pilot:
    """Who flies what: common to the commands that fly without learning."""

    policy: tyro.conf.Positional[str] = ""
    """A run folder, a .safetensors file, or the name of a task: then the policy that comes with
    quadrl flies it (a folder with the name of a task is written ./NAME)."""
    algo: str = ""
    """Of the policy that comes with quadrl, the algorithm that trained it; ppo by default."""
    controller: str = ""
    """A controller instead of a policy: geometric or lqr."""
    task: str = ""
    """The task; by default the one that the policy was trained for."""
    vehicle: str = ""
    """The aircraft; by default the one that the policy was trained with."""
    seed: int = 0
    """Of the episodes."""
    task_options: tuple[str, ...] = ()
    """Fields of the task that differ from the training's, such as horizon=5."""

    def setting(self) -> tuple[Controller, Task, Vehicle]:
        """Controller, task and aircraft.

        Raises:
            QuadrlError: They do not fit together, or are not there.
        """
        from quadrl import controllers

        _check_seed(self.seed)
        if bool(self.policy) == bool(self.controller):
            raise OptionError(
                "one of both is needed: a policy (a run folder, a .safetensors file, or a task for "
                "which one comes with quadrl), or "
                f"--controller {' or '.join(controllers.CONTROLLERS)} with --task"
            )
        if self.algo and self.policy not in tasks.TASKS:
            raise OptionError(
                f"--algo {self.algo} chooses among the policies that come with quadrl: give the "
                "name of a task, or leave it out"
            )
        if self.policy:
            shipped = self.policy in tasks.TASKS
            policy = (
                Policy.pretrained(self.policy, self.algo or "ppo")
                if shipped
                else Policy.load(self.policy)
            )
            name, options, vehicle = _setting(policy, self.task, self.task_options)
            if self.vehicle:
                check_choices([self.vehicle], VEHICLES, "vehicle")
                vehicle = VEHICLES[self.vehicle]
            return policy, make_task(name, options), vehicle
        check_choices([self.vehicle or "paper"], VEHICLES, "vehicle")
        vehicle = VEHICLES[self.vehicle or "paper"]
        task = make_task(self.task or "hover", parse_options(self.task_options))
        return controllers.make(self.controller, task, vehicle), task, vehicle


@dataclasses.dataclass(frozen=True)
class Evaluate(_Pilot):
    """Fly a policy's mean action, or a controller, through fresh episodes and judge it."""

    episodes: int = 100
    """Number of episodes."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print the figures, beside those of the geometric controller."""
        from quadrl import controllers

        _check_episodes(self.episodes)
        pilot, task, vehicle = self.setting()
        judged, _ = _evaluate(pilot, task, vehicle, self.episodes, self.seed)
        if self.json:
            sys.stdout.write(json.dumps(judged) + "\n")
            return
        columns = {self.controller or "policy": judged}
        if self.controller != "geometric":
            yardstick = controllers.make("geometric", task, vehicle)
            columns["geometric controller"], _ = _evaluate(
                yardstick, task, vehicle, self.episodes, self.seed
            )
        console.print(_figures_table(columns))


@dataclasses.dataclass(frozen=True)
class Render(_Pilot):
    """Draw a flight of a policy or a controller as a video."""

    out: Path = Path("flight.mp4")
    """The video."""
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

        _check_out(self.out)
        pilot, task, vehicle = self.setting()
        seed = EVALUATION_SEED + self.seed
        record = fly(pilot, task, episodes=1, seed=seed, vehicle=vehicle)
        with console.status(f"drawing {self.out}"):
            write_video(
                record.flight(vehicle),
                vehicle.compile(contact=task.contact),
                self.out,
                camera=self.camera,
                width=self.width,
                height=self.height,
                fps=self.fps,
            )
        _say(f"wrote {self.out}")


@dataclasses.dataclass(frozen=True)
class Plot:
    """Draw the learning curve of a run again, or those of several runs over each other."""

    run_folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders. Several are overlaid: a picture for each task, a curve for each algorithm with
    the spread over its runs."""
    out: Path | None = None
    """The picture; by default learning_curve.png in the run folder, or, of several runs,
    learning_curves_TASK.png here."""
    format: Literal["png", "pdf", "svg"] | None = None
    """Kind of the picture; png by default, or what the name in --out ends in."""

    def run(self) -> None:
        """Write the pictures."""
        out = self.out
        if self.format and out and out.suffix != f".{self.format}":
            raise OptionError(f"--out {out} is no .{self.format}: leave out --out or --format")
        if not self.run_folders:
            raise OptionError("which run? Give a run folder, or several: quadrl plot runs/*")
        if out:
            _check_out(out)
        kind = f".{self.format or 'png'}"
        if len(self.run_folders) == 1:
            (folder,) = self.run_folders
            _say(f"wrote {_draw_curve(folder, out or (folder / CURVE).with_suffix(kind))}")
            return
        for path in _draw_curves(self.run_folders, out, kind):
            _say(f"wrote {path}")


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Measure the speed of every layer in one run, as rates and as shares of bare mj_step."""

    num_envs: int = 1024
    """Aircraft in the batch."""
    seconds: float = 0.2
    """Of each measurement; short, since the speed of a machine drifts."""
    repeats: int = 30
    """Of each, in turns: the fastest is the rate, the median ratio of a turn the share."""
    task: str = "hover"
    """The task that is flown."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Measure and print."""
        from quadrl.benchmark import benchmark, rows, summary

        if self.seconds <= 0 or self.repeats < 1:
            raise OptionError("seconds must be positive and repeats at least 1")
        measured = benchmark(
            self.task, num_envs=self.num_envs, seconds=self.seconds, repeats=self.repeats
        )
        if self.json:
            sys.stdout.write(json.dumps(measured) + "\n")
            return
        table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
        for column in ("what", "control steps/s", "median", "of bare mj_step", "target"):
            table.add_column(column, justify="left" if column == "what" else "right")
        for row in rows(measured):
            table.add_row(*row)
        console.print(table)
        console.print(f"\n{summary(measured)}", highlight=False)


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
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    stderr = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
    try:
        _import_own(arguments)
        chosen = tyro.cli(
            _commands(arguments),
            args=arguments,
            prog="quadrl",
            description="Reinforcement learning for quadrotors on MuJoCo. --import FILE, anywhere, "
            "brings in tasks and aircraft of your own.",
        )
        chosen.run()
    except (QuadrlError, OSError) as error:
        if os.environ.get("QUADRL_TRACEBACK"):
            raise
        stderr.print(f"quadrl: {_reason(error) if isinstance(error, OSError) else error}")
        sys.exit(2)
    except KeyboardInterrupt as stop:
        stderr.print(f"quadrl: {stop.args[0] if stop.args else 'stopped'}")
        sys.exit(130)


_brought: list[Path] = []
"""The files named by `--import`."""


def _import_own(arguments: list[str]) -> None:
    """Run the files named by `--import FILE`, which register the user's own tasks and aircraft.

    Raises:
        OptionError: There is no such file.
    """
    _brought.clear()
    while "--import" in arguments:
        at = arguments.index("--import")
        if at + 1 == len(arguments) or not Path(arguments[at + 1]).is_file():
            named = arguments[at + 1 :][:1]
            raise OptionError(f"--import {' '.join(named)}: the path of a Python file is expected")
        path = Path(arguments[at + 1])
        del arguments[at : at + 2]
        spec: Any = importlib.util.spec_from_file_location(path.stem, path)
        module = importlib.util.module_from_spec(spec)
        sys.modules[path.stem] = module
        spec.loader.exec_module(module)
        _brought.append(path)


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
    """The commands; task, algorithm and aircraft have their own defaults for `train`."""
    named = [argument for argument in arguments if argument in tasks.TASKS]
    # Others than those known are refused by the configuration, which names the choices.
    algo = _given(arguments, "--algo", ALGORITHMS) or "ppo"
    vehicle = _given(arguments, "--vehicle", VEHICLES) or "paper"
    train = Train(config=recipe(named[0] if named else "hover", algo, vehicle))
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


def _given(arguments: list[str], option: str, known: Container[str]) -> str | None:
    """The last known value of an option."""
    values = [second for first, second in itertools.pairwise(arguments) if first == option]
    values += [w.partition("=")[2] for w in arguments if w.startswith(f"{option}=")]
    return next((value for value in reversed(values) if value in known), None)


def _say(text: str) -> None:
    """Print text with paths and commands, which are neither markup nor to be broken in two."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _reason(error: OSError) -> str:
    """What the system refused, in the words that a shell would use."""
    path = error.filename2 or error.filename
    return f"cannot read or write {path}: {error.strerror}" if path else str(error)


def _check_episodes(episodes: int) -> None:
    if not 1 <= episodes <= MAX_EPISODES:
        raise OptionError(f"episodes = {episodes}: 1 to {MAX_EPISODES} is allowed")


def _check_out(path: Path) -> None:
    """Make the folder of a file that is to be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(
            f"cannot write {path}: {path.parent} is no folder and cannot be made one; choose "
            "another with --out"
        ) from error


def _check_seed(seed: int) -> None:
    if seed < 0:
        raise OptionError(f"seed = {seed}: at least 0 is allowed")


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
    options = policy.metadata.get("task_options", {}) if same else {}
    vehicle = str(policy.metadata.get("vehicle", "paper"))
    check_choices([vehicle], VEHICLES, "vehicle")
    return name, options | parse_options(pairs), VEHICLES[vehicle]


def _evaluate(
    pilot: Controller, task: Task, vehicle: Vehicle, episodes: int, seed: int = 0
) -> tuple[dict[str, Any], Record]:
    from quadrl.learning.evaluate import EVALUATION_SEED, fly, judge

    record = fly(pilot, task, episodes=episodes, seed=EVALUATION_SEED + seed, vehicle=vehicle)
    return {"task": task.name, "seed": seed} | judge(record), record


def _read_run(folder: Path) -> dict[str, Any]:
    config = read_config(folder)
    if missing := {"task", "algo", "seed"} - set(config):
        raise RunError(f"{folder / CONFIG} does not say the run's {', '.join(sorted(missing))}")
    return config


def _draw_curves(folders: tuple[Path, ...], out: Path | None, kind: str) -> list[Path]:
    """A picture for each task of several runs; what is no run yet is left out and said so.

    Raises:
        RunError: None of the folders holds a run that has begun.
    """
    from quadrl.learning.figures import FigureError, learning_curves, read_metrics

    runs: dict[str, dict[str, list[Any]]] = {}
    for folder in folders:
        try:
            config = _read_run(folder)
            metrics = read_metrics(folder / "metrics.csv")
        except (RunError, FigureError) as error:
            _say(f"left out: {error}")
            continue
        runs.setdefault(config["task"], {}).setdefault(config["algo"], []).append(metrics)
    if not runs:
        raise RunError(f"none of the {len(folders)} folders holds a run to plot")
    base = out or Path(f"learning_curves{kind}")
    paths = {task: base.with_name(f"{base.stem}_{task}{base.suffix}") for task in runs}
    if out and len(runs) == 1:
        paths = dict.fromkeys(runs, out)
    return [learning_curves(groups, task, paths[task]) for task, groups in runs.items()]


def _draw_curve(folder: Path, path: Path) -> Path:
    from quadrl.learning.figures import learning_curve, read_metrics

    config = _read_run(folder)
    title = f"{config['task']}, {str(config['algo']).upper()}, seed {config['seed']}"
    return learning_curve(read_metrics(folder / "metrics.csv"), title, path)


def _draw_run(folder: Path, task: str, record: Record, vehicle: Vehicle, video: bool) -> None:
    """The pictures of a run; without a graphics library the video is left out and said so."""
    from quadrl.learning.figures import trajectory

    with console.status("drawing"):
        _draw_curve(folder, folder / CURVE)
        trajectory(record, f"{task}: mean action of the policy", folder / TRAJECTORY)
        if not video:
            return
        from quadrl.rendering import RenderingUnavailable, write_video

        try:
            model = vehicle.compile(contact=record.task.contact)
            write_video(record.flight(vehicle), model, folder / VIDEO)
        except RenderingUnavailable as error:
            _say(f"no video: {error}")


def _figures_table(columns: dict[str, dict[str, Any]]) -> Table:
    """Figures in rows, who flew them in columns."""
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    table.add_column("")
    for pilot in columns:
        table.add_column(pilot, justify="right")
    for name in next(iter(columns.values())):
        values = [figures[name] for figures in columns.values()]
        shown = [f"{v:.4g}" if isinstance(v, float) else str(v) for v in values]
        table.add_row(name, *shown)
    return table


def _sum_up(folder: Path, config: TrainConfig, judged: dict[str, Any]) -> None:
    """What was reached, where the files lie, what to try next."""
    survived = 100 * judged["survival_rate"]
    console.print(
        f"\n[bold]{config.task}[/bold] trained with {config.algo.upper()} in "
        f"{judged['training_s']:.1f} s of wall clock from the first step to the saved policy "
        f"(imports: {judged['imports_s']:.1f} s; engine: {config.engine})\n"
        f"{judged['episodes']} episodes in MuJoCo with the mean action: {survived:.0f} % to the "
        f"end, {100 * judged['success_rate']:.0f} % successful, error over the last 2 s "
        f"{100 * judged['position_error_m']:.1f} cm\n"
    )
    meanings = {
        "policy.safetensors": "the policy",
        CURVE: "return, success and error over the training",
        TRAJECTORY: "flights of the evaluation",
        VIDEO: "one of them on video",
        EVALUATION: "the figures",
        "metrics.csv": f"the training, row by row; also: tensorboard --logdir {folder}",
        CONFIG: "the resolved configuration",
        "checkpoint.safetensors": f"to go on: {_again('train --resume', folder)}",
    }
    _say(f"in {folder}")
    for name, meaning in meanings.items():
        if (folder / name).exists():
            _say(f"  {name:<22}  {meaning}")
    _say(
        f"\nnext: {_again('render', folder)} --camera chase --seed 7\n"
        f"      {_again('evaluate', folder)} --episodes 1000\n"
        f"      {_again('tasks')}"
    )


def _again(command: str, *folder: Path) -> str:
    """A command as it has to be typed: with the files that brought in what the run needs."""
    brought = [word for path in _brought for word in ("--import", str(path))]
    return shlex.join(["quadrl", *brought, *command.split(), *map(str, folder)])


def _table(head: Sequence[str], rows: Iterable[Sequence[str]] = ()) -> Table:
    """A table without lines; its texts are no markup."""
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for k, column in enumerate(head):
        table.add_column(column, no_wrap=k == 0)
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    return table
