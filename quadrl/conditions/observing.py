"""Options of the observation: what a policy sees besides or instead of the task's own entries."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any, Literal

from quadrl.base.errors import QuadrlError
from quadrl.base.validation import choice, number, resolved
from quadrl.conditions import ranging as ranging  # registers its sensors
from quadrl.conditions import sensors
from quadrl.conditions import targets as targets  # registers its sensors
from quadrl.conditions.sensors import Sensor
from quadrl.conditions.views import LONGEST_HISTORY

ROTOR_SPEEDS = ("true", "estimated", "none")
SWITCHES = ("relative_rotor_speed", "rotation", "airspeed", "disturbance", "privileged")
"""Sensors that are added by an option of their name."""


@dataclasses.dataclass(frozen=True)
class Observing:
    """Options of the observation."""

    action_history: int = 0
    """How many of the last actions are seen, the newest first; zeros before the first."""
    observation_history: int = 0
    """How many observations before the present one are seen, the newest first; the first one
    stands for those before it."""
    rotor_speed: Literal["true", "estimated", "none"] = "true"
    """Which rotor speeds are seen: the true ones, those that follow from the commands with the lag
    that is specified, or none."""
    relative_rotor_speed: bool = False
    """Whether those are seen less the speed of hover, over that, as `relative_rotor_speed`."""
    rotation: bool = False
    """Whether the rotation matrix from body to world is seen, row by row."""
    airspeed: bool = False
    """Whether the velocity through the air is seen, in the body frame."""
    disturbance: bool = False
    """Whether the acceleration is seen that weight and the thrust of the specified aircraft do not
    explain, body frame: what an accelerometer feels beside that thrust, smoothed."""
    privileged: bool = False
    """Whether there is an observation for the critic alone: the true one, what was drawn, and the
    wind in the body frame."""
    sensors: Mapping[str, Mapping[str, Any]] = dataclasses.field(
        default_factory=dict[str, Mapping[str, Any]]
    )
    """Further sensors by name, each with its options: noise, bias, delay [s], rate [Hz]."""

    def __post_init__(self) -> None:
        """Validate the options."""
        for name in ("action_history", "observation_history"):
            value = number(name, getattr(self, name), 0, LONGEST_HISTORY, whole=True)
            object.__setattr__(self, name, value)
        choice("rotor_speed", self.rotor_speed, ROTOR_SPEEDS)
        for name in SWITCHES:
            if not isinstance(value := getattr(self, name), bool):
                raise QuadrlError(name=name, value=value, allowed="True or False")
        if self.relative_rotor_speed and self.rotor_speed == "none":
            allowed = "True beside rotor_speed true or estimated"
            raise QuadrlError(name="relative_rotor_speed", value=True, allowed=allowed)
        given: Any = self.sensors
        if not isinstance(given, Mapping):
            allowed = "a mapping of their names to their options"
            raise QuadrlError(name="sensors", value=given, allowed=allowed)
        for name, options in self.sensors.items():
            sensors.make(name, options)
        own = {name: dict(options) for name, options in self.sensors.items()}
        object.__setattr__(self, "sensors", own)

    def made(
        self, further: Mapping[str, Mapping[str, Any]] | None = None, *, uncertain: bool = False
    ) -> dict[str, Sensor]:
        """The sensors by name, in the order in which they sense.

        Args:
            further: Sensors that the task asks for, whose options those of `sensors` override.
            uncertain: Whether the randomization gives the state estimate errors.
        """
        lengths = "action_history", "observation_history"
        given: dict[str, Any] = {"rotor_speed": {}, "estimate": {}, "state": {}}
        given |= {name: {} for name in SWITCHES if getattr(self, name)}
        given |= {k: {"length": length} for k in lengths if (length := getattr(self, k))}
        for own in (further or {}, self.sensors):
            given |= {name: given.get(name, {}) | dict(options) for name, options in own.items()}
        seen = self.rotor_speed
        modelled = seen == "estimated" or (seen == "none" and "disturbance" in given)
        speeds = {"source": "estimated" if modelled else "true", "entry": seen != "none"}
        given["rotor_speed"] = speeds | given["rotor_speed"]
        made = {name: sensors.make(name, options) for name, options in given.items()}
        truth = sensors.RotorSpeed(entry=seen != "none"), sensors.StateEstimate()
        if not uncertain and (made["rotor_speed"], made["estimate"]) == truth:
            del made["estimate"]
        return dict(sorted(made.items(), key=lambda item: item[1].last))

    def given(self) -> dict[str, Any]:
        """The options that differ from the defaults."""
        usual = vars(Observing())
        return {name: value for name, value in vars(self).items() if value != usual[name]}

    def for_controller(self) -> Observing:
        """What a controller observes beside such a policy: rotor speeds as it does, if any."""
        return Observing(rotor_speed="true" if self.rotor_speed == "true" else "estimated")

    def for_policy(self) -> dict[str, Any]:
        """The options that change what a policy observes."""
        own = {name: options for name, options in self.sensors.items() if name != "privileged"}
        return dataclasses.replace(self, privileged=False, sensors=own).given()

    def meaning(self, usual: Collection[str]) -> dict[str, Any]:
        """Those that change what its numbers mean: without errors and ages of samples.

        Args:
            usual: Sensors that are there in any case.
        """
        own: dict[str, Mapping[str, Any]] = {}
        for name, options in self.sensors.items():
            errors = {*sensors.SENSORS[name].exact, "delay", "rate"}
            kept = {key: value for key, value in options.items() if key not in errors}
            if kept or name not in usual:
                own[name] = kept
        return dataclasses.replace(self, sensors=own).for_policy()


Observed = Observing | Mapping[str, Any] | None
"""Types that `resolve` takes."""


def resolve(given: Observed) -> Observing:
    """Make options of the observation from a mapping of some of them; None is the default.

    Raises:
        QuadrlError: The value is something else, or an option is unknown or out of range.
    """
    return resolved("observe", {} if given is None else given, Observing, word="option")
