"""The catalogue of tasks: every registered task by its name."""

from __future__ import annotations

from typing import Any

from quadrl.base.validation import IN_A_FILE, choice, registered
from quadrl.core.task import Task

TASKS: dict[str, type[Task]] = {}
"""Every registered task by name, but for those in `COMPOSED`."""
COMPOSED: dict[str, type[Task]] = {}
"""Tasks that are made of others, by name: no API lists them, since an environment of theirs flies
several."""


def register(task: type[Task]) -> type[Task]:
    """Add a task to the catalogue, so that every API knows it by its name.

    Raises:
        QuadrlError: It is not a Task subclass with a name, or another task has the name.
    """
    TASKS[registered("task", task, Task, TASKS | COMPOSED)] = task
    return task


def kind(name: str | Task) -> type[Task]:
    """The class of a task already made, or of a name, as for `make`."""
    if isinstance(name, Task):
        return type(name)
    return COMPOSED[name] if name in COMPOSED else TASKS[choice("task", name, TASKS, IN_A_FILE)]


def make(name: str | Task, **options: Any) -> Task:
    """The task of a name with some options changed.

    Args:
        name: A name of the catalogue, or a task already made.
        **options: Fields of the task.

    Raises:
        QuadrlError: Unknown task or option; the message lists the choices.
    """
    return name.replace(**options) if isinstance(name, Task) else kind(name).of({}, **options)
