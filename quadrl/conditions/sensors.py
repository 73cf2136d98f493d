"""Sensors: what is measured on board, each with its own errors, delay and rate.

A sensor is a frozen dataclass: its fields are its options, its methods are pure functions of a
`Moment`. One of your own is a class with `sense`, registered by its name.
"""

from __future__ import annotations

import abc
import dataclasses
import math
import zlib
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.rotors import GRAVITY, MAX
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import SENSORS as STREAMS
from quadrl.base.rotation import Array, to_body, to_world
from quadrl.base.validation import choice, keys, number
from quadrl.conditions.randomization import LONGEST_DELAY
from quadrl.conditions.randomizer import Randomizer
from quadrl.conditions.sampler import whole_steps
from quadrl.engines.dynamics import thrust_wrench
from quadrl.engines.rng import normal, uniform
from quadrl.engines.state import State

Memory = dict[str, Array]
LONGEST_HISTORY = 1000
SMOOTHING = 0.1  # [s], of the acceleration that thrust does not explain
WEIGHT = np.array([0.0, 0.0, -GRAVITY])


@dataclasses.dataclass(slots=True)
class Moment:
    """All that a sensor may look at, at the end of a control step; arrays (N, ...)."""

    true: State
    state: State  # that is estimated on board; the true one where nothing disturbs the estimate
    wind: Array  # (N, 3) [m/s], world frame
    action: Array  # (N, k), as it was given; zero at the start
    parameters: Parameters  # of the specified aircraft
    entries: Array  # (N, e), the task's own entries of the estimated state
    memory: Memory  # what the sensor itself remembers, arrays (N, ...)


@dataclasses.dataclass(frozen=True)
class Sensor(abc.ABC):
    """A sensor of N aircraft. Every number of it has the same errors."""

    name: ClassVar[str]
    """The name in the registry and of the entry in the observation."""
    size: ClassVar[int] = 1
    """Numbers that it gives."""
    unit: ClassVar[str] = "1"
    measured: ClassVar[bool] = True
    """Whether the delay of the observation and its history hold for it."""

    noise: float = 0.0
    """Standard deviation of the error of each sample, in the sensor's unit."""
    bias: float = 0.0
    """Largest error that lasts for an episode."""
    delay: float = 0.0
    """Age of what is seen [s], in whole control steps."""
    rate: float = 0.0
    """Samples in a second, each held until the next one; 0 for one at each control step."""

    def __post_init__(self) -> None:
        """Validate the options."""
        for name in ("noise", "bias", "rate", "delay"):
            most = LONGEST_DELAY if name == "delay" else MAX
            value = number(f"{self.name} {name}", getattr(self, name), 0, most)
            object.__setattr__(self, name, value)

    def width(self, actions: int) -> int:
        """Numbers that it gives on an aircraft with some numbers in an action."""
        return self.size

    def begin(self, now: Moment) -> Memory:
        """What it remembers at the start of episodes, arrays (n, ...) by name."""
        return {}

    def update(self, now: Moment) -> Memory:
        """What it remembers after a control step, in place of `now.memory`."""
        return now.memory

    @abc.abstractmethod
    def sense(self, now: Moment) -> Array:
        """What it measures, (n, size)."""


SENSORS: dict[str, type[Sensor]] = {}
"""Every registered sensor by name."""


def register_sensor(kind: type[Sensor]) -> type[Sensor]:
    """Add a sensor to the registry, so that `observe` knows it by its name.

    Raises:
        QuadrlError: It is not a Sensor subclass with a name, or another sensor has the name.
    """
    name = getattr(kind, "name", None)
    named = isinstance(kind, type) and issubclass(kind, Sensor) and isinstance(name, str)
    if not named or not name.isidentifier():  # type: ignore[union-attr]
        allowed = "a Sensor subclass with a string `name` such as 'my_sensor'"
        raise QuadrlError(name="sensor", value=kind, allowed=allowed)
    if SENSORS.get(name, kind) is not kind:  # type: ignore[arg-type]
        raise QuadrlError(name="sensor name", value=name, allowed="one that no other sensor has")
    SENSORS[name] = kind = dataclasses.dataclass(frozen=True)(kind)  # type: ignore[index]
    return kind


def make(name: str, options: Any) -> Sensor:
    """The sensor of a name with some options.

    Raises:
        QuadrlError: An unknown sensor or option; the message lists the choices.
    """
    kind = SENSORS[choice("sensor", name, SENSORS)]
    if not isinstance(options, Mapping):
        raise QuadrlError(name=f"sensor {name}", value=options, allowed="a mapping of its options")
    keys(f"option of {name}", options, [field.name for field in dataclasses.fields(kind)])
    return kind(**options)


@register_sensor
class Entries(Sensor):
    """The task's own entries of the observation."""

    name, unit = "state", ""

    def sense(self, now: Moment) -> Array:
        """As the task gives them."""
        return now.entries


@register_sensor
class Airspeed(Sensor):
    """Velocity through the air, body frame."""

    name, size, unit = "airspeed", 3, "m/s"

    def sense(self, now: Moment) -> Array:
        """From the estimated velocity."""
        return to_body(now.state.rotation, now.state.velocity - now.wind)


@register_sensor
class Disturbance(Sensor):
    """Acceleration that weight and specified thrust do not explain, body frame."""

    name, size, unit = "disturbance", 3, "m/s^2"

    def begin(self, now: Moment) -> Memory:
        """Nothing is felt yet."""
        motion = moving(now.parameters, now.state)
        return {"motion": motion, "felt": np.zeros((len(motion), 3))}

    def update(self, now: Moment) -> Memory:
        """Smooth what the last control step shows."""
        last, motion = now.memory["motion"], moving(now.parameters, now.state)
        timestep = float(now.parameters.control_timestep)
        return {"motion": motion, "felt": felt(now.memory["felt"], last, motion, timestep)}

    def sense(self, now: Moment) -> Array:
        """In the body frame."""
        return to_body(now.state.rotation, now.memory["felt"])


@register_sensor
class ActionHistory(Sensor):
    """The last actions, the newest first."""

    name, measured = "action_history", False

    length: int = 1
    """How many; zeros before the first."""

    def __post_init__(self) -> None:
        """Validate the options."""
        super().__post_init__()
        number("action_history length", self.length, 1, LONGEST_HISTORY, whole=True)

    def width(self, actions: int) -> int:
        """All numbers of all actions."""
        return self.length * actions

    def begin(self, now: Moment) -> Memory:
        """No action was taken."""
        return {"actions": np.zeros((len(now.action), self.width(now.action.shape[1])))}

    def update(self, now: Moment) -> Memory:
        """Put the last one before the others, of which the oldest goes."""
        older = now.memory["actions"][:, : -now.action.shape[1]]
        return {"actions": np.concatenate([np.clip(now.action, -1.0, 1.0), older], axis=-1)}

    def sense(self, now: Moment) -> Array:
        """As they were taken."""
        return now.memory["actions"]


class Channel:
    """The output of a sensor for N aircraft: its samples with errors, rate and delay."""

    def __init__(self, sensor: Sensor, width: int, randomizer: Randomizer, timestep: float) -> None:
        """Set up the arrays.

        Raises:
            QuadrlError: The delay or the time between two samples is not a multiple of the time
                step [s].
        """
        self.sensor, self._width, self._randomizer = sensor, width, randomizer
        times = sensor.delay, 1 / sensor.rate if sensor.rate else timestep
        names = f"{sensor.name} delay and time of a sample [s]"
        self._delay, self._period = whole_steps(names, times, timestep, "control")
        self._stream = STREAMS + 2 * (zlib.crc32(sensor.name.encode()) >> 3)
        count = len(randomizer.steps)
        self._values = np.zeros((1 + self._delay, count, width))  # the newest first
        self._bias = np.zeros((count, width))
        self._memory: Memory = {}

    @property
    def seen(self) -> Array:
        """What is seen of it now, (N, size)."""
        return self._values[self._delay]

    def begin(self, rows: np.ndarray, now: Moment) -> None:
        """Begin episodes (n,); the first sample is seen until the next one arrives."""
        now.memory = self.sensor.begin(now)
        kept = {name: np.array(array) for name, array in self._memory.items()}
        for name, array in now.memory.items():
            kept.setdefault(name, np.zeros((len(self._bias), *array.shape[1:])))[rows] = array
        if self.sensor.bias:
            keys, episodes = self._randomizer.place[:, rows]
            shares = uniform(keys, episodes, self._stream + 1, 0, self._width)
            self._bias[rows] = self.sensor.bias * (2 * shares - 1)
        values = self._values.copy()
        values[:, rows] = self._sample(rows, now)
        self._memory, self._values = kept, values

    def step(self, now: Moment) -> None:
        """Sense all after a control step."""
        now.memory = self._memory
        self._memory = now.memory = self.sensor.update(now)
        sample = self._sample(np.arange(len(self._bias)), now)
        if self._period > 1:
            fresh = self._randomizer.steps % self._period == 0
            sample = np.where(fresh[:, None], sample, self._values[0])
        self._values = np.concatenate([sample[None], self._values[:-1]])

    def _sample(self, rows: np.ndarray, now: Moment) -> Array:
        """A sample of some aircraft (n,) with its errors."""
        sample, sensor, source = self.sensor.sense(now), self.sensor, self._randomizer
        if np.shape(sample) != (len(rows), self._width):
            allowed = f"an array {(len(rows), self._width)}"
            raise QuadrlError(name=f"sense of {sensor.name}", value=sample, allowed=allowed)
        if sensor.bias:
            sample = sample + self._bias[rows]
        if sensor.noise:
            (keys, episodes), steps = source.place[:, rows], source.steps[rows]
            errors = normal(keys, episodes, steps, self._stream, self._width)
            sample = sample + sensor.noise * errors
        return sample

    def save(self) -> dict[str, np.ndarray]:
        """Copies of what the next steps depend on, by the sensor's name."""
        own = {"values": self._values, "bias": self._bias, **self._memory}
        return {f"{self.sensor.name}.{name}": np.array(array) for name, array in own.items()}

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        """Restore what `save` returned."""
        start = f"{self.sensor.name}."
        own = {k.removeprefix(start): np.array(v) for k, v in saved.items() if k.startswith(start)}
        self._values, self._bias, self._memory = own.pop("values"), own.pop("bias"), own


def moving(specified: Parameters, state: State) -> Array:
    """Velocity [m/s] and the acceleration by the specified thrust [m/s^2], (n, 6), world frame."""
    force, _ = thrust_wrench(specified, state.rotor_speed)
    thrust = to_world(state.rotation, force / specified.mass[:, None])
    return np.concatenate([state.velocity, thrust], axis=-1)


def felt(disturbance: Array, last: Array, now: Array, timestep: float) -> Array:
    """The acceleration that weight and specified thrust do not explain, smoothed.

    Args:
        disturbance: The last one, (n, 3) [m/s^2], world frame.
        last: What `moving` gave a control step ago, (n, 6).
        now: What it gives now.
        timestep: Control timestep [s].
    """
    rate = (now[:, :3] - last[:, :3]) / timestep
    rate = rate - (0.5 * (now[:, 3:] + last[:, 3:]) + WEIGHT)
    return disturbance + (1 - math.exp(-timestep / SMOOTHING)) * (rate - disturbance)
