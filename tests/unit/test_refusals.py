"""What is refused has changed nothing: resets, air that is not finite, counters that cannot be."""

import helpers
import numpy as np
import pytest

import quadrl  # noqa: F401 - registers the ids
from quadrl.base.philox import MAX_SEED
from quadrl.core.environment import Environment
from quadrl.engines.air import ROWS as WEATHER_ROWS

ROWS, ROW_OF_STEPS = 9, WEATHER_ROWS.index("steps")
ACTIONS = 0.3 * helpers.random_actions(12, ROWS)
SETTINGS = {
    "in calm air": ("hover", {}),
    "near the ground": ("landing", {"observe": {"airspeed": True}}),
    "disturbed": ("hover", {"randomization": "full", "weather": "light"}),
}
STARTS = {
    "velocity at the start": {"velocity": [1e9, 0, 0]},
    "body_rate at the start": {"body_rate": [0, 0, 60.0]},
    "rotor_speed at the start": {"rotor_speed": [1, np.inf, 5, 5]},
    "position at the start": {"position": [np.nan, 0, 1]},
    "position": {"position": "high"},
    "quaternion": {"quaternion": [0, 0, 0, 0]},
    "start": {"speed": 1.0},
}
"""By the name that the message has."""


def flying(task="hover", **settings):
    environment = helpers.begun(task, ROWS, seed=5, **settings)
    helpers.fly(environment, ACTIONS[:3])
    return environment


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize("setting", SETTINGS)
def test_a_refused_reset_changes_nothing(setting, engine):
    task, settings = SETTINGS[setting]
    environment, other = (flying(task, engine=engine, **settings) for _ in range(2))
    for name, start in STARTS.items():
        for rows, seed in ((None, None), ([2, 4], 11)):
            with helpers.refused(name):
                environment.reset(rows, start, seed)
    # They fly on alike, and so do their next episodes.
    flown = (helpers.fly(each, ACTIONS[3:]) for each in (environment, other))
    helpers.assert_records(*flown)
    for got, expected in zip(environment.reset().values(), other.reset().values(), strict=True):
        np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize("settings", [{}, {"randomization": "full", "weather": "light"}])
def test_a_reset_of_no_rows_gives_no_rows(settings):
    environment, other = (flying(**settings) for _ in range(2))
    for none in ([], np.zeros(ROWS, dtype=bool)):
        fresh = environment.reset(none)
        assert environment.flatten(fresh).shape == (0, environment.size)
    flown = (helpers.fly(each, ACTIONS[3:]) for each in (environment, other))
    helpers.assert_records(*flown)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_air_that_is_not_finite_ends_in_a_line_before_the_step(engine, value):
    for count in (1, ROWS):
        environment, other = (helpers.begun(num_envs=count, engine=engine) for _ in range(2))
        row = count - 1
        for array, column, name in (
            (environment.engine.wind, 2, f"engine.wind[{row}]"),
            (environment.engine.air, 5, f"engine.air[{row}]"),
        ):
            array[row, column] = value
            with helpers.refused(name, allowed="finite"):
                helpers.idle(environment)
            array[row, column] = 0.0
        got, expected = (helpers.recorded(e, helpers.idle(e)) for e in (environment, other))
        helpers.assert_records([got], [expected])


@pytest.mark.parametrize(("count", "drawn"), [(1, "none"), (ROWS, {"mass": (0.9, 1.1)})])
def test_parameters_that_are_not_finite_end_in_a_line(count, drawn):
    environment = helpers.begun(num_envs=count, randomization=drawn)
    environment.engine.parameters["drag_coefficient"][-1] = np.nan
    with helpers.refused("engine.parameters['drag_coefficient']", allowed="finite"):
        helpers.idle(environment)
    environment.reset(seed=1)
    if count == 1:
        environment.engine.parameters["drag_coefficient"] = environment.vehicle.drag_coefficient
    assert not helpers.idle(environment).diverged.any()


COUNTERS = {
    "keys": (-1, 2**62),
    "episodes": (-1, 2**62),
    "randomizer.place": (-1, 2**62),
    "randomizer.steps": (-1, 2, 2**62),
    "weather.streams": (-1, 2**62),
    "weather.table": (-1.0, 2.0, np.nan),
    "episode.steps": (-1.0, 0.5, 2.0**62, np.nan),
    "episode.error_sum": (np.nan, np.inf),
    "time": (-1.0, 0.2, np.nan),
}
"""Three control steps were flown."""


@pytest.mark.slow
@pytest.mark.parametrize("name", COUNTERS)
@pytest.mark.parametrize("begun", [True, False])
def test_counters_that_no_environment_has_are_not_restored(name, begun):
    settings = {"randomization": "full", "weather": "light"}
    environment, other = (flying(**settings) for _ in range(2))
    fresh = Environment("hover", num_envs=ROWS, seed=8, **settings)
    into = environment if begun else fresh
    for value in COUNTERS[name]:
        saved = other.save()
        table = saved[name]
        column = table[ROW_OF_STEPS] if name == "weather.table" else table.reshape(-1)
        column[-1] = value
        with helpers.refused(name):
            into.restore(saved)
    if not begun:
        with pytest.raises(RuntimeError, match="call reset"):
            helpers.idle(fresh)
    flown = (helpers.fly(each, ACTIONS[3:]) for each in (environment, other))
    helpers.assert_records(*flown)


def test_the_last_row_of_a_batch_has_a_seed_too():
    environment = flying()
    for seed in (MAX_SEED, MAX_SEED - ROWS + 2):
        with helpers.refused("seed", seed):
            environment.seed(seed)
    environment.seed(MAX_SEED - ROWS + 1)
    environment.reset()
    environment.restore(environment.save())
