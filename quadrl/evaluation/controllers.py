"""Make the controllers that policies are compared with, by name."""

from __future__ import annotations

from quadrl import tasks
from quadrl.aircraft.presets import resolve
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.validation import choice
from quadrl.control import CONTROLLERS, Controller
from quadrl.core.task import Task


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
    return kind(resolve(vehicle), tasks.make(task))
