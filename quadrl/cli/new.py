"""`quadrl new-task` and `quadrl new-aircraft`: files of one's own that work as they stand."""

from __future__ import annotations

import importlib.util
import keyword
from collections.abc import Iterable
from pathlib import Path
from string import Template

from tyro.conf import Positional

from quadrl.aircraft.presets import VEHICLES
from quadrl.base.errors import QuadrlError
from quadrl.cli import choices
from quadrl.cli.console import say
from quadrl.core.catalogue import COMPOSED, TASKS
from quadrl.core.task import camel

TEMPLATES = Path(__file__).with_name("templates")


@choices.command
class NewTask:
    """Write NAME.py here, a commented task of your own that can be trained as it stands."""

    name: Positional[str]
    """Name of the task, such as my_task."""

    def run(self) -> None:
        """Write the file, and say what to do with it."""
        own = f"{self.name} --import {_write('task', self.name, TASKS | COMPOSED)}"
        say(f"next: quadrl check {own}\n      quadrl train {own}")


@choices.command
class NewAircraft:
    """Write NAME.py here, a commented aircraft of your own that can be flown as it stands."""

    name: Positional[str]
    """Name of the aircraft, such as my_aircraft."""

    def run(self) -> None:
        """Write the file, and say what to do with it."""
        own = f"--vehicle {self.name} --import {_write('aircraft', self.name, VEHICLES)}"
        say(f"next: quadrl check {own}\n      quadrl train hover {own}")


def content(what: str, name: str) -> str:
    """The file of a new task or aircraft."""
    text = (TEMPLATES / f"{what}.py.in").read_text()
    return Template(text).substitute(name=name, kind=camel(name))


def _write(what: str, name: str, taken: Iterable[str]) -> Path:
    """Write the file of a new task or aircraft into the working folder.

    Raises:
        QuadrlError: The name cannot be one, or is taken, or there is such a file.
    """
    path = Path(f"{name}.py")
    if not all(word.isidentifier() and not keyword.iskeyword(word) for word in (name, camel(name))):
        allowed = f"letters, digits and underscores, such as my_{what}"
    elif camel(name) in map(camel, taken):
        allowed = f"a name that no other {what} has"
    elif not path.exists() and importlib.util.find_spec(name):
        allowed = f"another one: {path} would hide the module {name} of Python"
    else:
        try:
            with open(path, "x") as file:
                file.write(content(what, name))
        except FileExistsError:
            raise QuadrlError(f"{path} exists already: choose another name") from None
        say(f"wrote {path}; its comments say what to change\n")
        return path
    raise QuadrlError(name=f"name of the {what}", value=name, allowed=allowed)
