"""Stable-Baselines3's own code on our environments, as it comes."""

import importlib
import sys

import gymnasium as gym
import numpy as np
import pytest
from helpers import refused
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecFrameStack, VecMonitor, VecNormalize

import quadrl  # noqa: F401 - registers the ids
from quadrl.envs.sb3 import QuadrotorVecEnv
from quadrl.tasks import TASKS
from quadrl.testing import varied_actions

HOVER = "quadrl/Hover-v0"
COUNT = 4
ACTIONS = varied_actions(50, COUNT)


def test_its_check_env():
    check_env(gym.make(HOVER))


@pytest.mark.parametrize("task", ["hover", "landing"])
def test_the_batch_is_its_own_vector_of_single_ones(task):
    settings = {"time_limit": 1.0, "vehicle": "crazyflie", "control_timestep": 0.04}
    settings |= {"start_height": 0.2} if task == "landing" else {}
    id = TASKS[task].gymnasium_id()
    ours = QuadrotorVecEnv(task, COUNT, reward_terms=True, **settings)
    theirs = make_vec_env(id, COUNT, env_kwargs=settings)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    for envs in (ours, theirs):
        envs.seed(3)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    kinds = set()
    for action in ACTIONS:
        (*got, infos), (*expected, their_infos) = ours.step(action), theirs.step(action)
        for mine, other in zip(got, expected, strict=True):
            np.testing.assert_array_equal(mine, other)
            assert mine.dtype == other.dtype
        for over, info, other in zip(got[2], infos, their_infos, strict=True):
            if not over:
                assert info == {}
                continue
            np.testing.assert_array_equal(
                info.pop("terminal_observation"), other.pop("terminal_observation")
            )
            other.pop("episode")  # of its Monitor
            assert info.keys() == other.keys()
            for name, value in info.items():
                np.testing.assert_array_equal(value, other[name], err_msg=name)
            kinds.add(info["TimeLimit.truncated"])
    assert kinds == {True, False}


def test_its_wrappers_count_and_normalise():
    envs = QuadrotorVecEnv("hover", COUNT, time_limit=0.5)
    envs = VecNormalize(VecMonitor(envs, info_keywords=("is_success",)), gamma=0.9)
    envs = VecFrameStack(envs, 2)
    envs.seed(0)
    assert envs.reset().shape == (COUNT, 44)
    ends = 0
    for action in ACTIONS[:25]:
        observation, _, over, infos = envs.step(action)
        assert np.isfinite(observation).all()
        for i in np.flatnonzero(over):
            assert infos[i]["episode"]["l"] == 10
            assert infos[i]["episode"]["is_success"] in (False, True)
            assert infos[i]["terminal_observation"].shape == (44,)
        ends += over.sum()
    assert ends == 2 * COUNT


def test_seeds_and_options_are_used_once():
    envs = QuadrotorVecEnv("hover", 2)
    envs.seed(5)
    envs.set_options({"position": np.array([0.0, 0.0, 0.25])})
    first = envs.reset()
    position = envs.envs.environment.snapshot.state.position
    np.testing.assert_allclose(position, [[0, 0, 0.25]] * 2, atol=1e-15)
    second = envs.reset()
    assert not np.array_equal(first, second)
    assert (envs.envs.environment.snapshot.state.position[:, 2] != 0.25).all()
    envs.seed(5)
    same = slice(3, 16)  # all but where it is, and where the goal is from there
    np.testing.assert_array_equal(envs.reset()[:, same], first[:, same])


def test_attributes_and_methods_are_those_of_the_rows():
    envs = QuadrotorVecEnv("hover", 3)
    assert envs.get_attr("render_mode") == [None] * 3
    assert envs.get_attr("action_space", [0, 2]) == [envs.action_space] * 2
    assert envs.env_method("get_attr", "num_envs", indices=1) == [(3, 3, 3)]
    assert envs.env_is_wrapped(Monitor) == [False] * 3
    envs.set_attr("anything", 7)
    assert envs.get_attr("anything") == [7, 7, 7]
    with refused():
        envs.set_attr("anything", 8, indices=0)
    assert envs.has_attr("environment") and not envs.has_attr("nothing_of_that_name")


@pytest.mark.usefixtures("cheap_pictures")
def test_pictures_of_the_rows_are_tiled():
    envs = QuadrotorVecEnv("hover", 3, render_mode="rgb_array", width=64, height=48)
    envs.reset()
    assert [image.shape for image in envs.get_images()] == [(48, 64, 3)] * 3
    assert envs.render().shape == (96, 128, 3)
    assert envs.metadata["render_fps"] == 20
    envs.close()


def test_without_it_the_import_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env.base_vec_env", None)
    monkeypatch.delitem(sys.modules, "quadrl.envs.sb3")
    with pytest.raises(ImportError, match="pip install stable-baselines3"):
        importlib.import_module("quadrl.envs.sb3")
