"""Base class and registry of sensors, and the output of a sensor for a batch of aircraft."""

from __future__ import annotations

import abc
import dataclasses
import zlib
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar, cast, dataclass_transform

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.rotors import MAX
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import SENSORS as STREAMS
from quadrl.base.rotation import Array
from quadrl.base.validation import IN_A_FILE, choice, number, record, registered, whole_steps
from quadrl.conditions.event_process import Events
from quadrl.conditions.randomization import LONGEST_DELAY
from quadrl.conditions.randomizer import Randomizer
from quadrl.conditions.world import World, above_ground
from quadrl.engines import native
from quadrl.engines.engine import Engine
from quadrl.engines.rng import normal, uniform
from quadrl.engines.state import Frame, State

SYMBOLS = {
    "R": "rotation matrix from body to world, R^T its transpose; of the estimated attitude",
    "T": "control_timestep [s]",
    "command": "of an action: clip(at_0 + action (change where action > 0, else -change_down), "
    "least, most)",
    "p, v": "position [m] and velocity [m/s], estimated; in the world frame, as goal and wind are",
}
"""What the letters in the formulas of exports mean."""
Memory = dict[str, Array]
Kind = TypeVar("Kind", bound=type)


@dataclasses.dataclass(slots=True)
class Moment:
    """All that a sensor may read at the end of a control step; arrays (n, ...)."""

    true: State
    state: State  # estimated on board; the true one where nothing disturbs the estimate
    rotor_speed: Array  # (n, R) [rad/s], for the estimate
    wind: Array  # (n, 3) [m/s], world frame
    action: Array  # (n, k), as it was given; zero at the start
    parameters: Parameters  # of the specified aircraft
    randomizer: Randomizer
    rows: np.ndarray | None  # (n,) which aircraft; None for all
    frame: EstimatedState | None  # keeps the estimate; None where it is the true state
    entries: Array = None  # (n, e), the task's entries that are seen, of the estimated state
    estimated: Mapping[str, Array] = dataclasses.field(default_factory=dict[str, Array])
    """All the task's entries, (n, k) by name, of the estimated state."""
    truth: Mapping[str, Array] = dataclasses.field(default_factory=dict[str, Array])
    """The same, of the true state."""
    observed: Array = None  # (n, m), all measured entries as they are seen, with their delays
    memory: Memory = dataclasses.field(default_factory=Memory)  # what the sensor itself remembers
    events: Events | None = None  # what happens in flight, where something does
    world: World = None  # type: ignore[assignment] - of this moment; far from all without solids

    @property
    def above_ground(self) -> Array:
        """Height of the lowest part above the ground, (n,) [m]; the ground is no solid."""
        return above_ground(self.true, self.parameters)


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of what sensors read, for one aircraft."""

    rotors: int
    actions: int
    entries: int = 0
    truth: int = 0
    drawn: int = 0
    happening: int = 0
    observed: int = 0


@dataclasses.dataclass(frozen=True)
class Sensor(abc.ABC):
    """A sensor of N aircraft. Its errors are the same for each of its numbers."""

    name: ClassVar[str]
    """The name in the registry and of the entry in the observation."""
    size: ClassVar[int] = 1
    """Numbers in a sample."""
    unit: ClassVar[str] = "1"
    measured: ClassVar[bool] = True
    """Whether it is part of the observation's history."""
    shown: ClassVar[bool] = True
    """Whether it is an entry of the observation."""
    last: ClassVar[bool] = False
    """Whether it reads the task's entries or what is observed; a task cannot see such a sensor."""
    formula: ClassVar[str] = ""
    """How a sample follows, step by step, for those who fly without quadrl: exports say it beside
    the sensor's options. `SYMBOLS` has its letters."""

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

    def width(self, sizes: Sizes) -> int:
        """Numbers in a sample on an aircraft."""
        return self.size

    @property
    def hides(self) -> tuple[str, ...]:
        """Entries of the task that it hides."""
        return ()

    def begin(self, now: Moment) -> Memory:
        """Its memory at the start of episodes, arrays (n, ...) by name."""
        return {}

    def follow(
        self, memory: Memory, specified: Parameters, command: Array, seconds: float
    ) -> Memory:
        """Its memory after commands (N, R) [rad/s] to the rotors for a time [s]."""
        return memory

    def update(self, now: Moment) -> Memory:
        """Its memory after a control step, which replaces `now.memory`."""
        return now.memory

    @abc.abstractmethod
    def sense(self, now: Moment) -> Array:
        """A sample without errors, (n, size)."""

    def tell(self, now: Moment, seen: Array) -> None:
        """Write what is seen of all aircraft (N, size) into `now`, for the sensors after it."""
        return


SENSORS: dict[str, type[Sensor]] = {}
"""Every registered sensor by name."""


@dataclass_transform(frozen_default=True)
def register_sensor(kind: Kind) -> Kind:
    """Add a sensor to the registry, so that `observe` finds it by its name.

    Raises:
        QuadrlError: It is not a Sensor subclass with a name, or another sensor has the name.
    """
    given, name = cast(Any, kind), registered("sensor", kind, Sensor, SENSORS)
    SENSORS[name] = dataclasses.dataclass(frozen=True)(given)
    return kind


def make(name: str, options: Any) -> Sensor:
    """Make the sensor of a name with some options.

    Raises:
        QuadrlError: The sensor or an option is unknown; the message lists the choices.
    """
    kind = SENSORS[choice("sensor", name, SENSORS, IN_A_FILE)]
    if not isinstance(options, Mapping):
        raise QuadrlError(name=f"sensor {name}", value=options, allowed="a mapping of its options")
    return record(name, options, kind, "option")


class Channel:
    """The output of a sensor for N aircraft: its samples with errors, rate and delay."""

    def __init__(
        self, sensor: Sensor, sizes: Sizes, randomizer: Randomizer, timestep: float
    ) -> None:
        """Set up the arrays.

        Raises:
            QuadrlError: The delay or the time between two samples is not a multiple of the time
                step [s].
        """
        self.sensor, self.width, self._randomizer = sensor, sensor.width(sizes), randomizer
        times = sensor.delay, 1 / sensor.rate if sensor.rate else timestep
        names = f"{sensor.name} delay and time of a sample [s]"
        self._delay, self._period = whole_steps(names, times, timestep, "control")
        self._stream = STREAMS + 2 * (zlib.crc32(sensor.name.encode()) >> 3)
        self._rows = np.arange(len(randomizer.steps))
        shape = 1 + self._delay, len(self._rows), self.width
        self._values = np.zeros(shape)  # the newest first
        self._bias = np.zeros(shape[1:])
        self._memory: Memory = {}

    @property
    def seen(self) -> Array:
        """What is seen now, (N, width)."""
        return self._values[self._delay]

    def begin(self, now: Moment) -> None:
        """Begin episodes, whose first sample is seen until the next one arrives."""
        rows = self._rows if now.rows is None else now.rows
        now.memory = self.sensor.begin(now)
        kept = {name: np.array(array) for name, array in self._memory.items()}
        for name, array in now.memory.items():
            kept.setdefault(name, np.zeros((len(self._bias), *array.shape[1:])))[rows] = array
        if self.sensor.bias:
            keys, episodes = self._randomizer.place[:, rows]
            shares = uniform(keys, episodes, self._stream + 1, 0, self.width)
            self._bias[rows] = self.sensor.bias * (2 * shares - 1)
        values = self._values.copy()
        values[:, rows] = self._sample(rows, now)
        self._memory, self._values = kept, values
        self.sensor.tell(now, self.seen)

    def follow(self, specified: Parameters, command: Array, seconds: float) -> None:
        """Update the memory by commands (N, R) [rad/s] to the rotors for a time [s]."""
        self._memory = self.sensor.follow(self._memory, specified, command, seconds)

    def step(self, now: Moment) -> None:
        """Take samples of all aircraft after a control step."""
        now.memory = self._memory
        self._memory = now.memory = self.sensor.update(now)
        sample = self._sample(self._rows, now)
        if self._period > 1:
            fresh = self._randomizer.steps % self._period == 0
            sample = cast(Array, np.where(fresh[:, None], sample, self._values[0]))
        self._values = np.concatenate([sample[None], self._values[:-1]])
        self.sensor.tell(now, self.seen)

    def _sample(self, rows: np.ndarray, now: Moment) -> Array:
        """A sample of some aircraft (n,) with its errors."""
        sample, sensor, source = self.sensor.sense(now), self.sensor, self._randomizer
        if np.shape(sample) != (len(rows), self.width):
            allowed = f"an array {(len(rows), self.width)}"
            raise QuadrlError(name=f"sense of {sensor.name}", value=sample, allowed=allowed)
        if sensor.bias:
            sample = sample + self._bias[rows]
        if sensor.noise:
            (keys, episodes), steps = source.place[:, rows], source.steps[rows]
            errors = normal(keys, episodes, steps, self._stream, self.width)
            sample = sample + sensor.noise * errors
        return sample

    def save(self) -> dict[str, np.ndarray]:
        """Copies of the arrays that the next steps depend on, under the sensor's name."""
        own = {"values": self._values, "bias": self._bias, **self._memory}
        return {f"{self.sensor.name}.{name}": np.array(array) for name, array in own.items()}

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        """Restore what `save` returned."""
        start = f"{self.sensor.name}."
        own = {k.removeprefix(start): np.array(v) for k, v in saved.items() if k.startswith(start)}
        self._values, self._bias, self._memory = own.pop("values"), own.pop("bias"), own


class EstimatedState(Frame):
    """A table of states from other coordinates than the engine's."""

    def __init__(self, engine: Engine) -> None:
        """Make the table for the aircraft of an engine."""
        count, rotors = engine.ctrl.shape
        super().__init__(count, rotors)
        self.coordinates = np.zeros((count, 13 + rotors))
        """What it was filled from."""
        self._limits = parameters.limits(parameters.rows(engine.vehicle))
        motion = np.split(self.coordinates, [7, 13], axis=1)
        arrays = (*motion, engine.origin, self._limits, engine.air)
        # As `Rows` in native/state.c.
        self._rows = native.struct(*arrays, 13 + rotors, 0, self.columns, rotors)

    def fill(self, coordinates: np.ndarray, rows: np.ndarray | None) -> State:
        """Fill the table, and return the state of some aircraft (n,), or of all.

        Args:
            coordinates: Coordinates of all, (N, 13 + R): position [m], world frame, quaternion,
                velocity [m/s], world frame, body rate [rad/s], body frame, rotor speeds [rad/s].
            rows: Which aircraft; None for all.
        """
        self.coordinates[:] = coordinates
        ids, count = (None, len(coordinates)) if rows is None else (rows.ctypes.data, len(rows))
        native.library().quadrl_state(self._rows.ctypes.data, count, ids, self.address)
        return self.state if rows is None else State.of_table(self.table[:, rows])
