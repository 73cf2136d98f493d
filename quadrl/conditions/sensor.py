"""Base class and registry of sensors, and the output of a sensor for a batch of aircraft."""

from __future__ import annotations

import abc
import dataclasses
import functools
import zlib
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar, cast, dataclass_transform

from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.rotors import MAX
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import SENSORS as STREAMS
from quadrl.base.rotation import Array, namespace
from quadrl.base.validation import IN_A_FILE, choice, number, record, registered, whole_steps
from quadrl.conditions.randomization import LONGEST_DELAY
from quadrl.conditions.world import World, above_ground
from quadrl.engines.rays import Rays
from quadrl.engines.state import State

ROUNDING = 1e-6  # of the time between two samples, as a share
SYMBOLS = {
    "R": "rotation matrix from body to world, R^T its transpose; of the estimated attitude",
    "T": "control_timestep [s]",
    "command": "of an action: clip(at_0 + action (change where action > 0, else -change_down), "
    "least, most)",
    "p, v": "position [m] and velocity [m/s], estimated; in the world frame, as goal and wind are",
}
"""What the letters in the formulas of exports mean."""
Memory = dict[str, Array]
VALUES = "values"
"""Where the output of a sensor keeps its samples, beside what the sensor remembers."""
Kind = TypeVar("Kind", bound=type)


@dataclasses.dataclass(slots=True)
class Moment:
    """All that a sensor may read at the end of a control step; arrays (n, ...)."""

    true: State
    action: Array  # (n, k), as it was given; zero at the start
    wind: Array  # (n, 3) [m/s], world frame
    parameters: Parameters  # of the specified aircraft
    world: World  # far from everything where the task declares no solids
    origin: Array  # (3,) [m], world frame, of the task's frame
    tasks: tuple[str, ...]  # names of what is flown: of the task, or of those that are drawn
    steps: Array  # (n,) control steps since the start
    aged: Array  # (n, 13) coordinates as old as is drawn: position [m], world frame, quaternion,
    # velocity [m/s], world frame, body rate [rad/s], body frame
    errors: Array  # (n, 12) of the estimate: position, attitude, velocity, body rate
    drawn: Array  # (n, d) what was drawn, from -1 to 1
    happening: Array  # (n, h) what events do, as `Events.seen` gives it
    airframe: Array  # (n, 16) of `quadrotor.authority`; (n, 0) where no sensor reads it
    bias: Mapping[str, Array]  # (n, size) errors that last for the episode, by sensor
    normal: Mapping[str, Array]  # (n, size) normal numbers of this step, by sensor
    state: State  # estimated on board; the true one where nothing disturbs the estimate
    rotor_speed: Array  # (n, R) [rad/s], for the estimate
    entries: Array = None  # (n, e), the task's entries that are seen, of the estimated state
    estimated: Mapping[str, Array] = dataclasses.field(default_factory=dict[str, Array])
    """All the task's entries, (n, k) by name, of the estimated state."""
    truth: Mapping[str, Array] = dataclasses.field(default_factory=dict[str, Array])
    """The same, of the true state."""
    observed: Array = None  # (n, m), all measured entries as they are seen, with their delays
    memory: Memory = dataclasses.field(default_factory=Memory)  # what the sensor itself remembers
    last: Array = None  # (n, size), the sensor's newest sample; None as an episode begins

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
    compiled: ClassVar[bool] = False
    """Whether a control step with it may be compiled: what its functions read besides their
    arguments then stays as it is. quadrl's own are; a class says it for itself alone."""
    formula: ClassVar[str] = ""
    """How a sample follows, step by step, for those who fly without quadrl: exports say it beside
    the sensor's options. `SYMBOLS` has its letters."""

    exact: ClassVar[Mapping[str, float]] = {"noise": 0.0, "bias": 0.0}
    """Options with which its samples have no errors."""

    noise: float = 0.0
    """Standard deviation of the error of each sample, in the sensor's unit."""
    bias: float = 0.0
    """Largest error that lasts for an episode."""
    delay: float = 0.0
    """Age of what is seen [s], in whole control steps."""
    rate: float = 0.0
    """Samples in a second, each taken in the control step in which it is due and held until the
    next one; 0 for one at each control step."""

    def __post_init__(self) -> None:
        """Validate the options."""
        for name in ("noise", "bias", "rate", "delay"):
            most = LONGEST_DELAY if name == "delay" else MAX
            value = number(f"{self.name} {name}", getattr(self, name), 0, most)
            object.__setattr__(self, name, value)

    def width(self, sizes: Sizes) -> int:
        """Numbers in a sample on an aircraft."""
        return self.size

    @functools.cached_property
    def rays(self) -> Rays | None:
        """Rays whose readings `now.world.ranges` of its name gives."""
        return None

    @property
    def hides(self) -> tuple[str, ...]:
        """Entries of the task that it hides."""
        return ()

    def check(self, tasks: tuple[str, ...]) -> None:
        """Refuse tasks, by their names, in which it has nothing to sense.

        Raises:
            QuadrlError: There is such a task.
        """
        return

    @property
    def asks_compiled(self) -> bool:
        """Whether its class asks for its functions to be compiled, and not only a base of it."""
        return vars(type(self)).get("compiled", False)

    def begin(self, now: Moment) -> Memory:
        """Its memory at the start of episodes, arrays (n, ...) by name."""
        return {}

    @property
    def follows(self) -> bool:
        """Whether it follows the commands to the rotors."""
        return type(self).follow is not Sensor.follow

    def follow(
        self, memory: Memory, specified: Parameters, command: Array, seconds: float
    ) -> Memory:
        """Its memory after commands (N, R) [rad/s] to the rotors for a time [s]."""
        return memory

    def update(self, now: Moment) -> Memory:
        """Its memory after a control step, which replaces `now.memory`."""
        return now.memory

    def drawn(self, width: int) -> int:
        """How many normal numbers `sample` takes, for a sample of some width."""
        return width if self.noise else 0

    @abc.abstractmethod
    def sense(self, now: Moment) -> Array:
        """A sample without errors, (n, size)."""

    def sample(self, now: Moment, width: int) -> Array:
        """A sample with its errors, (n, width)."""
        sample, expected = self.sense(now), (len(now.steps), width)
        if getattr(sample, "shape", None) != expected:
            allowed = f"an array {expected}"
            raise QuadrlError(name=f"sense of {self.name}", value=sample, allowed=allowed)
        if self.bias:
            sample = sample + now.bias[self.name]
        if self.noise:
            sample = sample + self.noise * now.normal[self.name]
        return sample

    def tell(self, now: Moment, seen: Array) -> None:
        """Write what is seen of all aircraft (n, size) into `now`, for the sensors after it."""
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
    """The output of a sensor: its samples with errors, rate and delay.

    Its memory holds VALUES (n, 1 + delay, width), the samples that are seen or will be, the newest
    first, and what the sensor remembers.
    """

    def __init__(self, sensor: Sensor, sizes: Sizes, timestep: float) -> None:
        """Lay it out.

        Raises:
            QuadrlError: The delay is not a multiple of the time step [s], or there are more samples
                than steps.
        """
        self.sensor, self.width = sensor, sensor.width(sizes)
        name = f"{sensor.name} delay [s]"
        (self._delay,) = whole_steps(name, [sensor.delay], timestep, "control")
        period = 1 / (sensor.rate * timestep) if sensor.rate else 1.0
        if period < 1 - ROUNDING:
            often = 1 / timestep
            allowed = f"at most {often:g}, one in each of the control steps of {timestep:g} s"
            raise QuadrlError(name=f"{sensor.name} rate", value=sensor.rate, allowed=allowed)
        whole = round(period)
        # As a number of steps where it is nearly one, so that no sample comes a step too late.
        self._period = float(whole) if abs(period - whole) < ROUNDING * period else period
        self.stream = STREAMS + 2 * (zlib.crc32(sensor.name.encode()) >> 3)
        """Stream of the errors of samples; that of the lasting errors is the next one."""

    def seen(self, memory: Memory) -> Array:
        """What is seen, (n, width)."""
        return memory[VALUES][:, self._delay]

    def begin(self, now: Moment) -> Memory:
        """Begin episodes, whose first sample is seen until the next one arrives."""
        now.memory, now.last = self.sensor.begin(now), None
        sample = self.sensor.sample(now, self.width)
        values = namespace(sample).stack([sample] * (1 + self._delay), axis=1)
        return {VALUES: values, **now.memory}

    def step(self, memory: Memory, now: Moment) -> Memory:
        """Take a sample after a control step."""
        last = memory[VALUES]
        now.memory = {name: array for name, array in memory.items() if name != VALUES}
        now.memory, now.last = self.sensor.update(now), last[:, 0]
        sample, xp = self.sensor.sample(now, self.width), namespace(last)
        if self._period > 1:
            due = xp.floor(now.steps / self._period) != xp.floor((now.steps - 1) / self._period)
            sample = xp.where(due[:, None], sample, last[:, 0])
        values = xp.concatenate([sample[:, None], last[:, :-1]], axis=1)
        return {VALUES: values, **now.memory}
