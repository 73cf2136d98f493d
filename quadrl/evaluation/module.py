"""A policy as a module of torch, and as a file that torch reads without quadrl."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import nn

from quadrl.evaluation.policy_file import CLIP


class PolicyModule(nn.Module):
    """The mean action of a policy; its normalisation is fixed, its weights can be trained on."""

    mean: torch.Tensor  # (size,)
    deviation: torch.Tensor  # (size,)

    def __init__(self, policy: Any) -> None:
        """Copy the numbers of a policy."""
        super().__init__()
        self.register_buffer("mean", torch.tensor(policy.mean))
        self.register_buffer("deviation", torch.tensor(policy.deviation))
        self.first, self.memory, layers = None, None, []
        # Without first weights, so that torch's random numbers stay where they are.
        if unit := policy.memory:
            inputs = unit.input_weight.shape[1]
            self.memory = nn.utils.skip_init(nn.GRUCell, inputs, policy.state_size)
            own = [*unit.arrays().values()]
            _fill(self.memory, own[:4])
            if unit.alone:
                self.first = nn.utils.skip_init(nn.Linear, policy.size, inputs)
                _fill(self.first, own[4:])
        for weight, bias in policy.mean_layers:
            layer = nn.utils.skip_init(nn.Linear, *reversed(weight.shape))
            _fill(layer, (weight, bias))
            layers += [layer, nn.Tanh()]
        self.network = nn.Sequential(*layers[:-1])

    def forward(
        self, observation: torch.Tensor, state: torch.Tensor | None = None
    ) -> torch.Tensor | tuple[torch.Tensor, torch.Tensor]:
        """Actions (batch, k) in [-1, 1]; of a policy with a memory also its next state.

        Args:
            observation: (batch, size).
            state: Of a policy with a memory, (batch, state_size); None as an episode begins.
        """
        seen = ((observation - self.mean) / self.deviation).clamp(-CLIP, CLIP)
        if self.memory is None:
            return self.network(seen).clamp(-1.0, 1.0)
        if self.first is not None:
            after = self.memory(self.first(seen).relu(), state)
            return self.network(after).clamp(-1.0, 1.0), after
        after = self.memory(seen, state)
        return self.network(torch.cat([seen, after], -1)).clamp(-1.0, 1.0), after


def _fill(module: nn.Module, arrays: Iterable[np.ndarray]) -> None:
    with torch.no_grad():
        for parameter, array in zip(module.parameters(), arrays, strict=True):
            parameter.copy_(torch.tensor(array))


def content(policy: Any, metadata: Mapping[str, str]) -> bytes:
    """The file of a program for batches of any size: `torch.export.load(path).module()`.

    Args:
        policy: The policy.
        metadata: What the file says of itself: `extra_files` of `torch.export.load`.
    """
    sizes = (policy.size, policy.state_size) if policy.memory else (policy.size,)
    batch = torch.export.Dim("batch")
    given = tuple(torch.zeros(2, size) for size in sizes)
    shapes = tuple({0: batch} for _ in sizes)
    program = torch.export.export(PolicyModule(policy), given, dynamic_shapes=shapes)
    file = io.BytesIO()
    torch.export.save(program, file, extra_files=dict(metadata))
    return file.getvalue()
