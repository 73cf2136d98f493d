"""The definitions of the tasks, statement by statement, in flight (hover: test_environment.py)."""

import math

import numpy as np
import pytest

from quadrl import controllers, tasks
from quadrl.environment import Environment
from quadrl.learning.evaluate import fly
from quadrl.state import State
from quadrl.task import EPISODE_DRAWS, Draw
from quadrl.vehicle import VEHICLES, Vehicle

VEHICLE = Vehicle()


def placed(task, position=(0, 0, 0), velocity=(0, 0, 0), roll=0.0):
    """An environment with its aircraft put somewhere: task frame [m], world [m/s], [rad]."""
    environment = Environment(task, seed=0)
    environment.reset()
    simulation = environment.simulation
    simulation.qpos[:3] = simulation.origin + position
    simulation.qpos[3:] = math.cos(roll / 2), math.sin(roll / 2), 0, 0
    simulation.qvel[:] = (*velocity, 0, 0, 0)
    return environment


def to_the_end(environment, action):
    """The last transition of an episode that is flown with one action."""
    for _ in range(environment.horizon_steps):
        now = environment.step(np.full(4, float(action)))
        if now.terminated or now.truncated:
            return now
    raise AssertionError("the episode did not end")


def samples(task, count=1000):
    """Starts and fields of many episodes."""
    return task.sample(Draw(np.random.default_rng(2).random((count, EPISODE_DRAWS))), VEHICLE)


# ----------------------------------------------------------------------------------------- landing


@pytest.mark.parametrize(
    ("position", "velocity", "roll", "action", "steps"),
    [
        # Stands from the first step on: at rest for 0.25 s after five of 0.05 s.
        ((0, 0, 0), (0, 0, 0), 0.0, -1, 5),
        ((0.4, 0.2, 0), (0, 0, 0), 0.0, -1, 5),
        # 2 cm at 0.3 m/s take 0.07 s at hover thrust, and then it slides nowhere.
        ((0, 0, 0.02), (0, 0, -0.3), 0.0, -0.2, None),
    ],
)
def test_a_landing_that_succeeds(position, velocity, roll, action, steps):
    environment = placed("landing", position, velocity, roll)
    end = to_the_end(environment, action)
    assert end.terminated
    assert end.is_success
    if steps:
        assert round(float(environment.simulation.state.time) / 0.05) == steps


@pytest.mark.parametrize(
    ("position", "velocity", "roll", "action"),
    [
        ((0, 0, 0.2), (0, 0, -0.7), 0.0, 0),  # a touchdown at 0.7 m/s
        ((0, 0, 0.2), (0.6, 0, -0.2), 0.0, 0),  # at 0.6 m/s, mostly sideways
        ((0, 0, 0.025), (0, 0, -0.3), math.radians(20), 0),  # tilted by 20 degrees
        ((0, 0, 2.0), (0, 0, -2.1), 0.0, 0),  # sinks into its own wash
        ((0, 0, 5.1), (0, 0, 0), 0.0, 0),  # away
        ((0, 0, -0.01), (0, 0, 0), math.radians(80), 0),  # on a rotor
    ],
)
def test_a_landing_that_fails(position, velocity, roll, action):
    end = to_the_end(placed("landing", position, velocity, roll), action)
    assert end.terminated
    assert not end.is_success
    assert end.reward_terms["failure"] == -300


def test_a_landing_beside_the_pad_is_none():
    # 0.51 m from the axis of a pad of 0.5 m, and there until the clock ends it.
    end = to_the_end(placed("landing", (0.51, 0, 0)), -1)
    assert end.truncated
    assert not end.is_success


@pytest.mark.parametrize("name", VEHICLES)
def test_every_aircraft_lands_on_its_feet(name):
    # The feet of the paper's aircraft are 7 cm below its centre, those of a Crazyflie 1.4 cm.
    task, vehicle = tasks.make("landing"), VEHICLES[name]
    environment = Environment(task, vehicle=vehicle)
    assert environment.simulation.origin[2] == vehicle.ground_clearance
    record = fly(controllers.make("geometric", task, vehicle), task, episodes=8, vehicle=vehicle)
    assert record.is_success.all()
    height = record.position[record.length - 1, np.arange(8), 2]
    np.testing.assert_allclose(height, 0.0, atol=0.002)  # [m]: the ground gives way a little
    assert task.figures(record)["touchdown_speed_max_m_s"] < 0.3


# --------------------------------------------------------------------------------------- waypoints


def test_random_waypoints_lie_in_their_shell():
    start, fields = samples(tasks.make("random_waypoint"))
    distance = np.linalg.norm(fields.goal - start.position, axis=-1)
    assert 1.0 <= distance.min() < 1.01
    assert 2.49 < distance.max() <= 2.5


def test_a_route_is_flown_in_order():
    route = ((0.0, 0.0, 0.1), (0.0, 0.0, 0.3), (0.0, 0.0, 2.0))
    environment = placed(tasks.make("static_waypoint", waypoints=route, reach=0.05))
    goals = []
    for height in (0.0, 0.31, 0.1, 0.31, 0.1):  # the second one does not count before the first
        environment.simulation.qpos[2] = environment.simulation.origin[2] + height
        environment.simulation.qvel[:] = 0
        environment.step(np.zeros(4))
        goals.append(float(environment.fields.goal[2]))
    assert goals == [0.1, 0.1, 0.3, 2.0, 2.0]


@pytest.mark.parametrize("name", ["static_waypoint", "random_waypoint"])
@pytest.mark.parametrize("position", [(8, 0, 0), (0, 0, -2.95)])  # away; on the ground
def test_what_ends_a_flight_to_a_waypoint(name, position):
    end = placed(tasks.make(name), position).step(np.zeros(4))
    assert end.terminated
    assert not end.is_success


# ------------------------------------------------------------------------------------ moving goals


@pytest.mark.parametrize(
    ("across", "up", "ended"),
    [(0.0, 0.69, False), (0.0, 0.72, True), (0.0, -0.72, True), (2.9, 0.0, False), (3.1, 0, True)],
)
def test_what_ends_straight_and_level(across, up, ended):
    environment = placed("straight_and_level")
    east, north, _ = environment.fields.direction
    position = np.array([-across * north, across * east, up])
    environment.simulation.qpos[:3] = environment.simulation.origin + position
    assert environment.step(np.zeros(4)).terminated == ended


def test_the_goal_runs_a_metre_ahead_on_the_line():
    # 3 m along the line and 0.4 m to its left the projection is at 3 m, the goal at 4 m.
    environment = placed("straight_and_level")
    direction = environment.fields.direction
    left = np.array([-direction[1], direction[0], 0.0])
    environment.simulation.qpos[:3] = environment.simulation.origin + 3 * direction + 0.4 * left
    environment.simulation.qvel[:] = 0
    environment.step(np.zeros(4))  # from rest: it moves by less than a millimetre
    goal = environment.task.goal(environment.simulation.state, environment.fields)
    np.testing.assert_allclose(goal, 4 * direction, atol=1e-3)


def at_times(task, fields, time):
    """Position and velocity of targets (..., 3) at times [s]."""
    zero = np.zeros((*time.shape, 3))
    state = State.of_coordinates(
        zero, np.array([1.0, 0, 0, 0]) + np.zeros((*time.shape, 4)), zero, zero, zero, time
    )
    return task.goal(state, fields), task.target_velocity(state, fields)


def test_the_target_is_smooth_and_never_too_fast():
    task = tasks.make("target_following")
    start, fields = samples(task, 200)
    np.testing.assert_allclose(np.linalg.norm(start.position, axis=-1), 1.0)
    np.testing.assert_array_equal(at_times(task, fields, np.zeros(200))[0], 0.0)
    fastest = 0.0
    for seconds in np.arange(0.0, 20.0, 0.25):
        time = np.full(200, seconds)
        before, after = (at_times(task, fields, time + step)[0] for step in (-1e-4, 1e-4))
        velocity = at_times(task, fields, time)[1]
        np.testing.assert_allclose((after - before) / 2e-4, velocity, atol=1e-6)
        fastest = max(fastest, np.linalg.norm(velocity, axis=-1).max())
    assert 1.0 < fastest <= 1.5


@pytest.mark.parametrize(("away", "ended"), [(4.9, False), (5.1, True), (0.0, False)])
def test_what_ends_target_following(away, ended):
    environment = placed("target_following", (away, 0, 0))
    now = environment.step(np.zeros(4))
    assert now.terminated == ended
    assert now.error == pytest.approx(abs(away - 1.0), abs=0.08)  # it goes 1.5 m/s * 0.05 s
