"""Fly a controller through fresh episodes, in calm air or in gusts, and summarize them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from quadrl.environment import Environment
from quadrl.errors import QuadrlError
from quadrl.policy import Policy
from quadrl.snapshot import Rollout
from quadrl.task import Task
from quadrl.validation import number
from quadrl.vehicle import Vehicle

Controller = Callable[[np.ndarray], np.ndarray]
"""Flat observations (N, size) float32 to actions (N, k); its attribute `control_mode`, if it has
one, says what they mean."""

EVALUATION_SEED = 1 << 53
"""Beyond the seeds of every training (2^32 * 2^20), so that evaluation episodes are fresh ones."""
MAX_SEED, MAX_EPISODES = (1 << 32) - 1, 100_000
FINAL_STRETCH = 2.0  # [s], over which position_error_m is the mean
GUST_TIME = 1.0  # [s], correlation time of the gusts
HISTORY = ("position", "quaternion", "velocity", "body_rate", "rotor_speed", "goal", "action",
           "error", "reward")  # fmt: skip


def fly(
    controller: Controller,
    task: str | Task,
    *,
    episodes: int,
    seed: int = EVALUATION_SEED,
    vehicle: Vehicle | str | None = None,
    control_mode: str | None = None,
    gusts: float = 0.0,
) -> Rollout:
    """Fly one episode of each of N aircraft.

    Args:
        controller: A `Policy`, or any function of observations.
        task: A task or its name.
        episodes: N.
        seed: Aircraft i has the seed `seed + i`.
        vehicle: The aircraft; None for the paper's.
        control_mode: What actions mean; None for what the controller says, or "rotor".
        gusts: Standard deviation of the wind in each direction [m/s]; see `make_gusts`. The
            aircraft does not observe it, and each flies in a wind of its own, from its seed.

    Raises:
        QuadrlError: The controller's actions have another meaning or another size, or an argument
            is out of range.
    """
    own = getattr(controller, "control_mode", None)
    if None not in (control_mode, own) and control_mode != own:
        raise QuadrlError(name="control_mode", value=control_mode, allowed=f"{own!r}, as trained")
    gusts = number("gusts", gusts, 0)
    environment = Environment(
        task,
        num_envs=episodes,
        seed=seed,
        vehicle=vehicle,
        control_mode=control_mode or own or "rotor",
    )
    task, timestep = environment.task, environment.vehicle.control_timestep
    if isinstance(controller, Policy):
        controller.check_fits(environment)
    observation = environment.flatten(environment.reset())
    seeds = range(seed, seed + episodes)
    winds = make_gusts(gusts, environment.time_limit_steps, timestep, seeds) if gusts else None
    history: dict[str, list[np.ndarray]] = {name: [] for name in HISTORY}
    alive = np.ones(episodes, dtype=bool)
    length = np.zeros(episodes, dtype=int)
    ends = {name: np.zeros(episodes, bool) for name in ("terminated", "is_success", "diverged")}
    markers = []
    while alive.any():
        taken = np.clip(controller(observation), -1.0, 1.0)
        if winds is not None:
            environment.engine.air[:] = winds[len(markers)]
        now = environment.step(taken)
        observation = environment.flatten(now.observation)
        markers.append(environment.markers())
        state, goal = environment.snapshot.state, task.goal(environment.snapshot)
        moment = {"goal": goal, "action": taken, "error": now.error, "reward": now.reward}
        for name, values in history.items():
            value = np.array(moment[name] if name in moment else getattr(state, name), dtype=float)
            value[~alive] = np.nan
            values.append(value)
        length += alive
        for name, flag in ends.items():
            flag |= alive & getattr(now, name)
        alive &= ~(now.terminated | now.truncated)
    return Rollout(
        **{name: np.stack(values) for name, values in history.items()},
        length=length,
        **ends,
        markers=tuple(markers),
        origin=np.array(environment.origin),
        control_timestep=timestep,
        task=task,
    )


def make_gusts(deviation: float, steps: int, timestep: float, seeds: range) -> np.ndarray:
    """Wind (steps, N, 3) [m/s], world frame: three Ornstein-Uhlenbeck processes per aircraft.

    The spectrum is that of the longitudinal gusts of Dryden's model (MIL-F-8785C, 3.7.2.2) with
    `GUST_TIME` for length over airspeed, in every direction.

    Args:
        deviation: Of each component at any time [m/s].
        steps: Control steps.
        timestep: Of the control [s].
        seeds: Of the N aircraft.
    """
    keep = np.exp(-timestep / GUST_TIME)
    # Their second word keeps these streams apart from all that have the seed alone.
    rows = [np.random.default_rng([seed, 1]).normal(size=(steps, 3)) for seed in seeds]
    wind = deviation * np.stack(rows, axis=1)
    for k in range(1, steps):  # the first is drawn from the distribution itself
        wind[k] = keep * wind[k - 1] + np.sqrt(1 - keep**2) * wind[k]
    return wind


def summarize(rollout: Rollout) -> dict[str, Any]:
    """The metrics of an evaluation.

    Returns:
        episodes; success_rate and survival_rate (shares); position_error_m and
        position_error_std_m: mean, and deviation over the episodes, of the error over the last 2 s
        [m]; where the heading matters heading_error_deg: mean of |yaw| over the same time;
        return_mean and return_std; length_mean_s; diverged (count); and the task's own metrics.
    """
    steps = max(1, round(FINAL_STRETCH / rollout.control_timestep))
    index = np.arange(len(rollout.error))[:, None]
    last = (index >= rollout.length - steps) & (index < rollout.length)
    final = _means(rollout.error, last)
    returns = np.nansum(rollout.reward, 0)
    w, x, y, z = np.moveaxis(rollout.quaternion, -1, 0)
    yaw = np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)))
    heading = {"heading_error_deg": float(_means(np.abs(yaw), last).mean())}
    return {
        "episodes": len(returns),
        "success_rate": float(rollout.is_success.mean()),
        "survival_rate": float(1 - (rollout.terminated & ~rollout.is_success).mean()),
        "position_error_m": float(final.mean()),
        "position_error_std_m": float(final.std()),
        **(heading if rollout.task.heading_matters else {}),
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "length_mean_s": float(rollout.length.mean() * rollout.control_timestep),
        "diverged": int(rollout.diverged.sum()),
    } | rollout.task.metrics(rollout)


def evaluate(
    controller: Controller,
    task: Task,
    *,
    episodes: int,
    seed: int = 0,
    vehicle: Vehicle | str | None = None,
) -> tuple[dict[str, Any], Rollout]:
    """Fly a controller through episodes that no training has seen.

    Args:
        controller: A `Policy`, or any function of observations.
        task: The task.
        episodes: Their number.
        seed: Of the episodes; the same ones for every controller.
        vehicle: The aircraft; None for the paper's.

    Returns:
        The task's name, the seed and the metrics of `summarize`; and the rollout.
    """
    seed = number("seed", seed, 0, MAX_SEED, whole=True)
    number("episodes", episodes, 1, MAX_EPISODES, whole=True)
    rollout = fly(controller, task, episodes=episodes, seed=EVALUATION_SEED + seed, vehicle=vehicle)
    return {"task": task.name, "seed": seed} | summarize(rollout), rollout


def _means(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Mean of values (T, N) over the chosen steps, (N,)."""
    return np.sum(np.where(chosen, values, 0.0), 0) / chosen.sum(0)
