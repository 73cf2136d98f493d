"""PPO (Schulman et al. 2017) on TorchRL's ClipPPOLoss, or its fused form."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor

from quadrl.learning.algorithm import Algorithm, shuffled
from quadrl.learning.fused import FusedPPOLoss, make_loss
from quadrl.learning.settings import PPOConfig


class PPO(Algorithm):
    """Several epochs of clipped gradient steps on each batch."""

    def __init__(
        self, actor: ProbabilisticActor, critic: TensorDictModule, config: PPOConfig
    ) -> None:
        """Make the loss and the optimisers."""
        super().__init__(config)
        self.loss = make_loss(
            actor,
            critic,
            clip_epsilon=config.clip,
            entropy_bonus=config.entropy > 0,
            entropy_coeff=config.entropy,
            critic_coeff=config.critic,
        )
        for name, network in (("policy", actor), ("critic", critic)):
            self.add_optimiser(
                name,
                network.parameters(),
                config.learning_rate,
                betas=(0.9, config.beta2),
                fused=True,
            )

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Epochs over minibatches."""
        batch, loss = batch.exclude("loc", "scale"), self.loss
        fused = loss if isinstance(loss, FusedPPOLoss) else None
        if fused is not None:
            batch = fused.prepare(batch)
        found: Any = None
        for _ in range(self.config.epochs):
            for part in shuffled(batch).split(self.rows(batch)):
                if fused is not None:
                    found = fused.gradients(part)
                    self.move("policy", "critic")
                else:
                    found = loss(part)
                    weighted = [value for name, value in found.items() if name.startswith("loss_")]
                    self.step(weighted, "policy", "critic")
        if fused is not None:
            found = fused.summary(found)
        logged = {"critic_loss": "loss_critic", "kl": "kl_approx", "clip_fraction": "clip_fraction"}
        # Where the critic weighs nothing it has no loss.
        had = {name: key for name, key in logged.items() if key in found.keys()}
        return dict.fromkeys(logged, 0.0) | {name: found[key].item() for name, key in had.items()}
