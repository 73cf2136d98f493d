"""Trim: in wind, a start at rest and level becomes one whose forces balance; others stay."""

import dataclasses
import math

import helpers
import numpy as np
import pytest
import reference
from scipy.linalg import null_space
from scipy.optimize import root

import quadrl
from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.presets import VEHICLES, in_real_air
from quadrl.aircraft.specification import resolve
from quadrl.base.errors import QuadrlWarning
from quadrl.base.rotation import heading_of, norm
from quadrl.conditions.sampler import Drawn
from quadrl.conditions.weather import WEATHERS, Weather
from quadrl.control import trim
from quadrl.control.feasibility import Reach, held_wind, lift_on_feet, warn_of_unreached
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
    mean = blowing.mean_wind(*place, engine.qpos[:, 2], Drawn())
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
    with pytest.warns(
        QuadrlWarning,
        match="mean wind of 13.2 m/s .* 1 holds it in 11.3 m/s at most, .* limits in 12.7 m/s",
    ):
        warn_of_unreached(moderate.aircraft, "none", "rotor", moderate.mean_wind)
    light = Scenario.of("hover", weather=WEATHERS["light"])
    warn_of_unreached(light.aircraft, "none", "rotor", light.mean_wind)
    assert Environment(moderate).has_begun is False


def test_wind_that_no_rotor_holds_trims_nobody():
    vehicle = in_real_air(VEHICLES["paper"])
    ends = (0.0,) * 4, tuple(vehicle.max_speed)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    still, hover = np.zeros((2, 3)), np.tile(vehicle.hover_speed, (2, 1))
    start = Start(still, level, still, still, hover)
    wind = trim.held_wind(vehicle, *ends) + np.array([[-0.7, 0.0], [0.7, 0.0]])
    wind[:, 1] = 0.0
    tilted = trim.trimmed(vehicle, start, wind).quaternion[:, 0] < 1
    assert tilted.tolist() == [True, False]


def balance(vehicle, wind):
    """Rotor speeds (R,) [rad/s] with which it keeps its place in wind (3,), by other equations."""
    free = null_space(vehicle.mixer)  # with more than four rotors many speeds give a wrench

    def lacking(unknown, wind):
        angle = max(np.hypot(*unknown[:2]), 1e-12)  # [rad], of the tilt towards x and y
        speed = vehicle.hover_speed * np.sqrt(np.maximum(unknown[2:], 0))
        turn = np.sin(angle / 2) / angle * np.array([-unknown[1], unknown[0], 0.0])
        level = [*(0, 0, 1e3), np.cos(angle / 2), *-turn, *np.zeros(6)]
        state = np.array([[*level, *speed]])
        rate = reference.derivative(state, vehicle, state[:, 13:], wind)[0]
        square = unknown[2:] * vehicle.hover_speed**2 / vehicle.hover_speed[0] ** 2
        return [*rate[7:10], *0.01 * rate[10:13], *(square - np.mean(square)) @ free]

    unknown = [0.0, 0.0, *np.ones(vehicle.rotor_count)]
    for share in (0.6, 0.85, 1.0):  # from calm air up to this wind
        found = root(lacking, unknown, (share * wind,), tol=1e-9)
        assert found.success
        unknown = found.x
    return vehicle.hover_speed * np.sqrt(unknown[2:])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "end", "worst"),
    [("paper", "action 1", 0), ("crazyflie_brushless", "limits", 4), ("racer", "limits", 0)],
)
def test_the_wind_that_is_held_takes_all_that_actions_and_rotors_give(name, end, worst):
    vehicle = in_real_air(VEHICLES[name])
    scale = vehicle.action_scale if end == "action 1" else Reach(vehicle).most
    low, high = (speed[0] for speed in Reach(vehicle).speeds(scale))

    def used(wind):
        """How much of the room of the worst rotor the worst bearing takes; 1 is all."""
        bearings = math.tau / 32 * np.arange(worst, 32, 8)
        most = 0.0
        for angle in bearings:
            speed = balance(vehicle, wind * np.array([np.cos(angle), np.sin(angle), 0.0]))
            middle, room = (high**2 + low**2) / 2, (high**2 - low**2) / 2
            most = max(most, (abs(speed**2 - middle) / room).max())
        return most

    held = held_wind(vehicle, scale)
    assert used(0.98 * held) < 1 < used(1.02 * held)
    rows = {row.quantity: row for row in quadrl.check(vehicle).rows}
    assert rows[f"steady wind held, {end}"].value == held


def test_check_marks_wind_that_actions_do_not_hold():
    name = "steady wind held, action 1"
    for weather, verdict in (("light", "ok"), ("moderate", "the mean wind is 13.2 m/s")):
        rows = {row.quantity: row for row in quadrl.check(weather=weather).rows}
        assert rows[name].verdict == verdict


# ------------------------------------------------------------------------ landing in real air


def test_an_aircraft_that_the_ground_holds_up_is_told_the_scale_that_lands():
    """Of 1.10 times the weight, at 190.7 of 225.7 rad/s."""
    flown = Scenario.of("landing", weather={"wind_speed": 0.5})
    lift = lift_on_feet(flown.aircraft, 35.0)
    assert lift == pytest.approx(1.10, abs=0.01)
    given = flown.aircraft, "none", "rotor", 0.0
    with pytest.warns(QuadrlWarning, match="lifts 1.10 times .* action_scale=54 or more"):
        warn_of_unreached(*given, lands=flown.lands)
    with pytest.warns(QuadrlWarning, match="lifts 1.10"):
        quadrl.evaluate("geometric", flown, episodes=1)
    warn_of_unreached(*given, lands=Scenario.of("hover").lands)  # it flies on
    warn_of_unreached(resolve(flown.aircraft, {"action_scale": 54}), "none", lands=True)
    warn_of_unreached(Scenario.of("landing").aircraft, "none", lands=True)  # in still air
    rows = {row.quantity: row for row in quadrl.check(task="landing", weather="light").rows}
    assert rows["lift on the ground, action -1"].value == lift
    assert "action_scale=54" in rows["lift on the ground, action -1"].verdict


def test_with_the_scale_that_is_suggested_it_lands():
    flown = {"weather": {"wind_speed": 0.5}, "vehicle_options": {"action_scale": 54}}
    found = quadrl.evaluate("geometric", "landing", episodes=20, seed=5, **flown)
    assert found.metrics["success_rate"] >= 0.95
