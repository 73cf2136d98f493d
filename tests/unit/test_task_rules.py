"""What each task rewards, what ends it and what succeeds, mostly by hand on rows of snapshots."""

import dataclasses
import math

import helpers
import numpy as np
import pytest

from quadrl import tasks
from quadrl.aircraft.parameters import Parameters, rows
from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.vehicle import Vehicle
from quadrl.core import transition
from quadrl.core.environment import Environment
from quadrl.engines.rng import Rng
from quadrl.engines.state import Start, State
from quadrl.evaluation import rollout
from quadrl.evaluation.controllers import make_controller

VEHICLE = Vehicle()
CLOCK = transition.Clock(control_timestep=0.05, time_limit_steps=200, settle_steps=40)
FEET = np.array(VEHICLE.foot)  # [m]
ON_SOLIDS = {name for name in tasks.TASKS if tasks.make(name).solids()}  # which they need
RACES = ("lsy_race", "race")


def drawn(task, count):
    """The Start and the TaskState of episodes, and the aircraft's parameters, one row each."""
    own = Parameters.of(rows(VEHICLE, count), 0.05)
    keys = np.arange(count)
    return *task.begin(Rng(keys, 0 * keys), own), own


def placed(position, velocity=(0, 0, 0), roll=0.0):
    """A Start at positions (N, 3) [m], moving [m/s], rolled (N,) [rad]."""
    start = helpers.level(len(np.atleast_2d(position)), position=position, velocity=velocity)
    start.quaternion[:, 0], start.quaternion[:, 1] = np.cos(roll / 2), np.sin(roll / 2)
    return start


def state(task, *place):
    """What a task sees of aircraft that are placed somewhere."""
    start, height = placed(*place), max(task.altitude, VEHICLE.ground_clearance)
    own = {name: getattr(start, name) for name in Start.__dataclass_fields__}
    return State.of_coordinates(**own, origin_height=height)


def snapshot(task, *place, **remembered):
    """The first snapshot of episodes, and how far they are; with some memories (N, ...)."""
    where = state(task, *place)
    _, task_state, own = drawn(task, len(where.position))
    task_state = task.remember(placed(*place), task_state)
    task_state = dataclasses.replace(task_state, **remembered)
    return transition.begin(task, where, task_state, own, 4)[:2]


def finished(task, before, episode, *place, command=VEHICLE.hover_speed):
    """The snapshot after one control step to another place, how far they are, and what it gave."""
    where = state(task, *place)
    command = np.broadcast_to(command, where.rotor_speed.shape)
    diverged = np.zeros(len(command), dtype=bool)
    return transition.finish(task, CLOCK, episode, before, where, 0 * command, command, diverged)


def test_the_common_terms():
    # From 1 m to 0.9 m, from rest to 0.5 m/s, level to 0.1 rad, all rotors a tenth over hover.
    task = tasks.make("hover")
    before, episode = snapshot(task, (1, 0, 0))
    command = VEHICLE.hover_speed + 0.1 * VEHICLE.max_speed
    *_, now = finished(task, before, episode, (0.9, 0, 0), (0.3, 0.4, 0), 0.1, command=command)
    attitude = -30 * (math.sin(0.1) + 1 - math.cos(0.1))
    expected = dict(progress=10, attitude=attitude, speed=-1, spin=0, control=-0.04, survival=10)
    assert {name: term[0] for name, term in now.reward_terms.items()} == pytest.approx(expected)
    assert now.error == pytest.approx([0.9])


def test_what_landing_adds():
    # 2 m/s down to 0.9 m, where 0.1 + 0.6 * 0.9 m/s are gentle; then a quarter second of rest on
    # the pad; and a touchdown at 0.6 m/s. There is no reward for the time in the air.
    task = tasks.make("landing")
    memory = dict(down=[0.0, 1, 0], rest=[0.0, 4, 0], speed=[0.0, 0, 0.6])
    memory = {name: np.array(value) for name, value in memory.items()}
    before, episode = snapshot(task, [(0, 0, 1), (0, 0, 0), (0, 0, 0)], **memory)
    *_, now = finished(task, before, episode, [(0, 0, 0.9), (0, 0, 0), (0, 0, 0)])
    np.testing.assert_allclose(now.reward_terms["haste"], [-60 * (2 - 0.64), 0, 0])
    np.testing.assert_array_equal(now.reward_terms["success"], [0, 100, 0])
    np.testing.assert_array_equal(now.reward_terms["failure"], [0, 0, -300])
    np.testing.assert_array_equal(now.reward_terms["survival"], 0)


def touching(roll):
    """Where the lowest foot of a rolled aircraft touches the ground (3,) [m], task frame."""
    return 0, 0, FEET[1] * math.sin(roll) - FEET[2] * math.cos(roll) - VEHICLE.ground_clearance


# Place; down, rest, speed remembered; terminated, succeeded.
LANDINGS = [
    ((0, 0, 0), 0, 0, (0, 0, 0.49), (False, False)),  # a touchdown at 0.49 m/s
    ((0, 0, 0), 0, 0, (0, 0, 0.51), (True, False)),  # hard
    ((0, 0, 0), 0, 0, (1, 0, 0.51), (False, False)),  # down before
    ((0, 0, 0.1), 0, 0, (0, 0, 0.51), (False, False)),  # in the air
    (touching(0.25), 0, 0.25, (0, 0, 0), (False, False)),  # tilted by 14.3 degrees
    (touching(0.27), 0, 0.27, (0, 0, 0), (True, False)),  # by 15.5 degrees
    (touching(0.27), 0, 0.27, (1, 4, 0), (True, False)),  # and at rest for 0.25 s
    (touching(0.25), 0, 0.25, (1, 4, 0), (True, True)),  # so by 14.3 degrees
    ((0, 0, 1), 0, 0.27, (0, 0, 0), (False, False)),  # the same in the air
    ((0, 0, -0.01), 0, 1.4, (0, 0, 0), (True, False)),  # on a rotor
    ((0, 0, 0), 0, 0, (1, 3, 0), (False, False)),  # at rest for 0.2 s
    ((0.4, 0.2, 0), 0, 0, (1, 4, 0), (True, True)),  # for 0.25 s
    ((0, 0, 0), -0.06, 0, (1, 4, 0), (False, False)),  # moves
    ((0.51, 0, 0), 0, 0, (1, 4, 0), (False, False)),  # 1 cm beside the pad
    ((0, 0, 2), -1.9, 0, (0, 0, 0), (False, False)),  # slower than its own wash
    ((0, 0, 2), -2.1, 0, (0, 0, 0), (True, False)),  # in its own wash
    ((0, 0, 4.9), 0, 0, (0, 0, 0), (False, False)),
    ((0, 0, 5.1), 0, 0, (0, 0, 0), (True, False)),  # away
    ((0, 0, 0.1), 0.2, 0, (1, 0, 0), (False, False)),  # bounced
]


def test_landing_by_hand():
    task = tasks.make("landing")
    position, climb, roll, remembered, ends = (np.array(c) for c in zip(*LANDINGS, strict=True))
    place = position, climb[:, None] * [0, 0, 1], roll
    memory = zip(("down", "rest", "speed"), remembered.T.astype(float), strict=True)
    before, episode = snapshot(task, *place, **dict(memory))
    after, _, now = finished(task, before, episode, *place)
    np.testing.assert_array_equal(np.stack([now.terminated, now.is_success], axis=-1), ends)
    np.testing.assert_allclose(after.task.speed, np.abs(climb))
    assert after.task.down[-1] == 1  # it stays so


def test_who_rests_with_another_heading_has_not_crashed():
    # One stands on the pad and faces north; the other falls on it at 0.7 m/s.
    start = placed([(0, 0, 0), (0, 0, 0.2)], [(0, 0, 0), (0, 0, -0.7)])
    start.quaternion[0] = math.sqrt(0.5), 0, 0, math.sqrt(0.5)
    task = helpers.starting(tasks.make("landing"), start)
    flight = rollout.fly(lambda seen: np.full((len(seen), 4), -1.0), task, episodes=2)
    assert flight.terminated.all() and not flight.is_success.any()
    assert task.metrics(flight)["crash_rate"] == 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", VEHICLES)
def test_every_aircraft_lands_on_its_feet(name):
    # The feet of the paper's aircraft are 7 cm below its centre, those of a Crazyflie 1.4 cm.
    task, vehicle = tasks.make("landing"), VEHICLES[name]
    assert helpers.begun(task, vehicle=vehicle).origin[2] == vehicle.ground_clearance
    flight = rollout.fly(
        make_controller("geometric", task, vehicle), task, episodes=8, vehicle=vehicle
    )
    assert flight.is_success.all()
    height = flight.position[flight.length - 1, np.arange(8), 2]
    np.testing.assert_allclose(height, 0.0, atol=0.002)  # [m]: the ground gives way a little
    assert task.metrics(flight)["touchdown_speed_max_m_s"] < 0.3


def test_random_waypoints_lie_in_their_shell():
    start, task_state, _ = drawn(tasks.make("random_waypoint"), 1000)
    distance = np.linalg.norm(task_state.goal - start.position, axis=-1)
    assert 1.0 <= distance.min() < 1.01
    assert 2.49 < distance.max() <= 2.5


@pytest.mark.parametrize(("tilt", "speed", "spin"), [(0.0, 0.0, 0.0), (0.5, 1.0, 2.0)])
def test_flights_to_random_waypoints_may_begin_in_motion(tilt, speed, spin):
    start, _, _ = drawn(tasks.make("random_waypoint", tilt=tilt, speed=speed, spin=spin), 1000)
    leaning = 2 * np.arcsin(np.linalg.norm(start.quaternion[:, 1:3], axis=-1))
    moving = (np.linalg.norm(part, axis=-1) for part in (start.velocity, start.body_rate))
    for found, largest in zip((leaning, *moving), (tilt, speed, spin), strict=True):
        assert 0.98 * largest <= found.max() <= largest + 1e-12


@pytest.mark.parametrize(("asked", "error"), [(False, 0.0), (True, np.sin(1) + 1 - np.cos(1))])
def test_a_random_waypoint_is_flown_to_with_any_heading_unless_east_is_asked(asked, error):
    environment = Environment(tasks.make("random_waypoint", faces_east=asked))
    environment.reset(start={"quaternion": (np.cos(0.5), 0, 0, np.sin(0.5))})  # 1 rad
    assert environment.snapshot.potentials.attitude[0] == pytest.approx(error)


def test_a_route_is_flown_in_order():
    route = ((0.0, 0.0, 0.1), (0.0, 0.0, 0.3), (0.0, 0.0, 2.0))
    task = tasks.make("static_waypoint", waypoints=route, reach=0.05)
    now, episode = snapshot(task, [(0, 0, 0)] * 2)
    goals = []
    for height in (0.0, 0.31, 0.1, 0.31, 0.1):  # the second one does not count before the first
        now, episode, _ = finished(task, now, episode, [(0, 0, height), (0, 0, 0)])
        goals.append(now.task.goal[:, 2].tolist())
    assert goals == [[0.1, 0.1], [0.1, 0.1], [0.3, 0.1], [2.0, 0.1], [2.0, 0.1]]
    np.testing.assert_array_equal(now.task.leg, [2, 0])
    np.testing.assert_allclose(now.potentials.distance, [1.9, 0.1])  # of the new goal
    # Only who is at the last one has succeeded, however close.
    held = transition.EpisodeEnd(*np.array([[False] * 2, [True] * 2]), 200, 0, np.zeros(2), 40)
    np.testing.assert_array_equal(task.succeeded(now, held), [True, False])
    held.final_sum += 4.1  # 0.1025 m in the mean of 40 steps
    assert not task.succeeded(now, held).any()


@pytest.mark.parametrize("name", sorted({*tasks.TASKS} - {*ON_SOLIDS, *RACES}))
def test_the_heading_counts_where_it_is_asked_for(name):
    task, degrees = tasks.make(name), np.array([0.0, 9.9, -9.9, 10.1, -10.1, 180.0])
    start = placed([(0, 0, 0)] * len(degrees))
    half = np.radians(degrees) / 2
    start.quaternion[:, 0], start.quaternion[:, 3] = np.cos(half), np.sin(half)
    memory = {"rest": 4.0 + 0 * half} if name == "landing" else {}  # one more step is 0.25 s
    now, _ = snapshot(task, start.position, **memory)
    own = {name: getattr(start, name) for name in Start.__dataclass_fields__}
    height = max(task.altitude, VEHICLE.ground_clearance)
    now = dataclasses.replace(now, state=State.of_coordinates(**own, origin_height=height))
    over = np.full((2, len(degrees)), [[name == "landing"], [name != "landing"]])
    held = transition.EpisodeEnd(*over, 200, 0, np.zeros(len(degrees)), 40)
    asked = name in ("hover", "static_waypoint", "landing")
    expected = np.abs(degrees) < 10 if asked else np.full(len(degrees), True)
    np.testing.assert_array_equal(task.succeeded(now, held), expected)


def test_what_ends_a_flight_early():
    away = [(8, 0, 0), (0, 0, -2.95), (0, 0, 0)]  # away; on the ground, 3 m below; and not
    following = [(5.1, 0, 0), (0, 0, -2.95), (4.9, 0, 0)]
    cases = ("static_waypoint", away), ("random_waypoint", away), ("target_following", following)
    for name, places in cases:
        now, episode = snapshot(task := tasks.make(name), places)
        *_, end = finished(task, now, episode, places)
        np.testing.assert_array_equal(end.terminated, [True, True, False])
        assert not end.is_success.any()
    np.testing.assert_allclose(task.error(now), [4.1, 1.95, 3.9])  # off 1 m from the target


def test_straight_and_level():
    task = tasks.make("straight_and_level")
    direction = drawn(task, 5)[1].direction
    left = np.cross([0.0, 0.0, 1.0], direction)
    off = np.array([(0, 0.69), (0, 0.71), (0, -0.71), (2.9, 0), (3.1, 0)])  # [m] across and up
    now, _ = snapshot(task, off[:, :1] * left + off[:, 1:] * [0, 0, 1])
    ends = task.terminated(now)
    np.testing.assert_array_equal(ends["off_altitude"], [False, True, True, False, False])
    np.testing.assert_array_equal(ends["off_line"], [False, False, False, False, True])
    # 3 m along the line and 0.4 m to its left the projection is at 3 m, the goal at 4 m.
    now, _ = snapshot(task, 3 * direction + 0.4 * left)
    np.testing.assert_allclose(task.goal(now), 4 * direction, atol=1e-12)
    np.testing.assert_allclose(task.error(now), 0.4)
    np.testing.assert_allclose(now.potentials.speed, 2.0)  # at rest, beside a line of 2 m/s


def test_the_target_is_smooth_and_never_too_fast():
    task = tasks.make("target_following")
    start, _, _ = drawn(task, 200)
    np.testing.assert_allclose(np.linalg.norm(start.position, axis=-1), 1.0)
    now, _ = snapshot(task, start.position)
    np.testing.assert_array_equal(task.goal(now), 0.0)
    fastest = 0.0
    for seconds in np.arange(0.0, 20.0, 0.25):
        before, then, after = (
            dataclasses.replace(now, time=np.full(200, seconds + step)) for step in (-1e-4, 0, 1e-4)
        )
        velocity = task.target_velocity(then)
        slope = (task.goal(after) - task.goal(before)) / 2e-4
        np.testing.assert_allclose(slope, velocity, atol=1e-6)
        fastest = max(fastest, np.linalg.norm(velocity, axis=-1).max())
    assert 1.0 < fastest <= 1.5
