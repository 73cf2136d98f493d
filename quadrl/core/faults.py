"""How a fault of a task is reported: an AssertionError that says what it does, and where."""

from __future__ import annotations

import contextlib
from collections.abc import Generator

import numpy as np

from quadrl.base.rotation import Array
from quadrl.core.task import Task


def require(condition: object, message: str) -> None:
    """Report a fault unless the condition holds."""
    if not condition:
        raise AssertionError(message)


def require_equal(got: dict[str, Array], expected: dict[str, Array], message: str) -> None:
    """Report the first array that is not what is expected."""
    for name, value in expected.items():
        require(np.array_equal(got[name], value), f"{message}: {name} is {got[name]} and {value}")


@contextlib.contextmanager
def blame(task: Task, what: str) -> Generator[None]:
    """Report an exception as a fault of the task."""
    try:
        yield
    except Exception as error:
        said = f"{task.name}: {what} fails: {type(error).__name__}: {error}"
        raise AssertionError(said) from error
