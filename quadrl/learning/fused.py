"""Fast passes through plain networks: the actions of a collector, and the gradients of PPO.

With layers this small, TorchRL's modules and autograd spend most of the time on other things than
arithmetic: with `PPOGradients` a gradient step takes 0.55 of that time.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from quadrl.evaluation.policy import LOG_VARIANCE
from quadrl.learning.settings import PPOConfig

LOG_2_PI = math.log(2 * math.pi)


@dataclasses.dataclass(frozen=True)
class Plain:
    """The parts of a network: normalisers, then linear layers with tanh between them."""

    sees: Mapping[str, Callable[[Tensor], Tensor]]
    """Normalises an entry of the batch, by its name; the first layer reads all of them."""
    layers: Sequence[Any]
    goal: Any = None
    """The `HoldsGoal` whose mean at the goal is subtracted, if there is one."""

    def seen(self, batch: TensorDictBase | Mapping[str, Tensor]) -> Tensor:
        """Return what the first layer reads of a batch, (n, inputs)."""
        parts = [_rows(sees(batch[name])) for name, sees in self.sees.items()]
        return torch.cat(parts, -1) if len(parts) > 1 else parts[0]

    def forward_policy(
        self, seen: Tensor, weights: Sequence[Tensor]
    ) -> tuple[list[Tensor], Tensor, Tensor]:
        """Compute what each layer of a policy reads, and mean and log-variance (n, k).

        The variance is not yet bounded. If the policy holds a goal, the layers read it as one more
        row, whose mean is subtracted.
        """
        goal, read = self.goal, seen
        if goal is not None:
            read = torch.cat([seen, goal.seen(goal.at_goal)[None]])
        values, output = forward(read, weights)
        mean, log_variance = output.chunk(2, -1)
        if goal is not None:
            mean, log_variance = mean[:-1] - self.held(seen, mean[-1]), log_variance[:-1]
        return values, mean, log_variance

    def held(self, seen: Tensor, at_goal: Tensor) -> Tensor:
        """Of something of the goal (k,), what counts in rows that read (n, size)."""
        return self.goal.share(seen) * at_goal if self.goal.others else at_goal

    def weights(self) -> list[Tensor]:
        """Weights and biases of the layers in turn."""
        return [weight for layer in self.layers for weight in (layer.weight, layer.bias)]


def _rows(tensor: Tensor) -> Tensor:
    return tensor.reshape(-1, tensor.shape[-1])


def forward(seen: Tensor, weights: Sequence[Tensor]) -> tuple[list[Tensor], Tensor]:
    """Compute what each layer reads, and the output, from what the first reads; all (n, ...)."""
    values, output = [], seen
    for weight, bias in zip(weights[::2], weights[1::2], strict=True):
        if values:
            _tanh(output)
        values.append(output)
        # The narrower of two factors first: that is faster, here and in `backward`.
        if len(weight) < weight.shape[1]:
            output = torch.addmm(bias[:, None], weight, output.t()).t()
        else:
            output = torch.addmm(bias, output, weight.t())
    return values, output


def _tanh(x: Tensor) -> None:
    """Apply tanh in place: NumPy's on a CPU, where torch's may take six times as long."""
    if x.device.type == "cpu":
        np.tanh(x.numpy(), out=x.numpy())
    else:
        x.tanh_()


def backward(error: Tensor, values: Sequence[Tensor], weights: Sequence[Tensor]) -> list[Tensor]:
    """Compute the gradients of weights and biases in turn, from that of the output (n, outputs)."""
    found: list[Tensor] = []
    for value, weight in zip(reversed(values), reversed(weights[::2]), strict=True):
        narrow = error.shape[1] <= value.shape[1]
        found += [error.sum(0), error.t() @ value if narrow else (value.t() @ error).t()]
        if value is not values[0]:
            error = torch.ops.aten.tanh_backward(error @ weight, value)
    return found[::-1]


class BehaviourPolicy(TensorDictModuleBase):
    """A plain policy for a collector: it writes the entries of the actor, without gradients."""

    def __init__(self, plain: Plain) -> None:
        """Keep a network, whose present weights are used at each step."""
        super().__init__()
        self._plain = plain
        self.in_keys = list(plain.sees)
        self.out_keys = ["loc", "scale", "action", "action_log_prob"]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add mean, deviation and action (N, k), and the action's log-probability (N,)."""
        plain = self._plain
        _, mean, free = plain.forward_policy(plain.seen(tensordict), plain.weights())
        log_variance = free.clamp(*LOG_VARIANCE)
        deviation, noise = (0.5 * log_variance).exp(), torch.randn_like(mean)
        log_probability = -0.5 * (noise.square() + log_variance + LOG_2_PI).sum(-1)
        entries = mean, deviation, mean + deviation * noise, log_probability
        for name, entry in zip(self.out_keys, entries, strict=True):
            tensordict.set(name, entry)
        return tensordict


class PPOGradients:
    """The gradients of TorchRL's ClipPPOLoss for a plain policy and a plain critic, to rounding."""

    def __init__(self, policy: Plain, critic: Plain, config: PPOConfig) -> None:
        """Keep the networks and the settings."""
        self._policy, self._critic, self._config = policy, critic, config
        clip = torch.tensor(config.clip)
        self._bounds = (-clip).log1p().item(), clip.log1p().item()  # of the log-ratio

    def prepare(self, batch: TensorDictBase) -> TensorDict:
        """Make the n rows that `gradients` reads of a batch (...), with normalised observations."""
        action = _rows(batch.get("action"))
        entries = {
            "policy": self._policy.seen(batch),
            "critic": self._critic.seen(batch),
            "action": action,
            "before": batch.get("action_log_prob").reshape(-1),
            "advantage": batch.get("advantage").reshape(-1),
            "target": batch.get("value_target").reshape(-1),
        }
        return TensorDict(entries, batch_size=[len(action)])

    @torch.no_grad()
    def gradients(self, part: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Write the gradients of the losses over n prepared rows into `grad`.

        Returns:
            The log-ratio and the critic's error, each (n,), for `figures`.
        """
        action, advantage = part.get("action"), part.get("advantage")
        weights, critic_weights = self._policy.weights(), self._critic.weights()
        share = 1 / len(action)  # of each row in a mean
        # The policy: gain = min(r, clip(r)) * advantage with the ratio r of the probabilities.
        values, mean, free = self._policy.forward_policy(part.get("policy"), weights)
        log_variance = free.clamp(*LOG_VARIANCE)
        off = action - mean
        by_mean = off * (-log_variance).exp()
        square = off * by_mean
        constant = action.shape[1] * LOG_2_PI
        log_ratio = -0.5 * ((square + log_variance).sum(-1) + constant) - part.get("before")
        gain = log_ratio.exp() * advantage
        clipped = log_ratio.clamp(*self._bounds).exp() * advantage
        slope = torch.where(gain <= clipped, gain, 0.0)  # by the log-ratio; 0 where it is clipped
        by_ratio = (-share * slope)[:, None]
        to_mean = by_ratio * by_mean
        to_variance = 0.5 * (by_ratio * (square - 1) - share * self._config.entropy)
        to_output = torch.cat([to_mean, to_variance * (free == log_variance)], -1)
        if self._policy.goal is not None:
            at_goal = -self._policy.held(part.get("policy"), to_mean).sum(0)
            at_goal = torch.cat([at_goal, torch.zeros_like(at_goal)])
            to_output = torch.cat([to_output, at_goal[None]])
        # The critic: its squared error.
        critic_values, value = forward(part.get("critic"), critic_weights)
        error = value[:, 0] - part.get("target")
        to_value = (2 * (share * self._config.critic) * error)[:, None]
        found = backward(to_output, values, weights)
        found += backward(to_value, critic_values, critic_weights)
        for weight, gradient in zip([*weights, *critic_weights], found, strict=True):
            weight.grad = gradient.contiguous()  # as Adam's fused kernel assumes
        return log_ratio, error

    def figures(self, log_ratio: Tensor, error: Tensor) -> dict[str, Tensor]:
        """Compute the figures of ClipPPOLoss for the log, from what `gradients` returned."""
        clipped = (log_ratio != log_ratio.clamp(*self._bounds)).to(log_ratio.dtype)
        return {
            "kl_approx": -log_ratio.mean(),
            "clip_fraction": clipped.mean(),
            "loss_critic": self._config.critic * error.square().mean(),
        }
