"""The plain policy gradient with generalised advantages (Schulman et al. 2016), on A2CLoss.

The paper calls the algorithm GAE after its advantages: one gradient step of the policy a batch.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import A2CLoss

from quadrl.learning.config import GAEConfig


class GAE:
    """One gradient step of the policy on each batch, and a few epochs of the critic."""

    def __init__(
        self, actor: ProbabilisticActor, critic: TensorDictModule, config: GAEConfig
    ) -> None:
        """Set up the loss and the optimisers."""
        self.config = config
        self.loss = A2CLoss(
            actor,
            critic,
            entropy_bonus=False,
            critic_coeff=1.0,
            loss_critic_type="l2",
            functional=False,
        )
        self.policy, self.critic = list(actor.parameters()), list(critic.parameters())
        self.parameters = [*self.policy, *self.critic]
        self.optimisers = {
            "policy": torch.optim.Adam(self.policy, lr=config.learning_rate, eps=1e-5),
            "critic": torch.optim.Adam(self.critic, lr=config.critic_rate, eps=1e-5),
        }

    def update(self, batch: TensorDictBase, remaining: float) -> dict[str, float]:
        """Learn from a batch.

        Args:
            batch: (transitions,), with advantage (normalised), value_target, action_log_prob.
            remaining: Share of the training that is left, 1 to 0.

        Returns:
            Figures for the log.
        """
        config = self.config
        rates = {"policy": config.learning_rate, "critic": config.critic_rate}
        for name, optimiser in self.optimisers.items():
            for group in optimiser.param_groups:
                group["lr"] = rates[name] * remaining
        losses = self.loss(batch)
        self._step("policy", losses["loss_objective"], self.policy)
        critic_loss = losses["loss_critic"]
        for _ in range(config.critic_epochs):
            for rows in torch.randperm(len(batch)).split(config.minibatch):
                critic_loss = self.loss(batch[rows])["loss_critic"]
                self._step("critic", critic_loss, self.critic)
        return {"critic_loss": critic_loss.item()}

    def _step(self, name: str, loss: torch.Tensor, parameters: list[torch.nn.Parameter]) -> None:
        optimiser = self.optimisers[name]
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, self.config.max_gradient)
        optimiser.step()

    def save(self) -> dict[str, Any]:
        """The optimisers' tensors, by optimiser, parameter and name."""
        return {
            name: {str(k): dict(v) for k, v in optimiser.state_dict()["state"].items()}
            for name, optimiser in self.optimisers.items()
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what `save` gave."""
        for name, optimiser in self.optimisers.items():
            state = optimiser.state_dict()
            state["state"] = {int(k): v for k, v in saved[name].items()}
            optimiser.load_state_dict(state)
