"""The settings of a training, what each of them may be, and the first layer of their defaults."""

from __future__ import annotations

import dataclasses
import math
import warnings
from typing import Any

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.validation import choice, keys, number
from quadrl.core.scenario import GIVEN
from quadrl.engines.mujoco import MAX_ENVS, MAX_THREADS
from quadrl.evaluation.rollout import MAX_EPISODES, MAX_SEED
from quadrl.learning.folder import FIGURES
from quadrl.learning.log import WRITERS
from quadrl.learning.settings import (
    APGConfig,
    DaggerConfig,
    PPOConfig,
    TRPOConfig,
    VPGConfig,
)

MAX_BATCH = 1 << 24
"""Most transitions in a batch, which are some GB."""
MAX_WIDTH = 1 << 16
MEMORIES = ("none", "gru", "raptor")
KEEPS = ("best", "last")
_CONDITIONS = {name: how["usual"] for name, how in GIVEN.items()}


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

    @property
    def iterations(self) -> int:
        """Batches in the training."""
        return max(1, math.ceil(self.steps / (self.num_envs * self.rollout)))

    def named(self) -> dict[str, Any]:
        """All of them by name, with each of the conditions as one; records are dicts."""
        whole = dict[str, Any]()
        for name, value in dataclasses.asdict(self).items():
            whole |= value if name == "conditions" else {name: value}
        return whole

    def check_values(self) -> None:
        """Refuse what each of them cannot be, whatever is trained on.

        Raises:
            QuadrlError: The message names the setting.
        """
        for name, low, high, rest in (
            ("seed", 0, MAX_SEED, {"whole": True}),
            ("num_envs", 1, MAX_ENVS, {"whole": True}),
            ("rollout", 1, MAX_BATCH, {"whole": True}),
            ("steps", 1, math.inf, {"whole": True}),
            ("num_threads", 0, MAX_THREADS, {"whole": True}),
            ("memory_width", 1, MAX_WIDTH, {"whole": True}),
            ("evaluations", 0, math.inf, {"whole": True}),
            ("checkpoint_every", 0, self.steps, {"whole": True}),
            ("episodes", 1, MAX_EPISODES, {"whole": True}),
            ("gamma", 0, 1, {}),
            ("gae_lambda", 0, 1, {}),
            ("initial_deviation", 0.01, math.e, {}),
            ("checkpoint_seconds", 0, math.inf, {}),
            ("reward_scale", 0, math.inf, {"positive": True}),
        ):
            object.__setattr__(self, name, number(name, getattr(self, name), low, high, **rest))
        widths: dict[str, type] = {"hidden": tuple, "critic_hidden": tuple}
        values = vars(self) | self.conditions
        for name, kind in (widths | dict.fromkeys(PAIRED, dict)).items():
            if not isinstance(values[name], kind):
                raise QuadrlError(name=name, value=values[name], allowed=f"a {kind.__name__}")
        for width in (*self.hidden, *self.critic_hidden):
            number("width of a hidden layer", width, 1, MAX_WIDTH, whole=True)
        batch = self.num_envs * self.rollout  # one advantage alone has no standard deviation
        number("num_envs * rollout", batch, 2, MAX_BATCH, whole=True)
        if self.gamma == 1.0:
            said = "gamma = 1: distant rewards count as much as near ones; usual are 0.9 to 0.99"
            warnings.warn(said, QuadrlWarning, stacklevel=4)
        choice("memory", self.memory, MEMORIES)
        choice("keep", self.keep, KEEPS)
        choice("log", self.log, WRITERS)
        keys("until", self.until, FIGURES)
        for name, value in self.until.items():
            number(f"until {name}", value)
        if self.evaluations > max(self.iterations, USUAL["evaluations"]):
            allowed = f"at most {self.iterations}, one after each batch"
            raise QuadrlError(name="evaluations", value=self.evaluations, allowed=allowed)
        if self.until and not self.evaluations:
            reason = "without evaluations nothing says when"
            raise QuadrlError(reason, name="until", value=self.until, allowed="left out")
        if not isinstance(self.holds_goal, bool) or (self.holds_goal and self.memory != "none"):
            allowed = "True or False; False for a policy with a memory"
            raise QuadrlError(name="holds_goal", value=self.holds_goal, allowed=allowed)
        if not isinstance(self.device, str) or not self.device:
            raise QuadrlError(name="device", value=self.device, allowed="a device of torch")


USUAL = TrainSettings().named()
"""The defaults of all settings, by name."""
PAIRED = ("training_options", "until", *(name for name in GIVEN if GIVEN[name]["given"] == "pairs"))
"""Settings that are dicts: given entries are added to the default ones."""
