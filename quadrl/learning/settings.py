"""The settings of each algorithm, with the first layer of their defaults."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

from quadrl.base.errors import QuadrlError
from quadrl.base.validation import number
from quadrl.conditions.observing import Observing
from quadrl.conditions.randomization import DELAYS, NONE

LATE_OR_UNSURE = (*DELAYS, "noise", "bias")
"""What a randomization may not have where a training goes through the physics: the observation must
follow from the state, and the rotors' commands from the action alone."""
_SURE = f"without {', '.join(LATE_OR_UNSURE)}"


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
            if isinstance(field.default, bool):
                if not isinstance(value, bool):
                    raise QuadrlError(name=name, value=value, allowed="True or False")
                checked = value
            elif isinstance(field.default, int):
                checked = number(name, value, 1, whole=True)
            else:
                high = self.largest.get(field.name, math.inf)
                positive = field.name not in self.may_be_zero
                checked = number(name, value, 0, high, positive=positive)
            object.__setattr__(self, field.name, checked)

    def check(self, config: Any) -> None:
        """Refuse the settings of a `TrainConfig` that the algorithm cannot learn with.

        Raises:
            QuadrlError: The message names the setting.
        """


@dataclasses.dataclass(frozen=True)
class PPOConfig(AlgorithmConfig):
    """Settings of PPO."""

    learning_rate: float = 4e-3
    """Initial learning rate of Adam; it falls linearly to zero over the training."""
    beta2: float = 0.999
    """Decay rate of Adam's mean of the squared gradients; below 1."""
    epochs: int = 5
    """Passes over each batch."""
    minibatch: int = 1024
    """Transitions in a gradient step: few large steps, since each takes milliseconds."""
    clip: float = 0.2
    """Bound on the change of the probability ratio."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    critic: float = 1.0
    """Weight of the critic's squared error."""
    max_gradient: float = 1.0
    """Norm to which the gradients of policy and critic are clipped separately."""
    fused: bool = True
    """Whether to use the gradients written by hand: they take 0.55 of the time of TorchRL's loss,
    agree with it to rounding, and do not work for a policy with a memory."""


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
    """Most steps tried in the line search."""
    shrink: float = 0.7
    """Factor by which the line search shortens a step that is within the bound but brings no
    gain."""
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
    """Initial learning rate of the policy, which takes one step on each batch; it falls linearly to
    zero."""
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
    """How far the actions of a window are moved along their gradient, where the gradient has its
    median length; at most twice as far elsewhere."""
    learning_rate: float = 5e-3
    """Initial learning rate of Adam, which fits the policy to the moved actions; it falls linearly
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

    def check(self, config: Any) -> None:
        """Refuse the settings with which the derivatives of the flight are not known."""
        flown, given = config.training_scenario, config.conditions
        task, drawn = flown.task, flown.randomization
        unsure = any(getattr(drawn, name) != getattr(NONE, name) for name in LATE_OR_UNSURE)
        observed = flown.observe != Observing()
        for name, value, wrong, allowed in (
            ("engine", flown.engine, flown.engine != "free_flight", "'free_flight'"),
            ("memory", config.memory, config.memory != "none", "'none'"),
            ("device", config.device, config.device != "cpu", "'cpu'"),
            ("gammas", config.gammas, bool(config.gammas), "left out, since gamma is for all"),
            ("task", task.name, task.contact, "a task without contact with the ground"),
            ("task", task.name, task.true_parameters, "a task that sees the specified parameters"),
            ("observe", given["observe"], observed, "left out"),
            ("events", given["events"], bool(flown.events), "left out"),
            ("randomization", given["randomization"], unsure, _SURE),
        ):
            if wrong:
                reason = "apg takes the derivatives of the whole flight, and has none for this"
                allowed = f"{allowed} with algo apg"
                raise QuadrlError(reason, name=name, value=value, allowed=allowed)


@dataclasses.dataclass(frozen=True)
class DaggerConfig(AlgorithmConfig):
    """Settings of the imitation of a teacher."""

    # Seconds of flight in each batch, for the memory; exploration would only hide what it finds.
    training = {"num_envs": 512, "rollout": 26, "initial_deviation": 0.03}

    learning_rate: float = 3e-3
    """Initial learning rate of Adam, which falls linearly to zero."""
    epochs: int = 2
    """Passes over each batch."""
    minibatch: int = 4096
    """Transitions in a gradient step, of whole aircraft."""
    max_gradient: float = 1.0
    """Norm to which the gradient is clipped."""


ALGORITHM_CONFIGS = {
    **{"ppo": PPOConfig, "trpo": TRPOConfig, "vpg": VPGConfig},
    **{"apg": APGConfig, "dagger": DaggerConfig},
}
