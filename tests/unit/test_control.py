"""Control modes and controllers: they do what they say, on every layout of rotors."""

import dataclasses
import math

import numpy as np
import pytest
from helpers import LAYOUTS, begun, refused
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from quadrl import control, tasks
from quadrl.aircraft import parameters
from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import NativeError
from quadrl.base.rotation import heading_of, quaternion_from_heading_and_tilt
from quadrl.control import CONTROL_MODES, CONTROLLERS, Gains, Weights, lqr, modes
from quadrl.control.allocation import Allocation
from quadrl.control.geometric import towards_east
from quadrl.control.loops import (
    Loops,
    rotor_lag,
    sampled,
    turned,
)
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.core.task import Snapshot, TaskState
from quadrl.engines.native import compiling
from quadrl.engines.state import Start, State
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.rollout import fly, summarize
from quadrl.tasks.hover import Hover

PAPER = Vehicle()
LOOPED = [name for name, mode in CONTROL_MODES.items() if mode.has_loops]
# High up, and over only by the clock.
FREE = Hover(time_limit=100.0, max_distance=1e3, altitude=500.0)
both = pytest.mark.parametrize("name", CONTROLLERS)
looped = pytest.mark.parametrize("name", LOOPED)
# In still air, in which the laws of loops and models are derived.
presets = pytest.mark.parametrize("vehicle", [LAYOUTS[name] for name in VEHICLES], ids=VEHICLES)
layouts = pytest.mark.parametrize("vehicle", LAYOUTS.values(), ids=LAYOUTS)


def hovering(vehicle, headings, **coordinates):
    """Coordinates of aircraft at the origin, level, at rest and hovering, but for what is given."""
    headings = np.asarray(headings, dtype=float)
    zero = np.zeros((len(headings), 3))
    level = quaternion_from_heading_and_tilt(headings, 0 * headings, 0 * headings)
    speed = np.tile(vehicle.hover_speed, (len(headings), 1))
    names = ("position", "quaternion", "velocity", "body_rate", "rotor_speed")
    return dict(zip(names, (zero, level, zero, zero, speed), strict=True)) | coordinates


def observations(task, headings=(0.0,), goal=(0.0, 0.0, 0.0), vehicle=PAPER, **coordinates):
    """Flat observations (n, size), float64, of such aircraft; the goal in the world frame."""
    motion = hovering(vehicle, headings, **coordinates)
    state = State.of_coordinates(**motion, origin_height=3.0)
    nominal = parameters.Parameters.of(parameters.rows(vehicle), vehicle.control_timestep)
    goals = TaskState(goal=np.broadcast_to(np.asarray(goal, dtype=float), state.position.shape))
    now = Snapshot(state, goals, nominal, state.rotor_speed, state.rotor_speed, state.speed)
    now = dataclasses.replace(now, potentials=task.measure(now))
    return np.concatenate(list(task.observe(now).values()), axis=-1)


class Flyer:
    """Such aircraft, flown in a control mode."""

    def __init__(self, mode, vehicle, headings=(0.0,), **coordinates):
        self.environment = Environment(
            FREE, num_envs=len(headings), seed=0, vehicle=vehicle, control_mode=mode, num_threads=1
        )
        self.environment.reset()
        self.engine, self.mode = self.environment.engine, self.environment.control_mode
        start = Start(**hovering(vehicle, headings, **coordinates))
        self.engine.place(np.arange(len(headings)), start)

    @property
    def state(self):
        return self.engine.state

    def fly(self, action, seconds=0.0):
        """Fly a control step or more; a function of the state gives the action of each anew."""
        shape = (self.environment.num_envs, self.environment.action_size)
        for _ in range(max(1, math.ceil(seconds / self.environment.vehicle.control_timestep))):
            now = action(self.state) if callable(action) else action
            self.environment.step(np.broadcast_to(now, shape))


# ---------------------------------------------------------------------------------- allocation


def allocation_of(vehicle):
    low, high = vehicle.rotor_command(np.array([[-1.0], [1.0]])) ** 2
    return Allocation(np.linalg.pinv(vehicle.mixer), low, high), low, high


@layouts
def test_what_fits_is_given_exactly_and_what_does_not_stays_within_the_limits(vehicle):
    allocation, low, high = allocation_of(vehicle)
    rng, largest = np.random.default_rng(0), [vehicle.mass * GRAVITY, *allocation.moment]
    wrench = largest * rng.uniform([0.98, -0.12, -0.12, -0.12], [1.02, 0.12, 0.12, 0.12], (50, 4))
    expected = wrench @ np.linalg.pinv(vehicle.mixer).T
    np.testing.assert_allclose(allocation.mix(wrench), expected, rtol=1e-9)
    squares = allocation.mix(largest * rng.uniform(-3, 3, (500, 4)))
    assert (squares >= low * (1 - 1e-12)).all() and (squares <= high * (1 + 1e-12)).all()


@layouts
def test_yaw_is_cut_first_then_thrust_then_roll_and_pitch_together(vehicle):
    allocation, low, high = allocation_of(vehicle)
    weight, (roll, pitch, yaw) = vehicle.mass * GRAVITY, allocation.moment
    much_yaw, much_thrust, much_tilt = wrench = np.array(
        [
            [weight, 0.3 * roll, 0.2 * pitch, 9 * yaw],
            [2 * weight, 0.3 * roll, 0.2 * pitch, 0.0],
            [weight, 3 * roll, -1 * pitch, 0.0],
        ]
    )
    given = allocation.mix(wrench) @ vehicle.mixer.T
    np.testing.assert_allclose(given[0, :3], much_yaw[:3], rtol=1e-9)
    assert 0 < given[0, 3] < yaw * (1 + 1e-9)
    np.testing.assert_allclose(given[1, 1:3], much_thrust[1:3], rtol=1e-9)
    assert weight < given[1, 0] < 2 * weight
    # The largest share s of both that fits with any thrust t: low <= s tilt + t lift <= high.
    inverse = np.linalg.pinv(vehicle.mixer)
    rows = np.stack([inverse[:, 1:3] @ much_tilt[1:3], inverse[:, 0]], axis=-1)
    best = linprog(
        [-1, 0], np.vstack([rows, -rows]), np.concatenate([high, -low]), bounds=(0, None)
    )
    np.testing.assert_allclose(given[2, 1:3], best.x[0] * much_tilt[1:3], rtol=1e-9)


# ------------------------------------------------------------------------------------ controllers


def test_the_controller_turns_towards_east_by_the_shorter_way():
    for heading, wanted in ((0.2, 0.0), (-0.2, 0.0), (2.0, 1.5), (-3.0, -2.5)):  # 0.5 rad nearer
        nearer = towards_east(np.array([[math.cos(heading), math.sin(heading)]]))
        np.testing.assert_allclose(nearer, [[math.cos(wanted), math.sin(wanted)]], atol=1e-12)


@pytest.mark.slow
@both
@pytest.mark.parametrize(
    "task",
    [
        *("hover", "static_waypoint", "random_waypoint"),
        *("straight_and_level", "landing", "target_following"),
    ],
)
def test_every_task_of_the_paper_is_solved(name, task):
    figures = summarize(fly(make_controller(name, task), task, episodes=8))
    assert figures["success_rate"] == 1.0
    if task in ("hover", "static_waypoint", "random_waypoint"):
        assert figures["position_error_m"] < 1e-3
    if task == "landing":  # the profile asks for 0.2 m/s at the end
        assert figures["touchdown_speed_max_m_s"] < 0.4


@pytest.mark.slow
@both
@layouts
def test_every_aircraft_hovers_without_tuning(name, vehicle):
    # An LQR with weights for small errors takes its time to turn round.
    task = tasks.make("hover", time_limit=20.0 if name == "lqr" else 10.0)
    flight = fly(make_controller(name, task, vehicle), task, episodes=12, vehicle=vehicle)
    figures = summarize(flight)
    assert figures["success_rate"] == 1.0
    assert figures["position_error_m"] < 0.02


def test_it_lands_though_the_ground_carries_the_rotors():
    # With what it commands far from the ground it hangs 13 cm over the pad.
    scenario = Scenario.of(
        "landing", aerodynamics="ground_effect", vehicle_options={"action_scale": 90.0}
    )
    controller = control.GeometricController(scenario.aircraft, scenario.task)
    found = summarize(fly(controller, scenario, episodes=4, seed=0))
    assert found["success_rate"] == 1 and found["touchdown_speed_max_m_s"] < 0.35


@pytest.mark.parametrize(("name", "speed", "spin"), [("geometric", 1.5, 3.0), ("lqr", 0.0, 0.0)])
def test_recovers_from_sixty_degrees_of_tilt(name, speed, spin):
    """Far outside of what is linear; geometric control from tumbling as well."""
    wild = dict(tilt=math.radians(60), speed=speed, spin=spin, max_distance=20.0, altitude=20.0)
    task = tasks.make("hover", **wild)
    assert summarize(fly(make_controller(name, task), task, episodes=50))["success_rate"] == 1.0


def test_a_task_brings_gains_of_its_own_unless_others_are_given():
    class Gentle(Hover):
        gains = {"level": 0.6, "max_speed": 1.0}

    seen = observations(Hover(), goal=(0.2, 0, 0))

    def action(task, *gains):
        return control.GeometricController(PAPER, task, *gains)(seen)

    own = action(Gentle())
    np.testing.assert_array_equal(own, action(Hover(), Gains(**Gentle.gains)))
    np.testing.assert_array_equal(action(Gentle(), Gains()), action(Hover()))
    assert np.abs(own).max() < 0.5 * np.abs(action(Hover())).max()


@both
@layouts
def test_rows_are_flown_as_each_alone_and_no_attitude_breaks_it(name, vehicle):
    """Bit for bit: straight up, straight down, on its back; far away, and on the goal."""
    task, rng = tasks.make("hover"), np.random.default_rng(0)
    turns = [angle * axis for angle in np.linspace(-math.pi, math.pi, 17) for axis in np.eye(3)]
    quaternion, count = Rotation.from_rotvec(turns).as_quat(scalar_first=True), len(turns)
    goal = rng.choice([0.0, 0.1, 1e3, -1e3], (count, 3))
    speed = vehicle.hover_speed * rng.uniform(0.5, 1.1, (count, vehicle.rotor_count))
    motion = dict(quaternion=quaternion, velocity=rng.normal(size=(count, 3)), rotor_speed=speed)
    seen = observations(task, np.zeros(count), goal, vehicle, **motion)
    controller = make_controller(name, task, vehicle)
    action = controller(seen)
    assert action.shape == (count, vehicle.rotor_count) and (np.abs(action) <= 1).all()
    for k in range(count):
        np.testing.assert_array_equal(controller(seen[k]), action[k])


@presets
def test_the_linear_model_is_the_derivative_of_the_engine(vehicle):
    """Central differences of one control step of MuJoCo, so that the squares cancel."""
    # With one lag in both directions: the step response is not linear otherwise. Of the dead time
    # the model knows nothing.
    lag = rotor_lag(vehicle)[0]
    rotors = [dataclasses.replace(rotor, lag_up=lag, lag_down=lag) for rotor in vehicle.rotors]
    vehicle = dataclasses.replace(vehicle, rotors=tuple(rotors), dead_time=0.0)
    count = vehicle.rotor_count
    # Steps that move every quantity about alike [m, m/s, rad, rad/s, rad/s, 1].
    sizes = np.repeat([1e-4, 1e-4, 1e-5, 1e-5, 1e-3, 1e-4], [3, 3, 3, 3, count, count])
    x = np.concatenate([np.diag(sizes), -np.diag(sizes)])
    part = {name: x[:, : 12 + count][:, where] for name, where in lqr.STATES.items()}
    turn = Rotation.from_rotvec(part.pop("attitude"))
    part["quaternion"] = turn.as_quat(scalar_first=True)
    part["rotor_speed"] = part["rotor_speed"] + vehicle.hover_speed
    flyer = Flyer("rotor", vehicle, np.zeros(len(x)), **part)
    flyer.fly(x[:, 12 + count :])
    state = flyer.state
    attitude = Rotation.from_matrix(np.array(state.rotation)).as_rotvec()
    speed = state.rotor_speed - vehicle.hover_speed
    after = np.concatenate([state.position, state.velocity, attitude, state.body_rate, speed], -1)
    difference = (after[: len(sizes)] - after[len(sizes) :]) / (2 * sizes[:, None])
    a, b = sampled(*lqr.linear_model(vehicle), vehicle.control_timestep)
    # RK4 takes the lag to (k_c dt)^5 / 120: 4e-9 for the paper's aircraft, 3e-6 for the hexa.
    np.testing.assert_allclose(difference.T, np.hstack([a, b]), rtol=2e-5, atol=2e-5)


# ---------------------------------------------------------------------------------- control modes


def test_scales_by_worked_numbers():
    """Of the paper's aircraft: hover at 225.678 rad/s, commands from 190.678 to 260.678 rad/s."""
    # 0.8 g (1 - (190.678 / 225.678)^2) = 2.246 m/s^2 down; up 2.623; the smaller counts.
    # Thrust and body rates: commands from 0 to 319.157 rad/s. (319.157 / 225.678)^2 - 1 = 1 weight
    # to add, 1 to take away; rates with 319.157^2 in place of 260.678^2 - 190.678^2 below.
    # Tilted by 0.4 rad: g tan 0.4 = 4.148 m/s^2. In a second: m/s; over another: m.
    # Roll: 0.8 l k_T (260.678^2 - 190.678^2) / J_x = 24.26 rad/s^2; sqrt(24.26 * 0.4) = 3.115.
    # Yaw: 0.8 * 2 k_Q (260.678^2 - 190.678^2) / J_z = 2.917; sqrt(2.917 * 0.5) = 1.208.
    expected = {
        "rotor": ([225.678] * 4, [35.0] * 4),
        "share": ([159.578] * 4, [159.578] * 4),  # half of 319.157
        "share_of_x": ([159.578] * 4, [159.578] * 4),
        "thrust_body_rate": ([1, 0, 0, 0], [1.0, 5.593, 5.593, 2.168]),
        "velocity": ([0] * 4, [4.148, 4.148, 2.246, 1.208]),
        "position": ([0] * 4, [4.148, 4.148, 2.246, 0.5]),
    }
    assert set(expected) == set(CONTROL_MODES)
    for name, (centre, scale) in expected.items():
        mode = modes.kind(name)(PAPER)
        np.testing.assert_allclose(mode.centre, centre, atol=6e-4)
        np.testing.assert_allclose(mode.scale, scale, atol=6e-4)
        np.testing.assert_allclose(mode.scale_down, scale, atol=6e-4)
    hexa = [modes.kind(name)(VEHICLES["hexa"]) for name in ("rotor", "velocity")]
    assert [term.name for term in hexa[0].terms] == [f"rotor_{k}" for k in range(1, 7)]
    assert [mode.size for mode in hexa] == [6, 4]


@layouts
@pytest.mark.parametrize("name", ["rotor", *LOOPED])
def test_no_action_hovers_at_any_heading_and_actions_are_clipped(name, vehicle):
    flyer = Flyer(name, vehicle, headings=(0.0, 2.0, -1.5))
    flyer.fly(0.0, 1.0)
    # Leaning rotors that differ push it aside.
    assert np.abs(flyer.state.position).max() < (1e-3 if vehicle.name == "leaning" else 1e-9)
    action = np.random.default_rng(0).uniform(-3, 3, (3, flyer.mode.size))
    clipped = flyer.mode.setpoint(flyer.state, np.clip(action, -1, 1))
    np.testing.assert_array_equal(flyer.mode.setpoint(flyer.state, action), clipped)


@pytest.mark.slow
@presets
@looped
def test_wild_actions_stay_within_the_rotors_limits_and_do_not_flip_the_aircraft(name, vehicle):
    """Every number at a limit, drawn anew now and then; body rates for a control step only."""
    flyer, rates = Flyer(name, vehicle, np.linspace(0, 6, 16)), name == "thrust_body_rate"
    low, high = flyer.mode.reach(vehicle).rotor_command(np.array([[-1.0], [1.0]]))
    rng, share, upright = np.random.default_rng(0), [], []
    for _ in range(20 if rates else 5):
        action = np.sign(rng.uniform(-1, 1, (16, 4)))
        for _ in range(1 if rates else rng.integers(1, 10)):
            flyer.fly(action)
            share.append((flyer.engine.ctrl - low) / (high - low))
            upright.append(flyer.state.rotation[:, 2, 2].min())
            assert not rates or (np.abs(flyer.state.body_rate) < 1.3 * flyer.mode.scale[1:]).all()
    assert np.min(share) > -1e-12 and np.max(share) == pytest.approx(1)  # and all of it is used
    assert rates or 0.5 < min(upright) < 0.99
    flyer.fly(0.0, 2.0 if rates else 3.2)
    assert flyer.state.angular_speed.max() < 0.02
    assert rates or flyer.state.rotation[:, 2, 2].min() > 0.999


@presets
@pytest.mark.parametrize("action", [-1.0, 0.5, 1.0])
def test_thrust_gives_the_acceleration_that_it_says(vehicle, action):
    """m a = (share - 1) m g less drag, after twelve time constants of rotor and step."""
    flyer, vertical = Flyer("thrust_body_rate", vehicle), np.array([[action, 0, 0, 0]])
    share = flyer.mode.values(vertical)[0, 0]
    flyer.fly(vertical, 12 * (1 / rotor_lag(vehicle)[1] + vehicle.physics_timestep))
    before = flyer.state.velocity[0].copy()
    flyer.fly(vertical)
    after = flyer.state.velocity[0]
    acceleration = (after - before) / vehicle.control_timestep
    square = (before**2 + before * after + after**2) / 3  # the mean of a speed that grows evenly
    drag = vehicle.drag_coefficient / vehicle.mass * np.sign(after) * square
    expected = np.array([0, 0, (share - 1) * GRAVITY]) - drag
    np.testing.assert_allclose(acceleration, expected, atol=1e-4 * GRAVITY)


def test_the_largest_thrust_is_that_of_all_rotors_and_the_least_is_none():
    """Whatever the action scale is."""
    full = VEHICLES["racer"]
    flyer = Flyer("thrust_body_rate", full)
    most = sum(r.thrust_coefficient * r.max_speed**2 for r in full.rotors) / full.mass / GRAVITY
    values = flyer.mode.values(np.array([[1.0, 0, 0, 0], [0.0] * 4, [-1.0, 0, 0, 0]]))
    np.testing.assert_allclose(values[:, 0], [most, 1.0, 0.0], rtol=0, atol=1e-12)
    assert most > 4.5
    for action, expected in ((1.0, full.max_speed), (-1.0, 0.0)):
        flyer.fly(np.array([[action, 0.0, 0.0, 0.0]]), 1.0)
        np.testing.assert_allclose(flyer.state.rotor_speed[0], expected, atol=1.0)


def settling(vehicle, poles, share, limit):
    """Time [s] in which a step response with n poles at one bandwidth is within 5 percent.

    1 - exp(-x) sum_{k<n} x^k / k! = 0.95 at x = 4.74 and 7.75 for n = 2 and 4; a control step is
    added, since that is how often it is looked at. The bandwidth is the share that the gains ask
    for of what the rotors allow, or a limit [rad/s] if that is less.
    """
    allowed = 1 / (1 / rotor_lag(vehicle)[1] + vehicle.physics_timestep)
    return {2: 4.74, 4: 7.75}[poles] / min(share * allowed, limit) + vehicle.control_timestep


@presets
@pytest.mark.parametrize("axis", [1, 2, 3])
def test_a_body_rate_is_reached_in_its_time_and_held(vehicle, axis):
    """A rate and the lag make two poles; at an action of 1 the largest moment limits it too."""
    flyer = Flyer("thrust_body_rate", vehicle, headings=(0.0, 0.0))
    actions, rates = np.array([[0.3], [-1.0]]) * np.eye(4)[axis], flyer.mode.scale[1:]
    wanted = actions[:, 1:] * rates
    near = 0.05 * np.abs(wanted).max(axis=1, keepdims=True)
    # At the limit p / 2 times the largest rate is the largest angular acceleration: the rate is
    # sqrt(acceleration * angle).
    share, limit = (1.0, 2 * rates[2] / 0.5) if axis == 3 else (1.3, 2 * min(rates[:2]) / 0.4)
    seconds = 1.1 * settling(vehicle, 2, share, limit)
    flyer.fly(actions, seconds)
    assert (np.abs(flyer.state.body_rate - wanted) < near).all()
    flyer.fly(actions, seconds)
    assert (np.abs(flyer.state.body_rate - wanted) < near / 10).all()


@presets
def test_a_velocity_is_reached_in_its_time_and_held_at_any_heading(vehicle):
    """Velocity, tilt, body rate and lag make four poles; far off the acceleration is limited."""
    flyer = Flyer("velocity", vehicle, headings=(0.0, 2.0, 4.0) * 2)
    actions = np.concatenate([-0.1 * np.eye(3, 4), np.eye(3, 4)])
    wanted = actions[:, :3] * flyer.mode.scale[:3]
    near = 0.05 * np.abs(wanted).max(axis=1, keepdims=True)

    def error():
        back = heading_of(flyer.state.rotation) * [1, -1]
        return np.abs(turned(flyer.state.velocity, back) - wanted)

    # At the limit p^2 times the largest angle is the largest angular acceleration.
    rates = Loops(vehicle, vehicle.physics_timestep, "velocity").max_body_rate
    # The scale is the largest acceleration times a second: a tenth of it takes 0.1 s more.
    flyer.fly(actions, settling(vehicle, 4, 1.3, min(rates[:2]) / 0.4) + 0.1)
    assert (error() < near)[:3].all()
    flyer.fly(actions, 0.9)
    assert (error() < near)[3:].all()
    flyer.fly(actions, 2.0)
    assert (error() < near / 10).all()


@presets
def test_a_position_is_reached_and_held_without_overshoot_and_no_action_brakes(vehicle):
    # Three fly to a place; the fourth flies east, and no action brakes it.
    velocity = np.outer([0, 0, 0, 1], [2.0, 0.0, 0.0])
    flyer = Flyer("position", vehicle, headings=(0.0, 0.8, -0.6, 0.0), velocity=velocity)
    place, east, share = np.array([4.0, -2.0, 0.7]), np.tile([1.0, 0.0], (4, 1)), []

    def action(state):
        back = heading_of(state.rotation) * [1, -1]
        x, y = turned(east, back).T
        there = np.column_stack([turned(place - state.position, back), np.arctan2(y, x)])
        return there * np.array([[1], [1], [1], [0]]) / flyer.mode.scale

    for step in range(16):
        flyer.fly(action, 0.5)
        share.append((flyer.state.position[:3] @ place / (place @ place)).max())
        if step == 7:
            assert flyer.state.speed[3] < 0.01
            # Without lag 2 m/s over the rate of the velocity loop, 1.7 / s for the slowest
            # aircraft: 1.2 m.
            assert 0.2 < flyer.state.position[3, 0] < 2.4
    assert max(share) < 1.01
    np.testing.assert_allclose(flyer.state.position[:3], np.tile(place, (3, 1)), atol=0.01)
    np.testing.assert_allclose(heading_of(flyer.state.rotation)[:3], east[:3], atol=0.03)


# ----------------------------------------------------------------------------- in the environment


@pytest.mark.parametrize(
    "settings",
    [
        {"num_envs": 1},
        {"num_envs": 11, "engine": "free_flight", "randomization": {"mass": (0.9, 1.1)}},
        {"num_envs": 3, "vehicle": "hexa", "randomization": "full", "task": "landing"},
        {"num_envs": 2, "vehicle": "crazyflie", "engine": "free_flight"},
    ],
    ids=["one", "batch", "late", "dead time"],
)
@looped
def test_compiled_loops_command_what_numpy_commands(name, settings, monkeypatch):
    flown = []
    for compiled in (True, False):
        with monkeypatch.context() as patch:
            if not compiled:
                patch.setattr(compiling, "compile_generated", fail)
            environment = Environment(
                **{"task": "hover", "seed": 3, "control_mode": name} | settings
            )
        assert environment.autopilot.is_compiled == compiled
        environment.reset()
        rng, track = np.random.default_rng(0), []
        for _ in range(12):
            done = environment.step(rng.uniform(-1, 1, (environment.num_envs, 4)))
            engine, command = environment.engine, environment.snapshot.rotor_command
            track += [engine.qpos.copy(), engine.act.copy(), command.copy(), done.reward.copy()]
        flown.append(track)
    # Only sine and cosine of the yaw are another library's; all else are the same bits.
    close = {"rtol": 1e-9, "atol": 1e-9} if name == "position" else {"rtol": 0, "atol": 0}
    for found, expected in zip(*flown, strict=True):
        np.testing.assert_allclose(found, expected, **close)


def fail(source):
    raise NativeError("there is no C compiler")


@looped
def test_a_divergence_within_the_physics_steps_of_loops_ends_the_episode(name):
    environment = begun("hover", num_envs=3, control_mode=name)
    control_rotors, calls = environment.control, []

    def faulty(most):
        calls.append(control_rotors(most))
        if len(calls) == PAPER.substeps:
            environment.engine.qvel[-1, 5] = np.nan
        return calls[-1]

    environment.control = faulty
    now = environment.step(np.tile([0.3, -0.2, 0.1, 0.5], (3, 1)))
    assert len(calls) == PAPER.substeps
    np.testing.assert_array_equal(now.diverged, [False, False, True])
    np.testing.assert_array_equal(now.terminated, [False, False, True])
    environment.control = control_rotors
    assert not environment.step(np.zeros((3, 4))).diverged.any()


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["paper", "crazyflie"])
def test_who_knows_how_the_target_goes_on_lags_behind_no_longer(vehicle):
    error = {}
    for sees in (False, True):
        task = tasks.make("target_following", sees_motion=sees)
        rollout = fly(
            make_controller("geometric", task, vehicle), task, episodes=4, vehicle=vehicle
        )
        error[sees] = summarize(rollout)["position_error_m"]  # over the last 2 s of 20
    # Centimetres of lag; with acceleration and jerk only what snap and rotors add is left, which
    # is tenths of millimetres on paths that change within seconds.
    assert error[True] < error[False] / 20


@pytest.mark.parametrize(
    ("call", "name", "value"),
    [
        (lambda: make_controller("lqg", "hover"), "controller", "lqg"),
        (lambda: make_controller("lqr", "hovr"), "task", "hovr"),
        (lambda: make_controller("lqr", "hover", "papr"), "vehicle", "papr"),
        (lambda: modes.kind("velocty"), "control_mode", "velocty"),
        (lambda: make_controller("lqr", "hover")(np.zeros(25)), "observation size", 25),
        (lambda: Gains(authority=1.1), "authority", 1.1),
        (lambda: Gains(max_tilt=2.0), "max_tilt", 2.0),
        (lambda: Weights(tilt=0.0), "tilt", 0.0),
    ],
)
def test_what_cannot_be_is_refused_by_name(call, name, value):
    with refused(name, value):
        call()
