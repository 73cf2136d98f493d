"""The settings of a training, and where their defaults come from; without torch."""

from __future__ import annotations

import dataclasses
import json
import math
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar

from quadrl import __version__, tasks
from quadrl.control.modes import CONTROL_MODES
from quadrl.engines.mujoco import ENGINES, MAX_ENVS, MAX_THREADS
from quadrl.errors import QuadrlError
from quadrl.learning.folder import CONFIG, read_config
from quadrl.rollout import MAX_SEED
from quadrl.task import Task
from quadrl.validation import choice, keys, number
from quadrl.vehicle import VEHICLES

ALGORITHMS = ("ppo", "trpo", "vpg")
ALIASES = {"gae": "vpg"}
"""The paper names the plain policy gradient after its advantages."""
CHOSEN = ("task", "algo", "seed", "vehicle")
"""Settings that the defaults follow from, or that have no better default than another."""
MAX_BATCH = 1 << 24
"""Most transitions in a batch: some GB."""
MAX_WIDTH = 1 << 16


@dataclasses.dataclass(frozen=True)
class AlgorithmConfig:
    """Numbers of an algorithm: whole ones are counts, the others are positive unless listed."""

    training: ClassVar[dict[str, Any]] = {}
    """Settings of `TrainConfig` that have other defaults with this algorithm."""
    may_be_zero: ClassVar[tuple[str, ...]] = ("entropy", "critic", "damping")

    def __post_init__(self) -> None:
        """Validate the numbers."""
        prefix = type(self).__name__.removesuffix("Config").lower()
        for field in dataclasses.fields(self):
            value, name = getattr(self, field.name), f"{prefix}.{field.name}"
            if isinstance(field.default, int):
                checked = number(name, value, 1, whole=True)
            else:
                checked = number(name, value, 0, positive=field.name not in self.may_be_zero)
            object.__setattr__(self, field.name, checked)


@dataclasses.dataclass(frozen=True)
class PPOConfig(AlgorithmConfig):
    """Settings of PPO."""

    learning_rate: float = 4e-3
    """Initial rate of Adam; it falls linearly to zero over the training."""
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
    """Norm to which gradients are clipped."""


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
    """Factor from one tried step to the next."""
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


ALGORITHM_CONFIGS = {"ppo": PPOConfig, "trpo": TRPOConfig, "vpg": VPGConfig}


@dataclasses.dataclass(frozen=True, init=False)
class TrainConfig:
    """All settings of a training but its folder.

    The defaults below are those of a task that has none of its own in `Task.training`.
    """

    task: str = "hover"
    """Name of the task."""
    algo: str = "ppo"
    """Algorithm: ppo, trpo, or vpg (the plain policy gradient; the paper's name gae works too)."""
    seed: int = 0
    """Seed of the networks, the exploration and the episodes, between 0 and 2^32 - 1."""
    vehicle: str = "paper"
    """Name of the aircraft."""
    control_mode: str = "rotor"
    """Meaning of the actions: rotor (the paper's), thrust_body_rate, velocity or position."""
    engine: str = "free_flight"
    """Engine of the training: free_flight (MuJoCo only near the ground) or mujoco. Evaluations
    always fly in mujoco."""
    task_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task that differ from its defaults, such as time_limit=5."""
    num_envs: int = 256
    """Aircraft flown together."""
    rollout: int = 16
    """Control steps of each aircraft in a batch."""
    steps: int = 1_310_720
    """Control steps of all aircraft in the training."""
    gamma: float = 0.93
    """Discount per control step (effective horizon 0.7 s): with a short one a lasting
    error costs more than one that is corrected."""
    gae_lambda: float = 0.95
    """Lambda of the generalised advantage estimation."""
    reward_scale: float = 0.01
    """Factor on the rewards, so that the critic's targets are of the order of 1."""
    hidden: tuple[int, ...] = (128,)
    """Widths of the policy's hidden layers; the paper has one of 128."""
    critic_hidden: tuple[int, ...] = (64, 64)
    """Widths of the critic's hidden layers."""
    initial_deviation: float = 1.0
    """Standard deviation of the actions at the start."""
    ppo: PPOConfig = dataclasses.field(default_factory=PPOConfig)
    """Settings of PPO."""
    trpo: TRPOConfig = dataclasses.field(default_factory=TRPOConfig)
    """Settings of TRPO."""
    vpg: VPGConfig = dataclasses.field(default_factory=VPGConfig)
    """Settings of the plain policy gradient."""
    num_threads: int = 0
    """Threads of the simulation; 0 for one per core. The results do not depend on it."""
    checkpoint_seconds: float = 5.0
    """Least time between two checkpoints [s]."""

    def __init__(self, task: str = "hover", **settings: Any) -> None:
        """Fill in what is not given: defaults of the task, else of the algorithm, else the above.

        Args:
            task: Name of the task.
            **settings: The other fields, None for the default; those of an algorithm (`ppo`) may
                be a dict of some.

        Raises:
            QuadrlError: A setting is unknown or out of range.
        """
        keys("setting", settings, [field.name for field in dataclasses.fields(self)])
        settings = _given(settings)
        algo = settings.get("algo", TrainConfig.algo)
        algo = choice("algo", ALIASES.get(algo, algo), ALGORITHMS)
        values = training_defaults(task, algo, settings.get("vehicle", TrainConfig.vehicle))
        for name, kind in ALGORITHM_CONFIGS.items():
            given = settings.get(name, {})
            if isinstance(given, dict):
                keys(f"setting of {name}", given, [f.name for f in dataclasses.fields(kind)])
                given = dataclasses.replace(values[name], **_given(given))
            elif not isinstance(given, kind):
                raise QuadrlError(name=name, value=given, allowed=f"a {kind.__name__} or a dict")
            settings[name] = given
        for name, value in (values | settings | {"algo": algo}).items():
            object.__setattr__(self, name, tuples(value))
        self._check()

    def _check(self) -> None:
        for name, low, high, rest in (
            ("seed", 0, MAX_SEED, {"whole": True}),
            ("num_envs", 1, MAX_ENVS, {"whole": True}),
            ("rollout", 1, MAX_BATCH, {"whole": True}),
            ("steps", 1, math.inf, {"whole": True}),
            ("num_threads", 0, MAX_THREADS, {"whole": True}),
            ("gamma", 0, 1, {}),
            ("gae_lambda", 0, 1, {}),
            ("initial_deviation", 0.01, math.e, {}),
            ("checkpoint_seconds", 0, math.inf, {}),
            ("reward_scale", 0, math.inf, {"positive": True}),
        ):
            object.__setattr__(self, name, number(name, getattr(self, name), low, high, **rest))
        for name, kind in (("hidden", tuple), ("critic_hidden", tuple), ("task_options", dict)):
            if not isinstance(value := getattr(self, name), kind):
                raise QuadrlError(name=name, value=value, allowed=f"a {kind.__name__}")
        for width in (*self.hidden, *self.critic_hidden):
            number("width of a hidden layer", width, 1, MAX_WIDTH, whole=True)
        batch = self.num_envs * self.rollout  # the advantage of a single one has no deviation
        number("num_envs * rollout", batch, 2, MAX_BATCH, whole=True)
        choice("control_mode", self.control_mode, CONTROL_MODES)
        choice("engine", self.engine, ENGINES)
        self.make_task()

    def make_task(self) -> Task:
        """The task with its options."""
        return tasks.make(self.task, **self.task_options)

    @property
    def iterations(self) -> int:
        """Batches in the training."""
        return max(1, math.ceil(self.steps / (self.num_envs * self.rollout)))

    def resolved(self) -> dict[str, Any]:
        """The settings and everything that their names stand for, as JSON gives them back."""
        packages = ("mujoco", "torch", "torchrl", "numpy")
        whole = dataclasses.asdict(self) | {
            "resolved_task": dataclasses.asdict(self.make_task()),
            "resolved_vehicle": dataclasses.asdict(VEHICLES[self.vehicle]),
            "versions": {"quadrl": __version__} | {name: version(name) for name in packages},
        }
        return json.loads(json.dumps(whole))

    @classmethod
    def of_folder(cls, folder: Path) -> TrainConfig:
        """The configuration of a run.

        Raises:
            QuadrlError: The folder holds no run, or what its names stand for has changed since.
        """
        saved = read_config(folder)
        names = [field.name for field in dataclasses.fields(cls)]
        if missing := set(names) - set(saved):
            raise QuadrlError(f"{folder / CONFIG} is damaged: it lacks {sorted(missing)[0]}")
        config = cls(**{name: saved[name] for name in names})
        now = config.resolved()
        for part in ("task", "vehicle"):
            if saved.get(f"resolved_{part}") != now[f"resolved_{part}"]:
                raise QuadrlError(
                    f"{folder} was trained with other parameters of the {part} "
                    f"{saved[part]}; start a new run"
                )
        return config


def training_defaults(task: str, algo: str, vehicle: str) -> dict[str, Any]:
    """The fields of `TrainConfig` that a task is trained with unless something else is said.

    An aircraft that is controlled more often than the paper's looks as far ahead in seconds,
    collects as many seconds in a batch, and trains for as many.

    Raises:
        QuadrlError: The task, the vehicle or a setting in `Task.training` is unknown.
    """
    own = tasks.TASKS[choice("task", task, tasks.TASKS)].training
    names = [field.name for field in dataclasses.fields(TrainConfig)]
    keys(f"training default of {task}", own, [name for name in names if name not in CHOSEN])
    values = {name: getattr(TrainConfig, name) for name in names if hasattr(TrainConfig, name)}
    values |= {"task_options": {}} | ALGORITHM_CONFIGS[algo].training | own
    values |= {"task": task, "algo": algo}
    for name, kind in ALGORITHM_CONFIGS.items():
        values[name] = kind(**own.get(name, {}))
    aircraft = VEHICLES[choice("vehicle", vehicle, VEHICLES)]
    often = round(VEHICLES["paper"].control_timestep / aircraft.control_timestep, 9)
    if often != 1:
        values["gamma"] = round(values["gamma"] ** (1 / often), 4)
        values["rollout"] = max(1, round(values["rollout"] * often))
        values["steps"] = round(values["steps"] * often)
    return values


def _given(settings: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if value is not None}


def tuples(value: Any) -> Any:
    """Lists as JSON has them to tuples, at any depth."""
    if isinstance(value, dict):
        return {name: tuples(item) for name, item in value.items()}
    return tuple(map(tuples, value)) if isinstance(value, (list, tuple)) else value
