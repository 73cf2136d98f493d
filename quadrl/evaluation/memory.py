"""What a policy remembers: a gated recurrent unit in NumPy, and a policy in flight with one."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

PREFIX = "memory_"
"""Of the arrays of a unit in the file of its policy."""


@dataclasses.dataclass(frozen=True)
class GRU:
    """A gated recurrent unit (Cho et al. 2014), with the equations of `torch.nn.GRUCell`.

    Rows of the weights: of the reset gate, then of the update gate, then of the candidate. With a
    layer before it, the actions follow from its state alone: the network of PX4's mc_raptor.
    """

    input_weight: np.ndarray  # (3 width, size)
    state_weight: np.ndarray  # (3 width, width)
    input_bias: np.ndarray  # (3 width,)
    state_bias: np.ndarray  # (3 width,)
    first_weight: np.ndarray | None = None  # (size, observation), rectified linear neurons before
    first_bias: np.ndarray | None = None  # (size,)

    @property
    def width(self) -> int:
        """Numbers in a state."""
        return self.state_bias.size // 3

    @property
    def alone(self) -> bool:
        """Whether what follows reads the state alone, without the observation beside it."""
        return self.first_weight is not None

    def step(self, inputs: np.ndarray, state: np.ndarray) -> np.ndarray:
        """The next state (..., width), from the observation and the present one."""
        if self.first_weight is not None:
            inputs = np.maximum(inputs @ self.first_weight.T + self.first_bias, 0.0)
        seen = np.split(inputs @ self.input_weight.T + self.input_bias, 3, axis=-1)
        kept = np.split(state @ self.state_weight.T + self.state_bias, 3, axis=-1)
        reset, update = (_sigmoid(a + b) for a, b in zip(seen[:2], kept[:2], strict=True))
        candidate = np.tanh(seen[2] + reset * kept[2])
        return candidate + update * (state - candidate)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by their names in a file."""
        return {PREFIX + name: array for name, array in vars(self).items() if array is not None}

    def fits(self, size: int) -> bool:
        """Whether the arrays are those of one unit with some numbers in an observation."""
        rows, width, first = 3 * self.width, self.width, list[tuple[int, ...]]()
        if self.first_bias is not None:
            first = [(self.first_bias.size, size), self.first_bias.shape]
            size = self.first_bias.size
        shapes = [(rows, size), (rows, width), (rows,), (rows,), *first]
        return width > 0 and [array.shape for array in self.arrays().values()] == shapes


NAMES = tuple(PREFIX + field.name for field in dataclasses.fields(GRU))


class PolicyInFlight:
    """A policy in flight: a function of observations that keeps the policy's memory."""

    def __init__(self, policy: Any, count: int | None, seed: int | None) -> None:
        """Begin with the state of a policy at an episode's begin; see `Policy.flying`."""
        self.policy, self.control_mode = policy, policy.control_mode
        self.state = policy.initial_state(count)
        self._generator = None if seed is None else np.random.default_rng(seed)

    @property
    def conditions(self) -> dict[str, Any]:
        """Those of the policy."""
        return self.policy.conditions

    def reset(self, rows: np.ndarray | None = None) -> None:
        """Forget, before the first observation of an episode.

        Args:
            rows: The aircraft whose episodes begin, a mask (n,) or indices; None for all.
        """
        self.state = self.state.copy()  # whoever has the old one keeps it
        self.state[... if rows is None else rows] = 0.0

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (n, k) for observations (n, size), in [-1, 1]; it remembers them.

        Raises:
            QuadrlError: The observations are of another number of aircraft, or of another size.
        """
        action, self.state = self.policy.step(observation, self.state, self._generator)
        return action


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * np.tanh(0.5 * x)  # without the overflow of exp(-x)
