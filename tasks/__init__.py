"""The catalogue of tasks."""

from __future__ import annotations

from typing import Any

from quadrl.task import OptionError, Task, check_choices
from quadrl.tasks.hover import Hover
from quadrl.tasks.landing import Landing
from quadrl.tasks.random_waypoint import RandomWaypoint
from quadrl.tasks.static_waypoint import StaticWaypoint
from quadrl.tasks.straight_and_level import StraightAndLevel
from quadrl.tasks.target_following import TargetFollowing

TASKS: dict[str, type[Task]] = {
    task.name: task
    for task in (
        Hover,
        StaticWaypoint,
        RandomWaypoint,
        StraightAndLevel,
        Landing,
        TargetFollowing,
    )
}
"""Every registered task by name."""


def register(task: type[Task]) -> type[Task]:
    """Add a task to the catalogue, so that every door knows it by its name.

    Raises:
        OptionError: It is no class of a task with a name, or another task has the name.
    """
    named = isinstance(task, type) and issubclass(task, Task) and hasattr(task, "name")
    if not named or not isinstance(task.name, str) or not task.name.isidentifier():
        raise OptionError(f"{task!r} is no class of a task with a name such as 'my_task'")
    if TASKS.get(task.name, task) is not task:
        raise OptionError(f"a task named {task.name!r} is registered already")
    TASKS[task.name] = task
    return task


def make(name: str | Task, **options: Any) -> Task:
    """The task of a name with some options changed.

    Args:
        name: A name of the catalogue, or a task already made.
        **options: Fields of the task.

    Raises:
        ValueError: Unknown task or option; the message lists the choices.
    """
    if isinstance(name, Task):
        return name.replace(**options)
    check_choices([name], TASKS, "task")
    return TASKS[name]().replace(**options)
