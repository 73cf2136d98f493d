"""A window of flight, and the derivatives of its return by its actions.

The task's own functions compute rewards and observations once more, with tensors, for all steps of
the window at once. The derivatives of the flight between the steps come from
`quadrl.engines.adjoint`, those of the loops of a control mode from `quadrl.control.autopilot`. They
are combined backwards in time.
"""

from __future__ import annotations

import dataclasses
import operator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from quadrl.base import records
from quadrl.base.errors import QuadrlError
from quadrl.control.modes import Rotor
from quadrl.core.environment import Environment
from quadrl.core.snapshot import Snapshot
from quadrl.core.transition import Clock, Episode, Transition, finish
from quadrl.engines.adjoint import Leg
from quadrl.engines.engine import Engine
from quadrl.engines.state import State

FLAGS = ("terminated", "truncated")
LEAVES = ("was", "end", "command", "before.rotor_command", "action")
"""Attributes of a `Moment` by which the derivatives are taken."""


@dataclasses.dataclass(frozen=True)
class Moment:
    """One control step of N aircraft."""

    was: np.ndarray  # (N, 13 + R), the motion before it: qpos, qvel and rotor speeds
    before: Snapshot
    episode: Episode  # before it
    legs: tuple[Leg, ...]  # of one command each
    setpoint: np.ndarray  # (N, n) of the loops, as `Autopilot` has it; (N, 0) without loops
    command: np.ndarray  # (N, R) [rad/s], mean over the step
    action: np.ndarray  # (N, k)
    end: np.ndarray  # (N, 13 + R), the motion after it
    terminated: np.ndarray  # (N,) bool
    truncated: np.ndarray  # (N,) bool
    diverged: np.ndarray  # (N,) bool


def fly(environment: Environment, action: np.ndarray) -> tuple[Moment, Transition]:
    """Do an `Environment.step`, and record what its derivatives need."""
    assert not environment.randomizer.late  # late commands have no derivatives here
    was, engine = coordinates(environment.engine), environment.engine
    begun = records.copied(environment.snapshot), records.copied(environment.episode)
    environment.begin(action)
    legs: list[Leg] = []
    for steps in environment.commands():
        legs.append(engine.leg(steps))
        engine.advance(steps)
    pilot = environment.autopilot
    setpoint = pilot.setpoint.copy() if pilot else np.zeros((environment.num_envs, 0))
    done = environment.finish()
    flown = tuple(legs), setpoint, np.array(environment.snapshot.rotor_command), action
    flags = (np.array(getattr(done, name)) for name in (*FLAGS, "diverged"))
    return Moment(was, *begun, *flown, coordinates(engine), *flags), done


def coordinates(engine: Engine) -> np.ndarray:
    """qpos, qvel and rotor speeds side by side, (N, 13 + R), a copy."""
    return np.concatenate([engine.qpos, engine.qvel, engine.act], axis=1)


class Window:
    """T control steps of N aircraft; tensors (T * N, ...), one step after another."""

    def __init__(self, environment: Environment, moments: list[Moment]) -> None:
        """Compute rewards and observations of the recorded steps with tensors.

        Raises:
            QuadrlError: The functions of the task cannot be run with tensors.
        """
        self.moments, task = moments, environment.task
        self.shape = len(moments), environment.num_envs  # (T, N)
        leaves = (_joined(moments, name).double().requires_grad_() for name in LEAVES)
        self._leaves = was, end, command, last_command, action = tuple(leaves)
        clock = Clock.of(task, environment.vehicle.control_timestep)
        self._control, self._pilot = environment.control_mode, environment.autopilot
        own, origin = moments[0].before.parameters, environment.origin
        parameters = own.map(lambda rows: torch.tensor(np.ascontiguousarray(rows)))
        time, diverged = _joined(moments, "before.time"), _joined(moments, "diverged")
        moment = parameters, torch.zeros_like(action), last_command, time
        before = Snapshot(_state(was, origin), _joined(moments, "before.task"), *moment)
        steps = _joined(moments, "episode")
        flown = _state(end, origin), action, command, diverged
        try:
            before.potentials = task.measure(before)
            done = finish(task, clock, steps, before, *flown)[2]
            self.observation = torch.cat(list(task.observe(before).values()), -1)
            """The observation before each step, (T * N, size)."""
        except (AttributeError, RuntimeError, TypeError, ValueError) as error:
            reason = f"its functions cannot be run with tensors: {error}"
            allowed = "a task of functions in the array API"
            raise QuadrlError(reason, name="task", value=task.name, allowed=allowed) from error
        self.next_observation = torch.cat(list(done.observation.values()), -1)
        """The observation after each step, (T * N, size)."""
        self.reward = torch.where(diverged, 0.0, done.reward)
        """The reward of each step, (T * N,); 0 where the simulation diverged."""

    @property
    def goes_on(self) -> np.ndarray:
        """Where the flight goes on after the step, but not in the window, (T * N,) bool."""
        terminated, truncated = (np.array([getattr(m, n) for m in self.moments]) for n in FLAGS)
        truncated[-1] = ~terminated[-1]
        return truncated.ravel()

    def vector_jacobian_product(self, earned: Tensor, action: Tensor, gamma: float) -> np.ndarray:
        """Compute the derivatives of the return from each step on by its action, (T, N, k).

        Args:
            earned: The sum, (), of the rewards of the steps and of the values after the window.
            action: The actions as functions of `observation`, (T * N, k).
            gamma: Discount per control step.
        """
        leaves = self._leaves
        by = torch.autograd.grad(earned, leaves, retain_graph=True, materialize_grads=True)
        was, end, command, last, own = map(self._steps, by)
        jacobian = [
            self._steps(torch.autograd.grad(one.sum(), leaves[0], retain_graph=True)[0])
            for one in action.unbind(-1)
        ]  # k of (T, N, 13 + R)
        by_action = np.zeros_like(own)
        later, later_command = np.zeros_like(was[0]), np.zeros_like(last[0])
        for t, moment in reversed(list(enumerate(self.moments))):
            same = ~(moment.terminated | moment.truncated)[:, None]  # the episode goes on
            from_start, from_action = self._through(
                moment,
                np.where(moment.diverged[:, None], 0.0, end[t] + gamma * same * later),
                command[t] + gamma * same * later_command,
            )
            by_action[t] = own[t] + from_action
            later = from_start + was[t]
            for k, row in enumerate(jacobian):
                later += row[t] * by_action[t, :, k, None]
            later_command = last[t]
            lost = ~(np.isfinite(later).all(1) & np.isfinite(by_action[t]).all(1))
            later[lost], by_action[t, lost] = 0.0, 0.0
        return by_action

    def _through(
        self, moment: Moment, by: np.ndarray, by_command: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the derivatives of a number by the motion before a step and by its action.

        Args:
            moment: The step.
            by: Derivatives by the motion after it, (N, 13 + R).
            by_command: Derivatives by the mean command, (N, R).
        """
        if self._pilot is None:
            assert isinstance(self._control, Rotor)
            by, more = moment.legs[0].vector_jacobian_product(by)
            return by, self._control.slope(moment.action) * (more + by_command)
        back, by_setpoint = self._pilot.reversed, np.zeros_like(moment.setpoint)
        for leg in reversed(moment.legs):
            by, more = leg.vector_jacobian_product(by)
            more += by_command / len(moment.legs)
            by_motion, by_own = back.command(leg.start, moment.setpoint, more)
            by, by_setpoint = by + by_motion, by_setpoint + by_own
        by_motion, by_action = back.setpoint(moment.was, moment.action, by_setpoint)
        return by + by_motion, by_action

    def _steps(self, gradient: Tensor) -> np.ndarray:
        """Reshape a gradient by a leaf to (T, N, ...)."""
        return gradient.numpy().reshape(*self.shape, -1)


def _joined(moments: list[Moment], name: str) -> Any:
    """Join an attribute of all moments, arrays (N, ...) or records, to tensors (T * N, ...)."""
    parts = [operator.attrgetter(name)(moment) for moment in moments]
    if isinstance(parts[0], np.ndarray):
        return torch.from_numpy(np.concatenate(parts))
    columns = zip(*map(records.leaves, parts), strict=True)
    joined = (torch.from_numpy(np.concatenate(column)) for column in columns)
    return records.filled(parts[0], joined)


def _state(motion: Tensor, origin: np.ndarray) -> State:
    """Make the state of motions (n, 13 + R)."""
    position = motion[:, :3] - torch.from_numpy(origin)
    parts = motion[:, 3:7], motion[:, 7:10], motion[:, 10:13], motion[:, 13:]
    return State.of_coordinates(position, *parts, float(origin[2]))
