"""Fly a controller through fresh episodes, in calm air or in wind, and summarize them."""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np

from quadrl.base import machine, records
from quadrl.base.rotation import roll_pitch_yaw
from quadrl.base.validation import action
from quadrl.core.environment import Environment
from quadrl.core.one_of import OneOf
from quadrl.core.scenario import Conditions, Scenario
from quadrl.core.snapshot import Rollout
from quadrl.core.task import Task
from quadrl.evaluation.in_flight import Controller, begun, scenario_of

EVALUATION_SEED = 1 << 53
"""Beyond the seeds of every training (2^32 * 2^20), so that evaluation episodes are fresh ones."""
MAX_SEED, MAX_EPISODES = (1 << 32) - 1, 100_000
FINAL_STRETCH = 2.0  # [s], over which position_error_m is the mean
MOTION = ("position", "quaternion", "velocity", "body_rate", "rotor_speed")
BEHAVIOUR = ("yaw_rate_rad_s", "circling_m_s", "command_change_rate", "saturated_rate",
             "least_height_m")  # fmt: skip
"""How an aircraft flies beside where: what `flights` says of it, in this order."""


def fly(
    controller: Controller,
    task: str | Task | Scenario | None = None,
    *,
    episodes: int,
    seed: int = EVALUATION_SEED,
    **conditions: Unpack[Conditions],
) -> Rollout:
    """Fly one episode of each of N aircraft.

    Each aircraft flies in a wind of its own, from its seed, and does not observe it.

    Args:
        controller: A `Policy`, or any function of observations.
        task: A task or its name, or a whole scenario; None for that of the controller's training.
        episodes: N.
        seed: Aircraft i has the seed `seed + i`.
        **conditions: As `Conditions` has them; what is left out is as in the controller's training.

    Raises:
        QuadrlError: The controller's actions have another meaning or another size, or an argument
            is out of range.
    """
    scenario = scenario_of(controller, task, **conditions)
    environment = Environment(scenario, num_envs=episodes, seed=seed)
    controller = begun(controller, environment)
    flown = environment.task
    observation = environment.flatten(environment.reset())
    steps, known = environment.time_limit_steps, records.leaves(environment.snapshot.task)
    numbers = 24 + 2 * len(environment.vehicle.rotors) + sum(a.size for a in known) // episodes
    machine.check_memory(f"{episodes} flights of {steps} steps", 16.0 * numbers * steps * episodes)
    everyone = np.ones(episodes, dtype=bool)
    states, moments = [_while(everyone, _state(environment))], list[dict[str, np.ndarray]]()
    remembered: list[dict[str, np.ndarray]] = []
    markers, events = [], list[str]()
    alive = everyone.copy()
    shape = episodes, environment.action_size
    length = np.zeros(episodes, dtype=int)
    ends = {name: np.zeros(episodes, bool) for name in ("terminated", "is_success", "diverged")}
    terms = {name: np.zeros(episodes) for name in environment.term_names}
    ended: dict[str, np.ndarray] = {}
    while alive.any():
        taken = np.clip(action(controller(observation), shape), -1.0, 1.0)
        now = environment.step(taken)
        observation = environment.flatten(now.observation)
        markers.append(environment.markers())
        events.append(environment.happening())
        states.append(_while(alive, _state(environment)))
        snapshot = environment.snapshot
        moment = {
            "action": taken,
            "rotor_command": snapshot.rotor_command / environment.vehicle.max_speed,
            "error": now.error,
            "reward": now.reward,
            "wind": environment.engine.wind,
        }
        moments.append(_while(alive, moment))
        remembered.append(_while(alive, records.named(snapshot.task)))
        length += alive
        for name, flag in ends.items():
            flag |= alive & getattr(now, name)
        for name, term in now.reward_terms.items():
            terms[name] += np.where(alive, term, 0.0)
        for name, holds in now.ended.items():
            ended[name] = ended.get(name, False) | (alive & holds)
        alive &= ~(now.terminated | now.truncated)
    return Rollout(
        **_stacked(states),
        **_stacked(moments),
        remembered=_stacked(remembered),
        length=length,
        **ends,
        ended=ended,
        reward_terms=terms,
        markers=tuple(markers),
        events=tuple(events),
        origin=np.array(environment.origin),
        control_timestep=environment.vehicle.control_timestep,
        task=flown,
    )


def flights(rollout: Rollout) -> dict[str, np.ndarray]:
    """The figures of each flight of a rollout, arrays (N,).

    Returns:
        success, survived and diverged (bool); position_error_m: mean error over the last 2 s [m];
        where the heading matters heading_error_deg: mean of |yaw| over the same time;
        yaw_rate_rad_s: mean of the body rate about z, without its sign, over it [rad/s]; where the
        task asks to keep a place circling_m_s: mean speed relative to the goal over it [m/s]; and
        over the whole flight command_change_rate: mean change of a rotor's command from one control
        step to the next, as a share of its largest speed; saturated_rate: share of the entries of
        the actions that are -1 or 1; least_height_m: of the aircraft's centre above the ground [m];
        return; length_s; for each end of the task end_NAME, whether it ended so (bool), with
        end_diverged and end_time_limit; for each term of the reward reward_NAME, its sum.
    """
    flown, last = _while_flying(rollout.error, rollout.length, rollout.control_timestep)
    yaw = np.degrees(roll_pitch_yaw(rollout.quaternion[1:])[..., 2])
    heading = {"heading_error_deg": _means(np.abs(yaw), last)}
    relative = np.linalg.norm((rollout.velocity - rollout.target_velocity)[1:], axis=-1)
    circling = {"circling_m_s": _means(relative, last)}
    change = np.abs(np.diff(rollout.rotor_command, axis=0)).mean(-1)
    height = rollout.position[1:, :, 2] + rollout.origin[2]
    return {
        "success": rollout.is_success,
        "survived": ~(rollout.terminated & ~rollout.is_success),
        "diverged": rollout.diverged,
        "position_error_m": _means(rollout.error, last),
        **(heading if rollout.task.heading_matters else {}),
        "yaw_rate_rad_s": _means(np.abs(rollout.body_rate[1:, :, 2]), last),
        **(circling if rollout.task.keeps_place else {}),
        "command_change_rate": _means(change, flown[1:]),
        "saturated_rate": _means((np.abs(rollout.action) >= 1.0).mean(-1), flown),
        "least_height_m": np.where(flown, height, np.inf).min(0),
        "return": np.nansum(rollout.reward, 0),
        "length_s": rollout.length * rollout.control_timestep,
        **{f"end_{name}": holds for name, holds in rollout.ended.items()},
        **{f"reward_{name}": term for name, term in rollout.reward_terms.items()},
    }


def final_error(error: np.ndarray, length: np.ndarray, control_timestep: float) -> np.ndarray:
    """Mean error of each flight over its last 2 s, (N,) [m], from errors (T, N) and lengths."""
    return _means(error, _while_flying(error, length, control_timestep)[1])


def _while_flying(
    values: np.ndarray, length: np.ndarray, control_timestep: float
) -> tuple[np.ndarray, np.ndarray]:
    """Which of values (T, N) are of a flight, and which of its last 2 s; masks (T, N)."""
    steps, index = max(1, round(FINAL_STRETCH / control_timestep)), np.arange(len(values))[:, None]
    return index < length, (index < length) & (index >= length - steps)


def means_of_behaviour(flown: dict[str, np.ndarray]) -> dict[str, float]:
    """Means of BEHAVIOUR in what `flights` gives, and the least of the heights.

    Over the flights that did not fail (who tumbles does not spin), over all if none is left.
    """
    counts = flown["survived"] | ~flown["survived"].any()
    ways = {name: flown[name][counts] for name in BEHAVIOUR if name in flown}
    return {k: float(v.min() if k == "least_height_m" else v.mean()) for k, v in ways.items()}


def summarize(rollout: Rollout) -> dict[str, Any]:
    """The metrics of an evaluation.

    Returns:
        episodes; success_rate and survival_rate (shares); position_error_m and
        position_error_std_m: mean and deviation over the flights [m]; where the heading matters
        heading_error_deg; `means_of_behaviour`; return_mean and return_std; length_mean_s; diverged
        (count); end_NAME_rate (share) and reward_NAME_mean; the task's own metrics; and of each
        member of a `OneOf` the same, with its name in front. `flights` says what each of them is of
        one flight.
    """
    flown, task, own = flights(rollout), rollout.task, dict[str, Any]()
    for name, part in task.flown(rollout).items() if isinstance(task, OneOf) else ():
        own |= {f"{name}_{metric}": value for metric, value in summarize(part).items()}
    heading = {k: float(v.mean()) for k, v in flown.items() if k == "heading_error_deg"}
    return {
        "episodes": len(flown["return"]),
        "success_rate": float(flown["success"].mean()),
        "survival_rate": float(flown["survived"].mean()),
        "position_error_m": float(flown["position_error_m"].mean()),
        "position_error_std_m": float(flown["position_error_m"].std()),
        **heading,
        **means_of_behaviour(flown),
        "return_mean": float(flown["return"].mean()),
        "return_std": float(flown["return"].std()),
        "length_mean_s": float(flown["length_s"].mean()),
        "diverged": int(flown["diverged"].sum()),
        **{f"end_{name}_rate": float(holds.mean()) for name, holds in rollout.ended.items()},
        **{f"reward_{name}_mean": float(x.mean()) for name, x in rollout.reward_terms.items()},
    } | (task.metrics(rollout) | own)


def _state(environment: Environment) -> dict[str, np.ndarray]:
    """The state, the goal and its velocity now, arrays (N, ...)."""
    now, task = environment.snapshot, environment.task
    goal, velocity = task.goal(now), task.target_velocity(now)
    return {name: getattr(now.state, name) for name in MOTION} | {
        "goal": goal,
        "target_velocity": np.zeros_like(goal) if velocity is None else velocity,
    }


def _while(alive: np.ndarray, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Copies of values (N, ...) as numbers, NaN where an aircraft's episode is over."""
    kept = {name: np.array(value, dtype=float) for name, value in values.items()}
    for value in kept.values():
        value[~alive] = np.nan
    return kept


def _stacked(moments: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The values (N, ...) of every moment as one array (T, N, ...) each."""
    return {name: np.stack([moment[name] for moment in moments]) for name in moments[0]}


def _means(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Mean of values (T, N) over the chosen steps, (N,); 0 where there are none."""
    return np.sum(np.where(chosen, values, 0.0), 0) / np.maximum(1, chosen.sum(0))
