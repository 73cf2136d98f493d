"""What a training that goes through the physics cannot have; without torch."""

from __future__ import annotations

from typing import Any

from quadrl.base.errors import QuadrlError
from quadrl.conditions.observing import Observing
from quadrl.conditions.observing import resolve as resolve_observing
from quadrl.conditions.randomization import NONE, resolve

LATE_OR_UNSURE = ("command_delay", "observation_delay", "noise", "bias")
"""What a randomization may not have: the observation must follow from the state, and the rotors'
commands from the action alone."""


def check_smooth(config: Any) -> None:
    """Refuse the settings of a `TrainConfig` whose derivatives are not known.

    Raises:
        QuadrlError: The message names the setting.
    """
    task, drawn = config.make_task(), resolve(config.randomization)
    disturbed = [name for name in LATE_OR_UNSURE if getattr(drawn, name) != getattr(NONE, name)]
    for name, value, wrong, allowed in (
        ("control_mode", config.control_mode, config.control_mode != "rotor", "'rotor'"),
        ("engine", config.engine, config.engine != "free_flight", "'free_flight'"),
        ("memory", config.memory, config.memory != "none", "'none'"),
        ("device", config.device, config.device != "cpu", "'cpu'"),
        ("task", task.name, task.contact, "a task without contact with the ground"),
        ("task", task.name, task.true_parameters, "a task that sees the specified parameters"),
        ("observe", config.observe, resolve_observing(config.observe) != Observing(), "left out"),
        ("randomization", config.randomization, disturbed, f"without {', '.join(LATE_OR_UNSURE)}"),
    ):
        if wrong:
            reason = "apg takes the derivatives of the whole flight, and has none for this"
            raise QuadrlError(reason, name=name, value=value, allowed=f"{allowed} with algo apg")
