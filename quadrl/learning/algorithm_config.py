"""The settings of each algorithm."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

from quadrl.base.validation import number


@dataclasses.dataclass(frozen=True)
class AlgorithmConfig:
    """Numbers of an algorithm: whole ones are counts, the others are positive unless listed."""

    training: ClassVar[dict[str, Any]] = {}
    """Settings of `TrainConfig` that have other defaults with this algorithm."""
    may_be_zero: ClassVar[tuple[str, ...]] = ("entropy", "critic", "damping")
    largest: ClassVar[dict[str, float]] = {"beta2": 0.99999}

    def __post_init__(self) -> None:
        """Validate the numbers."""
        prefix = type(self).__name__.removesuffix("Config").lower()
        for field in dataclasses.fields(self):
            value, name = getattr(self, field.name), f"{prefix}.{field.name}"
            if isinstance(field.default, int):
                checked = number(name, value, 1, whole=True)
            else:
                high = self.largest.get(field.name, math.inf)
                positive = field.name not in self.may_be_zero
                checked = number(name, value, 0, high, positive=positive)
            object.__setattr__(self, field.name, checked)


@dataclasses.dataclass(frozen=True)
class PPOConfig(AlgorithmConfig):
    """Settings of PPO."""

    learning_rate: float = 4e-3
    """Initial rate of Adam; it falls linearly to zero over the training."""
    beta2: float = 0.999
    """Share of Adam's mean of the squared gradients that a step leaves; below 1."""
    epochs: int = 5
    """Passes over each batch."""
    minibatch: int = 1024
    """Transitions in a gradient step: few large ones, since each step costs milliseconds."""
    clip: float = 0.2
    """Bound on the change of the probability ratio."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    critic: float = 1.0
    """Weight of the critic's squared error."""
    max_gradient: float = 1.0
    """Norm to which the gradients of policy and critic are clipped, each on its own."""


@dataclasses.dataclass(frozen=True)
class TRPOConfig(AlgorithmConfig):
    """Settings of TRPO."""

    max_kl: float = 0.02
    """Bound on the mean KL divergence of a step."""
    damping: float = 0.01
    """Added to the diagonal of the Fisher matrix."""
    iterations: int = 10
    """Iterations of the conjugate gradient method."""
    backtracks: int = 10
    """Steps tried in the line search."""
    shrink: float = 0.7
    """Factor from a tried step within the bound, but of no gain, to the next one."""
    critic_rate: float = 3e-3
    """Initial learning rate of the critic; it falls linearly to zero."""
    critic_epochs: int = 8
    """Passes of the critic over each batch."""
    minibatch: int = 1024
    """Transitions in a gradient step of the critic."""


@dataclasses.dataclass(frozen=True)
class VPGConfig(AlgorithmConfig):
    """Settings of the plain policy gradient."""

    training = {"num_envs": 128, "rollout": 8}  # one step per batch: more batches, and smaller

    learning_rate: float = 3e-3
    """Initial rate of the policy's one step on each batch; it falls linearly to zero."""
    critic_rate: float = 6e-3
    """Initial learning rate of the critic; it falls linearly to zero."""
    critic_epochs: int = 8
    """Passes of the critic over each batch."""
    minibatch: int = 1024
    """Transitions in a gradient step of the critic."""
    max_gradient: float = 1.0
    """Norm to which gradients are clipped."""


@dataclasses.dataclass(frozen=True)
class APGConfig(AlgorithmConfig):
    """Settings of the analytic policy gradient."""

    # Many windows, each of which is one step up the gradient.
    training = {"num_envs": 64, "rollout": 32, "initial_deviation": 0.5, "steps": 204_800}

    step: float = 0.2
    """How far the actions of a window are moved up their gradient, where it has its median
    length; twice as far at most."""
    learning_rate: float = 5e-3
    """Initial rate of Adam, with which the policy is fitted to the moved actions; it falls linearly
    to zero."""
    epochs: int = 4
    """Passes of the policy over each window."""
    critic_rate: float = 5e-3
    """Initial learning rate of the critic; it falls linearly to zero."""
    critic_epochs: int = 4
    """Passes of the critic over each window."""
    minibatch: int = 1024
    """Transitions in a gradient step."""
    max_gradient: float = 1.0
    """Norm to which gradients are clipped."""


ALGORITHM_CONFIGS = {"ppo": PPOConfig, "trpo": TRPOConfig, "vpg": VPGConfig, "apg": APGConfig}
