"""PPO (Schulman et al. 2017) on TorchRL's ClipPPOLoss."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from quadrl.base.errors import QuadrlError
from quadrl.learning.algorithm import Algorithm
from quadrl.learning.fused import PPOGradients
from quadrl.learning.networks import Entries
from quadrl.learning.settings import PPOConfig


class PPO(Algorithm):
    """Several epochs of clipped gradient steps on each batch."""

    def __init__(self, actor: ProbabilisticActor, critic: Entries, config: PPOConfig) -> None:
        """Make the loss and the optimisers.

        Raises:
            QuadrlError: The settings ask for the fused gradients, which do not fit the networks.
        """
        super().__init__(actor, critic, config)
        policy: Any = actor.module[0]
        self.loss = ClipPPOLoss(
            actor,
            critic,
            clip_epsilon=config.clip,
            entropy_bonus=config.entropy > 0,
            entropy_coeff=config.entropy,
            critic_coeff=config.critic,
            loss_critic_type="l2",
            # Without two things that cost time: a figure for the log, and parameters as arguments.
            log_explained_variance=False,
            functional=False,
        )
        self.fused: PPOGradients | None = None
        """The gradients that are written by hand, where they are used."""
        if config.fused:
            if policy.plain is None or critic.plain is None:
                reason = "the gradients written by hand are those of networks of plain layers"
                raise QuadrlError(reason, name="ppo.fused", value=True, allowed="False for others")
            self.fused = PPOGradients(policy.plain, critic.plain, config)
        adam = {"betas": (0.9, config.beta2), "fused": True}
        self.add_optimiser("policy", actor, config.learning_rate, **adam)
        self.add_optimiser("critic", critic, config.learning_rate, **adam)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Take gradient steps on the minibatches of several epochs."""
        batch, fused = batch.exclude("loc", "scale"), self.fused
        if fused is not None:
            batch = fused.prepare(batch)
        found: Any = None
        for part in self.minibatches(batch, self.config.epochs):
            if fused is not None:
                found = fused.gradients(part)
                self.move("policy", "critic")
            else:
                found = self.loss(part)
                losses = [value for name, value in found.items() if name.startswith("loss_")]
                self.step(losses, "policy", "critic")
        if fused is not None:
            found = fused.figures(*found)
        logged = {"critic_loss": "loss_critic", "kl": "kl_approx", "clip_fraction": "clip_fraction"}
        # A critic with weight 0 has no loss.
        known = {name: found[key].item() for name, key in logged.items() if key in found.keys()}
        return dict.fromkeys(logged, 0.0) | known
