"""What flies an aircraft: control modes and their loops, and the controllers that use them.

Controllers see the same observations and give actions of the same form as policies, whose
yardstick they are.
"""

from __future__ import annotations

from quadrl import tasks
from quadrl.aircraft.presets import resolve
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.validation import choice
from quadrl.control.geometric import Controller, GeometricController
from quadrl.control.loops import Gains
from quadrl.control.lqr import LQRController, Weights
from quadrl.control.modes import CONTROL_MODES, ActionTerm, ControlMode
from quadrl.task import Task

__all__ = [
    "CONTROLLERS", "CONTROL_MODES", "ActionTerm", "ControlMode", "Controller", "Gains",
    "GeometricController", "LQRController", "Weights", "make",
]  # fmt: skip

CONTROLLERS: dict[str, type[GeometricController] | type[LQRController]] = {
    "geometric": GeometricController,
    "lqr": LQRController,
}
"""Every controller by name."""


def make(name: str, task: str | Task, vehicle: Vehicle | str | None = None) -> Controller:
    """The controller of a name for a task: flat observations (..., size) to actions (..., R).

    Args:
        name: One of CONTROLLERS.
        task: A name of the catalogue or a task.
        vehicle: The aircraft or its name; None for the paper's.

    Raises:
        QuadrlError: Unknown controller, task or vehicle; the message lists the choices.
    """
    kind = CONTROLLERS[choice("controller", name, CONTROLLERS)]
    return kind(resolve(vehicle), tasks.make(task))
