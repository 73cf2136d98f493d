"""What finished trainings reached: their curves, and their policies flown in several ways."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.signal import welch

from quadrl import tasks
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import FINAL_STRETCH, Rollout, fly, summarize
from quadrl.learning.folder import EVALUATION, METRICS, read_metrics
from quadrl.learning.studies.plan import PlannedRun
from scripts.reports.report import Result

SMOOTHING = 0.05  # share of a training over which its curve is averaged for best and final
FRESH = 200_000  # first of the episodes that policies are measured in
NOISE_SEED = 0  # of sampled actions and of noise on the weights
WEIGHT_NOISE, WEIGHT_DRAWS = 0.2, 5  # of each neuron's weights, over their own length
SEGMENT = 40  # control steps in a segment of a spectrum
WOBBLE_HZ = 2.0  # body rates above it are wobble, not flight: a position loop is slower
ROUGHNESS = ("action_variation_1_s", "body_rate_rad_s", "angular_acceleration_rad_s2", "jerk_m_s3")


def trained(run: PlannedRun) -> Result:
    """What a finished run was: task, vehicle, engine, algorithm, seed, steps, seconds."""
    config = run.config
    known = {name: getattr(config, name) for name in ("task", "vehicle", "engine", "algo", "seed")}
    took = json.loads((run.folder / EVALUATION).read_text())["training_s"]
    steps = config.iterations * config.num_envs * config.rollout
    return known | {"steps": steps, "training_s": took}


def measure(run: PlannedRun, *, episodes: int, weathers: Iterable[str]) -> Result:
    """All figures of a finished run.

    Args:
        run: The run.
        episodes: Episodes of each evaluation; the same ones for every run, and none of those that
            settings are chosen by.
        weathers: Names of the weathers to fly in as well.

    Returns:
        What `trained` says, and: `curve`: best and final success of the training; `mean` and
        `sampled`: summary and smoothness with the mean action and with actions drawn from the
        policy; `windy`: a summary of both for each weather; `return_noisy_weights`: the return of
        the mean action with noise on the weights.
    """
    policy, task = Policy.load(run.folder), run.config.task
    ways = {"mean": policy, "sampled": policy.flying(episodes, NOISE_SEED)}
    measured: Result = trained(run) | {"curve": curve_figures(read_metrics(run.folder / METRICS))}
    for way, controller in ways.items():
        rollout = flown(controller, task, episodes)
        measured[way] = summarize(rollout) | {"smoothness": smoothness(rollout)}
    measured["windy"] = [
        {way: blown(controller, task, episodes, weather) for way, controller in ways.items()}
        for weather in weathers
    ]
    returns = []
    for draw in range(WEIGHT_DRAWS):
        noisy = with_noisy_weights(policy, WEIGHT_NOISE, NOISE_SEED + draw)
        # Each draw flies other episodes; together they are as many as in one evaluation.
        share = max(1, episodes // WEIGHT_DRAWS)
        flight = flown(noisy, task, share, first=FRESH + draw * episodes)
        returns.append(summarize(flight)["return_mean"])
    return measured | {"return_noisy_weights": float(np.mean(returns))}


def flown(
    controller: Any, task: str, episodes: int, weather: str = "calm", first: int = FRESH
) -> Rollout:
    """Flights in a weather: in free flight, but for tasks that touch the ground."""
    engine: Any = "mujoco" if tasks.make(task).contact else "free_flight"
    return fly(controller, task, episodes=episodes, seed=first, weather=weather, engine=engine)


def blown(controller: Any, task: str, episodes: int, weather: str) -> Result:
    """The main figures of flights in a weather."""
    summary = summarize(flown(controller, task, episodes, weather))
    names = ("success_rate", "survival_rate", "position_error_m", "return_mean")
    return {name: summary[name] for name in names}


def curve_figures(metrics: dict[str, np.ndarray]) -> dict[str, float | None]:
    """Best and final success of a training, of the running mean over `SMOOTHING` of it."""
    shares = metrics["success"][np.isfinite(metrics["success"])]
    if not len(shares):  # too short for an episode to end
        return dict.fromkeys(("best", "final"))
    width = max(1, round(SMOOTHING * len(shares)))
    smooth = np.convolve(shares, np.full(width, 1 / width), mode="valid")
    return {"best": smooth.max().item(), "final": smooth[-1].item()}


def with_noisy_weights(policy: Policy, share: float, seed: int) -> Policy:
    """The policy with noise on each neuron's weights, of a `share` of their length.

    How much return that costs says how sharp the optimum is (Li et al. 2018, "Visualizing the Loss
    Landscape of Neural Nets": directions normalised by filter, for the same reason).
    """
    generator = np.random.default_rng(seed)
    weights = []
    for weight in policy.weights:
        noise = generator.standard_normal(weight.shape)
        lengths = [np.linalg.norm(rows, axis=1, keepdims=True) for rows in (weight, noise)]
        weights.append((weight + share * noise * lengths[0] / lengths[1]).astype(np.float32))
    return dataclasses.replace(policy, weights=tuple(weights))


def smoothness(rollout: Rollout) -> Result:
    """How smoothly the successful flights were flown; NaN where there are none.

    Returns:
        `flights`: how many, of at least a segment of the spectrum. Means over them of ROUGHNESS:
        sum of |change of an action| per second, mean of the rotors, and root mean squares of body
        rate, its change, and jerk; of `wobble_rad_s`, that of the body rate less its mean over the
        last 2 s; and of `body_rate_spectrum` [rad^2/s^2/Hz] at `frequency_hz` (Welch's method,
        summed over the axes). `wobble_share`: its share above `WOBBLE_HZ`.
    """
    step = rollout.control_timestep
    hold, names = round(FINAL_STRETCH / step), (*ROUGHNESS, "wobble_rad_s")
    frequency = np.fft.rfftfreq(SEGMENT, step)
    rows, spectra = [[np.nan] * len(names)], [np.full(len(frequency), np.nan)]
    for i in np.flatnonzero(rollout.is_success & (rollout.length >= SEGMENT + 2)):
        flown = slice(0, int(rollout.length[i]))
        rate, velocity = rollout.body_rate[flown, i], rollout.velocity[flown, i]
        jerk = np.diff(velocity, n=2, axis=0) / step**2
        variation = np.abs(np.diff(rollout.action[flown, i], axis=0)) / step
        square = (rate, np.diff(rate, axis=0) / step, jerk, rate[-hold:] - rate[-hold:].mean(0))
        rows.append([variation.mean(), *(np.sqrt((x**2).sum(-1).mean()) for x in square)])
        spectra.append(welch(rate, fs=1 / step, nperseg=SEGMENT, axis=0)[1].sum(-1))
    flights = len(rows) - 1
    means, spectrum = (np.mean(x[1:] if flights else x, axis=0) for x in (rows, spectra))
    power = np.maximum(spectrum.sum(), np.finfo(float).tiny)  # a still aircraft does not wobble
    return {
        "flights": flights,
        **dict(zip(names, means.tolist(), strict=True)),
        "wobble_share": float(spectrum[frequency > WOBBLE_HZ].sum() / power),
        "frequency_hz": frequency.tolist(),
        "body_rate_spectrum": spectrum.tolist(),
    }
