"""The catalogue of tasks: every registered task by its name."""

from __future__ import annotations

from typing import Any

from quadrl.base.validation import IN_A_FILE, choice, registered
from quadrl.core.task import Task

TASKS: dict[str, type[Task]] = {}
"""Every registered task by name."""


def register(task: type[Task]) -> type[Task]:
    """Add a task to the catalogue, so that every API knows it by its name.

    Raises:
        QuadrlError: It is not a Task subclass with a name, or another task has the name.
    """
    TASKS[registered("task", task, Task, TASKS)] = task
    return task


def make(name: str | Task, **options: Any) -> Task:
    """The task of a name with some options changed.

    Args:
        name: A name of the catalogue, or a task already made.
        **options: Fields of the task.

    Raises:
        QuadrlError: Unknown task or option; the message lists the choices.
    """
    task = name if isinstance(name, Task) else TASKS[choice("task", name, TASKS, IN_A_FILE)]()
    return task.replace(**options)
