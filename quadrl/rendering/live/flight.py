"""A flight in real time, and what its spectator may do to it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array
from quadrl.base.validation import number
from quadrl.conditions.observing import resolve
from quadrl.core.environment import Environment
from quadrl.core.markers import Marker
from quadrl.core.scenario import Scenario
from quadrl.evaluation.in_flight import Controller, begun
from quadrl.evaluation.memory import PolicyInFlight
from quadrl.rendering.drawing import GOAL_RADIUS

MAX_AIRCRAFT = 256
LONGEST = 0.25  # [s] of flight at once; a machine that is slower shows slow motion
TRAIL_SECONDS = 3.0
TURNING = 0.02  # blades are shown at this share of their speed, which the eye can follow
KEY_STEP = 0.25  # of an action
KEYS: dict[str, tuple[int, int, str]] = {
    "I": (0, 1, "forward"),
    "K": (0, -1, "back"),
    "J": (1, 1, "left"),
    "L": (1, -1, "right"),
    "Y": (2, 1, "up"),
    "H": (2, -1, "down"),
    "U": (3, 1, "turn left"),
    "O": (3, -1, "turn right"),
}
"""Key: which number of the velocity setpoint it changes, its sign, and what it does."""


class Keyboard:
    """A controller that holds the velocity which keys have set, the same for every aircraft."""

    control_mode = "velocity"

    def __init__(self) -> None:
        """Begin with standing still."""
        self.action = np.zeros(4)  # forward, left, up, turn; within [-1, 1]

    def press(self, key: str) -> None:
        """Change the velocity by a step with one of KEYS; set it to zero with any other key."""
        if key not in KEYS:
            self.action[:] = 0.0
            return
        axis, sign, _ = KEYS[key]
        self.action[axis] = np.clip(self.action[axis] + sign * KEY_STEP, -1.0, 1.0)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (N, 4) for observations (N, size)."""
        return np.tile(self.action, (len(observation), 1))


class Flight:
    """N aircraft that fly a task in real time; where an episode ends, the next one begins.

    If it is `endless`, only flying into the ground ends one.
    """

    environment: Environment  # where it flies; another one after a change of the control mode
    wind: Array  # (3,) [m/s], world frame
    pose: Array  # (N, 7 + R) position, quaternion, angles of the blades [rad]; as after a step
    trail: Array  # (T, N, 3) [m], world frame, oldest first; NaN before an episode's begin

    def __init__(
        self,
        controller: Controller,
        scenario: Scenario,
        *,
        num_envs: int = 1,
        seed: int = 0,
    ) -> None:
        """Begin the first episodes.

        Args:
            controller: A `Policy`, or any function of observations.
            scenario: What is flown. Where it is not calm, the spectator's wind is ignored.
            num_envs: N, at most MAX_AIRCRAFT.
            seed: Row i has the seed `seed + i`.

        Raises:
            QuadrlError: The controller does not fit, or a number is out of range.
        """
        number("num_envs", num_envs, 1, MAX_AIRCRAFT, whole=True)
        self.scenario, self.task, self.vehicle = scenario, scenario.task, scenario.aircraft
        self.speed, self.paused, self.endless = 1.0, False, False
        self.wind = np.zeros(3)
        self._rows: Any = {"num_envs": num_envs, "seed": seed}
        self._spins = np.sign([rotor.spin for rotor in self.vehicle.rotors])
        self.fly_with(controller)

    def fly_with(self, controller: Controller) -> None:
        """Hand over to another controller.

        Episodes begin anew if its control mode is another, or what it sees.

        Raises:
            QuadrlError: It does not fit the task or the aircraft; nothing has changed then.
        """
        mode = getattr(controller, "control_mode", "rotor")
        seen = resolve(getattr(controller, "conditions", {}).get("observe"))
        scenario = dataclasses.replace(self.scenario, control_mode=mode, observe=seen)
        goes_on = hasattr(self, "environment") and self.environment.scenario == scenario
        environment = self.environment if goes_on else Environment(scenario, **self._rows)
        self._act, self.controller = begun(controller, environment), controller
        if not goes_on:
            self.environment = environment
            self.reset()

    def reset(self) -> None:
        """Begin new episodes of all aircraft."""
        environment, count = self.environment, self.environment.num_envs
        if isinstance(self._act, PolicyInFlight):
            self._act.reset()
        steps = max(2, round(TRAIL_SECONDS / self.vehicle.control_timestep))
        self.trail = np.full((steps, count, 3), np.nan)
        self.time, self.total, self.reward, self.error = np.zeros((4, count))
        self.episodes = self.successes = 0
        self._angles = np.zeros((count, self.vehicle.rotor_count))
        self._observation = np.array(environment.flatten(environment.reset()))
        self._due = self.vehicle.control_timestep  # the wall clock's lead, at most
        self.pose = self._before = self._read()

    def step(self) -> None:
        """Fly one control step in the wind that is set, and begin anew the episodes that end."""
        environment, timestep = self.environment, self.vehicle.control_timestep
        if self.scenario.calm:
            environment.engine.wind[:] = self.wind
        done = environment.step(np.clip(self._act(self._observation), -1.0, 1.0))
        self._observation = np.array(environment.flatten(done.observation))
        self._angles += TURNING * timestep * self._spins * environment.engine.act
        self.time += timestep
        self.reward, self.error = np.array(done.reward), np.array(done.error)
        self.total += self.reward
        self._before, self.pose = self.pose, self._read()
        self.trail[:-1], self.trail[-1] = self.trail[1:].copy(), self.pose[:, :3]
        over = done.terminated | done.truncated
        if self.endless:
            over = done.diverged | (self.pose[:, 2] < 0.0)
        ended = np.flatnonzero(over)
        if len(ended):
            self.episodes += len(ended)
            self.successes += np.count_nonzero(done.is_success[ended])
            if isinstance(self._act, PolicyInFlight):
                self._act.reset(ended)
            self._observation[ended] = environment.flatten(environment.reset(ended))
            self.time[ended] = self.total[ended] = 0.0
            self.trail[:, ended] = np.nan
            self.pose = self._read()
            self._before[ended] = self.pose[ended]

    def advance(self, seconds: float) -> int:
        """Fly for some seconds of the wall clock; returns the number of control steps flown."""
        if self.paused:
            return 0
        timestep, steps = self.vehicle.control_timestep, 0
        self._due = min(self._due + self.speed * seconds, timestep + LONGEST)
        while self._due >= timestep:
            self._due -= timestep
            self.step()
            steps += 1
        return steps

    def step_once(self) -> None:
        """Fly one control step while time stands still, and show its end."""
        self.step()
        self._due = self.vehicle.control_timestep

    def push(self, velocity: Array, row: int) -> None:
        """Change the velocity of an aircraft at once by (3,) [m/s], world frame."""
        self.environment.engine.qvel[row, :3] += velocity

    def drawn(self) -> Array:
        """Poses (N, 7 + R) at this moment, between the last two control steps."""
        share = min(1.0, self._due / self.vehicle.control_timestep)
        before, now = self._before.copy(), self.pose
        # An attitude has two quaternions: take the nearer one.
        same = (before[:, 3:7] * now[:, 3:7]).sum(1, keepdims=True) >= 0
        before[:, 3:7] *= np.where(same, 1.0, -1.0)
        pose = before + share * (now - before)
        pose[:, 3:7] /= np.linalg.norm(pose[:, 3:7], axis=1, keepdims=True)
        return pose

    def markers(self, row: int) -> tuple[Marker | Primitive, ...]:
        """The goal of an aircraft and what its task asks to be drawn, world frame."""
        goal = tuple(self.environment.goals()[row])
        return (
            Marker("goal", goal, GOAL_RADIUS * self.vehicle.scale),
            *self.environment.markers(row),
        )

    def _read(self) -> Array:
        return np.concatenate([self.environment.engine.qpos, self._angles], axis=1)
