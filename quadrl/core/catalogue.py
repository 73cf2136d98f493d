"""The catalogue of tasks: every task by its name, whoever registered it."""

from __future__ import annotations

from typing import Any, cast

from quadrl.base.errors import QuadrlError
from quadrl.base.validation import choice
from quadrl.core.task import Task

TASKS: dict[str, type[Task]] = {}
"""Every registered task by name."""


def register(task: type[Task]) -> type[Task]:
    """Add a task to the catalogue, so that every API knows it by its name.

    Raises:
        QuadrlError: It is not a Task subclass with a name, or another task has the name.
    """
    given, name = cast(Any, task), getattr(task, "name", None)
    named = isinstance(given, type) and issubclass(given, Task) and isinstance(name, str)
    if not named or not task.name.isidentifier():
        allowed = "a Task subclass with a string `name` such as 'my_task'"
        raise QuadrlError(name="task", value=task, allowed=allowed)
    if TASKS.get(task.name, task) is not task:
        allowed = "a name that no other task has"
        raise QuadrlError(name="task name", value=task.name, allowed=allowed)
    TASKS[task.name] = task
    return task


def make(name: str | Task, **options: Any) -> Task:
    """The task of a name with some options changed.

    Args:
        name: A name of the catalogue, or a task already made.
        **options: Fields of the task.

    Raises:
        QuadrlError: Unknown task or option; the message lists the choices.
    """
    task = name if isinstance(name, Task) else TASKS[choice("task", name, TASKS)]()
    return task.replace(**options)
