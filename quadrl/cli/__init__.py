"""The command `quadrl`: tasks, train, evaluate, render, plot, benchmark."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from tyro.conf import CascadeSubcommandArgs, DisallowNone, UseAppendAction, arg, subcommand

from quadrl.cli import console
from quadrl.cli.benchmark import Benchmark
from quadrl.cli.evaluate import Evaluate
from quadrl.cli.plot import Plot
from quadrl.cli.render import Render
from quadrl.cli.tasks import Tasks
from quadrl.cli.train import Train
from quadrl.errors import QuadrlError

Command = (
    Annotated[Tasks, subcommand("tasks")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Render, subcommand("render")]
    | Annotated[Plot, subcommand("plot")]
    | Annotated[Benchmark, subcommand("benchmark")]
)


@dataclasses.dataclass(frozen=True)
class Quadrl:
    """Reinforcement learning for quadrotors on MuJoCo."""

    command: Annotated[Command, arg(name="")]
    own: Annotated[
        CascadeSubcommandArgs[UseAppendAction[tuple[Path, ...]]],
        arg(name="import", metavar="FILE", help_behavior_hint="(repeatable)"),
    ] = ()
    """A Python file that registers tasks and aircraft of your own."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command; an error that the user can mend is one line on stderr and exit code 2."""
    stderr = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
    try:
        chosen = tyro.cli(Quadrl, args=arguments, prog="quadrl", config=(DisallowNone,))
        console.own_files[:] = chosen.own
        for path in chosen.own:
            _import(path)
        chosen.command.run()
    except (QuadrlError, OSError) as error:
        if os.environ.get("QUADRL_TRACEBACK"):
            raise
        said = console.reason(error) if isinstance(error, OSError) else error
        stderr.print(f"quadrl: {said}")
        sys.exit(2)
    except KeyboardInterrupt as stop:
        stderr.print(f"quadrl: {stop.args[0] if stop.args else 'stopped'}")
        sys.exit(130)


def _import(path: Path) -> None:
    """Run a file, which registers the user's own tasks and aircraft.

    Raises:
        QuadrlError: There is no such file.
    """
    if not path.is_file():
        raise QuadrlError(name="--import", value=str(path), allowed="the path of a Python file")
    spec: Any = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
