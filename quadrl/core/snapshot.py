"""What a task may look at: snapshots of rows of aircraft in flight, and rollouts afterwards."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array
from quadrl.conditions.world import World, above_ground
from quadrl.core.trajectory import Trajectory, outcome
from quadrl.engines.state import State


@dataclasses.dataclass(frozen=True)
class TaskState:
    """What a task remembers of an episode, arrays (N, ...); a task may add its own."""

    goal: Array  # (N, 3) [m], task frame


@dataclasses.dataclass(slots=True)
class Potentials:
    """Distances from what is asked; the reward is their decrease over a control step."""

    to_goal: Array  # (N, 3) [m], from the aircraft to the goal, world frame
    distance: Array  # (N,) [m], distance left to the goal
    attitude: Array  # (N,) attitude error |sin zeta - sin zeta_g| + |cos zeta - cos zeta_g|
    speed: Array  # (N,) [m/s], relative to the target where there is one
    angular_speed: Array  # (N,) [rad/s]


@dataclasses.dataclass(slots=True)
class Snapshot:
    """All that a task may look at, at the end of a control step; arrays (N, ...)."""

    state: State
    task: Any  # the task's own TaskState
    parameters: Parameters  # of the specified aircraft; with `true_parameters` the drawn ones
    action: Array  # (N, k), action of this control step; zero at the start
    rotor_command: Array  # (N, R) [rad/s], mean over the control step; the rotor speed at the start
    time: Array  # (N,) [s], since the start of the episode
    potentials: Potentials = None  # type: ignore[assignment] - what `Task.measure` gives
    sensed: Mapping[str, Array] = dataclasses.field(  # values of the task's sensors, (N, size) each
        default_factory=dict[str, Array]
    )
    world: World | None = None  # of this moment; None where the task declares no solids

    @property
    def above_ground(self) -> Array:
        """Height of its lowest part above the ground, (N,) [m], which is no solid."""
        return above_ground(self.state, self.parameters)

    @property
    def clearance(self) -> Array:
        """Lower bound of the distance from the aircraft to the nearest solid, (N,) [m].

        The ground, which may be nearer, is apart: `above_ground`.
        """
        return self._solids.clearance

    @property
    def touched(self) -> Array:
        """Which of K solids it touched (the fastest touch of this control step), (N, K) bool."""
        return self._solids.touched

    @property
    def touch_speed(self) -> Array:
        """Speed of this touch, (N,) [m/s]; 0 without a touch."""
        return self._solids.touch_speed

    @property
    def landed(self) -> Array:
        """Whether a foot has touched a solid, in this episode, (N,) bool."""
        return self._solids.landed

    @property
    def touch(self) -> Array:
        """The first touch of a foot, (N, 4); 0 before it.

        Speed into the solid and along it [m/s], cosine of the angle between the body's z axis and
        its normal, body rate [rad/s].
        """
        return self._solids.touch

    @property
    def held(self) -> Array:
        """Whether a foot has touched a solid that grips, in this episode, (N,) bool."""
        return self._solids.held

    def solid(self, name: str) -> Array:
        """Centre of a solid, (N, 3) [m], task frame; (N, count, 3) of one with a `count`."""
        return self._solids.solid(name)

    @property
    def _solids(self) -> World:
        if self.world is None:
            reason = "there is nothing to touch: the task declares no solids"
            raise QuadrlError(reason, name="solids", value=(), allowed="at least one")
        return self.world


@dataclasses.dataclass(slots=True)
class EpisodeEnd:
    """Where an episode stands, for the judgement of those that end now; arrays (N,)."""

    terminated: Array  # bool: failure, or success where the task says so
    truncated: Array  # bool: time limit; never together with terminated
    steps: Array  # control steps so far
    error_sum: Array  # [m], sum of the task's error over these steps
    final_sum: Array  # [m], sum over the last `settle_steps` before the time limit
    settle_steps: Array | int  # a number, or (N,) where it differs by row
    succeeded: Array = None  # bool; only the reward sees it

    @property
    def final_error(self) -> Array:
        """Mean error over the last `settle_time` before the time limit, (N,) [m]."""
        return self.final_sum / self.settle_steps

    @property
    def mean_error(self) -> Array:
        """Mean error over the episode so far, (N,) [m]."""
        return self.error_sum / self.steps

    @property
    def failed(self) -> Array:
        """Terminated, and not by success, (N,) bool; for the reward."""
        return self.terminated & ~self.succeeded


@dataclasses.dataclass(frozen=True, repr=False)
class Rollout:
    """One episode of each of N aircraft, step by step; T steps are the longest of them.

    There are S = T + 1 states, the start first: step t leads from state t to state t + 1.
    Everything after the end of an aircraft's episode is NaN.
    """

    position: np.ndarray  # (S, N, 3) [m], task frame
    quaternion: np.ndarray  # (S, N, 4) (w, x, y, z)
    velocity: np.ndarray  # (S, N, 3) [m/s], world frame
    body_rate: np.ndarray  # (S, N, 3) [rad/s], body frame
    rotor_speed: np.ndarray  # (S, N, R) [rad/s]
    goal: np.ndarray  # (S, N, 3) [m], task frame
    target_velocity: np.ndarray  # (S, N, 3) [m/s], world frame; zero where nothing moves
    action: np.ndarray  # (T, N, k), within [-1, 1]
    rotor_command: np.ndarray  # (T, N, R), mean over each step, as a share of the largest speed
    error: np.ndarray  # (T, N) [m]
    reward: np.ndarray  # (T, N)
    wind: np.ndarray  # (T, N, 3) [m/s], world frame; that of the step which led to each state
    remembered: Mapping[str, np.ndarray]  # (T, N, ...) by name: the task's TaskState after a step
    length: np.ndarray  # (N,) steps of each episode
    terminated: np.ndarray  # (N,) bool
    is_success: np.ndarray  # (N,) bool
    diverged: np.ndarray  # (N,) bool
    ended: Mapping[str, np.ndarray]  # (N,) bool by name: how each ended, as `Transition.ended`
    reward_terms: Mapping[str, np.ndarray]  # (N,) by name, summed over each flight
    markers: tuple[Any, ...]  # (T,) of what the task shows of the first aircraft, world frame
    events: tuple[str, ...]  # (T,) of what is said of the events of its flight
    origin: np.ndarray  # (3,) [m], of the task frame in the world frame
    control_timestep: float  # [s]
    task: Any  # the Task that was flown

    def __repr__(self) -> str:
        steps, flights = self.error.shape
        return f"Rollout of {self.task.name}: {flights} flights, {steps} control steps at most"

    def part(
        self, rows: np.ndarray, task: Any, remembered: Mapping[str, np.ndarray], height: float = 0.0
    ) -> Rollout:
        """Some of the flights, by their numbers (n,), with the task of theirs and its memory.

        Its frame is `height` above the one here [m].
        """
        steps, times = int(self.length[rows].max()), len(self.error)

        def own(values: Array) -> Array:  # (T, N, ...), or (S, N, ...)
            return values[: steps + len(values) - times, rows]

        changed = {k: own(v) for k, v in vars(self).items() if getattr(v, "ndim", 0) > 1}
        ends = ("length", "terminated", "is_success", "diverged")
        changed |= {k: getattr(self, k)[rows] for k in ends}
        changed["remembered"] = {k: own(v) for k, v in remembered.items()}
        for name in ("ended", "reward_terms"):
            changed[name] = {k: v[rows] for k, v in getattr(self, name).items()}
        if height:
            up = np.array([0.0, 0.0, height])
            changed |= {k: changed[k] - up for k in ("position", "goal")}
            changed["origin"] = self.origin + up
        return dataclasses.replace(self, **changed, task=task, markers=(), events=())

    @property
    def success_time(self) -> np.ndarray:
        """How long each successful flight took, (n,) [s]."""
        return self.length[self.is_success] * self.control_timestep

    def trajectory(self, vehicle: Vehicle) -> Trajectory:
        """The first flight, to be drawn: the markers are its own."""
        steps = slice(0, int(self.length[0]))
        after = slice(1, steps.stop + 1)
        position, wind = self.position[after, 0] + self.origin, self.wind[steps, 0]
        return Trajectory(
            time=np.arange(1, len(position) + 1) * self.control_timestep,
            qpos=np.concatenate([position, self.quaternion[after, 0]], axis=1),
            rotor_speed=self.rotor_speed[after, 0],
            error=self.error[steps, 0],
            reward=self.reward[steps, 0],
            goal=self.goal[after, 0] + self.origin,
            control_timestep=self.control_timestep,
            max_rotor_speed=vehicle.max_speed,
            task=self.task.name,
            markers=self.markers[steps],
            events=self.events[steps],
            outcome=outcome(self.terminated[0], True, self.is_success[0]),
            wind=wind if wind.any() else None,
        )


def statistic(of: Callable[[np.ndarray], Any], values: np.ndarray) -> float:
    """A statistic of values, such as `np.mean`; NaN if there are none."""
    return float(of(values)) if values.size else math.nan
