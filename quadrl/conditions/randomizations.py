"""Randomizations that are known by name, with the sources of their numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from quadrl.base.validation import resolved
from quadrl.conditions.randomization import NONE, Errors, Pushes, Randomization

RANDOMIZATIONS = {
    "none": NONE,
    # An aircraft that has been identified: half of what "full" has, and noise as in learning-to-fly
    # (Eschmann et al. 2024).
    "light": Randomization(
        mass=(0.95, 1.05),  # chosen
        inertia=(0.92, 1.08),  # chosen
        torque=(0.85, 1.15),  # chosen
        lag=(0.8, 1.25),  # chosen
        drag=(0.5, 1.5),  # chosen
        inflow=(0.85, 1.15),  # chosen
        rotors=(0.975, 1.025),  # chosen
        centre_of_mass=0.001,  # chosen
        command_delay=(0.0, 0.01),  # chosen: radio, beside the dead time of the aircraft
        observation_delay=(0.0, 0.02),  # chosen
        rate_delay=(0.0, 0.01),  # chosen: one physics step of the paper's aircraft
        rotor_inertia=(0.85, 1.15),  # chosen
        inertia_axes=(0.975, 1.025),  # chosen
        force=0.025,  # half of the standard deviation of learning-to-fly
        moment=0.001,  # half of that too: m g / 10^4 N m on an arm of 46 mm
        noise=Errors(position=1e-3, attitude=1e-3, velocity=2e-3, body_rate=2e-3),
    ),
    # An aircraft that is known from its data sheet. A steady force would be more than actions of
    # the paper's aircraft and the rotors of the Crazyflie can hold beside all this.
    "full": Randomization(
        mass=(0.8, 1.2),  # chosen: a battery or a camera more or less
        inertia=(0.85, 1.15),  # chosen
        thrust=(0.95, 1.05),  # chosen: with the mass, within what an action of 1 can carry
        torque=(0.7, 1.3),  # chosen
        lag=(0.5, 2.0),  # chosen: measured on one kind of aircraft were 39 to 87 ms (IMRCLab)
        drag=(0.0, 2.0),  # chosen
        inflow=(0.7, 1.3),  # chosen
        max_speed=(0.97, 1.0),  # chosen: 0.94 to 1 of the thrust
        wind=(0.0, 1.0),  # chosen
        rotors=(0.96, 1.04),  # chosen; others take 0.9 to 1.1 (Molchanov et al. 2019)
        centre_of_mass=0.002,  # chosen
        command_delay=(0.0, 0.05),  # chosen: about 10 ms from sensor to policy (RAPTOR), and radio
        observation_delay=(0.0, 0.04),  # chosen: up to two control steps of a small aircraft
        rate_delay=(0.0, 0.01),  # chosen: a gyroscope and its filter
        rotor_inertia=(0.7, 1.3),  # chosen
        inertia_axes=(0.95, 1.05),  # chosen
        noise=Errors(position=5e-3, attitude=5e-3, velocity=2e-2, body_rate=2e-2),
        # position: Molchanov et al. 2019; the others chosen
        bias=Errors(position=1e-2, attitude=1e-2, velocity=2e-2, body_rate=5e-3),  # chosen
        pushes=Pushes(rate=0.2, velocity=0.3, body_rate=0.5),  # chosen
    ),
}
"""Randomizations by name."""


Randomized = Randomization | Mapping[str, Any] | str | None
"""Types that `resolve` takes."""


def resolve(given: Randomized) -> Randomization:
    """Make a randomization from a name, a mapping of fields or a randomization; None is none.

    Raises:
        QuadrlError: The value is something else, a name or field is unknown, or a number is out of
            range.
    """
    given = "none" if given is None else given
    return resolved("randomization", given, Randomization, RANDOMIZATIONS)
