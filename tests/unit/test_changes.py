"""Options that are changed later: done everywhere from the next reset, or refused."""

import copy
import importlib
import pickle

import gymnasium as gym
import helpers
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import RecordEpisodeStatistics
from helpers import refused

import quadrl
from quadrl.core.environment import Environment
from quadrl.envs import sb3
from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.tasks.hover import Hover

HOVER = "quadrl/Hover-v0"
NEAR = {"radius": 0.1, "tilt": 0.0, "speed": 0.0, "spin": 0.0}
COUNT = 64


def farthest(environment):
    """How far from the goal the episodes begin [m]."""
    return environment.snapshot.potentials.distance.max()


MAKERS = {
    "environment": lambda: Environment("hover", num_envs=COUNT, seed=0, **NEAR),
    "gymnasium": lambda: gym.make_vec(HOVER, num_envs=COUNT, **NEAR),
    "torchrl": lambda: QuadrotorEnv("hover", COUNT, **NEAR),
    "sb3": lambda: sb3.QuadrotorVecEnv("hover", COUNT, **NEAR),
    "rsl_rl": lambda: importlib.import_module("quadrl.envs.rsl_rl").QuadrotorVecEnv(
        "hover", COUNT, **NEAR
    ),
}


@pytest.mark.parametrize("name", MAKERS)
def test_every_batch_begins_as_it_was_changed_and_not_before_a_reset(name):
    if name == "rsl_rl":
        pytest.importorskip("rsl_rl")
    made = MAKERS[name]()
    core = getattr(made, "environment", made)
    made.reset()
    assert farthest(core) <= 0.1 and core.time_limit_steps == 200
    made.change(radius=1.0, time_limit=0.3)
    with pytest.raises(RuntimeError, match="reset"):
        core.step(np.zeros((COUNT, 4)))
    with pytest.raises(RuntimeError, match="reset"):
        core.reset(np.array([0]))
    made.reset()
    assert 0.8 < farthest(core) <= 1.0  # of 64 draws
    for _ in range(6):
        done = helpers.idle(core)
    assert done.truncated.all() and core.time_limit_steps == 6
    if name == "rsl_rl":
        assert made.max_episode_length == 6 and made.cfg.task.radius == 1.0


@pytest.mark.slow
def test_vectors_of_single_ones_too():
    for mode in ("sync", "async"):
        envs = gym.make_vec(HOVER, num_envs=2, vectorization_mode=mode, **NEAR)
        envs.reset(seed=0)
        envs.set_attr("radius", [0.0, 1.0])
        assert envs.get_attr("radius") == (0.0, 1.0)
        observation, _ = envs.reset(seed=0)
        distance = np.linalg.norm(observation[:, :3], axis=1)
        assert distance[0] == 0.0 and distance[1] > 0.1
        envs.call("change", tilt=1.0)
        assert envs.get_attr("tilt") == (1.0, 1.0)
        envs.close()


def test_the_one_of_dm_control_too_but_for_what_its_physics_were_made_of():
    helpers.needs_dm_control()
    from quadrl.envs import dm_control

    control = dm_control.make("hover", random=1, **NEAR)
    control.reset()
    control.task.change(radius=1.0)
    expected = Environment("hover", seed=1, **NEAR | {"radius": 1.0})
    expected.reset()
    begun = control.reset().observation["position"]
    np.testing.assert_array_equal(begun, expected.reset()["position"][0])
    assert control.step(np.zeros(4)).reward is not None
    for other in ({"vehicle": "crazyflie"}, {"task": "landing"}, {"altitude": 9.0}):
        with refused("change"):
            control.task.change(**other)


def test_an_attribute_is_an_option_or_an_error():
    """Through wrappers, of vectors, and of what is inside."""
    single = RecordEpisodeStatistics(gym.make(HOVER, **NEAR))
    single.set_wrapper_attr("radius", 0.7)
    assert single.unwrapped.environment.task.radius == 0.7
    assert single.get_wrapper_attr("radius") == 0.7 and "radius" not in vars(single)
    single.unwrapped.task = Hover(radius=0.2)
    assert single.unwrapped.task.radius == 0.2 == single.unwrapped.radius
    batch, tensors = MAKERS["sb3"](), MAKERS["torchrl"]()
    batch.set_attr("radius", 0.6)
    assert batch.get_attr("radius") == [0.6] * COUNT
    tensors.weather = "light"
    assert not tensors.environment.weather.calm
    core = tensors.environment
    core.reset()
    for name, value in (("task", Hover()), ("radius", 1.0), ("weather", "calm"), ("vehicle", 1)):
        with refused(name, match=f"change\\({name}="):
            setattr(core, name, value)
    for wrong in ({"radius": "far"}, {"radios": 1.0}, {"control_mode": "velocity", "radius": 2.0},
                  {"control_timestep": 0.1}, {"task": "race"}):  # fmt: skip
        before = core.save(), core.task
        with pytest.raises(quadrl.base.errors.QuadrlError):
            core.change(**wrong)
        assert core.task is before[1]
        for key, array in core.save().items():
            np.testing.assert_array_equal(array, before[0][key])
    with pytest.raises(AttributeError, match="radios"):
        _ = single.unwrapped.radios


def test_what_was_changed_is_copied_and_goes_on_with_its_seeds():
    one, other = MAKERS["environment"](), Environment("hover", num_envs=COUNT, seed=0)
    one.reset()
    one.change(**{name: getattr(Hover, name) for name in NEAR})
    other.reset()
    copies = copy.deepcopy(one), pickle.loads(pickle.dumps(one)), one
    expected = other.reset()["goal"]
    for each in copies:
        np.testing.assert_array_equal(each.reset()["goal"], expected)


# ------------------------------------------------------------------------- max_episode_steps


def flown(env, crash=False):
    """Steps of an episode, whether it was a success, and its flags."""
    batch = hasattr(env, "num_envs")
    env.reset(seed=0)
    action = np.full(env.action_space.shape, -1.0 if crash else 0.0)
    for step in range(1, 500):
        _, _, *over, info = env.step(action)
        over = [np.all(flag) for flag in over]
        if any(over):
            done = info["is_success"]
            return step, bool(np.all(done)) if batch else bool(done), *over
    raise AssertionError("no end")


EASY = NEAR | {"tolerance": 9.0, "heading_tolerance": 4.0}  # the aircraft hovers by itself


@pytest.mark.parametrize("steps", [7, 250])
def test_max_episode_steps_means_the_same_wherever_it_is_given(steps):
    given = {"max_episode_steps": steps} | EASY
    plain = gym.make(HOVER, **EASY)
    made = [
        gym.make(HOVER, **given),
        gym.spec(HOVER).make(**given),
        plain.spec.make(max_episode_steps=steps),
        gym.make(EnvSpec.from_json(gym.make(HOVER, **given).spec.to_json())),
        RecordEpisodeStatistics(gym.make(HOVER, disable_env_checker=False, **given)),
        *(gym.make_vec(HOVER, num_envs=2, vectorization_mode=x, **given) for x in (None, "sync")),
    ]
    for env in made:
        assert flown(env) == (steps, True, False, True)
    for env in made[:-1]:
        assert env.spec.max_episode_steps == steps
        assert env.unwrapped.environment.time_limit_steps == steps
    assert made[3].spec.make().spec.max_episode_steps == steps
    assert flown(plain)[0] == 200


def test_a_crash_on_the_last_step_is_a_crash_whoever_set_the_limit():
    falls = {"max_distance": 0.5, "radius": 0.0, "speed": 0.0, "spin": 0.0, "tilt": 0.0}
    last = flown(gym.make(HOVER, **falls), crash=True)[0]
    assert 2 < last < 100
    for steps, over in ((last, (True, False)), (last - 1, (False, True))):
        env = gym.make(HOVER, max_episode_steps=steps, **falls)
        assert flown(env, crash=True) == (steps, False, *over)


def test_the_limit_of_stable_baselines_and_of_torchrl():
    from stable_baselines3.common.env_util import make_vec_env
    from torchrl.envs import GymEnv

    envs = make_vec_env(HOVER, 2, env_kwargs={"max_episode_steps": 7} | EASY)
    envs.seed(0)
    envs.reset()
    for step in range(1, 8):
        *_, done, info = envs.step(np.zeros((2, 4)))
        assert done.all() == (step == 7)
    assert all(one["TimeLimit.truncated"] and one["is_success"] for one in info)
    rollout = GymEnv(HOVER, max_episode_steps=7, **EASY).rollout(
        20, lambda observation: torch.zeros(4)
    )
    assert rollout.shape == (7,) and bool(rollout["next", "truncated"][-1])


@pytest.mark.parametrize("steps", [0, 2.5, "many"])
def test_an_impossible_limit_is_refused(steps):
    with pytest.raises((ValueError, TypeError), match="max_episode_steps"):
        gym.make(HOVER, max_episode_steps=steps)
