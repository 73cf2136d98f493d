"""What a task is: where an episode begins, what is seen, what is rewarded and what ends it.

A task is a frozen dataclass: its fields are its options, its methods are pure functions of arrays
with any leading shape, () for one aircraft and (N,) for a batch, in any array namespace. It knows
no front end, no clock and no batch size.
"""

from __future__ import annotations

import abc
import dataclasses
import difflib
import functools
import math
import numbers
import operator
import reprlib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, TypeVar, get_args

import numpy as np

from quadrl.errors import QuadrlError
from quadrl.rotation import (
    Array,
    held,
    namespace,
    norm,
    quaternion_from_heading_and_tilt,
    square_norm,
    stack,
    to_body,
)
from quadrl.state import Start, State
from quadrl.vehicle import ROTORS, Vehicle

if TYPE_CHECKING:
    from quadrl.learning.evaluate import Record

EPISODE_DRAWS = 64
"""Uniform numbers that every episode takes from its aircraft's generator, used or not."""

FULL_TURN = 2 * math.pi
REWARD_TIME = 0.05  # [s], the control step of the paper's aircraft
MAX_OPTION = 1e9
"""Larger options would take the digits from what is added to them."""
CONTACT_HEIGHT = 0.005  # [m], of the lowest foot at which the aircraft counts as standing


class OptionError(QuadrlError, ValueError):
    """A name or a value that is not among the choices."""


class TaskError(QuadrlError, ValueError):
    """A task that gives what no task may; `quadrl.testing.check_task` looks more closely."""


class Draw:
    """Random numbers of the start of an episode, from a block of uniform ones (..., 64).

    One block an episode: adding a draw to a task leaves the later episodes as they were.
    """

    def __init__(self, block: Array) -> None:
        """Take a block of numbers in [0, 1), (..., EPISODE_DRAWS)."""
        self._block = block
        self._used = 0

    def uniform(self, low: float, high: float, size: int | None = None) -> Array:
        """Uniform numbers in [low, high): (...), or (..., size)."""
        first, count = self._used, 1 if size is None else size
        self._used += count
        if self._used > self._block.shape[-1]:
            raise ValueError(
                f"an episode has {self._block.shape[-1]} random numbers to start from, and the "
                f"task asked for {self._used}"
            )
        taken = self._block[..., first] if size is None else self._block[..., first : self._used]
        return low + (high - low) * taken

    def direction(self) -> Array:
        """Unit vectors (..., 3), evenly over the sphere."""
        height = self.uniform(-1.0, 1.0)
        heading = self.uniform(0.0, FULL_TURN)
        xp = namespace(height)
        level = xp.sqrt(1 - height * height)
        return stack(level * xp.cos(heading), level * xp.sin(heading), height)

    def level_direction(self) -> Array:
        """Unit vectors (..., 3), evenly around the horizon."""
        bearing = self.uniform(0.0, FULL_TURN)
        xp = namespace(bearing)
        return xp.stack([xp.cos(bearing), xp.sin(bearing), xp.zeros_like(bearing)], axis=-1)

    def vector(self, length: float, shortest: float = 0.0) -> Array:
        """Vectors (..., 3) of any direction, their length uniform in [shortest, length)."""
        return self.uniform(shortest, length)[..., None] * self.direction()

    def attitude(self, tilt: float, heading: float = FULL_TURN) -> Array:
        """Unit quaternions (..., 4): a heading up to `heading`, a tilt up to `tilt` [rad]."""
        return quaternion_from_heading_and_tilt(
            heading=self.uniform(0.0, heading),
            tilt=self.uniform(0.0, tilt),
            direction=self.uniform(0.0, FULL_TURN),
        )

    def level_start(
        self, position: Array, vehicle: Vehicle, velocity: Array | None = None
    ) -> Start:
        """A start (..., k) at a position: level, any heading, the rotors at hover speed.

        Args:
            position: (..., 3) [m], task frame.
            vehicle: The aircraft.
            velocity: (..., 3) [m/s], world frame; None for at rest.
        """
        xp = namespace(position)
        rest = xp.zeros_like(position)
        return Start(
            position=position,
            quaternion=self.attitude(tilt=0.0),
            velocity=rest if velocity is None else velocity,
            body_rate=rest,
            rotor_speed=xp.full_like(self.uniform(0, 1, ROTORS), vehicle.hover_speed),
        )


@dataclasses.dataclass
class Fields:
    """What a task remembers of an episode, arrays (..., k); a task may add its own."""

    goal: Array  # (..., 3) [m], task frame


FieldsT = TypeVar("FieldsT", bound=Fields)
"""The fields of a task."""


@dataclasses.dataclass(slots=True)
class Measures:
    """Distances from what is asked; the reward is their decrease over a control step."""

    to_goal: Array  # (..., 3) [m], from the aircraft to the goal, world frame
    distance: Array  # (...) [m], what is left to the goal
    attitude: Array  # (...) attitude error |sin zeta - sin zeta_g| + |cos zeta - cos zeta_g|
    speed: Array  # (...) [m/s], relative to the target where there is one
    spin: Array  # (...) [rad/s]


@dataclasses.dataclass(frozen=True, slots=True)
class Errors:
    """Mean of a task's error over an episode, for the judgement at its end."""

    final: Array  # (...) [m], over the last `settle` seconds before the horizon
    mean: Array  # (...) [m], over all of it


@dataclasses.dataclass(slots=True)
class Outcome:
    """How an episode ends, if it ends now."""

    failed: Array  # (...) bool: over before its time, and not by success
    succeeded: Array  # (...) bool


@dataclasses.dataclass(frozen=True)
class Part:
    """One named entry of the observation."""

    size: int
    unit: str
    meaning: str


OBSERVATION = {
    "position": Part(3, "m", "world frame, from the origin of the task's frame"),
    "sin_attitude": Part(3, "1", "sine of roll, pitch and yaw (Z-Y-X)"),
    "cos_attitude": Part(3, "1", "cosine of roll, pitch and yaw"),
    "velocity": Part(3, "m/s", "body frame"),
    "body_rate": Part(3, "rad/s", "angular velocity, body frame"),
    "rotor_speed": Part(4, "1", "over the largest rotor speed"),
    "goal": Part(3, "m", "from the aircraft to the goal, body frame"),
}
"""The observation of every task, in the order of the flat vector."""

TARGET_VELOCITY = {
    "target_velocity": Part(3, "m/s", "of the target relative to the aircraft, body frame")
}
"""What tasks with a moving target add at the end."""


Rgba = tuple[float, float, float, float]
Kind = Literal["goal", "sphere", "ring", "pad", "line", "arrow", "path"]
GOAL_RGBA: Rgba = (0.25, 0.92, 0.50, 0.28)


@dataclasses.dataclass(frozen=True)
class Marker:
    """Something to be drawn, in the task's frame; an environment hands it out in the world's."""

    kind: Kind
    """goal: a sphere with a core and a drop line to the ground. ring: a circle that lies flat. pad:
    a landing pad on the ground below its position. Both turn where `end` is a point on their axis;
    a pad then has its place there."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre, or where a line or an arrow begins [m]."""
    size: float = 0.1
    """Radius of a goal, sphere, ring or pad; width of a line, arrow or path [m]."""
    rgba: Rgba = GOAL_RGBA
    """Colour and opacity, each 0 to 1."""
    end: tuple[float, float, float] | None = None
    """Where a line or an arrow ends [m]."""
    points: Sequence[Sequence[float]] | np.ndarray = ()
    """(n, 3) corners of a path [m]."""
    label: str = ""
    """Written beside a goal or a sphere."""

    def moved(self, offset: np.ndarray) -> Marker:
        """The same marker elsewhere; offset (3,) [m]."""
        points = np.asarray(self.points, dtype=float)
        return dataclasses.replace(
            self,
            position=tuple(np.asarray(self.position) + offset),
            end=None if self.end is None else tuple(np.asarray(self.end) + offset),
            points=points + offset if points.size else (),
        )

    def __post_init__(self) -> None:
        """Refuse what cannot be drawn."""
        if self.kind not in get_args(Kind):
            kinds = ", ".join(get_args(Kind))
            raise OptionError(f"unknown marker {self.kind!r}; choose from {kinds}")
        if self.kind in ("line", "arrow") and self.end is None:
            raise OptionError(f"a marker of kind {self.kind!r} needs its end")


@dataclasses.dataclass(frozen=True)
class Task(abc.ABC, Generic[FieldsT]):
    """Base of all tasks: fly to a goal and stay there."""

    name: ClassVar[str]
    """The name in the catalogue."""
    asks: ClassVar[str]
    """What it asks of the aircraft, in a line."""
    starts: ClassVar[str]
    """How an episode begins, in a line."""
    ends: ClassVar[str]
    """What ends an episode early, in a line."""
    solved: ClassVar[str]
    """What counts as success, in a line."""
    observation: ClassVar[dict[str, Part]] = OBSERVATION
    """The parts of the observation in the order of the flat vector."""
    heading_matters: ClassVar[bool] = False
    """Whether the attitude error counts yaw against east (0), or only roll and pitch."""
    contact: ClassVar[bool] = False
    """Whether the aircraft can touch anything without the episode being over."""

    horizon: float = 10.0
    """Time limit of an episode [s]."""
    settle: float = 2.0
    """Length of the stretch before the horizon over which the final error is taken [s]."""
    altitude: float = 3.0
    """Height of the origin of the task's frame above the ground [m]; at least that of the
    aircraft's centre when it stands on its feet."""
    progress_weight: float = 100.0
    """Reward for a metre of distance gained."""
    attitude_weight: float = 30.0
    """Reward for a unit of attitude error lost: with 10 the heading is learned last or not at all,
    and a policy that knows no heading tips over now and then."""
    speed_weight: float = 2.0
    """Reward for a m/s lost of the speed, or of that relative to a target (gym-aero has 0.1, with
    which hover takes twice the steps)."""
    spin_weight: float = 1.0
    """Reward for a rad/s of body rate lost (gym-aero: 0.1)."""
    control_weight: float = 1.0
    """Cost of sum((Omega_c - Omega_hover)^2) / Omega_max^2, for each 0.05 s."""
    survival_weight: float = 10.0
    """Reward for each 0.05 s in the air."""

    def __post_init__(self) -> None:
        """Refuse options that mean nothing."""
        for field in dataclasses.fields(self):
            if field.default is not dataclasses.MISSING:
                check_option(self.name, field.name, getattr(self, field.name), field.default)
        if self.horizon <= 0:
            raise OptionError(f"{self.name}: horizon = {self.horizon} must be positive")
        if self.altitude < 0:
            raise OptionError(f"{self.name}: altitude = {self.altitude} must not be negative")

    @abc.abstractmethod
    def sample(self, draw: Draw, vehicle: Vehicle) -> tuple[Start, FieldsT]:
        """How an episode begins, from random numbers alone."""

    def update(
        self, state: State, measures: Measures, fields: FieldsT, vehicle: Vehicle
    ) -> FieldsT:
        """The fields after a control step: the same object, or a new one (a waypoint reached)."""
        return fields

    def goal(self, state: State, fields: FieldsT) -> Array:
        """Where to be, (..., 3) [m], task frame."""
        return fields.goal

    def target_velocity(self, state: State, fields: FieldsT) -> Array | None:
        """Velocity of the target, (..., 3) [m/s], world frame; None where nothing moves."""
        return None

    def error(self, state: State, measures: Measures, fields: FieldsT) -> Array:
        """How far the task is from being done, (...) [m]."""
        return measures.distance

    def measure(self, state: State, fields: FieldsT) -> Measures:
        """The distances that the reward is made of."""
        to_goal = self.goal(state, fields) - state.position
        target_velocity = self.target_velocity(state, fields)
        if target_velocity is None:
            speed = held(state.speed)
        else:
            speed = norm(state.velocity - target_velocity)
        return Measures(
            to_goal=to_goal,
            distance=norm(to_goal),
            attitude=held(state.east_error if self.heading_matters else state.level_error),
            speed=speed,
            spin=held(state.spin),
        )

    def observe(
        self, state: State, measures: Measures, fields: FieldsT, vehicle: Vehicle
    ) -> dict[str, Array]:
        """What the policy sees, by name, in the order of `observation`."""
        parts = {
            "position": state.position,
            "sin_attitude": state.sin_attitude,
            "cos_attitude": state.cos_attitude,
            "velocity": state.body_velocity,
            "body_rate": state.body_rate,
            "rotor_speed": state.rotor_speed / vehicle.max_speed,
            "goal": to_body(state.rotation, measures.to_goal),
        }
        target_velocity = self.target_velocity(state, fields)
        if target_velocity is not None:
            relative = target_velocity - state.velocity
            parts["target_velocity"] = to_body(state.rotation, relative)
        return parts

    def reward(
        self,
        before: Measures,
        now: Measures,
        rotor_command: Array,
        outcome: Outcome,
        vehicle: Vehicle,
    ) -> dict[str, Array]:
        """Named terms (...) of the reward of one control step; it is their sum, in this order."""
        share = reward_share(vehicle)
        effort = square_norm((rotor_command - vehicle.hover_speed) / vehicle.max_speed)
        return {
            "progress": self.progress_weight * (before.distance - now.distance),
            "attitude": self.attitude_weight * (before.attitude - now.attitude),
            "speed": self.speed_weight * (before.speed - now.speed),
            "spin": self.spin_weight * (before.spin - now.spin),
            "control": -self.control_weight * share * effort,
            "survival": self.survival_weight * share + 0.0 * effort,
        }

    def term_names(self, vehicle: Vehicle) -> tuple[str, ...]:
        """Names of the reward's terms, in their order."""
        start, fields = self.sample(Draw(np.full(EPISODE_DRAWS, 0.5)), vehicle)
        measures = self.measure(State.of_coordinates(**vars(start), time=np.zeros(())), fields)
        outcome = Outcome(np.False_, np.False_)
        return tuple(self.reward(measures, measures, start.rotor_speed, outcome, vehicle))

    @abc.abstractmethod
    def terminated(
        self, state: State, measures: Measures, fields: FieldsT, vehicle: Vehicle
    ) -> Array:
        """Whether the episode is over before its time, (...) bool."""

    @abc.abstractmethod
    def success(
        self, state: State, fields: FieldsT, errors: Errors, terminated: Array, truncated: Array
    ) -> Array:
        """Whether an episode that ends now did what was asked, (...) bool."""

    def markers(self, fields: FieldsT) -> Sequence[Marker]:
        """What to draw of the task in one aircraft's episode; the goal is drawn anyway."""
        return ()

    def origin_height(self, vehicle: Vehicle) -> float:
        """Height of the origin of the task's frame above the ground [m]."""
        return max(self.altitude, vehicle.ground_clearance)

    def height(self, state: State, vehicle: Vehicle) -> Array:
        """Height of the aircraft's centre above the ground, (...) [m]."""
        return state.position[..., 2] + self.origin_height(vehicle)

    def touches_ground(self, state: State, vehicle: Vehicle) -> Array:
        """Whether an aircraft that should fly has come down to the ground, (...) bool."""
        lowest = vehicle.ground_clearance - self.origin_height(vehicle)
        return state.position[..., 2][()] < lowest  # a scalar, of one aircraft

    def stands(self, state: State, vehicle: Vehicle) -> Array:
        """Whether a foot is on the ground, (...) bool."""
        return self.height(state, vehicle) - vehicle.foot_depth(state.rotation) < CONTACT_HEIGHT

    def strikes_ground(self, state: State, vehicle: Vehicle) -> Array:
        """Whether the hull or a rotor has hit the ground, (...) bool."""
        return self.height(state, vehicle) < vehicle.strike_depth(state.rotation)

    def figures(self, record: Record) -> dict[str, float]:
        """The task's own figures of an evaluation, with their units in their names."""
        return {}

    def replace(self, **options: Any) -> Task:
        """A variant with other options.

        Raises:
            OptionError: An option that the task does not have; the message lists the choices.
        """
        check_choices(options, [f.name for f in dataclasses.fields(self)], f"{self.name} option")
        return dataclasses.replace(self, **options)


def reward_share(vehicle: Vehicle) -> float:
    """What a control step counts of the 0.05 s that weights of running rewards are for.

    Progress adds up to the same whatever the step is; what is paid by the step is paid by time.
    """
    return vehicle.control_step / REWARD_TIME


def total(terms: dict[str, Array]) -> Array:
    """The sum of reward terms, from the first to the last."""
    return functools.reduce(operator.add, terms.values())


def check_option(task: str, option: str, value: object, default: object) -> None:
    """Refuse a value of another kind than the default's, or with a number that is none.

    Raises:
        OptionError: The message names the option, the value and what is expected.
    """
    if _kind(value) != _kind(default):
        raise OptionError(
            f"{task} option {option} = {reprlib.repr(value)}: a {_kind(default)} is expected, such "
            f"as {default!r}"
        )
    if isinstance(value, (str, bool)):
        return
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    # Whole numbers past 64 bits are objects to NumPy.
    if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise OptionError(f"{task}: {option} = {reprlib.repr(value)} is not finite")
    if not (np.abs(array) <= MAX_OPTION).all():
        raise OptionError(
            f"{task}: {option} = {reprlib.repr(value)}: at most {MAX_OPTION:g} is allowed"
        )


def _kind(value: object) -> str:
    if isinstance(value, (bool, str, dict)) or value is None:
        return type(value).__name__
    return "number" if isinstance(value, numbers.Real) else "list"


def check_choices(given: Iterable[str], choices: Iterable[str], what: str) -> None:
    """Raise for the first name that is not among the choices.

    Raises:
        OptionError: The message names it, the nearest choice and all choices.
    """
    allowed = list(choices)
    for name in given:
        if name not in allowed:
            near = difflib.get_close_matches(str(name), allowed, n=1)
            hint = f" (did you mean {near[0]}?)" if near else ""
            raise OptionError(f"unknown {what} {name!r}{hint}; choices: {', '.join(allowed)}")
