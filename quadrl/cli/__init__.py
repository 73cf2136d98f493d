"""The command `quadrl`; each of its commands has a module of its name."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import typing
import warnings
from collections.abc import Generator
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from tyro.conf import CascadeSubcommandArgs, Positional, UseAppendAction, arg

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.extras import needed
from quadrl.base.signals import IN_ORDER, Stopped, handling
from quadrl.base.validation import choice
from quadrl.base.version import __version__
from quadrl.cli import choices, console, parsing, train
from quadrl.cli.benchmark import Benchmark
from quadrl.cli.check import Check
from quadrl.cli.crosscheck import Crosscheck
from quadrl.cli.evaluate import Evaluate
from quadrl.cli.export import Export
from quadrl.cli.identify import Identify
from quadrl.cli.new import NewAircraft, NewTask
from quadrl.cli.plot import Plot
from quadrl.cli.render import Render
from quadrl.cli.replay import Replay
from quadrl.cli.robustness import Robustness
from quadrl.cli.runs import Runs
from quadrl.cli.study import Study
from quadrl.cli.tasks import Tasks
from quadrl.cli.train import Train
from quadrl.cli.view import View
from quadrl.core.record import import_own

SHELLS = ("bash", "zsh", "fish")


@choices.command
class Completion:
    """Print a script that completes commands, options and names with the tab key.

    bash: source <(quadrl completion bash). zsh: write it to a file _quadrl in a folder of fpath.
    """

    shell: Positional[Annotated[str, choices.words(SHELLS)]] = "bash"
    """The shell to complete in."""

    def run(self) -> None:
        """Print the script."""
        shell = choice("shell", self.shell, SHELLS)
        with choices.enforced():
            parse(["--tyro-print-completion", shell])


Command = (Tasks | Train | Study | Runs | Evaluate | Robustness | Render | View | Plot | Check
           | Identify | Replay | Export | Crosscheck | NewTask | NewAircraft
           | Benchmark | Completion)  # fmt: skip


def _spelt(kind: type) -> str:
    """The name of a command: new-task of NewTask."""
    return re.sub("(?<=.)(?=[A-Z])", "-", kind.__name__).lower()


COMMANDS = {_spelt(kind): kind for kind in typing.get_args(Command)}


@choices.command
class Quadrl:
    """Reinforcement learning for quadrotors on MuJoCo. quadrl --version prints the versions.

    Begin with quadrl train hover, which takes seconds and ends with a video. The documentation is
    in docs/ of the source; scripts/docs makes a site of it, with a search.
    """

    command: Annotated[Command, arg(name="")]
    own: Annotated[
        CascadeSubcommandArgs[UseAppendAction[tuple[Path, ...]]],
        arg(name="import", metavar="FILE", help_behavior_hint="(repeatable)"),
    ] = ()
    """A Python file that registers tasks and aircraft of your own."""
    quiet: CascadeSubcommandArgs[bool] = False
    """Print errors, warnings and what --json asks for, and nothing else."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command; an error that the user can fix is one line on stderr and exit code 2."""
    stderr = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
    words = sys.argv[1:] if arguments is None else arguments
    if words == ["--version"]:
        print(f"quadrl {__version__}, mujoco {version('mujoco')}, Python {sys.version.split()[0]}")
        return
    try:
        with console.piped(), _warned_in_a_line(stderr), handling(IN_ORDER):
            chosen = parse(words)
            console.own_files[:] = chosen.own
            console.console.quiet = chosen.quiet
            for path in chosen.own:
                import_own(path)
            with needed(f"quadrl {_spelt(type(chosen.command))}"):
                chosen.command.run()
    except (QuadrlError, OSError, MemoryError, RuntimeError) as error:
        said = console.reason(error)
        if os.environ.get("QUADRL_TRACEBACK") or said is None:
            raise
        stderr.print(f"quadrl: {said}")
        sys.exit(2)
    except KeyboardInterrupt as stop:
        stderr.print(f"quadrl: {stop.args[0] if stop.args else 'stopped'}")
        sys.exit(128 + (stop.number if isinstance(stop, Stopped) else signal.SIGINT))


def parse(words: list[str]) -> Quadrl:
    """Parse a command line; raise what is wrong with it in one line."""
    if words[:1] == ["train"] and {"-h", "--help"} & {*words}:
        train.show_defaults(words[1:])
    return parsing.parse(Quadrl, words or ["--help"], COMMANDS)


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
