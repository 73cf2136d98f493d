"""A study: trainings of several tasks, algorithms and seeds, side by side, and their measures."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.learning.config import RunError, TrainConfig, make_task, recipe
from quadrl.learning.evaluate import EVALUATION_SEED, Controller, fly, judge, smoothness
from quadrl.learning.figures import read_metrics
from quadrl.policy import Policy
from quadrl.vehicle import VEHICLES

EVALUATION = "evaluation.json"
"""Of a run folder, written last: a run with it is done."""
POLL_SECONDS = 0.2
SMOOTHING = 0.05  # share of a training over which its curve is averaged for best and final
NOISE_SEED = 0  # of sampled actions and of noise on the weights
WEIGHT_NOISE = 0.2  # of each neuron's weights, over their own length
WEIGHT_DRAWS = 5
CURVE_POINTS = 50


@dataclasses.dataclass(frozen=True)
class Run:
    """One training of a study."""

    config: TrainConfig
    folder: Path

    @property
    def name(self) -> str:
        """That of its folder."""
        return self.folder.name

    @property
    def done(self) -> bool:
        """Whether it is trained and evaluated.

        Raises:
            RunError: The folder holds a run with other settings.
        """
        if not (self.folder / "config.json").exists():
            return False
        found = TrainConfig.of_folder(self.folder)
        free = {"num_threads": 0, "checkpoint_seconds": 0.0}  # they change no number
        if dataclasses.replace(found, **free) != dataclasses.replace(self.config, **free):
            raise RunError(
                f"{self.folder} holds a run with other settings than this study's; choose "
                "another --out"
            )
        return (self.folder / EVALUATION).exists()

    def command(self, episodes: int) -> list[str]:
        """Arguments of `quadrl` that begin it, or go on with it."""
        config = self.config
        ending = ["--no-video", "--episodes", str(episodes)]
        if (self.folder / "config.json").exists():
            return ["train", "--resume", str(self.folder), *ending]
        named = {
            "--algo": config.algo,
            "--seed": config.seed,
            "--steps": config.steps,
            "--vehicle": config.vehicle,
            "--engine": config.engine,
            "--num-threads": config.num_threads,
            "--out": self.folder,
        }
        pairs = [str(word) for pair in named.items() for word in pair]
        return ["train", config.task, *pairs, *ending]


def plan(
    out: Path,
    tasks: Iterable[str],
    algorithms: Iterable[str],
    seeds: Iterable[int],
    *,
    steps: int | None = None,
    num_threads: int = 0,
) -> list[Run]:
    """The runs of a study, seed by seed, so that a study that is stopped has whole seeds.

    Args:
        out: Folder of the run folders.
        tasks: Names of tasks.
        algorithms: Names of algorithms.
        seeds: Of the trainings.
        steps: Control steps of each; None for what the task trains with by default.
        num_threads: Of each simulation; 0 for every core.
    """
    runs = []
    for seed in seeds:
        for task in tasks:
            for algo in algorithms:
                config = recipe(task, algo)
                config = dataclasses.replace(
                    config,
                    seed=seed,
                    steps=steps or config.steps,
                    num_threads=num_threads,
                )
                runs.append(Run(config, out / f"{task}-{algo}-{seed}"))
    return runs


def train(
    runs: Iterable[Run], jobs: int, *, episodes: int, report: Callable[[str], None]
) -> list[str]:
    """Make what is not done of some runs, each in a process of its own.

    Args:
        runs: The runs; those that are done are left alone, half-done ones are gone on with.
        jobs: Processes at a time.
        episodes: Of the evaluation at the end of each.
        report: Is told, in a line, what begins and ends.

    Returns:
        What went wrong, a line for each run that failed.

    Raises:
        RunError: A folder holds a run with other settings.
    """
    waiting = [run for run in runs if not run.done]
    going: dict[subprocess.Popen, tuple[Run, Path]] = {}
    failed: list[str] = []
    try:
        while waiting or going:
            while waiting and len(going) < jobs:
                run = waiting.pop(0)
                log = run.folder.parent / "logs" / f"{run.name}.txt"
                going[_start(run.command(episodes), log)] = run, log
                report(f"{run.name}: begun, {len(waiting)} waiting")
            for process in [p for p in going if p.poll() is not None]:
                run, log = going.pop(process)
                if process.returncode:
                    last = (log.read_text().splitlines() or ["it said nothing"])[-1]
                    failed.append(f"{run.name}: {last} (the rest is in {log})")
                report(failed[-1] if process.returncode else f"{run.name}: done")
            time.sleep(POLL_SECONDS)
    finally:
        for process in going:  # stopped: each keeps its run, to be gone on with
            process.send_signal(signal.SIGINT)
        for process in going:
            process.wait()
    return failed


def _start(arguments: list[str], log: Path) -> subprocess.Popen:
    """The command in a session of its own, so that a Ctrl-C reaches it only once, from here."""
    log.parent.mkdir(parents=True, exist_ok=True)
    paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    with open(log, "w") as file:
        return subprocess.Popen(
            [sys.executable, "-m", "quadrl", *arguments],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def measure(run: Run, *, episodes: int, gusts: Iterable[float]) -> dict[str, Any]:
    """All figures of a finished run: its curve, and its policy flown in several ways.

    Args:
        run: The run.
        episodes: Of each evaluation; the same ones for every run.
        gusts: Deviations of the wind [m/s] to fly in.

    Returns:
        task, algo, seed, steps, training_s; curve (first, best, final return of the training, and
        the points of it); mean and sampled: evaluation and smoothness with the mean action and
        with actions drawn from the policy; gusts: for each deviation, success, survival and error
        of both; return_noisy_weights: return of the mean action with noise on the weights.
    """
    config = run.config
    policy, vehicle = Policy.load(run.folder), VEHICLES[config.vehicle]
    task = make_task(config.task, config.options)
    pilots: dict[str, Controller] = {"mean": policy, "sampled": policy.sampled(NOISE_SEED)}
    measured: dict[str, Any] = {
        "task": config.task,
        "algo": config.algo,
        "seed": config.seed,
        "steps": config.iterations * config.num_envs * config.rollout,
        "training_s": json.loads((run.folder / EVALUATION).read_text())["training_s"],
        "curve": curve_figures(read_metrics(run.folder / "metrics.csv")),
    }
    for way, pilot in pilots.items():
        record = fly(pilot, task, episodes=episodes, vehicle=vehicle)
        measured[way] = judge(record) | {"smoothness": smoothness(record)}
    names = ("success_rate", "survival_rate", "position_error_m", "return_mean")
    measured["gusts"] = []
    for deviation in gusts:
        level: dict[str, Any] = {"deviation_m_s": deviation}
        for way, pilot in pilots.items():
            judged = judge(fly(pilot, task, episodes=episodes, vehicle=vehicle, gusts=deviation))
            level[way] = {name: judged[name] for name in names}
        measured["gusts"].append(level)
    returns = []
    for draw in range(WEIGHT_DRAWS):
        noisy = with_noisy_weights(policy, WEIGHT_NOISE, NOISE_SEED + draw)
        # Other episodes in each draw: as many as in one evaluation, all in all.
        seed, share = EVALUATION_SEED + draw * episodes, max(1, episodes // WEIGHT_DRAWS)
        judged = judge(fly(noisy, task, episodes=share, seed=seed, vehicle=vehicle))
        returns.append(judged["return_mean"])
    measured["return_noisy_weights"] = float(np.mean(returns))
    return measured


def curve_figures(metrics: dict[str, np.ndarray]) -> dict[str, Any]:
    """First, best and final return of a training, and its curve in few points.

    First, best and final are of the running mean over `SMOOTHING` of the training, so that one
    lucky batch is not the best.
    """
    ended = np.isfinite(metrics["return"])
    steps, returns = metrics["steps"][ended], metrics["return"][ended]
    if not len(steps):  # too short for an episode to end
        return {"first": None, "best": None, "final": None, "steps": [], "return": []}
    width = max(1, round(SMOOTHING * len(returns)))
    smooth = np.convolve(returns, np.full(width, 1 / width), mode="valid")
    points = np.linspace(steps[0], steps[-1], CURVE_POINTS)
    return {
        "first": float(smooth[0]),
        "best": float(smooth.max()),
        "final": float(smooth[-1]),
        "steps": points.round().tolist(),
        **{
            name: np.interp(points, steps, metrics[name][ended]).tolist()
            for name in ("return", "success")
        },
    }


def with_noisy_weights(policy: Policy, share: float, seed: int) -> Policy:
    """The policy with noise on each neuron's weights, `share` of their length.

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
