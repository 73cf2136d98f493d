"""Recovery: how it begins, what its attitude error is, and what counts as recovered."""

import dataclasses
import math

import helpers
import numpy as np
import pytest

from quadrl import tasks
from quadrl.core.environment import Environment


def begun(count=1, **settings):
    return helpers.begun("recovery", count, seed=1, **settings)


def rolled(degrees):
    half = math.radians(degrees) / 2
    return np.array([[math.cos(half), math.sin(half), 0.0, 0.0]])


@pytest.mark.parametrize(("degrees", "chord"), [(0, 0), (60, 1), (90, math.sqrt(2)), (180, 2)])
def test_the_attitude_error_is_the_chord_to_the_vertical(degrees, chord):
    # 2 sin(tilt / 2), which grows up to 180 degrees.
    environment = begun()
    environment.reset(start={"quaternion": rolled(degrees)})
    assert environment.snapshot.potentials.attitude == pytest.approx(chord, abs=1e-6)


def test_starts_are_in_any_attitude_in_motion_and_at_the_height_asked_for():
    environment = begun(500, lowest=1.0, highest=2.0)
    state = environment.snapshot.state
    height = state.position[:, 2] + environment.origin[2]
    assert 1.0 <= height.min() < 1.1 and 1.9 < height.max() <= 2.0
    np.testing.assert_array_equal(state.position[:, :2], 0)
    # Any speed up to 3 m/s and 6 rad/s, none beyond.
    assert 2.5 < state.speed.max() <= 3.0 and 5.0 < state.angular_speed.max() <= 6.0
    assert state.cos_tilt.min() < -0.9 and state.cos_tilt.max() > 0.9


@pytest.mark.parametrize(
    ("start", "succeeds"),
    [
        ({}, True),
        ({"quaternion": rolled(11)}, False),  # more than 10 degrees
        ({"velocity": np.array([[0.3, 0.0, 0.0]])}, False),  # more than 0.2 m/s
        ({"body_rate": np.array([[0.0, 0.0, 0.6]])}, False),  # more than 0.5 rad/s
    ],
)
def test_success_is_level_slow_and_in_the_air_at_the_time_limit(start, succeeds):
    task = dataclasses.replace(tasks.make("recovery"), time_limit=0.05, settle_time=0.05)
    environment = Environment(task, seed=1, engine="free_flight")
    rest = {"quaternion": rolled(0), "velocity": np.zeros((1, 3)), "body_rate": np.zeros((1, 3))}
    environment.reset(start=rest | start)
    done = environment.step(np.zeros((1, 4)))
    assert done.truncated[0] and bool(done.is_success[0]) == succeeds


def test_who_falls_to_the_ground_has_failed():
    # From 0.1 m upside down, with the hover thrust down too: 2 g for 0.14 s.
    environment = begun(engine="free_flight", lowest=0.1, highest=0.1)
    environment.reset(start={"quaternion": rolled(180)})
    ends = [environment.step(np.zeros((1, 4))) for _ in range(6)]
    assert any(end.terminated[0] for end in ends)
    assert not any(end.is_success[0] for end in ends)
