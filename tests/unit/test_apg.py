"""Training through the physics: it learns, it goes on where it was stopped, what it refuses."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers import refused
from runs import metrics, train

from quadrl import tasks
from quadrl.base.errors import QuadrlWarning
from quadrl.base.rotation import norm
from quadrl.learning.config import TrainConfig
from quadrl.learning.environments import make_env
from quadrl.tasks.hover import Hover

TINY = TrainConfig(
    "hover",
    algo="apg",
    num_envs=8,
    rollout=8,
    steps=8 * 8 * 6,
    hidden=(16,),
    critic_hidden=(16,),
    task_options={"time_limit": 0.5},  # 10 steps: episodes end within windows
    randomization={"mass": (0.9, 1.1)},
    weather="light",
    checkpoint_seconds=0.0,
)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["rotor", "thrust_body_rate"])
def test_hover_is_learned_within_a_few_windows(mode, tmp_path):
    settings = {"seed": 300, "num_envs": 32, "steps": 32 * 32 * 20, "control_mode": mode}
    config = TrainConfig("hover", algo="apg", **settings)
    error = [float(row["error"]) for row in metrics(train(config, tmp_path / "run"))]
    assert max(error) > 1.0 and error[-1] < 0.4, error  # [m]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("engine", "mujoco"),
        ("memory", "gru"),
        ("observe", {"action_history": 2}),
        ("randomization", "full"),
        ("task", "landing"),  # it has contact
    ],
)
def test_what_has_no_derivatives_is_refused(name, value):
    with refused(name):
        TrainConfig(algo="apg", **{name: value})
    TrainConfig(**{name: value})


def test_it_trains_without_the_dead_time_and_says_so():
    config = TrainConfig("hover", algo="apg", vehicle="crazyflie", num_envs=8)
    with pytest.warns(QuadrlWarning, match=r"without the dead time of the aircraft, 0\.01 s"):
        trained = make_env(config, torch.device("cpu"))
    assert trained.environment.vehicle.dead_time == 0 and not trained.environment.stepwise
    assert config.scenario.vehicle.dead_time == 0.01
    assert make_env(
        dataclasses.replace(config, algo="ppo"), torch.device("cpu")
    ).environment.stepwise


def test_a_task_that_tensors_cannot_run_is_refused(tmp_path, monkeypatch):
    @dataclasses.dataclass(frozen=True)
    class Numpys(Hover):
        name = "numpys"
        compiled = False

        def error(self, now):
            return np.asarray(norm(now.potentials.to_goal))

    monkeypatch.setitem(tasks.TASKS, "numpys", Numpys)
    with refused("task", "numpys"):
        train(dataclasses.replace(TINY, task="numpys"), tmp_path / "run")
