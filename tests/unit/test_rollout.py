"""Rollouts: the episodes that are flown, and the metrics of them."""

import csv
import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from helpers import begun, refused

import quadrl
from quadrl import tasks
from quadrl.aircraft.vehicle import Vehicle
from quadrl.core.environment import Environment
from quadrl.engines.mujoco import MAX_ENVS
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.rollout import EVALUATION_SEED, MAX_SEED, Rollout, flights, fly, summarize
from quadrl.learning.environments import SEED_STRIDE
from quadrl.tasks.hover import Hover


def brake(observation: np.ndarray) -> np.ndarray:
    """A controller without a matrix product, whose rounding depends on the number of rows."""
    return np.tanh(0.3 * observation[..., 0:4] - 0.2 * observation[..., 9:13])


STATES = "position quaternion velocity body_rate rotor_speed goal target_velocity".split()


def make_rollout(**changes) -> Rollout:
    """Three aircraft over 5 s of 100 steps: one to the end, one crashed, one done early.

    States are given as after the steps; before them is a start of no numbers, which counts nowhere.
    """
    steps, episodes = 100, 3
    length = np.array([100, 20, 60])
    number = np.arange(steps)[:, None]
    flown = number < length
    error = np.where(number < length - 40, 9.0, [0.1, 0.2, 0.6]) * np.where(flown, 1, np.nan)
    nothing = {
        name: np.zeros((steps, episodes, k))
        for name, k in (("position", 3), ("quaternion", 4), ("velocity", 3), ("body_rate", 3),
                        ("rotor_speed", 4), ("goal", 3), ("target_velocity", 3), ("action", 4),
                        ("rotor_command", 4), ("wind", 3))
    }  # fmt: skip
    values = dict(
        error=error,
        reward=np.where(flown, [1.0, -2.0, 0.5], np.nan),
        length=length,
        terminated=np.array([False, True, True]),
        is_success=np.array([False, False, True]),
        diverged=np.array([False, True, False]),
        remembered={},
        ended={},
        reward_terms={},
        markers=(),
        events=(),
        origin=np.array([0.0, 0.0, 3.0]),
        control_timestep=0.05,
        task=tasks.make("hover"),
    )
    made = {**nothing, **values, **changes}
    for name in STATES:
        made[name] = np.concatenate([np.full_like(made[name][:1], np.nan), made[name]])
    return Rollout(**made)


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


SECONDS = 0.05 * np.arange(1, 101)[:, None]  # (100, 1) [s]


def turning(yaw_rate: float, radius: float, rate: float, **changes) -> Rollout:
    """Three aircraft on circles, turning: to the end, crashed after 1 s, done after 3 s."""
    angle = rate * SECONDS + [0.0, 1.0, 2.0]
    level = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    velocity = radius * rate * np.stack([-level[..., 1], level[..., 0], level[..., 2]], -1)
    body_rate = np.broadcast_to([9.0, -9.0, yaw_rate], velocity.shape)
    moved = {"position": radius * level, "velocity": velocity, "body_rate": body_rate}
    return make_rollout(**moved | changes)


@pytest.mark.parametrize("sign", [1, -1])
def test_who_turns_and_circles_is_seen_although_the_place_is_held(sign):
    """4.6 rad/s about z; 0.1 m around the goal at 1.2 rad/s are 0.12 m/s, beside a target, too."""
    metrics = summarize(turning(4.6 * sign, 0.1, 1.2 * sign))
    assert metrics["yaw_rate_rad_s"] == pytest.approx(4.6)
    assert metrics["circling_m_s"] == pytest.approx(0.12)
    beside = turning(4.6, 0.1, 1.2)
    along = np.broadcast_to([2.0, 0.0, 0.0], beside.velocity.shape)
    together = dataclasses.replace(
        beside, velocity=beside.velocity + along, target_velocity=along,
        task=tasks.make("target_following"),
    )  # fmt: skip
    assert summarize(together)["circling_m_s"] == pytest.approx(0.12)
    for task in ("straight_and_level", "landing"):  # they go somewhere
        assert "circling_m_s" not in flights(dataclasses.replace(beside, task=tasks.make(task)))


def test_only_the_last_two_seconds_turn_and_who_has_failed_does_not_count():
    body_rate = np.zeros((100, 3, 3))
    body_rate[:60, 0, 2] = 50.0  # before the last 2 s of 5 s
    body_rate[60:, 0, 2], body_rate[20:60, 2, 2] = 0.2, -0.4
    body_rate[:, 1, 2] = 30.0  # crashed: it tumbles
    each = flights(make_rollout(body_rate=body_rate))["yaw_rate_rad_s"]
    np.testing.assert_allclose(each, [0.2, 30.0, 0.4])
    assert summarize(make_rollout(body_rate=body_rate))["yaw_rate_rad_s"] == pytest.approx(0.3)
    none = make_rollout(body_rate=body_rate, terminated=np.ones(3, bool), is_success=0 > each)
    assert summarize(none)["yaw_rate_rad_s"] == pytest.approx((0.2 + 30.0 + 0.4) / 3)


def test_commands_and_heights_by_hand():
    """Rotor 1 of 4 goes 0.2 up and down, the others stand: 0.05 a step. Two of four actions are at
    their ends in 10 of the 100 steps of the first: 5 %; the others have shorter flights."""
    command, action, position = (np.zeros((100, 3, k)) for k in (4, 4, 3))
    command[::2, :, 0] = 0.2
    action[:10, 0, :2], action[:20, 1] = [1.0, -1.0], 1.0
    position[40, 0, 2], position[5, 1, 2], position[70:, 2, 2] = -1.25, -2.9, np.nan
    for array in (command, action, position):
        array[np.arange(100)[:, None] >= make_rollout().length] = np.nan
    rollout = make_rollout(rotor_command=command, action=action, position=position)
    each = flights(rollout)
    np.testing.assert_allclose(each["command_change_rate"], [0.05] * 3)
    np.testing.assert_allclose(each["saturated_rate"], [0.05, 1.0, 0.0])
    np.testing.assert_allclose(each["least_height_m"], [1.75, 0.1, 3.0])  # the origin is 3 m up
    metrics = summarize(rollout)  # without the second, which crashed
    assert metrics["saturated_rate"] == pytest.approx(0.025)
    assert metrics["least_height_m"] == pytest.approx(1.75)
    once = make_rollout(length=np.ones(3, int), rotor_command=command)
    assert (flights(once)["command_change_rate"] == 0).all()
    json.dumps(metrics, allow_nan=False)


def test_a_task_is_not_solved_by_who_turns_or_circles():
    turned = {"hover": 2, "static_waypoint": 2, "random_waypoint": 2, "straight_and_level": 1,
              "target_following": 2, "landing": 1}  # fmt: skip
    for name, count in turned.items():
        targets = tasks.TASKS[name].targets
        still = [x for x in targets if x.metric in ("yaw_rate_rad_s", "circling_m_s")]
        assert len(still) == count and {x.metric: x.limit for x in still}["yaw_rate_rad_s"] == 0.3
        stands = summarize(turning(0.29, 0.1, 0.49) if count == 2 else turning(0.29, 0, 0))
        assert all(target.met(stands) for target in still)
        spins = summarize(turning(-4.6, 0.1, 1.2))
        assert not any(target.met(spins) for target in still)
        assert not any(x.met({}) or x.met({x.metric: None}) for x in targets)


def at(alone, rollout, t, i):
    """Check that a single environment is in state t of flight i."""
    velocity = alone.task.target_velocity(alone.snapshot)
    for name, value in (
        ("position", alone.snapshot.state.position),
        ("rotor_speed", alone.snapshot.state.rotor_speed),
        ("goal", alone.task.goal(alone.snapshot)),
        ("target_velocity", np.zeros((1, 3)) if velocity is None else velocity),
    ):
        np.testing.assert_array_equal(getattr(rollout, name)[t, i], value[0], err_msg=name)


@pytest.mark.parametrize(
    ("task", "settings"),
    [
        ("hover", {}),
        ("hover", {"weather": "light"}),
        ("target_following", {"control_mode": "velocity"}),
    ],
)
def test_episode_i_is_the_single_environment_of_its_seed(task, settings):
    rollout = fly(brake, task, episodes=4, seed=EVALUATION_SEED + 7, **settings)
    assert np.nan_to_num(rollout.wind).any() == ("weather" in settings)
    assert 0 < np.nanmin(rollout.rotor_command) and np.nanmax(rollout.rotor_command) <= 1
    for i in range(4):
        alone = Environment(task, seed=EVALUATION_SEED + 7 + i, **settings)
        observation = alone.flatten(alone.reset())
        at(alone, rollout, 0, i)
        for t in range(rollout.length[i]):
            now = alone.step(brake(observation))
            observation = alone.flatten(now.observation)
            assert now.reward[0] == rollout.reward[t, i] and now.error[0] == rollout.error[t, i]
            at(alone, rollout, t + 1, i)
            for name, value in (
                ("rotor_command", alone.snapshot.rotor_command / alone.vehicle.max_speed),
                ("wind", alone.engine.wind),
            ):
                np.testing.assert_array_equal(getattr(rollout, name)[t, i], value[0], err_msg=name)
        assert now.terminated[0] == rollout.terminated[i]
        assert now.terminated[0] or now.truncated[0]
        for after in (rollout.reward, rollout.wind):
            assert np.isnan(after[rollout.length[i] :, i]).all()


def test_what_a_task_remembers_is_kept():
    route = tasks.make("static_waypoint", waypoints=((0, 0, 0.3), (0, 0, 3)), reach=0.25)
    rollout = fly(lambda seen: np.ones((len(seen), 4)), route, episodes=2, seed=3)
    alone = begun(route, seed=4)
    for t in range(rollout.length[1]):
        alone.step(np.ones((1, 4)))
        for name in ("goal", "leg"):
            expected = getattr(alone.snapshot.task, name)[0]
            np.testing.assert_array_equal(rollout.remembered[name][t, 1], expected)
    assert set(rollout.remembered["leg"][: rollout.length[1], 1]) == {0.0, 1.0}
    for name in ("goal", "leg"):
        kept = rollout.remembered[name]
        assert all(np.isnan(kept[rollout.length[i] :, i]).all() for i in range(2))


def test_evaluation_episodes_are_none_of_the_trainings():
    # Row seeds of a training: seed * 2^20 + i, with up to 2^20 aircraft.
    assert SEED_STRIDE == MAX_ENVS == 2**20
    assert EVALUATION_SEED >= (MAX_SEED + 1) * 2**20
    assert MAX_SEED == 2**32 - 1


def test_a_trajectory_is_in_the_world_frame():
    vehicle = Vehicle()
    rollout = fly(brake, "hover", episodes=2, vehicle=vehicle)
    trajectory, steps = rollout.trajectory(vehicle), rollout.length[0]
    assert len(trajectory.time) == steps
    assert trajectory.time[[0, -1]] == pytest.approx([0.05, 0.05 * steps])
    up = [0, 0, 3]  # the task's altitude
    np.testing.assert_allclose(trajectory.qpos[:, :3], rollout.position[1 : steps + 1, 0] + up)
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
    ],
)
def test_evaluations_that_cannot_be(change, name, value):
    with refused(name, value):
        evaluate(brake, tasks.make("hover"), **{"episodes": 1, **change})
    with refused("controller", 3):
        evaluate(3)
    with refused("task"):
        evaluate(brake)


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


@pytest.mark.slow
def test_a_torch_module_flies_as_the_arrays_that_it_was_made_of():
    policy = quadrl.Policy.pretrained("hover")
    own = quadrl.evaluate(policy, episodes=2)
    for module in (policy.to_torch(), policy.to_torch().double()):  # with parameters that learn
        found = quadrl.evaluate(module, "hover", episodes=2)
        np.testing.assert_allclose(found.rollout.action, own.rollout.action, atol=1e-4)
    with refused(match="action"):
        quadrl.evaluate(torch.nn.GRU(22, 4, batch_first=True), "hover", episodes=2)


def test_states_are_a_row_per_control_step_from_the_start_on(tmp_path):
    found = quadrl.evaluate("geometric", "hover", episodes=2, seed=3, vehicle="hexa", time_limit=1)
    with open(found.save_states(tmp_path / "states.csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    flown, length = found.rollout, found.rollout.length
    assert len(rows) == length.sum() + 2
    names = "episode seed time x y z qw qx qy qz vx vy vz wx wy wz".split()
    names += [f"rotor_{k}" for k in range(1, 7)] + ["goal_x", "goal_y", "goal_z"]
    assert list(rows[0]) == names + [f"action_{k}" for k in range(1, 7)]
    second = rows[length[0] + 1 :]
    assert [row["seed"] for row in second] == ["4"] * (length[1] + 1)
    for t, row in enumerate(second):
        assert float(row["time"]) == pytest.approx(t * flown.control_timestep)
        for name, value in (
            ("x", flown.position[t, 1, 0]),
            ("qz", flown.quaternion[t, 1, 3]),
            ("vy", flown.velocity[t, 1, 1]),
            ("wx", flown.body_rate[t, 1, 0]),
            ("rotor_6", flown.rotor_speed[t, 1, 5]),
            ("goal_z", flown.goal[t, 1, 2]),
        ):
            assert float(row[name]) == pytest.approx(value, rel=1e-8, abs=1e-12)
    assert float(second[0]["action_2"]) == pytest.approx(flown.action[0, 1, 1], rel=1e-8)
    assert second[-1]["action_2"] == ""


@pytest.mark.slow
def test_each_flight_ends_in_one_way_and_the_terms_add_up_to_its_reward():
    options = {"max_distance": 0.6, "altitude": 0.5, "time_limit": 1.5, "radius": 0.2}
    generator = np.random.default_rng(0)

    def some_dive(seen):
        return np.where(np.arange(60)[:, None] < 20, -1.0, generator.uniform(-1, 1, (60, 4)))

    flown = fly(some_dive, tasks.make("hover", **options), episodes=60, seed=3)
    ends = np.array([*flown.ended.values()])
    np.testing.assert_array_equal(ends.sum(0), 1)
    assert {"away", "ground"} <= {name for name, holds in flown.ended.items() if holds.any()}
    np.testing.assert_array_equal(flown.ended["time_limit"], ~flown.terminated)
    last, rows = flown.length, np.arange(60)
    place = flown.position[last, rows]
    away = np.linalg.norm(place, axis=-1) > 0.6
    np.testing.assert_array_equal(flown.ended["away"], away)  # the first that it names
    assert (place[flown.ended["ground"], 2] < 0.1 - 0.5).all()  # within 0.1 m of the ground
    np.testing.assert_allclose(sum(flown.reward_terms.values()), np.nansum(flown.reward, 0))
    found = summarize(flown)
    assert found["end_away_rate"] == flown.ended["away"].mean()
    assert found["reward_survival_mean"] == pytest.approx(10.0 * flown.length.mean())


def test_an_end_without_a_name_is_counted_too():
    class Own(Hover):
        def terminated(self, now):
            return now.time > 0.09

    flown = fly(lambda seen: np.zeros((len(seen), 4)), Own(), episodes=2)
    assert {name: holds.mean() for name, holds in flown.ended.items()} == {
        "diverged": 0.0, "terminated": 1.0, "time_limit": 0.0,
    }  # fmt: skip
    np.testing.assert_array_equal(flown.length, 2)  # of 0.05 s
