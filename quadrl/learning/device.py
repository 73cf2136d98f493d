"""Trainings that never leave a GPU: rollouts and gradient steps of PPO in a graph of kernels.

The first iteration runs kernel by kernel. It is then recorded, and each further iteration is one
launch: a batch of some ten thousand aircraft takes less time than Python would need to ask for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from quadrl.core.batch import Batch
from quadrl.core.columns import uncovered
from quadrl.core.environment import Environment
from quadrl.evaluation.policy import LOG_VARIANCE
from quadrl.learning import environments, networks
from quadrl.learning.advantages import LEAST
from quadrl.learning.config import TrainConfig
from quadrl.learning.fused import LOG_2_PI, forward
from quadrl.learning.normaliser import Normaliser, update_normalisers
from quadrl.learning.train import Training


class Flown:
    """The aircraft of a training on a device, as `Training` sees them."""

    def __init__(self, config: TrainConfig, device: torch.device) -> None:
        """Make them; each step of a rollout has a slot."""
        if device.type == "cuda":
            torch.cuda.set_device(device)  # graphs are recorded on the present one
        scenario, seed = config.training_scenario, config.seed * environments.SEED_STRIDE
        slots = config.rollout
        self.batch = Batch(scenario, config.num_envs, seed, device, slots=slots)
        self.environment, self.device = self.batch.environment, device
        self.batch.reset()

    @property
    def observation_spec(self) -> Mapping[str, Tensor]:
        """The privileged observation (N, p), where there is one, by its name."""
        slot = self.batch.slots[0]
        return {networks.PRIVILEGED: slot.privileged} if slot.privileged.shape[1] else {}

    def told(self) -> None:
        """Nothing: the batch has it."""

    def save(self) -> dict[str, np.ndarray]:
        """All that the next steps depend on."""
        return self.batch.save()

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Restore what `save` returned."""
        self.batch.restore(saved)


class Rollouts:
    """The batches of a training: the learner flies them itself, in its graph."""

    def __iter__(self) -> Iterator[None]:
        """Nothing, again and again."""
        while True:
            yield None

    def shutdown(self, **_: Any) -> None:
        """Nothing is open."""


class DeviceTraining(Training):
    """PPO whose aircraft, networks and gradient steps are on one device."""

    env: Any  # pyright: ignore[reportIncompatibleVariableOverride]
    on_device = True

    def __init__(self, config: TrainConfig, *given: Any, **more: Any) -> None:
        """Make it as `Training` does, with settings for which `elsewhere` says nothing."""
        super().__init__(config, *given, **more)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._warm = False
        self._learner = Learner(self)

    def _make_env(self, device: torch.device) -> Flown:
        return Flown(self.config, device)

    def _make_collector(self) -> Rollouts:
        return Rollouts()

    def _learn(self, batch: None) -> dict[str, float]:
        learner, remaining = self._learner, 1 - self.iteration / self.config.iterations
        fresh = self.iteration == 0 and not self._origin
        self.algorithm.set_rates(remaining)
        if self.env.device.type != "cuda" or not self._warm:
            learner.iterate(fresh)
            self._warm = True
        else:
            if self._graph is None:
                self._graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(self._graph):
                    learner.iterate(False)
            self._graph.replay()
        metrics = learner.count(self._episodes)
        self.env.batch.check()
        return metrics


def elsewhere(config: TrainConfig) -> str:
    """Why a training cannot be on its device alone, in words; empty where it can."""
    for name, value, allowed in (
        ("algo", config.algo, "ppo"),
        ("memory", config.memory, "none"),
        ("ppo.fused", config.ppo.fused, True),
        ("gammas", config.gammas, ()),
    ):
        if value != allowed:
            return f"trainings there take {name} = {allowed!r} alone"
    if config.training_scenario.engine != "free_flight":
        return "the engine is not free_flight"
    environment = Environment(config.training_scenario, num_envs=1, seed=0)
    if why := uncovered(environment):
        return f"free flight on a GPU has no {why}"
    environment.reset()
    return environment.not_compiled


class Learner:
    """One iteration: T steps of N aircraft, their advantages, and PPO's gradient steps."""

    def __init__(self, training: DeviceTraining) -> None:
        """Make the tensors that stay between iterations."""
        self._training, self._config = training, training.config
        self._batch: Batch = training.env.batch
        steps, count = self._config.rollout, self._batch.num_envs
        given: Any = {"device": self._batch.device}
        self._before = torch.zeros(steps, count, **given)  # log-probabilities
        self._first = torch.zeros_like(self._batch.out[-1, : self._batch.layout.seen])
        self._figures = torch.zeros(4, **given)
        self._policy: Any = training.actor.module[0].plain
        self._critic: Any = training.critic.plain
        self._algorithm: Any = training.algorithm
        self._gradients: Any = self._algorithm.fused

    @torch.no_grad()
    def iterate(self, fresh: bool) -> None:
        """Fly and learn.

        Args:
            fresh: Whether it is the first iteration, which is flown without normalisers.
        """
        self._fly()
        normalisers = self._training.normalisers
        if fresh:
            self._update(normalisers)
        part = self._prepare()
        if fresh:
            part["before"] = self._log_probability(part["policy"], part["action"])
        self._advantages(part)
        count, config = len(part["before"]), self._algorithm.config
        found: Any = None
        for _ in range(config.epochs):
            order = torch.rand(count, device=self._batch.device).argsort()
            for chosen in order.split(config.minibatch):
                own = {name: x.index_select(0, chosen) for name, x in part.items()}
                found = self._gradients.gradients(own)
                self._algorithm.move("policy", "critic")
        figures = self._gradients.figures(*found)
        names = ("loss_critic", "kl_approx", "clip_fraction")
        self._figures[:3] = torch.stack([figures[name] for name in names])
        if not fresh:
            self._update(normalisers)

    def _fly(self) -> None:
        """Fly a rollout with the present policy."""
        batch, policy = self._batch, self._policy
        self._first.copy_(batch.out[-1, : batch.layout.seen])
        weights, deviations = policy.weights(), self._figures[3:]
        deviations.zero_()
        seen = self._first[: batch.layout.observed].T
        for step, slot in enumerate(batch.slots):
            _, mean, free = policy.forward_policy(policy.seen({"observation": seen}), weights)
            log_variance = free.clamp(*LOG_VARIANCE)
            deviation, noise = (0.5 * log_variance).exp(), torch.randn_like(mean)
            torch.addcmul(mean, deviation, noise, out=slot.action)
            square = (noise.square() + log_variance).sum(-1)
            self._before[step] = -0.5 * (square + LOG_2_PI * mean.shape[1])
            deviations += deviation.mean() / len(batch.slots)
            batch.fly(step)
            seen = slot.observation

    def _observed(self) -> Mapping[str, Tensor]:
        """What was observed before each step, (T N, size) by name."""
        size = self._batch.layout.seen
        return self._named(torch.cat([self._first[None], self._batch.out[:-1, :size]]))

    def _named(self, seen: Tensor) -> Mapping[str, Tensor]:
        """Rows (T N, size) by name of what is seen (T, sizes, N) in all."""
        own = self._batch.layout.observed
        rows = seen.movedim(1, 2).flatten(0, 1)
        return {"observation": rows[:, :own], networks.PRIVILEGED: rows[:, own:]}

    def _update(self, normalisers: dict[str, Normaliser]) -> None:
        update_normalisers(normalisers, self._observed())

    def _prepare(self) -> dict[str, Tensor]:
        """The rows that gradients read."""
        seen = self._observed()
        return {
            "policy": self._policy.seen(seen).contiguous(),
            "critic": self._critic.seen(seen).contiguous(),
            "action": self._batch.action.flatten(0, 1),
            "before": self._before.flatten(),
        }

    def _log_probability(self, seen: Tensor, action: Tensor) -> Tensor:
        _, mean, free = self._policy.forward_policy(seen, self._policy.weights())
        log_variance = free.clamp(*LOG_VARIANCE)
        square = (action - mean).square() * (-log_variance).exp() + log_variance
        return -0.5 * (square.sum(-1) + LOG_2_PI * action.shape[1])

    def _advantages(self, part: dict[str, Tensor]) -> None:
        """Add advantages and the critic's targets to the rows."""
        batch, config, weights = self._batch, self._config, self._critic.weights()
        layout = batch.layout
        final = self._named(batch.out[:, layout.seen : layout.reward])
        values, after = (
            forward(seen, weights)[1].view(config.rollout, -1)
            for seen in (part["critic"], self._critic.seen(final))
        )
        over, terminated = batch.flags[:, 0], batch.flags[:, 1]
        after = after * ~terminated
        after[:-1] = torch.where(over[:-1], after[:-1], values[1:])
        change = config.reward_scale * batch.out[:, layout.reward] + config.gamma * after - values
        going, advantage = ~over * (config.gamma * config.gae_lambda), change
        for step in reversed(range(len(change) - 1)):
            change[step] += going[step] * advantage[step + 1]
        part["target"] = (advantage + values).flatten()
        part["advantage"] = (
            (advantage - advantage.mean()) / advantage.std().clamp(min=LEAST)
        ).flatten()

    def count(self, episodes: environments.EpisodeStatistics) -> dict[str, float]:
        """The metrics of the last iteration."""
        batch, layout = self._batch, self._batch.layout
        names = ("done", "terminated", "truncated", "is_success", "diverged")
        told = dict(zip(names, batch.flags.unbind(1), strict=False))
        told |= {"reward": batch.out[:, layout.reward], "error": batch.out[:, layout.reward + 1]}
        going, ended = told["done"], list[Tensor]()
        for holds in (told["diverged"], *batch.flags[:, 5:].unbind(1), told["truncated"]):
            ended.append(going & holds)
            going = going & ~holds
        metrics = episodes.count(told, batch.out[:, layout.reward + 2 :], torch.stack(ended, 1))
        names = ("critic_loss", "kl", "clip_fraction", "deviation")
        return metrics | dict(zip(names, self._figures.tolist(), strict=True))
