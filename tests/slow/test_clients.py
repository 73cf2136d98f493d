"""Clients that take their time: they learn, they film, they fly in other processes."""

import functools
import re
from pathlib import Path

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from gymnasium.wrappers.vector import RecordVideo as VectorRecordVideo
from processes import python
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import (
    SubprocVecEnv,
    VecMonitor,
    VecNormalize,
)
from torchrl.envs import GymEnv, ParallelEnv

import quadrl  # noqa: F401 - registers the ids
from quadrl.envs.sb3 import QuadrotorVecEnv
from quadrl.testing import varied_actions

HOVER = "quadrl/Hover-v0"
PICTURE = {"render_mode": "rgb_array", "width": 64, "height": 48}
EXAMPLES = Path(quadrl.__file__).parents[1] / "docs" / "examples"


@pytest.mark.parametrize("workers", [None, "fork", "forkserver", "spawn"])
def test_sb3_learns_from_the_name(workers):
    settings = {}
    if workers:
        settings = {"vec_env_cls": SubprocVecEnv, "vec_env_kwargs": {"start_method": workers}}
    # Workers that do not begin as a copy of this process know no id that it has registered.
    envs = VecNormalize(make_vec_env(f"quadrl:{HOVER}", 2, seed=0, **settings))
    model = PPO("MlpPolicy", envs, n_steps=128, batch_size=64, n_epochs=2, device="cpu")
    model.learn(512)
    assert len(model.ep_info_buffer) > 0
    envs.close()


def test_sb3_ppo_learns_on_the_batch():
    envs = VecNormalize(VecMonitor(QuadrotorVecEnv("hover", 64)), gamma=0.9)
    settings = {"n_steps": 64, "batch_size": 1024, "n_epochs": 5, "learning_rate": 3e-3}
    model = PPO("MlpPolicy", envs, gamma=0.9, seed=0, device="cpu", **settings)
    lengths = []
    for _ in range(2):
        model.learn(40 * 4096, reset_num_timesteps=False)
        lengths.append(np.mean([episode["l"] for episode in model.ep_info_buffer]))
    assert lengths[-1] > 190  # of 200: it stays in the air


@pytest.mark.parametrize("example", ["sb3_ppo", "cleanrl_ppo", "torchrl_ppo", "learning_curve"])
def test_an_example_trains(example):
    options = ["--algo", "sac"] if example == "learning_curve" else []
    done = python(EXAMPLES / f"{example}.py", "--total-steps", "4096", *options)
    assert '"successful"' in done.stdout or '"success' in done.stdout


def test_the_yardsticks_fly_corners_nearer_and_recover_as_often_as_the_policies():
    done = python(EXAMPLES / "yardsticks.py", "--episodes", "20")
    found = [re.search(r", (\w+): (\d+) % (?:.*, (.*) cm)?", x) for x in done.stdout.splitlines()]
    rows = [(who, int(share), cm and float(cm)) for who, share, cm in (x.groups() for x in found)]
    for (_, _, policy), (_, share, controller) in (rows[0:2], rows[2:4]):  # pentagram, zigzag
        assert share == 100 and controller < policy / 2
    for (_, policy, _), (_, controller, _) in (rows[6:8], rows[8:10]):
        assert controller >= policy - 15 and controller >= 70  # twice the standard error of 20


@pytest.mark.filterwarnings("default")  # of Ray, about itself
def test_rllib_learns_on_one_machine(monkeypatch):
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")  # it would write to the home folder
    # Plain Ray, on which studies run, lacks what RLlib needs.
    pytest.importorskip("ray.rllib", exc_type=ImportError)
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig

    config = PPOConfig().environment(f"quadrl:{HOVER}").env_runners(num_env_runners=0)
    config = config.training(train_batch_size=512, minibatch_size=128, num_epochs=1)
    algorithm = config.build_algo()
    result = algorithm.train()
    assert result["env_runners"]["num_env_steps_sampled"] >= 512
    algorithm.stop()
    ray.shutdown()


# The writers and the reader leave the pipes to ffmpeg to the garbage collector.
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.usefixtures("cheap_pictures")
def test_gymnasium_records_a_vector(tmp_path):
    envs = gym.make_vec(HOVER, num_envs=4, time_limit=0.5, **PICTURE)
    envs = VectorRecordVideo(
        envs, str(tmp_path / "all"), record_first_only=False, video_aspect_ratio=(1, 1)
    )
    envs.reset(seed=0)
    for _ in range(12):
        envs.step(np.zeros((4, 4)))
    envs.close()
    meta, *frames = imageio_ffmpeg.read_frames(str(tmp_path / "all" / "rl-video-episode-0.mp4"))
    assert meta["size"] == (128, 96) and len(frames) >= 10


@pytest.mark.parametrize(
    "imports",
    ["import mediapy, quadrl.rendering", "import IPython, quadrl.rendering, mediapy"],
    ids=["mediapy first", "quadrl first, in a notebook"],
)
def test_mediapy_shows_a_video_in_a_notebook(imports):
    # In a process of its own: there no ffmpeg is on the path, and nobody has named one.
    code = f"""
import os
os.environ["PATH"] = ""
{imports}
import IPython.display
import numpy as np
shown = []
IPython.display.display = shown.append
mediapy.show_video(np.zeros((3, 48, 64, 3), np.uint8), fps=10)
assert "video/mp4" in shown[0].data
"""
    python("-c", code)


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_gymnasiums_asynchronous_vector(context):
    kwargs = {"vectorization_mode": "async", "vector_kwargs": {"context": context}}
    envs, ours = gym.make_vec(HOVER, 2, **kwargs), gym.make_vec(HOVER, 2)
    np.testing.assert_array_equal(envs.reset(seed=3)[0], ours.reset(seed=3)[0])
    for action in varied_actions(5, 2):
        one, other = envs.step(action), ours.step(action)
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])
    envs.close()


def test_torchrls_parallel_environment():
    # Its processes have not imported quadrl: the name says where the id comes from.
    envs = ParallelEnv(2, functools.partial(GymEnv, f"quadrl:{HOVER}"))
    assert envs.rollout(5).batch_size == (2, 5)
    envs.close()
