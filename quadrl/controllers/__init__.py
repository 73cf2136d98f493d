"""The modern controllers that policies are held against: same observations, same actions."""

from __future__ import annotations

from quadrl import tasks
from quadrl.controllers.geometric import GeometricController
from quadrl.controllers.lqr import LQRController, Weights
from quadrl.loops import Gains
from quadrl.task import Task, check_choices
from quadrl.vehicle import Vehicle

__all__ = ["CONTROLLERS", "Gains", "GeometricController", "LQRController", "Weights", "make"]

CONTROLLERS: dict[str, type[GeometricController] | type[LQRController]] = {
    "geometric": GeometricController,
    "lqr": LQRController,
}
"""Every controller by name."""


def make(
    name: str, task: str | Task, vehicle: Vehicle | None = None
) -> GeometricController | LQRController:
    """The controller of a name for a task: flat observations to actions, as a policy.

    Args:
        name: One of CONTROLLERS.
        task: A name of the catalogue or a task.
        vehicle: The aircraft; None for the paper's.

    Raises:
        OptionError: Unknown controller or task; the message lists the choices.
    """
    check_choices([name], CONTROLLERS, "controller")
    return CONTROLLERS[name](vehicle or Vehicle(), tasks.make(task))
