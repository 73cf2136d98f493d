"""Rows of one environment that fly different tasks, each as it would alone."""

import copy
import dataclasses
import json

import helpers
import numpy as np
import pytest

from quadrl.base import records
from quadrl.core.environment import Environment
from quadrl.core.one_of import Chosen, OneOf
from quadrl.core.scenario import Scenario
from quadrl.core.snapshot import TaskState
from quadrl.core.task import ObservationTerm
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import flights
from quadrl.learning.config import TrainConfig
from quadrl.tasks.hover import Hover
from quadrl.tasks.random_waypoint import RandomWaypoint


@dataclasses.dataclass(frozen=True)
class Near(RandomWaypoint):
    """Its sum of terms begins with one that no other task has."""

    compiled = True

    def reward(self, before, now, end):
        return {"near": -0.3 * now.potentials.distance} | super().reward(before, now, end)


# 10, 14 and 20 control steps of 0.05 s, and settle times of 4, 6 and 14, the last longer than 10.
MEMBERS = (
    {"task": "hover", "time_limit": 0.5, "settle_time": 0.2, "tolerance": 0.5},
    Near(time_limit=0.7, settle_time=0.3, smoothness_weight=0.4),
    {"task": "straight_and_level", "time_limit": 1.0, "settle_time": 0.7, "spin_weight": 3.0},
)
COUNT = 13


class Written(OneOf):
    """It runs as it is written."""


FLOWN = [(OneOf, {}), (Written, {}), (OneOf, {"control_mode": "velocity"})]
FLOWN += [(OneOf, {"randomization": "light"})]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "settings"), FLOWN)
@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_each_row_flies_as_its_task_alone(engine, kind, settings):
    together = helpers.begun(kind(members=MEMBERS), COUNT, 3, engine=engine, **settings)
    flown = together.task.members
    alone = [helpers.begun(one, COUNT, 3, engine=engine, **settings) for one in flown]
    assert bool(together.not_compiled) == (kind is Written)
    rng, lengths = np.random.default_rng(0), set()
    for _ in range(60):
        action = rng.uniform(-0.6, 0.6, (COUNT, together.action_size))
        rows = [np.flatnonzero(together.snapshot.task.which == k) for k in range(len(alone))]
        now = helpers.recorded(together, together.step(action))
        for number, (own, environment) in enumerate(zip(rows, alone, strict=True)):
            then = helpers.recorded(environment, environment.step(action))
            for name, value in now.items():
                expected = then.get(name, np.zeros_like(value))[own]
                if name == "observation.task":
                    expected = np.eye(len(alone))[np.full(len(own), number)]
                np.testing.assert_array_equal(value[own], expected, err_msg=name)
            ends = own[now["truncated"][own]]
            lengths |= {(number, n) for n in together.episode.steps[ends]}
        over = now["terminated"] | now["truncated"]
        if over.any():
            seen = together.reset(over)
            first = [environment.reset(over) for environment in alone]
            for row, which in enumerate(together.snapshot.task.which[over].astype(int)):
                for name, value in first[which].items():
                    np.testing.assert_array_equal(seen[name][row], value[row], err_msg=name)
    assert lengths == {(0, 10), (1, 14), (2, 20)}


def test_it_is_compiled_only_if_every_member_asks_for_it():
    mixed = (Hover(), helpers.variant(RandomWaypoint, compiled=False))
    assert helpers.begun(OneOf(members=mixed)).not_compiled


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_a_copy_and_a_restored_one_go_on_bit_for_bit(engine):
    actions = helpers.random_actions(20, COUNT)
    one, other = (helpers.begun(OneOf(members=MEMBERS), COUNT, s, engine=engine) for s in (3, 4))
    helpers.fly(one, actions[:7])
    same = copy.deepcopy(one)
    other.restore(one.save())
    expected = helpers.fly(one, actions[7:])
    for environment in (same, other):
        helpers.assert_records(helpers.fly(environment, actions[7:]), expected)


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_members_at_other_heights_fly_as_alone_each_in_its_own_frame(engine):
    members = "hover", "landing", "target_following"
    together = helpers.begun(OneOf(members=members), COUNT, 3, engine=engine)
    assert (together.task.altitude, together.task.contact) == (0.0, True)
    alone = [helpers.begun(one, COUNT, 3, engine=engine) for one in together.task.members]
    rng, which = np.random.default_rng(0), together.snapshot.task.which
    # MuJoCo steps a world with contact more finely, which landing brings.
    near = {"mujoco": 1e-4, "free_flight": 1e-8}[engine]
    floor = together.origin[2]  # a member 3 m up is that much higher above the ground
    for _ in range(20):
        action = rng.uniform(-0.3, 0.3, (COUNT, 4))
        done, goals = together.step(action), together.goals()
        for number, environment in enumerate(alone):
            own, then = which == number, environment.step(action)
            assert own.any()
            for name, value in {**then.observation, **then.reward_terms}.items():
                got = (done.observation | done.reward_terms)[name]
                np.testing.assert_allclose(got[own], value[own], rtol=near, atol=near)
            lifted = [0.0, 0.0, floor if environment.task.altitude else 0.0]
            np.testing.assert_allclose(goals[own], (environment.goals() + lifted)[own], atol=near)
            np.testing.assert_allclose(
                together.snapshot.state.height[own],
                environment.snapshot.state.height[own] + lifted[2],
                atol=near,
            )


SEEN = {"sensors": {"standard": {}, "aim": {"beside_goal": True}}}


@pytest.mark.parametrize("kind", [OneOf, Written])
def test_the_standard_sensor_shows_the_same_numbers_in_each_task_alone_and_drawn(kind):
    members = "hover", "straight_and_level", "target_following"
    together = helpers.begun(kind(members=members), COUNT, 3, observe=SEEN)
    alone = [helpers.begun(one, COUNT, 3, observe=SEEN) for one in together.task.members]
    rng, which = np.random.default_rng(0), together.snapshot.task.which
    for _ in range(5):
        action = rng.uniform(-0.3, 0.3, (COUNT, 4))
        seen = together.flatten(together.step(action).observation)
        for number, environment in enumerate(alone):
            assert environment.layout == together.layout
            then = environment.step(action).observation
            own, flags = which == number, then["standard"][:, 3:]
            np.testing.assert_array_equal(seen[own], environment.flatten(then)[own])
            assert (flags == np.eye(6)[[0, 3, 5][number]]).all()
            assert then["standard"][:, :3].any() == (number > 0)
    with helpers.refused("standard tasks", lists="recovery"):
        Environment("recovery", observe=SEEN)


def test_keywords_of_a_policy_for_several_tasks_make_each_of_them():
    scenario = Scenario.of("all", observe=SEEN, vehicle_options={"action_scale": 50.0})
    size = Environment(scenario).size
    layer = (np.zeros((8, size)),), (np.zeros(8),)
    policy = Policy(*layer, np.zeros(size), np.ones(size), "all", scenario.to_json())
    for part in scenario.task.parts:
        environment = Environment(part.name, **policy.keywords)
        policy.check_fits(environment)
        assert environment.vehicle.action_scale == 50.0 and environment.task == type(part)()


def test_each_row_draws_its_task_for_each_episode_in_proportion():
    environment = Environment(OneOf(members=MEMBERS, shares=(1, 2, 5)), num_envs=8000, seed=0)
    first, second = (environment.reset()["task"].argmax(-1) for _ in range(2))
    # Standard deviations of a share of 8000 draws are at most 0.0056.
    for which in (first, second):
        shares = np.bincount(which) / 8000
        np.testing.assert_allclose(shares, [1 / 8, 1 / 4, 5 / 8], atol=0.02)
    # Two draws that have nothing to do with each other agree with 1/64 + 1/16 + 25/64.
    np.testing.assert_allclose((first == second).mean(), 30 / 64, atol=0.02)
    alone = helpers.begun(environment.task, 1, 41)
    assert alone.snapshot.task.which[0] == first[41]


def test_an_evaluation_tells_of_each_member_what_it_reaches_alone():
    task, given = OneOf(members=MEMBERS), {"episodes": 24, "engine": "free_flight", "seed": 1}
    found = evaluate("geometric", task, **given)
    which, parts = found.rollout.remembered["which"][0], task.flown(found.rollout)
    for number, (name, part) in enumerate(parts.items()):
        rows, alone = (
            np.flatnonzero(which == number),
            evaluate("geometric", task.named[name], **given),
        )
        for figure, values in flights(alone.rollout).items():
            np.testing.assert_allclose(flights(part)[figure], values[rows], rtol=1e-12)
        assert found.metrics[f"{name}_success_rate"] == alone.rollout.is_success[rows].mean()
    off = np.sqrt(np.nanmean(alone.rollout.position[1:, rows, 2] ** 2))
    np.testing.assert_allclose(found.metrics["straight_and_level_altitude_rms_m"], off, rtol=1e-12)
    assert {target.metric for target in task.targets} <= found.metrics.keys()


def test_json_keeps_the_members_and_their_options():
    members = ["hover", "recovery", {"task": "hover", "radius": 0.3}]
    given = {"members": members, "shares": [1, 1, 2]}
    scenario = Scenario.of({"task": "one_of", "task_options": given}, time_limit=5.0)
    assert list(scenario.task.named) == ["hover", "recovery", "hover_2"]
    assert scenario.task.named["hover_2"] == Hover(radius=0.3, time_limit=5.0)
    assert Scenario.of(json.loads(json.dumps(scenario.to_json()))) == scenario
    config = TrainConfig("one_of", task_options=given)
    assert TrainConfig.of_saved(config.resolved()).base == config.base


class Backwards(Hover):
    def reward(self, before, now, end):
        return dict(reversed(super().reward(before, now, end).items()))


class Seen(Hover):
    observation = {"task": ObservationTerm(1, "1", "another")}


REFUSED = {
    "one": ({"members": ("hover",)}, "at least two tasks"),
    "none": ({}, "at least two tasks"),
    "solids": ({"members": ("perching", {"task": "landing", "altitude": 3.0})}, "without solids"),
    "names": ({"members": ("hover", "hovr")}, "hovr.*did you mean hover"),
    "options": ({"members": ("hover", {"task": "hover", "radus": 1})}, "did you mean radius"),
    "of itself": ({"members": ("hover", OneOf(members=MEMBERS))}, "none a one_of"),
    "entries": ({"members": (Seen(), "hover")}, "observation 'task' of hover"),
    "shares": ({"members": MEMBERS, "shares": (1, 2)}, "a sequence of 3 numbers"),
    "no shares": ({"members": MEMBERS, "shares": (0, 0, 0)}, "not all 0"),
    "orders": ({"members": (Hover(), Backwards())}, "one_of reward.*same order"),
    "times": ({"members": ({"task": "hover", "time_limit": 0.07}, "recovery")}, "whole control"),
    "its own": ({"members": MEMBERS, "spin_weight": 3.0}, "spin_weight.*an option of members"),
}


@pytest.mark.parametrize(("options", "message"), REFUSED.values(), ids=REFUSED)
def test_members_that_cannot_fly_together_are_refused(options, message):
    with helpers.refused(match=message):
        Environment(OneOf(**options))


def test_records_within_tuples_are_read_and_written_by_name():
    goal, more = np.zeros((3, 3)), np.arange(3.0)
    record = Chosen(goal, more, (TaskState(goal + 1.0), TaskState(goal + 2.0)))
    assert list(records.named(record)) == ["goal", "which", "own.0.goal", "own.1.goal"]
    saved = records.arrays("task", record)
    again = records.of_arrays("task", records.copied(record), saved)
    records.put(record, np.array([2]), records.mapped(lambda array: array[:1] + 7.0, record))
    np.testing.assert_array_equal(record.own[1].goal[:, 0], [2.0, 2.0, 9.0])
    assert (again.own[1].goal == 2.0).all() and records.owned(again) is again
    view = dataclasses.replace(again, own=(TaskState(goal[:1]), again.own[1]))
    assert records.owned(view) is not view
