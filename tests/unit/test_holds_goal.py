"""Policies that hold the goal: there their mean action is to hover, whatever the weights."""

import numpy as np
import pytest
import torch
from helpers import begun, refused
from runs import assert_same_run, changed, disturbed, stopped, train
from tensordict import TensorDict

from quadrl.learning.config import TrainConfig
from quadrl.learning.environments import make_env
from quadrl.learning.goal import goal_state
from quadrl.learning.networks import make_actor_critic
from quadrl.learning.numpy_policy import export

HELD = ("hover", "static_waypoint", "random_waypoint")


def some_policy(task, **settings):
    """Of weights that nobody has trained, with a normaliser that has seen something; its actor."""
    config = TrainConfig(task, holds_goal=True, **settings)
    environment = make_env(config, torch.device("cpu")).environment
    torch.manual_seed(0)
    actor, _, normalisers = make_actor_critic(environment.size, environment.action_size, config)
    seen = 0.3 + torch.rand(50, environment.size)
    normalisers["observation"].update(seen)
    own = {"vehicle_options": config.conditions["vehicle_options"]}
    return export(disturbed(actor), task, own), actor


def at_rest(environment, goal, yaw):
    """Begin at a goal with a heading."""
    rest = {"velocity": np.zeros(3), "body_rate": np.zeros(3)}
    rest["rotor_speed"] = environment.vehicle.hover_speed
    attitude = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    return environment.flatten(
        environment.reset(start=rest | {"position": goal, "quaternion": attitude})
    )


@pytest.mark.slow
@pytest.mark.parametrize("task", HELD)
def test_at_the_goal_it_hovers_and_stays(task):
    policy, _ = some_policy(task)
    environment = begun(task, 3, seed=1, engine="free_flight")
    goals = environment.goals() - environment.origin
    environment.seed(1)
    seen = at_rest(environment, goals, 0.0 if environment.task.heading_matters else 2.0)
    np.testing.assert_allclose(policy(seen), 0, atol=2e-6)
    away = policy(seen + np.float32(0.1))
    assert np.abs(away).max() > 0.01
    for _ in range(20):
        seen = environment.flatten(environment.step(policy(seen)).observation)
    np.testing.assert_allclose(environment.engine.qpos[:, :3], environment.goals(), atol=1e-4)


def test_errors_of_a_sensor_do_not_move_the_goal():
    exact, noisy = (
        goal_state(TrainConfig("hover", observe={"sensors": {"airspeed": errors}}))
        for errors in ({}, {"noise": 0.5, "bias": 0.2})
    )
    np.testing.assert_array_equal(exact.seen, noisy.seen)
    np.testing.assert_array_equal(exact.looks, noisy.looks)


@pytest.mark.parametrize("variant", ["ideal", "robust"])
def test_its_file_is_a_plain_network(variant):
    assert_the_same_function(*some_policy("hover", variant=variant))


def test_so_is_that_of_one_that_holds_the_goal_state_several_tasks():
    assert_the_same_function(*some_policy("all", hidden=(16, 12)), flags=6)


def assert_the_same_function(policy, actor, flags=0):
    """Hold a file against its actor, at observations of which each is of one of some tasks."""
    seen = torch.randn(30, policy.size)
    if flags:
        seen[:, -flags:] = torch.eye(flags).repeat(30 // flags, 1)
    with torch.no_grad():
        mean = actor.get_dist(TensorDict({"observation": seen}, [30])).mean.numpy()
    assert 0.01 < np.abs(mean).max()
    np.testing.assert_allclose(policy(seen.numpy()), np.clip(mean, -1, 1), atol=1e-5)


def test_where_the_heading_is_free_it_flies_the_same_in_every_direction():
    policy, _ = some_policy("random_waypoint")
    environment = begun("random_waypoint", 2)
    goal = environment.goals()[0] - environment.origin
    turned = np.array([-goal[1], goal[0], goal[2]])
    # A quarter turn about the vertical through the goal: all that it sees turns with it.
    place = [goal + (0.4, -0.2, 0.3), turned + (0.2, 0.4, 0.3)]
    seen = []
    for k, yaw in enumerate((0.3, 0.3 + np.pi / 2)):
        environment.seed(0)
        flat = at_rest(environment, place[k], yaw)[0]
        flat[-3:] = 0.1, 0.2, 0.3  # the way to the goal, in the body frame: the same for both
        seen.append(flat)
    assert np.abs(seen[0] - seen[1]).max() > 0.1
    np.testing.assert_allclose(*policy(np.array(seen)), atol=1e-6)


def test_it_is_trained_and_continued_bit_for_bit(tmp_path):
    config = changed(holds_goal=True)
    stopped(config, tmp_path / "begun", after=3)
    train(config, tmp_path / "begun", resume=True)
    assert_same_run(train(config, tmp_path / "whole"), tmp_path / "begun")


@pytest.mark.parametrize("task", ["straight_and_level", "target_following"])
def test_a_task_without_one_goal_state_is_refused(task):
    with refused("holds_goal", match="target_velocity"):
        some_policy(task)


def test_of_several_tasks_those_that_stay_at_a_goal_look_alike():
    goal = goal_state(TrainConfig("all"))
    place = begun("all", 1, observe=TrainConfig("all").scenario.observe).layout["standard"]
    flags = [*range(place.start + 3, place.stop)]
    # hover, static_waypoint and random_waypoint: targets of the others move, or it is a pad.
    assert goal.others == tuple(flags[3:])
    assert not goal.looks[flags[:3]].any() and goal.looks[flags[3:]].all()
    assert not goal.seen[flags[3:]].any()


def test_it_holds_the_goal_of_each_task_by_that_tasks_own_name():
    policy, _ = some_policy("all", hidden=(16, 12))
    for task in HELD:
        environment = begun(
            task, 3, engine="free_flight", observe=TrainConfig("all").scenario.observe
        )
        goals = environment.goals() - environment.origin
        environment.seed(0)
        seen = at_rest(environment, goals, 0.0)
        np.testing.assert_allclose(policy(seen), 0, atol=2e-6)
        assert np.abs(policy(seen + np.eye(1, policy.size, 9, dtype=np.float32))).max() > 0.01


def test_several_tasks_that_stay_nowhere_are_refused():
    members = ["straight_and_level", "landing"]
    with refused("holds_goal", match="no task of one_of stays at a goal"):
        some_policy("one_of", task_options={"members": members})
