"""The action interfaces: what an action asks for is what the aircraft does, on every aircraft."""

import dataclasses
import json
import math

import gymnasium as gym
import numpy as np
import pytest

import quadrl
from quadrl import testing
from quadrl.controllers import make as make_controller
from quadrl.environment import ActionError, Environment
from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.interfaces import INTERFACES, make
from quadrl.learning.config import RunError, TrainConfig
from quadrl.learning.evaluate import fly
from quadrl.learning.train import Training
from quadrl.loops import MAX_TURN, Gains, Loops, heading_of
from quadrl.policy import Policy
from quadrl.rotation import quaternion_from_heading_and_tilt
from quadrl.state import Start
from quadrl.task import OptionError
from quadrl.tasks import make as make_task
from quadrl.vehicle import GRAVITY, VEHICLES, Vehicle

LOOPED = [name for name in INTERFACES if name != "rotor"]
# High up, and over only by the clock.
FREE = make_task("hover", horizon=100.0, max_distance=1e3, altitude=500.0)
every_aircraft = pytest.mark.parametrize("vehicle", VEHICLES.values(), ids=VEHICLES)
looped = pytest.mark.parametrize("name", LOOPED)
TINY = TrainConfig(num_envs=4, rollout=4, steps=64, hidden=(4,), critic_hidden=(4,))


class Flyer:
    """N aircraft that begin level at the origin, at rest, with given headings [rad]."""

    def __init__(self, name, vehicle, headings=(0.0,), task=FREE, **coordinates):
        count = len(headings)
        self.environment = Environment(
            task, num_envs=count, seed=0, vehicle=vehicle, action=name, num_threads=1
        )
        self.environment.reset()
        none = np.zeros(count)
        values = {
            "position": np.zeros((count, 3)),
            "quaternion": quaternion_from_heading_and_tilt(np.array(headings), none, none),
            "velocity": np.zeros((count, 3)),
            "body_rate": np.zeros((count, 3)),
            "rotor_speed": np.full((count, 4), vehicle.hover_speed),
        }
        start = Start(**values | coordinates)
        self.environment.simulation.place(np.arange(count), start)

    @property
    def state(self):
        return self.environment.simulation.state

    @property
    def interface(self):
        return self.environment.interface

    def step(self, action):
        return self.environment.step(np.broadcast_to(action, self.environment._action_shape))

    def fly(self, action, seconds):
        """Fly on with one action; a function of the state gives it anew at every step."""
        for _ in range(round(seconds / self.environment.vehicle.control_step)):
            self.step(action(self.state) if callable(action) else action)

    def fly_until(self, actions, seconds, reading):
        """Fly on with one action each; a reading (N, 3) of each aircraft at its own time (N,)."""
        steps = np.ceil(np.array(seconds) / self.environment.vehicle.control_step).astype(int)
        log = []
        for _ in range(max(steps)):
            self.step(actions)
            log.append(np.array(reading(self.state)))
        return np.array(log)[steps - 1, np.arange(len(steps))]


def unit(k):
    return np.eye(4)[k]


def settling(vehicle, poles, bandwidth):
    """Time [s] in which a step response with n poles at one bandwidth is within 5 percent.

    1 - exp(-x) sum_{k<n} x^k / k! = 0.95 at x = 4.74, 7.75, 9.15 for n = 2, 4, 5; and a control
    step more, since that is how often it is looked at.
    """
    return {2: 4.74, 4: 7.75, 5: 9.15}[poles] / bandwidth + vehicle.control_step


def unit_of_bandwidth(vehicle):
    return 1 / (1 / vehicle.lag_rate + vehicle.physics_step)


# ------------------------------------------------------------------------------------ the numbers


def test_scales_by_worked_numbers():
    """Of the paper's aircraft: hover at 225.678 rad/s, commands from 190.678 to 260.678 rad/s."""
    # 0.8 g (1 - (190.678 / 225.678)^2) = 2.246 m/s^2 down; up 2.623; the smaller counts.
    # Tilted by 0.4 rad: g tan 0.4 = 4.148 m/s^2. In a second: m/s; over another: m.
    # Roll: 0.8 l k_T (260.678^2 - 190.678^2) / J_x = 24.26 rad/s^2; sqrt(24.26 * 0.4) = 3.115.
    # Yaw: 0.8 * 2 k_Q (260.678^2 - 190.678^2) / J_z = 2.917; sqrt(2.917 * 0.5) = 1.208.
    expected = {
        "rotor": ([225.678] * 4, [35.0] * 4),
        "thrust_body_rate": ([1, 0, 0, 0], [0.229, 3.115, 3.115, 1.208]),
        "velocity": ([0] * 4, [4.148, 4.148, 2.246, 1.208]),
        "position": ([0] * 4, [4.148, 4.148, 2.246, 0.5]),
    }
    assert set(expected) == set(INTERFACES)
    for name, (centre, scale) in expected.items():
        interface = make(name, Vehicle())
        np.testing.assert_allclose(interface.centre, centre, atol=6e-4)
        np.testing.assert_allclose(interface.scale, scale, atol=6e-4)


@pytest.mark.parametrize("name", INTERFACES)
def test_actions_outside_of_the_range_are_clipped(name):
    one, other = (Flyer(name, Vehicle()) for _ in range(2))
    one.fly([1.0, -1.0, 0.2, 1.0], 0.5)
    other.fly([7.0, -3.0, 0.2, 1.0], 0.5)
    np.testing.assert_array_equal(one.state.position, other.state.position)
    np.testing.assert_array_equal(one.state.rotor_speed, other.state.rotor_speed)


@every_aircraft
@pytest.mark.parametrize("name", INTERFACES)
def test_no_action_hovers_from_rest_at_any_heading(name, vehicle):
    flyer = Flyer(name, vehicle, headings=(0.0, 2.0, -1.5))
    flyer.fly(np.zeros(4), 3.0)
    assert np.abs(flyer.state.position).max() < 1e-9
    assert flyer.state.spin.max() < 1e-9


@every_aircraft
@looped
def test_rotors_are_commanded_within_what_rotor_actions_command(name, vehicle):
    flyer = Flyer(name, vehicle, headings=np.zeros(8))
    low, high = vehicle.rotor_command(np.array([-1.0, 1.0]))
    rng, reached = np.random.default_rng(0), []
    for _ in range(30):
        flyer.step(rng.uniform(-1, 1, (8, 4)))
        reached.append(flyer.environment.simulation.ctrl.copy())
    assert np.min(reached) >= low * (1 - 1e-12) and np.max(reached) <= high * (1 + 1e-12)
    assert np.max(reached) == pytest.approx(high)  # and all of it is used


# ---------------------------------------------------------------------------- thrust and body rate


@every_aircraft
@pytest.mark.parametrize("action", [-1.0, 0.5, 1.0])
def test_thrust_gives_the_acceleration_that_it_says(vehicle, action):
    """m a = (share - 1) m g, from rest and before there is drag; half a unit after the lag."""
    flyer = Flyer("thrust_body_rate", vehicle)
    share = flyer.interface.values(action * unit(0))[0]
    flyer.fly(action * unit(0), 12 / unit_of_bandwidth(vehicle))
    thrust = vehicle.thrust_coefficient * np.sum(flyer.state.rotor_speed**2)
    assert thrust / (vehicle.mass * GRAVITY) == pytest.approx(share, rel=1e-5)
    before = flyer.state.velocity[0].copy()
    flyer.step(action * unit(0))
    after = flyer.state.velocity[0]
    acceleration = (after - before) / vehicle.control_step
    middle = (before + after) / 2
    drag = vehicle.drag_coefficient / vehicle.mass * np.abs(middle) * middle
    expected = np.array([0, 0, (share - 1) * GRAVITY]) - drag
    np.testing.assert_allclose(acceleration, expected, atol=1e-4 * GRAVITY)


@every_aircraft
def test_a_body_rate_is_reached_in_its_time_and_held(vehicle):
    """A rate and the lag make two poles; at an action of 1 the largest moment limits it too."""
    cases = [(k, action) for k in (1, 2, 3) for action in (0.3, -1.0)]
    flyer = Flyer("thrust_body_rate", vehicle, headings=np.zeros(len(cases)))
    rates, seconds = flyer.interface.scale[1:], []
    for k, _ in cases:
        # The bandwidth that the gains ask for; or, if less, that at which p / 2 times the largest
        # rate is the largest angular acceleration: the rate is sqrt(acceleration * angle).
        if k == 3:
            asked, limit = Gains().heading, 2 * rates[2] / MAX_TURN
        else:
            asked, limit = Gains().level, 2 * min(rates[:2]) / Gains().max_tilt
        bandwidth = min(asked * unit_of_bandwidth(vehicle), limit)
        seconds.append(1.1 * settling(vehicle, 2, bandwidth))
    actions = np.array([action * unit(k) for k, action in cases])
    wanted = actions[:, 1:] * rates
    near = 0.05 * np.abs(wanted).max(axis=1)
    reached = flyer.fly_until(actions, seconds, lambda state: state.body_rate)
    assert (np.abs(reached - wanted).max(axis=1) < near).all()
    flyer.fly(actions, max(seconds))
    assert (np.abs(flyer.state.body_rate - wanted).max(axis=1) < near / 10).all()


@every_aircraft
def test_body_rates_and_thrust_are_held_together(vehicle):
    flyer = Flyer("thrust_body_rate", vehicle)
    action = np.array([0.2, 0.3, -0.2, 0.3])
    flyer.fly(action, 3.0)
    wanted = flyer.interface.values(action)
    np.testing.assert_allclose(flyer.state.body_rate[0], wanted[1:], rtol=0.02)
    thrust = vehicle.thrust_coefficient * np.sum(flyer.state.rotor_speed**2)
    assert thrust / (vehicle.mass * GRAVITY) == pytest.approx(wanted[0], rel=0.02)


# ---------------------------------------------------------------------------- velocity and position


def along(state):
    """Velocities (..., 3) forward, left and up, along the heading."""
    east, north = np.moveaxis(heading_of(state.rotation), -1, 0)
    x, y, up = np.moveaxis(state.velocity, -1, 0)
    return np.stack([east * x + north * y, east * y - north * x, up], axis=-1)


@every_aircraft
def test_a_velocity_is_reached_in_its_time_and_held_at_any_heading(vehicle):
    """Velocity, tilt, body rate and lag make four poles; far off the acceleration is limited."""
    cases = [(k, action) for k in (0, 1, 2) for action in (-0.1, 1.0)]
    flyer = Flyer("velocity", vehicle, headings=np.linspace(0, 5, len(cases)))
    loops = Loops(vehicle, vehicle.physics_step, "velocity")
    # `max_body_rate` is the root of the largest angular acceleration times the largest angle, and
    # the bandwidth is at most the root of their quotient. Upwards the poles are fewer and faster.
    slowest = min(loops.max_body_rate[:2]) / Gains().max_tilt
    bandwidth = min(Gains().level * unit_of_bandwidth(vehicle), slowest)
    actions = np.array([action * unit(k) for k, action in cases])
    wanted = actions[:, :3] * flyer.interface.scale[:3]
    # The scale is the largest acceleration times a second.
    seconds = settling(vehicle, 4, bandwidth) + np.abs(actions).max(axis=1)
    near = 0.05 * np.abs(wanted).max(axis=1)
    reached = flyer.fly_until(actions, seconds, along)
    assert (np.abs(reached - wanted).max(axis=1) < near).all()
    flyer.fly(actions, 2.0)
    assert (np.abs(along(flyer.state) - wanted).max(axis=1) < near / 10).all()
    assert flyer.state.spin.max() < 0.01


@every_aircraft
def test_a_velocity_is_held_through_a_turn(vehicle):
    flyer = Flyer("velocity", vehicle)
    flyer.fly([0.2, 0.0, 0.1, 0.5], 4.0)
    wanted = flyer.interface.values(np.array([0.2, 0.0, 0.1, 0.5]))
    # The direction changes at r, for which no loop looks ahead: the velocity lags by some r / k of
    # an angle, 0.6 / 1.7 for the paper's aircraft, the slowest; the cosine of it is 0.94.
    np.testing.assert_allclose(along(flyer.state)[0, 0], wanted[0], rtol=0.15)
    np.testing.assert_allclose(along(flyer.state)[0, 2], wanted[2], rtol=0.02)
    before = heading_of(flyer.state.rotation)[0]
    flyer.step([0.2, 0.0, 0.1, 0.5])
    after = heading_of(flyer.state.rotation)[0]
    turned = math.atan2(before[0] * after[1] - before[1] * after[0], before @ after)
    assert turned / vehicle.control_step == pytest.approx(wanted[3], rel=0.02)


def towards(interface, place, heading):
    """A policy that asks the position interface for a place (3,) and a heading [rad], again and
    again: offsets along its own heading."""

    def action(state):
        east, north = np.moveaxis(heading_of(state.rotation), -1, 0)
        x, y, up = np.moveaxis(place - state.position, -1, 0)
        turn = np.arctan2(
            east * np.sin(heading) - north * np.cos(heading),
            east * np.cos(heading) + north * np.sin(heading),
        )
        offset = np.stack([east * x + north * y, east * y - north * x, up, turn], axis=-1)
        return offset / interface.scale

    return action


@every_aircraft
def test_a_position_is_reached_and_held(vehicle):
    flyer = Flyer("position", vehicle, headings=(0.0, 2.0, -1.5))
    place, heading = np.array([1.0, -2.0, 0.7]), 0.4
    # Less than 3 m at 4 m/s at most and 2 m/s^2 of braking, then five poles.
    flyer.fly(towards(flyer.interface, place, heading), 7.0)
    for _ in range(20):
        flyer.step(towards(flyer.interface, place, heading)(flyer.state))
        assert np.abs(flyer.state.position - place).max() < 0.01
    turned = heading_of(flyer.state.rotation)
    expected = [math.cos(heading), math.sin(heading)]
    np.testing.assert_allclose(turned, np.tile(expected, (3, 1)), atol=0.01)


@every_aircraft
def test_a_far_position_is_flown_to_without_overshoot_and_no_action_brakes(vehicle):
    flyer = Flyer("position", vehicle)
    distances = []
    for _ in range(round(12 / vehicle.control_step)):
        flyer.step(towards(flyer.interface, np.array([8.0, 0.0, 0.0]), 0.0)(flyer.state))
        distances.append(8.0 - flyer.state.position[0, 0])
    assert distances[-1] == pytest.approx(0.0, abs=0.02)
    assert min(distances) > -0.05
    flyer = Flyer("position", vehicle, velocity=np.array([[2.0, 0.0, 0.0]]))
    flyer.fly(np.zeros(4), 5.0)
    assert flyer.state.speed[0] < 0.01
    # Without lag 2 m/s over the rate of the velocity loop, 1.7 / s for the slowest aircraft: 1.2 m.
    assert 0.2 < flyer.state.position[0, 0] < 2.4


# ----------------------------------------------------------------------------------------- limits


@every_aircraft
@pytest.mark.parametrize("name", ["velocity", "position"])
def test_the_wildest_actions_do_not_flip_the_aircraft(name, vehicle):
    """Every entry at a limit, drawn anew now and then: it tilts, and never past 60 degrees."""
    flyer = Flyer(name, vehicle, headings=np.linspace(0, 6, 64))
    rng, upright = np.random.default_rng(0), []
    for _ in range(10):
        action = np.sign(rng.uniform(-1, 1, (64, 4)))
        for _ in range(rng.integers(1, 10)):
            flyer.step(action)
            upright.append(flyer.state.rotation[:, 2, 2].min())
    assert 0.5 < min(upright) < 0.99
    flyer.fly(np.zeros(4), 4.0)
    assert flyer.state.rotation[:, 2, 2].min() > 0.999


@every_aircraft
def test_the_wildest_rates_are_followed_and_stopped(vehicle):
    flyer = Flyer("thrust_body_rate", vehicle, headings=np.zeros(64))
    rng = np.random.default_rng(0)
    for _ in range(20):
        flyer.step(np.sign(rng.uniform(-1, 1, (64, 4))))
        assert (np.abs(flyer.state.body_rate) < 1.3 * flyer.interface.scale[1:]).all()
    flyer.fly(np.zeros(4), 3.0)
    assert flyer.state.spin.max() < 0.02 * flyer.interface.scale[1]


@looped
def test_a_batch_flies_as_each_alone(name):
    actions = testing.varied_actions(40, 5)
    batch = Environment("hover", num_envs=5, seed=3, action=name)
    batch.reset()
    singles = [Environment("hover", seed=3 + i, action=name) for i in range(5)]
    for single in singles:
        single.reset()
    for action in actions:
        now = batch.step(action)
        for i, single in enumerate(singles):
            alone = single.step(action[i])
            assert alone.reward == now.reward[i]
            np.testing.assert_array_equal(single.simulation.qpos, batch.simulation.qpos[i])
            np.testing.assert_array_equal(single.simulation.act, batch.simulation.act[i])


@looped
def test_saved_environments_go_on_bit_for_bit(name):
    actions = testing.varied_actions(20, 4)
    one = Environment("hover", num_envs=4, seed=3, action=name)
    one.reset()
    for action in actions[:10]:
        one.step(action)
    other = Environment("hover", num_envs=4, action=name)
    other.restore(one.save())
    for action in actions[10:]:
        np.testing.assert_array_equal(one.step(action).reward, other.step(action).reward)


@looped
def test_the_control_term_is_of_the_mean_command(name):
    environment = Environment("hover", seed=0, action=name)
    environment.reset()
    commands, control = [], environment.control

    def noted():
        control()
        commands.append(environment.simulation.ctrl.copy())

    environment.control = noted
    now = environment.step(np.array([0.3, -0.2, 0.1, 0.5]))
    assert len(commands) == environment.vehicle.substeps
    assert np.ptp(commands, axis=0).max() > 0.1  # the loops were at work [rad/s]
    off = np.mean(commands, axis=0) - environment.vehicle.hover_speed
    effort = np.sum((off / environment.vehicle.max_speed) ** 2)
    assert now.reward_terms["control"] == pytest.approx(-effort, rel=1e-9)


@looped
@pytest.mark.parametrize("substep", [0, 2, 4])
@pytest.mark.parametrize("count", [None, 3])
def test_a_divergence_in_any_physics_step_ends_the_episode(name, substep, count):
    environment = Environment("hover", num_envs=count, seed=0, action=name)
    environment.reset()
    zero = np.zeros((*environment.shape, 4))
    environment.step(zero)
    control, calls = environment.control, []

    def broken():
        control()
        if len(calls) == substep:
            environment.simulation.qvel.reshape(-1, 6)[-1, 5] = np.nan
        calls.append(None)

    environment.control = broken
    now = environment.step(zero)
    expected = np.arange(environment.num_envs) == environment.num_envs - 1
    np.testing.assert_array_equal(np.atleast_1d(now.diverged), expected)
    np.testing.assert_array_equal(np.atleast_1d(now.terminated), expected)
    assert not np.any(now.is_success)
    assert np.isfinite(environment.flatten(now.observation)).all()
    environment.control = control
    assert not np.any(environment.step(zero).diverged)


# ------------------------------------------------------------------------------------- the doors


@looped
def test_doors_take_the_option_and_say_what_an_action_is(name):
    interface = make(name, Vehicle())
    assert gym.make("quadrl/Hover-v0", action=name).unwrapped.environment.interface.name == name
    vector = gym.make_vec("quadrl/Hover-v0", num_envs=2, action=name)
    assert vector.action_space.shape == (2, 4)
    assert QuadrotorEnv("hover", 2, action=name).environment.interface.name == name
    spec = quadrl.load("hover", {"action": name}).action_spec()
    assert spec.name == "\t".join(entry.name for entry in interface.entries)
    assert spec.shape == (interface.size,) == (4,)


def test_unknown_interfaces_are_refused_by_every_door():
    for make_one in (
        lambda: Environment("hover", action="velocty"),
        lambda: gym.make("quadrl/Hover-v0", action="velocty"),
        lambda: quadrl.load("hover", {"action": "velocty"}),
        lambda: QuadrotorEnv("hover", action="velocty"),
        lambda: make("velocty", Vehicle()),
    ):
        with pytest.raises(OptionError, match="velocty.*did you mean velocity.*thrust_body_rate"):
            make_one()


@looped
def test_bad_actions_are_refused_as_they_always_are(name):
    environment = Environment("hover", num_envs=2, seed=0, action=name)
    environment.reset()
    with pytest.raises(ActionError, match=r"\(2, 3\) was given; \(2, 4\) is expected"):
        environment.step(np.zeros((2, 3)))
    with pytest.raises(ActionError, match=r"action\[1, 2\] is nan"):
        environment.step(np.array([[0, 0, 0, 0], [0, 0, np.nan, 0]]))


# ------------------------------------------------------------------------------- policies and runs


def test_a_training_policy_and_evaluation_go_by_the_interface(tmp_path):
    config = dataclasses.replace(TINY, action="velocity")
    training = Training(config, tmp_path / "run")
    training.run()
    assert json.loads((tmp_path / "run" / "config.json").read_text())["action"] == "velocity"
    assert TrainConfig.of_folder(tmp_path / "run") == config
    policy = Policy.load(tmp_path / "run")
    assert policy.action == "velocity"
    task = make_task("hover", horizon=0.5)
    own, same = fly(policy, task, episodes=2), fly(policy, task, episodes=2, action="velocity")
    np.testing.assert_array_equal(own.position, same.position)
    plain = fly(lambda seen: policy(seen), task, episodes=2)  # a mere function is for rotors
    assert not np.array_equal(own.position, plain.position)
    with pytest.raises(OptionError, match="Policy gives actions for the interface 'velocity'.*'ro"):
        fly(policy, task, episodes=2, action="rotor")


@pytest.mark.parametrize("name", ["geometric", "lqr"])
def test_controllers_are_refused_other_interfaces(name):
    task = make_task("hover", horizon=0.5)
    with pytest.raises(OptionError, match="'rotor', not for 'position'.*action='rotor'"):
        fly(make_controller(name, task), task, episodes=2, action="position")


def test_a_checkpoint_of_another_interface_is_refused(tmp_path):
    folder = tmp_path / "run"
    Training(TINY, folder).run()
    changed = json.loads((folder / "config.json").read_text()) | {"action": "position"}
    (folder / "config.json").write_text(json.dumps(changed))
    with pytest.raises(RunError, match="action = 'rotor', and here it is 'position'"):
        Training(TrainConfig.of_folder(folder), folder, resume=True)


def test_an_unknown_interface_is_refused_before_a_training_begins():
    with pytest.raises(Exception, match="choices: rotor, thrust_body_rate, velocity, position"):
        dataclasses.replace(TINY, action="torque")
