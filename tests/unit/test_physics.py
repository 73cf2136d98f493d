"""Statements about flight that anyone can check by hand, in MuJoCo and in the equations."""

import math

import helpers
import mujoco
import numpy as np
import pytest

from quadrl.aircraft.parameters import Parameters, rows
from quadrl.aircraft.vehicle import Vehicle
from quadrl.engines import dynamics, mjcf
from quadrl.engines.mujoco import BatchEngine, DataEngine

PAPER = Vehicle()
VACUUM = Vehicle(drag_coefficient=0.0, moment_coefficient=0.0)
HOVER = math.sqrt(0.65 * 9.81 / (4 * 3.13e-5))  # = 225.678 rad/s
UPRIGHT = (1, 0, 0, 0)
both = pytest.mark.parametrize("engine", ["mujoco", "free_flight"])


def aircraft(engine, vehicle=PAPER, *, height=100.0, rate=(0, 0, 0), velocity=(0, 0, 0), speed=0.0):
    """One level aircraft in an engine; its rotors are commanded the speed that they have."""
    flying = BatchEngine(vehicle, 1, altitude=3.0, engine=engine)
    flying.qpos[:] = (0, 0, height, *UPRIGHT)
    flying.qvel[:] = (*velocity, *rate)
    flying.act[:] = flying.ctrl[:] = speed
    return flying


def accelerations(
    vehicle=PAPER,
    *,
    speed=0.0,
    velocity=(0, 0, 0),
    rate=(0, 0, 0),
    wind=(0, 0, 0),
    attitude=UPRIGHT,
):
    """World linear (3,) and body angular (3,) acceleration, the same from MuJoCo and by NumPy."""
    model = mjcf.compile_model(vehicle)
    one = DataEngine(vehicle, model, mujoco.MjData(model), altitude=3.0)
    one.qpos[:], one.qvel[:] = (0, 0, 100, *attitude), (*velocity, *rate)
    one.act[:], one.wind[:] = speed, wind
    mujoco.mj_forward(model, one.data)
    moving = (one.qpos[:, :3], one.qpos[:, 3:], one.qvel[:, :3], one.qvel[:, 3:], one.act)
    p = Parameters.of(rows(vehicle))
    motion = dynamics.derivative(p, dynamics.Motion(*moving), one.act, one.wind, -9.81)
    for equation, engine in ((motion.velocity, slice(0, 3)), (motion.body_rate, slice(3, 6))):
        np.testing.assert_allclose(equation[0], one.data.qacc[engine], rtol=1e-12, atol=1e-12)
    return motion.velocity[0], motion.body_rate[0]


@both
def test_free_fall_without_drag_is_minus_g(engine):
    falling = aircraft(engine, VACUUM)
    falling.advance(100)  # 1 s
    np.testing.assert_allclose(falling.qvel, [[0, 0, -9.81, 0, 0, 0]], atol=1e-12)
    # 100 m - 9.81/2 m
    np.testing.assert_allclose(falling.qpos[0, :3], [0, 0, 95.095], atol=1e-10)


# Rotors that lean push it sideways, and in air that turns it.
HOVERING = {n: v for n, v in (helpers.LAYOUTS | helpers.IN_AIR).items() if n != "leaning in air"}


@both
@pytest.mark.parametrize("name", HOVERING)
def test_every_layout_hovers_at_its_hover_speed(name, engine):
    vehicle = HOVERING[name]
    hovering = aircraft(engine, vehicle, speed=vehicle.hover_speed)
    hovering.advance(round(2 / vehicle.physics_timestep))
    # Rotors that lean may push it sideways.
    np.testing.assert_allclose(hovering.qpos[:, 2:], [[100, *UPRIGHT]], atol=1e-8)


def test_thrust_is_up_in_the_body_frame():
    # Nose down by 30 deg about +y at hover speed: 9.81 sin 30 = 4.905 ahead (east), and
    # 9.81 (cos 30 - 1) = -1.3143 of what is left against gravity.
    nose_down = (math.cos(math.pi / 12), 0, math.sin(math.pi / 12), 0)
    linear, _ = accelerations(attitude=nose_down, speed=HOVER)
    np.testing.assert_allclose(linear, [4.905, 0, -1.31429], atol=1e-5)


def test_drag_opposes_the_motion_through_the_air_and_grows_with_its_square():
    # |v| = 5: F = -9e-3 * 5 * (3, 4, 0) = (-0.135, -0.18, 0); over 0.65 kg.
    linear, angular = accelerations(velocity=(3, 4, 0))
    np.testing.assert_allclose(linear, [-0.135 / 0.65, -0.18 / 0.65, -9.81], rtol=1e-12)
    np.testing.assert_array_equal(angular, 0)
    drifting, _ = accelerations(velocity=(3, 4, 0), wind=(3, 4, 0))
    np.testing.assert_allclose(drifting, [0, 0, -9.81], atol=1e-14)
    # At rest in a west wind of 5 m/s: 9e-3 * 25 / 0.65 = 0.346154 to the east.
    pushed, angular = accelerations(wind=(5, 0, 0))
    np.testing.assert_allclose(pushed, [0.225 / 0.65, 0, -9.81], rtol=1e-12)
    np.testing.assert_array_equal(angular, 0)


def test_the_wind_is_one_of_the_world():
    # The nose to the north, a wind to the east: it is pushed to the east all the same.
    north = (math.sqrt(0.5), 0, 0, math.sqrt(0.5))
    pushed, _ = accelerations(wind=(5, 0, 0), attitude=north)
    np.testing.assert_allclose(pushed, [0.225 / 0.65, 0, -9.81], atol=1e-12)


@pytest.mark.parametrize(
    ("speeds", "expected"),
    [
        # Roll and pitch: l k_T (210^2 - 190^2) = 0.23 * 3.13e-5 * 8000 = 0.057592 N m; over
        # 7.5e-3: 7.678933. The pair together has 210^2 + 190^2 - 2 * 200^2 = 200 more than the
        # other: a yaw of 7.5e-7 * 200 = 1.5e-4 N m; over 1.3e-2: 0.011538.
        ((200, 210, 200, 190), (7.678933, 0, 0.011538)),  # more on the left: to the right, +x
        ((200, 190, 200, 210), (-7.678933, 0, 0.011538)),
        ((190, 200, 210, 200), (0, 7.678933, -0.011538)),  # more behind: nose down, +y
        ((210, 200, 190, 200), (0, -7.678933, -0.011538)),
        # Yaw: k_Q 2 (210^2 - 190^2) = 7.5e-7 * 16000 = 0.012 N m; over 1.3e-2: 0.923077.
        ((190, 210, 190, 210), (0, 0, 0.923077)),  # 2 and 4 yaw to the left, +z
        ((210, 190, 210, 190), (0, 0, -0.923077)),
    ],
)
def test_sign_and_size_of_each_torque(speeds, expected):
    _, angular = accelerations(speed=speeds)
    np.testing.assert_allclose(angular, expected, atol=1e-6)
