"""Networks that are plain layers: which of actor and critic are, and what they consist of."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from quadrl.learning.networks import (
    Entries,
    HoldsGoal,
    Informed,
    MeanAndDeviation,
    Normaliser,
    Tanh,
)


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
    if kinds != [nn.Linear, Tanh] * (len(kinds) // 2) + [nn.Linear]:
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
