"""Networks that are plain layers: which of actor and critic are, and quick passes through them.

TorchRL's modules and autograd work for any network; for layers this small, what they do beside the
arithmetic takes most of the time.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from quadrl.evaluation.policy import LOG_VARIANCE
from quadrl.learning.networks import Entries, HoldsGoal, Informed, MeanAndDeviation, Normaliser

LOG_2_PI = math.log(2 * math.pi)


@dataclasses.dataclass(frozen=True)
class Plain:
    """A network of linear layers with tanh between them, behind normalisers."""

    entries: list[Any]
    """What it reads, an entry for each normaliser."""
    normalisers: list[Normaliser]
    layers: list[nn.Linear]
    held: HoldsGoal | None
    """What holds the goal, if anything does."""

    def seen(self, batch: TensorDictBase) -> Tensor:
        """What the first layer reads of a batch, (n, inputs)."""
        pairs = zip(self.normalisers, self.entries, strict=True)
        parts = [rows(normaliser(batch.get(name))) for normaliser, name in pairs]
        seen = torch.cat(parts, -1) if len(parts) > 1 else parts[0]
        return seen if self.held is None else self.held.looks * seen

    def goal(self) -> Tensor | None:
        """What the first layer reads at the goal (1, inputs), if the network holds one."""
        if self.held is None:
            return None
        return (self.held.looks * self.held.normaliser(self.held.at_goal))[None]

    def weights(self) -> list[Tensor]:
        """Weights and biases of the layers in turn."""
        return [weight for layer in self.layers for weight in (layer.weight, layer.bias)]


def plain_policy(actor: nn.Module) -> Plain | None:
    """The network of an actor; None if it is of another structure."""
    if not isinstance(actor, ProbabilisticActor) or len(actor.module) != 2:
        return None
    entries, distribution = actor.module
    usual = {"validate_args": False}  # neither bounds nor squashes the mean
    if distribution.distribution_class is not IndependentNormal:
        return None
    if distribution.distribution_kwargs != usual or type(entries) is not Entries:
        return None
    network: Any = entries.module
    if type(network) is HoldsGoal:
        parts = [network.normaliser, *network.network, network.last]
        return _plain(entries, parts[:1], parts[1:-1], network)
    if type(network) is not nn.Sequential or type(network[-1]) is not MeanAndDeviation:
        return None
    return _plain(entries, network[:1], network[1:-1])


def plain_value(critic: nn.Module) -> Plain | None:
    """The network of a critic; None if it is of another structure."""
    if type(critic) is not Entries:
        return None
    network: Any = critic.module
    if type(network) is Informed and type(network.network) is nn.Sequential:
        return _plain(critic, network.normalisers, network.network)
    if type(network) is not nn.Sequential:
        return None
    return _plain(critic, network[:1], network[1:])


def _plain(
    entries: Entries, normalisers: Any, layers: Any, held: HoldsGoal | None = None
) -> Plain | None:
    kinds = [type(module) for module in layers]
    if kinds != [nn.Linear, nn.Tanh] * (len(kinds) // 2) + [nn.Linear]:
        return None
    if any(type(module) is not Normaliser for module in normalisers):
        return None
    linear = [module for module in layers if isinstance(module, nn.Linear)]
    if any(layer.bias is None for layer in linear):
        return None
    return Plain(list(entries.in_keys), list(normalisers), linear, held)


def rows(tensor: Tensor) -> Tensor:
    """A tensor (..., k) as (n, k)."""
    return tensor.reshape(-1, tensor.shape[-1])


# ------------------------------------------------------------------- passes


def forward(seen: Tensor, weights: Sequence[Tensor]) -> tuple[list[Tensor], Tensor]:
    """What each layer reads, and the output, all (n, ...).

    Args:
        seen: What the first layer reads, (n, inputs).
        weights: Weights and biases of the layers in turn, with tanh between the layers.
    """
    values, output = [], seen
    for weight, bias in zip(weights[::2], weights[1::2], strict=True):
        if values:
            tanh_(output)
        values.append(output)
        # The narrower of two factors first: that is quicker, here and in the backward.
        if len(weight) < weight.shape[1]:
            output = torch.addmm(bias[:, None], weight, output.t()).t()
        else:
            output = torch.addmm(bias, output, weight.t())
    return values, output


def tanh_(x: Tensor) -> Tensor:
    """Hyperbolic tangent in place, without a gradient.

    On a CPU it is NumPy's, which takes a sixth of the time of torch's.
    """
    if x.device.type != "cpu":
        return x.tanh_()
    array = x.numpy()
    np.tanh(array, out=array)
    return x


def backward(error: Tensor, values: Sequence[Tensor], weights: Sequence[Tensor]) -> list[Tensor]:
    """Gradients of weights and biases in turn, from that of the output (n, outputs)."""
    found: list[Tensor] = []
    for value, weight in zip(reversed(values), reversed(weights[::2]), strict=True):
        narrow = error.shape[1] <= value.shape[1]
        found += [error.sum(0), error.t() @ value if narrow else (value.t() @ error).t()]
        if value is not values[0]:
            error = torch.ops.aten.tanh_backward(error @ weight, value)
    return found[::-1]


def mean_and_log_variance(output: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Of the actions, (count, k), from a policy's output; the variance is not yet bounded.

    Args:
        output: (count, 2 * k), or with one row more: that of the goal, whose mean is taken away.
        count: Of observations.
    """
    mean, free = output.chunk(2, -1)
    if len(output) > count:
        return mean[:count] - mean[-1], free[:count]
    return mean, free


class BehaviourPolicy(TensorDictModuleBase):
    """Draws the actions of a plain policy, for a collector.

    It gives the entries that the actor gives, without gradients and in two thirds of the time.
    """

    def __init__(self, plain: Plain) -> None:
        """Fly with the weights of a network, as they are at each step."""
        super().__init__()
        self._plain = plain
        self.in_keys = plain.entries
        self.out_keys = ["loc", "scale", "action", "action_log_prob"]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add mean, deviation and action (N, k), and the action's log-probability (N,)."""
        seen, goal = self._plain.seen(tensordict), self._plain.goal()
        count = len(seen)
        _, output = forward(
            seen if goal is None else torch.cat([seen, goal]), self._plain.weights()
        )
        mean, free = mean_and_log_variance(output, count)
        log_variance = free.clamp(*LOG_VARIANCE)
        deviation, noise = (0.5 * log_variance).exp(), torch.randn_like(mean)
        log_probability = -0.5 * (noise.square() + log_variance + LOG_2_PI).sum(-1)
        entries = mean, deviation, mean + deviation * noise, log_probability
        for name, entry in zip(self.out_keys, entries, strict=True):
            tensordict.set(name, entry)
        return tensordict
