"""Door one: dm_control."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from dm_control import suite as dm_suite

import quadrl
from quadrl import suite, testing
from quadrl.environment import ActionError
from quadrl.task import OptionError
from quadrl.tasks import TASKS
from quadrl.tasks.hover import Hover

FOLDER = Path(__file__).parent
DIVE = np.full(4, -1.0)
CONTROL_STEP = 0.05  # [s]


def run(*arguments):
    """Output of a Python process that finds this repository's package."""
    done = subprocess.run(
        [sys.executable, "-W", "error", *arguments],
        env={"PYTHONPATH": str(FOLDER.parent), "MUJOCO_GL": "egl", "HOME": str(Path.home())},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def fly(environment, action=DIVE):
    """Time steps of an episode, the first one included."""
    steps = [environment.reset()]
    while not steps[-1].last():
        steps.append(environment.step(action))
    return steps


def test_dm_controls_own_suite_test_passes():
    output = run(FOLDER / "dm_control_conformance.py")
    assert output.rstrip().endswith("OK"), output  # nothing skipped either
    # One test of the constants, and nine of every task.
    assert int(re.search(r"Ran (\d+) tests", output)[1]) == 1 + 9 * len(TASKS)
    for name in TASKS:
        assert output.count(f"task='{name}'") >= 2 * 8


@pytest.mark.parametrize("name", TASKS)
def test_dm_envs_own_tests_pass(name):
    testing.check_dm_control(TASKS[name](horizon=0.5))


def test_dm_envs_tests_would_notice_a_fault(monkeypatch):
    monkeypatch.setattr(suite.QuadrotorTask, "get_reward", lambda self, physics: "much")
    with pytest.raises(AssertionError, match="dm_env"):
        testing.check_dm_control(Hover(horizon=0.5))


@pytest.mark.parametrize("name", TASKS)
def test_after_register_dm_control_loads_the_same_environment(name):
    suite.register()
    suite.register()  # harmless
    assert ("quadrotor", name) in dm_suite.ALL_TASKS
    assert name in dm_suite.TASKS_BY_DOMAIN["quadrotor"]
    assert ("cartpole", "balance") in dm_suite.BENCHMARKING  # the others are still there
    theirs = dm_suite.load("quadrotor", name, task_kwargs={"random": 4})
    ours = quadrl.load(name, {"random": 4})
    for one, other in zip(fly(theirs), fly(ours), strict=True):
        assert (one.step_type, one.reward, one.discount) == (
            other.step_type,
            other.reward,
            other.discount,
        )
        assert list(one.observation) == list(other.observation) == list(TASKS[name].observation)
        for part in one.observation:
            np.testing.assert_array_equal(one.observation[part], other.observation[part])


def test_the_lists_of_the_domain_name_every_task():
    assert suite.ALL_TASKS == tuple(("quadrotor", name) for name in TASKS)
    assert suite.TASKS_BY_DOMAIN == {"quadrotor": tuple(TASKS)}
    with pytest.raises(AttributeError, match="NO_SUCH_TASKS"):
        _ = suite.NO_SUCH_TASKS


@pytest.mark.parametrize("name", TASKS)
def test_a_crash_on_the_last_step_is_a_crash_and_the_clock_is_no_crash(name):
    crashed = fly(quadrl.load(name, {"random": 0}))
    assert crashed[-1].discount == 0.0
    assert all(step.discount == 1.0 for step in crashed[1:-1])
    steps = len(crashed) - 1
    on_the_clock = fly(quadrl.load(name, {"random": 0, "time_limit": steps * CONTROL_STEP}))
    assert (len(on_the_clock) - 1, on_the_clock[-1].discount) == (steps, 0.0)
    earlier = fly(quadrl.load(name, {"random": 0, "time_limit": (steps - 1) * CONTROL_STEP}))
    assert (len(earlier) - 1, earlier[-1].discount) == (steps - 1, 1.0)


def test_a_success_that_ends_an_episode_has_discount_0():
    @dataclasses.dataclass(frozen=True)
    class Down(Hover):
        name = "down"

        def terminated(self, state, *rest):
            return state.position[..., 2] < -1.0

        def success(self, state, fields, errors, terminated, truncated):
            return terminated

    environment = suite.make(Down(horizon=2.0), random=0)
    last = fly(environment)[-1]
    assert last.discount == 0.0
    assert environment.task.transition.is_success
    assert fly(environment, np.zeros(4))[-1].discount == 1.0
    assert not environment.task.transition.is_success


@pytest.mark.parametrize("kwargs", [{"control_timestep": 0.02}, {"n_sub_steps": 2}])
def test_the_control_step_can_be_chosen(kwargs):
    # Two of the four steps of 0.01 s of an episode of 0.2 s: ten actions.
    environment = quadrl.load("hover", environment_kwargs=kwargs | {"time_limit": 0.2})
    assert environment.control_timestep() == pytest.approx(0.02)
    assert len(fly(environment)) - 1 == 10
    assert environment.physics.time() == pytest.approx(0.2)


def test_two_control_steps_are_one_too_many():
    with pytest.raises(ValueError, match="control_timestep and n_sub_steps"):
        quadrl.load("hover", environment_kwargs={"control_timestep": 0.02, "n_sub_steps": 2})


@pytest.mark.parametrize("name", TASKS)
def test_the_flat_observation_has_the_order_of_the_parts(name):
    flat = quadrl.load(name, {"random": 1}, {"flat_observation": True}).reset().observation
    parts = quadrl.load(name, {"random": 1}).reset().observation
    vector = flat["observations"]
    np.testing.assert_array_equal(vector[0:3], parts["position"])
    np.testing.assert_array_equal(vector[12:15], parts["body_rate"])
    np.testing.assert_array_equal(vector[19:22], parts["goal"])
    assert len(vector) == sum(part.size for part in TASKS[name].observation.values())


def test_without_the_legacy_step_the_numbers_are_the_same():
    plain = fly(quadrl.load("hover", {"random": 2}, {"legacy_step": False}))
    legacy = fly(quadrl.load("hover", {"random": 2}))
    assert [step.reward for step in plain] == [step.reward for step in legacy]


def test_task_options_and_vehicle_arrive():
    heavy = dataclasses.replace(quadrl.Vehicle(), mass=1.3)
    environment = quadrl.load("hover", {"vehicle": heavy, "max_distance": 0.8, "random": 0})
    assert environment.physics.model.body_mass.sum() == pytest.approx(1.3)
    assert len(fly(environment)) < len(fly(quadrl.load("hover", {"random": 0})))


@pytest.mark.parametrize(
    ("arguments", "choices"),
    [
        (("quadrotor", "hoover"), r"hoover.*did you mean hover\?.*choices: .*hover"),
        (("cartpole", "balance"), "unknown domain 'cartpole'.*choices: quadrotor"),
        (("quadrotor", "hover", {"tollerance": 1}), "did you mean tolerance.*choices: horizon"),
        (("quadrotor", "hover", None, {"flat": True}), "'flat'.*choices: .*flat_observation"),
    ],
)
def test_an_unknown_name_lists_the_choices(arguments, choices):
    with pytest.raises(OptionError, match=choices):
        suite.load(*arguments)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(3), r"shape \(3,\) was given; \(4,\) is expected"),
        (np.zeros((1, 4)), r"shape \(1, 4\) was given; \(4,\) is expected"),
        (np.array([0, 0, np.nan, 0]), r"action\[2\] is nan"),
        (np.array([0, -np.inf, 0, 0]), r"action\[1\] is -inf"),
    ],
)
def test_an_impossible_action_is_refused(action, message):
    environment = quadrl.load("hover")
    environment.reset()
    with pytest.raises(ActionError, match=message):
        environment.step(action)


def test_the_reward_colours_the_aircraft_when_asked():
    def colours(visualize):
        environment = quadrl.load("hover", {"random": 0}, visualize_reward=visualize)
        rgba = environment.physics.named.model.mat_rgba
        environment.reset()
        before = rgba["self"].copy()
        reward = environment.step(np.zeros(4)).reward
        assert reward > 1  # clipped to 1: all highlight
        return before, rgba["self"].copy(), rgba["self_default"], rgba["self_highlight"]

    before, after, default, highlight = colours(True)
    np.testing.assert_allclose(before, default)
    np.testing.assert_allclose(after, highlight)
    before, after, default, _ = colours(False)
    np.testing.assert_allclose(after, default)
    assert not np.allclose(default, highlight)


def test_a_random_state_seeds_the_episodes():
    def start(random):
        return quadrl.load("hover", {"random": random}).reset().observation["position"]

    one, same, other = (start(np.random.RandomState(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
    assert not np.array_equal(start(None), start(None))


def test_a_reset_leaves_the_solver_no_memory():
    # As in a fresh MjData, from which a plain loop starts.
    environment = quadrl.load("landing")
    fly(environment)
    environment.reset()
    assert not environment.physics.data.qacc_warmstart.any()


def test_what_is_handed_out_is_never_changed_later():
    environment = quadrl.load("hover", {"random": 0, "time_limit": 0.3})
    handed_out = [environment.reset().observation]
    copies = [{name: part.copy() for name, part in handed_out[0].items()}]
    for _ in range(15):
        handed_out.append(environment.step(DIVE).observation)
        copies.append({name: part.copy() for name, part in handed_out[-1].items()})
    for given, copy in zip(handed_out, copies, strict=True):
        for name, part in given.items():
            np.testing.assert_array_equal(part, copy[name])


def test_a_divergence_ends_the_episode_and_raises_nothing():
    environment = quadrl.load("hover", {"random": 0})
    environment.reset()
    before = environment.step(np.zeros(4))
    environment.physics.data.qvel[0] = 1e12
    step = environment.step(np.zeros(4))
    assert step.last()
    assert step.discount == 0.0
    assert environment.task.transition.diverged
    np.testing.assert_array_equal(step.observation["position"], before.observation["position"])
    assert environment.step(np.zeros(4)).first()
    assert not environment.step(np.zeros(4)).last()


def test_physics_render_draws_the_aircraft():
    # In a process of its own: dm_control's and mujoco's contexts end the same display at exit.
    run(
        "-c",
        "import quadrl; environment = quadrl.load('hover'); environment.reset();"
        "picture = environment.physics.render(96, 128, camera_id='track');"
        "assert picture.shape == (96, 128, 3), picture.shape;"
        "assert picture.reshape(-1, 3).std(axis=0).min() > 5, 'blank';"
        "environment.physics.free()",
    )
