"""The training loop: collect, estimate advantages, let the algorithm learn, write it down.

A run is a folder. Everything that the next iteration depends on (networks, optimisers, normaliser,
generators, the simulated aircraft) stands in its checkpoint, so a run that was killed at any
moment continues and ends with the same policy, bit for bit.
"""

from __future__ import annotations

import contextlib
import dataclasses
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
from quadrl.errors import QuadrlError
from quadrl.learning import checkpoint
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import CONFIG, Log, lock_folder, new_folder, write_json
from quadrl.learning.networks import export, make_actor_critic
from quadrl.learning.ppo import PPO
from quadrl.learning.trpo import TRPO
from quadrl.learning.vpg import VPG
from quadrl.policy import FILE as POLICY_FILE
from quadrl.policy import Policy
from quadrl.vehicle import VEHICLES

with warnings.catch_warnings():
    # TorchRL 0.14 warns about its own classes at this import.
    warnings.filterwarnings("ignore", message=".*WeightUpdater.*", category=DeprecationWarning)
    from torchrl.collectors import Collector
    from torchrl.objectives.value import GAE

SEED_STRIDE = 1 << 20
"""Distance between the aircraft's seeds of two trainings: the most aircraft that there can be."""
ALGORITHMS = {"ppo": PPO, "trpo": TRPO, "vpg": VPG}


def make_collector(env: QuadrotorEnv, actor: torch.nn.Module, frames: int) -> Collector:
    """TorchRL's collector of batches of `frames` steps, without what a training does not use."""
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
    """The state of a training after an iteration."""

    iteration: int
    iterations: int
    steps: int
    seconds: float
    metrics: dict[str, float]


class Training:
    """A run in its folder."""

    def __init__(self, config: TrainConfig, folder: Path, *, resume: bool = False) -> None:
        """Make everything that learns; then make the folder, or load its checkpoint.

        Raises:
            QuadrlError: The folder cannot be used.
        """
        self.config, self.folder = config, folder
        torch.manual_seed(config.seed)
        self.env = QuadrotorEnv(
            config.make_task(),
            config.num_envs,
            seed=config.seed * SEED_STRIDE,
            vehicle=VEHICLES[config.vehicle],
            control_mode=config.control_mode,
            num_threads=config.num_threads,
            engine=config.engine,
        )
        self.actor, self.critic, self.normaliser = make_actor_critic(
            self.env.environment.size, self.env.environment.action_size, config
        )
        self.algorithm = ALGORITHMS[config.algo](
            self.actor, self.critic, getattr(config, config.algo)
        )
        self.advantages = GAE(
            gamma=config.gamma, lmbda=config.gae_lambda, value_network=self.critic, average_gae=True
        )
        self.iteration = 0
        self.seconds = 0.0  # of training, in all processes that worked on it
        self._running = {name: np.zeros(config.num_envs) for name in ("return", "length")}
        self._generator_state: torch.Tensor | None = None
        if not resume:
            new_folder(folder)
        self._unlock = weakref.finalize(self, os.close, lock_folder(folder))
        if not resume:
            write_json(folder / CONFIG, config.resolved())
        elif any((folder / name).exists() for name in (checkpoint.CHECKPOINT, POLICY_FILE)):
            # Without either, it was stopped before the first checkpoint.
            try:
                self._restore()
            except QuadrlError:
                self._unlock()
                raise

    @property
    def steps(self) -> int:
        """Control steps of all aircraft so far."""
        return self.iteration * self.config.num_envs * self.config.rollout

    def run(self, on_progress: Callable[[Progress], None] = lambda progress: None) -> Policy:
        """Train to the end, and save the policy.

        Returns:
            The saved policy.

        Raises:
            QuadrlError: A weight is no longer finite.
        """
        config = self.config
        with contextlib.ExitStack() as stack:
            stack.callback(self._unlock)
            if self.iteration >= config.iterations and (self.folder / POLICY_FILE).exists():
                return Policy.load(self.folder)
            collector = make_collector(self.env, self.actor, config.num_envs * config.rollout)
            stack.callback(collector.shutdown, close_env=False)
            if self._generator_state is not None:
                torch.set_rng_state(self._generator_state)
            # Networks this small gain nothing from a second thread and lose a lot when a core is
            # busy, and with one the results are the same on any number of cores.
            stack.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(1)
            log = Log(self.folder, self.iteration)
            stack.callback(log.close)
            started = saved = time.perf_counter()
            before, batches = self.seconds, iter(collector)
            while self.iteration < config.iterations:
                metrics = self._learn(next(batches))
                self.iteration += 1
                now = time.perf_counter()
                self.seconds = before + now - started
                if not all(weight.isfinite().all() for weight in self.algorithm.parameters):
                    raise QuadrlError(
                        f"the training diverged after {self.steps} steps: a weight is no longer "
                        "finite; lower the learning rate and start a new run"
                    )
                log.write(self.iteration, self.steps, self.seconds, metrics)
                progress = (self.iteration, config.iterations, self.steps, self.seconds, metrics)
                on_progress(Progress(*progress))
                if self.iteration == config.iterations or now - saved > config.checkpoint_seconds:
                    self.save()
                    saved = time.perf_counter()
            policy = self.policy()
            policy.save(self.folder / POLICY_FILE)
            self.seconds = before + time.perf_counter() - started
        return policy

    def policy(self) -> Policy:
        """The policy at this moment."""
        config = self.config
        metadata = {
            "algo": config.algo,
            "seed": config.seed,
            "steps": self.steps,
            "vehicle": config.vehicle,
            "rotors": VEHICLES[config.vehicle].rotor_count,
            "control_mode": config.control_mode,
            "task_options": config.task_options,
        }
        return export(self.actor, config.task, metadata)

    def _learn(self, batch: Any) -> dict[str, float]:
        """One iteration on a batch (aircraft, time)."""
        metrics = self._episodes(batch)
        with torch.no_grad():
            if self.iteration == 0:  # the first batch was collected without a normaliser
                self.normaliser.update(batch["observation"])
                batch["action_log_prob"] = self.actor.get_dist(batch).log_prob(batch["action"])
            batch["next", "reward"] *= self.config.reward_scale
            self.advantages(batch)
        flat = batch.select(
            "observation", "action", "action_log_prob", "loc", "scale", "advantage", "value_target"
        ).reshape(-1)
        metrics |= self.algorithm.update(flat, 1 - self.iteration / self.config.iterations)
        if self.iteration > 0:
            self.normaliser.update(batch["observation"])
        return metrics | {"deviation": float(batch["scale"].mean())}

    def _episodes(self, batch: Any) -> dict[str, float]:
        """Return, length, success and survival of the episodes that ended in the batch."""
        names = ("reward", "done", "terminated", "is_success", "error")
        columns = (batch["next", name][..., 0].numpy().T for name in names)
        reward, done, terminated, success, error = columns  # (time, aircraft)
        ended: dict[str, list[np.ndarray]] = {name: [] for name in self._running}
        for gained, over in zip(reward, done, strict=True):
            self._running["return"] += gained
            self._running["length"] += 1
            for name, running in self._running.items():
                ended[name].append(running[over])
                running[over] = 0.0
        returns, lengths = (np.concatenate(ended[name]) for name in ("return", "length"))
        metrics = {"episodes": float(len(returns)), "reward": float(reward.mean())}
        metrics["error"] = float(error.mean())
        if len(returns):
            metrics |= {
                "return": float(returns.mean()),
                "length": float(lengths.mean()),
                "success": float(success[done].mean()),
                "survival": float(1 - (terminated & ~success)[done].mean()),
            }
        return metrics

    def save(self) -> None:
        """Write the checkpoint."""
        tensors = {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "optimisers": self.algorithm.save(),
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
            checkpoint.check_same(path, numbers["config"], self.config.resolved())
            self.actor.load_state_dict(tensors["actor"])
            self.critic.load_state_dict(tensors["critic"])
            self.algorithm.restore(tensors.get("optimisers", {}))
            self.env.restore({k: v.numpy() for k, v in tensors["environment"].items()})
            self._running = {k: v.numpy().copy() for k, v in tensors["running"].items()}
            self._generator_state = tensors["generator"]
            self.iteration, self.seconds = int(numbers["iteration"]), float(numbers["seconds"])
        except QuadrlError:
            raise
        except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError,
                ValueError) as error:  # fmt: skip
            reason = str(error).partition("\n")[0]
            raise QuadrlError(f"{path} does not fit its run: {reason}") from error
