"""Gymnasium, single and vector; what all APIs have in common is in contract/."""

import copy
import dataclasses
import math
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode
from helpers import refused

import quadrl
from quadrl import envs
from quadrl.tasks import TASKS
from quadrl.testing import varied_actions

IDS = {name: task.gymnasium_id() for name, task in TASKS.items()}
HOVER = "quadrl/Hover-v0"
HEAVY = dataclasses.replace(quadrl.Vehicle(), mass=1.3, control_timestep=0.02)
every_mode = pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.name)


def test_every_task_has_an_id():
    registered = dict(gym.registry)
    assert registered.keys() >= set(IDS.values())  # other tests add tasks of their own
    envs.register_ids()  # Gymnasium would warn of an id that is registered twice
    assert dict(gym.registry) == registered


def test_a_step_takes_and_returns_pythons_own_types_and_gives_an_info_of_scalars():
    environment = gym.make(HOVER)
    observation, info = environment.reset(seed=0)
    assert observation.dtype == np.float32
    assert info == {}
    for action in varied_actions(10, 1)[:, 0]:
        observation, reward, terminated, truncated, info = environment.step(action.tolist())
        assert observation.dtype == np.float32
        assert type(reward) is float
        assert type(terminated) is type(truncated) is bool
        terms = info["reward_terms"]
        assert set(info) == {"reward_terms", "is_success", "error", "diverged"}
        assert terms.keys() == environment.unwrapped.environment.term_names
        for name in ("is_success", "error", "diverged"):  # TorchRL reads nothing else
            assert isinstance(info[name], (np.generic, np.ndarray)) and info[name].shape == ()
        assert info["is_success"].dtype == info["diverged"].dtype == bool
        assert sum(terms.values()) == reward


def test_reward_terms_are_an_array_with_names():
    environment = gym.make(HOVER)
    environment.reset(seed=0)
    _, reward, _, _, info = environment.step(np.full(4, 0.1))
    vector = gym.make_vec(HOVER, num_envs=2)
    vector.reset(seed=0)
    _, rewards, _, _, infos = vector.step(np.full((2, 4), 0.1))
    names = environment.unwrapped.environment.term_names
    for terms, total in ((info["reward_terms"], reward), (infos["reward_terms"], rewards)):
        for same in (terms, pickle.loads(pickle.dumps(terms)), copy.deepcopy(terms)):
            assert tuple(same.keys()) == names
            np.testing.assert_allclose(same.sum(-1), total, rtol=1e-12)
            np.testing.assert_allclose(sum(same.values()), total, rtol=1e-12)
            for k, (name, term) in enumerate(same.items()):
                np.testing.assert_array_equal(same[name], np.asarray(terms)[..., k])
                np.testing.assert_array_equal(term, same[name])
    np.testing.assert_array_equal(infos["reward_terms"][0], info["reward_terms"])
    with pytest.raises(KeyError):
        info["reward_terms"]["bonus"]


def test_reward_terms_can_be_left_out():
    environment = gym.make(HOVER, reward_terms=False)
    environment.reset()
    assert "reward_terms" not in environment.step(np.zeros(4))[4]
    vector = gym.make_vec(HOVER, num_envs=2, reward_terms=False)
    vector.reset()
    assert not {"reward_terms", "_reward_terms"} & set(vector.step(np.zeros((2, 4)))[4])


def unnamed(value):
    """Reward terms as plain arrays: stacked by Gymnasium, they lose their names."""
    if isinstance(value, dict):
        return {name: unnamed(one) for name, one in value.items()}
    return np.asarray(value) if isinstance(value, np.ndarray) else value


@pytest.mark.slow
@every_mode
@pytest.mark.parametrize("name", ["hover", "landing"])
def test_the_vector_is_gymnasiums_own_vector_of_single_ones(name, mode):
    settings = {"time_limit": 2.4}
    ours = gym.make_vec(IDS[name], num_envs=4, autoreset_mode=mode, **settings)
    sync = {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": mode}}
    theirs = gym.make_vec(IDS[name], num_envs=4, **sync, **settings)
    assert ours.autoreset_mode == ours.metadata["autoreset_mode"] == mode
    for space in ("observation", "action", "single_observation", "single_action"):
        assert getattr(ours, f"{space}_space") == getattr(theirs, f"{space}_space")
    assert data_equivalence(ours.reset(seed=3), theirs.reset(seed=3))
    ends = 0
    for action in varied_actions(110, 4):
        *got, info = ours.step(action)
        *expected, their_info = theirs.step(action)
        assert data_equivalence(got, expected)
        # Where no row has something, Gymnasium's lacks the name, and ours masks every row.
        for key in set(info) - set(their_info):
            assert not info[key if key.startswith("_") else f"_{key}"].any()
        assert set(their_info) <= set(info)
        for key, value in their_info.items():
            given = tuple(info[key]) if key == "final_obs" else unnamed(info[key])
            assert data_equivalence(given, tuple(value) if key == "final_obs" else value), key
        over = got[2] | got[3]
        ends += over.sum()
        if mode == AutoresetMode.DISABLED and over.any():
            reset = [vector.reset(options={"reset_mask": over.copy()}) for vector in (ours, theirs)]
            assert data_equivalence(*reset)
    assert ends >= 8


def test_a_mask_resets_and_seeds_its_rows_alone():
    def second_start(seed):
        environment = gym.make(HOVER)
        environment.reset(seed=seed)
        return environment.reset()[0]

    vector = gym.make_vec(HOVER, num_envs=3, autoreset_mode="DISABLED")
    vector.reset(seed=0)
    met = vector.step(np.zeros((3, 4)))[0]
    mask = np.array([False, True, False])
    after, _ = vector.reset(seed=40, options={"reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], met[~mask])
    np.testing.assert_array_equal(after[1], gym.make(HOVER).reset(seed=41)[0])
    second, _ = vector.reset()
    np.testing.assert_array_equal(second[0], second_start(seed=0))
    np.testing.assert_array_equal(second[1], second_start(seed=41))


@pytest.mark.parametrize("mask", [np.zeros(3, dtype=bool), np.ones(2, dtype=bool), np.ones(3)])
def test_an_impossible_mask_is_refused(mask):
    vector = gym.make_vec(HOVER, num_envs=3, autoreset_mode="DISABLED")
    vector.reset()
    with refused("reset_mask"):
        vector.reset(options={"reset_mask": mask})


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
def test_vehicle_task_options_randomization_and_the_time_limit_arrive(make):
    drawn = {"mass": (0.92, 0.96)}
    settings = {"time_limit": 0.06} if make is gym.make else {"max_episode_steps": 3, "num_envs": 2}
    settings |= {"tolerance": 9.0, "heading_tolerance": math.pi}
    made = make(HOVER, vehicle=HEAVY, num_threads=1, randomization=drawn, **settings)
    core = made.unwrapped.environment
    assert core.vehicle.mass == 1.3
    assert core.task.tolerance == 9.0
    assert made.unwrapped.metadata["render_fps"] == 50
    made.reset(seed=0)
    assert (core.engine.parameters["mass"] != 1.3).all()
    flown = [made.step(np.zeros(made.action_space.shape)) for _ in range(3)]  # of 0.02 s
    assert [np.all(step[3]) for step in flown] == [False, False, True]
    # Success is reported at the end alone.
    assert [np.all(step[4]["is_success"]) for step in flown] == [False, False, True]


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (envs.gymnasium.QuadrotorEnv, "render_mode", "human"),
        (envs.gymnasium.make_one, "render_mode", "rgb"),
        (envs.gymnasium.QuadrotorEnv, "max_episode_steps", 0),
        (envs.gymnasium.QuadrotorVectorEnv, "autoreset_mode", "same"),
        (envs.gymnasium.QuadrotorVectorEnv, "num_envs", 0),
    ],
)
def test_an_impossible_setting_is_refused(kind, name, value):
    with refused(name, value):
        kind(**{name: value})


# ------------------------------------------------------------------------------------ pictures

PICTURE = {"render_mode": "rgb_array", "width": 160, "height": 96}
pictures = pytest.mark.usefixtures("cheap_pictures")


def alike(one, other):
    """Whether two pictures show the same; software rendering is off by a level here and there."""
    return np.abs(one.astype(int) - other).max() <= 8


@pictures
def test_render_draws_the_flight():
    environment = gym.make(HOVER, **PICTURE)
    environment.reset(seed=0)
    first = environment.render()
    assert first.shape == (96, 160, 3)
    assert first.dtype == np.uint8
    assert first.reshape(-1, 3).std(axis=0).min() > 5  # not blank
    assert alike(environment.render(), first)
    for _ in range(10):
        environment.step(np.ones(4, dtype=np.float32))
    assert not alike(environment.render(), first)
    environment.close()


@pictures
def test_the_goal_is_drawn():
    # Seen from where it does not move with the aircraft, the goal of hover is all that is green.
    environment = gym.make(HOVER, camera="fixed", **PICTURE | {"width": 480, "height": 288})
    environment.reset(seed=0)
    red, green, blue = environment.render().astype(int).reshape(-1, 3).T
    assert ((green > red + 20) & (green > blue + 20)).sum() > 5
    environment.close()


@pictures
def test_render_of_a_vector_has_a_picture_per_row():
    single, vector = gym.make(HOVER, **PICTURE), gym.make_vec(HOVER, num_envs=2, **PICTURE)
    single.reset(seed=4)
    vector.reset(seed=3)
    frames = vector.render()
    assert len(frames) == 2
    assert alike(frames[1], single.render())
    assert not alike(*frames)
    single.close()
    vector.close()
