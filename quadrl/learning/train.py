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

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.files import PART
from quadrl.base.machine import processor_kind
from quadrl.base.progress import Progress
from quadrl.core.launch import make_device
from quadrl.core.transition import TIME_LIMIT
from quadrl.engines import native
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.policy_file import FILE as POLICY_FILE
from quadrl.learning import checkpoint, environments, log, networks
from quadrl.learning.advantages import Advantages, add_values
from quadrl.learning.algorithm import generators, one_thread, set_generators
from quadrl.learning.algorithms import make_algorithm
from quadrl.learning.config import TrainConfig
from quadrl.learning.evaluations import Evaluations
from quadrl.learning.folder import (
    EVALUATION,
    WARNINGS,
    earlier,
    lock_folder,
    new_folder,
    read_config,
    run_of,
    write_config,
)
from quadrl.learning.networks import BEGINS, PRIVILEGED, STATE
from quadrl.learning.normaliser import update_normalisers
from quadrl.learning.numpy_policy import export, metadata_of
from quadrl.learning.origin import Origin

LEARNED_FROM = ("action", "action_log_prob", "loc", "scale", "advantage", "value_target")
"""Entries of a batch that algorithms learn from, beside those that actor and critic read."""


class Training:
    """A training, and the folder of its run."""

    on_device = False
    """Whether its aircraft are where its networks are."""

    @one_thread()  # for the bits of the first weights
    def __init__(self, config: TrainConfig, folder: Path, *, resume: bool = False) -> None:
        """Make environments, networks and algorithm; then make the folder, or load its checkpoint.

        A run may be continued with more steps than it was begun with.

        Raises:
            QuadrlError: The folder or the device cannot be used.
        """
        self.config, self.folder = config, folder
        device = make_device(config.device)
        torch.manual_seed(config.seed)
        self.env = self._make_env(device)
        size, actions = self.env.environment.size, self.env.environment.action_size
        networks.check_fits(config, size)
        given = self.env.observation_spec.get(PRIVILEGED, None)
        self.actor, self.critic, self.normalisers = networks.make_actor_critic(
            size, actions, config, 0 if given is None else given.shape[-1]
        )
        for network in (self.actor, self.critic):
            network.to(device)
        begun = resume and any((folder / x).exists() for x in (checkpoint.CHECKPOINT, POLICY_FILE))
        self._origin = earlier(folder, len(config.phases)) if config.phases else config.from_run
        """The run whose networks it begins with, or none."""
        if self._origin and not begun:
            found = Origin.of(self._origin).checkpoint(size, actions)
            checkpoint.begin_with(found, self.actor, self.critic)
        self.algorithm = make_algorithm(config, self.env, self.actor, self.critic)
        self.advantages = Advantages(config, device)
        self.iteration = 0
        self.seconds = 0.0  # of training, in all processes that worked on it
        self._evaluations = Evaluations(config, folder) if config.evaluations else None
        flown = self.env.environment
        self._episodes = environments.EpisodeStatistics(
            *(config.num_envs, flown.time_limit_steps, config.rollout),
            *(flown.term_names, ("diverged", *flown.end_names, TIME_LIMIT)),
            device if self.on_device else "cpu",
        )
        self._generators: dict[str, torch.Tensor] = {}
        self._remembered: dict[str, np.ndarray] = {}  # the states of a recurrent policy
        self._asked = self._stopping = False
        log.check(config.log)
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
        if self._evaluations:
            self._evaluations.begin(self.steps)

    def _make_env(self, device: torch.device) -> Any:
        """The aircraft of the training."""
        return environments.make_env(self.config, device)

    def _make_collector(self) -> Any:
        """What flies them, batch after batch."""
        frames = self.config.num_envs * self.config.rollout
        return environments.make_collector(self.env, self.actor, frames)

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
            if self.iteration >= config.iterations or self._reached:
                policy = self.policy()  # it may have been killed between checkpoint and policy
                policy.save(self.folder / POLICY_FILE)
                return policy
            collector = self._make_collector()
            stack.callback(collector.shutdown, close_env=False)
            set_generators(self._generators, self.env.device)
            self.env.told()  # what the collector asked of it before
            settings = {name: value for name, value, _ in config.sources()}
            columns = [*self._episodes.columns, *self.algorithm.columns]
            logged = self.folder, self.iteration, columns, settings, config.log
            rows = log.Log(*logged)
            stack.callback(rows.close)
            if self._evaluations:
                self._evaluations.on_row = rows.evaluated
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
                sound = [weight.isfinite().all() for weight in self.algorithm.parameters]
                if not torch.stack(sound).all():
                    raise QuadrlError(
                        f"the training diverged after {self.steps} steps: a weight is no longer "
                        "finite; lower the learning rate and start a new run"
                    )
                rows.write(self.iteration, self.steps, self.seconds, metrics)
                if self._evaluations and self.iteration in self._evaluations.due:
                    moment = self.iteration, self.steps, self.seconds
                    self._evaluations.add(*moment, self._present())
                if config.checkpoint_every and self._passes(config.checkpoint_every):
                    numbered = POLICY_FILE.replace(".", f"_{self.steps:09}.")
                    self._present(described=True).save(self.folder / numbered)
                progress = (self.iteration, config.iterations, self.steps, self.seconds, metrics)
                on_progress(Progress(*progress))
                over = self.iteration == config.iterations or self._reached or self._stopping
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

    @property
    def _reached(self) -> bool:
        return bool(self._evaluations) and self._evaluations.reached

    def _passes(self, every: int) -> bool:
        """Whether the last iteration passed a multiple of some control steps."""
        return self.steps % every < self.config.num_envs * self.config.rollout

    def policy(self) -> Policy:
        """Export the policy that is kept so far: the best, or the present one."""
        best = self._evaluations.best if self._evaluations else None
        if best is None or self.config.keep == "last":
            return self._present(described=True)
        return dataclasses.replace(
            best.policy, metadata=metadata_of(self.config, self._known_as, best.steps)
        )

    def _present(self, *, described: bool = False) -> Policy:
        metadata = metadata_of(self.config, self._known_as, self.steps) if described else {}
        return export(self.actor, self.config.task, metadata)

    def _learn(self, batch: Any) -> dict[str, float]:
        """Do one iteration with a batch (aircraft, time)."""
        terms, ends, which = self.env.told()
        names = ("reward", "done", "terminated", "is_success", "error")
        told = {name: batch["next", name][..., 0].cpu().T for name in names}
        metrics = self._episodes.count(told, *map(torch.from_numpy, (terms, ends)))
        with torch.no_grad():
            if self.config.memory != "none":
                done, state = (batch["next", name] for name in ("done", STATE))
                batch[BEGINS] = torch.roll(done, 1, dims=1)
                batch[BEGINS][:, 0] = False  # a state with which an episode begins is zero
                self._remembered = {STATE: state[:, -1].masked_fill(done[:, -1], 0.0).cpu().numpy()}
            fresh = self.iteration == 0 and not self._origin
            first = fresh and not self.algorithm.whole
            if first:  # the first batch was collected without a normaliser
                update_normalisers(self.normalisers, batch)
                with set_recurrent_mode():
                    present = self.actor.get_dist(batch)
                batch["action_log_prob"] = present.log_prob(batch["action"])
            batch["next", "reward"] *= self.config.reward_scale
            add_values(batch, self.critic)
            self.advantages(batch, which)
        flat = batch.select(*self.actor.in_keys, *self.critic.in_keys, *LEARNED_FROM)
        if self.config.memory == "none" and not self.algorithm.whole:
            flat = flat.reshape(-1)
        metrics |= self.algorithm.update(flat, 1 - self.iteration / self.config.iterations)
        if not first:
            update_normalisers(self.normalisers, batch)
        return metrics | {"deviation": float(batch["scale"].mean())}

    def save(self) -> None:
        """Write the checkpoint and the policy."""
        if self._evaluations:
            self._evaluations.fly()
        tensors = {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "returns": self.advantages.returns,
            "optimisers": self.algorithm.save(),
            "environment": self.env.save() | self._remembered,
            "running": self._episodes.running,
            "generators": generators(self.env.device),
        }
        arrays, best = self._evaluations.save() if self._evaluations else ({}, [])
        if best:
            tensors["best"] = arrays
        numbers = {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "config": self.config.resolved(),
            "best": best,
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
            for name, values in tensors.get("returns", {}).items():  # older trainings have none
                self.advantages.returns[name].copy_(values)
            self.algorithm.restore(tensors.get("optimisers", {}))
            self.env.restore({k: v.numpy() for k, v in tensors["environment"].items()})
            for name, values in tensors["running"].items():
                self._episodes.running[name].copy_(values)
            self._generators = tensors["generators"]
            if self._evaluations and numbers["best"]:
                arrays = {k: v.numpy() for k, v in tensors["best"].items()}
                self._evaluations.restore(arrays, numbers["best"], self.config.task)
            self.iteration, self.seconds = int(numbers["iteration"]), float(numbers["seconds"])
        except QuadrlError:
            raise
        except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError,
                ValueError) as error:  # fmt: skip
            reason = str(error).partition("\n")[0]
            raise QuadrlError(f"{path} does not fit its run: {reason}") from error
