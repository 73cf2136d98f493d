"""The disturbances of a robustness card, each at levels that are the same for every policy."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from quadrl.conditions.randomization import Errors, Pushes, Randomization
from quadrl.conditions.randomizations import RANDOMIZATIONS
from quadrl.conditions.weather import Weather
from quadrl.core.scenario import Scenario

PUSHES_PER_SECOND = 0.5  # chosen: about five in a flight of 10 s


@dataclasses.dataclass(frozen=True)
class Disturbance:
    """One disturbance, at levels that are the same for every policy."""

    name: str
    label: str
    unit: str
    levels: tuple[float, ...]
    """In rising order."""
    at: Callable[[float], Randomization | Weather]
    """What flights of a level are disturbed by."""
    usual: float = 0.0
    """The level at which nothing is disturbed; one of the levels."""


def _noise(times: float) -> Randomization:
    full = vars(RANDOMIZATIONS["full"].noise)
    return Randomization(noise=Errors(**{name: times * size for name, size in full.items()}))


def _pushes(speed: float) -> Randomization:
    pushes = Pushes(rate=PUSHES_PER_SECOND, velocity=speed, body_rate=speed)
    return Randomization(pushes=pushes if speed else Pushes())


def _exactly(name: str, value: float) -> Randomization:
    given: dict[str, Any] = {name: (value, value)}
    return Randomization(**given)


def _delay(milliseconds: float) -> Randomization:
    return _exactly("command_delay", milliseconds / 1000)


def _jitter(percent: float) -> Randomization:
    return _exactly("command_jitter", percent / 100)


def _outages(milliseconds: float) -> Randomization:
    given: dict[str, Any] = {"command_loss": 1.0, "loss_time": milliseconds / 1000}
    return Randomization(**given) if milliseconds else Randomization()


def _weather(name: str) -> Callable[[float], Weather]:
    return lambda level: Weather(**{name: level})


def _factor(name: str) -> Callable[[float], Randomization]:
    return lambda level: _exactly(name, level)


def _loss(name: str) -> Callable[[float], Randomization]:
    return lambda percent: _exactly(name, 1 - percent / 100)


WIND_SPEEDS = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
GUST_SPEEDS = (0.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0, 20.0)
MASSES = (0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2, 1.3)
INERTIAS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)
LOSSES = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0)
DELAYS = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 70.0, 100.0)
JITTERS = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 75.0, 100.0)
OUTAGES = (0.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 800.0)
LAGS = (0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
NOISES = (0.0, 1.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0)
PUSHES = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
SPECIFIED = "of the specified"
DISTURBANCES = {
    one.name: one
    for one in (
        Disturbance("wind", "mean wind, turbulent", "m/s", WIND_SPEEDS, _weather("wind_speed")),
        Disturbance("gust", "one gust", "m/s", GUST_SPEEDS, _weather("gust_speed")),
        Disturbance("mass", "mass", SPECIFIED, MASSES, _factor("mass"), 1.0),
        Disturbance("inertia", "inertia", SPECIFIED, INERTIAS, _factor("inertia"), 1.0),
        Disturbance("thrust", "thrust lost", "%", LOSSES, _loss("thrust")),
        Disturbance("one_rotor", "thrust lost by one rotor", "%", LOSSES, _loss("one_rotor")),
        Disturbance("delay", "delay of commands", "ms", DELAYS, _delay),
        Disturbance("lag", "rotor lag", SPECIFIED, LAGS, _factor("lag"), 1.0),
        Disturbance("noise", "noise of the estimate", "of 'full'", NOISES, _noise),
        Disturbance("pushes", "pushes, 0.5 per second", "m/s", PUSHES, _pushes),
        Disturbance("jitter", "commands one step late", "%", JITTERS, _jitter),
        Disturbance("outages", "outages, 1 per second", "ms", OUTAGES, _outages),
    )
}
"""By name."""


def disturbed(scenario: Scenario, level: Randomization | Weather) -> Scenario:
    """A scenario with the change that a level stands for."""
    name = "weather" if isinstance(level, Weather) else "randomization"
    usual, changes = type(level)(), vars(level).items()
    changes = {field: value for field, value in changes if value != getattr(usual, field)}
    changed: Any = {name: dataclasses.replace(getattr(scenario, name), **changes)}
    return dataclasses.replace(scenario, **changed)
