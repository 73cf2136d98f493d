"""Any quadrotor: its sizes as they are drawn, an X in every layout, and a teacher that is told."""

import dataclasses
import sys
import types
import warnings

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import quadrl
from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.quadrotor import as_x, authority, sizes_of
from quadrl.aircraft.rotors import ring
from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.conditions.sampler import AircraftSampler, vehicle_of
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.deploy.foundation_policy import Facing
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.policy_file import arrays_of
from quadrl.learning.config import TrainConfig
from quadrl.learning.teacher import COST, EFFORT, STATES, Teacher, regulators, sampled
from quadrl.learning.train import Training
from scripts.reports import any_aircraft

SIZES = {
    "mass": (0.025, 2.0),
    "thrust_to_weight": (1.5, 5.0),
    "angular_acceleration": (100.0, 900.0),
    "lag": (0.02, 0.2),
}
SEES = {"action_history": 2, "rotor_speed": "none", "sensors": {"level": {}}}
FLOWN = {"control_mode": "share_of_x", "observe": SEES, "control_timestep": 0.02}
ANY = TrainConfig("hover", algo="dagger", variant="any")


def drawn(sampler, n=2000):
    return sampler.sample(np.random.default_rng(0).random((n, len(sampler.names))))


@pytest.mark.parametrize("name", ["racer", "paper"])
def test_aircraft_have_the_drawn_sizes_evenly_in_their_logarithm(name):
    vehicle = VEHICLES[name]
    sampler = AircraftSampler({"sizes": SIZES}, vehicle)
    numbers = drawn(sampler)
    found = [sizes_of(vehicle_of(vehicle, row)) for row in sampler.table(numbers)[:50]]
    for size, (low, high) in SIZES.items():
        values = np.array([one[size] for one in found])
        np.testing.assert_allclose(values, np.exp(sampler.columns(numbers, f"log_{size}")[:50, 0]))
        middle = np.median(sampler.columns(numbers, f"log_{size}"))
        # The median of an even draw of logarithms, within 5 % of the range (2,000 of them: 3 %).
        assert middle == pytest.approx(np.log(low * high) / 2, abs=0.05 * np.log(high / low))
    assert sampler.contains(numbers)


def test_a_size_that_is_not_drawn_stays_and_no_size_moves_other_numbers():
    racer = VEHICLES["racer"]
    alone = AircraftSampler({"mass": (0.8, 1.2)}, racer)
    beside = AircraftSampler({"mass": (0.8, 1.2), "sizes": {"lag": (0.02, 0.2)}}, racer)
    assert alone.names == beside.names
    kept = [name for name in alone.names if not name.startswith("log_")]
    for name in kept:
        one, other = (x.columns(drawn(x, 5), name) for x in (alone, beside))
        np.testing.assert_array_equal(one, other)
    made = vehicle_of(racer, beside.table(beside.low[None])[0])
    assert sizes_of(made)["thrust_to_weight"] == pytest.approx(
        sizes_of(racer)["thrust_to_weight"] / 0.8
    )
    assert made.rotors[0].lag_up == pytest.approx(1 / 0.02)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"sizes": {"lag": (0.0, 0.2)}}, "sizes lag"),
        ({"sizes": {"lag": (0.2, 0.1)}}, "low at most high"),
        ({"sizes": {"span": 1.0}}, "span"),
    ],
)
def test_impossible_sizes_are_refused(given, said):
    with pytest.raises(QuadrlError, match=said):
        AircraftSampler(given, VEHICLES["racer"])


@pytest.mark.parametrize(
    ("bearings", "spins", "turn"),
    [
        ((-45, -135, 135, 45), (1, -1, 1, -1), 0.0),
        ((45, 135, -135, -45), (-1, 1, -1, 1), 0.0),  # in another order
        ((0, -90, 180, 90), (1, -1, 1, -1), np.pi / 4),  # a plus
        ((0, -90, 180, 90), (-1, 1, -1, 1), -np.pi / 4),
        ((-45, -135, 135, 45), (-1, 1, -1, 1), np.pi / 2),  # the rotors turn the other way
    ],
)
def test_every_layout_is_an_x(bearings, spins, turn):
    bearing = np.radians(bearings)
    position = np.stack([np.cos(bearing), np.sin(bearing), 0 * bearing], axis=-1)
    order, found = as_x(position, np.array(spins, float))
    assert abs(found) == pytest.approx(abs(turn))
    assert [spins[k] for k in order] == [1, -1, 1, -1]
    seen = bearing[order] - found  # in the frame of the X: -45 deg, and on clockwise
    apart = np.exp(1j * (seen - np.radians([-45, -135, 135, 45])))
    np.testing.assert_allclose(apart, 1, atol=1e-12)


def test_no_x_is_refused_in_one_line():
    with pytest.raises(QuadrlError, match="four in an X or a plus") as caught:
        Environment(Scenario.of("hover", vehicle="hexa", **FLOWN))
    assert "\n" not in str(caught.value)


def flight(vehicle, heading=0.0, steps=40):
    """What the sensor `level` gives along a flight with the same actions (T, 1, 12)."""
    env = Environment(Scenario.of("hover", vehicle=vehicle, any_heading=True, **FLOWN), seed=3)
    quaternion = np.array([[np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)]])
    still = {"velocity": np.zeros(3), "body_rate": np.zeros(3), "position": np.array([0, 0, 0.2])}
    env.reset(start={"quaternion": quaternion, **still})
    rng, seen = np.random.default_rng(0), []
    for _ in range(steps):
        action = 2 * np.sqrt(0.25 / (9.81 * 0.65 / vehicle.mass / 9.81)) * np.ones(4) - 1
        step = env.step((action + 0.05 * rng.uniform(-1, 1, 4))[None])
        seen.append(np.array(step.observation["level"]))
    return np.array(seen)


def test_the_same_actions_fly_a_plus_an_x_and_any_heading_the_same_way():
    paper = VEHICLES["paper"]
    rotors = paper.rotors[0]
    own = {
        name: getattr(rotors, name)
        for name in ("thrust_coefficient", "torque_coefficient", "lag_up", "lag_down", "max_speed")
    }
    bearings = [np.degrees(np.arctan2(r.position[1], r.position[0])) for r in paper.rotors]
    spins = [r.spin for r in paper.rotors]
    turned = ring([b - 45 for b in bearings], spins, 0.23, **own, disc_radius=rotors.disc_radius)
    x = dataclasses.replace(paper, name="turned", rotors=turned)
    other_way = dataclasses.replace(
        x,
        name="other_way",
        rotors=ring([b + 45 for b in bearings], spins, 0.23, **own),
    )
    usual = flight(paper)
    assert np.abs(usual[-1, 0, :2]).max() > 0.01  # it has tilted
    for again in (flight(x), flight(other_way), flight(paper, heading=1.0)):
        np.testing.assert_allclose(again, usual, atol=1e-9)


def test_more_thrust_behind_flies_ahead_and_more_on_the_right_to_the_left():
    env = Environment(Scenario.of("hover", vehicle="racer", any_heading=True, **FLOWN), seed=0)
    level = {"quaternion": np.array([1.0, 0, 0, 0]), "velocity": np.zeros(3)}
    for action, axis in (([-1, 1, 1, -1], 0), ([1, 1, -1, -1], 1)):
        env.reset(start={**level, "body_rate": np.zeros(3)})
        hover = 2 * env.vehicle.hover_speed / env.vehicle.max_speed - 1
        for _ in range(15):
            step = env.step(hover[:4][None] + 0.02 * np.array(action)[None])
        velocity = step.observation["level"][0, 6:9]
        assert velocity[axis] > 0.01 and abs(velocity[1 - axis]) < 0.1 * velocity[axis]


def test_the_airframe_is_that_of_the_drawn_aircraft():
    sees = {"sensors": {"level": {}, "airframe": {}}}
    given = FLOWN | {"observe": sees}
    env = Environment(
        Scenario.of("hover", vehicle="racer", randomization={"sizes": SIZES}, **given), num_envs=5
    )
    seen = env.reset(seed=1)["airframe"]
    np.testing.assert_array_equal(seen, authority(env.engine.begun))
    assert np.ptp(seen[:, 0]) > 0.1
    nominal = Environment(Scenario.of("hover", vehicle="racer", **given))
    # Racer: 8.5 N a rotor over 0.752 kg; rolling, 8.5 N * 0.1 m / 2.5e-3 kg m^2 = 340 rad/s^2.
    found = np.exp(nominal.reset()["airframe"][0, :2])
    np.testing.assert_allclose(found, [8.5 / (0.752 * 9.81), 340.0])


def test_regulators_are_those_of_the_riccati_equation():
    gain, lag = np.array([[60.0, 500, 400, 60]]), np.array([20.0])
    for late, most in ((0, 0), (5, 2)):
        matrix, given = sampled(gain, lag, np.array([late]), 0.005, 4, most)
        found = regulators(matrix, given)
        for k, states in enumerate(([0, 1, 4], range(5), range(5), [3, 4])):
            kept = [*states, *range(STATES, STATES + most)]
            a, b = matrix[0, k][np.ix_(kept, kept)], given[0, k, kept, None]
            cost = np.diag([*COST[k], *[0.0] * most])[np.ix_(kept, kept)]
            value = solve_discrete_are(a, b, cost, EFFORT[k : k + 1, None])
            own = np.linalg.solve(EFFORT[k] + b.T @ value @ b, b.T @ value @ a)
            np.testing.assert_allclose(found[0, k, kept], own[0], rtol=1e-6)


def test_a_late_command_acts_when_it_arrives():
    # 7 physics steps late, of 4 in a control step: the newest command acts in no physics step of
    # this control step, the one before it in the last one, and the one before that in the others.
    gain, lag, late = np.ones((1, 4)), np.array([20.0]), np.array([7])
    matrix, given = sampled(gain, lag, late, 0.005, 4, 2)
    assert given[0, 0, 4] == 0.0 and given[0, 0, STATES] == 1.0
    one = 1 - np.exp(-0.1)  # share of a change that a rotor follows in a physics step
    assert matrix[0, 0, 4, STATES] == pytest.approx(one)
    assert matrix[0, 0, 4, STATES + 1] == pytest.approx(1 - one - np.exp(-0.4))


def test_the_teacher_holds_every_aircraft_that_is_drawn():
    env = Environment(ANY.training_scenario, num_envs=64, seed=11)
    env.reset()
    teacher = Teacher(env)
    for _ in range(300):  # 6 s, in wind and in noise
        step = env.step(teacher.action())
        assert not step.terminated.any()
    assert step.error.max() < 0.05
    assert np.abs(env.engine.qvel[:, 3:]).max() < 0.3


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"control_mode": "share"}, "share_of_x"),
        ({"observe": {"action_history": 1}}, "at least 2"),
    ],
)
def test_what_the_teacher_needs_is_said(changes, said, tmp_path):
    with pytest.raises(QuadrlError, match=f"{said}.*teacher"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        quadrl.train("hover", algo="dagger", variant="any", out=tmp_path / "run", **changes)


@pytest.mark.slow
@pytest.mark.parametrize("memory", ["gru", "none"])
def test_dagger_learns_and_resumes_to_the_same_bits(memory, tmp_path):
    small = {
        **{"algo": "dagger", "variant": "any", "memory": memory, "num_envs": 32, "rollout": 32},
        **{"evaluations": 0, "episodes": 1, "hidden": (16,), "memory_width": 16},
    }
    whole = Training(config := TrainConfig("hover", steps=8 * 1024, **small), tmp_path / "whole")
    stopped = Training(config, tmp_path / "stopped")
    stopped.run(lambda progress: stopped.ask(stop=progress.iteration == 4))
    again = Training(config, tmp_path / "stopped", resume=True)
    one, other = whole.run(), again.run()
    for name, array in arrays_of(one).items():
        np.testing.assert_array_equal(arrays_of(other)[name], array)
    log = (tmp_path / "whole" / "metrics.csv").read_text().splitlines()
    column = log[0].split(",").index("distance")
    first, last = (float(log[k].split(",")[column]) for k in (1, 8))
    assert last < first


def test_a_policy_for_any_refuses_what_it_was_not_trained_for():
    policy = Policy(
        weights=(np.zeros((8, 20), np.float32),),
        biases=(np.zeros(8, np.float32),),
        mean=np.zeros(20, np.float32),
        deviation=np.ones(20, np.float32),
        task="hover",
        metadata={"variant": "any"} | ANY.resolved()["scenario"],
    )
    for name in ("paper", "crazyflie", "crazyflie_brushless", "racer"):
        scenario = Scenario.of(policy.scenario, vehicle=name, randomization="none")
        env = Environment(Scenario.of(scenario, control_timestep=0.02, observe=SEES))
        policy.check_fits(env)
    heavy = dataclasses.replace(VEHICLES["racer"], name="heavy", mass=2.5, control_timestep=0.02)
    given = {"randomization": "none", "observe": SEES, "aerodynamics": "none", "weather": "calm"}
    env = Environment(Scenario.of(policy.scenario, vehicle=heavy, **given))
    with pytest.raises(QuadrlError, match=r"mass of the vehicle heavy = 2.5: .*0.025 to 2") as said:
        policy.check_fits(env)
    assert "\n" not in str(said.value)


@pytest.mark.parametrize("name", ["paper", "crazyflie", "crazyflie_brushless", "racer"])
def test_the_shipped_policy_holds_a_place_with_every_preset_late_and_in_real_air(name):
    policy = Policy.pretrained("hover", variant="any")
    given = {"vehicle": name, "control_timestep": 0.02, "aerodynamics": "full", "weather": "calm"}
    late = {"randomization": {"command_delay": 0.02}, "engine": "free_flight"}
    found = quadrl.evaluate(policy, episodes=20, seed=5, **given, **late).metrics
    assert found["success_rate"] == found["survival_rate"] == 1.0
    assert found["position_error_m"] < 0.02
    assert found["yaw_rate_rad_s"] < 0.05


@pytest.mark.slow
def test_a_named_aircraft_whose_sizes_are_drawn_is_told():
    policy = Policy.pretrained("hover", variant="any")
    with pytest.warns(QuadrlWarning, match="draws sizes in place of those of the vehicle paper"):
        quadrl.evaluate(policy, episodes=1, vehicle="paper", control_timestep=0.02)
    found = quadrl.evaluate(policy, episodes=8, engine="free_flight")  # nothing is warned of
    vehicle = found.yardstick().scenario.vehicle  # beside shares of the largest speed
    np.testing.assert_array_equal(vehicle.rotor_command(np.ones(4)), vehicle.max_speed)
    np.testing.assert_array_equal(vehicle.rotor_command(-np.ones(4)), 0.0)


def test_figures_of_drawn_aircraft_are_of_as_many_flights():
    policy = Policy.pretrained("hover", variant="any")
    found = any_aircraft.flown(policy, "any", "drawn: a plus", "none", 0.02, 4)
    assert found["episodes"] == 4 and found["success_rate"] == 1.0


def test_another_projects_policy_is_told_that_it_begins_heading_east(monkeypatch):
    seen = []

    class Published:
        def reset(self):
            seen.clear()

        def evaluate_step(self, observation):
            seen.append(observation)
            return np.zeros((len(observation), 4))

    module = types.SimpleNamespace(Raptor=Published)
    monkeypatch.setitem(sys.modules, "foundation_policy", module)
    environment = Environment(scenario := Scenario.of("hover", vehicle="racer"), num_envs=5, seed=0)
    first = environment.flatten(environment.reset())
    policy = Facing(scenario)
    policy(first)
    way = seen[0][:, 3:12].reshape(-1, 3, 3)
    np.testing.assert_allclose(np.arctan2(way[:, 1, 0], way[:, 0, 0]), 0.0, atol=1e-6)
    distance = np.linalg.norm(environment.snapshot.potentials.to_goal, axis=1)
    np.testing.assert_allclose(np.linalg.norm(seen[0][:, :3], axis=1), distance, rtol=1e-5)
