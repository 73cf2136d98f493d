"""What a robustness card turns up: one disturbance at a time, from nothing to too much."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from quadrl.conditions.randomization import RANDOMIZATIONS, Errors, Pushes, Randomization
from quadrl.conditions.weather import Weather

PUSHES_PER_SECOND = 0.5  # chosen: about five in a flight of 10 s


@dataclasses.dataclass(frozen=True)
class Axis:
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


def _factor(name: str) -> Callable[[float], Randomization]:
    return lambda level: _exactly(name, level)


def _loss(name: str) -> Callable[[float], Randomization]:
    return lambda percent: _exactly(name, 1 - percent / 100)


WIND_SPEEDS = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
GUST_SPEEDS = (0.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0, 20.0)
LOSSES = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0)
AXES = {
    axis.name: axis
    for axis in (
        Axis("wind", "mean wind, turbulent", "m/s", WIND_SPEEDS, lambda x: Weather(wind_speed=x)),
        Axis("gust", "one gust", "m/s", GUST_SPEEDS, lambda x: Weather(gust_speed=x)),
        Axis(
            *("mass", "mass", "of the specified"),
            (0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2, 1.3),
            *(_factor("mass"), 1.0),
        ),
        Axis(
            *("inertia", "inertia", "of the specified"),
            (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0),
            *(_factor("inertia"), 1.0),
        ),
        Axis("thrust", "thrust lost", "%", LOSSES, _loss("thrust")),
        Axis("one_rotor", "thrust lost by one rotor", "%", LOSSES, _loss("one_rotor")),
        Axis(
            *("delay", "delay of commands", "ms"),
            (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 70.0, 100.0),
            lambda ms: _exactly("command_delay", ms / 1000),
        ),
        Axis(
            *("lag", "rotor lag", "of the specified"),
            (0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0),
            *(_factor("lag"), 1.0),
        ),
        Axis(
            *("noise", "noise of the estimate", "of 'full'"),
            (0.0, 1.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0),
            _noise,
        ),
        Axis(
            *("pushes", "pushes, 0.5 per second", "m/s"),
            (0.0, 0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0),
            _pushes,
        ),
    )
}
"""By name."""
