"""Transitions: how episodes end, what diverges, what is saved, and what is refused."""

import dataclasses

import helpers
import numpy as np
import pytest
from helpers import begun, idle

from quadrl import tasks
from quadrl.core.environment import Environment
from quadrl.engines.mujoco import MAX_ENVS
from quadrl.tasks.hover import Hover

# ------------------------------------------------------------------------------- how episodes end


def test_smoothness_costs_the_square_of_the_change_of_the_commands():
    # From hover speed to 35 * (1, -1, 0.5, 0) above it: of the fastest, 319.157 rad/s, squared,
    # 1225 * 2.25 / 101861 = 0.027059; then back by twice the half.
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
        place = beside + away[:, None] * [0.52, 0, 0]  # where the step ends, at rest and level
        environment.engine.place(np.arange(4), helpers.level(4, position=place))
        now = idle(environment)
    np.testing.assert_array_equal(now.truncated, True)
    np.testing.assert_array_equal(now.is_success, [True, False, False, True])
    np.testing.assert_allclose(now.error, [0, 0, 0.2, 0.05], atol=1e-4)


# ----------------------------------------------------------------------------------------- faults


@pytest.mark.parametrize(
    ("value", "column", "mode", "engine"),
    [
        (np.nan, 0, "rotor", "mujoco"),
        (np.nan, 4, "velocity", "free_flight"),
        (np.inf, 0, "velocity", "mujoco"),
        (np.inf, 4, "rotor", "free_flight"),
        (-1e12, 0, "rotor", "free_flight"),
        (1e9, 4, "rotor", "mujoco"),
        (1e6, 0, "velocity", "free_flight"),
        (1e6, 4, "velocity", "mujoco"),
    ],
)
def test_a_diverged_aircraft_is_terminated_and_disturbs_nobody(value, column, mode, engine):
    settings = {"num_envs": 4, "seed": 1, "engine": engine, "control_mode": mode}
    settings |= {"randomization": {"command_delay": (0.0, 0.05)}} if column else {}
    sound, faulty = begun(**settings), begun(**settings)
    row, others, actions = 2, [0, 1, 3], helpers.random_actions(8, 4) * 0.2
    for action in actions[:3]:
        sound.step(action), faulty.step(action)
    last, wind = np.array(faulty.snapshot.state.position[row]), faulty.engine.wind.copy()

    def both(action):
        expected, got = (helpers.recorded(e, e.step(action)) for e in (sound, faulty))
        for name, part in got.items():
            assert np.isfinite(part).all(), name
            np.testing.assert_array_equal(part[others], expected[name][others], err_msg=name)
        return got

    faulty.engine.qvel[row, column] = value
    got = both(actions[3])
    assert got["diverged"][row] and got["terminated"][row]
    assert not got["truncated"][row] and not got["is_success"][row]
    if mode == "rotor":
        # It is shown where it was last in order, and flies on from there: no fresh episode, neither
        # one of the task's nor MuJoCo's own (which would be on the ground at the origin).
        np.testing.assert_array_equal(got["observation.position"][row], last)
        np.testing.assert_array_equal(faulty.engine.qpos[row, :3], last + [0, 0, 3])
    assert faulty.snapshot.time[row] == pytest.approx(4 * 0.05)
    np.testing.assert_array_equal(faulty.engine.wind, wind)
    for action in actions[4:]:
        assert np.linalg.norm(both(action)["observation.position"][row] - last) < 0.4
    # A reset makes it whole: the same next episode as that of the aircraft that stayed sound.
    fresh, regular = faulty.reset(np.array([row])), sound.reset(np.array([row]))
    for name, part in regular.items():
        np.testing.assert_array_equal(fresh[name], part, err_msg=name)
    for action in actions:
        np.testing.assert_array_equal(sound.step(action).reward, faulty.step(action).reward)


def test_a_fault_that_stays_is_reported_at_every_step():
    environment = begun(num_envs=3, seed=1)
    for _ in range(4):
        environment.engine.qvel[1, 0] = np.nan
        now = idle(environment)
        np.testing.assert_array_equal(now.diverged, [False, True, False])
        np.testing.assert_array_equal(now.terminated, [False, True, False])


def test_a_fault_on_the_last_step_is_terminated_and_no_success():
    class Easy(Hover):
        def succeeded(self, now, end):
            return end.terminated | end.truncated

    for task, success in (
        (Hover(time_limit=0.1), [False] * 2),
        (Easy(time_limit=0.1), [False, True]),
    ):
        environment = begun(task, 2, seed=1)
        idle(environment)
        environment.engine.act[0, 0] = np.nan
        now = idle(environment)
        np.testing.assert_array_equal(now.terminated, [True, False])
        np.testing.assert_array_equal(now.truncated, [False, True])
        np.testing.assert_array_equal(now.is_success, success)


# ----------------------------------------------------------------------------------------- saving


def test_a_saved_environment_of_another_shape_is_refused():
    environment = begun(num_envs=2)
    kept = environment.save()
    before = helpers.coordinates(environment.engine)
    for name, value in kept.items():
        if name == "engine.layout":  # another one is of another version: test_record
            continue
        for wrong in (value[..., :1], np.zeros(7), value.astype(np.complex128), None):
            if wrong is None or (wrong.shape, wrong.dtype) != (value.shape, value.dtype):
                changed = {k: v for k, v in (kept | {name: wrong}).items() if v is not None}
                with helpers.refused(name, lists=str(value.shape)):
                    environment.restore(changed)
    np.testing.assert_array_equal(helpers.coordinates(environment.engine), before)
    for other in (begun(num_envs=3), begun("landing", 2), begun(num_envs=2, vehicle="hexa")):
        with helpers.refused():
            other.restore(kept)


# --------------------------------------------------------------------------------- what is refused


NUMBERS = [0, -1, 10**9, 1.5, MAX_ENVS + 1, "4", True, None]
REFUSED = [("num_envs", value, "1 and 1048576") for value in NUMBERS]
REFUSED += [("num_threads", value, "0 and 1024") for value in (-1, 1.5, 1025)]
REFUSED += [
    ("control_mode", "rotr", "did you mean rotor?"),
    ("engine", "warp", "mujoco, free_flight"),
    ("seed", -1, "0"),
]


@pytest.mark.parametrize(("name", "value", "allowed"), REFUSED)
def test_an_argument_that_cannot_be_is_refused_with_the_choices(name, value, allowed):
    with helpers.refused(name, value, lists=allowed):
        Environment(**{"task": "hover", name: value})


OPTIONS = [
    ("hover", "raduis", 1.0, "did you mean radius?"),
    ("hover", "time_limit", 0.0, "positive"),
    ("hover", "time_limit", -1.0, "positive"),
    ("hover", "time_limit", "5", "number"),
    ("hover", "time_limit", 10**400, ""),
    ("hover", "altitude", np.inf, "finite"),
    ("hover", "altitude", 1e12, ""),
    ("hover", "radius", np.nan, "finite"),
    ("hover", "radius", 1e300, ""),
    ("hover", "settle_time", 1e308, ""),
    ("target_following", "climb_share", 2, ""),
    ("target_following", "slowest", 0, ""),
    ("target_following", "fastest", 0.1, ""),
    ("straight_and_level", "line_speed", 0, ""),
    ("static_waypoint", "waypoints", 5, ""),
    ("static_waypoint", "waypoints", ((1, 2, "x"),), ""),
    ("static_waypoint", "waypoints", ((1, 2, 3e300),), ""),
]


@pytest.mark.parametrize(("task", "option", "value", "allowed"), OPTIONS)
def test_an_option_that_means_nothing_is_refused_by_name(task, option, value, allowed):
    known = {field.name for field in dataclasses.fields(tasks.TASKS[task])}
    named = f"{task} {option}" if option in known else f"{task} option"
    with helpers.refused(match=f"^{named}", lists=allowed) as caught:
        tasks.make(task, **{option: value})
    assert option in known or all(name in caught.value.allowed for name in known)


def test_a_step_before_the_first_reset_is_refused():
    environment = Environment("hover", num_envs=2, seed=0)
    for early in (lambda: idle(environment), environment.save, lambda: environment.reset([0])):
        with pytest.raises(RuntimeError):
            early()
    environment.reset(np.array([True, True]))
    idle(environment)
