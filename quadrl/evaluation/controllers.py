"""What flies, by its name: the controllers that policies are compared with, and policies."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from quadrl.aircraft.specification import resolve
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.validation import choice
from quadrl.control import CONTROLLERS, Controller
from quadrl.core.observation import layout
from quadrl.core.one_of import OneOf
from quadrl.core.task import Task
from quadrl.evaluation.policy import Policy, shipped
from quadrl.tasks import TASKS, make


def make_controller(
    name: str, task: str | Task, vehicle: Vehicle | str | None = None
) -> Controller | EachMember:
    """Make the controller of a name for a task: flat observations (..., size) to actions (..., R).

    Args:
        name: One of CONTROLLERS.
        task: A name of the catalogue or a task.
        vehicle: The aircraft or its name; None for the paper's.

    Raises:
        QuadrlError: Unknown controller, task or vehicle; the message lists the choices.
    """
    kind = CONTROLLERS[choice("controller", name, CONTROLLERS)]
    made, flies = make(task), resolve(vehicle)
    return EachMember(kind, flies, made) if isinstance(made, OneOf) else kind(flies, made)


class EachMember:
    """Flies each row as a controller of its member does."""

    control_mode = Controller.control_mode

    def __init__(
        self, kind: Callable[[Vehicle, Task], Controller], vehicle: Vehicle, task: OneOf
    ) -> None:
        """Make a controller for each member."""
        self._own = [(member, kind(vehicle, member)) for member in task.members]
        self._rotors = vehicle.rotor_count
        self._places = layout(task.observation, self._rotors)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (..., R), within [-1, 1], for flat observations (..., size)."""
        action = np.zeros((*observation.shape[:-1], self._rotors))
        which = observation[..., self._places["task"]].argmax(-1)
        for number, (member, own) in enumerate(self._own):
            seen = observation[rows := which == number]
            if not len(seen):
                continue
            parts = [seen[:, self._places[name]] for name in member.observation]
            action[rows] = own(np.concatenate(parts, axis=-1))
        return action


def comes_with_quadrl(name: str) -> bool:
    """Whether a name is that of a task, or of a policy that comes with quadrl."""
    known = {file.stem for file in shipped()}
    return name in TASKS or name in known or f"{name}_ppo" in known


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
