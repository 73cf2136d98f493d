"""The paper's policy and a critic as TorchRL modules."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator

from quadrl.policy import CLIP, Policy


class Normaliser(nn.Module):
    """Running mean and deviation of the observations (Chan, Golub and LeVeque 1979)."""

    def __init__(self, size: int) -> None:
        """Start from no observation at all."""
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("square_sum", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("deviation", torch.ones(size))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Observations (..., size) with mean 0 and deviation 1, within +-CLIP."""
        return ((observation - self.shift) / self.deviation).clamp(-CLIP, CLIP)

    @torch.no_grad()
    def update(self, observation: torch.Tensor) -> None:
        """Take in observations (..., size)."""
        rows = observation.reshape(-1, observation.shape[-1]).double()
        mean, count = rows.mean(0), len(rows)
        difference, total = mean - self.mean, self.count + count
        self.square_sum += (rows - mean).square().sum(0)
        self.square_sum += difference.square() * self.count * count / total
        self.mean += difference * count / total
        self.count.copy_(total)
        self.shift.copy_(self.mean)
        self.deviation.copy_((self.square_sum / total).sqrt().clamp(min=1e-4))


class Network(nn.Module):
    """Hidden layers of tanh behind the normaliser."""

    def __init__(
        self, normaliser: Normaliser, size: int, hidden: tuple[int, ...], outputs: int, gain: float
    ) -> None:
        """Orthogonal weights, zero biases; `gain` scales the last layer's."""
        super().__init__()
        self.normaliser = normaliser
        widths = (size, *hidden, outputs)
        self.layers = nn.ModuleList(
            nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True)
        )
        for k, layer in enumerate(self.layers):
            last = k == len(self.layers) - 1
            nn.init.orthogonal_(layer.weight, gain if last else 2**0.5)  # type: ignore[arg-type]
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Outputs (..., outputs) of observations (..., size)."""
        hidden = self.normaliser(observation)
        for layer in self.layers[:-1]:
            hidden = torch.tanh(layer(hidden))
        return self.layers[-1](hidden)


class GaussianNetwork(Network):
    """The paper's policy network: mean and log-variance of a normal distribution."""

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and standard deviation, each (..., actions)."""
        mean, log_variance = super().forward(observation).chunk(2, -1)
        return mean, (0.5 * log_variance.clamp(-12.0, 2.0)).exp()


def make_actor_critic(
    size: int,
    actions: int,
    *,
    hidden: tuple[int, ...],
    critic_hidden: tuple[int, ...],
    initial_deviation: float,
) -> tuple[ProbabilisticActor, ValueOperator, Normaliser]:
    """Actor, critic and the normaliser that they share.

    Args:
        size: Of the observation.
        actions: Number of actions.
        hidden: Widths of the actor's hidden layers; the paper's is (128,).
        critic_hidden: Widths of the critic's.
        initial_deviation: Of the actions, at the start.
    """
    normaliser = Normaliser(size)
    network = GaussianNetwork(normaliser, size, hidden, 2 * actions, gain=0.01)
    with torch.no_grad():
        network.layers[-1].bias[actions:] = 2 * torch.tensor(initial_deviation).log()  # type: ignore[index]
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(
        Network(normaliser, size, critic_hidden, 1, gain=1.0), in_keys=["observation"]
    )
    return actor, critic, normaliser


def export(actor: ProbabilisticActor, task: str, metadata: dict[str, Any]) -> Policy:
    """The NumPy policy of an actor."""
    network = actor.module[0].module  # type: ignore[union-attr]
    to_numpy = lambda tensor: tensor.detach().cpu().float().numpy().copy()  # noqa: E731
    return Policy(
        weights=tuple(to_numpy(layer.weight) for layer in network.layers),
        biases=tuple(to_numpy(layer.bias) for layer in network.layers),
        mean=to_numpy(network.normaliser.shift),
        deviation=to_numpy(network.normaliser.deviation),
        task=task,
        metadata=metadata,
    )
