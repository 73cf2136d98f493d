"""What a task is, in words and numbers: for the command line, the README and the contract."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Sequence
from typing import Any

from quadrl.task import Task
from quadrl.vehicle import Vehicle

Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""The head of a table, and its rows."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """Some numbers of the flat observation."""

    name: str
    first: int
    last: int
    unit: str
    meaning: str


@dataclasses.dataclass(frozen=True)
class Term:
    """A term of the reward; the weight is None where the task has no option of that name."""

    name: str
    weight: float | None
    meaning: str


@dataclasses.dataclass(frozen=True)
class Option:
    """A field of the task."""

    name: str
    value: Any
    meaning: str


@dataclasses.dataclass(frozen=True)
class Description:
    """All that is to be known of a task before it is flown."""

    name: str
    asks: str
    starts: str
    ends: str
    solved: str
    horizon: float  # [s]
    observation: tuple[Entry, ...]
    action: str
    reward: tuple[Term, ...]
    options: tuple[Option, ...]


def describe(task: Task, vehicle: Vehicle | None = None) -> Description:
    """A task, flown by an aircraft (None: the paper's)."""
    vehicle, texts = vehicle or Vehicle(), docstrings(type(task))
    entries, first = [], 0
    for name, part in task.observation.items():
        entries.append(Entry(name, first, first + part.size - 1, part.unit, part.meaning))
        first += part.size
    weights = ((term, f"{term}_weight") for term in task.term_names(vehicle))
    options = [field.name for field in dataclasses.fields(task)]
    return Description(
        name=task.name,
        asks=task.asks,
        starts=task.starts,
        ends=task.ends,
        solved=task.solved,
        horizon=task.horizon,
        observation=tuple(entries),
        action=describe_action(vehicle),
        reward=tuple(
            Term(term, getattr(task, weight, None), texts.get(weight, ""))
            for term, weight in weights
        ),
        options=tuple(
            Option(name, getattr(task, name), texts.get(name, ""))
            for name in options
            if name != "horizon" and not name.endswith("_weight")
        ),
    )


def describe_action(vehicle: Vehicle) -> str:
    """What the numbers of an action mean."""
    return (
        f"Four numbers in [-1, 1], one a rotor: the change of its speed command from hover "
        f"({vehicle.hover_speed:.1f} rad/s), {vehicle.action_scale:g} rad/s at 1; commands stay "
        f"within 0 and {vehicle.max_speed:.1f} rad/s"
    )


def observation_rows(described: Sequence[Description]) -> Rows:
    """The entries of the flat observation, and which tasks have them if not all."""
    entries = {entry.name: entry for task in described for entry in task.observation}
    rows = []
    for name, entry in entries.items():
        having = [task.name for task in described if entry in task.observation]
        where = "" if len(having) == len(described) else f" (only {', '.join(having)})"
        rows.append((name, f"{entry.first}..{entry.last}", entry.unit, entry.meaning + where))
    return ("observation", "numbers", "unit", "meaning and frame"), rows


def reward_rows(described: Sequence[Description]) -> Rows:
    """The terms of the reward, their usual weight, and which tasks have another."""
    found: dict[str, list[tuple[str, Term]]] = {}
    for task in described:
        for term in task.reward:
            found.setdefault(term.name, []).append((task.name, term))
    rows = []
    for name, terms in found.items():
        (first, usual), *_ = terms
        alone = len(described) > 1 and first != described[0].name  # not a term of all tasks
        others = [(task, t) for task, t in terms if alone or t.weight != usual.weight]
        differs = ", ".join(f"{task} {_weight(term)}" for task, term in others)
        rows.append((name, usual.meaning, "" if alone else _weight(usual), differs))
    head = ("reward", "meaning", "weight", "where it differs")
    return (head, rows) if len(described) > 1 else (head[:3], [row[:3] for row in rows])


def option_rows(described: Description) -> Rows:
    """The options of a task."""
    rows = [
        (o.name, f"{o.value:g}" if isinstance(o.value, float) else str(o.value), o.meaning)
        for o in described.options
    ]
    return ("option", "default", "meaning"), rows


def _weight(term: Term) -> str:
    return "of the task" if term.weight is None else f"{term.weight:g}"


def docstrings(kind: type) -> dict[str, str]:
    """The docstrings under the fields of a dataclass and of its bases, each in one line."""
    found: dict[str, str] = {}
    for base in reversed([c for c in kind.__mro__ if dataclasses.is_dataclass(c)]):
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(definition, ast.ClassDef)
        for field, text in zip(definition.body, definition.body[1:], strict=False):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
            ):
                found[field.target.id] = " ".join(str(text.value.value).split()).rstrip(".")
    return found
