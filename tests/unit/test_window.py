"""Derivatives of windows of flight, beside differences of the flights themselves."""

import dataclasses

import helpers
import numpy as np
import pytest
import torch

from quadrl import tasks
from quadrl.aircraft.presets import VEHICLES
from quadrl.core.environment import Environment
from quadrl.learning.window import Window, fly

STEPS, COUNT, GAMMA = 12, 5, 0.9
CASES = {
    "hover": {},
    "random_waypoint": {"randomization": {"mass": (0.8, 1.2), "pushes": {"rate": 3.0}}},
    "static_waypoint": {"weather": {"gust_speed": 8.0, "gust_time": 0.5}},
    # What is late has no derivatives.
    "straight_and_level": {"vehicle": dataclasses.replace(VEHICLES["crazyflie"], dead_time=0.0)},
    "target_following": {"vehicle": "hexa"},
    "a short hover": {"time_limit": 0.3},
    "smooth": {"smoothness_weight": 10.0},
    "by thrust and body rates": {"control_mode": "thrust_body_rate", "smoothness_weight": 10.0},
    "by velocities": {"control_mode": "velocity", "vehicle": "hexa"},
    "by places": {"control_mode": "position", "time_limit": 0.3},
}


def flown(name, weights, shifts):
    """Fly a linear policy with some random numbers on top: the window and what was earned."""
    settings = dict(CASES[name])
    options = {k: settings.pop(k) for k in ("time_limit", "smoothness_weight") if k in settings}
    task = tasks.make(name if name in tasks.TASKS else "hover", **options)
    environment = Environment(task, num_envs=COUNT, seed=3, engine="free_flight", **settings)
    environment.reset()
    own, engine = len(environment.engine.parameters), environment.engine
    engine.write_parameters(np.arange(own), helpers.parameter_rows(engine.vehicle, own))
    moments, total, share = [], 0.0, np.ones(COUNT)
    for shift in shifts:
        terms = environment.task.observe(environment.snapshot).values()
        action = np.concatenate(list(terms), axis=-1) @ weights + shift
        moment, done = fly(environment, action)
        moments.append(moment)
        total += (share * done.reward).sum()
        share = share * GAMMA
        over = np.array(done.terminated | done.truncated)
        if over.any():
            environment.reset(over)
            share[over] = 1.0
    return Window(environment, moments), total


def test_what_comes_after_a_step_is_expected_where_the_window_does_not_hold_it():
    # An episode that only runs out of time, or the window, goes on; one that ended does not, and
    # what follows within the window is no expectation.
    window, _ = flown("hover", np.zeros((22, 4)), np.zeros((3, COUNT, 4)))
    ends = np.array([[0, 0, 1, 0, 0], [0, 1, 0, 0, 0], [1, 0, 0, 0, 0]], dtype=bool)
    late = np.array([[0, 0, 0, 1, 0], [0, 0, 0, 0, 0], [0, 0, 0, 0, 1]], dtype=bool)
    window.moments[:] = [
        dataclasses.replace(moment, terminated=end, truncated=out)
        for moment, end, out in zip(window.moments, ends, late, strict=True)
    ]
    expected = [[0, 0, 0, 1, 0], [0, 0, 0, 0, 0], [0, 1, 1, 1, 1]]
    np.testing.assert_array_equal(window.goes_on.reshape(3, COUNT), expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_derivatives_by_a_policy_are_those_of_its_flights(name):
    rng = np.random.default_rng(0)
    known = name if name in tasks.TASKS else "hover"
    flies = {key: CASES[name].get(key) for key in ("vehicle", "control_mode")}
    environment = Environment(known, **flies)
    size, actions = environment.size, environment.action_size
    weights = 0.02 * rng.normal(size=(size, actions))
    shifts = 0.2 * rng.normal(size=(STEPS, COUNT, actions))
    direction = rng.normal(size=weights.shape)
    window, _ = flown(name, weights, shifts)
    action = window.observation @ torch.from_numpy(weights)
    by_action = window.vector_jacobian_product(window.reward.sum(), action, GAMMA)
    # The first action of an episode counts whole, each later one less by gamma.
    over = np.array([m.terminated | m.truncated for m in window.moments])
    share = np.ones((STEPS, COUNT))
    for t in range(1, STEPS):
        share[t] = np.where(over[t - 1], 1.0, GAMMA * share[t - 1])
    seen = window.observation.detach().numpy().reshape(STEPS, COUNT, -1)
    got = (share[..., None] * by_action * (seen @ direction)).sum()
    step = 1e-6
    ends = [flown(name, weights + sign * step * direction, shifts)[1] for sign in (1, -1)]
    assert got == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5)
