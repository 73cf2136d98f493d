"""The one training loop: collect, estimate advantages, let the algorithm learn, write it down.

A run is a folder. Everything that the next iteration depends on (networks, optimiser, normaliser,
generators, the simulated aircraft) stands in its checkpoint, so a run that was killed at any
moment goes on and ends with the same policy, bit for bit.
"""

from __future__ import annotations

import csv
import dataclasses
import fcntl
import io
import json
import os
import time
import warnings
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.learning import checkpoint
from quadrl.learning.config import CONFIG, RunError, TrainConfig, new_folder, write_text
from quadrl.learning.gae import GAE as PolicyGradient
from quadrl.learning.policy import export, make_actor_critic
from quadrl.learning.ppo import PPO
from quadrl.learning.trpo import TRPO
from quadrl.policy import FILE as POLICY_FILE
from quadrl.policy import Policy
from quadrl.vehicle import VEHICLES

with warnings.catch_warnings():
    # TorchRL 0.14 warns about its own classes at this import.
    warnings.filterwarnings("ignore", message=".*WeightUpdater.*", category=DeprecationWarning)
    from torchrl.collectors import Collector
    from torchrl.objectives.value import GAE

METRICS = "metrics.csv"
EVENTS = "events"
SEED_STRIDE = 1 << 20
"""Distance between the aircraft's seeds of two trainings: the most aircraft that there can be."""
ALGORITHMS = {"ppo": PPO, "trpo": TRPO, "gae": PolicyGradient}


def make_collector(env: QuadrotorEnv, actor: torch.nn.Module, frames: int) -> Collector:
    """TorchRL's collector without what a training does not use: batches of `frames` steps."""
    return Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=-1,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
        use_buffers=False,
        trust_policy=True,
    )


@dataclasses.dataclass
class Progress:
    """Where a training stands, for whoever shows it."""

    iteration: int
    iterations: int
    steps: int
    seconds: float
    figures: dict[str, float]


class Training:
    """A run in its folder."""

    def __init__(self, config: TrainConfig, folder: Path, *, resume: bool = False) -> None:
        """Make everything that learns; then the folder, or take up its checkpoint when resuming.

        Raises:
            RunError: The folder cannot be used.
        """
        self.config, self.folder = config, folder
        torch.manual_seed(config.seed)
        self.env = QuadrotorEnv(
            config.task,
            config.num_envs,
            seed=config.seed * SEED_STRIDE,
            vehicle=VEHICLES[config.vehicle],
            action=config.action,
            num_threads=config.num_threads,
            engine=config.engine,
            **config.options,
        )
        self.actor, self.critic, self.normaliser = make_actor_critic(
            self.env.environment.size,
            self.env.environment.interface.size,
            hidden=config.hidden,
            critic_hidden=config.critic_hidden,
            initial_deviation=config.initial_deviation,
        )
        self.algorithm = ALGORITHMS[config.algo](
            self.actor, self.critic, getattr(config, config.algo)
        )
        self.advantages = GAE(
            gamma=config.gamma,
            lmbda=config.gae_lambda,
            value_network=self.critic,
            average_gae=True,
        )
        self.iteration = 0
        self.seconds = 0.0  # of training, in all processes that worked on it
        self._running = {
            "return": np.zeros(config.num_envs),
            "length": np.zeros(config.num_envs),
        }
        self._generator_state: torch.Tensor | None = None
        if not resume:
            new_folder(folder)
        self._unlock = weakref.finalize(self, os.close, _lock(folder))
        if not resume:
            write_text(folder / CONFIG, json.dumps(config.resolved(), indent=2))
        elif any((folder / name).exists() for name in (checkpoint.CHECKPOINT, POLICY_FILE)):
            # Without either, it was stopped before the first checkpoint.
            try:
                self._restore()
            except RunError:
                self._unlock()
                raise

    def run(self, on_progress: Callable[[Progress], None] = lambda progress: None) -> Policy:
        """Train to the end, and save the policy.

        Returns:
            The policy that was saved.

        Raises:
            RunError: A weight is no longer a finite number.
        """
        try:
            return self._run(on_progress)
        finally:
            self._unlock()

    def _run(self, on_progress: Callable[[Progress], None]) -> Policy:
        config = self.config
        if self.iteration >= config.iterations and (self.folder / POLICY_FILE).exists():
            return Policy.load(self.folder)
        collector = make_collector(self.env, self.actor, config.num_envs * config.rollout)
        if self._generator_state is not None:
            torch.set_rng_state(self._generator_state)
        # Nets this small gain nothing from a second thread and lose a lot when a core is taken, and
        # with one the numbers are the same on any number of cores.
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        log = _Log(self.folder, self.iteration)
        started, begun_at, saved_at = time.perf_counter(), self.seconds, time.perf_counter()
        batches = iter(collector)
        try:
            while self.iteration < config.iterations:
                figures = self._learn(next(batches))
                self.iteration += 1
                self.seconds = begun_at + time.perf_counter() - started
                steps = self.iteration * config.num_envs * config.rollout
                if not all(weight.isfinite().all() for weight in self.algorithm.parameters):
                    raise RunError(
                        f"the training diverged after {steps} steps: a weight is no longer finite; "
                        "lower the learning rate and start a new run"
                    )
                log.write(self.iteration, steps, self.seconds, figures)
                on_progress(
                    Progress(self.iteration, config.iterations, steps, self.seconds, figures)
                )
                last = self.iteration == config.iterations
                if last or time.perf_counter() - saved_at > config.checkpoint_seconds:
                    self.save()
                    saved_at = time.perf_counter()
            policy = self.policy()
            policy.save(self.folder / POLICY_FILE)
            self.seconds = begun_at + time.perf_counter() - started
        finally:
            log.close()
            torch.set_num_threads(threads)
            collector.shutdown(close_env=False)
        return policy

    def policy(self) -> Policy:
        """The policy as it stands."""
        config = self.config
        metadata = {
            "algo": config.algo,
            "seed": config.seed,
            "steps": self.iteration * config.num_envs * config.rollout,
            "vehicle": config.vehicle,
            "action": config.action,
            "task_options": config.options,
        }
        return export(self.actor, config.task, metadata)

    def _learn(self, batch: Any) -> dict[str, float]:
        """One iteration on a batch (aircraft, time)."""
        config = self.config
        figures = self._episodes(batch)
        with torch.no_grad():
            if self.iteration == 0:  # before, there was nothing to normalise with
                self.normaliser.update(batch["observation"])
                batch["action_log_prob"] = self.actor.get_dist(batch).log_prob(batch["action"])
            batch["next", "reward"] *= config.reward_scale
            self.advantages(batch)
        flat = batch.select(
            "observation", "action", "action_log_prob", "loc", "scale", "advantage", "value_target"
        ).reshape(-1)
        remaining = 1 - self.iteration / config.iterations
        figures |= self.algorithm.update(flat, remaining)
        if self.iteration > 0:
            self.normaliser.update(batch["observation"])
        figures["deviation"] = float(batch["scale"].mean())
        return figures

    def _episodes(self, batch: Any) -> dict[str, float]:
        """Return, length, success and survival of the episodes that ended in the batch."""
        ahead = batch["next"]
        names = ("reward", "done", "terminated", "is_success", "error")
        reward, done, terminated, success, error = (ahead[name][..., 0].numpy().T for name in names)
        returns, lengths = [], []
        for t in range(len(reward)):
            self._running["return"] += reward[t]
            self._running["length"] += 1
            over = done[t]
            returns.append(self._running["return"][over])
            lengths.append(self._running["length"][over])
            for running in self._running.values():
                running[over] = 0.0
        ended = np.concatenate(returns)
        figures = {"episodes": float(len(ended)), "reward": float(reward.mean())}
        figures["error"] = float(error.mean())
        if len(ended):
            figures |= {
                "return": float(ended.mean()),
                "length": float(np.concatenate(lengths).mean()),
                "success": float(success[done].mean()),
                "survival": float(1 - (terminated & ~success)[done].mean()),
            }
        return figures

    def save(self) -> None:
        """Write the checkpoint."""
        tensors = {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "optimiser": self.algorithm.save(),
            "environment": self.env.environment.save(),
            "running": self._running,
            "generator": torch.get_rng_state(),
        }
        numbers = {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "config": self.config.resolved(),
        }
        checkpoint.save(self.folder / checkpoint.CHECKPOINT, tensors, numbers)

    def _restore(self) -> None:
        path = self.folder / checkpoint.CHECKPOINT
        tensors, numbers = checkpoint.load(path)
        try:
            if other := self.config.difference(numbers["config"]):
                raise RunError(
                    f"{path} was trained with {other}: it would not end as it began; go back to "
                    "that, or start a new run"
                )
            self.actor.load_state_dict(tensors["actor"])
            self.critic.load_state_dict(tensors["critic"])
            self.algorithm.restore(tensors.get("optimiser", {}))
            arrays = {k: v.numpy() for k, v in tensors["environment"].items()}
            self.env.restore(arrays)
            self._running = {k: v.numpy().copy() for k, v in tensors["running"].items()}
            self._generator_state = tensors["generator"]
            self.iteration, self.seconds = int(numbers["iteration"]), float(numbers["seconds"])
        except (
            ArithmeticError,
            AttributeError,
            KeyError,
            RuntimeError,
            TypeError,
            ValueError,
        ) as error:
            raise RunError(f"{path} does not fit its run: {error}") from error


def _lock(folder: Path) -> int:
    """Make the folder this process's own for as long as the descriptor that it returns is open.

    Raises:
        RunError: Another training works on it.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise RunError(
            f"another training works in {folder}: wait for its end or stop it, or start a new run "
            "with another --out"
        ) from error
    return descriptor


class _Log:
    """metrics.csv and TensorBoard events; rows past the checkpoint are written anew."""

    COLUMNS = (
        "iteration", "steps", "seconds", "episodes", "return", "length", "success", "survival",
        "reward", "error", "deviation", "critic_loss", "kl", "clip_fraction",
    )  # fmt: skip

    def __init__(self, folder: Path, iteration: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        path = folder / METRICS
        kept: list[list[str]] = []
        if path.exists():
            with open(path, newline="") as file:
                rows = list(csv.reader(file))[1:]
            kept = [row for row in rows if len(row) == len(self.COLUMNS)][:iteration]
        whole = io.StringIO(newline="")
        csv.writer(whole).writerows([list(self.COLUMNS), *kept])
        write_text(path, whole.getvalue())
        self._file = open(path, "a", newline="")  # noqa: SIM115 - closed by close
        self._writer = csv.writer(self._file)
        self._events = SummaryWriter(str(folder / EVENTS), purge_step=iteration + 1)

    def write(self, iteration: int, steps: int, seconds: float, figures: dict[str, float]) -> None:
        known = {"iteration": iteration, "steps": steps, "seconds": round(seconds, 3)} | figures
        self._writer.writerow([_text(known.get(name, "")) for name in self.COLUMNS])
        self._file.flush()
        for name, value in figures.items():
            self._events.add_scalar(name, value, iteration)

    def close(self) -> None:
        self._file.close()
        self._events.close()


def _text(value: float | str) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
