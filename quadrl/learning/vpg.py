"""The plain policy gradient with generalised advantages (Schulman et al. 2016), on A2CLoss.

The paper calls the algorithm GAE, after its advantages.
"""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import A2CLoss

from quadrl.learning.algorithm import Algorithm
from quadrl.learning.settings import VPGConfig


class VPG(Algorithm):
    """One gradient step of the policy on each batch, and a few epochs of the critic."""

    def __init__(
        self, actor: ProbabilisticActor, critic: TensorDictModule, config: VPGConfig
    ) -> None:
        """Make the loss and the optimisers."""
        super().__init__(actor, critic, config)
        # The loss of the policy alone, since the critic has epochs of its own.
        own = {"critic_coeff": None, "entropy_bonus": False, "functional": False}
        self.loss = A2CLoss(actor, critic, **own)
        self.add_optimiser("policy", actor, config.learning_rate)
        self.add_optimiser("critic", critic, config.critic_rate)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Take the step of the policy, then fit the critic."""
        self.step(self.loss(batch)["loss_objective"], "policy")
        return self.fit_critic(batch)
