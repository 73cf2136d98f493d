"""TRPO (Schulman et al. 2015) as a TorchRL loss module and an update; TorchRL has none."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.distributions import kl_divergence
from torchrl.modules import ProbabilisticActor
from torchrl.objectives.common import LossModule

from quadrl.learning.algorithm import Algorithm
from quadrl.learning.algorithm_config import TRPOConfig


class TRPOLoss(LossModule):
    """The surrogate of TRPO, the KL divergence from the policy that acted, and the critic's loss.

    The forward reads what actor and critic read, `action`, `action_log_prob`, `advantage`,
    `value_target` and the parameters of the acting policy (`loc`, `scale`), each (n, ...), and
    gives `loss_objective` (the negative surrogate, equation 14 of the paper), `kl` (mean KL
    divergence of the acting policy from the present one, in closed form) and `loss_critic`.
    """

    def __init__(self, actor_network: ProbabilisticActor, critic_network: TensorDictModule) -> None:
        """Keep references to the networks."""
        super().__init__()
        self.actor_network = actor_network
        self.critic_network = critic_network

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The three losses as scalars."""
        surrogate, kl = self.surrogate_and_kl(tensordict)
        critic = self.critic_loss(tensordict)
        return TensorDict({"loss_objective": -surrogate, "kl": kl, "loss_critic": critic})

    def critic_loss(self, batch: TensorDictBase) -> Tensor:
        """Mean squared error of the critic, a scalar."""
        value = self.critic_network(batch.select(*self.critic_network.in_keys)).get("state_value")
        return (value - batch.get("value_target")).square().mean()

    def surrogate_and_kl(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Mean of ratio times advantage, and mean KL divergence; scalars."""
        present: Any = self.actor_network.get_dist(batch.select(*self.actor_network.in_keys))
        acting = type(present)(batch.get("loc"), batch.get("scale"))
        ratio = (present.log_prob(batch.get("action")) - batch.get("action_log_prob")).exp()
        surrogate = (ratio * batch.get("advantage").squeeze(-1)).mean()
        # The base of an Independent(Normal): its closed form, summed over the actions.
        kl = kl_divergence(acting.base_dist, present.base_dist).sum(-1).mean()
        return surrogate, kl


def conjugate_gradients(
    product: Callable[[Tensor], Tensor], target: Tensor, iterations: int, tolerance: float = 1e-10
) -> Tensor:
    """Solve A x = b for a symmetric positive definite A that is only known by its products.

    Args:
        product: x (n,) to A x (n,).
        target: b (n,), float64.
        iterations: Their largest number.
        tolerance: On the squared residual over that of b.

    Returns:
        x (n,), float64.
    """
    solution = torch.zeros_like(target)
    residual, direction = target.clone(), target.clone()
    square = residual @ residual
    enough = tolerance * square
    for _ in range(iterations):
        if square <= enough:
            break
        image = product(direction)
        step = square / (direction @ image)
        solution += step * direction
        residual -= step * image
        last, square = square, residual @ residual
        direction = residual + (square / last) * direction
    return solution


def fisher_product(
    kl: Tensor, parameters: Sequence[Tensor], damping: float
) -> Callable[[Tensor], Tensor]:
    """Products with the Fisher matrix: the Hessian of the mean KL divergence, plus damping.

    Args:
        kl: Scalar with a graph, at the policy that acted.
        parameters: Of the policy, n numbers in all.
        damping: Added to the diagonal.

    Returns:
        A function (n,) float64 to (n,) float64.
    """
    gradient = flat(torch.autograd.grad(kl, parameters, create_graph=True))

    def product(vector: Tensor) -> Tensor:
        along = (gradient.double() * vector).sum()
        second = torch.autograd.grad(along, parameters, retain_graph=True)
        return flat(second).double() + damping * vector

    return product


def flat(tensors: Sequence[Tensor]) -> Tensor:
    """All tensors in one vector."""
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


class TRPO(Algorithm):
    """One natural-gradient step of the policy on each batch, and a few epochs of the critic."""

    def __init__(
        self, actor: ProbabilisticActor, critic: TensorDictModule, config: TRPOConfig
    ) -> None:
        """Make the loss and the critic's optimiser."""
        super().__init__(config)
        self.loss = TRPOLoss(actor, critic)
        self.policy = list(actor.parameters())
        self.add_optimiser("critic", critic.parameters(), config.critic_rate)
        self.parameters += self.policy

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """The policy's step, then the critic's epochs."""
        return self.natural_step(batch) | self.fit_critic(self.loss.critic_loss, batch)

    def natural_step(self, batch: TensorDictBase) -> dict[str, float]:
        """The policy's step: natural gradient, then a line search under the KL bound.

        Takes the longest of the tried steps with which the surrogate rises and the mean KL
        divergence stays within the bound; without any, the policy stays as it is.
        """
        config = self.config
        surrogate, kl = self.loss.surrogate_and_kl(batch)
        gradient = flat(torch.autograd.grad(surrogate, self.policy, retain_graph=True)).double()
        product = fisher_product(kl, self.policy, config.damping)
        direction = conjugate_gradients(product, gradient, config.iterations)
        curvature = direction @ product(direction)
        start = flat([p.detach() for p in self.policy])
        before = surrogate.item()
        if not math.isfinite(curvature.item()) or curvature <= 0:
            return {"kl": 0.0, "step": 0.0, "surrogate_gain": 0.0}
        full = direction * torch.sqrt(2 * config.max_kl / curvature)
        share = 1.0
        for _ in range(config.backtracks):
            self._set(start + (share * full).to(start.dtype))
            with torch.no_grad():
                after, divergence = (x.item() for x in self.loss.surrogate_and_kl(batch))
            if after > before and divergence <= config.max_kl:
                return {"kl": divergence, "step": share, "surrogate_gain": after - before}
            share *= config.shrink
        self._set(start)
        return {"kl": 0.0, "step": 0.0, "surrogate_gain": 0.0}

    @torch.no_grad()
    def _set(self, vector: Tensor) -> None:
        parts = vector.split([parameter.numel() for parameter in self.policy])
        for parameter, part in zip(self.policy, parts, strict=True):
            parameter.copy_(part.view_as(parameter))
