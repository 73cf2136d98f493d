"""The configuration of a training and the folder that it goes to; without torch."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from pathlib import Path
from typing import Any

import tyro

from quadrl import tasks
from quadrl.errors import QuadrlError
from quadrl.task import OptionError, check_choices
from quadrl.vehicle import VEHICLES

CONFIG = "config.json"
ALGORITHMS = ("ppo",)


class RunError(QuadrlError):
    """A run folder or a checkpoint that cannot be used."""


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
    scratch = path.with_name(path.name + ".part")
    scratch.write_text(text)
    os.replace(scratch, path)


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
class PPOConfig:
    """What is PPO's own."""

    learning_rate: float = 3e-3
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
class TrainConfig:
    """A training, but for the folder that it goes to."""

    task: tyro.conf.Positional[str] = "hover"
    """Name of the task."""
    algo: str = "ppo"
    """Algorithm: ppo."""
    seed: int = 0
    """Of the networks, the exploration and the episodes."""
    vehicle: str = "paper"
    """Name of the aircraft."""
    task_options: tuple[str, ...] = ()
    """Fields of the task that differ from its defaults, such as horizon=5."""
    num_envs: int = 256
    """Aircraft flown together."""
    rollout: int = 16
    """Control steps of each aircraft in a batch."""
    steps: int = 491_520
    """Control steps of all aircraft in the training."""
    gamma: float = 0.95
    """Discount: the reward is the gain of a step, so a short sight (1 s) is enough, and sharper."""
    gae_lambda: float = 0.95
    """Lambda of the generalised advantage estimation."""
    reward_scale: float = 0.01
    """Factor on the rewards, so that the critic's targets are of the order of 1."""
    hidden: tuple[int, ...] = (128,)
    """Hidden layers of the policy; the paper's is one of 128."""
    critic_hidden: tuple[int, ...] = (128,)
    """Hidden layers of the critic."""
    initial_deviation: float = 0.6
    """Standard deviation of the actions at the start."""
    ppo: PPOConfig = dataclasses.field(default_factory=PPOConfig)
    """PPO's own."""
    num_threads: int = 0
    """Threads of the simulation; 0 for every core. The numbers do not depend on it."""
    checkpoint_seconds: float = 5.0
    """Least time between two checkpoints [s]."""

    def __post_init__(self) -> None:
        """Refuse what cannot be trained."""
        for name in ("num_envs", "rollout", "steps"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} = {getattr(self, name)}: at least 1 is allowed")
        for name in ("gamma", "gae_lambda"):
            if not 0 <= getattr(self, name) <= 1:
                raise OptionError(f"{name} = {getattr(self, name)}: 0 to 1 is allowed")
        if not 0 <= self.seed < 1000:
            raise OptionError(f"seed = {self.seed}: 0 to 999 is allowed")
        check_choices([self.vehicle], VEHICLES, "vehicle")
        check_choices([self.algo], ALGORITHMS, "algorithm")
        tasks.make(self.task, **self.options)

    @property
    def options(self) -> dict[str, Any]:
        """`task_options` by name."""
        return parse_options(self.task_options)

    @property
    def iterations(self) -> int:
        """Batches in the training."""
        return max(1, math.ceil(self.steps / (self.num_envs * self.rollout)))

    def resolved(self) -> dict[str, Any]:
        """As plain values, with everything that the names stand for."""
        return dataclasses.asdict(self) | {
            "resolved_task": dataclasses.asdict(tasks.make(self.task, **self.options)),
            "resolved_vehicle": dataclasses.asdict(VEHICLES[self.vehicle]),
            "versions": versions(),
        }

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
            values["ppo"] = PPOConfig(**values["ppo"])
            values |= {k: tuple(values[k]) for k in ("hidden", "critic_hidden", "task_options")}
            config = cls(**values)
        except (KeyError, TypeError, AttributeError) as error:
            raise RunError(f"{folder}: its configuration is damaged: {error}") from error
        now = json.loads(json.dumps(config.resolved()))
        for part in ("resolved_task", "resolved_vehicle"):
            if saved.get(part) != now[part]:
                raise RunError(
                    f"{folder} was trained with another {part.removeprefix('resolved_')}: its "
                    "parameters have changed since; start a new run"
                )
        return config


def parse_options(pairs: tuple[str, ...]) -> dict[str, Any]:
    """Options given as NAME=VALUE; a value is read as JSON where it is some.

    Raises:
        OptionError: One has no equals sign.
    """
    options: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals:
            raise OptionError(f"option {pair!r}: NAME=VALUE is expected, such as horizon=5")
        try:
            options[name] = json.loads(text)
        except ValueError:
            options[name] = text
    return options


def versions() -> dict[str, str]:
    """Of the packages that a run depends on."""
    from importlib.metadata import version

    return {name: version(name) for name in ("mujoco", "torch", "torchrl", "numpy")}


RECIPES: dict[str, dict[str, Any]] = {}
"""What a task trains with where the defaults are not its best."""


def recipe(task: str) -> TrainConfig:
    """The configuration that a task is trained with by default."""
    return TrainConfig(task=task, **RECIPES.get(task, {}))
