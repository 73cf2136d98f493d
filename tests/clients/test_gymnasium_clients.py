"""Gymnasium's own check and wrappers on our environments, as they come."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import vector as vector_wrappers
from helpers import refused

import quadrl  # noqa: F401 - registers the ids
from quadrl.base.errors import QuadrlError
from quadrl.testing import varied_actions

HOVER = "quadrl/Hover-v0"
SMALL = {"width": 64, "height": 48}
ACTIONS = varied_actions(30, 4)


@pytest.mark.usefixtures("cheap_pictures")
def test_check_env_with_pictures():
    check_env(gym.make(HOVER, **SMALL).unwrapped)


WRAPPERS = {
    "RecordEpisodeStatistics": {},
    "NormalizeObservation": {},
    "NormalizeReward": {},
    "FrameStackObservation": {"stack_size": 3},
    "TimeLimit": {"max_episode_steps": 5},
    "RescaleAction": {"min_action": np.float32(0), "max_action": np.float32(2)},
    "ClipAction": {},
    "RepeatAction": {"num_repeats": 2},
    "DtypeObservation": {"dtype": np.float64},
    "FlattenObservation": {},
    "Autoreset": {},
    "NumpyToTorch": {},
    "TimeAwareObservation": {},
}
PICTURES = {"RenderCollection": {}, "AddRenderObservation": {}}


@pytest.mark.usefixtures("cheap_pictures")
@pytest.mark.parametrize("name", WRAPPERS | PICTURES)
def test_a_wrapper_flies_an_episode(name):
    picture = {"render_mode": "rgb_array"} | SMALL if name in PICTURES else {}
    environment = wrapped = gym.make("quadrl:" + HOVER, time_limit=0.5, **picture)
    arguments = (WRAPPERS | PICTURES)[name]
    wrapped = getattr(wrappers, name)(environment, **arguments)
    observation, _ = wrapped.reset(seed=0)
    truncated, steps = False, 0
    while not truncated:
        assert name == "NumpyToTorch" or observation in wrapped.observation_space
        action = wrapped.action_space.sample() * 0.1
        action = torch.from_numpy(action) if name == "NumpyToTorch" else action
        observation, reward, terminated, truncated, info = wrapped.step(action)
        assert np.isfinite(float(reward)) and not terminated
        steps += 1
    assert steps == {"TimeLimit": 5, "RepeatAction": 5}.get(name, 10)
    if name == "RecordEpisodeStatistics":
        assert info["episode"]["l"] == 10


@pytest.mark.parametrize(
    ("settings", "steps"),
    [
        ({}, 200),
        ({"time_limit": 2.0}, 40),
        ({"control_timestep": 0.02}, 500),
        ({"vehicle": "crazyflie", "control_timestep": 0.02, "time_limit": 1.0}, 50),
    ],
)
def test_the_spec_knows_the_time_limit_of_the_task(settings, steps):
    environment = gym.make(HOVER, **settings)
    assert environment.spec.max_episode_steps == steps
    assert environment.unwrapped is environment  # there is no wrapper that counts as well
    assert gym.make_vec(HOVER, num_envs=2, **settings).spec.max_episode_steps == steps
    aware = wrappers.TimeAwareObservation(environment, normalize_time=True)
    aware.reset(seed=0)
    observation = aware.step(np.zeros(4))[0]
    assert observation[-1] == pytest.approx(1 / steps)


def test_what_made_an_environment_makes_it_again():
    one = gym.make(HOVER, time_limit=0.5, vehicle="crazyflie")
    read = gym.envs.registration.EnvSpec.from_json(one.spec.to_json())
    for other in (gym.make(one.spec), gym.make(read)):
        np.testing.assert_array_equal(one.reset(seed=3)[0], other.reset(seed=3)[0])
        for _ in range(10):
            np.testing.assert_array_equal(one.step(np.zeros(4))[0], other.step(np.zeros(4))[0])
    vector = gym.make_vec(HOVER, num_envs=3, max_episode_steps=7)
    again = gym.make_vec(vector.spec)
    assert again.num_envs == 3 and again.environment.time_limit_steps == 7


VECTOR_WRAPPERS = {
    "RecordEpisodeStatistics": {},
    "NormalizeObservation": {},
    "NormalizeReward": {},
    "ClipAction": {},
    "RescaleAction": {"min_action": np.float32(0), "max_action": np.float32(2)},
    "FlattenObservation": {},
    "DtypeObservation": {"dtype": np.float64},
    "DictInfoToList": {},
    "NumpyToTorch": {},
}


@pytest.mark.parametrize("name", VECTOR_WRAPPERS)
def test_a_vector_wrapper_flies_episodes(name):
    """Other modes of autoreset are held against Gymnasium's own vector in test_gymnasium.py."""
    envs = gym.make_vec(HOVER, num_envs=4, time_limit=0.5)
    wrapped = getattr(vector_wrappers, name)(envs, **VECTOR_WRAPPERS[name])
    wrapped.reset(seed=0)
    ends = 0
    for action in ACTIONS:
        action = torch.from_numpy(action) if name == "NumpyToTorch" else action
        observation, _, terminated, truncated, info = wrapped.step(action)
        assert np.isfinite(np.asarray(observation)).all()
        over = np.asarray(terminated | truncated)
        ends += over.sum()
        if name == "RecordEpisodeStatistics" and over.any():
            assert (info["episode"]["l"][over] == 10).all()
        if name == "DictInfoToList":
            assert len(info) == 4
    assert ends >= 8


# ------------------------------------------------------------------------------- what is asked


@pytest.mark.parametrize("seeds", [[0, 0, 0], (7, 2, 11), np.array([3, 2, 1])])
def test_a_list_of_seeds_is_for_the_rows(seeds):
    vector = gym.make_vec(HOVER, num_envs=3)
    met, _ = vector.reset(seed=seeds)
    for row, seed in zip(met, seeds, strict=True):
        np.testing.assert_array_equal(row, gym.make(HOVER).reset(seed=int(seed))[0])
    sync = gym.make_vec(HOVER, num_envs=3, vectorization_mode="sync")
    np.testing.assert_array_equal(met, sync.reset(seed=[int(seed) for seed in seeds])[0])


def test_none_in_a_list_of_seeds_leaves_the_row_as_it_is():
    vector, other = (gym.make_vec(HOVER, num_envs=3) for _ in range(2))
    vector.reset(seed=5)
    other.reset(seed=5)
    met, following = vector.reset(seed=[None, 9, None])[0], other.reset()[0]
    np.testing.assert_array_equal(met[[0, 2]], following[[0, 2]])
    np.testing.assert_array_equal(met[1], gym.make(HOVER).reset(seed=9)[0])


@pytest.mark.parametrize("seeds", [[1, 2], [1, -2, 3], [1, 2.5, 3], "one"])
def test_an_impossible_list_of_seeds_is_refused_and_changes_nothing(seeds):
    vector, other = (gym.make_vec(HOVER, num_envs=3) for _ in range(2))
    vector.reset(seed=0)
    other.reset(seed=0)
    with refused("seed"):
        vector.reset(seed=seeds)
    np.testing.assert_array_equal(vector.reset()[0], other.reset()[0])


def test_attributes_of_a_vector_are_asked_as_those_of_gymnasiums_own():
    ours = gym.make_vec(HOVER, num_envs=3)
    sync = gym.make_vec(HOVER, num_envs=3, vectorization_mode="sync")
    for name in ("render_mode", "action_space", "observation_space"):
        assert ours.get_attr(name) == sync.get_attr(name) == ours.call(name)
    assert [each.task for each in ours.get_attr("environment")] == [
        each.task for each in sync.get_attr("environment")
    ]
    assert ours.call("render") == sync.call("render") == (None,) * 3
    for vector in (ours, sync):
        vector.set_attr("anything", 3)
        assert vector.get_attr("anything") == (3, 3, 3)
        vector.set_attr("anything", [4.5, 4.5, 4.5])
        assert vector.get_attr("anything") == (4.5, 4.5, 4.5)
    for values in ([1, 2, 3], [1, 1]):
        with refused():
            ours.set_attr("anything", values)
    for name in ("reset", "step", "close"):
        with pytest.raises(QuadrlError, match=f"call {name} of the vector itself"):
            ours.call(name)
    with pytest.raises(AttributeError):
        ours.get_attr("nothing_of_that_name")


def test_options_of_a_reset_say_where_an_episode_begins():
    environment = gym.make(HOVER)
    start = {"position": (0.1, 0.2, 0.3), "velocity": (1.0, 0.0, 0.0), "quaternion": (2, 0, 0, 0)}
    environment.reset(seed=0, options=start)
    state = environment.unwrapped.environment.snapshot.state
    np.testing.assert_allclose(state.position[0], start["position"], atol=1e-15)
    np.testing.assert_array_equal(state.velocity[0], start["velocity"])
    np.testing.assert_array_equal(state.rotation[0], np.eye(3))
    drawn = gym.make(HOVER)
    drawn.reset(seed=0)
    body_rate = drawn.unwrapped.environment.snapshot.state.body_rate
    np.testing.assert_array_equal(state.body_rate, body_rate)  # what is not given is drawn


def test_options_of_a_vectors_reset_are_for_its_rows():
    vector, other = (gym.make_vec(HOVER, num_envs=3) for _ in range(2))
    vector.reset(seed=0)
    other.reset(seed=0)
    heights = np.array([[0, 0, 0.1], [0, 0, 0.2], [0, 0, 0.3]])
    mask = np.array([True, False, True])
    vector.reset(options={"reset_mask": mask, "position": heights})
    position = vector.environment.snapshot.state.position
    np.testing.assert_allclose(position[mask], heights[mask], atol=1e-15)
    np.testing.assert_array_equal(position[1], other.environment.snapshot.state.position[1])


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
def test_an_impossible_option_of_a_reset_is_refused(make):
    environment = make(HOVER)
    for name, value in {"position": (0, 1), "start": {"positon": (0, 0, 1)}}.items():
        with refused(name):
            environment.reset(options={name: value})
    environment.reset(seed=0)


def test_an_unknown_keyword_is_refused_in_pythons_words():
    # Libraries try keywords, and read in the TypeError which one they have to leave out.
    with pytest.raises(TypeError, match="got an unexpected keyword argument 'frameskip'"):
        gym.make(HOVER, frameskip=1)
    with refused(match=r"vehicle\b.*control_timestep.*did you mean vehicle"):
        gym.make(HOVER, vehical="crazyflie")


@pytest.mark.usefixtures("cheap_pictures")
def test_human_shows_what_is_drawn(monkeypatch):
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    environment = gym.make(HOVER, render_mode="human", **SMALL)
    assert environment.render_mode == "human"
    environment.reset(seed=0)
    environment.step(np.zeros(4))
    shown = pygame.surfarray.array3d(environment.window).transpose(1, 0, 2)
    drawn = environment.unwrapped.render()
    assert shown.shape == drawn.shape == (48, 64, 3)
    assert np.abs(shown.astype(int) - drawn).max() <= 8
    assert shown.std() > 5
    environment.close()
