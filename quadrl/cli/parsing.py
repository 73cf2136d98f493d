"""The parser of the command line, whose complaints are one line each."""

from __future__ import annotations

import argparse
import contextlib
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from quadrl.base.errors import QuadrlError
from quadrl.base.validation import choice
from quadrl.cli import choices
from quadrl.core.record import import_own
from quadrl.learning import foreign
from quadrl.learning.config import TrainConfig
from quadrl.learning.defaults import algorithm_of
from quadrl.tasks import TASKS

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
        choice("command", command, commands, known_as=foreign.COMMANDS)
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
    here = PROGRAM if command.startswith("-") else f"{PROGRAM} {command}"
    where = f"{here} --help"
    if found := re.search(r"Error parsing --(\S+): .*? matching (.*?) could .*? \[(.*?)\]", text):
        name, kind, given = found.groups()
        return f"{name} = {given}: must be {KINDS.get(kind, kind)}"
    if found := re.search(r"Unrecognized (?:or misplaced )?options: ([^\s,]+)", text):
        return f"{_unknown(found[1].partition('=')[0], box, command, words)}; see {where}"
    if found := re.search(r"Missing value for argument '[(']*([^\s',)]+)", text):
        return f"{found[1]} needs a value; see {where}"
    if found := re.search(r"Missing from .*?: (.*?) \(required\)", text):
        return f"missing: {found[1]} See {where}"
    return f"{text.partition('For full helptext')[0].strip()}; see {where}"


def _unknown(word: str, box: str, command: str, words: Sequence[str]) -> str:
    """What is wrong with a word that the command does not take."""
    if not word.startswith("-"):
        return f"{word} is one word too many"
    like = rf"(?:you meant|similar to {re.escape(word)}):(.*?)(?:similar to|For full)"
    found = re.search(like, box, re.DOTALL)
    similar = found[1] if found else ""
    having: dict[str, list[str]] = {}  # options like it, and the commands that have them
    option = ""
    for name, other in re.findall(r"\n. {5}(--[\w.-]+)|in quadrl (\w+)", similar):
        option = name or option
        having.setdefault(option, []).extend([other] * bool(other))
    if others := having.get(word):
        more = ", ..." * ("[...]" in similar)
        where = f"quadrl {command}; commands with it: {', '.join(others)}{more}"
        return f"{word} is not an option of {where}"
    own = (name for name, others in having.items() if command in others and "." not in name)
    meant = next(own, "")
    with contextlib.suppress(QuadrlError):  # the algorithm may be unknown, too
        if command == "train":
            task, given = trained(words)
            algo = algorithm_of(task, given["algo"], given["variant"])
            known = foreign.setting(word.strip("-"), algo)
            if " " in known:
                return f"{word} is an unknown option; {known}"
            known = choices.FLAGS.get(known, known).replace("_", "-")
            meant = f"--{known}" if known else meant
    hint = f" (did you mean {meant}?)" if meant else ""
    return f"{word} is an unknown option{hint}"


def trained(words: Iterable[str]) -> tuple[str, dict[str, Any]]:
    """The task that words behind `quadrl train` name, and its algorithm, aircraft and variant.

    The files that `--import` names are imported, since they may register them.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("algo", "vehicle", "variant"):
        parser.add_argument(f"--{name}", nargs="?")
    parser.add_argument("--import", action="append", nargs="?", default=[])
    known, others = parser.parse_known_args([*words])
    given = vars(known)
    with contextlib.suppress(QuadrlError):  # who imports them next says what is wrong
        for path in given.pop("import"):
            import_own(Path(path))
    return next((word for word in others if word in TASKS), TrainConfig.task), given
