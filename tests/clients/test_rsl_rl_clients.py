"""rsl_rl's own code on our batch, as it comes."""

import copy
import dataclasses
import importlib
import sys
import time

import gymnasium as gym
import numpy as np
import pytest
import torch
from helpers import refused

from quadrl.tasks import TASKS
from quadrl.testing import varied_actions

pytest.importorskip("rsl_rl")

from rsl_rl.runners import OnPolicyRunner

from quadrl.envs.rsl_rl import QuadrotorVecEnv

COUNT = 4
ACTIONS = varied_actions(50, COUNT).astype(np.float32)
NETWORK = {"class_name": "MLPModel", "hidden_dims": [64, 64], "obs_normalization": True}
GAUSSIAN = {"class_name": "GaussianDistribution", "init_std": 0.5}
SETTINGS = {
    "num_steps_per_env": 8,
    "save_interval": 1000,
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": NETWORK | {"distribution_cfg": GAUSSIAN},
    "critic": NETWORK,
    "algorithm": {"class_name": "PPO", "num_learning_epochs": 1, "num_mini_batches": 1},
}


def settings(**changed):
    """Settings of a training; the runner writes into what it gets."""
    return copy.deepcopy(SETTINGS | changed)


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("hover", {"vehicle": "crazyflie", "control_timestep": 0.04}),
        ("landing", {"start_height": 0.2}),
        (
            "hover",
            {
                "randomization": "full",
                "weather": "light",
                "observe": {"privileged": True},
                "max_distance": 0.7,
            },
        ),
    ],
    ids=["hover", "landing", "uncertain"],
)
def test_the_batch_has_the_numbers_of_gymnasium(task, options):
    options = options | {"time_limit": 1.0}
    ours = QuadrotorVecEnv(task, COUNT, seed=3, **options)
    id = TASKS[task].gymnasium_id()
    theirs = gym.make_vec(id, COUNT, autoreset_mode="SameStep", **options)
    seen, (expected, info) = ours.get_observations(), theirs.reset(seed=3)
    kinds = set()
    for action in ACTIONS:
        np.testing.assert_array_equal(seen["policy"], expected)
        assert seen["policy"].dtype == torch.float32
        assert ("critic" in seen.keys()) == ("privileged" in info)
        if "critic" in seen.keys():
            np.testing.assert_array_equal(seen["critic"], info["privileged"])
        seen, reward, done, extras = ours.step(torch.from_numpy(action))
        expected, their_reward, terminated, truncated, info = theirs.step(action)
        np.testing.assert_array_equal(reward, their_reward.astype(np.float32))
        np.testing.assert_array_equal(done, terminated | truncated)
        np.testing.assert_array_equal(extras["time_outs"], truncated)
        assert ("final_obs" in extras) == ("log" in extras) == bool(done.any())
        if done.any():
            ended, last = done == 1, info["final_info"]
            final = np.stack(info["final_obs"][ended])
            np.testing.assert_array_equal(extras["final_obs"]["policy"][ended], final)
            kinds |= set(truncated[ended].tolist())
            for name, given in (("success", "is_success"), ("error", "error")):
                told = last[given][ended].astype(np.float32)
                np.testing.assert_array_equal(extras["log"][name], told)
    assert kinds == {True, False}


def test_lengths_that_are_set_end_the_first_episodes_earlier():
    ours, plain = (QuadrotorVecEnv("hover", COUNT, seed=0, time_limit=0.5) for _ in range(2))
    assert ours.max_episode_length == 10
    for envs in (ours, plain):
        envs.get_observations()
    ours.episode_length_buf = torch.tensor([0, 9, 4, 7])
    ends = [[], [], [], []]
    for step in range(1, 21):
        still = torch.zeros(COUNT, 4)
        seen, reward, done, extras = ours.step(still)
        expected, their_reward, _, _ = plain.step(still)
        torch.testing.assert_close(seen["policy"][0], expected["policy"][0], rtol=0, atol=0)
        if step == 1:  # what is flown is the same until an episode ends
            torch.testing.assert_close(reward, their_reward, rtol=0, atol=0)
        assert torch.equal(done == 1, extras["time_outs"])
        for row in np.flatnonzero(done):
            ends[row].append(step)
        # An episode that was cut short has neither failed nor succeeded.
        told = len(extras["log"]["error"]) if "log" in extras else 0
        assert told == (done.sum() if step > 10 else done[0])
    assert ends == [[10, 20], [1, 11], [6, 16], [3, 13]]


def test_a_length_that_is_set_back_does_not_outlast_the_time_limit():
    envs = QuadrotorVecEnv("hover", 1, seed=0, time_limit=0.5)
    envs.get_observations()
    dones = []
    for _ in range(10):
        envs.episode_length_buf = torch.zeros(1, dtype=torch.int64)
        dones.append(envs.step(torch.zeros(1, 4))[2].item())
    assert dones == [0] * 9 + [1]


@pytest.mark.parametrize("lengths", [torch.zeros(3, dtype=int), torch.zeros(COUNT), [-1, 0, 0, 0]])
def test_impossible_lengths_are_refused(lengths):
    envs = QuadrotorVecEnv("hover", COUNT)
    with refused(match="episode_length_buf.*4 whole numbers"):
        envs.episode_length_buf = lengths
    assert (envs.episode_length_buf == 0).all()


def test_its_critic_reads_the_privileged_observation_and_its_logs_are_read(tmp_path):
    envs = QuadrotorVecEnv(
        "hover", COUNT, seed=0, time_limit=0.5, observe={"privileged": True}, randomization="light"
    )
    groups = {"actor": ["policy"], "critic": ["critic"]}
    runner = OnPolicyRunner(envs, settings(obs_groups=groups), str(tmp_path))
    runner.learn(2)
    size = envs.get_observations()["critic"].shape[1]
    assert runner.alg.critic.obs_dim == size > envs.environment.size
    assert dataclasses.asdict(envs.cfg)["task"]["time_limit"] == 0.5  # as its loggers keep it
    assert (tmp_path / "model_1.pt").exists()
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events, begun = EventAccumulator(str(tmp_path)), time.monotonic()
    while "Train/mean_episode_length" not in events.Reload().Tags()["scalars"]:
        assert time.monotonic() < begun + 30  # a thread writes them
        time.sleep(0.1)
    assert {"Episode/success", "Episode/error"} <= set(events.Tags()["scalars"])
    assert events.Scalars("Train/mean_episode_length")[-1].value <= 10


def test_without_it_the_import_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "rsl_rl.env", None)
    monkeypatch.delitem(sys.modules, "quadrl.envs.rsl_rl")
    with pytest.raises(ImportError, match=r"pip install 'quadrl\[rsl_rl\]'"):
        importlib.import_module("quadrl.envs.rsl_rl")


def test_a_gpus_environment_gives_what_the_processors_gives(monkeypatch):
    from quadrl.envs.rsl_rl import DeviceVecEnv

    monkeypatch.setenv("QUADRL_CFLAGS", "-O1")
    given = {"num_envs": 16, "seed": 3, "engine": "free_flight"}
    one = QuadrotorVecEnv("hover", **given)
    other = DeviceVecEnv("hover", **given, device="cpu", precision="float64")
    for env in (one, other):
        env.reset()
        env.episode_length_buf = torch.arange(16) * 10
    torch.manual_seed(1)
    ended = 0
    for _ in range(60):
        actions = torch.rand(16, 4) - 0.5
        first, second = (env.step(actions) for env in (one, other))
        assert torch.equal(first[0]["policy"], second[0]["policy"].float())
        assert torch.equal(first[1], second[1].float())
        assert torch.equal(first[2], second[2])
        assert torch.equal(first[3]["time_outs"], second[3]["time_outs"])
        assert torch.equal(one.episode_length_buf, other.episode_length_buf)
        ended += int(first[2].sum())
    assert ended > 5
