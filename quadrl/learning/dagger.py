"""Imitation of a teacher that is told what was drawn (DAgger: Ross, Gordon and Bagnell 2011).

The policy flies, the teacher says what it would do in each of these states, and the policy is
fitted to that. It has to find out from what it sees what the teacher is told.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor

from quadrl.learning.algorithm import Algorithm
from quadrl.learning.environments import TrainingEnv
from quadrl.learning.settings import DaggerConfig


class Dagger(Algorithm):
    """Epochs of the policy towards the teacher's actions on each batch, and none of the critic."""

    whole, columns = True, ("distance",)

    def __init__(
        self,
        actor: ProbabilisticActor,
        critic: TensorDictModule,
        config: DaggerConfig,
        env: TrainingEnv,
    ) -> None:
        """Make the optimiser; the environments keep what the teacher says."""
        super().__init__(actor, critic, config)
        self._env = env
        self.add_optimiser("policy", actor, config.learning_rate)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch (aircraft, time): the squared distance from the teacher's actions."""
        taught = torch.from_numpy(self._env.taught()).float().transpose(0, 1)
        seen = batch.select(*self.actor.in_keys).set("taught", taught.to(batch.device))
        loss = torch.zeros(())
        for part in self.minibatches(seen, self.config.epochs):
            found: Any = self.actor.get_dist_params(part)
            loss = (found["loc"] - part["taught"]).square().mean()
            self.step(loss, "policy")
        return {"distance": loss.sqrt().item()}
