"""The parser of the command line, whose complaints are one line each."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterable, Sequence
from typing import TypeVar

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from quadrl.base.errors import QuadrlError
from quadrl.base.validation import choice

Parsed = TypeVar("Parsed")
NUMBERS = ConstructorRegistry()
PROGRAM = "quadrl"
KINDS = {
    "INT": "a whole number",
    "FLOAT": "a number",
    "{[INT [INT ...]]}": "whole numbers with spaces between them",
}
"""What an option takes, by the parser's name for it."""
REPEATED = ("robustness", "--controller")
"""The command and its option that may be given several times."""


def parse(kind: type[Parsed], words: Sequence[str], commands: Iterable[str]) -> Parsed:
    """Parse the words of a command line.

    Args:
        kind: The class of all commands and their options.
        words: The words behind the name of the program.
        commands: Names of the commands.

    Raises:
        QuadrlError: A command or an option is unknown, given twice, without a value, or with one
            that cannot be read.
        SystemExit: Help was asked for; it has been printed.
    """
    command = _command(words)
    if command and not command.startswith("-"):
        choice("command", command, commands)
    _refuse_repetition(words)
    complaints = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaints):
            return tyro.cli(
                kind,
                args=words,
                prog=PROGRAM,
                registry=NUMBERS,
                config=(tyro.conf.DisallowNone,),
            )
    except SystemExit as end:
        if not end.code:
            raise
        raise QuadrlError(_in_a_line(complaints.getvalue(), words)) from None


@NUMBERS.primitive_rule
def _whole_number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[int] | None:
    """Read 1e6 as a whole number, too."""
    if info.type is not int:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda given: _whole(given[0]),
        is_instance=lambda value: isinstance(value, int),
        str_from_instance=lambda value: [str(value)],
    )


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        value = float(text)
        if not value.is_integer():
            raise ValueError(text) from None
        return int(value)


def _command(words: Sequence[str]) -> str | None:
    """The first word that is neither `--quiet`, `--import` nor its file."""
    rest = iter(words)
    for word in rest:
        if word == "--import":
            next(rest, None)
        elif word != "--quiet" and not word.startswith("--import="):
            return word
    return None


def _refuse_repetition(words: Sequence[str]) -> None:
    """Refuse an option that is given twice, since the last one would win without a word."""
    seen = set()
    for word in words:
        if not re.match(r"--[a-z]", word):
            continue
        name = word.partition("=")[0].replace("_", "-").replace("--no-", "--", 1)
        if name in seen and name != "--import" and (_command(words), name) != REPEATED:
            raise QuadrlError(name="option", value=name, allowed="given once")
        seen.add(name)


def _in_a_line(box: str, words: Sequence[str]) -> str:
    """What the parser draws in a box of several lines, in one."""
    text = " ".join(re.sub(r"[╭╮╰╯│─|+]|-{3,}", " ", box).split())
    command = _command(words) or "-"
    where = f"{PROGRAM} --help" if command.startswith("-") else f"{PROGRAM} {command} --help"
    if found := re.search(r"Error parsing --(\S+): .*? matching (.*?) could .*? \[(.*?)\]", text):
        name, kind, given = found.groups()
        return f"{name} = {given}: must be {KINDS.get(kind, kind)}"
    if found := re.search(r"Unrecognized options: (.*?) (?:Perhaps|Available|For full)", text):
        meant = re.search(r"Perhaps you meant: .*?(--[\w.-]+)", text)
        hint = f" (did you mean {meant[1]}?)" if meant else ""
        first = found[1].partition(",")[0]
        kind = "an unknown option" if first.startswith("-") else "one word too many"
        return f"{first} is {kind}{hint}; see {where}"
    if found := re.search(r"Missing value for argument '(\S+)'", text):
        return f"{found[1]} needs a value; see {where}"
    if found := re.search(r"Missing from .*?: (.*?) \(required\)", text):
        return f"missing: {found[1]} See {where}"
    return f"{text.partition('For full helptext')[0].strip()}; see {where}"
