"""Small trainings, and what their tests compare."""

import csv
import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from quadrl.evaluation.evaluate import evaluate
from quadrl.learning.config import TrainConfig
from quadrl.learning.networks import make_actor_critic
from quadrl.learning.train import Training

# 6 batches of 32 transitions; episodes of 10 steps, so that many end in between.
TINY = TrainConfig(
    "hover",
    num_envs=8,
    rollout=4,
    steps=8 * 4 * 6,
    hidden=(16,),
    critic_hidden=(16,),
    task_options={"time_limit": 0.5},
    checkpoint_seconds=0.0,
    evaluations=0,
    holds_goal=False,
    ppo={"epochs": 2, "minibatch": 16},
)


def changed(**settings) -> TrainConfig:
    other = {"training_options": {}} if "task" in settings else {}  # hover's is no other task's
    if settings.get("algo", "ppo") != "ppo":
        other["ppo"] = {}  # settings of PPO are refused there
    if settings.get("memory", "none") != "none":
        other["ppo"] = dataclasses.replace(TINY.ppo, fused=False)
    return dataclasses.replace(TINY, **other | settings)


def train(config: TrainConfig, folder: Path, *, resume: bool = False) -> Path:
    Training(config, folder, resume=resume).run()
    return folder


class Stop(Exception):
    pass


def stopped(config: TrainConfig, folder: Path, after: int, *, resume: bool = False) -> Path:
    """A run that stops after the row of an iteration is written, before its checkpoint."""

    def stop(progress):
        if progress.iteration == after:
            raise Stop

    with pytest.raises(Stop):
        Training(config, folder, resume=resume).run(stop)
    return folder


def metrics(folder: Path, name: str = "metrics.csv") -> list[dict[str, str]]:
    """The rows of metrics.csv, or of another file of a run, but for the wall clock."""
    with open(folder / name, newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


@pytest.fixture
def one_thread():
    """As in a training: on a busy machine a second one costs more than it gives."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def actor_critic(
    seed: int = 0, size: int = 5, actions: int = 2, privileged: int = 0, **settings: Any
) -> tuple[Any, Any, Any]:
    """Small networks as they are at the start of a training, and their normalisers."""
    torch.manual_seed(seed)
    small = {"hidden": (6,), "critic_hidden": (6,), "initial_deviation": 0.5, "holds_goal": False}
    return make_actor_critic(size, actions, TrainConfig(**small | settings), privileged)


def disturbed(network: Any, by: float = 0.3) -> Any:
    """A network away from the start, where a policy's mean hardly depends on the weights."""
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += by * torch.randn_like(parameter)
    return network


def batch_of(actor: Any, size: int, seed: int = 0, rows: int = 24) -> Any:
    """What an actor did with observations of a size."""
    torch.manual_seed(seed)
    batch = TensorDict({"observation": torch.randn(rows, size)}, [rows])
    with torch.no_grad():
        batch = actor(batch)
    # Better the nearer the first action is to 0.5: an advantage that a policy can climb.
    advantage = -(batch["action"][:, :1] - 0.5).square()
    batch["advantage"] = (advantage - advantage.mean()) / advantage.std()
    batch["value_target"] = batch["observation"][:, :1].clone()
    return batch


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def assert_same_run(a: Path, b: Path) -> None:
    """Weights, normaliser and header; metrics; evaluation."""
    assert (a / "policy.safetensors").read_bytes() == (b / "policy.safetensors").read_bytes()
    assert metrics(a) == metrics(b)
    task = TrainConfig.of_folder(a).scenario.task
    one, other = (evaluate(folder, task, episodes=4).metrics for folder in (a, b))
    assert one == other
