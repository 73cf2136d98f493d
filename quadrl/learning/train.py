"""The training loop: collect, estimate advantages, let the algorithm learn, log.

A run is a folder. Its checkpoint holds everything that the next iteration depends on (networks,
optimisers, normalisers, generators, the simulated aircraft), so a run that was killed at any moment
can be continued, and ends with the same policy, bit for bit.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import time
import warnings
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.modules import set_recurrent_mode
from torchrl.objectives.value import GAE

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.files import PART
from quadrl.base.machine import processor_kind
from quadrl.base.progress import Progress
from quadrl.engines import native
from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.policy_file import FILE as POLICY_FILE
from quadrl.learning import checkpoint, environments, networks
from quadrl.learning.algorithm import Algorithm, generators, one_thread, set_generators
from quadrl.learning.apg import APG
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import (
    EVALUATION,
    WARNINGS,
    Log,
    lock_folder,
    new_folder,
    read_config,
    run_of,
    write_config,
)
from quadrl.learning.networks import BEGINS, PRIVILEGED, STATE
from quadrl.learning.origin import Origin
from quadrl.learning.ppo import PPO
from quadrl.learning.trpo import TRPO
from quadrl.learning.vpg import VPG

LEARNED_FROM = ("action", "action_log_prob", "loc", "scale", "advantage", "value_target")
"""Entries of a batch that algorithms learn from, beside those that actor and critic read."""
ALGORITHMS = {"ppo": PPO, "trpo": TRPO, "vpg": VPG}


def make_algorithm(config: TrainConfig, env: QuadrotorEnv, actor: Any, critic: Any) -> Algorithm:
    """Make the algorithm of a training."""
    own = getattr(config, config.algo)
    if isinstance(env, environments.RecordingEnv):
        return APG(actor, critic, own, env, config.gamma, config.reward_scale)
    return ALGORITHMS[config.algo](actor, critic, own)


class Training:
    """A training, and the folder of its run."""

    @one_thread()  # for the bits of the first weights
    def __init__(self, config: TrainConfig, folder: Path, *, resume: bool = False) -> None:
        """Make environments, networks and algorithm; then make the folder, or load its checkpoint.

        A run may be continued with more steps than it was begun with.

        Raises:
            QuadrlError: The folder or the device cannot be used.
        """
        self.config, self.folder = config, folder
        device = environments.make_device(config.device)
        torch.manual_seed(config.seed)
        self.env = environments.make_env(config, device)
        size, actions = self.env.environment.size, self.env.environment.action_size
        networks.check_fits(config, size)
        given = self.env.observation_spec.get(PRIVILEGED, None)
        self.actor, self.critic, self.normalisers = networks.make_actor_critic(
            size, actions, config, 0 if given is None else given.shape[-1]
        )
        for network in (self.actor, self.critic):
            network.to(device)
        begun = resume and any((folder / x).exists() for x in (checkpoint.CHECKPOINT, POLICY_FILE))
        if config.from_run and not begun:
            checkpoint.begin_with(
                Origin.of(config.from_run).checkpoint(size, actions), self.actor, self.critic
            )
        self.algorithm = make_algorithm(config, self.env, self.actor, self.critic)
        self.advantages = GAE(
            gamma=config.gamma, lmbda=config.gae_lambda, value_network=None, average_gae=True
        )
        self.iteration = 0
        self.seconds = 0.0  # of training, in all processes that worked on it
        self._episodes = environments.EpisodeStatistics(
            config.num_envs, self.env.environment.time_limit_steps, config.rollout
        )
        self._generators: dict[str, torch.Tensor] = {}
        self._remembered: dict[str, np.ndarray] = {}  # the states of a recurrent policy
        self._asked = self._stopping = False
        if not resume:
            new_folder(folder)
        self._unlock = weakref.finalize(self, lock_folder(folder))
        for left in folder.glob(f"*{PART}") if resume else ():  # when it was killed
            left.unlink(missing_ok=True)
        resolved = config.resolved()
        self._known_as = run_of(resolved)
        if not resume:
            write_config(folder, resolved)
        elif begun:
            # Otherwise it was stopped before the first checkpoint.
            try:
                self._restore()
            except QuadrlError:
                self._unlock()
                raise
            before = read_config(folder).get("processors", ())
            if others := set(before) - {processor_kind()}:
                text = f"{folder} was trained on another processor ({', '.join(sorted(others))}): "
                text += "on this one its policy can end otherwise in the last digits"
                warnings.warn(text, QuadrlWarning, stacklevel=2)
            write_config(folder, resolved, before)
        if self.iteration < config.iterations:
            (folder / EVALUATION).unlink(missing_ok=True)

    @property
    def steps(self) -> int:
        """Control steps of all aircraft so far."""
        return self.iteration * self.config.num_envs * self.config.rollout

    @one_thread()
    def run(self, on_progress: Callable[[Progress], None] = lambda progress: None) -> Policy:
        """Train to the end, or until `ask` stops it, and save the policy.

        Returns:
            The saved policy.

        Raises:
            QuadrlError: A weight is no longer finite.
        """
        config = self.config
        with contextlib.ExitStack() as stack:
            stack.callback(self._unlock)
            if self.iteration >= config.iterations:
                policy = self.policy()  # it may have been killed between checkpoint and policy
                policy.save(self.folder / POLICY_FILE)
                return policy
            collector = environments.make_collector(
                self.env, self.actor, config.num_envs * config.rollout
            )
            stack.callback(collector.shutdown, close_env=False)
            set_generators(self._generators, self.env.device)
            log = Log(self.folder, self.iteration)
            stack.callback(log.close)
            stack.enter_context(native.warnings_in(self.folder / WARNINGS))
            # What the imports made is no garbage, and searching it would take 5 % of the time.
            gc.freeze()
            stack.callback(gc.unfreeze)
            started = saved = time.perf_counter()
            before, batches = self.seconds, iter(collector)
            while True:
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
                over = self.iteration == config.iterations or self._stopping
                if over or self._asked or now - saved > config.checkpoint_seconds:
                    self._asked = False  # requests from here on are for the next iteration
                    self.save()
                    saved = time.perf_counter()
                if over:
                    break
            self.seconds = before + time.perf_counter() - started
        return self.policy()

    def ask(self, *, stop: bool = False) -> None:
        """Ask for a checkpoint at the end of this iteration, and perhaps to stop after it.

        It may be called at any moment, by a signal handler or another thread.
        """
        self._stopping |= stop
        self._asked = True

    def policy(self) -> Policy:
        """Export the present policy."""
        config = self.config
        metadata = {
            "algo": config.algo,
            "seed": config.seed,
            "run": self._known_as,
            "variant": config.variant,
            "steps": self.steps,
            "rotors": config.scenario.vehicle.rotor_count,
            **config.resolved()["scenario"],
            "engine": "mujoco",
            "observe": dataclasses.asdict(config.scenario.observe),
        }
        return networks.export(self.actor, config.task, metadata)

    def _learn(self, batch: Any) -> dict[str, float]:
        """Do one iteration with a batch (aircraft, time)."""
        metrics = self._episodes.count(batch)
        with torch.no_grad():
            if self.config.memory != "none":
                done, state = (batch["next", name] for name in ("done", STATE))
                batch[BEGINS] = torch.roll(done, 1, dims=1)
                batch[BEGINS][:, 0] = False  # a state with which an episode begins is zero
                self._remembered = {STATE: state[:, -1].masked_fill(done[:, -1], 0.0).cpu().numpy()}
            fresh = self.iteration == 0 and not self.config.from_run
            first = fresh and not self.algorithm.whole
            if first:  # the first batch was collected without a normaliser
                networks.update_normalisers(self.normalisers, batch)
                with set_recurrent_mode():
                    present = self.actor.get_dist(batch)
                batch["action_log_prob"] = present.log_prob(batch["action"])
            batch["next", "reward"] *= self.config.reward_scale
            self._evaluate(batch)
            self.advantages(batch)
        flat = batch.select(*self.actor.in_keys, *self.critic.in_keys, *LEARNED_FROM)
        if self.config.memory == "none" and not self.algorithm.whole:
            flat = flat.reshape(-1)
        metrics |= self.algorithm.update(flat, 1 - self.iteration / self.config.iterations)
        if not first:
            networks.update_normalisers(self.normalisers, batch)
        return metrics | {"deviation": float(batch["scale"].mean())}

    def _evaluate(self, batch: Any) -> None:
        """Add the critic's values of all states and of the states after them.

        Within an episode the state after a step is the next one of the batch, whose value is known.
        """
        value = self.critic(batch)["state_value"]
        ends = batch["next", "done"][..., 0].clone()
        ends[:, -1] = True
        after = torch.roll(value, -1, dims=1)
        after[ends] = self.critic(batch["next"].select(*self.critic.in_keys)[ends])["state_value"]
        batch["next", "state_value"] = after

    def save(self) -> None:
        """Write the checkpoint and the present policy."""
        tensors = {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "optimisers": self.algorithm.save(),
            "environment": self.env.environment.save() | self._remembered,
            "running": self._episodes.running,
            "generators": generators(self.env.device),
        }
        numbers = {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "config": self.config.resolved(),
        }
        checkpoint.save(self.folder / checkpoint.CHECKPOINT, tensors, numbers)
        self.policy().save(self.folder / POLICY_FILE)

    def _restore(self) -> None:
        path = self.folder / checkpoint.CHECKPOINT
        tensors, numbers = checkpoint.load(path)
        try:
            saved = numbers["config"]
            was = TrainConfig.of_saved(saved).resolved() | {"versions": saved["versions"]}
            checkpoint.check_same(path, was, self.config.resolved())
            self.actor.load_state_dict(tensors["actor"])
            self.critic.load_state_dict(tensors["critic"])
            self.algorithm.restore(tensors.get("optimisers", {}))
            self.env.restore({k: v.numpy() for k, v in tensors["environment"].items()})
            self._episodes.running |= {k: v.numpy().copy() for k, v in tensors["running"].items()}
            self._generators = tensors["generators"]
            self.iteration, self.seconds = int(numbers["iteration"]), float(numbers["seconds"])
        except QuadrlError:
            raise
        except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError,
                ValueError) as error:  # fmt: skip
            reason = str(error).partition("\n")[0]
            raise QuadrlError(f"{path} does not fit its run: {reason}") from error
