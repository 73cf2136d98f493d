"""What flies, by its name: the controllers that policies are compared with, and policies."""

from __future__ import annotations

from pathlib import Path

from quadrl.aircraft.presets import resolve
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.validation import choice
from quadrl.control import CONTROLLERS, Controller
from quadrl.core.task import Task
from quadrl.evaluation.policy import Policy, shipped
from quadrl.tasks import TASKS, make


def make_controller(
    name: str, task: str | Task, vehicle: Vehicle | str | None = None
) -> Controller:
    """Make the controller of a name for a task: flat observations (..., size) to actions (..., R).

    Args:
        name: One of CONTROLLERS.
        task: A name of the catalogue or a task.
        vehicle: The aircraft or its name; None for the paper's.

    Raises:
        QuadrlError: Unknown controller, task or vehicle; the message lists the choices.
    """
    kind = CONTROLLERS[choice("controller", name, CONTROLLERS)]
    return kind(resolve(vehicle), make(task))


def comes_with_quadrl(name: str) -> bool:
    """Whether a name is that of a task, or of a policy that comes with quadrl."""
    return name in TASKS or name in {file.stem for file in shipped()}


def policy_of(given: str | Path) -> Policy:
    """Load a policy by its name, or from a file or a run folder.

    Args:
        given: A name as `comes_with_quadrl` knows it, that of a task for its policy by PPO; else a
            path, as a Path is whatever it is called.

    Raises:
        QuadrlError: As `Policy.load` raises it.
    """
    if isinstance(given, str) and comes_with_quadrl(given):
        return Policy.pretrained(given)
    return Policy.load(given)
