"""What the commands share that fly a policy or a controller without learning."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from tyro.conf import Positional

from quadrl import tasks
from quadrl.control import CONTROLLERS
from quadrl.control import make as make_controller
from quadrl.errors import QuadrlError
from quadrl.learning.config import tuples
from quadrl.policy import Policy
from quadrl.rollout import Controller
from quadrl.task import Task
from quadrl.vehicle import Vehicle, resolve


@dataclasses.dataclass(frozen=True)
class Flown:
    """What flies, and what it flies."""

    policy: Positional[str] = ""
    """A run folder, a .safetensors file, or the name of a task: then the policy for it that comes
    with quadrl (write ./NAME for a folder of that name)."""
    algo: str = ""
    """The algorithm that trained the policy that comes with quadrl; ppo by default."""
    controller: str = ""
    """A controller instead of a policy: geometric or lqr."""
    task: str = ""
    """The task; by default the one that the policy was trained for, and hover for a controller."""
    vehicle: str = ""
    """The aircraft; by default the one that the policy was trained with, paper for a controller."""
    seed: int = 0
    """Seed of the episodes, between 0 and 2^32 - 1."""
    task_options: tuple[str, ...] = ()
    """Options of the task that differ from the training's, such as time_limit=5."""

    def setting(self) -> tuple[Controller, Task, Vehicle]:
        """Controller, task and aircraft.

        Raises:
            QuadrlError: One is unknown, or the choice is ambiguous.
        """
        options = parse_options(self.task_options)
        if bool(self.policy) == bool(self.controller):
            raise QuadrlError(
                "give either a policy (a run folder, a .safetensors file, or the name of a task) "
                f"or --controller {' or '.join(CONTROLLERS)}"
            )
        shipped = self.policy in tasks.TASKS
        if self.algo and not shipped:
            raise QuadrlError(
                "--algo chooses among the policies that come with quadrl: give the name of a task, "
                "or leave it out"
            )
        if not self.policy:
            vehicle = resolve(self.vehicle or None)
            task = tasks.make(self.task or "hover", **options)
            return make_controller(self.controller, task, vehicle), task, vehicle
        if shipped:
            policy = Policy.pretrained(self.policy, self.algo or "ppo")
        else:
            policy = Policy.load(self.policy)
        name = self.task or policy.task
        trained = policy.metadata.get("task_options", {}) if name == policy.task else {}
        task = tasks.make(name, **(trained | options))
        return policy, task, resolve(self.vehicle or policy.metadata.get("vehicle"))


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
