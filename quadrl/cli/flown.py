"""What the commands share that fly a policy or a controller without learning."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from quadrl import tasks
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.validation import choice
from quadrl.cli import choices
from quadrl.control import CONTROLLERS
from quadrl.core.task import Task
from quadrl.evaluation.evaluate import comes_with_quadrl, setting
from quadrl.evaluation.rollout import Controller
from quadrl.learning.config import tuples


@choices.command
class Flown:
    """What flies, and what it flies."""

    policy: Annotated[Positional[str], arg(metavar="[POLICY]")] = ""
    """A run folder, a .safetensors file, the name of a task, for the policy for it that comes with
    quadrl, or of such a policy, as hover_robust (write ./NAME for a folder of that name)."""
    algo: choices.Algorithm = ""
    """The algorithm that trained the policy that comes with quadrl; ppo by default."""
    controller: choices.ControllerName = ""
    """A controller instead of a policy: geometric or lqr."""
    task: choices.TaskName = ""
    """The task; by default the one that the policy was trained for, and hover for a controller."""
    vehicle: choices.VehicleName = ""
    """The aircraft; by default the one that the policy was trained with, paper for a controller."""
    seed: int = 0
    """Seed of the episodes, between 0 and 2^32 - 1."""
    task_options: tuple[str, ...] = ()
    """Options of the task that differ from the training's, such as time_limit=5."""

    randomization: choices.RandomizationName = ""
    """What is drawn for each aircraft and disturbs it: none, light or full, or JSON such as
    '{"mass": [0.8, 1.2]}'; by default that of the policy's training, and none for a controller."""

    aerodynamics: str = ""
    """Effects of the air on the rotors: none, full, or names of single ones with commas between
    them; by default those of the policy's training."""

    def setting(self) -> tuple[str, Controller, Task, Vehicle]:
        """A name for what flies, what flies, task and aircraft.

        Raises:
            QuadrlError: One is unknown, or the choice is ambiguous.
        """
        if bool(self.policy) == bool(self.controller):
            raise QuadrlError(
                "give either a policy (a run folder, a .safetensors file, or the name of a task) "
                f"or --controller {' or '.join(CONTROLLERS)}"
            )
        if self.algo and self.policy not in tasks.TASKS:
            raise QuadrlError(
                "--algo chooses among the policies that come with quadrl: give the name of a task, "
                "or leave it out"
            )
        choice("controller", self.controller or "geometric", CONTROLLERS)
        # The name of a controller is no policy here: a folder may be called so.
        flown = self.controller or (
            self.policy if comes_with_quadrl(self.policy) else Path(self.policy)
        )
        options = parse_options(self.task_options)
        chosen = self.task or None, self.vehicle or None, options, self.algo or "ppo"
        return setting(flown, *chosen, self.aerodynamics or None)

    def of_all(self, name: str, flown: Iterable[Controller]) -> Any:
        """The weather, or the randomization, in which all fly beside each other."""
        own = (getattr(controller, "conditions", {}).get(name) for controller in flown)
        return parse_named(name, getattr(self, name)) or next(filter(None, own), None)


def parse_named(name: str, text: str) -> Any:
    """A name as it is, or what JSON such as {"mass": [0.8, 1.2]} stands for.

    Raises:
        QuadrlError: It begins like JSON and is none.
    """
    if not text.startswith("{"):
        return text
    try:
        return tuples(json.loads(text))
    except (ValueError, RecursionError) as error:
        allowed = 'a name, or JSON such as {"mass": [0.8, 1.2]}'
        raise QuadrlError(f"{error}", name=name, value=text, allowed=allowed) from None


def parse_options(pairs: tuple[str, ...]) -> dict[str, Any]:
    """Options given as NAME=VALUE; a value is read as JSON where it is valid, lists as tuples.

    Raises:
        QuadrlError: One has no equals sign.
    """
    options: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals:
            allowed = "NAME=VALUE, such as time_limit=5"
            raise QuadrlError(name="task option", value=pair, allowed=allowed)
        try:
            options[name] = tuples(json.loads(text))
        except (ValueError, RecursionError):
            options[name] = text
    return options
