"""Base class and registry of events, which change aircraft between two resets.

An event scales numbers of an aircraft's row, limits the speeds of its rotors, or blows. What it
does follows from what it remembers, so that a state which was saved in the middle of it goes on bit
for bit. `event_process.py` lets events act.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar, TypeVar, cast, dataclass_transform

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array
from quadrl.base.validation import MAX_OPTION, number, numbers, registered
from quadrl.engines.rng import Rng

SPEED_LIMIT, WIND = "speed_limit", "wind"
"""What an event may change besides numbers of a row: see `Event.changes`."""
NEVER = 1e9
"""When an event happens that does not happen in an episode [s]."""
Memory = dict[str, Array]
Range = tuple[float, float]
Kind = TypeVar("Kind", bound=type)


@dataclasses.dataclass(slots=True)
class Happening:
    """All that an event may read before a control step; arrays (n, ...)."""

    time: Array  # (n,) [s] since the episode began
    rotor_speed: Array  # (n, R) [rad/s]
    aircraft: Parameters  # as when the episodes began, (n, ...) or (1, ...)
    memory: Memory  # what the event remembers
    timestep: float  # of control [s]


@dataclasses.dataclass(frozen=True)
class Event(abc.ABC):
    """Something that happens to aircraft in flight. Its fields are its options."""

    name: ClassVar[str]
    """The name in the registry."""
    changes: ClassVar[tuple[str, ...]]
    """What it changes: numbers of an aircraft's row by their names, such as "mass" or
    "rotor.thrust_coefficient"; SPEED_LIMIT, the largest speeds of the rotors; WIND."""

    def check(self, vehicle: Vehicle, time_limit: float) -> None:
        """Refuse options that do not fit an aircraft or episodes of a length [s].

        Raises:
            QuadrlError: The message names the option.
        """
        return

    @property
    def burden(self) -> tuple[float, float]:
        """How heavy an episode may begin, over the weight, and with which least speed limit."""
        return 1.0, 1.0

    @property
    def strongest_wind(self) -> float:
        """The fastest that it blows [m/s]."""
        return 0.0

    @abc.abstractmethod
    def draw(self, rng: Rng, time_limit: float) -> Memory:
        """What it remembers as episodes begin: arrays (n,) by name, all finite."""

    def update(self, now: Happening) -> Memory:
        """What it remembers after a control step, in place of `now.memory`."""
        return now.memory

    @abc.abstractmethod
    def effect(self, now: Happening) -> tuple[Array, ...]:
        """What it does in the control step that begins, for each of `changes`.

        Returns:
            Factors (n, 1) or as many as the row has, of its numbers as the episode began; for
            SPEED_LIMIT factors (n, 1) or (n, R) of the largest speeds; for WIND a velocity (n, 3)
            [m/s], world frame, that adds to the weather's.
        """

    @abc.abstractmethod
    def told(self, now: Happening) -> str:
        """What pictures say of one aircraft (n = 1), such as "rotor 2 failed"; may be empty."""


@dataclasses.dataclass(frozen=True)
class Sudden(Event):
    """An event that happens at a time."""

    at: float | Range | None = None
    """When [s] after the start of the episode, or the first and the last time between which it is
    drawn; None for any time of the episode."""
    chance: float = 1.0
    """Share of the episodes in which it happens."""

    def __post_init__(self) -> None:
        """Validate the options."""
        if self.at is not None:
            object.__setattr__(self, "at", ranged(f"{self.name} at", self.at))
        number(f"{self.name} chance", self.chance, 0, 1)

    def check(self, vehicle: Vehicle, time_limit: float) -> None:
        """Refuse a time at which no episode flies any more."""
        if self.at is not None and cast(Range, self.at)[1] >= time_limit:
            allowed = f"before the time limit of the episode, {time_limit:g} s"
            raise QuadrlError(name=f"{self.name} at", value=self.at, allowed=allowed)

    def draw(self, rng: Rng, time_limit: float) -> Memory:
        """When it happens, `at` (n,) [s]."""
        first, last = (0.0, time_limit) if self.at is None else cast(Range, self.at)
        happens, at = rng.uniform(0.0, 1.0) < self.chance, rng.uniform(first, last)
        return {"at": np.where(happens, at, NEVER)}

    def happened(self, now: Happening) -> Array:
        """Whether it has happened, (n, 1) bool."""
        return (now.time >= now.memory["at"])[:, None]


def ranged(name: str, given: Any, low: float = 0.0, high: float = MAX_OPTION) -> Range:
    """The lowest and the highest value of an option that is a number or two.

    Raises:
        QuadrlError: It is neither, or out of range.
    """
    if isinstance(given, (tuple, list)):
        least, most = numbers(name, given, 2, low, high)
    else:
        least = most = number(name, given, low, high)
    if least > most:
        raise QuadrlError(name=name, value=given, allowed="the lowest and the highest value")
    return least, most


EVENTS: dict[str, type[Event]] = {}
"""Every registered event by name."""


@dataclass_transform(frozen_default=True)
def register_event(kind: Kind) -> Kind:
    """Add an event to the registry, so that a scenario finds it by its name.

    Raises:
        QuadrlError: It is not an Event subclass with a name, or another event has the name.
    """
    given, name = cast(Any, kind), registered("event", kind, Event, EVENTS)
    EVENTS[name] = dataclasses.dataclass(frozen=True)(given)
    return kind
