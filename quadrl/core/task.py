"""The base class of tasks: where an episode begins, what is seen and rewarded, and what ends it.

A task is a frozen dataclass: its fields are its options, its methods are pure functions of arrays
with a leading axis N, in any array namespace (NumPy, torch) and on any device. It knows no API, no
clock and no vehicle: all that it may look at is a `Snapshot`. Everything that is the task's stands
in its own file: options, reward weights and terms, start, observation, ends, training defaults, the
yardstick controller's way to fly it, and what counts as solved.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self, cast

import mujoco

from quadrl.aircraft.parameters import Parameters
from quadrl.base.errors import QuadrlError
from quadrl.base.primitives import Primitive
from quadrl.base.records import as_json
from quadrl.base.rotation import Array, norm, to_body
from quadrl.base.validation import keys, like, number
from quadrl.conditions.scene import Scene
from quadrl.conditions.solids import Pose, Solid
from quadrl.control.reading import Motion, Reading
from quadrl.core import rewards
from quadrl.core.markers import Marker
from quadrl.core.observation import OBSERVATION, ObservationTerm, observed_motion
from quadrl.core.observation import ROTATION as ROTATION  # for users' tasks
from quadrl.core.observation import TARGET_MOTION as TARGET_MOTION
from quadrl.core.observation import TARGET_VELOCITY as TARGET_VELOCITY
from quadrl.core.snapshot import EpisodeEnd, Potentials, Rollout, Snapshot, TaskState
from quadrl.core.solved import STILL as STILL
from quadrl.core.solved import TURNING as TURNING
from quadrl.core.solved import Target
from quadrl.engines.rng import Rng
from quadrl.engines.state import Start


def camel(name: str) -> str:
    """The name of a task as classes and Gymnasium's ids have it: MyTask of my_task."""
    return "".join(word.capitalize() for word in name.split("_"))


@dataclasses.dataclass(frozen=True)
class Task(abc.ABC):
    """Base of all tasks: fly to a goal and stay there."""

    name: ClassVar[str]
    """The name in the catalogue."""
    version: ClassVar[int] = 0
    """The -vN of its Gymnasium id, which grows when its numbers change."""
    asks: ClassVar[str]
    """What it asks of the aircraft, in a line."""
    starts: ClassVar[str]
    """How an episode begins, in a line."""
    ends: ClassVar[str]
    """What ends an episode early, in a line."""
    solved: ClassVar[str]
    """What counts as success, in a line."""
    targets: ClassVar[tuple[Target, ...]] = (Target("success_rate", "successful", 0.99, True),)
    """What a trained policy has to reach over many undisturbed episodes; in wind, an aircraft that
    holds its place moves more than `STILL` allows."""
    trained_on: ClassVar[str] = "paper"
    """The aircraft of a training where none is named."""
    trained_by: ClassVar[str] = "ppo"
    """The algorithm of a training, and of a policy that comes with quadrl, where none is named."""
    training: ClassVar[dict[str, Any]] = {}
    """Training settings that differ from the defaults of `quadrl.learning.config.TrainConfig`;
    `vehicle_options` are those of that aircraft, and no other's."""
    training_with: ClassVar[dict[str, dict[str, Any]]] = {}
    """What is different with an algorithm, by its name."""
    gains: ClassVar[dict[str, float]] = {}
    """Gains of the geometric controller that differ from its defaults."""
    observation: ClassVar[dict[str, ObservationTerm]] = OBSERVATION
    """The entries of the observation in the order of the flat vector."""
    heading_matters: ClassVar[bool] = False
    """Whether the attitude error counts yaw against east (0), or only roll and pitch."""
    keeps_place: ClassVar[bool] = True
    """Whether it asks to stay at the goal, or with one that moves: speed relative to it counts."""
    contact: ClassVar[bool] = False
    """Whether the aircraft can touch anything without the episode being over."""
    compiled: ClassVar[bool] = False
    """Whether its step is compiled (`core/compiled.py`), which a class asks for itself: what its
    functions read besides their arguments and options must not change."""
    true_parameters: ClassVar[bool] = False
    """Whether snapshots show the parameters that were drawn, instead of the specified ones."""
    sensors: ClassVar[dict[str, dict[str, Any]]] = {}
    """Sensors that it reads in `Snapshot.sensed`, by name, with their options; policies see what
    they give."""
    tracks: ClassVar[dict[str, ObservationTerm]] = {}
    """What an aircraft measures in flight of what moves of itself: names of methods of a snapshot,
    such as goal, and what they give. An exported policy is given it in each step."""
    variants: ClassVar[dict[str, dict[str, Any]]] = {}
    """Settings of other trainings, by variant: what differs from the usual one; also the algorithm,
    where that is another one."""
    signed: ClassVar[tuple[str, ...]] = ()
    """Options that may be negative although their default is positive."""

    time_limit: float = 10.0
    """Time limit of an episode [s]."""
    settle_time: float = 2.0
    """Time before the time limit over which the final error is averaged [s]; at most the time
    limit."""
    altitude: float = 3.0
    """Height of the origin of the task's frame above the ground [m]; at least the height of the
    aircraft's centre when it stands on its feet."""
    progress_weight: float = 100.0
    """Reward per metre by which the distance to the goal falls."""
    attitude_weight: float = 30.0
    """Reward per unit by which the attitude error falls. With 10 a policy learns the heading late
    or never, and sometimes tips over."""
    speed_weight: float = 2.0
    """Reward per m/s by which the speed falls, or the speed relative to a target (gym-aero has 0.1,
    with which hover takes twice the steps)."""
    spin_weight: float = 1.0
    """Reward per rad/s by which the body rate falls (gym-aero: 0.1)."""
    control_weight: float = 1.0
    """Cost of sum((Omega_c - Omega_hover)^2) / Omega_max^2, for each 0.05 s."""
    smoothness_weight: float = 0.0
    """Cost of sum((Omega_c - Omega_c before)^2) / Omega_max^2, the change of the commands from one
    control step to the next, for each 0.05 s."""
    survival_weight: float = 10.0
    """Reward for each 0.05 s in the air."""

    @classmethod
    def gymnasium_id(cls) -> str:
        """Its id in Gymnasium: quadrl/<CamelCase>-vN."""
        return f"quadrl/{camel(cls.name)}-v{cls.version}"

    def __post_init__(self) -> None:
        """Validate options."""
        number(f"{self.name} time_limit", self.time_limit, positive=True)
        for field in dataclasses.fields(self):
            default, name = field.default, f"{self.name} {field.name}"
            if default is dataclasses.MISSING or default is None:  # the task's own to check
                continue
            value = like(name, getattr(self, field.name), default)
            counts = isinstance(default, (int, float)) and not isinstance(default, bool)
            if counts and default > 0 and field.name not in self.signed:
                number(name, value, 0)
        number(f"{self.name} altitude", self.altitude, 0)
        number(f"{self.name} smoothness_weight", self.smoothness_weight, 0)
        if self.settle_time != Task.settle_time:
            number(f"{self.name} settle_time", self.settle_time, 0, self.time_limit)

    @property
    def asks_compiled(self) -> bool:
        """Whether its class asks for its step to be compiled, and not only a base of it."""
        return vars(type(self)).get("compiled", False)

    @property
    def parts(self) -> tuple[Task, ...]:
        """The tasks that its episodes are of: itself."""
        return (self,)

    def check(self, parameters: Parameters) -> None:
        """Refuse an aircraft that cannot do what is asked, from its parameters (1, ...).

        Raises:
            QuadrlError: The message names the option that asks for too much.
        """
        return

    @abc.abstractmethod
    def begin(self, rng: Rng, parameters: Parameters) -> tuple[Start, TaskState]:
        """How an episode begins, from random numbers and the aircraft's parameters alone.

        What is remembered of the start itself, `remember` fills in.
        """

    def remember(self, start: Start, drawn: TaskState) -> TaskState:
        """What is remembered as an episode begins: a new record, or `drawn` itself.

        Args:
            start: How it begins in fact: a caller of `reset` may have given another start than
                `begin` drew, and wind may have trimmed it.
            drawn: What `begin` gave.
        """
        return drawn

    def update(self, before: Snapshot, now: Snapshot) -> TaskState:
        """What is remembered after a control step: a new record, or `now.task` itself."""
        return now.task

    def duration(self, now: Snapshot) -> tuple[Array, Array] | None:
        """Time limit and settle time of each row's episode [s], (N,) each, in whole control steps.

        The limit stays what it is, at most `time_limit`. None where they are the options.
        """
        return None

    def goal(self, now: Snapshot) -> Array:
        """Where to be, (N, 3) [m], task frame."""
        return now.task.goal

    def target_velocity(self, now: Snapshot) -> Array | None:
        """Velocity of the target, (N, 3) [m/s], world frame; None where nothing moves."""
        return None

    def target_motion(self, now: Snapshot) -> Motion | None:
        """Acceleration [m/s^2] and jerk [m/s^3] of the target, (N, 3) each, world frame.

        None where policies do not see them; else the observation has `TARGET_MOTION`, too.
        """
        return None

    def error(self, now: Snapshot) -> Array:
        """How far the task is from being done, (N,) [m]."""
        return now.potentials.distance

    @property
    def asked(self) -> tuple[Target, ...]:
        """The targets that the task asks for with its options."""
        return self.targets

    def measure(self, now: Snapshot) -> Potentials:
        """The distances that the reward is made of; `now` has no potentials yet."""
        state, target_velocity = now.state, self.target_velocity(now)
        to_goal = self.goal(now) - state.position
        relative = state.velocity - target_velocity if target_velocity is not None else None
        return Potentials(
            to_goal=to_goal,
            distance=norm(to_goal),
            attitude=state.east_error if self.heading_matters else state.level_error,
            speed=state.speed if relative is None else norm(relative),
            angular_speed=state.angular_speed,
        )

    def observe(self, now: Snapshot) -> dict[str, Array]:
        """What the policy sees, by name, in the order of `observation`."""
        state = now.state
        terms = {
            "position": state.position,
            "sin_attitude": state.sin_attitude,
            "cos_attitude": state.cos_attitude,
            **observed_motion(now),
        }
        target_velocity = self.target_velocity(now)
        if target_velocity is not None:
            terms["target_velocity"] = to_body(state.rotation, target_velocity - state.velocity)
        ahead = self.target_motion(now)
        if ahead is not None:
            terms["target_acceleration"] = to_body(state.rotation, ahead[0])
            terms["target_jerk"] = to_body(state.rotation, ahead[1])
        return terms

    def reward(self, before: Snapshot, now: Snapshot, end: EpisodeEnd) -> dict[str, Array]:
        """Named terms (N,) of the reward of one control step; it is their sum, in this order.

        Those of a flight to a goal, for tasks that have none of their own.
        """
        terms = "progress", "attitude", "speed", "spin", "control", "survival", "smoothness"
        return rewards.weighted(self, terms, before, now)

    @abc.abstractmethod
    def terminated(self, now: Snapshot) -> dict[str, Array] | Array:
        """Whether the episode is over before its time, (N,) bool by the name of each such end.

        Trainings and evaluations say how often each was the first that held. One array, without a
        name, will do, too.
        """

    @abc.abstractmethod
    def succeeded(self, now: Snapshot, end: EpisodeEnd) -> Array:
        """Whether an episode that ends now did what was asked, (N,) bool."""

    def guide(self, reading: Reading) -> tuple[Array, Array]:
        """Where controllers fly: to the goal, and along with it where it moves.

        Returns:
            Offset (N, 3) [m] from the aircraft to where it should be, and the velocity (N, 3)
            [m/s] of that place; both in the world frame.
        """
        return reading.to_goal, reading.target_velocity

    def feed_forward(self, reading: Reading) -> Motion | None:
        """Acceleration and jerk of the place that `guide` names; None where they are not known.

        Those of the target, where the observation has them. The geometric controller then need not
        wait for an error of position and velocity to turn into a tilt.
        """
        return reading.target_motion

    def solids(self) -> Sequence[Solid]:
        """The solids of the world, with which aircraft collide in both engines."""
        return ()

    def place(self, rng: Rng, start: Start, state: TaskState) -> Mapping[str, Pose]:
        """Where solids are at the start of episodes (n,), by name; the others are as declared.

        Args:
            rng: Random numbers of their own.
            start: Start of the episodes, as `remember` gets it.
            state: What the task remembers, as `remember` gives it.
        """
        return self.move(state, 0.0 * state.goal[..., 0])

    @property
    def moves(self) -> bool:
        """Whether `move` moves solids; where none moves, steps are many times as fast."""
        return type(self).move is not Task.move

    def move(self, state: TaskState, time: Array) -> Mapping[str, Pose]:
        """Where solids that move are at a time (n,) [s] of episodes, by name.

        An aircraft that touches one is carried along. It is asked at every physics step.
        """
        return {}

    def scene(self, spec: mujoco.MjSpec) -> None:
        """Add other geoms to the world, which free flight does not know."""
        return

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add to the world what `solids` and `scene` say."""
        Scene(self.solids()).add_to(spec)
        self.scene(spec)

    def markers(self, now: Snapshot) -> Sequence[Marker | Primitive]:
        """What to draw of the episode of one aircraft (N = 1); goal and solids are drawn anyway."""
        return ()

    def metrics(self, rollout: Rollout) -> dict[str, float]:
        """The task's own figures of an evaluation, with their units in their names."""
        return {}

    def replace(self, **options: Any) -> Self:
        """A variant with other options.

        Raises:
            QuadrlError: An option that the task does not have; the message lists the choices.
        """
        own = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return self.of(own, **options)

    @classmethod
    def of(cls, own: Mapping[str, Any], /, **options: Any) -> Self:
        """A task of this class with some options; the others are its `own`, or the usual ones.

        Raises:
            QuadrlError: An option that the task does not have; the message lists the choices.
        """
        keys(f"{cls.name} option", options, [f.name for f in dataclasses.fields(cls)])
        try:
            return cls(**{**own, **options})
        except (TypeError, ArithmeticError) as error:  # of a check that is the task's own
            raise QuadrlError(f"{cls.name} options {options}: {error}") from error

    @classmethod
    def usual(cls) -> dict[str, Any]:
        """Its options where none is given."""
        made = ((field, field.default_factory) for field in dataclasses.fields(cls))
        none = dataclasses.MISSING
        return {field.name: field.default if of is none else of() for field, of in made}

    def to_json(self) -> dict[str, Any]:
        """Its options, as JSON can hold them."""
        return as_json(self)


def heads_east(now: Snapshot, tolerance: float) -> Array:
    """Whether the heading is at most `tolerance` [rad] off east, (N,) bool."""
    return now.state.cos_attitude[..., 2] >= math.cos(min(tolerance, math.pi))


def ends_of(task: Task, now: Snapshot) -> dict[str, Array]:
    """What ends the episodes of a task before their time, (N,) bool by name."""
    found = task.terminated(now)
    return cast(dict[str, Array], found) if isinstance(found, dict) else {"terminated": found}


def either(flags: Mapping[str, Array]) -> Array:
    """Whether any of some named flags holds, (N,) bool."""
    return functools.reduce(lambda one, other: one | other, flags.values())
