"""Landing on a moving deck: the sea is the one that is asked for, and the deck follows it."""

import dataclasses
import math

import numpy as np
import pytest
from helpers import refused
from scipy.spatial.transform import Rotation

from quadrl import tasks
from quadrl.aircraft import parameters
from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.rotors import GRAVITY
from quadrl.conditions.solids import heading
from quadrl.core.environment import Environment
from quadrl.engines.rng import Rng
from quadrl.tasks.deck_landing import DECK, DeckLanding
from quadrl.tasks.sea import FREEBOARD, upright, water
from quadrl.tasks.sea import deck as deck_of

PAPER = VEHICLES["paper"]
OWN = parameters.Parameters.of(parameters.rows(PAPER), PAPER.control_timestep)
TINY = {"boat_length": 1e-3, "boat_beam": 1e-3}


def sea(count, waves=2.0, **options):
    """What a task remembers of the waves of some episodes."""
    task = DeckLanding(lowest_waves=waves, highest_waves=waves, **options)
    keys = np.arange(count)
    return task.begin(Rng(keys, 0 * keys), OWN)[1]


@pytest.mark.parametrize("waves", [0.5, 2.0, 4.0])
def test_the_waves_have_the_height_and_the_period_of_a_wind_sea(waves):
    """Significant height: four standard deviations. Mean period of Pierson and Moskowitz's sea."""
    made = sea(4000, waves, **TINY)
    power = made.amplitude**2 / 2
    assert 4 * math.sqrt(power.sum(axis=1).mean()) == pytest.approx(waves, rel=1e-3)
    # m_0 / m_1 of S = A / w^5 exp(-1.25 (p / w)^4): the mean frequency is 1.296 p.
    mean = (power * made.frequency).sum() / power.sum()
    assert mean == pytest.approx(1.296 * 0.4 * math.sqrt(GRAVITY / waves), rel=0.01)


def test_waves_that_are_shorter_than_the_boat_move_it_less():
    whole, part = (sea(500, 1.0, **boat).amplitude for boat in (TINY, {}))
    frequency = sea(500, 1.0).frequency
    left = abs(part / whole)
    assert left[frequency < 1.0].min() > 0.9 and left[frequency > 4.0].max() < 0.3


def test_velocity_turn_and_normal_of_the_deck_are_those_of_its_way():
    made, time, step = sea(50, 4.0), np.linspace(0.0, 20.0, 50), 1e-5
    early, now, late = (deck_of(made, time + k * step) for k in (-1, 0, 1))
    np.testing.assert_allclose(
        now.velocity, (late.position - early.position) / (2 * step), atol=1e-5
    )
    turn = np.cross(now.normal, (late.normal - early.normal) / (2 * step))
    np.testing.assert_allclose(turn, now.rate, atol=0.02 * abs(turn).max())
    # The water's surface is square to the normal: a neighbour at the lag of a small way ahead.
    ahead = 0.01
    lag = ahead * made.frequency**2 / GRAVITY
    there = deck_of(type(made)(**{**vars(made), "phase": made.phase - lag}), time)
    slope = (there.position - now.position)[:, 2] / ahead
    lean = -(now.normal[:, :2] * made.course).sum(axis=1) / now.normal[:, 2]
    np.testing.assert_allclose(slope, lean, atol=2e-3)


def test_the_water_that_is_drawn_is_whole_and_moves_as_the_deck_does():
    """Its strips begin where the last one ends; near the boat it is what the boat would ride on."""
    made, time = sea(1, 4.0, **TINY), np.array([3.0])
    ends = []
    for strip in water(made, time):
        turn, (half, _, thick) = Rotation.from_quat(strip.quaternion, scalar_first=True), strip.size
        ends.append([strip.position + turn.apply([x, 0, thick]) for x in (-half, half)])
    ends = np.array(ends)
    np.testing.assert_allclose(ends[1:, 0], ends[:-1, 1], atol=1e-9)
    ahead = ends[1:, 0] @ [*made.course[0], 0.0]
    assert ahead[0] < -100.0 and ahead[-1] > 100.0 and (np.diff(ahead) > 0).all()
    near = abs(ahead) < 15.0
    phase = made.phase - made.frequency**2 / GRAVITY * ahead[near, None]
    there = deck_of(dataclasses.replace(made, phase=phase), time).position[:, 2]
    np.testing.assert_allclose(ends[1:, 0, 2][near], there - FREEBOARD, atol=0.05)


def on_the_deck(count, engine="mujoco", falls=0.0, aside=0.0, slips=0.0, **waves):
    """Aircraft just above the pad, which they approach at a speed [m/s], and slip over at one."""
    made = Environment("deck_landing", num_envs=count, engine=engine, **waves)
    made.reset(seed=1)
    deck = deck_of(made.snapshot.task, made.snapshot.time)
    place = made.task.goal(made.snapshot) + 0.003 * deck.normal + [aside, 0.0, 0.0]
    velocity = deck.velocity - np.reshape(falls, (-1, 1)) * deck.normal
    velocity = velocity + np.reshape(slips, (-1, 1)) * [0.0, 1.0, 0.0]
    start = {"position": place, "velocity": velocity, "quaternion": upright(deck.normal)}
    made.reset(seed=1, start=start)
    return made


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_the_deck_is_where_the_task_says_and_carries_who_stands_on_it(engine):
    made = on_the_deck(3, engine, lowest_waves=2.0)
    over = np.zeros(3, dtype=bool)
    for _ in range(20):
        done = made.step(np.full((3, 4), -1.0))
        deck = deck_of(made.snapshot.task, made.snapshot.time)
        centre = deck.position - DECK.height / 2 * deck.normal
        np.testing.assert_allclose(made.snapshot.solid("deck"), centre, atol=1e-9)
        assert done.is_success[done.terminated].all()
        over |= done.is_success
    assert over.all() and (made.snapshot.potentials.distance < 0.02).all()


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_who_stands_on_the_deck_goes_on_alike_from_a_saved_state(engine):
    made, off = on_the_deck(4, engine, lowest_waves=2.0), np.full((4, 4), -1.0)
    for _ in range(8):
        made.step(off)
    assert made.snapshot.landed.all()
    saved, other = made.save(), Environment(made.task, num_envs=4, engine=engine)
    other.restore(saved)
    for _ in range(3):
        made.step(off)
        other.step(off)
        np.testing.assert_array_equal(other.engine.qpos, made.engine.qpos)
        np.testing.assert_array_equal(other.engine.qvel, made.engine.qvel)


def test_who_rests_on_the_pad_off_its_heading_has_not_succeeded():
    made = on_the_deck(2, lowest_waves=0.1, highest_waves=0.1)
    deck = deck_of(made.snapshot.task, made.snapshot.time)
    start = {"position": made.snapshot.state.position, "velocity": deck.velocity}
    made.reset(seed=1, start=start | {"quaternion": heading(np.radians([9.0, 11.0]))})
    for _ in range(20):
        done = made.step(np.full((2, 4), -1.0))
        if done.terminated.all():
            break
    assert done.is_success.tolist() == [True, False]


def test_a_touchdown_is_remembered_and_a_hard_one_fails():
    made = on_the_deck(2, falls=[0.2, 0.8], aside=0.1)
    done = made.step(np.full((2, 4), -1.0))
    seen = made.snapshot.task
    assert (seen.down == 1).all() and done.terminated.tolist() == [False, True]
    # On its last 3 mm it falls no faster than freely.
    fell = np.sqrt(np.square([0.2, 0.8]) + 2 * 9.81 * 0.003)
    assert (seen.speed > [0.19, 0.79]).all() and (seen.speed < fell + 0.01).all()
    np.testing.assert_allclose(seen.miss, 0.1, atol=0.02)
    np.testing.assert_allclose(seen.upright, 1.0, atol=1e-3)


def test_a_touchdown_sideways_is_as_hard_as_a_straight_one():
    """At 0.2 m/s down and 0.3 or 0.6 m/s aside: 0.36 or 0.63 m/s in all, where 0.5 is the most."""
    made = on_the_deck(2, falls=0.2, slips=[0.3, 0.6], lowest_waves=0.1, highest_waves=0.1)
    done = made.step(np.full((2, 4), -1.0))
    assert (made.snapshot.task.down == 1).all()
    assert done.terminated.tolist() == [False, True] and not done.is_success.any()


@pytest.mark.parametrize(
    "options", [{"lowest_waves": 0.0}, {"highest_waves": 0.05}, {"boat_beam": 0.0}]
)
def test_a_sea_that_is_none_is_refused(options):
    with refused(match=next(iter(options))):
        tasks.make("deck_landing", **options)
