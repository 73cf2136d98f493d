# ruff: noqa: E402 - where there is no dm_control nothing of it is imported
"""dm_control; what all APIs have in common is in contract/."""

import numpy as np
import pytest
from helpers import level, needs_dm_control, refused, starting

import quadrl

needs_dm_control()

from quadrl import suite  # before dm_control: it chooses what draws
from quadrl.envs import dm_control
from quadrl.tasks import TASKS, make

from dm_control import suite as dm_suite  # isort: skip

DIVE = np.full(4, -1.0)
CONTROL_STEP = 0.05  # [s]


def fly(environment, action=DIVE):
    """Time steps of an episode, the first one included."""
    steps = [environment.reset()]
    while not steps[-1].last():
        steps.append(environment.step(action))
    return steps


@pytest.mark.slow
def test_after_register_dm_control_loads_the_same_environments():
    suite.register()
    suite.register()  # harmless
    assert suite.ALL_TASKS == tuple(("quadrotor", name) for name in TASKS)
    assert suite.TASKS_BY_DOMAIN == {"quadrotor": tuple(TASKS)}
    with pytest.raises(AttributeError, match="NO_SUCH_TASKS"):
        _ = suite.NO_SUCH_TASKS
    assert ("cartpole", "balance") in dm_suite.BENCHMARKING  # the others are still there
    for name in TASKS:
        assert ("quadrotor", name) in dm_suite.ALL_TASKS
        assert name in dm_suite.TASKS_BY_DOMAIN["quadrotor"]
        theirs = fly(dm_suite.load("quadrotor", name, task_kwargs={"random": 4}))
        ours = fly(quadrl.load(name, {"random": 4}))
        for one, other in zip(theirs, ours, strict=True):
            assert one[:3] == other[:3]
            seen = [*TASKS[name].observation, *TASKS[name].sensors]
            assert list(one.observation) == list(other.observation) == seen
            for term in one.observation:
                np.testing.assert_array_equal(one.observation[term], other.observation[term])


@pytest.mark.slow
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
    environment = dm_control.make(starting(make("landing"), level()), random=0)  # stands already
    assert fly(environment)[-1].discount == 0.0
    assert environment.task.transition.is_success[0]


@pytest.mark.parametrize("kwargs", [{"control_timestep": 0.02}, {"n_sub_steps": 2}])
def test_the_control_step_can_be_chosen(kwargs):
    # Two of the physics steps of 0.01 s, of an episode of 0.2 s: ten actions.
    environment = quadrl.load("hover", environment_kwargs=kwargs | {"time_limit": 0.2})
    assert environment.control_timestep() == pytest.approx(0.02)
    assert len(fly(environment)) - 1 == 10
    assert environment.physics.time() == pytest.approx(0.2)


def test_the_flat_observation_has_the_order_of_the_terms():
    flat = quadrl.load("hover", {"random": 1}, {"flat_observation": True}).reset().observation
    terms = quadrl.load("hover", {"random": 1}).reset().observation
    np.testing.assert_array_equal(flat["observations"], np.concatenate(list(terms.values())))


@pytest.mark.parametrize("control_mode", ["rotor", "velocity"])
def test_without_the_legacy_step_the_numbers_are_the_same(control_mode):
    task_kwargs = {"random": 2, "control_mode": control_mode, "time_limit": 1.0}
    plain = fly(quadrl.load("hover", task_kwargs, {"legacy_step": False}))
    legacy = fly(quadrl.load("hover", task_kwargs))
    assert [step.reward for step in plain] == [step.reward for step in legacy]


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (("quadrotor", "hoover"), "task_name"),
        (("cartpole", "balance"), "domain_name"),
        (("quadrotor", "hover", None, {"flat": True}), "environment_kwargs"),
        (
            ("quadrotor", "hover", None, {"control_timestep": 0.02, "n_sub_steps": 2}),
            "n_sub_steps",
        ),
    ],
)
def test_an_unknown_name_is_refused(arguments, name):
    with refused(name):
        suite.load(*arguments)


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


def test_free_flight_flies_the_same_and_shows_what_it_flies():
    one = quadrl.load("hover", {"random": 0, "engine": "free_flight"})
    other = quadrl.load("hover", {"random": 0})
    one.reset(), other.reset()
    for action in np.random.default_rng(0).uniform(-1, 1, (10, 4)):
        flown, expected = one.step(action), other.step(action)
        np.testing.assert_allclose(flown.reward, expected.reward, rtol=1e-5)
        height = one.physics.named.data.xpos["aircraft", "z"]
        assert height == one.physics.data.qpos[2]
        assert one.physics.time() == pytest.approx(other.physics.time())


@pytest.mark.usefixtures("cheap_pictures")
def test_the_camera_follow_keeps_the_aircraft_in_view_wherever_it_is():
    environment = quadrl.load("hover", {"random": 0})
    environment.reset()
    physics = environment.physics

    def sees_it(camera):
        shown = physics.render(96, 128, camera_id=camera, segmentation=True)
        names = {physics.model.id2name(k, "geom") for k in np.unique(shown[..., 0]) if k >= 0}
        return any(name.startswith("rotor_") for name in names)

    for _ in range(2):
        assert sees_it("follow")
        for camera in ("follow", "track"):
            picture = physics.render(96, 128, camera_id=camera)
            assert picture.shape == (96, 128, 3)
            assert picture.reshape(-1, 3).std(axis=0).min() > 5  # not blank
        physics.data.qpos[:3] += 5.0
        physics.forward()
    assert not sees_it("fixed")
    physics.free()
