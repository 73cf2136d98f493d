"""Wind in pictures: streaks that go where the air goes, its strength in the panel."""

import numpy as np
import pytest

from quadrl.conditions.weather import Weather
from quadrl.engines import mjcf
from quadrl.evaluation.evaluate import evaluate
from quadrl.rendering import Renderer, overlay, render_trajectory
from quadrl.rendering.drawing import STREAKS, streaks

WEST = Weather(wind_speed=12.0, direction=np.pi)
HIGH = np.array([0.0, 0.0, 30.0])


def heads(lines):
    """Where the streaks end that are seen well, (n, 3), and where they begin."""
    seen = [line for line in lines if line.rgba[-1, 3] > 0.5]
    return (np.array([line.points[end] for line in seen]) for end in (-1, 0))


def assert_moved(before, after, way, share=2, atol=1e-12):
    """Of the streaks that are seen before (n, 3), one of `share` is found again, a way further."""
    apart = np.linalg.norm(after[:, None] - (before + way), axis=-1).min(axis=0)
    assert np.sort(apart)[: len(apart) // share].max() < atol


def test_streaks_point_where_the_air_goes_and_drift_with_it():
    wind = np.array([6.0, -3.0, 0.5])
    shown = streaks(HIGH, wind, np.zeros(3), 1.0)
    assert STREAKS / 4 < len(shown) <= STREAKS
    ends, begins = heads(shown)
    assert len(ends) > 5 and abs(ends - HIGH).max() < 1.2
    np.testing.assert_allclose(ends - begins, np.tile(wind * 0.05, (len(ends), 1)))
    assert (np.diff(shown[0].rgba[:, 3]) >= 0).all() and shown[0].rgba[0, 3] > 0  # the head leads
    # A centimetre of drift moves each by a centimetre, and so does none of the aircraft's ways.
    moved, _ = heads(streaks(HIGH, wind, np.array([0.01, 0, 0]), 1.0))
    assert_moved(ends, moved, (0.01, 0, 0))
    still, _ = heads(streaks(HIGH + (0.01, 0, 0), wind, np.zeros(3), 1.0))
    assert_moved(ends, still, 0.0)


def test_streaks_are_short_in_a_storm_small_with_a_small_aircraft_and_above_the_ground():
    ends, begins = heads(streaks(HIGH, np.array([100.0, 0, 0]), np.zeros(3), 1.0))
    assert np.linalg.norm(ends - begins, axis=1).max() == pytest.approx(0.8)
    small, _ = heads(streaks(HIGH, np.array([5.0, 0, 0]), np.zeros(3), 0.25))
    assert abs(small - HIGH).max() < 1.2 / 2
    low = streaks(np.array([0, 0, 0.1]), np.array([5.0, 0, -3.0]), np.zeros(3), 1.0)
    assert low and min(line.points[:, 2].min() for line in low) > 0
    for calm in (0.0, 0.05):
        assert streaks(HIGH, np.array([calm, 0, 0]), np.zeros(3), 1.0) == ()


@pytest.fixture(scope="module")
def flown():
    """A flight in wind, and one in calm air."""
    return [evaluate("hover", episodes=1, weather=w, time_limit=0.5) for w in (WEST, None)]


def test_a_flight_is_drawn_in_its_wind(flown, monkeypatch, cheap_pictures):
    asked, written = [], []
    blank = np.zeros((120, 160, 3), np.uint8)
    monkeypatch.setattr(Renderer, "frame", lambda self, *_, **o: asked.append(o) or blank)
    monkeypatch.setattr(overlay.Panel, "draw", lambda self, _, lines, *__: written.append(lines))
    model = mjcf.compile_model(flown[0].vehicle)
    for one in flown:
        flight = one.rollout.trajectory(one.vehicle)
        list(render_trajectory(flight, model, width=160, height=120))
    steps = len(asked) // 2
    windy, calm = asked[:steps], asked[steps:]
    wind = flown[0].rollout.wind[:, 0]
    for k, one in enumerate(windy):
        assert written[k][-1] == f"{np.linalg.norm(wind[k]):.1f} m/s" and len(written[k]) == 5
        ends, begins = heads(one["markers"])
        np.testing.assert_allclose(ends - begins, np.tile(wind[k] * 0.05, (len(ends), 1)))
    # From one picture to the next the air goes on by its wind.
    one, other = (next(heads(windy[k]["markers"])) for k in (4, 5))
    assert_moved(one, other, 0.05 * (wind[4] + wind[5]) / 2, share=3, atol=1e-9)
    assert all(one["markers"] == () for one in calm) and len(written[-1]) == 4


def test_a_resampled_flight_has_its_wind(flown):
    flight, calm = (one.rollout.trajectory(one.vehicle) for one in flown)
    assert calm.wind is None and calm.resampled(40).wind is None
    np.testing.assert_array_equal(flight.wind, flown[0].rollout.wind[:, 0])
    np.testing.assert_allclose(flight.resampled(40).wind[::2], flight.wind, atol=1e-12)
