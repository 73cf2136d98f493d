"""The events that come with quadrl: battery, rotors that fail or are damaged, payload, gust front.

One of your own is an `Event` with `register_event`; a scenario finds it by its name. Defaults
without a source were chosen.
"""

# pyright: reportUnnecessaryIsInstance=false
# What users give is checked, whatever its annotation promises.
from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, cast

import numpy as np

from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.records import tuples
from quadrl.base.rotation import Array, stack
from quadrl.base.validation import IN_A_FILE, choice, number, record
from quadrl.conditions.event import (
    EVENTS,
    SPEED_LIMIT,
    WIND,
    Event,
    Happening,
    Memory,
    Range,
    Sudden,
    ranged,
    register_event,
)
from quadrl.conditions.weather import MAX_WIND
from quadrl.engines.rng import FULL_TURN, Rng

MOST_LOST = 0.95
"""The largest share of the rotors' speed that a battery may lose."""
Happens = Mapping[str, Any] | Sequence[str] | str | None
"""Types that `resolve` takes."""


@register_event
class Battery(Event):
    """A battery that runs down: the largest speeds of the rotors fall with its voltage.

    The current goes with the power of the rotors, sum(k_Q Omega^3), and the voltage falls with the
    charge and, at once, with the current. The rotors stop when it is empty.
    """

    name, changes = "battery", (SPEED_LIMIT,)

    charge: float | Range = (0.2, 1.0)
    """Charge at the start, 1 for a full one; drawn between two numbers."""
    endurance: float = 420.0
    """How long a full one lasts in hover [s]. The default is a Crazyflie 2.1's 7 minutes."""
    sag: float = 0.2
    """Share of the largest speeds that is lost from full to empty. A lithium cell has 4.2 V and
    then 3.3 V, which is 0.21."""
    drop: float = 0.05
    """Share that the current of hover costs besides; twice the current costs twice of it."""

    def __post_init__(self) -> None:
        """Validate the options."""
        object.__setattr__(self, "charge", ranged("battery charge", self.charge, 0.01, 1))
        number("battery endurance", self.endurance, 1.0, 1e6)
        number("battery sag", self.sag, 0, MOST_LOST)
        number("battery drop", self.drop, 0, MOST_LOST - self.sag)

    @property
    def burden(self) -> tuple[float, float]:
        """The speed limit of the emptiest one, in hover."""
        least, _ = cast(Range, self.charge)
        return 1.0, 1.0 - self.sag * (1.0 - least) - self.drop

    def draw(self, rng: Rng, time_limit: float) -> Memory:
        """Its charge (n,)."""
        return {"charge": rng.uniform(*cast(Range, self.charge))}

    def update(self, now: Happening) -> Memory:
        """Take from the charge what the rotors draw in a control step."""
        used = now.timestep / self.endurance * _power(now)
        return {"charge": np.maximum(now.memory["charge"] - used, 0.0)}

    def effect(self, now: Happening) -> tuple[Array, ...]:
        """The voltage, over that of a full battery without a load."""
        charge = now.memory["charge"]
        voltage = 1.0 - self.sag * (1.0 - charge) - self.drop * _power(now)
        return (np.where(charge > 0, np.maximum(voltage, 1.0 - MOST_LOST), 0.0)[:, None],)

    def told(self, now: Happening) -> str:
        """Its charge."""
        return f"battery {100 * now.memory['charge'][0]:.0f} %"


def _power(now: Happening) -> Array:
    """Power of the rotors over that of hover, (n,)."""
    rotor, speed, power, hover = now.aircraft.rotor, now.rotor_speed, 0.0, 0.0
    for k in range(speed.shape[1]):  # one after the other, as a single aircraft's are added
        drag, usual, own = rotor.torque_coefficient[:, k], rotor.hover_speed[:, k], speed[:, k]
        power = power + drag * own * own * own
        hover = hover + drag * usual * usual * usual
    return cast(Array, power / hover)


@dataclasses.dataclass(frozen=True)
class _OneRotor(Sudden):
    """An event that leaves a rotor a share of something."""

    word: ClassVar[str]
    """What has happened to the rotor, for pictures."""
    least: ClassVar[float] = 0.0
    """The least share that may be left."""

    rotor: int | None = None
    """Number of the rotor, from 1 on; None to draw one for each episode."""
    left: float | Range = 0.0
    """Share that is left; drawn between two numbers."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        object.__setattr__(self, "left", ranged(f"{self.name} left", self.left, self.least, 1))

    def check(self, vehicle: Vehicle, time_limit: float) -> None:
        """Refuse a rotor that the aircraft does not have."""
        super().check(vehicle, time_limit)
        if self.rotor is not None:
            number(f"{self.name} rotor", self.rotor, 1, vehicle.rotor_count, whole=True)

    def draw(self, rng: Rng, time_limit: float) -> Memory:
        """When it happens, which rotor it hits, as a share of them, and which share is left."""
        memory = super().draw(rng, time_limit)
        memory["which"] = rng.uniform(0.0, 1.0)
        memory["left"] = rng.uniform(*cast(Range, self.left))
        return memory

    def number(self, now: Happening) -> Array:
        """Number of the rotor that it hits, from 1 on, (n, 1)."""
        if self.rotor is not None:
            return np.full((len(now.time), 1), self.rotor)
        return 1 + np.floor(now.memory["which"] * now.rotor_speed.shape[1])[:, None]

    def factor(self, now: Happening) -> Array:
        """What is left of each rotor, (n, R)."""
        count = now.rotor_speed.shape[1]
        each = np.arange(1.0, 1.0 + count)
        others = ~self.happened(now) | (self.number(now) != each)
        return np.where(others, 1.0, now.memory["left"][:, None])

    def told(self, now: Happening) -> str:
        """Which rotor it has hit, once it has."""
        if not self.happened(now).any():
            return ""
        left, which = float(now.memory["left"][0]), int(self.number(now)[0, 0])
        return f"rotor {which} {self.word}" + (f" to {100 * left:.0f} %" if left else "")


@register_event
class RotorFailure(_OneRotor):
    """A motor fails: the largest speed of its rotor falls to a share of it, 0 by default."""

    name, changes, word = "rotor_failure", (SPEED_LIMIT,), "fails"

    def effect(self, now: Happening) -> tuple[Array, ...]:
        """The largest speeds that are left."""
        return (self.factor(now),)


@register_event
class RotorDamage(_OneRotor):
    """A rotor is damaged: its thrust and torque fall to a share, 0.7 to 0.9 by default."""

    name, word, least = "rotor_damage", "is damaged", 0.05
    changes = "rotor.thrust_coefficient", "rotor.torque_coefficient"

    left: float | Range = (0.7, 0.9)
    """Share of thrust and torque that is left; drawn between two numbers."""

    def effect(self, now: Happening) -> tuple[Array, ...]:
        """The thrust and the torque that are left."""
        return (self.factor(now),) * 2


@register_event
class Payload(Sudden):
    """A payload at the centre of mass, which is dropped: the aircraft is heavier until then."""

    name, changes = "payload", ("mass",)

    mass: float | Range = 0.2
    """Its mass over that of the aircraft; drawn between two numbers."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        object.__setattr__(self, "mass", ranged("payload mass", self.mass, 0, 10))

    @property
    def burden(self) -> tuple[float, float]:
        """The weight with the heaviest one."""
        return 1.0 + cast(Range, self.mass)[1], 1.0

    def draw(self, rng: Rng, time_limit: float) -> Memory:
        """When it is dropped, and its mass (n,)."""
        memory = super().draw(rng, time_limit)
        memory["mass"] = rng.uniform(*cast(Range, self.mass))
        return memory

    def effect(self, now: Happening) -> tuple[Array, ...]:
        """The mass of both, or of the aircraft alone."""
        return (np.where(self.happened(now), 1.0, 1.0 + now.memory["mass"][:, None]),)

    def told(self, now: Happening) -> str:
        """Whether it is dropped."""
        return "payload dropped" if self.happened(now).any() else "with payload"


@register_event
class GustFront(Sudden):
    """A gust front: a wind that rises within a time, as (1 - cos) does, and stays."""

    name, changes = "gust_front", (WIND,)

    speed: float | Range = 5.0
    """Speed that the wind rises to [m/s]; drawn between two numbers."""
    direction: float | None = None
    """Direction in which it blows, from east towards north [rad]; None to draw one."""
    rise: float = 0.5
    """Time in which it rises [s]."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        object.__setattr__(self, "speed", ranged("gust_front speed", self.speed, 0, MAX_WIND))
        if self.direction is not None:
            number("gust_front direction", self.direction)
        number("gust_front rise", self.rise, 0.01, 1e3)

    @property
    def strongest_wind(self) -> float:
        """The fastest that it blows [m/s]."""
        return cast(Range, self.speed)[1]

    def draw(self, rng: Rng, time_limit: float) -> Memory:
        """When it begins, its speed (n,) [m/s] and its direction (n,) [rad]."""
        memory = super().draw(rng, time_limit)
        memory["speed"] = rng.uniform(*cast(Range, self.speed))
        bearing = rng.uniform(0.0, FULL_TURN)
        memory["direction"] = bearing if self.direction is None else 0 * bearing + self.direction
        return memory

    def effect(self, now: Happening) -> tuple[Array, ...]:
        """The wind of the front."""
        since = (now.time - now.memory["at"]) / self.rise
        speed = now.memory["speed"] * 0.5 * (1.0 - np.cos(math.pi * np.clip(since, 0.0, 1.0)))
        bearing = now.memory["direction"]
        return (stack(speed * np.cos(bearing), speed * np.sin(bearing), 0.0 * speed),)

    def told(self, now: Happening) -> str:
        """Whether it blows."""
        return "gust front" if self.happened(now).any() else ""


def resolve(given: Happens) -> dict[str, Event]:
    """Make events by name from a name, from names, or from a mapping of names to their options.

    The name "none" alone is for no event.

    Raises:
        QuadrlError: The event or an option is unknown, or an option is out of range.
    """
    named: Any = given
    if not isinstance(given, Mapping):
        given = [given] if isinstance(given, str) else given or ()
        if not (isinstance(given, (list, tuple)) and all(isinstance(n, str) for n in given)):
            allowed = "a name, a list of names, or a mapping of names to options"
            raise QuadrlError(name="events", value=given, allowed=allowed)
        named = dict.fromkeys(given)
    if [*named] == ["none"]:
        return {}
    return {name: _made(name, options) for name, options in named.items()}


def _made(name: str, options: Any) -> Event:
    kind = EVENTS[choice("event", name, EVENTS, IN_A_FILE)]
    options = record(name, {} if options is None else tuples(options), kind, "option")
    if not isinstance(options, kind):
        raise QuadrlError(name=f"event {name}", value=options, allowed="a mapping of its options")
    return options
