"""Whether a policy fits an environment: whether what it sees and does means what it has learned."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.quadrotor import sizes_of
from quadrl.aircraft.specification import resolve as resolve_vehicle
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.conditions import observing
from quadrl.conditions.randomization import NONE
from quadrl.conditions.randomizations import resolve as resolve_randomization

if TYPE_CHECKING:
    from quadrl.core.environment import Environment


def check_fits(policy: Any, environment: Environment) -> Vehicle:
    """Refuse an environment in which observations or actions mean something else to a policy.

    `Policy.check_fits` says what is refused.

    Returns:
        The aircraft that the policy was trained with.

    Raises:
        QuadrlError: The policy does not fit; the message says what would.
    """
    vehicle, name = environment.vehicle, policy.metadata.get("vehicle")
    as_trained = f"as in the training of the policy for {policy.task}"
    # One that is not known here is taken for the one that it is to fly.
    known = name if isinstance(name, dict) or name in VEHICLES else vehicle
    trained = resolve_vehicle(known, policy.metadata.get("vehicle_options"), whole=True)
    usual = environment.task.sensors
    needed = observing.resolve(policy.metadata.get("observe")).meaning(usual)
    seen = environment.scenario.observe.meaning(usual)
    if needed != seen:
        raise QuadrlError(name="observe", value=seen, allowed=f"{needed}, {as_trained}")
    for what, own, needed in (
        ("observation", policy.size, environment.size),
        ("action", policy.action_size, environment.action_size),
    ):
        if own != needed:
            name = f"{what} size of the policy for {policy.task}"
            where = f"{environment.task.name} with the vehicle {vehicle.name}"
            raise QuadrlError(name=name, value=own, allowed=f"{needed} for {where}")
    if (mode := environment.control_mode.name) != policy.control_mode:
        allowed = f"{policy.control_mode!r}, {as_trained}"
        raise QuadrlError(name="control_mode", value=mode, allowed=allowed)
    if not environment.control_mode.any_layout and not np.array_equal(
        trained.layout, vehicle.layout
    ):
        allowed = f"one with the rotor layout of {trained.name}, which the policy has learned"
        raise QuadrlError(name="vehicle", value=vehicle.name, allowed=allowed)
    if mode == "rotor" and trained.action_scale != vehicle.action_scale:
        reason = "make the environment with **policy.keywords, or its aircraft with that scale"
        scale, allowed = vehicle.action_scale, f"{trained.action_scale:g}, {as_trained}"
        raise QuadrlError(reason, name="action_scale", value=scale, allowed=allowed)
    _check_size(policy, environment)
    return trained


def _check_size(policy: Any, environment: Environment) -> None:
    """Refuse an aircraft outside of the sizes that were drawn in its training.

    Raises:
        QuadrlError: The message has the size, and those of the training.
    """
    drawn = resolve_randomization(policy.metadata.get("randomization")).sizes
    if drawn == NONE.sizes or environment.randomization.sizes != NONE.sizes:
        return
    for name, size in sizes_of(environment.vehicle).items():
        low, high = getattr(drawn, name)
        if high and not low <= size <= high:
            what = f"{name} of the vehicle {environment.vehicle.name}"
            allowed = f"{low:g} to {high:g}, as in the training of the policy for {policy.task}"
            raise QuadrlError(name=what, value=round(size, 4), allowed=allowed)
