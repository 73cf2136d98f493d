"""The configuration of a training and the folder that it goes to; without torch."""

from __future__ import annotations

import dataclasses
import json
import math
import reprlib
import sys
from pathlib import Path
from typing import Any, ClassVar

import tyro

from quadrl import __version__, tasks
from quadrl.environment import MAX_ENVS, MAX_THREADS
from quadrl.errors import QuadrlError
from quadrl.interfaces import INTERFACES
from quadrl.policy import write_whole
from quadrl.simulation import ENGINES, Engine
from quadrl.task import OptionError, Task, check_choices
from quadrl.vehicle import VEHICLES, Vehicle

CONFIG = "config.json"
ALGORITHMS = ("ppo", "trpo", "gae")
FREE = ("num_threads", "checkpoint_seconds")
"""Settings that change no number."""
MAX_BATCH = 1 << 24
"""Most transitions in a batch: some GB."""


class RunError(QuadrlError):
    """A run folder or a checkpoint that cannot be used."""


class ConfigError(QuadrlError):
    """A configuration that cannot be trained; no ValueError, which tyro would put in a frame."""


def new_folder(path: Path) -> Path:
    """Make the folder of a new run.

    Raises:
        RunError: It holds a run already, or cannot be written.
    """
    if (path / CONFIG).exists():
        raise RunError(
            f"{path} already holds a run; choose another --out, or go on with it: "
            f"quadrl train --resume {path}"
        )
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise RunError(
            f"cannot write the run folder {path}: {error.strerror or error}; "
            "choose another with --out"
        ) from error
    return path


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    write_whole(path, text.encode())


def read_config(folder: Path) -> dict[str, Any]:
    """The resolved configuration of a run.

    Raises:
        RunError: The folder holds no run, or its configuration cannot be read.
    """
    file = folder / CONFIG
    if not file.is_file():
        raise RunError(f"{folder} holds no run: there is no {CONFIG} in it")
    try:
        config = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise RunError(f"{file} cannot be read: {error}") from error
    if not isinstance(config, dict):
        raise RunError(f"{file} is no configuration of a run")
    return config


@dataclasses.dataclass(frozen=True)
class _Settings:
    """Numbers of an algorithm: whole ones are counts, others are positive unless they may be 0."""

    MAY_BE_ZERO: ClassVar[tuple[str, ...]] = ("entropy", "critic", "damping")

    def __post_init__(self) -> None:
        """Refuse what cannot be trained.

        Raises:
            ConfigError: The message names the value and what is allowed.
        """
        try:
            for field in dataclasses.fields(self):
                value = getattr(self, field.name)
                if isinstance(field.default, int):
                    _check_count(field.name, value, 1)
                elif field.name in self.MAY_BE_ZERO:
                    _check_number(field.name, value, 0)
                else:
                    _check_positive(field.name, value)
        except OptionError as error:
            raise ConfigError(str(error)) from error


@dataclasses.dataclass(frozen=True)
class PPOConfig(_Settings):
    """What is PPO's own."""

    learning_rate: float = 4e-3
    """Of Adam, at the start; it falls linearly to zero over the training."""
    epochs: int = 5
    """Passes over each batch."""
    minibatch: int = 1024
    """Transitions in one gradient step: few and large, since each step costs milliseconds."""
    clip: float = 0.2
    """Of the probability ratio."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    critic: float = 1.0
    """Weight of the critic's squared error."""
    max_gradient: float = 1.0
    """Norm to which gradients are clipped."""


@dataclasses.dataclass(frozen=True)
class TRPOConfig(_Settings):
    """What is TRPO's own."""

    max_kl: float = 0.02
    """Bound of the mean KL divergence of a step."""
    damping: float = 0.01
    """Added to the diagonal of the Fisher matrix."""
    iterations: int = 10
    """Of the conjugate gradients."""
    backtracks: int = 10
    """Steps tried in the line search."""
    shrink: float = 0.7
    """Factor from one tried step to the next."""
    critic_rate: float = 3e-3
    """Learning rate of the critic, at the start; it falls linearly to zero."""
    critic_epochs: int = 8
    """Passes of the critic over each batch."""
    minibatch: int = 1024
    """Transitions in one gradient step of the critic."""


@dataclasses.dataclass(frozen=True)
class GAEConfig(_Settings):
    """What is the plain policy gradient's own."""

    # Tried on hover with 360,448 control steps, a critic of one layer and a first deviation of 0.6,
    # as aircraft x steps of a batch, learning rate: share of 100 fresh episodes that succeed with
    # the mean action, a number a seed from 100 on.
    # Critic at 0.003, 4 epochs: 256 x 16 (PPO's batch), 0.01: 0; 64 x 16, 0.003 and 0.01: 0, 0;
    # 32 x 16, 0.005 and 0.01: 0, 0; 64 x 8, 0.005: 0.01.
    # Critic at 0.003, 8 epochs: 256 x 16, 0.05: 0; 256 x 8, 0.007: 0.87, 1, 0; 0.01: 0.30; 0.03: 0;
    # 256 x 4, 0.003: 0.79; 0.01: 0; with seed 101 alone: 256 x 4, 0.005: 0.04; 64 x 16, 0.005: 0;
    # 128 x 8, 0.003: 0.66, 1, 1; 0.005: 0.99, 0.27.
    # Critic at 0.006, 8 epochs: 256 x 8, 0.005: 1, not tried, 0; 128 x 8, 0.003: 1, 1, 1
    # (and with seed 100, where nothing was tuned: static waypoint 1, landing 0).
    learning_rate: float = 3e-3
    """Of the policy's one step on a batch, at the start; it falls linearly to zero."""
    critic_rate: float = 6e-3
    """Learning rate of the critic, at the start; it falls linearly to zero."""
    critic_epochs: int = 8
    """Passes of the critic over each batch."""
    minibatch: int = 1024
    """Transitions in one gradient step of the critic."""
    max_gradient: float = 1.0
    """Norm to which gradients are clipped."""


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A training, but for the folder that it goes to."""

    task: tyro.conf.Positional[str] = "hover"
    """Name of the task."""
    algo: str = "ppo"
    """Algorithm: ppo, trpo, or gae (the plain policy gradient)."""
    seed: int = 0
    """Of the networks, the exploration and the episodes."""
    vehicle: str = "paper"
    """Name of the aircraft."""
    action: str = "rotor"
    """What actions mean: rotor (the paper's), thrust_body_rate, velocity or position."""
    engine: Engine = "flight"
    """What the training flies in: flight (free flight wherever there is nothing to touch), or
    mujoco. Evaluations fly in mujoco."""
    task_options: tuple[str, ...] = ()
    """Fields of the task that differ from its defaults, such as horizon=5."""
    num_envs: int = 256
    """Aircraft flown together."""
    rollout: int = 16
    """Control steps of each aircraft in a batch."""
    steps: int = 1_310_720
    """Control steps of all aircraft in the training."""
    gamma: float = 0.93
    """Discount a control step: rewards are gains, so a sight of 0.7 s is enough, and the shorter it
    is, the more an error that stays costs against one that is mended."""
    gae_lambda: float = 0.95
    """Lambda of the generalised advantage estimation."""
    reward_scale: float = 0.01
    """Factor on the rewards, so that the critic's targets are of the order of 1."""
    hidden: tuple[int, ...] = (128,)
    """Hidden layers of the policy; the paper's is one of 128."""
    critic_hidden: tuple[int, ...] = (64, 64)
    """Hidden layers of the critic."""
    initial_deviation: float = 1.0
    """Standard deviation of the actions at the start."""
    trpo: TRPOConfig = dataclasses.field(default_factory=TRPOConfig)
    """TRPO's own."""
    gae: GAEConfig = dataclasses.field(default_factory=GAEConfig)
    """The plain policy gradient's own."""
    ppo: PPOConfig = dataclasses.field(default_factory=PPOConfig)
    """PPO's own."""
    num_threads: int = 0
    """Threads of the simulation; 0 for every core. The numbers do not depend on it."""
    checkpoint_seconds: float = 5.0
    """Least time between two checkpoints [s]."""

    def __post_init__(self) -> None:
        """Refuse what cannot be trained.

        Raises:
            ConfigError: The message names the value and what is allowed.
        """
        try:
            self._check()
        except QuadrlError as error:
            raise ConfigError(str(error)) from error

    def _check(self) -> None:
        for name in ("rollout", "steps"):
            _check_count(name, getattr(self, name), 1)
        _check_count("num_envs", self.num_envs, 1, MAX_ENVS)
        if not 2 <= self.num_envs * self.rollout <= MAX_BATCH:  # one advantage has no deviation
            raise OptionError(
                f"num_envs = {self.num_envs} with rollout = {self.rollout}: 2 to {MAX_BATCH} "
                "transitions in a batch are allowed"
            )
        for name in ("gamma", "gae_lambda"):
            _check_number(name, getattr(self, name), 0, 1)
        _check_count("seed", self.seed, 0, 999)
        _check_number("initial_deviation", self.initial_deviation, 0.01, math.e)
        _check_count("num_threads", self.num_threads, 0, MAX_THREADS)
        _check_number("checkpoint_seconds", self.checkpoint_seconds, 0)
        _check_positive("reward_scale", self.reward_scale)
        for name in ("hidden", "critic_hidden", "task_options"):
            if not isinstance(getattr(self, name), (tuple, list)):
                raise OptionError(
                    f"{name} = {reprlib.repr(getattr(self, name))}: a list is allowed"
                )
        for width in (*self.hidden, *self.critic_hidden):
            _check_count("width of a hidden layer", width, 1, 1 << 16)
        for name, kind in (("ppo", PPOConfig), ("trpo", TRPOConfig), ("gae", GAEConfig)):
            if not isinstance(getattr(self, name), kind):
                raise OptionError(
                    f"{name} = {reprlib.repr(getattr(self, name))}: a {kind.__name__} is allowed"
                )
        check_choices([self.vehicle], VEHICLES, "vehicle")
        check_choices([self.action], INTERFACES, "action interface")
        check_choices([self.engine], ENGINES, "engine")
        check_choices([self.algo], ALGORITHMS, "algorithm")
        make_task(self.task, self.options)

    @property
    def options(self) -> dict[str, Any]:
        """`task_options` by name."""
        return parse_options(self.task_options)

    @property
    def iterations(self) -> int:
        """Batches in the training."""
        return max(1, math.ceil(self.steps / (self.num_envs * self.rollout)))

    def resolved(self) -> dict[str, Any]:
        """As JSON gives it back, with everything that the names stand for."""
        whole = dataclasses.asdict(self) | {
            "resolved_task": dataclasses.asdict(tasks.make(self.task, **self.options)),
            "resolved_vehicle": dataclasses.asdict(VEHICLES[self.vehicle]),
            "versions": versions(),
        }
        return json.loads(json.dumps(whole))

    def difference(self, saved: dict[str, Any]) -> str:
        """The first setting that changes numbers and was another in a resolved configuration.

        Args:
            saved: What `resolved` gave when it was saved.

        Returns:
            Its name and both values in words; nothing when the numbers are the same.
        """
        was, now = _flat(saved), _flat(self.resolved())
        for name in (*now, *was):
            if name not in FREE and was.get(name) != now.get(name):
                return f"{name} = {was.get(name)!r}, and here it is {now.get(name)!r}"
        return ""

    @classmethod
    def of_folder(cls, folder: Path) -> TrainConfig:
        """The configuration of a run.

        Raises:
            RunError: The folder holds none, or what its names stand for has changed since.
        """
        saved = read_config(folder)
        known = {f.name for f in dataclasses.fields(cls)}
        values = {k: v for k, v in saved.items() if k in known}
        try:
            for name, kind in (("ppo", PPOConfig), ("trpo", TRPOConfig), ("gae", GAEConfig)):
                values[name] = kind(**values[name])
            values |= {k: tuple(values[k]) for k in ("hidden", "critic_hidden", "task_options")}
            config = cls(**values)
        except (KeyError, TypeError, AttributeError) as error:
            raise RunError(f"{folder}: its configuration is damaged: {error}") from error
        now = config.resolved()
        for part in ("resolved_task", "resolved_vehicle"):
            if saved.get(part) != now[part]:
                raise RunError(
                    f"{folder} was trained with another {part.removeprefix('resolved_')}: its "
                    "parameters have changed since; start a new run"
                )
        return config


def _flat(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of settings by both names: ppo.clip, versions.torch, task.horizon."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            group = name.removeprefix("resolved_")
            flat |= {f"{group}.{inner}": v for inner, v in value.items()}
        else:
            flat[name] = value
    return flat


def parse_options(pairs: tuple[str, ...]) -> dict[str, Any]:
    """Options given as NAME=VALUE; a value is read as JSON where it is some, lists as tuples.

    Raises:
        OptionError: One has no equals sign.
    """
    options: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=") if isinstance(pair, str) else ("", "", "")
        if not equals:
            raise OptionError(
                f"option {reprlib.repr(pair)}: NAME=VALUE is expected, such as horizon=5"
            )
        try:
            options[name] = _tuples(json.loads(text))
        except (ValueError, RecursionError):
            options[name] = text
    return options


def make_task(name: str, options: dict[str, Any]) -> Task:
    """A task of the catalogue with options that came as text or from a file.

    Raises:
        OptionError: Unknown task or option, or a value of another kind than the default's.
    """
    task = tasks.make(name)
    try:
        return task.replace(**options)
    except (TypeError, ArithmeticError) as error:  # of a check that is the task's own
        raise OptionError(f"{name} options {options}: {error}") from error


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _check_positive(name: str, value: float) -> None:
    if not (_is_number(value) and 0 < value <= sys.float_info.max):
        raise OptionError(f"{name} = {reprlib.repr(value)}: a positive number is allowed")


def _check_number(name: str, value: float, low: float, high: float = math.inf) -> None:
    if not (_is_number(value) and low <= value <= min(high, sys.float_info.max)):
        allowed = f"at least {low:g}" if math.isinf(high) else f"{low:g} to {high:.10g}"
        raise OptionError(f"{name} = {reprlib.repr(value)}: {allowed} is allowed")


def _check_count(name: str, value: int, low: int, high: float = math.inf) -> None:
    """The same of a whole number."""
    _check_number(name, value, low, high)
    if not isinstance(value, int):
        raise OptionError(f"{name} = {value}: a whole number is allowed")


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def versions() -> dict[str, str]:
    """Of the packages that the numbers of a run depend on."""
    from importlib.metadata import version

    packages = {name: version(name) for name in ("mujoco", "torch", "torchrl", "numpy")}
    return {"quadrl": __version__} | packages


RECIPES: dict[str, dict[str, Any]] = {
    "hover": {"gamma": 0.9, "steps": 204_800, "ppo": PPOConfig(learning_rate=8e-3)},
    "static_waypoint": {"gamma": 0.9, "ppo": PPOConfig(learning_rate=8e-3)},
    "random_waypoint": {"steps": 2_621_440},
    "straight_and_level": {"gamma": 0.94, "steps": 1_966_080},
    "landing": {"gamma": 0.97, "steps": 2_621_440},
}
"""What a task trains with where the defaults are not its best."""


ALGO_RECIPES: dict[str, dict[str, Any]] = {"gae": {"num_envs": 128, "rollout": 8}}
"""What an algorithm trains with where the defaults are not its best."""


def recipe(task: str, algo: str = "ppo", vehicle: str = "paper") -> TrainConfig:
    """The configuration that a task is trained with by default by an algorithm.

    An aircraft that is controlled more often sees as far ahead in seconds as the paper's, collects
    as many seconds in a batch, and trains for as many.

    Raises:
        ConfigError: Unknown task, algorithm or aircraft.
    """
    usual = TrainConfig(task=task, algo=algo, **RECIPES.get(task, {}), **ALGO_RECIPES.get(algo, {}))
    check_choices([vehicle], VEHICLES, "vehicle")
    often = round(Vehicle().control_step / VEHICLES[vehicle].control_step, 9)
    return dataclasses.replace(
        usual,
        vehicle=vehicle,
        gamma=usual.gamma if often == 1 else round(usual.gamma ** (1 / often), 4),
        rollout=max(1, round(usual.rollout * often)),
        steps=round(usual.steps * often),
    )
