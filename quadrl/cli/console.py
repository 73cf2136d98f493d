"""Printing for the commands."""

from __future__ import annotations

import contextlib
import json
import shlex
import signal
import sys
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from quadrl.base.errors import QuadrlError
from quadrl.base.signals import Stopped, handling
from quadrl.evaluation.controllers import comes_with_quadrl

PADDING, NARROWEST = 2, 12
"""Spaces behind a column of a table, and characters that a folded one has at least."""
console = Console()
own_files: list[Path] = []
"""The files named by `--import`."""


def say(text: str) -> None:
    """Print text whose paths and commands are not to be broken over lines."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def print_json(data: Any) -> None:
    """Print one JSON object, with --quiet as well."""
    print(json.dumps(data))


def make_table(rows: Sequence[Sequence[str]], numbers: int = 0) -> Table:
    """A table without lines, whose texts are no markup; the last columns hold `numbers`.

    The first row is its head. Where the terminal is narrow, texts are broken between words; where
    that is not enough, the column with the longest word is broken within it.
    """
    table = Table(box=None, header_style="bold", padding=(0, PADDING, 0, 0))
    texts = len(rows[0]) - numbers
    least = [
        max(len(word) for cell in column for word in ("", *(cell.split() if k < texts else [cell])))
        for k, column in enumerate(zip(*rows, strict=True))
    ]
    if texts:
        longest = max(range(texts), key=least.__getitem__)
        over = sum(least) + PADDING * len(least) - console.width
        least[longest] = min(least[longest], max(NARROWEST, least[longest] - over))
    for k, column in enumerate(rows[0]):
        justify = "left" if k < texts else "right"
        table.add_column(escape(column), min_width=least[k], justify=justify, overflow="fold")
    for row in rows[1:]:
        table.add_row(*(escape(cell) for cell in row))
    return table


def again(command: str, *folder: Path) -> str:
    """A command line for a run, which remembers its --import, or with the options of this one."""
    own = [word for path in own_files for word in ("--import", str(path)) if not folder]
    # A bare name may be that of a policy that comes with quadrl.
    where = [f"./{path}" if comes_with_quadrl(str(path)) else str(path) for path in folder]
    return shlex.join(["quadrl", *own, *command.split(), *where])


@contextlib.contextmanager
def piped() -> Generator[None]:
    """End quietly where nobody reads the output to its end, as in `quadrl tasks | head -1`."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        console.on_broken_pipe()


@contextlib.contextmanager
def going_on() -> Generator[None]:
    """Say, after a Ctrl-C or a SIGTERM, that the same command goes on."""

    def stop(number: int, _: Any) -> None:
        raise Stopped(number)

    try:
        with handling({signal.SIGTERM: stop}):
            yield
    except KeyboardInterrupt as stopped:
        words = ["quadrl", *sys.argv[1:]]
        stopped.args = (f"stopped; the same command goes on: {shlex.join(words)}",)
        raise


def reason(error: Exception) -> str | None:
    """What an error that the user can mend says, in a line; None where it is another.

    That is one of quadrl, one of the system, in a shell's words, or one of Python, NumPy, MuJoCo
    or torch that says that there is no memory left.
    """
    if isinstance(error, OSError):
        path = error.filename2 or error.filename
        return f"cannot read or write {path}: {error.strerror}" if path else str(error)
    if isinstance(error, QuadrlError):
        return str(error)
    said = " ".join(str(error).split())
    if isinstance(error, MemoryError) or any(words in said.lower() for words in OUT_OF_MEMORY):
        return f"there is not enough memory: {said or type(error).__name__}"
    return None


OUT_OF_MEMORY = ("allocate memory", "out of memory", "bad_alloc", "could not allocate")
