"""PPO (Schulman et al. 2017) on TorchRL's ClipPPOLoss."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from quadrl.learning.config import PPOConfig


class PPO:
    """Several epochs of clipped gradient steps on each batch."""

    def __init__(
        self, actor: ProbabilisticActor, critic: TensorDictModule, config: PPOConfig
    ) -> None:
        """Set up the loss and the optimiser."""
        self.config = config
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
        self.parameters = list(self.loss.parameters())
        self.optimiser = torch.optim.Adam(
            self.parameters, lr=config.learning_rate, eps=1e-5, fused=True
        )

    def update(self, batch: TensorDictBase, remaining: float) -> dict[str, float]:
        """Learn from a batch.

        Args:
            batch: (transitions,), with advantage (normalised), value_target, action_log_prob.
            remaining: Share of the training that is left, 1 to 0.

        Returns:
            Figures for the log.
        """
        config = self.config
        for group in self.optimiser.param_groups:
            group["lr"] = config.learning_rate * remaining
        batch = batch.exclude("loc", "scale")
        losses: Any = None
        for _ in range(config.epochs):
            for part in batch[torch.randperm(len(batch))].split(config.minibatch):
                losses = self.loss(part)
                objective = losses["loss_objective"] + losses["loss_critic"]
                if config.entropy > 0:
                    objective = objective + losses["loss_entropy"]
                self.optimiser.zero_grad()
                objective.backward()
                torch.nn.utils.clip_grad_norm_(self.parameters, config.max_gradient)
                self.optimiser.step()
        return {
            "critic_loss": losses["loss_critic"].item(),
            "kl": losses["kl_approx"].item(),
            "clip_fraction": losses["clip_fraction"].item(),
        }

    def save(self) -> dict[str, Any]:
        """The optimiser's tensors, by parameter and name."""
        state = self.optimiser.state_dict()["state"]
        return {str(k): dict(v) for k, v in state.items()}

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what `save` gave."""
        state = self.optimiser.state_dict()
        state["state"] = {int(k): v for k, v in saved.items()}
        self.optimiser.load_state_dict(state)
