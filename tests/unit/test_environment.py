"""Transitions: rows and single environments, rewards, ends, success; faults: test_faults.py."""

import helpers
import numpy as np
import pytest
from helpers import begun, idle

from quadrl import tasks


def held(environment, positions):
    """A step that ends at positions (N, 3) or (3,), task frame, at rest and level."""
    start = helpers.level(environment.num_envs, environment.vehicle, position=positions)
    environment.engine.place(np.arange(environment.num_envs), start)
    return idle(environment)


# ------------------------------------------------------------------- one definition of the numbers


# ------------------------------------------------------------------------------- reward and goals


def test_smoothness_costs_the_square_of_the_change_of_the_commands():
    # From hover speed to 35 * (1, -1, 0.5, 0) above it, as above; then back by twice the half.
    task = tasks.make("hover", smoothness_weight=2.0)
    environment = helpers.begun(task)
    first, second, third = (
        environment.step(np.array([action])).reward_terms["smoothness"].item()
        for action in ([1, -1, 0.5, 0], [1, -1, 0.5, 0], [1, 0, 0, 0])
    )
    assert first == pytest.approx(-2 * 0.027059, abs=1e-6) and second == 0
    assert third == pytest.approx(-2 * 1225 * 1.25 / 101861, abs=1e-6)
    assert "smoothness" not in helpers.begun("hover").term_names
    with helpers.refused():
        tasks.make("hover", smoothness_weight=-1.0)


# ------------------------------------------------------------------------------- how episodes end


@pytest.mark.parametrize(
    ("time_limit", "steps"), [(0.05, 1), (0.5, 10), (10.0, 200), (10.02, 200), (0.3, 6)]
)
def test_truncated_at_exactly_the_time_limit(time_limit, steps):
    # Control steps of 0.05 s; a limit near them is rounded.
    environment = helpers.placed(options={"time_limit": time_limit})
    assert environment.time_limit_steps == steps
    for k in range(1, steps + 1):
        now = idle(environment)
        assert not now.terminated[0] and now.truncated[0] == (k == steps)
    assert environment.snapshot.time[0] == pytest.approx(steps * 0.05)


def test_success_is_judged_on_the_mean_of_the_last_two_seconds():
    # Of 10 s, in the last 2 s (40 steps) 0.52 m away for the first n of them: a mean of 0.52 n / 40
    # is below 0.1 m for n = 7 (0.091), and above for n = 9 (0.117). What was before does not count,
    # not even the step before (n = 8 would be above). Row 2 is 0.2 m away all the time, row 3 5 cm.
    environment, last = begun(num_envs=4), np.array([7, 9, 0, 0])
    beside = np.array([[0.0] * 3, [0.0] * 3, [0, 0.2, 0], [0, 0, -0.05]])
    for k in range(200):
        away = (159 <= k) & (k < 160 + last) & (last > 0)
        now = held(environment, beside + away[:, None] * [0.52, 0, 0])
    np.testing.assert_array_equal(now.truncated, True)
    np.testing.assert_array_equal(now.is_success, [True, False, False, True])
    np.testing.assert_allclose(now.error, [0, 0, 0.2, 0.05], atol=1e-4)
