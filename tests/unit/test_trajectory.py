"""Trajectory: references are the curves that they are said to be, and what cannot be is refused."""

import dataclasses
import math

import numpy as np
import pytest
from helpers import refused

from quadrl import Policy, tasks
from quadrl.aircraft.presets import VEHICLES
from quadrl.base.rotation import roll_pitch_yaw
from quadrl.core.environment import Environment
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.rollout import fly, summarize

FULL_RANGE = dataclasses.replace(VEHICLES["crazyflie"], action_scale=540.0)


def flown(**options):
    """Eight aircraft at the start of a reference, and a function that gives them at a time [s]."""
    environment = Environment(tasks.make("trajectory", **options), num_envs=8, vehicle="crazyflie")
    environment.reset(seed=5)
    now = environment.snapshot
    return environment, lambda seconds: dataclasses.replace(now, time=now.time * 0 + seconds)


@pytest.mark.parametrize("figure", ["random", "lemniscate", "vertical", "polynomial"])
def test_velocity_acceleration_and_jerk_are_slopes(figure):
    environment, at = flown(figure=figure)
    task, step = environment.task, 1e-6
    chain = [
        task.goal,
        task.target_velocity,
        lambda now: task.target_motion(now)[0],
        lambda now: task.target_motion(now)[1],
    ]
    for seconds in (0.013, 4.447, 9.991):  # within pieces
        for value, slope in zip(chain, chain[1:], strict=False):
            measured = (value(at(seconds + step)) - value(at(seconds - step))) / (2 * step)
            np.testing.assert_allclose(measured, slope(at(seconds)), atol=1e-6)


def test_the_eight_is_that_of_its_definition():
    environment, at = flown(figure="lemniscate", period=3.5)
    time = np.arange(0, 3.5, 1e-3)
    place, velocity, acceleration = (
        np.array([function(at(t))[0] for t in time])
        for function in (
            environment.task.goal,
            environment.task.target_velocity,
            lambda now: environment.task.target_motion(now)[0],
        )
    )
    # (cos(2 pi t/T), sin(2 pi t/T) cos(2 pi t/T), 0) from t = T/4 on.
    turn = 2 * math.pi * (time / 3.5 + 0.25)
    expected = np.stack([np.cos(turn), np.sin(turn) * np.cos(turn), 0 * turn], axis=-1)
    np.testing.assert_allclose(place, expected, atol=1e-12)
    # Fastest in the crossing, sqrt(2) w with w = 2 pi/T. The square of the acceleration over w^4 is
    # cos^2 a + 4 sin^2 2a = (1 + c)/2 + 4 - 4 c^2 with c = cos 2a, largest at c = 1/16: (17/8)^2.
    rate = 2 * math.pi / 3.5
    assert np.linalg.norm(velocity, axis=-1).max() == pytest.approx(math.sqrt(2) * rate)
    largest = rate**2 * 17 / 8
    assert np.linalg.norm(acceleration, axis=-1).max() == pytest.approx(largest, rel=1e-5)


def test_a_star_is_flown_at_its_speed_and_a_zigzag_through_its_corners():
    environment, at = flown(figure="pentagram")
    for seconds in np.arange(0.05, 14, 0.37):
        place = environment.task.goal(at(seconds))[0]
        assert np.linalg.norm(place) < 0.7 + 1e-9
        speed = np.linalg.norm(environment.task.target_velocity(at(seconds))[0])
        assert speed == pytest.approx(1.0, rel=0.01)  # a leg is a whole number of pieces
    environment, at = flown(figure="zigzag")
    corner = environment.task.goal(at(0.0))
    assert len(np.unique(corner[:, 0])) > 4 and np.abs(corner).max() < 1  # several curves
    assert not environment.not_compiled


def write(path, rows, names="time,x,y,z"):
    path.write_text(names + "\n" + "\n".join(",".join(map(str, row)) for row in rows))
    return str(path)


def test_a_file_is_followed_to_its_end(tmp_path):
    time = np.linspace(0, 4, 81)
    rows = np.stack([time, np.sin(time), np.cos(time), 0.1 * time], axis=-1)
    environment, at = flown(figure=write(tmp_path / "own.csv", rows))
    for seconds in (0.0, 1.234, 3.9):
        expected = [math.sin(seconds), math.cos(seconds), 0.1 * seconds]
        np.testing.assert_allclose(environment.task.goal(at(seconds))[0], expected, atol=1e-4)
    np.testing.assert_allclose(environment.task.goal(at(9.0))[0], rows[-1, 1:], atol=1e-4)
    assert not environment.task.target_velocity(at(9.0)).any()
    assert not environment.not_compiled


STEADY = [(0.1 * k, 0.01 * k, 0, 0) for k in range(9)]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (STEADY[:5] + [(1.5, 0.05, 0, 0)], "from row 5 to 6 it takes 1.1 s"),  # a gap
        (STEADY[:5] + [(0.5, 9.0, 0, 0)], "from 0.4 to 0.5 s it goes at 89.6 m/s"),  # a jump
        (STEADY[:5] + [(0.3, 0.05, 0, 0)], "from row 5 to 6 it takes -0.1 s"),
        ([], "it has 0 rows$"),
        (STEADY[:5] + [(0.5, "", 0, 0)], "could not convert"),
        (STEADY[:5] + [(0.5, "nan", 0, 0)], "finite numbers .*; row 6 is .0.5, nan, 0.0, 0.0"),
        (STEADY[:5] + [(0.5, 1e300, 0, 0)], "of up to 1e.09; row 6"),
        (STEADY[1:], "from time 0 on; row 1 is at 0.1 s"),
        (STEADY[:3], "must be 5 rows at least; it has 3 rows"),
        ([row[:3] for row in STEADY], "invalid column index"),
        ([(*row, 0.0) for row in STEADY], "a row has more numbers than time,x,y,z has names"),
        ([(t, 50 * x, y, z) for t, x, y, z in STEADY], "within 3 m"),
        ([(t, x, y, -2.9) for t, x, y, _ in STEADY], "0.3 m above the ground"),
    ],
)
def test_a_faulty_file_is_refused(rows, message, tmp_path):
    path = write(tmp_path / "own.csv", rows)
    with refused("trajectory figure", path, match=message):
        tasks.make("trajectory", figure=path)


@pytest.mark.parametrize(
    ("options", "name", "message"),
    [
        ({"figure": "eight"}, "figure", "lemniscate"),
        ({"figure": "none.csv"}, "figure", "a csv file"),
        ({"period": 5.0}, "period", "lemniscate, vertical"),
        ({"figure": "lemniscate", "period": 0.5}, "period", "at least 1 s"),
        ({"extent": 2.5}, "extent", "box"),
        ({"altitude": 1.0}, "extent", "0.3 m above the ground; it goes 1.5"),
    ],
)
def test_an_impossible_reference_is_refused(options, name, message):
    with refused(f"trajectory {name}", match=message):
        tasks.make("trajectory", **options)


@pytest.mark.parametrize(
    ("head", "message"),
    [("0,0,0,0", "no names"), ("", "no column x, but $"), ("t,x,y,z", "0 rows")],
)
def test_a_file_without_names_or_rows_is_refused_and_nothing_else_is_said(
    head, message, tmp_path, recwarn
):
    path = tmp_path / "own.csv"
    path.write_text(head + "\n0.1,0,0,0" * 5 * head.startswith("0"))
    with refused("trajectory figure", str(path), match=message):
        tasks.make("trajectory", figure=str(path))
    assert not recwarn


def test_more_thrust_than_there_is_is_refused():
    eight = tasks.make("trajectory", figure="lemniscate", period=2.0)
    # (2 pi / 2 s)^2 * 2.13 m = 21 m/s^2 level: 2.36 weights, of which the Crazyflie has 1.65.
    with refused("trajectory period", 2.0, match="2.36 weights of .*, and the aircraft has 1.65"):
        Environment(eight, vehicle="crazyflie")
    with refused("trajectory acceleration", 30.0, allowed="smaller"):
        Environment("trajectory", vehicle="crazyflie", task_options={"acceleration": 30.0})
    Environment(eight, vehicle="racer")


@pytest.mark.slow
def test_the_yardstick_flies_the_fast_eight_within_centimetres():
    task = tasks.make("trajectory", figure="lemniscate", period=3.5)
    controller = make_controller("geometric", task, FULL_RANGE)
    figures = summarize(fly(controller, task, episodes=4, vehicle=FULL_RANGE))
    # It begins at rest where the eight passes at 2.5 m/s, and catches up within a period.
    assert figures["survival_rate"] == 1.0 and figures["settled_m"] < 0.02
    assert figures["distance_m"] > 2 * figures["settled_m"]


def test_a_file_may_have_headings_which_a_policy_follows_that_knows_only_east(tmp_path):
    time = np.linspace(0, 15, 151)
    heading = 2.0 + 0.5 * time  # past 180 degrees more than once
    wrapped = np.angle(np.exp(1j * heading))
    rows = np.stack([time, np.sin(time), np.cos(time), 0.1 * time, wrapped], axis=-1)
    figure = write(tmp_path / "own.csv", rows, "time,x,y,z,yaw")
    environment, at = flown(figure=figure)
    np.testing.assert_allclose(environment.task.curve.heading(np.array([7.77])), 5.885, atol=1e-6)
    seen = environment.task.observe(environment.snapshot)
    assert np.abs(seen["sin_attitude"]).max() < 0.1 and not environment.not_compiled
    # A heading of 2 rad, of what a controller for the east is 2 rad off.
    assert environment.snapshot.potentials.attitude == pytest.approx(0.0, abs=0.1)
    turned = environment.snapshot.state.sin_attitude[:, 2]
    np.testing.assert_allclose(turned, math.sin(2.0), atol=0.1)
    policy = Policy.pretrained("trajectory")
    flight = fly(policy, "trajectory", episodes=4, task_options={"figure": figure})
    assert summarize(flight)["survival_rate"] == 1.0 and summarize(flight)["settled_m"] < 0.03
    yaw = np.unwrap(roll_pitch_yaw(flight.quaternion), axis=0)[..., 2]
    np.testing.assert_allclose(np.diff(yaw[100::100], axis=0), 0.5 * 2.0, atol=0.1)
