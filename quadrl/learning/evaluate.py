"""Fly a controller through fresh episodes and judge it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from quadrl.environment import Environment
from quadrl.state import State
from quadrl.task import Task
from quadrl.vehicle import Vehicle

if TYPE_CHECKING:
    from quadrl.rendering import Flight

Controller = Callable[[np.ndarray], np.ndarray]
"""Flat observations (N, size) float32 to actions (N, 4)."""

EVALUATION_SEED = 2_000_000_000
"""Beyond the seeds of every training (1000 * 2**20), so that evaluation episodes are fresh ones."""
FINAL_STRETCH = 2.0  # [s], over which position_error_m is the mean


@dataclasses.dataclass(frozen=True)
class Record:
    """Flights step by step, of the N aircraft of an evaluation; T steps are the horizon.

    What follows the end of an aircraft's episode is not a number.
    """

    position: np.ndarray  # (T, N, 3) [m], world, from the origin of the task's frame
    quaternion: np.ndarray  # (T, N, 4) (w, x, y, z)
    velocity: np.ndarray  # (T, N, 3) [m/s], world
    body_rate: np.ndarray  # (T, N, 3) [rad/s], body
    rotor_speed: np.ndarray  # (T, N, 4) [rad/s]
    goal: np.ndarray  # (T, N, 3) [m], task frame
    action: np.ndarray  # (T, N, 4), within [-1, 1]
    error: np.ndarray  # (T, N) [m]
    reward: np.ndarray  # (T, N)
    length: np.ndarray  # (N,) steps of each episode
    terminated: np.ndarray  # (N,) bool
    is_success: np.ndarray  # (N,) bool
    diverged: np.ndarray  # (N,) bool
    markers: tuple[Any, ...]  # (T,) of what the task asks to be drawn, of the first aircraft
    control_step: float  # [s]
    task: Task

    def flight(self, vehicle: Vehicle, episode: int = 0) -> Flight:
        """One aircraft's flight, to be drawn."""
        from quadrl.rendering import Flight

        steps = slice(0, int(self.length[episode]))
        origin = np.array([0.0, 0.0, self.task.origin_height(vehicle)])
        position = self.position[steps, episode] + origin
        return Flight(
            time=np.arange(1, len(position) + 1) * self.control_step,
            qpos=np.concatenate([position, self.quaternion[steps, episode]], axis=1),
            rotor_speed=self.rotor_speed[steps, episode],
            error=self.error[steps, episode],
            reward=self.reward[steps, episode],
            goal=self.goal[steps, episode] + origin,
            control_step=self.control_step,
            max_rotor_speed=vehicle.max_speed,
            task=self.task.name,
            markers=self.markers[steps],
        )


def fly(
    controller: Controller,
    task: str | Task,
    *,
    episodes: int,
    seed: int = EVALUATION_SEED,
    vehicle: Vehicle | None = None,
) -> Record:
    """One episode of each of N aircraft.

    Args:
        controller: A `Policy`, or any function of observations.
        task: A name of the catalogue or a task.
        episodes: N.
        seed: Aircraft i is seeded with seed + i.
        vehicle: The aircraft; None for the paper's.
    """
    environment = Environment(task, num_envs=episodes, seed=seed, vehicle=vehicle)
    observation = environment.flatten(environment.reset())
    names = [f.name for f in dataclasses.fields(Record)][:9]
    history: dict[str, list[np.ndarray]] = {name: [] for name in names}
    alive = np.ones(episodes, dtype=bool)
    length = np.zeros(episodes, dtype=int)
    ends = {name: np.zeros(episodes, bool) for name in ("terminated", "is_success", "diverged")}
    fields, drawn, markers = None, (), []
    while alive.any() and len(history["error"]) < environment.horizon_steps:
        action = np.clip(controller(observation), -1.0, 1.0)
        now = environment.step(action)
        observation = environment.flatten(now.observation)
        state: State = environment.simulation.state
        if environment.fields is not fields:  # else nothing has changed
            fields, drawn = environment.fields, environment.markers()
        markers.append(drawn)
        goal = environment.task.goal(state, environment.fields)
        moment = {"goal": goal, "action": action, "error": now.error, "reward": now.reward}
        for name in names:
            value = np.array(moment[name] if name in moment else getattr(state, name), dtype=float)
            value[~alive] = np.nan
            history[name].append(value)
        length += alive
        for name, flag in ends.items():
            flag |= alive & getattr(now, name)
        alive &= ~(now.terminated | now.truncated)
    return Record(
        **{name: np.stack(values) for name, values in history.items()},
        length=length,
        **ends,
        markers=tuple(markers),
        control_step=environment.vehicle.control_step,
        task=environment.task,
    )


def judge(record: Record) -> dict[str, Any]:
    """The figures of an evaluation.

    Returns:
        episodes; success_rate and survival_rate (shares); position_error_m: mean of the error over
        the last 2 s of the episodes [m]; return_mean and return_std; length_mean_s; diverged; and
        the task's own.
    """
    steps = max(1, round(FINAL_STRETCH / record.control_step))
    number = np.arange(len(record.error))[:, None]
    last = (number >= record.length - steps) & (number < record.length)
    final = np.sum(np.where(last, record.error, 0.0), 0) / last.sum(0)
    returns = np.nansum(record.reward, 0)
    return {
        "episodes": int(len(returns)),
        "success_rate": float(record.is_success.mean()),
        "survival_rate": float(1 - (record.terminated & ~record.is_success).mean()),
        "position_error_m": float(final.mean()),
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "length_mean_s": float(record.length.mean() * record.control_step),
        "diverged": int(record.diverged.sum()),
    } | record.task.figures(record)
