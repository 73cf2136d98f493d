"""Events in flight: what they do to an aircraft, in both engines, and when."""

import copy
import dataclasses
import math
import pickle

import helpers
import numpy as np
import pytest

from quadrl.aircraft.presets import VEHICLES
from quadrl.base.rotation import namespace
from quadrl.conditions.event import EVENTS, SPEED_LIMIT, Event, register_event
from quadrl.core.environment import Environment
from quadrl.core.scenario import UNDISTURBED, Scenario
from quadrl.engines.engine import ENGINES

PAPER = VEHICLES["paper"]
HOVER = np.zeros((1, 4))  # of actions
ALL = {
    "battery": {"charge": (0.5, 1.0)},
    "rotor_failure": {"at": (0.3, 2.0), "chance": 0.5},
    "rotor_damage": {},
    "payload": {"mass": (0.05, 0.2)},
    "gust_front": {"speed": (1.0, 4.0)},
}
STEP = PAPER.control_timestep
HOVERING, FASTEST = PAPER.hover_speed[0], PAPER.max_speed[0]  # of a rotor [rad/s]


def flown(events, steps, action=HOVER, count=1, **conditions):
    """An environment after some control steps."""
    environment = helpers.begun("hover", count, events=events, **conditions)
    for _ in range(steps):
        environment.step(np.broadcast_to(action, (count, environment.action_size)))
    return environment


@pytest.mark.parametrize("engine", ENGINES)
def test_a_dropped_payload_lets_the_aircraft_rise(engine):
    # The rotors hold the weight of the aircraft alone, so with a payload of a fifth of it the
    # acceleration is -g (1 - 1 / 1.2) before the drop, and 0 after it.
    at = {"position": np.zeros(3), "velocity": np.zeros(3)}
    level = {"quaternion": np.array([1.0, 0.0, 0.0, 0.0]), "body_rate": np.zeros(3)}
    events = {"payload": {"mass": 0.2, "at": 4 * STEP}}
    task = {"altitude": 20.0, "vehicle": "paper", "vehicle_options": {"drag_coefficient": 0.0}}
    environment = Environment("hover", seed=0, engine=engine, events=events, **task)
    environment.reset(start=at | level)
    speeds = [0.0]
    for _ in range(8):
        environment.step(HOVER)
        speeds.append(float(environment.engine.qvel[0, 2]))
    sinking, hanging = np.split(np.diff(speeds) / STEP, 2)
    np.testing.assert_allclose(sinking, -9.81 * (1 - 1 / 1.2), rtol=1e-6)
    np.testing.assert_allclose(hanging, 0.0, atol=1e-6)
    mass = environment.engine.parameters["mass"][0]
    assert mass == PAPER.mass and environment.engine.model.body_mass[1] == mass


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("mode", ["rotor", "thrust_body_rate"])
def test_the_rotor_of_a_failed_motor_runs_out(engine, mode):
    events = {"rotor_failure": {"rotor": 2, "at": 5 * STEP}}
    environment = helpers.begun("hover", 2, events=events, engine=engine, control_mode=mode)
    for step in range(9):
        if step == 5:
            before = environment.engine.act[:, 1].copy()
            assert (before > 0.5 * HOVERING).all()
        environment.step(np.zeros((2, 4)))
    # It slows by its lag: exp(-lag t) of its speed is left after t.
    left = math.exp(-PAPER.rotors[1].lag_down * 4 * STEP)
    np.testing.assert_allclose(environment.engine.act[:, 1], left * before, rtol=1e-5)
    assert (environment.engine.act[:, 0] > 0.5 * HOVERING).all() or mode != "rotor"


def test_a_failure_may_leave_a_share_and_strikes_each_rotor():
    events = {"rotor_failure": {"left": 0.4, "at": 0.0}}
    environment = flown(events, 1, count=400)
    struck = environment.engine.ceiling < FASTEST
    np.testing.assert_array_equal(struck.sum(axis=1), 1)
    assert (struck.sum(axis=0) > 60).all()  # of 100 on average
    np.testing.assert_allclose(environment.engine.ceiling[struck], 0.4 * FASTEST)


def test_a_damaged_rotor_has_less_thrust_and_torque_from_its_time_on():
    events = {"rotor_damage": {"rotor": 3, "left": 0.8, "at": 2 * STEP}}
    environment = helpers.begun("hover", 3, events=events)
    for step in range(4):
        environment.step(np.zeros((3, 4)))
        rotor = environment.engine.parameters["rotor"][:, :4]
        for name in ("thrust_coefficient", "torque_coefficient"):
            whole = getattr(PAPER.rotors[2], name)
            np.testing.assert_array_equal(rotor[name][:, 2], whole * (0.8 if step >= 2 else 1.0))
            assert (rotor[name][:, [0, 1, 3]] == whole).all()
    # And it has to turn faster to hover, as its number says.
    np.testing.assert_allclose(
        rotor["hover_speed"][0, 2] / rotor["hover_speed"][0, 0], 0.8**-0.5, rtol=1e-6
    )


def test_a_battery_lasts_as_long_as_it_should_and_its_speeds_sag():
    battery = {"charge": 1.0, "endurance": 4.0, "sag": 0.2, "drop": 0.05}
    conditions = {"altitude": 100.0, "time_limit": 20.0, "aerodynamics": "none"}
    environment = helpers.begun("hover", 1, events={"battery": battery}, **conditions)
    environment.reset(start={"rotor_speed": np.full(4, HOVERING)})
    limits = []
    for _ in range(round(4.2 / STEP)):
        environment.step(HOVER)
        limits.append(environment.engine.ceiling[0, 0] / FASTEST)
    full, half, last = limits[0], limits[round(2.0 / STEP)], limits[round(3.9 / STEP)]
    # Hover draws the current of hover: the charge falls evenly, and the drop is all of it.
    assert full == pytest.approx(1 - 0.05, abs=1e-6)
    assert half == pytest.approx(1 - 0.05 - 0.2 * 0.5, abs=2e-3)
    assert last == pytest.approx(1 - 0.05 - 0.2 * 0.975, abs=2e-3)
    assert limits[-1] == 0.0 and environment.events.told(0) == "battery 0 %"


def test_a_gust_front_rises_and_stays():
    front = {"speed": 6.0, "direction": math.pi / 2, "rise": 0.2, "at": 0.1}
    environment, winds = helpers.begun("hover", 2, events={"gust_front": front}), []
    assert environment.vehicle.aerodynamics.effects  # as any wind brings them
    for _ in range(10):
        environment.step(np.zeros((2, 4)))
        winds.append(environment.engine.wind.copy())
    north = np.array(winds)[:, :, 1]
    np.testing.assert_allclose(north[[2, 4, 6, 9], 0], [0.0, 3.0, 6.0, 6.0], atol=1e-9)
    assert not np.array(winds)[:, :, [0, 2]].round(12).any()


def test_a_gust_front_adds_to_the_weather():
    front = {"speed": 3.0, "direction": 0.0, "at": 0.0, "rise": STEP}
    plain, windy = (
        flown(events, 2, weather="light", aerodynamics="none", count=3).engine.wind
        for events in ({}, {"gust_front": front})
    )
    assert plain.any(axis=1).all()
    # In the second step it has risen; until then the aircraft have moved by no more than this.
    np.testing.assert_allclose(windy - plain, [[3.0, 0.0, 0.0]] * 3, atol=0.02)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("drawn", [False, True])
def test_a_row_is_the_single_aircraft_of_its_seed(engine, drawn):
    conditions = {"events": ALL, "engine": engine, "observe": {"privileged": True}}
    if drawn:
        conditions |= {"randomization": {"mass": (0.95, 1.05), "drag": (0.9, 1.1)}}
    actions = helpers.random_actions(60, 3)
    expected = helpers.fly(helpers.begun("hover", 3, seed=5, **conditions), actions)
    assert any(name.startswith("fresh.") for record in expected for name in record)
    for row in range(3):
        single = helpers.begun("hover", 1, seed=5 + row, **conditions)
        chosen = slice(row, row + 1)
        helpers.assert_records(helpers.fly(single, actions[:, chosen]), expected, chosen)


@pytest.mark.parametrize("engine", ENGINES)
def test_it_goes_on_bit_for_bit_from_the_middle_of_events(engine):
    actions = helpers.random_actions(80, 3, seed=2)
    environment = helpers.begun("hover", 3, events=ALL, engine=engine)
    for action in actions[:40]:
        environment.step(action)
    other = Environment("hover", num_envs=3, events=ALL, engine=engine)
    other.restore(environment.save())
    others = [other, copy.deepcopy(environment), pickle.loads(pickle.dumps(environment))]
    assert (environment.engine.parameters["rotor"] != environment.engine.begun["rotor"]).any()
    expected = helpers.fly(environment, actions[40:])
    for each in others:
        helpers.assert_records(helpers.fly(each, actions[40:]), expected)


def test_what_is_over_with_an_episode_does_not_last():
    environment = flown({"rotor_damage": {"at": 0.0, "chance": 0.5}}, 1, count=64)
    whole = environment.engine.begun["rotor"]["thrust_coefficient"]
    struck = (environment.engine.parameters["rotor"]["thrust_coefficient"] < whole).any(axis=1)
    assert 16 < struck.sum() < 48
    environment.reset(np.flatnonzero(struck))
    environment.step(np.zeros((64, 4)))
    again = (environment.engine.parameters["rotor"]["thrust_coefficient"] < whole).any(axis=1)
    assert 0 < again[struck].sum() < struck.sum() and not again[~struck].any()


def test_the_critic_sees_what_events_do():
    plain = flown({}, 3, observe={"privileged": True})
    events = {"payload": {"mass": 0.25, "at": 5.0}, "rotor_failure": {"rotor": 1, "at": 0.0}}
    environment = flown(events, 3, observe={"privileged": True})
    added = environment.privileged.shape[1] - plain.privileged.shape[1]
    assert added == 1 + 4
    seen = environment.privileged[0, -3 - added : -3]
    np.testing.assert_allclose(seen, [0.25, -1.0, 0.0, 0.0, 0.0])
    assert environment.events.told(0) == "with payload, rotor 1 fails"


def test_the_controls_of_a_task_are_what_was_wanted():
    events = {"rotor_failure": {"rotor": 1, "at": 0.0}}
    environment = flown(events, 3)
    np.testing.assert_array_equal(environment.snapshot.rotor_command, HOVERING)
    assert environment.engine.ctrl[0, 0] == 0.0


@pytest.fixture
def heating():
    """An event of one's own, which cannot be compiled: motors lose speed as they get warm."""

    @register_event
    class Heating(Event):
        name, changes = "heating", (SPEED_LIMIT,)
        rate: float = 0.5

        def draw(self, rng, time_limit):
            return {"warmth": rng.uniform(0.0, 0.1)}

        def update(self, now):
            warm = [float(w) for w in now.memory["warmth"]]  # of numbers alone
            return {"warmth": namespace(now.time).asarray(warm) + self.rate * now.timestep}

        def effect(self, now):
            return ((1.0 - now.memory["warmth"])[:, None],)

        def told(self, now):
            return f"{now.memory['warmth'][0]:.2f}"

    yield Heating
    del EVENTS["heating"]


def test_an_event_of_ones_own_flies_by_its_name(heating):
    environment = flown({"heating": {"rate": 0.4}}, 4, count=2)
    warmth = 1 - environment.engine.ceiling[:, 0] / FASTEST
    first = warmth - 0.4 * 3 * STEP
    assert ((first > 0) & (first < 0.1)).all() and first[0] != first[1]
    twin = copy.deepcopy(environment)
    for each in (environment, twin):
        each.step(np.zeros((2, 4)))
    np.testing.assert_array_equal(environment.engine.ceiling, twin.engine.ceiling)


def test_compiled_events_give_what_the_functions_give(heating):
    """The one that cannot be compiled makes NumPy run the others, too."""
    actions = helpers.random_actions(60, 4, seed=4)
    compiled = helpers.begun("hover", 4, events=ALL)
    written = helpers.begun("hover", 4, events=ALL | {"heating": {"rate": 0.0}})
    for action in actions:
        written.events._table[:, written.events._remembered.index("heating.warmth")] = 0.0
        for each in (compiled, written):
            each.step(action)
        np.testing.assert_allclose(compiled.engine.ceiling, written.engine.ceiling, rtol=1e-13)
        np.testing.assert_allclose(compiled.engine.qpos, written.engine.qpos, atol=1e-9)


@pytest.mark.parametrize(
    ("events", "name", "lists"),
    [
        ({"batery": {}}, "event", "battery"),
        ({"battery": {"charg": 1}}, "option of battery", "charge"),
        ({"battery": 3}, "event battery", "mapping"),
        (3, "events", "list of names"),
        ({"battery": {"charge": (0.5, 2)}}, "battery charge[1]", ""),
        ({"battery": {"charge": (0.9, 0.5)}}, "battery charge", "lowest"),
        ({"rotor_failure": {"at": 11.0}}, "rotor_failure at", "time limit"),
        ({"rotor_failure": {"at": -1.0}}, "rotor_failure at", ""),
        ({"rotor_failure": {"rotor": 5}}, "rotor_failure rotor", "4"),
        ({"rotor_damage": {"left": 0.0}}, "rotor_damage left", ""),
        ({"payload": {"mass": 3.0}}, "events", "hover"),
        ({"battery": {"charge": 0.1, "sag": 0.6}}, "events", "hover"),
        ({"gust_front": {"speed": 150.0}}, "gust_front speed", "100"),
        ({"payload": {"chance": 2}}, "payload chance", ""),
    ],
)
def test_what_cannot_happen_is_refused(events, name, lists):
    with helpers.refused(name) as caught:
        Environment("hover", events=events)
    assert lists in str(caught.value)


def test_a_scenario_keeps_its_events():
    given = Scenario.of("hover", events=["battery", "payload"])
    again = Scenario.of(given.to_json())
    assert again == given and again.events["battery"] == EVENTS["battery"]()
    changed = Scenario.of(given, events={"payload": {"at": [1, 2]}})
    assert [*changed.events] == ["payload"]
    assert changed.events["payload"].at == (1, 2)
    assert Scenario.of("hover", events="battery").events == {"battery": given.events["battery"]}
    assert dataclasses.replace(given, events=None).events == {}
    assert Scenario.of(given, **UNDISTURBED).events == {}
