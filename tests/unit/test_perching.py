"""Perching: what grips holds, what does not lets go, and only a touch as it is asked counts."""

import math

import numpy as np
import pytest
from helpers import refused

from quadrl import tasks
from quadrl.aircraft import parameters
from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.rotors import GRAVITY
from quadrl.conditions.solids import Box
from quadrl.core.environment import Environment
from quadrl.tasks import perching
from quadrl.tasks.perching import Perching

INCLINES = [0, 30, 60, 90]
TWO = np.ones((2, 1))


def normal(incline):
    """Out of a surface (3,), by its incline [deg]."""
    return np.array([-math.sin(math.radians(incline)), 0.0, math.cos(math.radians(incline))])


def touching(incline, engine="mujoco", lean=(0.0, 10.0), into=0.5, along=0.0, rate=0.0, slack=8e-3):
    """Aircraft just before they touch, whose z axis leans from the normal [deg], and where."""
    turn = math.radians(incline)
    task = Perching(least_incline=turn, most_incline=turn)
    made = Environment(task, num_envs=2, seed=0, engine=engine)
    out, up = normal(incline), np.array([math.cos(turn), 0.0, math.sin(turn)])
    half = -(turn - np.radians(lean)) / 2
    quaternion = np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half], axis=-1)
    depth = -made.vehicle.foot[2]
    # The foot ahead is the lower one of an aircraft that leans forward.
    first = made.vehicle.foot[0] * np.sin(abs(np.radians(lean)))
    start = {
        "position": (depth * np.cos(np.radians(lean)) + first + slack)[:, None] * out,
        "quaternion": quaternion,
        "velocity": TWO * (along * up - into * out),
        "body_rate": TWO * np.array([0.0, rate, 0.0]),
    }
    made.reset(start=start)
    return made, depth * out


def fly(made, count):
    """The last transition of some control steps without thrust off hover, or of the episode."""
    for _ in range(count):
        done = made.step(np.zeros((2, made.action_size)))
        if done.terminated.all():
            break
    return done


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize("incline", INCLINES)
def test_a_good_touch_holds_an_aircraft_whose_motors_stop(incline, engine):
    made, place = touching(incline, engine)
    done = fly(made, 3)
    assert made.snapshot.held.all() and not done.terminated.any()
    into, _, cosine, _ = made.snapshot.touch.T
    assert (abs(into - 0.5) < 0.2).all() and np.allclose(cosine, np.cos(np.radians([0, 10])), 0.02)
    done = fly(made, 40)
    assert done.terminated.all() and done.is_success.all()
    assert (made.snapshot.state.rotor_speed < 5).all()
    np.testing.assert_allclose(made.snapshot.state.position, TWO * place, rtol=0, atol=0.05)
    # The feet, and nothing else, are on the surface.
    np.testing.assert_allclose(
        made.snapshot.state.rotation[..., 2] @ normal(incline), 1.0, atol=1e-3
    )


@pytest.mark.parametrize(
    "bad",
    [{"into": 1.6}, {"along": 0.8}, {"lean": (25.0, 30.0)}, {"rate": 3.5}, {"into": 0.05}],
    ids=["too hard", "slips", "aslant", "spins", "too soft"],
)
def test_a_touch_that_is_not_as_asked_fails(bad):
    slack = 1e-4 if bad.get("into") == 0.05 else 2e-3
    made, _ = touching(0, slack=slack, **{"lean": (0.0, 0.0)} | bad)
    done = fly(made, 40)
    assert done.terminated.all() and not done.is_success.any()


def test_without_a_grip_a_wall_holds_nobody(monkeypatch):
    smooth = Box("wall", length=2.0, width=2.0, height=0.1)
    monkeypatch.setattr(perching, "WALL", smooth)
    made, _ = touching(90)
    done = fly(made, 30)
    assert done.terminated.all() and not (done.is_success | made.snapshot.held).any()


def test_a_hold_ends_with_the_episode_and_stays_with_a_saved_state():
    made, _ = touching(90)
    fly(made, 5)
    saved, touch = made.save(), made.snapshot.touch.copy()
    made.reset()
    assert not made.snapshot.held.any() and (made.snapshot.touch == 0).all()
    made.restore(saved)
    fly(made, 1)
    assert made.snapshot.held.all()
    np.testing.assert_array_equal(made.snapshot.touch, touch)


def test_an_aircraft_that_comes_off_the_surface_has_failed():
    made, place = touching(90)
    done = fly(made, 3)
    assert made.snapshot.held.all() and not done.terminated.any()
    made.engine.qpos[1, :3] += 1.2 * perching.OFF * normal(90)  # the other one stays
    done = made.step(np.zeros((2, made.action_size)))
    assert made.snapshot.held.all()
    assert done.terminated.tolist() == [False, True] and not done.is_success.any()


def test_success_takes_the_time_at_rest_and_no_control_step_more():
    made, _ = touching(60, lean=(0.0, 0.0))
    held = 0
    for _ in range(60):
        done = made.step(np.zeros((2, made.action_size)))
        held += made.snapshot.held[0]
        if done.terminated.all():
            break
    assert done.is_success.all()
    assert held == math.ceil(made.task.rest_time / made.vehicle.control_timestep - 1e-9)


def test_episodes_begin_before_the_surface():
    made = Environment("perching", num_envs=200, seed=3)
    made.reset()
    out = made.snapshot.task.normal
    assert (np.sum(out * made.snapshot.state.position, axis=-1) > 0.5).all()
    assert (made.snapshot.clearance > 0.3).all()
    assert out[:, 0].min() < -0.99 and out[:, 2].max() > 0.99


class Middle:
    """Random numbers that are always in the middle of their range."""

    def uniform(self, low, high, size=None):
        return np.full((1, size) if size else 1, (low + high) / 2)


@pytest.mark.parametrize("incline", INCLINES)
def test_a_way_ends_in_the_touch_that_it_was_flown_backwards_from(incline):
    turn = math.radians(incline)
    task = Perching(least_incline=turn, most_incline=turn, approach=1.0, least_touch=0.5)
    paper = VEHICLES["paper"]
    own = parameters.Parameters.of(parameters.rows(paper), paper.control_timestep)
    start, state = task.begin(Middle(), own)
    position, velocity = start.position[0].copy(), start.velocity[0].copy()
    (rate,), thrust, pitch = (
        -start.body_rate[:, 1],
        0.925 * GRAVITY,
        2 * np.arctan2(-start.quaternion[0, 2], start.quaternion[0, 0]),
    )  # nose up
    step, count = 1e-4, round((turn - pitch) / rate / 1e-4)
    for _ in range(count):
        up = np.array([-math.sin(pitch), 0.0, math.cos(pitch)])
        position += step * velocity
        velocity += step * (thrust * up - np.array([0.0, 0.0, GRAVITY]))
        pitch += step * rate
    np.testing.assert_allclose(position, state.goal[0], atol=2e-3)
    np.testing.assert_allclose(velocity, -0.75 * normal(incline), atol=2e-3)


def test_practice_may_begin_in_the_surface_and_what_is_given_may_not():
    environment = Environment(Perching(approach=1.0, most_incline=0.0), num_envs=2000, seed=0)
    environment.reset()
    assert (environment.snapshot.clearance < -0.05).any()
    place = np.where(np.arange(2000) == 7, -0.05, 1.0)[:, None] * [0.0, 0.0, 1.0]
    with refused("position at the start", match=r"outside of wall; .* \[7\]"):
        environment.reset(start={"position": place})


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("most_incline", {"least_incline": 1.0, "most_incline": 0.5}),
        ("nearest", {"nearest": 0.0, "farthest": 0.0}),
        ("nearest", {"nearest": 1.1}),  # 0.3 m over a level one: (0.5 + 0.3) m / sin 45 degrees
        ("most_touch", {"most_touch": 0.2}),
        ("most_slip", {"most_slip": 0.0}),
        ("most_spin", {"most_spin": 0.0}),
    ],
)
def test_ranges_that_are_none_are_refused(name, options):
    with refused(match=name):
        tasks.make("perching", **options)
