"""Control modes with their loops, and the controllers that policies are compared with.

Controllers take the same observations as policies and return actions of the same form.
"""

from __future__ import annotations

from quadrl.control.geometric import Controller, GeometricController
from quadrl.control.loops import Gains
from quadrl.control.lqr import LQRController, Weights
from quadrl.control.mode import ActionTerm, ControlMode
from quadrl.control.modes import CONTROL_MODES

__all__ = [
    "CONTROLLERS", "CONTROL_MODES", "ActionTerm", "ControlMode", "Controller", "Gains",
    "GeometricController", "LQRController", "Weights",
]  # fmt: skip

CONTROLLERS: dict[str, type[GeometricController] | type[LQRController]] = {
    "geometric": GeometricController,
    "lqr": LQRController,
}
"""Every controller by name."""
