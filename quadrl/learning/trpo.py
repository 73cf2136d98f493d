"""The update of TRPO (Schulman et al. 2015): natural gradient and line search."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.modules import ProbabilisticActor

from quadrl.learning.algorithm import Algorithm
from quadrl.learning.settings import TRPOConfig
from quadrl.learning.trpo_loss import TRPOLoss

SAFETY = 0.95
"""Share of the step that would meet the bound if the divergence were quadratic in its length."""


def conjugate_gradients(
    product: Callable[[Tensor], Tensor], target: Tensor, iterations: int, tolerance: float = 1e-10
) -> Tensor:
    """Solve A x = b for a symmetric positive definite A of which only products are known.

    Args:
        product: Maps x (n,) to A x (n,).
        target: b (n,), float64.
        iterations: Largest number of iterations.
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
    """Make products with the Fisher matrix: the Hessian of the mean KL divergence, plus damping.

    Args:
        kl: Scalar with a graph, for the policy that acted.
        parameters: Parameters of the policy, n numbers in all.
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
    """Join tensors to one vector."""
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


class TRPO(Algorithm):
    """One natural-gradient step of the policy on each batch, and a few epochs of the critic."""

    def __init__(
        self, actor: ProbabilisticActor, critic: TensorDictModule, config: TRPOConfig
    ) -> None:
        """Make the loss and the critic's optimiser."""
        super().__init__(actor, critic, config)
        self.loss = TRPOLoss(actor, functional=False)
        self.policy = list(actor.parameters())
        self.add_optimiser("critic", critic, config.critic_rate)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Take the step of the policy, then fit the critic."""
        return self.natural_step(batch) | self.fit_critic(batch)

    def natural_step(self, batch: TensorDictBase) -> dict[str, float]:
        """Take the step of the policy: natural gradient, then a line search under the KL bound.

        The step is the first of ever shorter ones with which the surrogate rises and the mean KL
        divergence stays within the bound. If there is none, the policy stays as it is, bit for bit.
        """
        config = self.config
        surrogate, kl = self.loss.surrogate_and_kl(batch)
        gradient = flat(torch.autograd.grad(surrogate, self.policy, retain_graph=True)).double()
        product = fisher_product(kl, self.policy, config.damping)
        direction = conjugate_gradients(product, gradient, config.iterations)
        curvature = direction @ product(direction)
        start = flat([p.detach() for p in self.policy])
        before = surrogate.item()
        full = direction * torch.sqrt(2 * config.max_kl / curvature)
        curved = 0 < curvature.item() < math.inf  # otherwise the step has no length
        share = 1.0
        for _ in range(config.backtracks if curved else 0):
            self._set(start + (share * full).to(start.dtype))
            with torch.no_grad():
                after, divergence = (x.item() for x in self.loss.surrogate_and_kl(batch))
            if after > before and divergence <= config.max_kl:
                return {"kl": divergence, "step": share, "surrogate_gain": after - before}
            share *= self.shorter(divergence)
        self._set(start)
        return {"kl": 0.0, "step": 0.0, "surrogate_gain": 0.0}

    def shorter(self, divergence: float) -> float:
        """Choose the factor from a refused step to the next by the divergence of the refused one.

        The divergence of a short step grows with the square of its length. After a step beyond the
        bound, the next one is a little shorter than the one that would meet the bound by that rule.
        """
        if self.config.max_kl < divergence < math.inf:
            return SAFETY * math.sqrt(self.config.max_kl / divergence)
        return self.config.shrink

    @torch.no_grad()
    def _set(self, vector: Tensor) -> None:
        parts = vector.split([parameter.numel() for parameter in self.policy])
        for parameter, part in zip(self.policy, parts, strict=True):
            parameter.copy_(part.view_as(parameter))
