"""The normalisation of observations, with what a training has observed so far."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from quadrl.evaluation.policy_file import CLIP


class Normaliser(nn.Module):
    """Running mean and deviation of the observations (Chan, Golub and LeVeque 1979)."""

    count: torch.Tensor  # (), observations so far
    mean: torch.Tensor  # (size,), in double precision as the sum below
    square_sum: torch.Tensor  # (size,), of the squared distances from the mean
    shift: torch.Tensor  # (size,), the mean in single precision
    deviation: torch.Tensor  # (size,)

    def __init__(self, size: int, clip: float = CLIP) -> None:
        """Start with mean 0 and deviation 1."""
        super().__init__()
        self.clip = clip
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("square_sum", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("deviation", torch.ones(size))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Observations (..., size) shifted and scaled to mean 0 and deviation 1, within +-clip."""
        return ((observation - self.shift) / self.deviation).clamp(-self.clip, self.clip)

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


def update_normalisers(normalisers: dict[str, Normaliser], batch: Mapping[str, Any]) -> None:
    """Include a batch in the normaliser of each of its entries."""
    for name, normaliser in normalisers.items():
        normaliser.update(batch[name])
