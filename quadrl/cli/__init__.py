"""The command `quadrl`; each of its commands has a module of its name."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import inspect
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Generator
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from tyro.conf import CascadeSubcommandArgs, DisallowNone, UseAppendAction, arg, subcommand

from quadrl import __version__
from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.cli import choices, console
from quadrl.cli.benchmark import Benchmark
from quadrl.cli.check import Check
from quadrl.cli.completion import Completion
from quadrl.cli.evaluate import Evaluate
from quadrl.cli.plot import Plot
from quadrl.cli.render import Render
from quadrl.cli.robustness import Robustness
from quadrl.cli.study import Study
from quadrl.cli.tasks import Tasks
from quadrl.cli.train import Train
from quadrl.cli.view import View
from quadrl.signals import IN_ORDER, Stopped, handling
from quadrl.tasks import TASKS

Command = (
    Annotated[Tasks, subcommand("tasks")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Study, subcommand("study")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Robustness, subcommand("robustness")]
    | Annotated[Render, subcommand("render")]
    | Annotated[View, subcommand("view")]
    | Annotated[Plot, subcommand("plot")]
    | Annotated[Check, subcommand("check")]
    | Annotated[Benchmark, subcommand("benchmark")]
    | Annotated[Completion, subcommand("completion")]
)


@dataclasses.dataclass(frozen=True)
class Quadrl:
    """Reinforcement learning for quadrotors on MuJoCo. quadrl --version prints the versions."""

    command: Annotated[Command, arg(name="")]
    own: Annotated[
        CascadeSubcommandArgs[UseAppendAction[tuple[Path, ...]]],
        arg(name="import", metavar="FILE", help_behavior_hint="(repeatable)"),
    ] = ()
    """A Python file that registers tasks and aircraft of your own."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command; an error that the user can mend is one line on stderr and exit code 2."""
    stderr = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
    words = sys.argv[1:] if arguments is None else arguments
    if words == ["--version"]:
        print(f"quadrl {__version__}, mujoco {version('mujoco')}, Python {sys.version.split()[0]}")
        return
    try:
        with _warned_in_a_line(stderr), handling(IN_ORDER):
            chosen = parse(words)
            console.own_files[:] = chosen.own
            for path in chosen.own:
                import_own(path)
            chosen.command.run()
    except (QuadrlError, OSError) as error:
        if os.environ.get("QUADRL_TRACEBACK"):
            raise
        said = console.reason(error) if isinstance(error, OSError) else error
        stderr.print(f"quadrl: {said}")
        sys.exit(2)
    except (MemoryError, RuntimeError) as error:
        if os.environ.get("QUADRL_TRACEBACK") or not console.is_of_memory(error):
            raise
        stderr.print(f"quadrl: there is not enough memory: {console.in_a_line(error)}")
        sys.exit(2)
    except KeyboardInterrupt as stop:
        stderr.print(f"quadrl: {stop.args[0] if stop.args else 'stopped'}")
        sys.exit(128 + (stop.number if isinstance(stop, Stopped) else signal.SIGINT))


def parse(words: list[str], *, enforced: bool = False) -> Quadrl:
    """What the words of a command line ask for; prints what is wrong with them and exits with 2."""
    rules = choices.registry(enforced)
    return tyro.cli(Quadrl, args=words, prog="quadrl", config=(DisallowNone,), registry=rules)


@contextlib.contextmanager
def _warned_in_a_line(stderr: Console) -> Generator[None]:
    """Print each of quadrl's own warnings once, in one line; others are printed as Python does."""
    with warnings.catch_warnings():
        warnings.simplefilter("default", QuadrlWarning)
        usual, said = warnings.showwarning, set()

        def show(message: Warning | str, category: type[Warning], *where: Any) -> None:
            if issubclass(category, QuadrlWarning):
                if str(message) not in said:  # from wherever it comes
                    stderr.print(f"quadrl: warning: {message}")
                said.add(str(message))
            else:
                usual(message, category, *where)

        warnings.showwarning = show
        yield


def import_own(path: Path) -> None:
    """Run a file, which registers the user's own tasks and aircraft.

    Raises:
        QuadrlError: There is no such file, or it fails, or a task in it breaks a rule; the message
            names the file and the line.
    """
    if not path.is_file():
        raise QuadrlError(name="--import", value=str(path), allowed="the path of a Python file")
    known = set(TASKS)
    spec: Any = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    with _located(path):
        spec.loader.exec_module(module)
    for name in TASKS.keys() - known:
        from quadrl.testing import check_rules

        kind = TASKS[name]
        with _located(path, inspect.getsourcelines(kind)[1]):
            check_rules(kind)


@contextlib.contextmanager
def _located(path: Path, line: int | None = None) -> Generator[None]:
    """Report a failure with the last line of the user's file that led to it, or a given one."""
    try:
        yield
    except Exception as error:
        frames, cause = [], error
        while cause is not None:
            frames += traceback.extract_tb(cause.__traceback__)
            cause = cause.__cause__
        lines = [
            frame.lineno for frame in frames if Path(frame.filename).resolve() == path.resolve()
        ]
        line = error.lineno if isinstance(error, SyntaxError) else (lines or [line])[-1]
        where = f"{path}, line {line}" if line else str(path)
        # What a check of quadrl says is a sentence; what Python says needs its kind.
        said = error if isinstance(error, (AssertionError, QuadrlError)) else repr(error)
        raise QuadrlError(f"{where}: {said}") from error
