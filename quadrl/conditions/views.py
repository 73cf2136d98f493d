"""Sensors of what others have seen: the last actions and observations; and the critic's view."""

from __future__ import annotations

import dataclasses

import numpy as np

from quadrl.base.rotation import Array, to_body
from quadrl.base.validation import number
from quadrl.conditions.sensor import Memory, Moment, Sensor, Sizes, register_sensor

LONGEST_HISTORY = 1000


@dataclasses.dataclass(frozen=True)
class History(Sensor):
    """The last of something, the newest first."""

    measured = False

    length: int = 1
    """How many; zeros before the first."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        number(f"{self.name} length", self.length, 1, LONGEST_HISTORY, whole=True)


@register_sensor
class ActionHistory(History):
    """The last actions, the newest first."""

    compiled = True
    name = "action_history"
    formula = "the last `length` actions, clipped to [-1, 1], the newest first; zeros before them"

    def width(self, sizes: Sizes) -> int:
        """All numbers of all actions."""
        return self.length * sizes.actions

    def begin(self, now: Moment) -> Memory:
        """Zeros: no action was taken yet."""
        return {"actions": np.zeros((len(now.action), self.length * now.action.shape[1]))}

    def update(self, now: Moment) -> Memory:
        """Put the last action before the others, of which the oldest is dropped."""
        return {"actions": pushed(now.memory["actions"], np.clip(now.action, -1.0, 1.0))}

    def sense(self, now: Moment) -> Array:
        """The actions, clipped to [-1, 1]."""
        return now.memory["actions"]


@register_sensor
class ObservationHistory(History):
    """The observations before, the newest first; the first one stands for those before it."""

    compiled = True
    name, unit, last = "observation_history", "", True
    formula = (
        "the `length` observations before the present one, without histories, the newest first; "
        "the first one stands for those before it"
    )

    def width(self, sizes: Sizes) -> int:
        """All numbers of all observations."""
        return self.length * sizes.observed

    def begin(self, now: Moment) -> Memory:
        """The first observation, repeated."""
        return {"past": np.tile(now.observed, 1 + self.length)}

    def update(self, now: Moment) -> Memory:
        """Put the present one before the others, of which the oldest is dropped."""
        return {"past": pushed(now.memory["past"], now.observed)}

    def sense(self, now: Moment) -> Array:
        """The observations before the present one."""
        return now.memory["past"][:, now.observed.shape[1] :]


@register_sensor
class Privileged(Sensor):
    """For the critic alone: the task's true entries, what was drawn, what events do, and the wind.

    What was drawn lies between -1 and 1 in its range; what events do is 0 where it is nothing, as
    `Events.seen` gives it; the wind [m/s] is in the body frame.
    """

    compiled = True
    name, unit, measured, shown, last = "privileged", "", False, False, True

    def width(self, sizes: Sizes) -> int:
        """All of these."""
        return sizes.truth + sizes.drawn + sizes.happening + 3

    def sense(self, now: Moment) -> Array:
        """The true entries, what was drawn, what happens and the wind, side by side."""
        wind = to_body(now.true.rotation, now.wind)
        return np.concatenate([*now.truth.values(), now.drawn, now.happening, wind], axis=-1)


def pushed(past: Array, newest: Array) -> Array:
    """Past numbers (n, k) with the newest (n, m) before them; the oldest m are dropped."""
    return np.concatenate([newest, past[:, : -newest.shape[1]]], axis=-1)
