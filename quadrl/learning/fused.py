"""PPO's loss with a backward that is written by hand, for networks that are plain layers.

Of a gradient step with TorchRL's ClipPPOLoss only a third is arithmetic of the networks: the rest
is a graph of small operations, their tensordicts, and the tanh of torch. `FusedPPOLoss` is that
loss with one node in its graph for both networks and all that lies between them and the means.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from quadrl.evaluation.policy import LOG_VARIANCE
from quadrl.learning.plain import (
    LOG_2_PI,
    backward,
    forward,
    mean_and_log_variance,
    plain_policy,
    plain_value,
    rows,
)

USUAL: dict[str, Any] = {
    "loss_critic_type": "l2",
    # Without what costs time: a figure for the log, and the parameters as arguments.
    "log_explained_variance": False,
    "functional": False,
}
"""Settings of TorchRL's loss that are always the same."""


def make_loss(actor: ProbabilisticActor, critic: TensorDictModule, **settings: Any) -> ClipPPOLoss:
    """The loss of PPO: fused where both networks are plain, TorchRL's for any other.

    Args:
        actor: Of a normal distribution.
        critic: Gives `state_value`.
        **settings: Of `FusedPPOLoss`.
    """
    if plain_policy(actor) is not None and plain_value(critic) is not None:
        return FusedPPOLoss(actor, critic, **settings)
    return ClipPPOLoss(actor, critic, **USUAL, **settings)


# ------------------------------------------------------------------- gradients by hand


def terms(
    part: Mapping[str, Tensor], bounds: Sequence[Tensor], count: int, weights: Sequence[Tensor]
) -> tuple[tuple[Tensor, ...], tuple[Any, ...]]:
    """What the losses are means of, and what `slopes` needs of it.

    Args:
        part: What `FusedPPOLoss.prepare` gives. The policy may see one row more than there are
            transitions: the goal, whose mean is taken away from the others.
        bounds: Logarithms of the least and the largest ratio; beyond them nothing is gained.
        count: How many of the weights are the policy's.
        weights: Of the policy's layers, then of the critic's.

    Returns:
        Clipped gain, entropy, the critic's squared error, and the log-ratio, each (n,); and more.
    """
    seen, action, advantage = (part[name] for name in ("policy", "action", "advantage"))
    size = action.shape[1]
    values, output = forward(seen, weights[:count])
    mean, free = mean_and_log_variance(output, len(action))
    log_variance = free.clamp(*LOG_VARIANCE)
    off = action - mean
    by_mean = off * (-log_variance).exp()
    square = off * by_mean
    log_probability = -0.5 * ((square + log_variance).sum(-1) + size * LOG_2_PI)
    log_ratio = log_probability - part["before"]
    gain = log_ratio.exp() * advantage
    clipped = log_ratio.clamp(*bounds).exp() * advantage
    slope = torch.where(gain <= clipped, gain, 0.0)  # by the log-ratio: clipped, it is constant
    entropy = 0.5 * (log_variance.sum(-1) + size * (1 + LOG_2_PI))
    critic_values, value = forward(part["value"], weights[count:])
    error = value[:, 0] - part["target"]
    holds = len(output) > len(action)
    kept = values, critic_values, holds, slope, by_mean, square, free == log_variance, error
    return (torch.minimum(gain, clipped), entropy, error.square(), log_ratio), kept


def slopes(
    kept: tuple[Any, ...],
    count: int,
    weights: Sequence[Tensor],
    gain: Tensor | float,
    entropy: Tensor | float,
    squared_error: Tensor | float,
) -> list[Tensor]:
    """Gradients of the weights, from those of the terms: each (n,) or the same for all rows.

    Args:
        kept: What `terms` gave beside the terms.
        count: How many of the weights are the policy's.
        weights: Of the policy's layers, then of the critic's.
        gain: Gradient of the clipped gain.
        entropy: Gradient of the entropy; as a tensor (n, 1).
        squared_error: Gradient of the critic's squared error.
    """
    values, critic_values, holds, slope, by_mean, square, inside, error = kept
    share = (gain * slope)[:, None]
    mean = share * by_mean
    log_variance = 0.5 * (share * (square - 1) + entropy) * inside
    output = torch.cat([mean, log_variance], -1)
    if holds:
        goal = torch.cat([-mean.sum(0), torch.zeros_like(mean[0])])
        output = torch.cat([output, goal[None]])
    value = (2 * squared_error * error)[:, None]
    found = backward(output, values, weights[:count])
    return [*found, *backward(value, critic_values, weights[count:])]


class Terms(torch.autograd.Function):
    """`terms` and `slopes` as one node of autograd's graph."""

    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, part: Mapping[str, Tensor], bounds: Sequence[Tensor], count: int, *weights: Tensor
    ) -> tuple[Tensor, ...]:
        """The terms, each (n,)."""
        found, ctx.kept = terms(part, bounds, count, weights)
        ctx.count = count
        ctx.save_for_backward(*weights)
        ctx.mark_non_differentiable(found[-1])
        return found

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, gain: Tensor, entropy: Tensor, squared_error: Tensor, _: Tensor
    ) -> tuple[Tensor | None, ...]:
        """Gradients of the weights."""
        weights = ctx.saved_tensors
        found = slopes(ctx.kept, ctx.count, weights, gain, entropy[:, None], squared_error)
        return None, None, None, *found


# ------------------------------------------------------------------- the loss


class FusedPPOLoss(ClipPPOLoss):
    """TorchRL's ClipPPOLoss of plain networks: the same entries, losses and gradients, to rounding.

    Once for a batch `prepare` does what stays the same while it is learned from, and `losses`, or
    `gradients` for a gradient step, is what a minibatch costs; the forward is `prepare` and
    `losses`. The critic's loss is its squared error ("l2").
    """

    entropy_coeff: Tensor
    critic_coeff: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticActor,
        critic_network: TensorDictModule,
        *,
        clip_epsilon: float | tuple[float, float] = 0.2,
        entropy_bonus: bool = True,
        entropy_coeff: float | None = None,
        critic_coeff: float | None = None,
        reduction: str | None = None,
    ) -> None:
        """Keep the networks, which `plain_policy` and `plain_value` must know; see ClipPPOLoss."""
        policy, value = plain_policy(actor_network), plain_value(critic_network)
        if policy is None or value is None:
            raise TypeError("the networks are not plain; make_loss chooses the loss that fits")
        super().__init__(
            actor_network,
            critic_network,
            clip_epsilon=clip_epsilon,
            entropy_bonus=entropy_bonus,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            reduction=reduction,
            **USUAL,
        )
        self._policy, self._value = policy, value
        self._goal: Tensor | None = None  # as the policy sees it

    @dispatch  # pyright: ignore[reportArgumentType] - it takes a function, too
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The entries of ClipPPOLoss."""
        advantage = tensordict.get(self.tensor_keys.advantage, None)
        masks = [tensordict.get(name, None) for name in self._loss_mask_keys()]
        if advantage is None or any(mask is not None for mask in masks):
            return super().forward(tensordict)
        found = self.losses(self.prepare(tensordict))
        shape = advantage.shape[:-1]
        log_ratio = found.pop("log_ratio").reshape(shape)
        ratio = log_ratio.exp()
        effective = (2 * log_ratio.logsumexp(0) - (2 * log_ratio).logsumexp(0)).exp()
        found |= {"ESS": effective / len(log_ratio)}
        found |= {"max_ratio": ratio.max(), "mean_ratio": ratio.mean()}
        if self.reduction == "none":
            for name in found.keys() & {"loss_objective", "loss_entropy", "loss_critic"}:
                found[name] = found[name].reshape(shape)
        return TensorDict(found)

    def prepare(self, batch: TensorDictBase) -> TensorDict:
        """What `losses` reads of a batch (...), as n rows; it normalises the observations."""
        keys: Any = self.tensor_keys
        self._goal = self._policy.goal()
        action = rows(batch.get(keys.action))
        entries = {
            "policy": self._policy.seen(batch),
            "value": self._value.seen(batch),
            "action": action,
            "before": batch.get(keys.sample_log_prob).reshape(-1),
            "advantage": batch.get(keys.advantage).reshape(-1),
            "target": batch.get(keys.value_target).reshape(-1),
        }
        return TensorDict(entries, batch_size=[len(action)])

    def losses(self, part: TensorDictBase) -> dict[str, Tensor]:
        """Losses and what is logged of n rows that are prepared, and their `log_ratio` (n,)."""
        given, count, weights = self._given(part)
        found = Terms.apply(given, self._clip_bounds, count, *weights)
        return self.summary(found)  # pyright: ignore[reportArgumentType]

    @torch.no_grad()
    def gradients(self, part: TensorDictBase) -> tuple[Tensor, ...]:
        """Put the gradients of all losses, over n rows that are prepared, into `grad`.

        They are those of `losses` and autograd, whose bookkeeping takes about as long as what is
        computed here. With the reduction "none" they are those of the sum.

        Returns:
            The terms, for `summary`.
        """
        given, count, weights = self._given(part)
        found, kept = terms(given, self._clip_bounds, count, weights)
        share = 1 / len(part) if self.reduction == "mean" else 1.0
        entropy = -share * float(self.entropy_coeff) if self.entropy_bonus else 0.0
        error = share * float(self.critic_coeff) if self._has_critic else 0.0
        gradients = slopes(kept, count, weights, -share, entropy, error)
        for weight, gradient in zip(weights, gradients, strict=True):
            weight.grad = gradient.contiguous()  # Adam's fused kernel reads it as its weight lies
        return found

    def summary(self, found: Sequence[Tensor]) -> dict[str, Tensor]:
        """Losses and what is logged, and the `log_ratio` (n,), from the terms."""
        gain, entropy, squared_error, log_ratio = found
        clipped = (log_ratio != log_ratio.clamp(*self._clip_bounds)).to(gain.dtype)
        said = {"loss_objective": -self._reduce_loss(gain)}
        said |= {"clip_fraction": clipped.mean(), "kl_approx": -log_ratio.mean()}
        if self.entropy_bonus:
            said["entropy"] = entropy.detach().mean()
            said["loss_entropy"] = -self.entropy_coeff * self._reduce_loss(entropy)
        if self._has_critic:
            said["loss_critic"] = self.critic_coeff * self._reduce_loss(squared_error)
        return said | {"log_ratio": log_ratio}

    def _given(self, part: TensorDictBase) -> tuple[dict[str, Tensor], int, list[Tensor]]:
        """What `terms` reads of rows that are prepared: them, how many weights, the weights."""
        given = {name: part.get(name) for name in part.keys()}
        if self._goal is not None:
            given["policy"] = torch.cat([given["policy"], self._goal])
        own = self._policy.weights()
        return given, len(own), own + self._value.weights()
