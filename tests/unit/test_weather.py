"""The weather against its formulas: profile, spectra, gust, noise; and that it belongs to a row."""

import dataclasses
import math

import air_reference as definition
import helpers
import numpy as np
import pytest
import torch
from scipy import stats

from quadrl import tasks
from quadrl.aircraft import parameters
from quadrl.aircraft.vehicle import Vehicle
from quadrl.conditions.sampler import Drawn
from quadrl.conditions.weather import WEATHERS, Weather, WeatherProcess
from quadrl.engines import air

LIGHT = WEATHERS["light"]
GUSTY = Weather(wind_speed=7.72, gust_speed=5.0, gust_time=1.5)
STEP = 0.05  # [s]
SIGMAS, RARE = 5.0, 1e-6  # as in test_rng.py


def process(weather, count=1, noise_time=0.0, time_limit=10.0, seed=0, altitude=3.0):
    """A process of rows that stay where they are, and its engine."""
    task = tasks.make("hover", altitude=altitude)
    engine = helpers.begun(task, count, engine="free_flight").engine
    made = WeatherProcess(weather, engine, time_limit, noise_time)
    made.begin(np.arange(count), seed + np.arange(count), np.zeros(count, dtype=np.int64), Drawn())
    return made, engine


def column(made, name):
    return made.save()["table"][air.ROWS.index(name)]


def blown(weather, steps, **settings):
    """The wind (steps + 1, N, 3) [m/s] of rows that stay where they are."""
    made, engine = process(weather, **settings)
    winds = [engine.wind.copy()]
    for _ in range(steps):
        made.act()
        winds.append(engine.wind.copy())
    return np.array(winds), made


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "noise_time", "as_array"),
    [(1, 0.0, np.asarray), (21, 0.5, np.asarray), (21, 0.5, torch.as_tensor)],
    ids=["one", "batch", "tensors"],
)
def test_c_is_the_definition_bit_for_bit(count, noise_time, as_array):
    made, engine = process(GUSTY, count, noise_time)
    numbers = np.arange(count)
    made.begin(numbers, 2**40 + numbers, 2**33 + 7 * numbers, Drawn())
    engine.qpos[:, 2] = np.geomspace(0.01, 500.0, count)
    height, rotors = as_array(engine.qpos[:, 2].copy()), 4 if noise_time else 0
    streams = tuple(map(as_array, made.save()["streams"]))
    kept = dict(zip(air.ROWS, map(as_array, made.save()["table"]), strict=True))
    now = definition.begun(kept, streams, rotors)
    for step in range(220):  # past the gust
        for name, values in now.items():
            np.testing.assert_array_equal(column(made, name), np.asarray(values), err_msg=name)
        if step:
            how = 1 / GUSTY.roughness, STEP, 1 / GUSTY.gust_time
            wind = np.asarray(definition.blowing(now, height, *how))
            np.testing.assert_array_equal(engine.wind, wind)
            assert not (np.signbit(wind) & (wind == 0)).any()
        noise = np.stack([np.asarray(now[name]) for name in air.NOISE], axis=-1)
        np.testing.assert_array_equal(engine.air[:, 3:], noise * (np.arange(8) < rotors))
        made.act()
        now = definition.advanced(now, streams, rotors)


def test_series_are_the_functions():
    x = np.geomspace(1, 1e10, 100_001)
    np.testing.assert_allclose(definition.logarithm(x), np.log(x), rtol=0, atol=4e-15)
    np.testing.assert_array_equal(definition.logarithm(np.array([1.0, 0.5, 0.0, -3.0])), 0)
    share = np.linspace(0, 1, 10_001)
    np.testing.assert_allclose(
        definition.half_wave(share), np.sin(np.pi * share), rtol=0, atol=1e-15
    )
    np.testing.assert_array_equal(definition.half_wave(np.array([-9.0, -1e-9, 1.0 + 1e-9, 7.0])), 0)


def test_no_step_draws_the_numbers_of_another():
    # Two numbers of a block, which 2800 blocks share by chance once in 10000 times.
    steps = np.arange(400.0)
    streams = np.full(400, 5), np.full(400, 2)
    drawn = np.array(definition.normals(streams, steps, 0, 6 + parameters.MAX_ROTORS))
    blocks = drawn.reshape(-1, 2, 400).transpose(0, 2, 1).reshape(-1, 2)
    assert len(np.unique(blocks, axis=0)) == len(blocks) == 400 * air.BLOCKS


@pytest.mark.parametrize(
    ("height", "share"),
    # ln(h / 0.0457) / ln(6.096 / 0.0457), ln(6.096 / 0.0457) = 4.893
    [(6.096, 1.0), (2.0, 0.772), (0.5, 0.489), (0.0457, 0.0), (0.02, 0.0), (-1.0, 0.0)],
)
def test_mean_wind_follows_the_profile(height, share):
    made, _ = process(dataclasses.replace(LIGHT, direction=0.7))
    still = dict(zip(air.ROWS, made.save()["table"], strict=True))
    still |= {name: np.zeros(1) for name in air.FILTERS}
    wind = definition.blowing(still, np.array([height]), 1 / LIGHT.roughness, STEP, 1.0)
    expected = share * 7.72 * np.array([[math.cos(0.7), math.sin(0.7), 0.0]])
    np.testing.assert_allclose(wind, expected, rtol=1e-3)


def test_directions_are_drawn_or_given():
    count = 3000
    made, _ = process(GUSTY, count)
    bearing, gust = (
        np.arctan2(column(made, f"{of}north"), column(made, f"{of}east")) for of in ("", "gust_")
    )
    start = 2 * np.pi * column(made, "gust_start") / (10.0 - 1.5)
    for angle in (bearing, gust, start, bearing - gust, bearing - start, gust - start):
        angle = angle % (2 * np.pi)
        assert stats.kstest(angle, stats.uniform(0, 2 * np.pi).cdf).pvalue > RARE
    made, _ = process(dataclasses.replace(GUSTY, direction=-1.2), 5)
    for of, speed in (("", 1.0), ("gust_", 5.0)):
        np.testing.assert_allclose(column(made, f"{of}east"), speed * math.cos(-1.2))
        np.testing.assert_allclose(column(made, f"{of}north"), speed * math.sin(-1.2))


def test_lengths_and_deviations_are_those_of_the_standard():
    rows = air.fixed_of(7.72, LIGHT.roughness, 3.0, STEP, 0.0)
    assert rows["upward_deviation"] == pytest.approx(0.772)
    assert rows["level_deviation"] == pytest.approx(1.516, rel=1e-3)
    speed = 7.72 * math.log(3.048 / 0.0457) / math.log(6.096 / 0.0457)
    # L_u = 23.05 m, L_w = 3.05 m up to 10 ft.
    assert rows["left_rate"] == pytest.approx(speed * STEP / 23.05, rel=1e-3)
    assert rows["up_rate"] == pytest.approx(speed * STEP / 3.048, rel=1e-3)
    # At 1000 ft and above the air is the same in all directions: 0.177 + 0.823 = 1.
    high = air.fixed_of(7.72, LIGHT.roughness, 400.0, STEP, 0.0)
    assert high["level_deviation"] == pytest.approx(high["upward_deviation"])
    assert high["left_rate"] == pytest.approx(high["up_rate"])
    # In weak wind it is carried past at 1 m/s.
    weak = air.fixed_of(0.1, LIGHT.roughness, 3.0, STEP, 0.0)
    assert weak["up_rate"] == pytest.approx(STEP / 3.048)


RATES = [1e-4, 1e-3, 0.01, 0.1, 0.5, 1.0, 3.0, 20.0]  # control steps in times L/V
PER_LENGTH = 1.0 * STEP / 3.048  # a rate at 1 m/s


def matrices(name, rate):
    """(A, Q) of a filter, whose covariance is A P A' + Q after a step."""
    rows = air.fixed_of(0.0, LIGHT.roughness, 3.0, STEP * rate / PER_LENGTH, 0.0)
    if name == "along":
        return np.array([[rows["along_keep"]]]), np.array([[rows["along_fresh"] ** 2]])
    assert rows[f"{name}_rate"] == pytest.approx(rate)
    keep, rate, first, across, second = (rows[f"{name}_{part}"] for part in air.WALK)
    noise = np.array([[first, 0.0], [across, second]])
    return keep * np.array([[1.0, 0.0], [rate, 1.0]]), noise @ noise.T


COVARIANCE = np.array([[0.5, 0.25], [0.25, 0.25]])
OUTPUT = np.array([math.sqrt(3), 1 - math.sqrt(3)])


def test_turbulence_is_that_at_the_altitude_of_the_task():
    # 0.1 * 7.72 m/s over (0.177 + 0.000823 h)^0.4, with 60 m = 196.85 ft.
    made, _ = process(LIGHT, altitude=60.0)
    expected = 0.772 / (0.177 + 0.000823 * 196.85) ** 0.4
    assert column(made, "level_deviation") == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("rate", RATES)
def test_a_step_of_any_length_keeps_the_covariance(rate):
    turn, noise = matrices("up", rate)
    np.testing.assert_allclose(turn @ COVARIANCE @ turn.T + noise, COVARIANCE, atol=1e-15)
    assert OUTPUT @ COVARIANCE @ OUTPUT == pytest.approx(1, abs=1e-15)
    # Two halves of a step are the step: the spectrum does not depend on it.
    half, fresh = matrices("up", rate / 2)
    np.testing.assert_allclose(half @ half, turn, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(half @ fresh @ half.T + fresh, noise, atol=1e-15)


@pytest.mark.parametrize("step_share", [1, 5])
def test_the_wind_has_the_deviations_and_correlations_of_the_spectra(step_share):
    """Of 3000 rows, at times that are 4 L_w/V apart and more."""
    vehicle = dataclasses.replace(Vehicle(), control_timestep=STEP / step_share)
    engine = helpers.begun("hover", 3000, engine="free_flight", vehicle=vehicle).engine
    made = WeatherProcess(dataclasses.replace(LIGHT, direction=math.pi / 2), engine, 10.0)
    made.begin(np.arange(3000), np.arange(3000), np.zeros(3000, np.int64), Drawn())
    engine.qpos[:, 2] = 0.01  # no mean wind
    winds = []
    for _ in range(60 * step_share + 1):
        made.act()
        winds.append(engine.wind.copy())
    # The wind blows north: left of it is west.
    along, left, up = np.moveaxis(np.array(winds)[::step_share], -1, 0)[[1, 0, 2]]
    left = -left
    speed = 7.72 * math.log(3.048 / 0.0457) / math.log(6.096 / 0.0457)  # 6.63 m/s
    for wind, sigma, length, first in (
        (along, 1.516, 23.05, True),
        (left, 1.516, 23.05, False),
        (up, 0.772 * 0.01 / 3.048, 3.048, False),  # 1 cm over the ground
    ):
        unit = wind / sigma
        # Times far apart count alone; the bounds are those of Gauss's distribution.
        for moment in (0, 30, 60):
            assert abs(unit[moment].mean()) < SIGMAS / math.sqrt(3000)
            assert abs(unit[moment].var() - 1) < SIGMAS * math.sqrt(2 / 3000)
        for steps in (1, 9, 18, 60):
            lag = steps * STEP * speed / length
            expected = math.exp(-lag) * (1 if first else 1 - lag / 2)
            found = (unit[0] * unit[steps]).mean()
            assert abs(found - expected) < SIGMAS * math.sqrt(2 / 3000), (length, steps)
        kurtosis = (unit[[0, 30, 60]] ** 4).mean() / (unit[[0, 30, 60]] ** 2).mean() ** 2
        assert kurtosis == pytest.approx(2.9, abs=0.3)
    for one, other in ((along, left), (along, up), (left, up)):
        assert abs(np.corrcoef(one[60], other[60])[0, 1]) < SIGMAS / math.sqrt(3000)


def test_the_gust_has_its_peak_and_its_integral():
    pulse = Weather(gust_speed=5.0, gust_time=2.0, direction=math.pi)
    winds, made = blown(pulse, 250, count=40)
    start = column(made, "gust_start")
    assert (start >= 0).all() and (start < 8).all() and np.ptp(start) > 4  # within 10 s
    np.testing.assert_allclose(winds[..., 1:], 0, atol=1e-14)
    along = -winds[..., 0]
    time = STEP * np.arange(251)[:, None]
    inside = (time > start) & (time < start + 2.0)
    assert (along[~inside] == 0).all() and (along[inside] > 0).all()
    # 5 (1 - cos(2 pi (t - t0) / 2)) / 2
    expected = 2.5 * (1 - np.cos(np.pi * (time - start)))
    np.testing.assert_allclose(along[inside], expected[inside], atol=1e-12)
    # Next to the middle, by at most half a step: 5 cos^2(pi 0.025 / 2) = 4.992; in all 5 * 2 / 2.
    assert (along.max(axis=0) >= 4.992).all() and along.max() <= 5
    np.testing.assert_allclose(STEP * along.sum(axis=0), 5.0, rtol=1e-12)
    # A gust that is longer than the episode begins with it.
    made, _ = process(Weather(gust_speed=5.0, gust_time=20.0), 3)
    np.testing.assert_array_equal(column(made, "gust_start"), 0)


def test_noise_of_the_lift_is_of_first_order_and_changes_no_wind():
    count, tau = 2000, 0.49
    made, engine = process(GUSTY, count, noise_time=tau)
    plain, other = process(GUSTY, count)
    noise = []
    for _ in range(20):
        made.act()
        plain.act()
        noise.append(engine.air[:, 3:7].copy())
        np.testing.assert_array_equal(engine.wind, other.wind)
    noise = np.array(noise)
    assert not engine.air[:, 7:].any() and not other.air[:, 3:].any()
    for at in (0, 19):
        assert (abs(noise[at].mean(axis=0)) < SIGMAS / math.sqrt(count)).all()
        assert (abs(noise[at].var(axis=0) - 1) < SIGMAS * math.sqrt(2 / count)).all()
        assert abs(np.corrcoef(noise[at].T) - np.eye(4)).max() < SIGMAS / math.sqrt(count)
    for steps in (1, 5, 19):
        found, expected = (noise[0] * noise[steps]).mean(axis=0), math.exp(-steps * STEP / tau)
        assert (abs(found - expected) < SIGMAS * math.sqrt(2 / count)).all()
    assert abs((noise[0, :, 0] * engine.wind[:, 2]).mean()) < SIGMAS * 0.772 / math.sqrt(count)


def test_calm_air_costs_nothing_and_changes_nothing():
    for weather in (None, "calm", Weather(), Weather(roughness=0.1, gust_time=7.0)):
        flown = helpers.begun("hover", 3, weather=weather)
        assert flown.blowing is None and flown.weather.calm
        flown.engine.wind[:] = 1.0  # stays whoever's it is
        helpers.idle(flown)
        np.testing.assert_array_equal(flown.engine.air[:, :3], 1.0)
        assert not flown.engine.air[:, 3:].any()


def test_rows_may_have_a_wind_speed_of_their_own():
    factors = np.array([0.0, 0.4, 1.0, 2.6])
    numbers = np.arange(4), np.arange(4), np.zeros(4, np.int64)
    made, engine = process(LIGHT, 4)
    made.begin(*numbers, Drawn(wind=factors))
    for _ in range(5):
        made.act()
    for i, speed in enumerate(LIGHT.wind_speed * factors):
        same, other = process(dataclasses.replace(LIGHT, wind_speed=float(speed)), 4)
        same.begin(*numbers, Drawn())
        for _ in range(5):
            same.act()
        np.testing.assert_array_equal(engine.wind[i], other.wind[i])
    assert not engine.wind[0].any()


def test_what_was_saved_in_another_weather_is_not_taken_up():
    light, severe, calm = (
        helpers.begun("hover", 2, weather=w, aerodynamics="none") for w in ("light", "severe", None)
    )
    before = severe.engine.air.copy()
    for environment, saved, name in (
        (severe, light.save(), "weather.table"),
        (calm, light.save(), "weather.streams"),
        (light, calm.save(), "weather.table"),
    ):
        with helpers.refused(name) as caught:
            environment.restore(saved)
        assert caught.value.allowed
    broken = severe.save()
    broken["weather.table"][-1, 0] = np.nan
    with helpers.refused():
        severe.restore(broken)
    np.testing.assert_array_equal(severe.engine.air, before)


def test_a_steady_wind_is_its_mean_and_nothing_else():
    north = {"wind_speed": 5.0, "turbulence": 0.0, "direction": math.pi / 2}
    for weather in ("steady", north):
        environment = helpers.begun(num_envs=3, weather=weather)
        for _ in range(20):
            # As high as the aircraft is when the step begins: 5 m/s ln(h / z0) / ln(6.096 m / z0).
            height = environment.engine.qpos[:, 2].copy()
            helpers.idle(environment)
            wind, mean = (
                environment.engine.wind,
                5 * np.log(height / 0.0457) / math.log(6.096 / 0.0457),
            )
            np.testing.assert_allclose(np.linalg.norm(wind, axis=1), mean, rtol=1e-12)
            assert not wind[:, 2].any()
        if weather is north:
            np.testing.assert_allclose(wind[:, 0], 0.0, atol=1e-12)
            assert (wind[:, 1] > 0).all()
    strong = helpers.begun(weather=north | {"turbulence": 2.0}, seed=4)
    usual = helpers.begun(weather=north | {"turbulence": 1.0}, seed=4)
    up = [environment.engine.wind[0, 2] for environment in (strong, usual)]
    assert up[0] == pytest.approx(2 * up[1]) and up[1] != 0


def test_a_weather_is_found_by_name_and_by_its_fields():
    assert Weather.of("light") is LIGHT and Weather.of(GUSTY) is GUSTY
    assert Weather.of(dataclasses.asdict(GUSTY)) == GUSTY
    knots = [round(weather.wind_speed / 0.514444) for weather in WEATHERS.values()]
    assert knots == [0, 10, 15, 30, 45]
    for given in ("windy", 3.0, ("light",)):
        with helpers.refused("weather", lists="calm, steady, light"):
            helpers.begun(weather=given)
    with helpers.refused(lists="wind_speed"):
        Weather.of({"speed": 3.0})


@pytest.mark.parametrize(
    "bad",
    [
        {"wind_speed": -0.1},
        {"wind_speed": math.nan},
        {"gust_speed": 1000.0},
        {"gust_time": 0.0},
        {"roughness": 6.2},
        {"direction": "north"},
    ],
    ids=str,
)
def test_a_weather_that_cannot_be_is_refused_by_name(bad):
    ((name, value),) = bad.items()
    with helpers.refused(name, value):
        Weather(**bad)
