"""PPO (Schulman et al. 2017) on TorchRL's ClipPPOLoss."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from quadrl.learning.algorithm import Algorithm
from quadrl.learning.algorithm_config import PPOConfig


class PPO(Algorithm):
    """Several epochs of clipped gradient steps on each batch."""

    def __init__(
        self, actor: ProbabilisticActor, critic: TensorDictModule, config: PPOConfig
    ) -> None:
        """Make the loss and the optimisers."""
        super().__init__(config)
        self.loss = ClipPPOLoss(
            actor,
            critic,
            clip_epsilon=config.clip,
            entropy_bonus=config.entropy > 0,
            entropy_coeff=config.entropy,
            critic_coeff=config.critic,
            loss_critic_type="l2",
            log_explained_variance=False,
            functional=False,  # nothing needs the parameters as arguments, and that costs time
        )
        self.add_optimiser("policy", actor.parameters(), config.learning_rate, fused=True)
        self.add_optimiser("critic", critic.parameters(), config.learning_rate, fused=True)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Epochs over minibatches."""
        batch = batch.exclude("loc", "scale")
        losses: Any = None
        for _ in range(self.config.epochs):
            for part in batch[torch.randperm(len(batch))].split(self.rows(batch)):
                losses = self.loss(part)
                weighted = [loss for name, loss in losses.items() if name.startswith("loss_")]
                self.step(torch.stack(weighted).sum(), "policy", "critic")
        last = losses.detach()
        return {
            "critic_loss": float(last.get("loss_critic", 0.0)),  # with no weight it has none
            "kl": float(last["kl_approx"]),
            "clip_fraction": float(last["clip_fraction"]),
        }
