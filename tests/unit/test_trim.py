"""Trim: in wind, a start at rest and level becomes one whose forces balance; others stay."""

import dataclasses

import helpers
import numpy as np
import pytest

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.presets import VEHICLES, in_real_air
from quadrl.base.errors import QuadrlWarning
from quadrl.base.rotation import heading_of, norm
from quadrl.conditions.weather import WEATHERS, Weather
from quadrl.control import trim
from quadrl.control.feasibility import warn_of_unreached
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.engines.dynamics import Motion, derivative
from quadrl.engines.state import Start

HELD = {
    ("paper", "light"): 3.0,
    ("paper", "moderate"): 1.25,
    ("crazyflie_brushless", "light"): 3.0,
    ("crazyflie_brushless", "moderate"): 0.4,
}
"""Heights of starts [m] at which the aircraft hold the mean wind, 6.6 to 10.4 m/s; out of the
ground's reach, which is 8 radii of a rotor."""


def begun(vehicle, weather, height, **settings):
    task = {"task": "landing", "start_height": height}
    return helpers.begun(**task, num_envs=40, vehicle=vehicle, weather=weather, **settings)


def acceleration(environment):
    """Right after a reset, in the mean wind alone, without noise (N, 3) [m/s^2] and [rad/s^2]."""
    engine, blowing = environment.engine, environment.blowing
    place = blowing.save()["streams"]
    mean = blowing.mean_wind(*place, engine.qpos[:, 2])
    wind = np.concatenate([mean, 0 * mean[:, :1]], axis=1)
    motion = Motion(
        *np.split(engine.qpos, [3], axis=1), *np.split(engine.qvel, [3], axis=1), engine.act
    )
    p = Parameters.of(parameters.rows(environment.vehicle), 0.05)
    effects = environment.vehicle.aerodynamics.effects
    rate = derivative(p, motion, engine.act, wind, -9.81, effects)
    return wind, rate.velocity, rate.body_rate


@pytest.mark.parametrize(("vehicle", "weather"), HELD)
def test_episodes_begin_in_trim(vehicle, weather):
    environment = begun(vehicle, weather, HELD[vehicle, weather])
    wind, linear, angular = acceleration(environment)
    assert (norm(wind) > 6.0).all() and environment.engine.qvel.any() == 0
    assert norm(linear).max() < 0.05 and norm(angular).max() < 1.0
    # It leans against the wind, and heads where it did in calm air.
    rotation = environment.snapshot.state.rotation
    assert (np.einsum("ni,ni->n", rotation[:, :2, 2], wind[:, :2]) < 0).all()
    calm = helpers.begun("landing", 40, vehicle=vehicle).snapshot.state
    np.testing.assert_allclose(heading_of(rotation), heading_of(calm.rotation), atol=1e-12)
    # In what it was without: level and at hover speed.
    level = environment.reset(start={"quaternion": [1, 0, 0, 0]})
    assert level and norm(acceleration(environment)[1]).min() > 1.0


def test_what_asks_for_something_else_and_what_cannot_be_held_stays():
    vehicle = in_real_air(VEHICLES["paper"])
    zero, level = np.zeros((4, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))
    start = Start(zero, level, zero, zero, np.tile(vehicle.hover_speed, (4, 1)))
    wind = np.array([[0.0, 0.0], [5.0, 0.0], [20.0, 0.0], [1e3, 0.0]])
    found = trim.trimmed(vehicle, start, wind)
    changed = (found.quaternion != level).any(1), (found.rotor_speed != start.rotor_speed).any(1)
    np.testing.assert_array_equal(changed, [[False, True, False, False]] * 2)
    for name, value in (
        ("velocity", [0.1, 0.0, 0.0]),
        ("body_rate", [0.0, 0.0, 0.1]),
        ("quaternion", [0.8, 0.6, 0.0, 0.0]),
    ):
        moving = dataclasses.replace(start, **{name: np.tile(value, (4, 1))})
        same = trim.trimmed(vehicle, moving, wind)
        np.testing.assert_array_equal(same.quaternion, moving.quaternion)
        np.testing.assert_array_equal(same.rotor_speed, moving.rotor_speed)


def test_without_a_mean_wind_starts_are_those_of_calm_air():
    calm = helpers.begun("landing", 6).engine
    for weather in ("calm", Weather(gust_speed=4.0)):
        same = helpers.begun("landing", 6, weather=weather, aerodynamics="none").engine
        np.testing.assert_array_equal(same.qpos, calm.qpos)
        np.testing.assert_array_equal(same.act, calm.act)


def test_wind_that_no_rotor_holds_is_said_with_its_speed():
    moderate = Scenario.of("hover", weather="moderate")
    assert moderate.mean_wind == pytest.approx(15.4 * 0.8583, rel=1e-3)  # ln(3.048 / z0) / 4.893
    with pytest.warns(QuadrlWarning, match="mean wind of 13.2 m/s .* 11 m/s at most"):
        warn_of_unreached(moderate.aircraft, "none", "rotor", moderate.mean_wind)
    light = Scenario.of("hover", weather=WEATHERS["light"])
    warn_of_unreached(light.aircraft, "none", "rotor", light.mean_wind)
    assert Environment(moderate).has_begun is False
