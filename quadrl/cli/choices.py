"""The words that options choose from: help shows them, completion offers them.

The parser takes any word, since files of one's own add tasks and aircraft after it has parsed; what
is unknown is refused later, in one line that names the nearest.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import typing
from collections.abc import Callable, Generator, Iterable
from typing import Annotated, Any, ClassVar, TypeVar, dataclass_transform

from tyro.conf import Positional, arg
from tyro.constructors import PrimitiveConstructorSpec

from quadrl.aircraft.presets import VEHICLES
from quadrl.base.docstrings import docstrings
from quadrl.control import CONTROLLERS
from quadrl.core.scenario import GIVEN, Conditions
from quadrl.learning.defaults import ALGORITHMS, ALIASES
from quadrl.learning.log import WRITERS
from quadrl.learning.train_settings import KEEPS, MEMORIES, PAIRED
from quadrl.learning.variants import VARIANTS
from quadrl.tasks import TASKS

Kind = TypeVar("Kind")
_OFFERED: list[tuple[PrimitiveConstructorSpec[str], tuple[str, ...]]] = []


def words(known: Iterable[str], *others: str) -> PrimitiveConstructorSpec[str]:
    """A text that is one of the known words, or what help calls the others."""
    known = tuple(known)
    spec = PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join((*known, *others))}}}",
        instance_from_str=lambda given: given[0],
        is_instance=lambda value: isinstance(value, str),
        str_from_instance=lambda value: [value],
    )
    _OFFERED.append((spec, known))
    return spec


TaskName = Annotated[str, words(TASKS)]
Algorithm = Annotated[str, words((*ALGORITHMS, *ALIASES))]
ControllerName = Annotated[str, words(CONTROLLERS)]
VehicleName = Annotated[str, words(VEHICLES, "FILE.json")]
Camera = Annotated[str, words(("follow", "track", "chase", "onboard", "fixed"))]
SETTINGS = {
    "variant": Annotated[str, words(VARIANTS)],
    "algo": Algorithm,
    "memory": Annotated[str, words(MEMORIES)],
    "keep": Annotated[str, words(KEEPS)],
    "log": Annotated[str, words(WRITERS)],
    "phases": str,
}
"""Of settings, by name."""
FLAGS = {"from_run": "from"}
"""Of settings that cannot have the name of their flag in Python."""


@contextlib.contextmanager
def enforced() -> Generator[None]:
    """Let the parser take no other words, as it must for completion to offer them."""
    for spec, known in _OFFERED:
        object.__setattr__(spec, "choices", known)
    try:
        yield
    finally:
        for spec, _ in _OFFERED:
            object.__setattr__(spec, "choices", None)


def optional(kind: Any, default: Callable[[str], str], within: str = "") -> Any:
    """A dataclass of options that are empty by default: "not given".

    Args:
        kind: A dataclass or a TypedDict with a field for each option; a field that is a dataclass
            is a group of options, and `conditions` of a training are options of their own.
        default: What help says is used where an option is not given, from its whole name.
        within: The group that they are in, with a dot.
    """
    said = docstrings(Conditions) | docstrings(kind)
    fields: list[tuple[str, Any, Any]] = []
    flown = {k: v for k, v in typing.get_type_hints(Conditions).items() if k in GIVEN}
    hints = dict[str, Any]()
    for name, hint in typing.get_type_hints(kind).items():
        hints |= flown if name == "conditions" else {name: hint}
    for name, hint in hints.items():
        if typing.get_origin(hint) is ClassVar:
            continue
        show = functools.partial(lambda whole, _: default(whole), within + name)
        told = arg(name=FLAGS.get(name), help=said[name], help_behavior_hint=show)
        if name in PAIRED:
            fields.append((name, Annotated[tuple[str, ...], told], ()))
        elif word := _word(name):
            fields.append((name, Annotated[word, told], ""))
        elif dataclasses.is_dataclass(hint):
            group = optional(hint, default, within=f"{within}{name}.")
            made = dataclasses.field(default_factory=group)
            fields.append((name, Annotated[group, arg(help=said[name])], made))
        else:
            fields.append((name, Annotated[hint | None, told], None))
    return dataclasses.make_dataclass("Options", fields, frozen=True)


def _word(name: str) -> Any:
    """The type of an option that is a word, or a word or JSON; None for any other."""
    if name == "task":
        return Positional[TaskName]
    if name == "vehicle":
        return VehicleName
    how = GIVEN.get(name, {})
    if (given := how.get("given")) not in ("name", "json"):
        return SETTINGS.get(name)
    others = ["JSON"] if given == "json" else []
    return Annotated[str, words(how["names"], *others)] if "names" in how else str


@dataclass_transform(frozen_default=True)
def command(kind: type[Kind]) -> type[Kind]:
    """Make a class of options a frozen dataclass; help shows a default where there is one."""
    made = dataclasses.dataclass(frozen=True)(kind)
    hints = typing.get_type_hints(made, include_extras=True)
    for name in vars(made).get("__annotations__", {}):
        hint: Any = hints[name]
        if hasattr(hint, "__metadata__"):  # a hint of its own comes last, and counts
            made.__annotations__[name] = Annotated[(hint.__origin__, SHOWN, *hint.__metadata__)]
        else:
            made.__annotations__[name] = Annotated[hint, SHOWN]
    return made


def _default(label: str) -> str:
    return "" if label in ("", "''", "None") else f"(default: {label})"


SHOWN = arg(help_behavior_hint=_default)
