"""The paper's policy and a critic as TorchRL modules."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from quadrl.learning.config import TrainConfig
from quadrl.policy import CLIP, LOG_VARIANCE, Policy


class Normaliser(nn.Module):
    """Running mean and deviation of the observations (Chan, Golub and LeVeque 1979)."""

    count: torch.Tensor  # (), observations so far
    mean: torch.Tensor  # (size,), in double precision as the sum below
    square_sum: torch.Tensor  # (size,), of the distances from the mean
    shift: torch.Tensor  # (size,), the mean in single precision
    deviation: torch.Tensor  # (size,)

    def __init__(self, size: int) -> None:
        """Start with mean 0 and deviation 1."""
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("square_sum", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("deviation", torch.ones(size))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Observations (..., size) shifted and scaled to mean 0 and deviation 1, within +-CLIP."""
        return ((observation - self.shift) / self.deviation).clamp(-CLIP, CLIP)

    @torch.no_grad()
    def update(self, observation: torch.Tensor) -> None:
        """Include observations (..., size)."""
        rows = observation.reshape(-1, observation.shape[-1]).double()
        mean, count = rows.mean(0), len(rows)
        difference, total = mean - self.mean, self.count + count
        self.square_sum += (rows - mean).square().sum(0)
        self.square_sum += difference.square() * self.count * count / total
        self.mean += difference * count / total
        self.count.copy_(total)
        self.shift.copy_(self.mean)
        self.deviation.copy_((self.square_sum / total).sqrt().clamp(min=1e-4))


class MeanAndDeviation(nn.Module):
    """The last step of the paper's policy: mean and log-variance of a normal distribution."""

    def forward(self, output: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and standard deviation (..., actions) from outputs (..., 2 * actions)."""
        mean, log_variance = output.chunk(2, -1)
        return mean, (0.5 * log_variance.clamp(*LOG_VARIANCE)).exp()


class OfObservation(TensorDictModule):
    """A network from the observation to named entries: its output, or its tuple of outputs.

    At each write, tensordict 0.14 looks for other packages in a TensorDictModule's forward, which
    costs a tenth of a gradient step; this forward only writes.
    """

    def __init__(self, module: nn.Module, *names: str) -> None:
        """Wrap the network."""
        super().__init__(module, in_keys=["observation"], out_keys=[*names])

    def forward(  # pyright: ignore[reportIncompatibleVariableOverride] - the base wraps it
        self, tensordict: TensorDictBase, **_: Any
    ) -> TensorDictBase:
        """Add the entries."""
        outputs = self.module(tensordict.get("observation"))
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        for name, output in zip(self.out_keys, outputs, strict=True):
            tensordict.set(name, output)
        return tensordict


def make_network(
    normaliser: Normaliser, hidden: tuple[int, ...], outputs: int, gain: float
) -> nn.Sequential:
    """The normaliser and linear layers with tanh between them.

    Weights are orthogonal and biases zero; `gain` scales the last layer's weights.
    """
    widths = (len(normaliser.mean), *hidden, outputs)
    layers = [nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else 2**0.5)
        nn.init.zeros_(layer.bias)
    between = [module for layer in layers[:-1] for module in (layer, nn.Tanh())]
    return nn.Sequential(normaliser, *between, layers[-1])


def make_actor_critic(
    size: int, actions: int, config: TrainConfig
) -> tuple[ProbabilisticActor, OfObservation, Normaliser]:
    """Actor, critic and the normaliser that they share.

    Args:
        size: Numbers in an observation.
        actions: Numbers in an action, k.
        config: Has the widths of the hidden layers and the deviation of the first actions.
    """
    normaliser = Normaliser(size)
    network = make_network(normaliser, config.hidden, 2 * actions, gain=0.01)
    bias: Any = network[-1].bias
    with torch.no_grad():
        bias[actions:] = 2 * torch.tensor(config.initial_deviation).log()
    actor = ProbabilisticActor(
        OfObservation(network.append(MeanAndDeviation()), "loc", "scale"),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        distribution_kwargs={"validate_args": False},
        return_log_prob=True,
    )
    network = make_network(normaliser, config.critic_hidden, 1, gain=1.0)
    return actor, OfObservation(network, "state_value"), normaliser


def export(actor: ProbabilisticActor, task: str, metadata: dict[str, Any]) -> Policy:
    """The NumPy policy of an actor."""
    layers = [module for module in actor.modules() if isinstance(module, nn.Linear)]
    (normaliser,) = (module for module in actor.modules() if isinstance(module, Normaliser))
    return Policy(
        weights=tuple(_array(layer.weight) for layer in layers),
        biases=tuple(_array(layer.bias) for layer in layers),
        mean=_array(normaliser.shift),
        deviation=_array(normaliser.deviation),
        task=task,
        metadata=metadata,
    )


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().float().numpy().copy()
