"""The settings of a training and of each algorithm, with the first layer of their defaults."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

from quadrl.base.errors import QuadrlError
from quadrl.base.validation import number
from quadrl.conditions.observing import Observing
from quadrl.conditions.randomization import DELAYS, NONE
from quadrl.core.scenario import GIVEN

LATE_OR_UNSURE = (*DELAYS, "noise", "bias")
"""What a randomization may not have where a training goes through the physics: the observation must
follow from the state, and the rotors' commands from the action alone."""
_SURE = f"without {', '.join(LATE_OR_UNSURE)}"
_CONDITIONS = {name: how["usual"] for name, how in GIVEN.items()}


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


@dataclasses.dataclass(frozen=True)
class TrainSettings:
    """The fields of `quadrl.learning.config.TrainConfig`.

    Their defaults are the first layer of those of a task: see `quadrl.learning.defaults`. Each of
    the conditions is a setting of its own to whoever gives, reads or saves them: see `named`.
    """

    task: str = "hover"
    """Name of the task."""
    algo: str = "ppo"
    """Algorithm: ppo, trpo, vpg (the plain policy gradient; gae, the paper's name for it, works
    too), apg (the analytic policy gradient through the physics; not in the paper), or dagger
    (imitation of a regulator that is told what was drawn; of quadrotors that hold a place)."""
    seed: int = 0
    """Seed of the networks, the exploration and the episodes, between 0 and 2^32 - 1."""
    variant: str = "ideal"
    """Group of settings: ideal (the paper's episodes), robust (an uncertain aircraft in light wind,
    and a policy that sees what it needs for that), or raptor (one of the shape that PX4's mc_raptor
    flies)."""
    conditions: dict[str, Any] = dataclasses.field(
        default_factory=lambda: _CONDITIONS | {"engine": "free_flight"}
    )
    """The conditions of flight by keyword, as they were given: `quadrl.core.scenario.Conditions`
    documents them. Evaluations always fly in mujoco."""
    training_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task for the training only, such as farthest=3: a policy is weakest at the
    edge of what it was trained on."""
    num_envs: int = 256
    """Aircraft simulated at the same time."""
    rollout: int = 16
    """Control steps of each aircraft in a batch."""
    steps: int = 1_310_720
    """Control steps of the training, summed over all aircraft."""
    gamma: float = 0.93
    """Discount per control step; 0.93 gives an effective horizon of 0.7 s. With a short horizon a
    lasting error costs more than one that is corrected."""
    gammas: tuple[float, ...] = ()
    """Of several tasks in one, the discount of each instead of gamma."""
    gae_lambda: float = 0.95
    """Lambda of the generalised advantage estimation."""
    reward_scale: float = 0.01
    """Factor on the rewards, so that the critic's targets are of the order of 1."""
    hidden: tuple[int, ...] = (128,)
    """Widths of the policy's hidden layers; the paper has one of 128."""
    critic_hidden: tuple[int, ...] = (64, 64)
    """Widths of the critic's hidden layers."""
    memory: str = "none"
    """Memory of the policy: none (the paper's), gru, a gated recurrent unit, or raptor, a unit
    behind a layer of as many neurons, whose state is all that is read: what mc_raptor flies."""
    memory_width: int = 64
    """Numbers that a policy with a memory remembers."""
    holds_goal: bool = False
    """Whether the mean action at the goal is to hover, whatever the weights: the network's output
    at the goal is subtracted from its output. The policy then sees neither position nor, if the
    heading is free, yaw."""
    initial_deviation: float = 1.0
    """Standard deviation of the actions at the start of the training."""
    from_run: str = ""
    """Folder of a run whose networks the training begins with: policy and critic, with the mean and
    deviation of what they see. Their widths, memory, holds_goal and deviation are those of that
    run; task, algorithm and all else may differ. Saved as FOLDER@DIGEST, with the digest of its
    checkpoint."""
    phases: tuple[dict[str, Any], ...] = ()
    """Trainings that come before, in turn, each from the networks of the one before it: the
    algorithm of each, and what else differs there, such as [{"algo": "apg", "steps": 200000}]. One
    with the same algorithm has the settings of this training, another one its own defaults; all
    have the same task, seed and networks. They are in the same folder, as phase_1, phase_2, ..."""
    ppo: PPOConfig = dataclasses.field(default_factory=PPOConfig)
    """Settings of PPO."""
    trpo: TRPOConfig = dataclasses.field(default_factory=TRPOConfig)
    """Settings of TRPO."""
    vpg: VPGConfig = dataclasses.field(default_factory=VPGConfig)
    """Settings of the plain policy gradient."""
    apg: APGConfig = dataclasses.field(default_factory=APGConfig)
    """Settings of the analytic policy gradient."""
    dagger: DaggerConfig = dataclasses.field(default_factory=DaggerConfig)
    """Settings of the imitation of a teacher."""
    device: str = "cpu"
    """Device: cpu, or cuda for a GPU, where PPO flies and learns without a processor as far as free
    flight is covered there (docs/gpu.md); what is not covered is flown on the CPU."""
    num_threads: int = 0
    """Threads of the simulation; 0 for one per core. The results do not depend on it."""
    checkpoint_seconds: float = 5.0
    """Shortest time between two checkpoints [s]."""
    evaluations: int = 10
    """Number of evaluations, evenly over the training: the policy of the moment flies 10 to 50
    episodes with its mean action, in the engine of the training, for a row of evaluations.csv. They
    take some 2 % of the training, and change nothing of it."""
    keep: str = "best"
    """The policy that is kept: best (of the evaluations that with the highest success, then the
    lowest error, then the latest) or last. The checkpoint is always the last."""
    log: str = "tensorboard"
    """Where the figures of metrics.csv and evaluations.csv are shown: tensorboard, or wandb for W&B
    as well (offline with WANDB_MODE=offline; its project is WANDB_PROJECT, by default quadrl)."""
    until: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Figures of an evaluation that end the training early, such as success=0.99: success,
    survival and return from there on up, error [m] from there on down."""
    checkpoint_every: int = 0
    """Control steps between two policies that are kept beside the last, as in
    policy_000100000.safetensors; 0 for none."""
    episodes: int = 100
    """Episodes of the evaluation at the end."""

    def named(self) -> dict[str, Any]:
        """All of them by name, with each of the conditions as one; records are dicts."""
        whole = dict[str, Any]()
        for name, value in dataclasses.asdict(self).items():
            whole |= value if name == "conditions" else {name: value}
        return whole


USUAL = TrainSettings().named()
"""The defaults of all settings, by name."""
PAIRED = ("training_options", "until", *(name for name in GIVEN if GIVEN[name]["given"] == "pairs"))
"""Settings that are dicts: given entries are added to the default ones."""
