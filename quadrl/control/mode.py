"""What every control mode is: named numbers of an action, their scales, and rotor commands."""

from __future__ import annotations

import abc
import dataclasses
from typing import ClassVar

import numpy as np

from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import Array
from quadrl.control.allocation import within
from quadrl.engines.state import State


@dataclasses.dataclass(frozen=True)
class ActionTerm:
    """One number of an action."""

    name: str
    unit: str
    meaning: str
    """Its meaning and frame."""


class ControlMode(abc.ABC):
    """A map from actions (N, k) to rotor commands; it keeps no memory between control steps."""

    name: ClassVar[str]
    """The name in CONTROL_MODES."""
    has_loops: ClassVar[bool] = True
    """Whether the rotor commands depend on the state at every physics step."""
    any_layout: ClassVar[bool] = True
    """Whether an action means the same with rotors that stand otherwise."""
    quadrotors_alone: ClassVar[bool] = False
    """Whether it needs four rotors in an X or a plus."""
    terms: tuple[ActionTerm, ...]
    """The k numbers of an action."""
    centre: Array
    """Values (k,) in the terms' units at an action of 0."""
    scale: Array
    """What an action of 1 adds to them (k,)."""
    scale_down: Array
    """What an action of -1 subtracts from them (k,)."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Take the scales from the vehicle."""
        self.vehicle = vehicle

    @property
    def size(self) -> int:
        """Numbers in an action, k."""
        return len(self.terms)

    def values(self, action: Array) -> Array:
        """The values of actions (N, k), clipped to [-1, 1], in the terms' units."""
        share = within(np.asanyarray(action, order="F"), -1.0, 1.0)
        return self.centre + np.where(share > 0.0, self.scale, self.scale_down) * share

    @classmethod
    def reach(cls, vehicle: Vehicle) -> Vehicle:
        """Return the aircraft with the action scale that the mode commands within."""
        return vehicle

    def setpoint(self, state: State, action: Array) -> Array:
        """The setpoint (N, n) held for a control step, from the state in which the step begins."""
        return self.values(action)

    @abc.abstractmethod
    def rotor_command(self, state: State, setpoint: Array) -> Array:
        """Rotor speed commands (N, R) [rad/s] for the next physics step."""
