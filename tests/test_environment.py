"""Transitions: rows and single environments, clock and ends, faults, saving, and task functions."""

import dataclasses

import mujoco
import numpy as np
import pytest

from quadrl import tasks
from quadrl.environment import MAX_ENVS, ActionError, Environment
from quadrl.rotation import quaternion_from_heading_and_tilt
from quadrl.state import Start, State
from quadrl.task import EPISODE_DRAWS, Draw, Errors, OptionError, Outcome
from quadrl.tasks.hover import Hover
from quadrl.vehicle import Vehicle

VEHICLE = Vehicle()
FLAGS = ("terminated", "truncated", "is_success", "diverged")


def random_actions(steps, count, seed=0):
    """(T, N, 4); one aircraft dives, so that episodes end early too."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (steps, count, 4))
    actions[:, 1 % count] -= 0.7
    return actions


def record(transition):
    """Copies of everything in a transition, by name."""
    parts = {f"observation.{k}": v for k, v in transition.observation.items()}
    parts |= {f"term.{k}": v for k, v in transition.reward_terms.items()}
    parts |= {name: getattr(transition, name) for name in ("reward", "error", *FLAGS)}
    return {name: np.array(value) for name, value in parts.items()}


def coordinates(environment):
    simulation = environment.simulation
    return np.concatenate([simulation.qpos, simulation.qvel, simulation.act], axis=-1)


def fly(environment, actions):
    """The first observation and the records of a flight, with what each reset on the way gives."""
    first = {name: np.array(part) for name, part in environment.reset().items()}
    records = []
    for action in actions:
        transition = environment.step(action)
        now = record(transition) | {"coordinates": coordinates(environment)}
        records.append(now)
        over = transition.terminated | transition.truncated
        if np.any(over):
            fresh = environment.reset(over) if environment.shape else environment.reset()
            now |= {f"fresh.{k}": np.array(v) for k, v in fresh.items()}
    return first, records


def assert_row(single, batch, row):
    """One aircraft's record is that row of a batch's."""
    for name, value in single.items():
        got = batch[name]
        if name.startswith("fresh."):  # only the rows that were reset
            over = batch["terminated"] | batch["truncated"]
            got = got[np.flatnonzero(over).tolist().index(row)]
        else:
            got = got[row]
        np.testing.assert_array_equal(value, got, err_msg=f"{name} of aircraft {row}")


# ------------------------------------------------------------------- one definition of the numbers


# 12 steps to the horizon: several episodes. One route has a waypoint to pass, and one landing is
# low enough to touch the ground.
ROUTE = ((0.0, 0.0, -0.05), (0.0, 0.0, -1.0))
SHORT = [tasks.make(name, horizon=0.6) for name in tasks.TASKS]
SHORT.append(tasks.make("static_waypoint", horizon=0.6, waypoints=ROUTE, reach=0.04))
SHORT.append(tasks.make("landing", horizon=0.6, start_height=0.05))


@pytest.mark.parametrize("task", SHORT, ids=lambda task: task.name)
def test_row_i_is_the_single_environment_seeded_with_seed_plus_i(task):
    actions = random_actions(40, 5)
    first, batch = fly(Environment(task, num_envs=5, seed=40), actions)
    ends = np.array([r["terminated"] | r["truncated"] for r in batch])
    assert (ends.sum(0) >= 3).all()
    for i in range(5):
        met, single = fly(Environment(task, seed=40 + i), actions[:, i])
        assert_row(met, first, i)
        for alone, together in zip(single, batch, strict=True):
            assert_row(alone, together, i)


@pytest.mark.parametrize("num_threads", [1, 2])
def test_threads_and_neighbours_do_not_matter(num_threads):
    task = Hover(horizon=0.6)
    actions = random_actions(30, 5)
    _, five = fly(Environment(task, num_envs=5, seed=7), actions)
    few = Environment(task, num_envs=2, seed=9, num_threads=num_threads)
    _, two = fly(few, actions[:, 2:4])
    for wide, narrow in zip(five, two, strict=True):
        for name in ("coordinates", "reward", "error", *FLAGS):
            np.testing.assert_array_equal(narrow[name], wide[name][2:4], err_msg=name)


@pytest.mark.parametrize("task", SHORT, ids=lambda task: task.name)
@pytest.mark.parametrize("num_envs", [None, 3])
def test_states_are_those_of_a_plain_mj_step_loop(task, num_envs):
    environment = Environment(task, num_envs=num_envs, seed=1)
    environment.reset()
    start = np.atleast_2d(coordinates(environment)).copy()
    actions = random_actions(25, num_envs or 1)
    flown = []
    for action in actions:
        environment.step(action if num_envs else action[0])
        flown.append(np.atleast_2d(coordinates(environment)).copy())

    model = VEHICLE.compile(contact=task.contact)  # with everything that is drawn
    contacts = 0
    for i in range(num_envs or 1):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.act[:] = np.split(start[i], [7, 13])
        for action, states in zip(actions[:, i], flown, strict=True):
            # Omega_c = clip(Omega_hover + 35 a, 0, Omega_max), five steps of 0.01 s.
            command = VEHICLE.hover_speed + 35.0 * np.clip(action, -1, 1)
            data.ctrl[:] = np.clip(command, 0, VEHICLE.max_speed)
            for _ in range(5):
                mujoco.mj_step(model, data)
                contacts += data.ncon
            expected = np.concatenate([data.qpos, data.qvel, data.act])
            np.testing.assert_array_equal(states[i], expected)
    assert (contacts > 0) == (task is SHORT[-1])


def test_seeding_again_gives_the_same_episodes_and_another_seed_others():
    actions = random_actions(10, 2)
    environment = Environment("hover", num_envs=2, seed=5)
    _, once = fly(environment, actions)
    assert environment.seed(5) == 5
    _, again = fly(environment, actions)
    environment.seed(6)
    _, other = fly(environment, actions)
    np.testing.assert_array_equal(once[-1]["coordinates"], again[-1]["coordinates"])
    np.testing.assert_array_equal(once[0]["term.survival"], other[0]["term.survival"])
    assert (once[0]["coordinates"] != other[0]["coordinates"]).any()
    assert len({Environment("hover").seed() for _ in range(3)}) == 3


def test_a_reset_of_some_leaves_the_others_bit_by_bit():
    actions = random_actions(12, 4)
    left, touched = (Environment("hover", num_envs=4, seed=2) for _ in range(2))
    left.reset()
    touched.reset()
    for k, action in enumerate(actions):
        expected, got = record(left.step(action)), record(touched.step(action))
        for name, value in expected.items():
            np.testing.assert_array_equal(got[name][[0, 3]], value[[0, 3]], err_msg=name)
        if k == 4:
            observation = touched.reset(np.array([False, True, True, False]))
            assert observation["position"].shape == (2, 3)
            np.testing.assert_array_equal(touched.simulation.state.time, [5 * 0.05, 0, 0, 5 * 0.05])
        if k == 7:
            touched.reset(np.array([2]))
    np.testing.assert_allclose(touched.simulation.state.time, [0.6, 0.35, 0.2, 0.6])


def test_the_episodes_of_an_aircraft_do_not_depend_on_when_it_is_reset():
    early, late = (Environment("hover", num_envs=2, seed=3) for _ in range(2))
    early.reset()
    late.reset()
    first = early.reset(np.array([1]))
    for action in random_actions(5, 2):
        late.step(action)
    late.reset(np.array([0]))
    second = late.reset(np.array([1]))
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)


# ------------------------------------------------------------------------------- reward and goals


@pytest.mark.parametrize("name", tasks.TASKS)
def test_the_reward_is_exactly_the_sum_of_its_terms_in_order(name):
    environment = Environment(name, num_envs=3, seed=0)
    environment.reset()
    for action in random_actions(20, 3):
        transition = environment.step(action)
        assert tuple(transition.reward_terms) == environment.term_names
        assert environment.term_names[0] == "progress"
        total = np.zeros(3)
        for term in transition.reward_terms.values():
            assert term.shape == (3,)
            total = total + term
        np.testing.assert_array_equal(transition.reward, total)


def placed(position, velocity, task=None, **options):
    """A hover environment whose aircraft is level somewhere, at hover speed."""
    environment = Environment(task or Hover(**options), seed=0)
    environment.reset()
    start = Start(
        position=np.array(position, dtype=float),
        quaternion=np.array([1.0, 0, 0, 0]),
        velocity=np.array(velocity, dtype=float),
        body_rate=np.zeros(3),
        rotor_speed=np.full(4, VEHICLE.hover_speed),
    )
    state = environment.simulation.place(None, start)
    environment._measures = environment.task.measure(state, environment.fields)
    return environment


def test_progress_is_a_hundred_for_a_metre_gained():
    # Level at hover speed and 1 m/s for 0.05 s, towards the origin from 2 m east. The drag slows
    # it by 9e-3 / 0.65 * 1 = 0.0138 m/s^2: 0.05 - 0.0138 * 0.00125 = 0.049983 m.
    towards = placed((2, 0, 0), (-1, 0, 0)).step(np.zeros(4))
    assert towards.reward_terms["progress"] == pytest.approx(4.9983, abs=1e-4)
    away = placed((2, 0, 0), (1, 0, 0)).step(np.zeros(4))
    assert away.reward_terms["progress"] == pytest.approx(-4.9983, abs=1e-4)
    past = placed((2, 0, 0), (0, 1, 0)).step(np.zeros(4))
    # sqrt(4 + 0.05^2) - 2 = 6.2e-4 m
    assert past.reward_terms["progress"] == pytest.approx(-0.0625, abs=1e-3)
    # Speed lost: 0.0138 m/s^2 * 0.05 s = 6.9e-4 m/s, at 2 a m/s.
    assert towards.reward_terms["speed"] == pytest.approx(2 * 6.9e-4, rel=0.02)
    for name in ("attitude", "spin", "control"):
        assert towards.reward_terms[name] == pytest.approx(0, abs=1e-9), name


def test_control_costs_the_square_of_the_deviation():
    # sum((35 * (1, -1, 0.5, 0))^2) / 319.157^2 = 1225 * 2.25 / 101861 = 0.027059
    transition = placed((0, 0, 0), (0, 0, 0)).step(np.array([1, -1, 0.5, 0]))
    assert transition.reward_terms["control"] == pytest.approx(-0.027059, abs=1e-6)
    assert transition.reward_terms["survival"] == 10.0
    # Beyond +-1 it is the clipped command that costs: 1225 * 4 / 101861 = 0.048105
    transition = placed((0, 0, 0), (0, 0, 0)).step(np.full(4, 9.0))
    assert transition.reward_terms["control"] == pytest.approx(-0.048105, abs=1e-6)


def test_weights_weigh():
    terms = (
        placed((2, 0, 0), (-1, 0, 0), progress_weight=7.0, survival_weight=0.5)
        .step(np.zeros(4))
        .reward_terms
    )
    assert terms["progress"] == pytest.approx(7 * 0.049983, abs=1e-5)
    assert terms["survival"] == 0.5


def test_a_new_goal_is_seen_at_once_and_costs_nothing():
    # The first waypoint is reached on the first step. The policy sees the second, 2 m up, from
    # then on, and the way to it, 20 times as long, is not taken for a step away.
    task = tasks.make("static_waypoint", waypoints=((0, 0, 0.1), (0, 0, 2)), reach=0.2)
    environment = placed((0, 0, 0), (0, 0, 1), task)
    first = environment.step(np.zeros(4))
    height = float(environment.simulation.state.position[2])
    assert first.reward_terms["progress"] == pytest.approx(100 * height, rel=1e-9)
    np.testing.assert_allclose(first.observation["goal"], [0, 0, 2 - height], atol=1e-12)
    second = environment.step(np.zeros(4))
    gained = float(environment.simulation.state.position[2]) - height
    assert second.reward_terms["progress"] == pytest.approx(100 * gained, rel=1e-9)
    assert 0.04 < gained < 0.05


@pytest.mark.parametrize("name", tasks.TASKS)
def test_the_flat_observation_is_that_of_the_model_page(name):
    environment = Environment(name, num_envs=4, seed=0)
    environment.reset()
    transition = environment.step(random_actions(1, 4)[0])
    flat = environment.flatten(transition.observation)
    state = environment.simulation.state
    parts = [
        state.position,
        state.sin_attitude,
        state.cos_attitude,
        state.body_velocity,
        state.body_rate,
        state.rotor_speed / VEHICLE.max_speed,
    ]
    np.testing.assert_array_equal(flat[:, :19], np.concatenate(parts, axis=-1).astype(np.float32))
    # The goal vector, body frame, at 19..21: back in the world it leads to the goal.
    goal = environment.task.goal(state, environment.fields)
    lead = np.einsum("nij,nj->ni", state.rotation, flat[:, 19:22])
    np.testing.assert_allclose(state.position + lead, goal, atol=1e-5)
    moving = name in ("straight_and_level", "target_following")
    assert flat.shape == (4, 25 if moving else 22)
    assert flat.dtype == np.float32


# ------------------------------------------------------------------------------- how episodes end


@pytest.mark.parametrize("name", tasks.TASKS)
def test_an_episode_is_never_terminated_and_truncated(name):
    environment = Environment(tasks.make(name, horizon=0.5), num_envs=8, seed=0)
    environment.reset()
    for action in random_actions(30, 8):
        transition = environment.step(action)  # flies on past the horizon
        assert not (transition.terminated & transition.truncated).any()
        over = transition.terminated | transition.truncated
        assert (over | ~transition.is_success).all()


@pytest.mark.parametrize(
    ("horizon", "steps"), [(0.05, 1), (0.5, 10), (10.0, 200), (0.07, 1), (0.01, 1), (0.3, 6)]
)
def test_truncated_at_exactly_the_horizon(horizon, steps):
    # Control steps of 0.05 s; a horizon in between is rounded, and is never nothing.
    environment = placed((0, 0, 0), (0, 0, 0), horizon=horizon)
    assert environment.horizon_steps == steps
    for k in range(1, steps + 1):
        transition = environment.step(np.zeros(4))
        assert not transition.terminated
        assert bool(transition.truncated) == (k == steps)
    assert environment.simulation.state.time == pytest.approx(steps * 0.05)


@pytest.mark.parametrize("num_envs", [None, 2])
def test_a_crash_on_the_last_step_is_a_crash(num_envs):
    # From 2.95 m east at 3 m/s: 3 m are past on the first step, which is also the last.
    environment = Environment(Hover(horizon=0.05), num_envs=num_envs, seed=0)
    environment.reset()
    environment.simulation.qpos[..., :3] = (2.95, 0, 3)
    environment.simulation.qvel[..., :3] = (3, 0, 0)
    if num_envs:
        environment.simulation.qpos[0, 0] = 0.0
    transition = environment.step(np.zeros((*environment.shape, 4)))
    crashed = [False, True] if num_envs else True
    np.testing.assert_array_equal(transition.terminated, crashed)
    np.testing.assert_array_equal(transition.truncated, np.logical_not(crashed))
    assert not np.any(transition.is_success & transition.terminated)


@pytest.mark.parametrize(
    ("coordinate", "value"),
    [
        ("distance", [0.0, 3.1, 3.0]),
        ("ground", [0.0, 0.0, 0.05]),
        ("tilt", [0.0, 0.0, 3.0]),
    ],
)
def test_what_ends_a_hover_early(coordinate, value):
    environment = placed((0, 0, 0), (0, 0, 0))
    environment.simulation.qpos[:3] = value
    if coordinate == "tilt":  # 1.7 rad about x: past 90 degrees
        environment.simulation.qpos[3:5] = np.cos(0.85), np.sin(0.85)
    if coordinate == "ground":
        environment.task = environment.task.replace(max_distance=10.0)
    transition = environment.step(np.zeros(4))
    assert transition.terminated
    assert not transition.truncated
    assert not transition.is_success


# ---------------------------------------------------------------------------------------- success


def controller(state, goal):
    """A cascade of PD loops on the rotor commands: position, tilt, body rate; heading east."""
    roll, pitch, yaw = np.moveaxis(np.arctan2(state.sin_attitude, state.cos_attitude), -1, 0)
    lead, velocity, rate = goal - state.position, state.velocity, state.body_rate
    east, north = np.moveaxis(0.8 * lead[..., :2] - 1.4 * velocity[..., :2], -1, 0)  # [m/s^2]
    ahead = np.cos(yaw) * east + np.sin(yaw) * north
    left = -np.sin(yaw) * east + np.cos(yaw) * north
    want_pitch, want_roll = np.clip(ahead / 9.81, -0.25, 0.25), np.clip(-left / 9.81, -0.25, 0.25)
    # [rad/s] of the rotors; two of them for each of roll and pitch, in opposite directions.
    x = 20 * (want_roll - roll) - 10 * rate[..., 0]
    y = 20 * (want_pitch - pitch) - 10 * rate[..., 1]
    z = np.clip(-12 * yaw - 12 * rate[..., 2], -10, 10)
    up = 10 * lead[..., 2] - 16 * velocity[..., 2]
    return np.stack([up - y - z, up + x + z, up + y - z, up - x + z], axis=-1) / 35


@pytest.mark.parametrize("name", ["hover", "static_waypoint", "random_waypoint"])
@pytest.mark.parametrize("num_envs", [None, 6])
def test_success_at_the_end_of_a_flight_that_is_held_at_the_goal(name, num_envs):
    environment = Environment(name, num_envs=num_envs, seed=0)
    environment.reset()
    for k in range(200):
        goal = environment.task.goal(environment.simulation.state, environment.fields)
        transition = environment.step(controller(environment.simulation.state, goal))
        assert not transition.terminated.any()
        assert np.all(transition.is_success == (k == 199))
    assert np.all(transition.truncated)
    assert np.all(transition.error < 0.05)


def test_a_flight_that_ends_away_from_the_goal_is_no_success():
    # Held 0.2 m beside the goal: in the air to the end, but the mean error is above 0.1 m.
    environment = Environment("hover", num_envs=3, seed=0)
    environment.reset()
    aim = np.array([[0.2, 0, 0], [0.05, 0, 0], [0, 0, -0.15]])
    for _ in range(200):
        transition = environment.step(controller(environment.simulation.state, aim))
    np.testing.assert_array_equal(transition.truncated, True)
    np.testing.assert_array_equal(transition.is_success, [False, True, False])
    np.testing.assert_allclose(transition.error, [0.2, 0.05, 0.15], atol=0.01)


def test_success_is_judged_on_the_mean_of_the_last_two_seconds():
    # At the goal for 10 s, but in the last 2 s (40 steps) seen 0.5 m away for the first n of them:
    # a mean of 0.5 n / 40 is below 0.1 m for n = 7 (0.0875), and above for n = 9 (0.1125).
    for n, succeeds in ((7, True), (9, False)):
        environment = placed((0, 0, 0), (0, 0, 0))
        for k in range(200):
            environment.simulation.qpos[:3] = (0, 0, 3)
            if 160 <= k < 160 + n or k == 100:  # what was before does not count
                environment.simulation.qpos[0] = 0.5
            transition = environment.step(np.zeros(4))
        assert transition.truncated
        assert bool(transition.is_success) == succeeds, n


def test_errors_of_the_last_episode_do_not_weigh_on_the_next():
    environment = Environment("hover", num_envs=2, seed=0)
    environment.reset()
    for k in range(230):
        state, goal = environment.simulation.state, np.zeros((2, 3))
        if k < 30:
            goal[1, 0] = 2.0
        transition = environment.step(controller(state, goal))
        if k == 29:
            environment.reset(np.array([1]))
        if k == 199:
            np.testing.assert_array_equal(transition.is_success, [True, False])
            environment.reset(np.array([0]))
    np.testing.assert_array_equal(transition.is_success, [False, True])


# ----------------------------------------------------------------------------------------- faults


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e12, 1e9, 1e6])
@pytest.mark.parametrize("column", [0, 4])
@pytest.mark.parametrize("num_envs", [None, 4])
def test_a_diverged_aircraft_is_terminated_and_disturbs_nobody(value, column, num_envs):
    sound, faulty = (Environment("hover", num_envs=num_envs, seed=1) for _ in range(2))
    row = 2 if num_envs else ...
    others = [0, 1, 3]
    actions = random_actions(8, num_envs or 1) * 0.2
    actions = actions if num_envs else actions[:, 0]
    sound.reset()
    faulty.reset()
    for action in actions[:3]:
        sound.step(action)
        faulty.step(action)
    last = np.array(faulty.simulation.state.position[row])
    faulty.simulation.qvel[row, column] = value

    expected, got = record(sound.step(actions[3])), record(faulty.step(actions[3]))
    assert got["diverged"][row] and got["terminated"][row]
    assert not got["truncated"][row] and not got["is_success"][row]
    for name, part in got.items():
        assert np.isfinite(part).all(), name
        if num_envs:
            np.testing.assert_array_equal(part[others], expected[name][others], err_msg=name)
    # It is shown where it was last in order, and flies on from there: no fresh episode, neither
    # one of the task's nor MuJoCo's own (which would be on the ground at the origin).
    np.testing.assert_array_equal(got["observation.position"][row], last)
    np.testing.assert_array_equal(faulty.simulation.qpos[row][:3], last + [0, 0, 3])
    assert faulty.simulation.state.time[row] == pytest.approx(4 * 0.05)
    for action in actions[4:]:
        expected, got = record(sound.step(action)), record(faulty.step(action))
        assert np.linalg.norm(got["observation.position"][row] - last) < 0.3
        assert np.isfinite(got["observation.position"]).all()
        if num_envs:
            for name, part in got.items():
                np.testing.assert_array_equal(part[others], expected[name][others], err_msg=name)
    # A reset makes it whole: the same next episode as that of the aircraft that stayed sound.
    mask = np.array([2]) if num_envs else None
    fresh, regular = faulty.reset(mask), sound.reset(mask)
    for name, part in regular.items():
        np.testing.assert_array_equal(fresh[name], part, err_msg=name)
    for action in actions:
        np.testing.assert_array_equal(sound.step(action).reward, faulty.step(action).reward)


def test_a_fault_that_stays_is_reported_at_every_step():
    environment = Environment("hover", num_envs=3, seed=1)
    environment.reset()
    for _ in range(4):
        environment.simulation.qvel[1, 0] = np.nan
        transition = environment.step(np.zeros((3, 4)))
        np.testing.assert_array_equal(transition.diverged, [False, True, False])
        np.testing.assert_array_equal(transition.terminated, [False, True, False])


def test_a_fault_on_the_last_step_is_terminated_and_no_success():
    environment = Environment(Hover(horizon=0.1), num_envs=2, seed=1)
    environment.reset()
    environment.step(np.zeros((2, 4)))
    environment.simulation.act[0, 0] = np.nan
    transition = environment.step(np.zeros((2, 4)))
    np.testing.assert_array_equal(transition.terminated, [True, False])
    np.testing.assert_array_equal(transition.truncated, [False, True])
    assert not transition.is_success[0]


def test_a_diverged_aircraft_has_not_done_what_was_asked():
    class Easy(Hover):
        def success(self, state, fields, errors, terminated, truncated):
            return terminated | truncated

    environment = Environment(Easy(horizon=0.05), num_envs=2, seed=1)
    environment.reset()
    environment.simulation.qvel[0, 0] = np.nan
    transition = environment.step(np.zeros((2, 4)))
    np.testing.assert_array_equal(transition.is_success, [False, True])


# ----------------------------------------------------------------------------------------- saving


@pytest.mark.parametrize("task", SHORT, ids=lambda task: task.name)
@pytest.mark.parametrize("num_envs", [None, 4])
def test_a_restored_environment_continues_bit_by_bit(task, num_envs, tmp_path):
    actions = random_actions(40, num_envs or 1)
    actions = actions if num_envs else actions[:, 0]

    def go_on(environment, actions):
        records = []
        for action in actions:
            transition = environment.step(action)
            over = transition.terminated | transition.truncated
            records.append(record(transition) | {"coordinates": coordinates(environment)})
            if np.any(over):
                environment.reset(over) if num_envs else environment.reset()
        return records

    environment = Environment(task, num_envs=num_envs, seed=3)
    environment.reset()
    go_on(environment, actions[:17])
    np.savez(tmp_path / "saved.npz", **environment.save())
    seen = environment.task.observe(
        environment.simulation.state, environment._measures, environment.fields, VEHICLE
    )
    seen = {k: np.array(v) for k, v in seen.items()}
    expected = go_on(environment, actions[17:])  # with resets, so that the generators matter

    with np.load(tmp_path / "saved.npz") as file:
        saved = dict(file)
    other = Environment(task, num_envs=num_envs, seed=77)
    other.reset()
    go_on(other, actions[:5])
    fresh = Environment(task, num_envs=num_envs, seed=78)  # never reset
    for restored in (other, fresh, environment):
        observation = restored.restore(saved)
        for part, value in seen.items():
            np.testing.assert_array_equal(observation[part], value, err_msg=part)
        got = go_on(restored, actions[17:])
        for step, (now, then) in enumerate(zip(got, expected, strict=True)):
            for key, value in then.items():
                np.testing.assert_array_equal(now[key], value, err_msg=f"{key}, step {step}")


@pytest.mark.parametrize("num_envs", [None, 2])
def test_a_restored_aircraft_on_the_ground_continues_bit_by_bit(num_envs):
    # Where the solver of the contacts begins (its warm start) is part of what is saved.
    task = tasks.make("landing", start_height=0.02)
    environment = Environment(task, num_envs=num_envs, seed=3)
    environment.reset()
    down = np.full((*environment.shape, 4), -1.0)
    down[..., 0] = -0.8  # leans back, so that the feet bear different loads
    for _ in range(12):
        environment.step(down)
    assert np.all(environment.simulation.qpos[..., 2] < 0.1)
    saved = environment.save()
    other = Environment(task, num_envs=num_envs, seed=4)
    other.restore(saved)
    for _ in range(10):
        environment.step(down)
        other.step(down)
        np.testing.assert_array_equal(coordinates(other), coordinates(environment))


def test_what_is_saved_does_not_change_any_more():
    environment = Environment("hover", num_envs=2, seed=3)
    environment.reset()
    saved = environment.save()
    kept = {name: value.copy() for name, value in saved.items()}
    environment.step(np.ones((2, 4)))
    environment.restore(saved)
    environment.step(np.ones((2, 4)))
    for name, value in kept.items():
        np.testing.assert_array_equal(saved[name], value, err_msg=name)


# --------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("num_envs", "shape"),
    [(None, (3,)), (None, (1, 4)), (3, (4,)), (3, (2, 4)), (3, (3, 5)), (3, (4, 3)), (None, ())],
)
def test_an_action_of_the_wrong_shape_is_refused(num_envs, shape):
    environment = Environment("hover", num_envs=num_envs, seed=0)
    environment.reset()
    expected = (num_envs, 4) if num_envs else (4,)
    with pytest.raises(ActionError) as error:
        environment.step(np.zeros(shape))
    assert str(shape) in str(error.value)
    assert str(expected) in str(error.value)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_is_refused_by_name(value):
    environment = Environment("hover", num_envs=5, seed=0)
    environment.reset()
    before = coordinates(environment).copy()
    action = np.zeros((5, 4))
    action[3, 2] = value
    with pytest.raises(ActionError, match=rf"action\[3, 2\] is {value}"):
        environment.step(action)
    np.testing.assert_array_equal(coordinates(environment), before)
    assert environment.simulation.state.time[3] == 0
    single = Environment("hover", seed=0)
    single.reset()
    with pytest.raises(ActionError, match=rf"action\[1\] is {value}"):
        single.step([0, value, 0, 0])


@pytest.mark.parametrize("num_envs", [0, -1, 10**9, 1.5, MAX_ENVS + 1, "4"])
def test_a_number_of_aircraft_that_cannot_be_is_refused(num_envs):
    with pytest.raises(OptionError, match=rf"num_envs = {num_envs!r}.*1 to {MAX_ENVS}"):
        Environment("hover", num_envs=num_envs)


def test_an_unknown_task_lists_the_choices():
    with pytest.raises(OptionError) as error:
        Environment("hoover")
    message = str(error.value)
    assert "'hoover'" in message
    assert "did you mean hover?" in message
    for name in tasks.TASKS:
        assert name in message


def test_an_unknown_option_lists_the_choices():
    with pytest.raises(OptionError) as error:
        tasks.make("hover", raduis=1.0)
    message = str(error.value)
    assert "'raduis'" in message
    assert "did you mean radius?" in message
    for field in dataclasses.fields(Hover):
        assert field.name in message


@pytest.mark.parametrize(
    "options", [{"horizon": 0.0}, {"horizon": -1.0}, {"horizon": np.nan}, {"altitude": np.inf}]
)
def test_an_option_that_means_nothing_is_refused_by_name(options):
    (name,) = options
    with pytest.raises(OptionError, match=f"hover: {name} = "):
        tasks.make("hover", **options)


def test_a_step_before_the_first_reset_is_refused():
    environment = Environment("hover", num_envs=2, seed=0)
    with pytest.raises(RuntimeError, match="reset before the first step"):
        environment.step(np.zeros((2, 4)))
    with pytest.raises(RuntimeError, match="first reset must be of every aircraft"):
        environment.reset(np.array([True, False]))
    environment.reset(np.array([True, True]))
    environment.step(np.zeros((2, 4)))


# ----------------------------------------------------------------- the functions of a task, by row


def random_flight(task, count):
    """States around the start of a task and its fields, NumPy (count, ...), and the draws."""
    rng = np.random.default_rng(11)
    block = rng.random((count, EPISODE_DRAWS))
    start, fields = task.sample(Draw(block), VEHICLE)
    tilt = rng.uniform(0, 2, count)
    turn = quaternion_from_heading_and_tilt(
        rng.uniform(0, 6, count), tilt, rng.uniform(0, 6, count)
    )
    state = {
        "position": start.position + rng.normal(0, 1.5, (count, 3)),
        "quaternion": turn,
        "velocity": start.velocity + rng.normal(0, 1.5, (count, 3)),
        "body_rate": rng.normal(0, 1, (count, 3)),
        "rotor_speed": rng.uniform(100, 319, (count, 4)),
        "time": rng.uniform(0, 10, count),
    }
    later = {**state, "position": state["position"] + rng.normal(0, 0.05, (count, 3))}
    return block, fields, state, later, rng.uniform(150, 300, (count, 4))


def functions(task, block, fields, state, later, command):
    """What every function of a task gives, by name."""
    start, sampled = task.sample(Draw(block), VEHICLE)
    before, state = State.of_coordinates(**state), State.of_coordinates(**later)
    measures, now = task.measure(before, fields), task.measure(state, fields)
    terminated = task.terminated(state, now, fields, VEHICLE)
    error = task.error(state, now, fields)
    outcome = Outcome(failed=terminated, succeeded=~terminated)
    mean = Errors(final=error, mean=error)
    success = task.success(state, fields, mean, terminated, ~terminated)
    results = {
        f"{kind}.{field.name}": getattr(thing, field.name)
        for kind, thing in (
            ("start", start),
            ("sampled", sampled),
            ("measures", now),
            ("updated", task.update(state, now, fields, VEHICLE)),
        )
        for field in dataclasses.fields(thing)
    }
    results |= {"terminated": terminated, "error": error, "success": success}
    results |= task.observe(state, now, fields, VEHICLE)
    terms = task.reward(measures, now, command, outcome, VEHICLE)
    return results | {f"reward.{name}": term for name, term in terms.items()}


def mapped(function, thing):
    """Arrays of a dict or of a record, each through a function."""
    if isinstance(thing, dict):
        return {name: function(value) for name, value in thing.items()}
    names = [field.name for field in dataclasses.fields(thing)]
    return type(thing)(**{name: function(getattr(thing, name)) for name in names})


@pytest.mark.parametrize("name", tasks.TASKS)
def test_a_task_gives_one_aircraft_the_numbers_of_a_batch(name):
    task, count = tasks.make(name), 40
    block, fields, state, later, command = random_flight(task, count)
    batch = functions(task, block, fields, state, later, command)
    assert 0 < batch["terminated"].sum() < count
    for i in range(count):
        rows = [mapped(lambda array: array[i], thing) for thing in (fields, state, later)]  # noqa: B023
        for key, value in functions(task, block[i], *rows, command[i]).items():
            np.testing.assert_array_equal(value, batch[key][i], err_msg=f"{key} of aircraft {i}")


@pytest.mark.parametrize("name", tasks.TASKS)
def test_a_task_gives_tensors_the_same_numbers(name):
    import torch

    task = tasks.make(name)
    block, fields, state, later, command = random_flight(task, 40)
    expected = functions(task, block, fields, state, later, command)
    records = [mapped(torch.tensor, thing) for thing in (fields, state, later)]
    got = functions(task, torch.tensor(block), *records, torch.tensor(command))
    assert got.keys() == expected.keys()
    for key, value in expected.items():
        assert isinstance(got[key], torch.Tensor), key
        assert got[key].dtype.is_floating_point == (value.dtype.kind == "f"), key
        np.testing.assert_allclose(got[key], value, rtol=1e-12, atol=1e-12, err_msg=key)
