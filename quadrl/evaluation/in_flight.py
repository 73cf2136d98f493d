"""What flies: a controller that is ready for an environment, and the scenario that it flies."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from typing import Any, Unpack

import numpy as np

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.conditions.randomization import Sizes
from quadrl.core.environment import Environment
from quadrl.core.record import warn_of_changes
from quadrl.core.scenario import Conditions, Scenario
from quadrl.core.task import Task
from quadrl.evaluation.memory import PolicyInFlight
from quadrl.evaluation.policy import Policy

Controller = Callable[[np.ndarray], np.ndarray]
"""Flat observations (N, size) float32 to actions (N, k), or a torch module that does that.

Its attribute `control_mode`, if it has one, says what actions mean, and `conditions` what it was
trained in, as `Scenario.of` takes it."""


def scenario_of(
    controller: Any, task: str | Task | Scenario | None = None, **conditions: Unpack[Conditions]
) -> Scenario:
    """The scenario of a flight: that of a controller's training, but for what is given.

    Args:
        controller: What flies. Its attribute `conditions`, if it has one, says what it was trained
            in, and `control_mode` what its actions mean.
        task: As `fly` takes it. A whole scenario leaves nothing of the training's.
        **conditions: What differs.

    Raises:
        QuadrlError: There is no task, a name is unknown, or a value impossible.
    """
    own = getattr(controller, "control_mode", None)
    if isinstance(task, Scenario):
        scenario = Scenario.of(task, **conditions)
    else:
        trained = {"control_mode": own, **getattr(controller, "conditions", {})}
        if task is None and "task" not in trained:
            raise QuadrlError(name="task", value=None, allowed="given, for a function")
        scenario = Scenario.of(trained, task=task, **conditions)
        warn_of_changes(trained, scenario, "policy")
    asked = conditions.get("vehicle") and not conditions.get("randomization")
    if asked and scenario.randomization.sizes != Sizes():
        said = f"the training draws sizes in place of those of the vehicle {scenario.vehicle.name}"
        warnings.warn(f"{said}; with randomization none that one flies", QuadrlWarning, 2)
    if own not in (None, mode := scenario.control_mode):
        allowed = f"{own!r}, the mode of this policy or controller"
        raise QuadrlError(name="control_mode", value=mode, allowed=allowed)
    return scenario


def begun(controller: Controller, environment: Environment) -> Controller:
    """A controller with an empty memory, to fly the aircraft of an environment.

    Raises:
        QuadrlError: It is a policy that does not fit.
    """
    if isinstance(controller, Policy):
        controller = controller.flying(environment.num_envs)
    if isinstance(controller, PolicyInFlight):
        controller.policy.check_fits(environment)
        controller.reset()
    torch: Any = sys.modules.get("torch")  # who has a module has imported it
    if torch and isinstance(controller, torch.nn.Module):
        return _of_module(controller, torch)
    return controller


def _of_module(module: Any, torch: Any) -> Controller:
    """A torch module as a function of arrays, on its device and in its precision."""
    like = next(module.parameters(), torch.zeros(()))

    def act(observation: np.ndarray) -> Any:
        with torch.no_grad():
            given = module(torch.from_numpy(observation).to(like))
        return given.cpu().numpy() if isinstance(given, torch.Tensor) else given

    return act
