"""Options of the observation: histories, rotor speeds, airspeed, delay, and the critic's own."""

import json
import math

import helpers
import numpy as np
import pytest
from apis import APIS
from policies import linear

from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import to_body, to_world
from quadrl.conditions.observing import Observing
from quadrl.conditions.sensors import Disturbance
from quadrl.core.environment import Environment
from quadrl.envs.gymnasium import QuadrotorVectorEnv
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.policy import Policy

PAPER = Vehicle()
ACTIONS = helpers.random_actions(12, 3)
REST = {name: np.zeros(3) for name in ("position", "velocity", "body_rate")}
REST |= {"quaternion": np.array([1.0, 0, 0, 0])}


def seen(observe, actions=ACTIONS, **settings):
    """Copies of the observations (T + 1) of a flight, and its environment."""
    environment = Environment("hover", num_envs=3, seed=1, observe=observe, **settings)
    found = [{name: np.array(part) for name, part in environment.reset().items()}]
    for action in actions:
        given = environment.step(action).observation
        found.append({name: np.array(part) for name, part in given.items()})
    return found, environment


def flat(observation, names):
    return np.concatenate([observation[name] for name in names], axis=-1)


def test_the_task_own_entries_stay_what_they_are():
    usual, plain = seen(None)
    options = {"action_history": 1, "observation_history": 1, "airspeed": True}
    found, environment = seen(options)
    for one, other in zip(found, usual, strict=True):
        assert [*one] == [*other, "airspeed", "action_history", "observation_history"]
        for name, part in other.items():
            np.testing.assert_array_equal(one[name], part, err_msg=name)
        np.testing.assert_array_equal(one["airspeed"], one["velocity"])  # in calm air
    assert plain.size == 22 and environment.size == 22 + 3 + 4 + 25
    assert environment.layout["observation_history"] == slice(29, 54)
    vector = environment.flatten(environment.step(ACTIONS[0]).observation)
    assert vector.shape == (3, 54) and vector.dtype == np.float32


def test_histories_are_those_of_the_flight_the_newest_first():
    found, environment = seen({"action_history": 3, "observation_history": 2})
    names = environment.task.observation
    for t, one in enumerate(found):
        last = [ACTIONS[k] if k >= 0 else 0 * ACTIONS[0] for k in (t - 1, t - 2, t - 3)]
        taken = [np.clip(action, -1, 1) for action in last]
        np.testing.assert_array_equal(one["action_history"], np.concatenate(taken, axis=-1))
        before = [flat(found[max(0, t - k)], names) for k in (1, 2)]
        np.testing.assert_array_equal(one["observation_history"], np.concatenate(before, axis=-1))
    fresh = environment.reset(np.array([1]))
    assert not fresh["action_history"].any()
    twice = np.tile(flat(fresh, names), 2)
    np.testing.assert_array_equal(fresh["observation_history"], twice)


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize("mode", ["rotor", "velocity"])
def test_each_part_of_the_estimate_is_as_old_as_is_drawn_for_each_row(engine, mode):
    given = {"observation_delay": (0.0, 0.07), "rate_delay": (0.01, 0.03)}
    settings = {"engine": engine, "control_mode": mode, "randomization": given}
    environment, twin = (helpers.begun("hover", 30, **settings) for _ in range(2))
    flown, log, rows = environment.engine, [helpers.coordinates(twin.engine)], np.arange(30)
    begun = np.zeros(30, int)
    for action in helpers.random_actions(9, 30, environment.action_size):
        environment.step(action)
        twin.begin(action)  # the same in parts, which show each physics step
        for steps in twin.commands():
            twin.engine.advance(steps)
            log.append(helpers.coordinates(twin.engine))
        twin.finish()
        np.testing.assert_array_equal(helpers.coordinates(flown), log[-1])
        drawn = environment.randomizer.shown()
        for name, parts in {
            "observation_delay": {"position": (0, 3), "quaternion": (3, 7), "velocity": (7, 10)},
            "rate_delay": {"body_rate": (10, 13)},
        }.items():
            ages = np.rint(drawn[name] / PAPER.physics_timestep).astype(int)
            expected = np.array(log)[np.maximum(len(log) - 1 - ages, begun), rows]
            for part, (first, last) in parts.items():
                found = getattr(environment.observer.estimate, part)
                found = found + environment.origin if part == "position" else found
                np.testing.assert_array_equal(found, expected[:, first:last], err_msg=part)
        np.testing.assert_array_equal(environment.observer.estimate.rotor_speed, flown.act)
        if len(log) == 21:
            environment.reset(rows % 3 == 0)
            twin.reset(rows % 3 == 0)
            log[-1], begun[::3] = helpers.coordinates(flown), 20
    assert len(log) == 46  # every physics step was seen


def test_ages_are_drawn_evenly_and_change_nothing_else_that_is_drawn():
    ages = dict.fromkeys(("observation_delay", "rate_delay", "command_delay"), (0.0, 0.03))
    environment = helpers.begun("hover", 400, randomization={"mass": (0.9, 1.1), **ages})
    for name in ages:
        values, counts = np.unique(
            environment.randomizer.shown()[name].round(9), return_counts=True
        )
        np.testing.assert_allclose(values, [0.0, 0.01, 0.02, 0.03])
        # 100 of each; a binomial of 400 and 1/4 has a deviation of 8.7.
        assert (np.abs(counts - 100) < 5 * 8.7).all()
    plain = helpers.begun("hover", 400, randomization={"mass": (0.9, 1.1)})
    shown = [each.randomizer.shown()["mass"] for each in (environment, plain)]
    np.testing.assert_array_equal(*shown)


@pytest.mark.parametrize("mode", ["rotor", "velocity"])
def test_rotor_speeds_are_estimated_with_the_lag_that_is_specified(mode):
    found, environment = seen({"rotor_speed": "estimated"}, control_mode=mode)
    # Without anything drawn the estimate is the truth, but for the error of the integrator: the
    # fourth-order method with a step of 0.01 / 0.18 leaves (0.056)^5 / 120 of each change.
    true = environment.engine.act / PAPER.max_speed
    np.testing.assert_allclose(found[-1]["rotor_speed"], true, atol=1e-7)
    slow = {"lag": 2.0}
    slower, other = seen({"rotor_speed": "estimated"}, control_mode=mode, randomization=slow)
    assert np.abs(slower[-1]["rotor_speed"] - other.engine.act / PAPER.max_speed).max() > 1e-3
    if mode == "rotor":  # the estimate follows from the commands alone
        np.testing.assert_array_equal(slower[-1]["rotor_speed"], found[-1]["rotor_speed"])


@pytest.mark.parametrize("weather", ["calm", "moderate"])  # in wind the start is in trim
def test_an_estimate_begins_with_what_an_aircraft_can_know(weather):
    observe = {"rotor_speed": "estimated", "disturbance": True}
    environment = helpers.begun("hover", 3, observe=observe, weather=weather)
    starts = ({}, {"rotor_speed": np.zeros(4)}, REST | {"rotor_speed": 0.9 * PAPER.max_speed})
    for start in starts:  # the same whatever the rotors do
        found = environment.reset(start=start)
        hover = np.tile(PAPER.hover_speed / PAPER.max_speed, (3, 1))
        np.testing.assert_array_equal(found["rotor_speed"], hover)
        assert not found["disturbance"].any()
    environment.step(np.zeros((3, 4)))
    one = environment.reset(np.array([1]), start={"rotor_speed": np.zeros(4)})
    np.testing.assert_array_equal(one["rotor_speed"], hover[:1])


def test_the_rotation_is_the_matrix_of_the_attitude_row_by_row():
    found, environment = seen({"rotation": True})
    state = environment.engine.state
    vertical = to_body(state.rotation, np.array([[0.0, 0.0, 1.0]]))  # its last row
    np.testing.assert_allclose(found[-1]["rotation"][:, 6:], vertical, atol=1e-15)
    ahead = to_world(state.rotation, np.array([[1.0, 0.0, 0.0]]))  # its first column
    np.testing.assert_allclose(found[-1]["rotation"][:, ::3], ahead, atol=1e-15)


def test_relative_rotor_speeds_are_zero_in_hover_and_hide_the_others():
    found, environment = seen({"relative_rotor_speed": True, "rotor_speed": "estimated"})
    modelled, _ = seen({"rotor_speed": "estimated"})
    assert "rotor_speed" not in found[0] and environment.size == 22
    hidden, environment = seen({"rotor_speed": "none"})
    assert "rotor_speed" not in hidden[0] and environment.size == 18
    np.testing.assert_allclose(found[0]["relative_rotor_speed"], 0.0, atol=1e-12)
    vehicle = environment.vehicle
    speed = modelled[-1]["rotor_speed"] * vehicle.max_speed  # [rad/s]
    share = speed / vehicle.hover_speed - 1
    assert np.abs(share).max() > 0.01
    np.testing.assert_allclose(found[-1]["relative_rotor_speed"], share, atol=1e-12)


def test_the_airspeed_is_the_velocity_through_the_air():
    found, environment = seen({"airspeed": True}, weather="moderate")
    state, wind = environment.engine.state, environment.engine.wind
    assert np.abs(wind).max() > 1
    np.testing.assert_array_equal(
        found[-1]["airspeed"], to_body(state.rotation, state.velocity - wind)
    )


@pytest.mark.parametrize("rotor_speed", ["true", "estimated", "none"])
@pytest.mark.parametrize(("mass", "smoothing"), [(0.8, Disturbance.smoothing), (1.25, 0.0)])
def test_a_mass_that_is_not_the_specified_one_shows_as_acceleration(mass, smoothing, rotor_speed):
    sensors = {"disturbance": {"smoothing": smoothing}}
    options = {"sensors": sensors, "rotor_speed": rotor_speed}
    environment = helpers.begun("hover", 2, observe=options, randomization={"mass": mass})
    environment.reset(start=REST)
    for k in range(1, 6):
        found = helpers.idle(environment).observation["disturbance"]
        arrived = 1 - math.exp(-k * PAPER.control_timestep / smoothing) if smoothing else 1.0
        expected = arrived * GRAVITY * (1 / mass - 1)  # the rotors turn as if it were the specified
        np.testing.assert_allclose(found, [[0, 0, expected]] * 2, atol=0.05)
    assert not environment.reset(np.array([1]), REST)["disturbance"].any()


def test_the_push_of_the_wind_shows_as_acceleration_in_the_body_frame():
    east = {**REST, "quaternion": np.array([1, 0, 0, 1]) / math.sqrt(2)}  # x of the body is north
    environment = helpers.begun("hover", 1, observe={"disturbance": True})
    environment.reset(start=east)
    environment.engine.wind[:] = 4.0, 0.0, 0.0
    for _ in range(4):
        found = helpers.idle(environment).observation["disturbance"]
    arrived = 1 - math.exp(-4 * 0.05 / Disturbance.smoothing)
    push = PAPER.drag_coefficient * 4.0**2 / PAPER.mass * arrived
    np.testing.assert_allclose(found, [[0, -push, 0]], atol=0.1 * push)


def test_the_privileged_observation_is_the_truth_what_was_drawn_and_the_wind():
    settings = {"randomization": "full", "weather": "light"}
    found, environment = seen({"privileged": True}, **settings)
    privileged, state = environment.privileged, environment.engine.state
    shown = environment.randomizer.shown()
    true = flat(environment.task.observe(environment.snapshot), environment.task.observation)
    np.testing.assert_array_equal(privileged[:, :22], true)
    assert (flat(found[-1], environment.task.observation) != true).any()
    drawn = privileged[:, 22:-3]
    assert drawn.shape[1] == len(shown) and (np.abs(drawn) <= 1).all()
    low, high = environment.randomization.mass
    column = 22 + [*shown].index("mass")
    np.testing.assert_allclose(
        low + (privileged[:, column] + 1) / 2 * (high - low), shown["mass"], rtol=1e-12
    )
    wind = to_body(state.rotation, environment.engine.wind)
    np.testing.assert_array_equal(privileged[:, -3:], wind)
    before = privileged.copy()
    environment.reset(np.array([2]))
    np.testing.assert_array_equal(privileged, before)  # what was handed out stays
    np.testing.assert_array_equal(environment.privileged[:2], before[:2])
    continuous = [not name.endswith("_delay") for name in shown]  # others may be drawn again
    assert (environment.privileged[2, 22:-3] != before[2, 22:-3])[continuous].all()


@pytest.mark.parametrize("api", APIS, ids=lambda api: api.__name__)
def test_every_api_observes_alike_and_tells_what_was_drawn(api):
    observe = {"action_history": 1, "rotor_speed": "estimated", "privileged": True}
    settings = {"randomization": "full", "observe": observe, "weather": "light"}
    settings |= {"aerodynamics": "rotor_drag"}
    flown = api(seed=4, **settings)
    core = Environment("hover", num_envs=flown.rows, seed=4, vehicle=flown.core.vehicle,
                       **{k: v for k, v in settings.items() if k != "aerodynamics"})  # fmt: skip
    assert core.vehicle.aerodynamics.rotor_drag > 0
    met = flown.reset()
    expected = core.flatten(core.reset())
    np.testing.assert_array_equal(flown.observation(met).astype(np.float32), expected)
    for action in helpers.random_actions(3, flown.rows) * 0.1:
        given = flown.step(action)
        now = core.step(action)
        found = flown.observation(given).astype(np.float32)
        np.testing.assert_array_equal(found, core.flatten(now.observation))
    np.testing.assert_array_equal(flown.core.privileged, core.privileged)
    if api.__name__ in ("Gymnasium", "Vector"):
        info, shown = given[-1], core.randomizer.shown()
        mass = np.reshape(info["drawn"]["mass"], -1)
        np.testing.assert_array_equal(mass, shown["mass"])
        assert info["drawn"].names == tuple(shown)
        told = np.reshape(info["privileged"], core.privileged.shape)
        np.testing.assert_array_equal(told, core.privileged.astype(np.float32))
    if api.__name__ == "TorchRL":
        told = given["privileged"].numpy()
        np.testing.assert_array_equal(told, core.privileged.astype(np.float32))
        flown.environment.check_env_specs()


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP", "DISABLED"])
def test_a_vector_tells_what_was_drawn_for_the_present_episode(mode):
    environment = QuadrotorVectorEnv(
        "hover", 3, autoreset_mode=mode, time_limit=0.1, randomization={"mass": (0.9, 1.1)}
    )
    _, info = environment.reset(seed=0)
    first = info["drawn"]["mass"].copy()
    assert info["_drawn"].all()
    for _ in range(2):
        *_, info = environment.step(np.zeros((3, 4)))
    if mode == "SAME_STEP":
        np.testing.assert_array_equal(info["final_info"]["drawn"]["mass"], first)
    if mode == "NEXT_STEP":
        np.testing.assert_array_equal(info["drawn"]["mass"], first)
        *_, info = environment.step(np.zeros((3, 4)))
    if mode == "DISABLED":
        _, info = environment.reset(options={"reset_mask": np.array([True, True, True])})
    now = environment.environment.randomizer.shown()["mass"]
    np.testing.assert_array_equal(info["drawn"]["mass"], now)
    assert (now != first).all()


def test_a_policy_flies_with_the_options_of_its_training_and_no_others(tmp_path):
    late = {"airspeed": {"noise": 0.3, "delay": 0.1}}
    observe = json.loads(json.dumps(Observing(action_history=2, sensors=late).given()))
    drawn = {"randomization": {"mass": [0.9, 1.1]}, "weather": {}}
    linear(33, 4, observe=observe, **drawn).save(tmp_path / "policy")
    policy = Policy.load(tmp_path / "policy")
    found = evaluate(policy, "hover", episodes=2, time_limit=0.2)
    assert found.metrics["episodes"] == 2
    for other in ({}, {"action_history": 2}, {"action_history": 2, "airspeed": True}):
        with helpers.refused("observe", lists="action_history"):
            evaluate(policy, "hover", episodes=2, observe=other)
    evaluate(policy, "hover", episodes=2, time_limit=0.2, sampled=True)
    # What only the critic sees makes no difference.
    evaluate(policy, "hover", episodes=1, time_limit=0.1, observe=observe | {"privileged": True})


@pytest.mark.parametrize(
    ("observe", "name", "value"),
    [
        ("all", "observe", "all"),
        ({"history": 2}, "option of observe", "history"),
        ({"action_history": -1}, "action_history", -1),
        ({"action_history": 1.5}, "action_history", 1.5),
        ({"observation_history": 10**6}, "observation_history", 10**6),
        ({"rotor_speed": "guessed"}, "rotor_speed", "guessed"),
        ({"airspeed": 1}, "airspeed", 1),
        ({"relative_rotor_speed": True, "rotor_speed": "none"}, "relative_rotor_speed", True),
        ({"privileged": "yes"}, "privileged", "yes"),
    ],
)
def test_an_impossible_option_is_refused(observe, name, value):
    with helpers.refused(name, value):
        Environment("hover", observe=observe)


def test_a_policy_flies_with_a_worse_sensor_and_not_with_another_one():
    policy, task = Policy.pretrained("navigation"), {"trees": 12, "time_limit": 0.5}
    worse = {"rate": 15.0, "share": 0.02, "dropout": 0.5, "noise": 0.1, "delay": 0.05}

    def seen(options):
        observe = {"sensors": options}
        return evaluate(policy, episodes=2, engine="free_flight", observe=observe, **task)

    usual, late = (seen({"range_finder": own}).rollout.action for own in ({}, worse))
    assert usual.shape == late.shape and (usual != late).any()
    for other in ({"range_finder": {"reach": 5.0}}, {"airspeed": {"noise": 0.1}}):
        with helpers.refused(match="observe", lists="as in the training"):
            seen(other)
