"""Rollouts: the episodes that are flown, and the metrics of them."""

import dataclasses
import json
import math

import numpy as np
import pytest
from runs import refused

from quadrl import tasks
from quadrl.aircraft.vehicle import Vehicle
from quadrl.core.environment import Environment
from quadrl.engines.mujoco import MAX_ENVS
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.rollout import EVALUATION_SEED, Rollout, fly, summarize
from quadrl.learning.config import MAX_SEED
from quadrl.learning.environments import SEED_STRIDE


def brake(observation: np.ndarray) -> np.ndarray:
    """A controller without a matrix product, whose rounding depends on the number of rows."""
    return np.tanh(0.3 * observation[..., 0:4] - 0.2 * observation[..., 9:13])


def make_rollout(**changes) -> Rollout:
    """Three aircraft over 5 s of 100 steps: one to the end, one crashed, one done early."""
    steps, episodes = 100, 3
    length = np.array([100, 20, 60])
    number = np.arange(steps)[:, None]
    flown = number < length
    error = np.where(number < length - 40, 9.0, [0.1, 0.2, 0.6]) * np.where(flown, 1, np.nan)
    nothing = {
        name: np.zeros((steps, episodes, k))
        for name, k in (("position", 3), ("quaternion", 4), ("velocity", 3), ("body_rate", 3),
                        ("rotor_speed", 4), ("goal", 3), ("action", 4), ("wind", 3))
    }  # fmt: skip
    values = dict(
        error=error,
        reward=np.where(flown, [1.0, -2.0, 0.5], np.nan),
        length=length,
        terminated=np.array([False, True, True]),
        is_success=np.array([False, False, True]),
        diverged=np.array([False, True, False]),
        markers=(),
        origin=np.array([0.0, 0.0, 3.0]),
        control_timestep=0.05,
        task=tasks.make("hover"),
    )
    return Rollout(**{**nothing, **values, **changes})


def test_metrics_by_hand():
    metrics = summarize(make_rollout())
    # The last 2 s are 40 steps. The first aircraft: 0.1; the second flew for 20 steps, all of
    # them 0.2; the third: 0.6. Mean: 0.3.
    assert metrics["position_error_m"] == pytest.approx(0.3)
    # Returns: 100 * 1, 20 * -2, 60 * 0.5 = 100, -40, 30: mean 30, deviation sqrt(9800 / 3).
    assert metrics["return_mean"] == pytest.approx(30.0)
    assert metrics["return_std"] == pytest.approx(math.sqrt(9800 / 3))
    assert metrics["success_rate"] == pytest.approx(1 / 3)
    # The second crashed; the third was over early, but by success.
    assert metrics["survival_rate"] == pytest.approx(2 / 3)
    assert metrics["length_mean_s"] == pytest.approx(3.0)  # (5 + 1 + 3) / 3
    assert metrics["episodes"] == 3
    assert metrics["diverged"] == 1
    json.dumps(metrics, allow_nan=False)


def test_heading_error_by_hand():
    """Yaw 10, -30 and 90 degrees; the first only in the last 2 s, turned about before."""
    half = np.radians([10.0, -30.0, 90.0]) / 2
    quaternion = np.zeros((100, 3, 4))
    quaternion[..., 0], quaternion[..., 3] = np.cos(half), np.sin(half)
    quaternion[:60, 0] = [0.0, 0.0, 0.0, 1.0]
    quaternion[60:, 2] = np.nan  # over since
    metrics = summarize(make_rollout(quaternion=quaternion))
    assert metrics["heading_error_deg"] == pytest.approx((10 + 30 + 90) / 3)
    free = make_rollout(quaternion=quaternion, task=tasks.make("random_waypoint"))
    assert "heading_error_deg" not in summarize(free)


def test_an_error_before_the_last_two_seconds_does_not_count():
    rollout = make_rollout()
    early, late = rollout.error.copy(), rollout.error.copy()
    early[59, 0], late[60, 0] = 1000.0, 4.1  # 40 steps before the end is 60
    assert summarize(make_rollout(error=early))["position_error_m"] == pytest.approx(0.3)
    # One of 40 is 4 m larger: 0.1 on the first aircraft, a third of it in the mean.
    assert summarize(make_rollout(error=late))["position_error_m"] == pytest.approx(0.3 + 0.1 / 3)


@pytest.mark.parametrize("weather", ["calm", "light"])
def test_episode_i_is_the_single_environment_of_its_seed(weather):
    rollout = fly(brake, "hover", episodes=4, seed=EVALUATION_SEED + 7, weather=weather)
    assert np.nan_to_num(rollout.wind).any() == (weather == "light")
    for i in range(4):
        alone = Environment("hover", seed=EVALUATION_SEED + 7 + i, weather=weather)
        observation = alone.flatten(alone.reset())
        for t in range(rollout.length[i]):
            now = alone.step(brake(observation))
            observation = alone.flatten(now.observation)
            assert now.reward[0] == rollout.reward[t, i] and now.error[0] == rollout.error[t, i]
            position = alone.snapshot.state.position[0]
            np.testing.assert_array_equal(position, rollout.position[t, i])
            np.testing.assert_array_equal(alone.engine.wind[0], rollout.wind[t, i])
        assert now.terminated[0] == rollout.terminated[i]
        assert now.terminated[0] or now.truncated[0]
        for after in (rollout.reward, rollout.wind):
            assert np.isnan(after[rollout.length[i] :, i]).all()


def test_an_evaluation_is_the_same_every_time_and_another_with_another_seed():
    task = tasks.make("hover", time_limit=1.0)
    one, other = (evaluate(brake, task, episodes=5) for _ in range(2))
    assert one.metrics == other.metrics
    assert one.metrics["task"] == "hover" and one.metrics["seed"] == 0
    first, second = one.rollout, other.rollout
    for field in dataclasses.fields(Rollout):
        if isinstance(value := getattr(first, field.name), np.ndarray):
            np.testing.assert_array_equal(value, getattr(second, field.name))
    fresh = evaluate(brake, task, episodes=5, seed=5).rollout
    assert (fresh.position[0] != first.position[0]).all()


def test_evaluation_episodes_are_none_of_the_trainings():
    # Row seeds of a training: seed * 2^20 + i, with up to 2^20 aircraft.
    assert SEED_STRIDE == MAX_ENVS == 2**20
    assert EVALUATION_SEED >= (MAX_SEED + 1) * 2**20
    assert MAX_SEED == 2**32 - 1


def test_a_trajectory_is_in_the_world_frame():
    vehicle = Vehicle()
    rollout = fly(brake, "hover", episodes=2, vehicle=vehicle)
    trajectory, steps = rollout.trajectory(vehicle, 1), rollout.length[1]
    assert len(trajectory.time) == steps
    assert trajectory.time[[0, -1]] == pytest.approx([0.05, 0.05 * steps])
    up = [0, 0, 3]  # the task's altitude
    np.testing.assert_allclose(trajectory.qpos[:, :3], rollout.position[:steps, 1] + up)
    np.testing.assert_allclose(trajectory.goal, np.tile(up, (steps, 1)))
    np.testing.assert_array_equal(trajectory.max_rotor_speed, vehicle.max_speed)
    assert trajectory.task == "hover"


@pytest.mark.parametrize(
    ("change", "name", "value"),
    [
        ({"episodes": 0}, "episodes", 0),
        ({"episodes": 10**6}, "episodes", 10**6),
        ({"seed": -1}, "seed", -1),
        ({"seed": 2**32}, "seed", 2**32),
        ({"seed": 0.5}, "seed", 0.5),
        ({"vehicle": "brick"}, "vehicle", "brick"),
    ],
)
def test_evaluations_that_cannot_be(change, name, value):
    with refused(name, value):
        evaluate(brake, tasks.make("hover"), **{"episodes": 1, **change})


def test_actions_with_another_meaning_are_refused():
    class Hovering:
        control_mode = "velocity"

        def __call__(self, observation):
            return np.zeros((len(observation), 4))

    rollout = fly(Hovering(), tasks.make("hover", time_limit=0.5), episodes=1)
    assert rollout.length == [10]
    with refused("control_mode", "rotor"):
        fly(Hovering(), "hover", episodes=1, control_mode="rotor")
    with refused("weather", "windy"):
        fly(Hovering(), "hover", episodes=1, weather="windy")
