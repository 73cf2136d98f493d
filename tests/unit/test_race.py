"""Race: what counts as through a gate, what it takes, and tracks that cannot be."""

import dataclasses
import json
import math

import numpy as np
import pytest
from helpers import begun, refused

from quadrl import tasks
from quadrl.aircraft.vehicle import Vehicle
from quadrl.core.environment import Environment
from quadrl.deploy.web import surroundings
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.rollout import fly, summarize
from quadrl.tasks.race import Race
from quadrl.tasks.tracks import NAMES, TRACKS, crossing

EAST = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])  # through, left
GATES = (1.0, 0.0, 5.0, 0.0, 0.0), (4.0, 0.0, 5.0, 0.0, 0.0)
OWN = {"gates": GATES, "start": (0.0, 0.0, 5.0), "opening": 1.0, "frame": 1.6, "radius": 0.0}


def crossed(last, position, axes=EAST):
    at = (np.array([point], float) for point in (last, position, (1.0, 0.0, 5.0)))
    forwards, backwards, aside, share = crossing(*at, *axes)
    return bool(forwards[0]), bool(backwards[0]), float(aside[0]), float(share[0])


def test_a_plane_is_crossed_where_the_straight_way_meets_it():
    # From x = 0.8 to 1.2 past the plane at 1: half way, y from 0.1 to 0.5 and z from 5.2 to 5.0.
    forwards, backwards, aside, share = crossed((0.8, 0.1, 5.2), (1.2, 0.5, 5.0))
    assert (forwards, backwards) == (True, False)
    assert aside == pytest.approx(0.3) and share == pytest.approx(0.5)  # the larger of 0.3 and 0.1
    # The same way back, and higher than wide: 0.4 up.
    forwards, backwards, aside, _ = crossed((1.2, 0.5, 5.8), (0.8, 0.1, 5.0))
    assert (forwards, backwards) == (False, True) and aside == pytest.approx(0.4)
    assert crossed((0.2, 0.0, 5.0), (0.9, 0.0, 5.0))[:2] == (False, False)
    # A gate that one dives through: up along its edges is east.
    down = np.array([[0.0, 0.0, -1.0]]), EAST[1]
    forwards, _, aside, _ = crossed((1.3, 0.1, 5.1), (1.3, 0.1, 4.9), down)
    assert forwards and aside == pytest.approx(0.3)


def race(y=0.0, *, speed=10.0, **options):
    """A flight to the east at some distance from the gates' axis, without a turn."""
    environment = Environment(Race(**OWN | options), seed=1, engine="free_flight")
    start = {"position": (0.0, y, 5.0), "velocity": (speed, 0.0, 0.0), "quaternion": (1, 0, 0, 0)}
    environment.reset(start=start)
    for _ in range(20):
        done = environment.step(np.zeros((1, 4)))
        yield environment.snapshot.task, done
        if done.terminated[0]:
            return


def test_gates_are_passed_in_order_and_timed_between_control_steps():
    flown = [(float(t.passed[0]), float(t.time[0]), bool(d.is_success[0])) for t, d in race()]
    # Drag alone brakes: dv/dt = -k v^2, so that x = ln(1 + k v0 t) / k; control steps of 0.05 s.
    k = Vehicle().drag_coefficient / Vehicle().mass
    times = [math.expm1(k * x) / (k * 10.0) for x in (1.0, 4.0)]  # 0.10 and 0.41 s
    assert {passed for passed, _, _ in flown} == {0.0, 1.0, 2.0}
    assert flown[-1][1] == pytest.approx(times[1], rel=1e-3) and flown[-1][2]
    first = next(time for passed, time, _ in flown if passed == 1)
    assert first == pytest.approx(times[0], rel=1e-3)
    assert sum(d.reward_terms["pass"][0] for _, d in race()) == 20.0


@pytest.mark.parametrize(
    ("y", "margin", "passed", "hit", "missed"),
    [
        (0.45, 0.0, 1, False, 0.0),
        (0.45, 0.1, 0, True, 0.05),
        (0.75, 0.0, 0, True, 0.25),
        (0.85, 0.0, 0, False, 0.35),
        (0.85, 0.1, 0, True, 0.45),
        (2.5, 0.0, 0, False, 1.0),  # the cost grows no more
    ],
)
def test_an_opening_is_passed_a_frame_is_hit_and_beside_it_nothing_is(
    y, margin, passed, hit, missed
):
    """The opening reaches 0.5 m, the frame 0.8 m from the axis; less and more by the margin."""
    flown = [(task, done) for task, done in race(y, margin=margin)][:4]  # 0.2 s, the gate at 0.1 s
    task, done = flown[-1]
    assert task.passed[0] == passed and not done.is_success[0]
    assert bool(done.terminated[0]) == hit
    assert sum(d.reward_terms["crash"][0] for _, d in flown) == -100.0 * hit
    cost = sum(d.reward_terms["miss"][0] for _, d in flown)
    assert cost == pytest.approx(-50 * missed, abs=0.2)
    # From behind a frame is hit alike, and nothing is passed or missed.
    behind = {"gates": ((-1.0, 0.0, 5.0, 0.0, 0.0), GATES[1]), "margin": margin}
    flown = [(task, done) for task, done in race(y, speed=-10.0, **behind)][:4]
    assert bool(flown[-1][1].terminated[0]) == hit and flown[-1][0].passed[0] == 0
    assert not any(d.reward_terms["miss"][0] for _, d in flown)


def test_who_goes_astray_is_out():
    # Away from the first gate, 1 m away: out past 6 m.
    *_, (_, done) = race(speed=-15.0)
    assert done.terminated[0] and not done.is_success[0]
    assert done.error[0] == pytest.approx(6.0, abs=0.8)


@pytest.mark.parametrize(("height", "cost"), [(0.5, 3.0), (0.9, 0.0)])
def test_low_flight_costs_by_depth_and_time(height, cost):
    environment = Environment(Race(low_weight=10.0), seed=1, engine="free_flight")
    # The paper's aircraft hovers for its control step of 0.05 s: 10 x 0.3 m below 0.8 m.
    position = (-5.0, -4.5, height - environment.origin[2])
    environment.reset(start={"position": position, "quaternion": (1, 0, 0, 0)})
    done = environment.step(np.zeros((1, 4)))
    assert done.reward_terms["low"][0] == pytest.approx(-cost, abs=0.01)


def test_practice_flights_begin_on_the_way_to_every_gate():
    task = Race(flying=1.0, track="alphapilot")
    environment = begun(task, num_envs=300, seed=3, engine="free_flight")
    course, state = environment.snapshot.task, environment.snapshot.state
    assert set(course.gate) == set(range(11))
    before = task.course.centre[course.gate.astype(int) - 1]
    # Within half an opening of the straight way from the gate before.
    leg = course.goal - before
    share = np.sum((state.position - before) * leg, -1) / np.sum(leg**2, -1)
    aside = state.position - before - np.clip(share, 0, 1)[:, None] * leg
    assert (np.linalg.norm(aside, axis=-1) < task.course.opening / 2).all()
    assert np.ptp(share) > 0.8
    # At up to 5 m/s, straight to the gate.
    towards = np.sum(state.velocity * (course.goal - state.position), -1) / course.leg
    np.testing.assert_allclose(towards, state.speed)
    assert 4.5 < state.speed.max() < 5.0
    rest = Environment(Race(), num_envs=50, seed=3).reset()
    assert not rest["velocity"].any()


@pytest.mark.parametrize("name", NAMES)
def test_known_tracks_lead_through_their_gates_and_are_compiled(name):
    task = Race(track=name)
    read = json.loads((TRACKS / f"{name}.json").read_text())
    assert read["source"].startswith("https://") and read["licence"].startswith("MIT")
    track = task.course
    way = np.diff([track.start, *track.centre], axis=0)
    through = track.axes[:, 0]
    np.testing.assert_allclose(np.linalg.norm(track.axes, axis=-1), 1.0)
    # Each gate is come to from its front, or gone from at its back (the fifth of split_s lies
    # below the fourth, and is flown through the other way).
    comes = np.sum(way * through, -1)
    assert ((comes > 0) | (np.sum(np.roll(way, -1, axis=0) * through, -1) > 0)).all()
    assert (comes > 0).mean() > 0.8
    assert (track.centre[:, 2] > track.frame / 2).all()
    environment = Environment(task, num_envs=2, vehicle="racer")
    environment.reset()
    assert environment.not_compiled == ""


def test_gates_stand_on_the_page_in_the_browser():
    task = Race(track="alphapilot")
    bars = np.array([bar["position"] for bar in surroundings(task)["shapes"]])
    # The four bars of a frame lie around its centre, as far above the ground as the feet reach.
    centres = bars.reshape(11, 4, 3).mean(1) - task.course.centre
    np.testing.assert_allclose(centres, [[0, 0, Vehicle().ground_clearance]] * 11, atol=1e-3)


def test_the_tracks_have_their_gates_and_split_s_its_length():
    counts = [len(Race(track=name).course.gates) for name in ("split_s", "alphapilot", "airsim")]
    assert counts == [7, 11, 21]
    centre = Race(track="split_s").course.centre
    length = np.linalg.norm(np.diff([*centre, centre[0]], axis=0), axis=-1).sum()
    assert length == pytest.approx(67.8, abs=0.05)  # what is published of it


def test_figures_of_races_by_hand():
    """Two laps of two gates. The first aircraft passes at 1, 2, 4 and 6.5 s, the second crashes
    after three gates, the third passes at 1, 3, 4 and 5 s."""
    base = fly(lambda seen: np.zeros((len(seen), 4)), Race(time_limit=0.3), episodes=3)
    passed = np.array([[1, 1, 1], [2, 2, 2], [3, 3, 3], [4, np.nan, 4], [np.nan, np.nan, 4.0]])
    time = np.array([[1, 1, 1], [2, 2, 3], [4, 4, 4], [6.5, np.nan, 5], [np.nan, np.nan, 5.0]])
    done = np.array([True, False, True])
    rollout = dataclasses.replace(
        base, remembered={"passed": passed, "time": time}, is_success=done, terminated=~done,
        task=Race(**OWN, laps=2),
    )  # fmt: skip
    figures = rollout.task.metrics(rollout)
    assert figures["race_time_mean_s"] == pytest.approx(5.75)
    assert figures["race_time_best_s"] == 5.0
    assert figures["gates_passed_mean"] == pytest.approx(11 / 3)
    # Second laps: 6.5 - 2 and 5 - 3.
    assert figures["flying_lap_mean_s"] == pytest.approx(3.25)
    assert figures["in_time_rate"] == pytest.approx(1 / 3)  # 5 s, of 6.5 s, a crash and 5 s
    rates = np.array([[[1.0, -9.0, 0.0], [0.0, 2.0, 3.0]], [[-4.0, 0.0, 1.0], [np.nan] * 3]])
    turning = rollout.task.metrics(dataclasses.replace(rollout, body_rate=rates))
    largest = [turning[f"largest_{axis}_rate_rad_s"] for axis in ("roll", "pitch", "yaw")]
    assert largest == [4.0, 9.0, 3.0]
    none = dataclasses.replace(rollout, is_success=~done & done)
    assert math.isnan(none.task.metrics(none)["race_time_mean_s"])
    assert "flying_lap_mean_s" not in summarize(dataclasses.replace(rollout, task=Race(**OWN)))


@pytest.mark.slow
def test_the_geometric_controller_comes_through_on_the_racer():
    controller = make_controller("geometric", "race", "racer")
    flown = fly(controller, "race", episodes=4, vehicle="racer", engine="free_flight")
    figures = summarize(flown)
    assert figures["success_rate"] == 1.0 and figures["race_time_mean_s"] < 25.0


FIRST = (0.0, 0.0, 5.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("second", "overlaps"),
    [
        ((0.0, 1.0, 5.0, 0.0, 0.0), True),
        ((0.0, 1.5, 6.5, 0.0, 0.0), True),
        ((0.0, 1.5, 7.0, 0.0, 0.0), False),
        ((0.0, -2.0, 5.0, 180.0, 0.0), False),  # side by side
        ((0.02, 0.0, 6.9, 180.0, 0.0), True),  # a frame is 6 cm deep
        ((0.1, 0.0, 5.0, 0.0, 0.0), False),
        ((0.9, 0.0, 5.0, 90.0, 0.0), True),  # the edge of one across the other, and before it
        ((1.1, 0.0, 5.0, 90.0, 0.0), False),
        ((0.0, 0.9, 5.0, 45.0, 0.0), True),  # it crosses the plane of the first at its centre
        ((0.0, 1.1, 5.0, 45.0, 0.0), False),
        ((0.0, 0.0, 6.1, 0.0, 90.0), False),  # flat above it
    ],
)
def test_gates_whose_frames_overlap_are_refused(second, overlaps):
    """Frames of 2 m in the plane x = 0 and elsewhere."""
    given = {"gates": (FIRST, second), "track": "split_s"}
    if not overlaps:
        assert len(Race(**given).course.gates) == 2
        return
    with refused("own gates 1 and 2", match=r"\[\[0.0, 0.0, 5.0\], .*frames of 2 m do not overlap"):
        Race(**given)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"track": "split"}, "split_s"),
        ({"gates": ()}, r"gates = \(\): must be at least one row"),
        ({"gates": (FIRST[:4],)}, "5 numbers"),
        ({"gates": "split_s"}, "at least one row"),
        ({"start": "(0, 0, 5)"}, r"a sequence, such as \[0, 0, 1\]"),
        ({"start": (0.0, 0.0)}, "3 numbers"),
        ({"opening": 3.0}, "frame"),
        ({"opening": -1.0}, "opening"),
        ({"frame": 2.5}, "gates 4 and 5"),
        ({"margin": 0.8}, "margin"),
        ({"flying": 1.5}, "flying"),
        ({"laps": 0}, "laps"),
        ({"laps": 1.5}, "laps"),
    ],
)
def test_races_that_cannot_be(options, said):
    with refused(match=said):
        tasks.make("race", **options)


def test_the_next_gate_is_drawn_in_its_own_colour():
    environment = begun(Race(), seed=1)
    bars = environment.markers()
    assert len(bars) == 4 * 7
    first = {tuple(bar.rgba) for bar in bars[:4]}
    assert len(first) == 1 and first.isdisjoint(tuple(bar.rgba) for bar in bars[4:])
    # The upper bar of the first gate: 3.48 m, half of the opening and half of a bar higher.
    top = max(bars[:4], key=lambda bar: bar.position[2])
    height = 3.48 + 0.75 + 0.125 + Vehicle().ground_clearance
    assert top.position[2] == pytest.approx(height)
