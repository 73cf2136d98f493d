"""Scenarios: what is asked for becomes one record, goes through JSON, and flies as it should."""

import dataclasses
import json
import pickle

import pytest
from helpers import refused

import quadrl
from quadrl import tasks
from quadrl.aircraft.aerodynamics import Aerodynamics
from quadrl.aircraft.presets import REAL_AIR, VEHICLES, in_real_air, with_effects
from quadrl.aircraft.rotors import Rotor
from quadrl.base.errors import QuadrlWarning, UnknownKeyword
from quadrl.conditions.weather import Weather
from quadrl.core.environment import Environment
from quadrl.core.record import warn_of_changes
from quadrl.core.scenario import FIELDS, KEYWORDS, Scenario
from quadrl.evaluation import robustness
from quadrl.evaluation.disturbances import disturbed
from quadrl.evaluation.evaluate import beside, setting
from quadrl.evaluation.policy import Policy
from quadrl.learning.config import TrainConfig
from quadrl.tasks import RandomWaypoint

EVERYTHING = {
    "task_options": {"farthest": 3.0},
    "vehicle": "crazyflie",
    "vehicle_options": {"mass": 0.03},
    "aerodynamics": "full",
    "weather": "light",
    "randomization": {"mass": (0.9, 1.1), "noise": {"position": 0.01}},
    "events": {"battery": {"charge": 0.9}},
    "observe": {"action_history": 2},
    "control_mode": "velocity",
    "engine": "free_flight",
}
"""A value that differs from the default for every field."""
MINE = quadrl.Vehicle(name="mine", mass=0.7, aerodynamics=Aerodynamics.full())
WIDE = tuple(dataclasses.replace(rotor, disc_radius=0.2) for rotor in MINE.rotors)


def whole() -> Scenario:
    return Scenario.of("random_waypoint", **EVERYTHING)


def test_every_field_has_its_keyword_and_a_value_here():
    fields = {field.name for field in FIELDS}
    assert fields <= {*KEYWORDS}
    assert fields - {"task"} == {*EVERYTHING} - {"task_options", "vehicle_options"}
    assert fields <= {*TrainConfig().named()}
    plain, other = Scenario.of("hover"), whole()
    assert all(getattr(plain, name) != getattr(other, name) for name in fields)


@pytest.mark.parametrize(
    "scenario",
    [
        Scenario.of("hover"),
        whole(),
        Scenario.of("landing", vehicle=MINE, control_timestep=0.02, max_episode_steps=50),
        Scenario.of("hover", vehicle="hexa", control_timestep=0.01),
        Scenario.of("hover", aerodynamics=Aerodynamics(inflow=True, blade_lift=0.9)),
    ],
    ids=["plain", "everything", "an aircraft of one's own", "another step", "air of one's own"],
)
def test_json_gives_back_the_same_scenario(scenario):
    written = json.loads(json.dumps(scenario.to_json(), allow_nan=False))
    again = Scenario.of(written)
    assert again == scenario and again.aircraft == scenario.aircraft
    assert Scenario.of(scenario) is scenario
    assert pickle.loads(pickle.dumps(scenario)) == scenario


def test_all_of_it_is_written_and_what_is_not_as_it_is_named():
    written = json.loads(json.dumps(whole().to_json()))
    assert written["changed"] == {"task": ["farthest"], "vehicle": ["mass"]}
    for name, record in (("task_options", whole().task), ("vehicle", whole().vehicle),
                         ("weather", whole().weather)):  # fmt: skip
        assert set(written[name]) == {field.name for field in dataclasses.fields(record)}
    assert written["vehicle"]["mass"] == 0.03 and written["task_options"]["farthest"] == 3.0
    assert len(written["vehicle"]["rotors"][0]) == len(dataclasses.fields(Rotor))


def test_a_record_is_flown_with_its_own_numbers_whatever_its_names_mean_today(monkeypatch):
    given = whole()
    record, (air, share) = json.loads(json.dumps(given.to_json())), REAL_AIR["crazyflie"]
    rotors = [dataclasses.replace(r, lag_up=15.0) for r in VEHICLES["crazyflie"].rotors]
    other = dataclasses.replace(VEHICLES["crazyflie"], rotors=rotors, mass=0.035, dead_time=0.0)
    monkeypatch.setitem(VEHICLES, "crazyflie", other)
    assert Scenario.of(record) == given and Scenario.of(record).aircraft == given.aircraft
    said = r"crazyflie of this policy has rotors\[0\].lag_up = 20.4.*\(and 2 more\).*is now 15.0, "
    with pytest.warns(QuadrlWarning, match=said) as caught:
        warn_of_changes(record, Scenario.of(record), "policy")
    assert len(caught) == 1 and "mass" not in str(caught[0].message)  # that was its own
    now = dataclasses.replace(air, rotor_drag=1e-9), share / 2
    monkeypatch.setitem(REAL_AIR, "crazyflie", now)
    assert Scenario.of(record).aircraft == given.aircraft
    monkeypatch.setitem(VEHICLES, "crazyflie", given.vehicle)
    with pytest.warns(QuadrlWarning, match="drag_coefficient = .*aerodynamics.rotor_drag = "):
        warn_of_changes(record, Scenario.of(record), "policy")
    monkeypatch.delitem(VEHICLES, "crazyflie")
    assert Scenario.of(record).aircraft == given.aircraft
    changed = Scenario.of(record, vehicle_options={"mass": 0.04}, task_options={"farthest": 2})
    assert changed.vehicle.mass == 0.04 and changed.task.farthest == 2
    assert changed.vehicle.rotors == given.vehicle.rotors


DROPPED = {"vehicle": "dead_time", "task_options": "smoothness_weight", "weather": "gust_time",
           "randomization": "corners", "observe": "privileged"}  # fmt: skip


@pytest.mark.parametrize("name", [*DROPPED, "aerodynamics", "rotor"])
def test_what_a_record_lacks_has_its_default_and_what_is_unknown_is_refused(name):
    given = Scenario.of("hover", aerodynamics=in_real_air(VEHICLES["paper"]).aerodynamics)
    record = json.loads(json.dumps(given.to_json()))
    part = record["vehicle"]["rotors"][0] if name == "rotor" else record[name]
    del part[{"aerodynamics": "body_lift", "rotor": "axis"}.get(name) or DROPPED[name]]
    assert Scenario.of(record) == given
    part["of_tomorrow"] = 1.0
    with refused(match="of_tomorrow"):
        Scenario.of(record)


def test_what_the_record_of_an_aircraft_lacks_is_not_taken_from_that_of_its_name_today():
    record = Scenario.of("hover", vehicle="crazyflie").to_json()
    assert record["vehicle"].pop("dead_time") == 0.01
    assert Scenario.of(record).vehicle.dead_time == 0.0


def test_it_is_the_same_environment_however_it_is_asked_for():
    by_keywords = Environment("random_waypoint", **EVERYTHING)
    given = Environment(Scenario.of(whole().to_json()))
    assert given.scenario == by_keywords.scenario == whole()


def test_what_another_aircraft_or_task_leaves_of_a_scenario():
    base = whole()
    # The name that is there already keeps its options.
    same = Scenario.of(base, task="random_waypoint", vehicle="crazyflie", weather=None)
    assert same == base
    # Another name flies in the air that was asked for; a Vehicle brings its own.
    racer = Scenario.of(base, vehicle="racer")
    assert racer.aircraft == in_real_air(VEHICLES["racer"])
    assert Scenario.of(base, vehicle=MINE).aircraft == MINE
    assert Scenario.of(base, vehicle=VEHICLES["crazyflie"]).aircraft.mass == 0.0293
    assert Scenario.of(base, task="hover").task == quadrl.tasks.make("hover")
    assert Scenario.of(base, task=RandomWaypoint()).task.farthest != 3.0
    # Options go on top of what is there, whoever gives them.
    lower = Scenario.of(base, altitude=2.0, task_options={"time_limit": 4.0})
    assert (lower.task.altitude, lower.task.time_limit, lower.task.farthest) == (2.0, 4.0, 3.0)  # type: ignore[attr-defined]
    # Without the air the quadratic drag is whole again.
    calm = Scenario.of(base, aerodynamics="none").aircraft
    assert calm.drag_coefficient == VEHICLES["crazyflie"].drag_coefficient


def test_wind_blows_in_real_air_unless_something_else_is_asked_for():
    for weather in ("light", {"gust_speed": 1.0}):
        windy = Scenario.of("hover", vehicle="racer", weather=weather)
        assert windy.aircraft == in_real_air(VEHICLES["racer"])
    assert Scenario.of("hover", vehicle=MINE, weather="light").aircraft == MINE
    for asked in ("none", "rotor_drag"):
        given = Scenario.of("hover", weather="light", aerodynamics=asked)
        assert given.aircraft == with_effects(VEHICLES["paper"], asked)
        assert Scenario.of(given.to_json()) == given
    calm = dataclasses.replace(Scenario.of("hover"), weather=Weather(roughness=0.1))
    assert calm.aircraft == VEHICLES["paper"] and "aerodynamics" not in calm.to_json()
    assert Environment("hover", weather="light").vehicle == in_real_air(VEHICLES["paper"])


@pytest.mark.parametrize(
    ("vehicle", "why"),
    [
        (quadrl.Vehicle(name="mine"), "quadrl knows the full set of paper"),
        (quadrl.Vehicle(rotors=WIDE), "not those of the aircraft"),
        ({"name": "crazyflie", "mass": 1e-3}, "physics_timestep"),
    ],
    ids=["unknown", "other rotors", "too light for the step"],
)
def test_an_aircraft_without_numbers_for_real_air_is_told_so_in_wind(vehicle, why):
    with refused("aerodynamics", lists="'none'", match=why):
        Scenario.of("hover", vehicle=vehicle, weather="light")
    Scenario.of("hover", vehicle=vehicle, weather="light", aerodynamics="none")
    Scenario.of("hover", vehicle=vehicle)


def test_wind_that_acts_by_drag_alone_goes_on_doing_so_with_an_aircraft_without_effects():
    before = Scenario.of("hover", weather="light", aerodynamics="none")
    assert Scenario.of(before, vehicle=VEHICLES["paper"]) == before
    in_air = in_real_air(VEHICLES["paper"])
    assert Scenario.of(before, vehicle=in_air).aircraft == in_air


def test_all_that_fly_beside_each_other_or_for_a_card_fly_in_the_same_air():
    robust = "hover_robust"  # was trained in wind, with every effect of the air
    for flown, effects in ((robust, "hover"), 2), (("hover", robust), 0):
        together = [scenario for _, scenario in beside(flown, weather=None)]
        assert [one.aircraft.aerodynamics.effects for one in together] == [2, 2]
        card = robustness._flown(flown, None).values()
        gusty = [disturbed(one, Weather(gust_speed=4.0)) for _, one in card]
        assert {one.aerodynamics for one in gusty} == {"full"}
        assert [one.aircraft.aerodynamics.effects for _, one in card] == [effects] * 2
        drag = robustness._flown(flown, None, aerodynamics="none").values()
        gusty = [disturbed(one, Weather(gust_speed=4.0)) for _, one in drag]
        assert {one.aerodynamics for one in gusty} == {"none"}


@pytest.mark.parametrize(
    ("given", "vehicle", "scale"),
    [({}, "crazyflie", 540.0), ({"vehicle": "racer"}, "racer", VEHICLES["racer"].action_scale)],
)
def test_a_controller_flies_the_aircraft_that_the_task_is_trained_on(given, vehicle, scale):
    for task in ("trajectory", tasks.make("trajectory")):
        scenario = setting("geometric", task, **given)[2]
        assert (scenario.vehicle.name, scenario.vehicle.action_scale) == (vehicle, scale)
    plain = Scenario.of("trajectory")
    assert setting("geometric", plain)[2] is plain


def test_timing_is_the_aircrafts_and_the_tasks():
    scenario = Scenario.of("hover", control_timestep=0.02, max_episode_steps=30)
    assert scenario.aircraft.control_timestep == 0.02
    assert scenario.task.time_limit == pytest.approx(0.6)
    assert Environment(scenario).time_limit_steps == 30


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("vehicle", 3),
        ("weather", "windy"),
        ("randomization", "heavy"),
        ("observe", "all"),
        ("aerodynamics", "thick"),
        ("max_episode_steps", 0),
    ],
)
def test_what_cannot_be_is_refused_by_its_name(name, value):
    with refused(name, value):
        Scenario.of("hover", **{name: value})


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"wether": "light"}, "hover option"),
        ({"vehicle": {"weight": 1.0}}, "field of vehicle"),
        ({"randomization": {"mas": (0.9, 1.1)}}, "field of randomization"),
        ({"observe": {"rotor_speeds": "none"}}, "option of observe"),
        ({"aerodynamics": {"lift": 1.0}}, "field of aerodynamics"),
        ({"vehicle_options": {"rotors": ()}}, "vehicle option"),
    ],
)
def test_an_unknown_name_is_refused_with_the_choices(given, name):
    with pytest.raises(UnknownKeyword) as caught:
        Scenario.of("hover", ["num_envs"], **given)
    assert caught.value.name == name
    assert (caught.value.reason != "") == (name == "hover option")  # those may be tried
    if name == "hover option":
        assert "weather" in caught.value.allowed and "num_envs" in caught.value.allowed
        with pytest.raises(UnknownKeyword) as caught:  # those of the task alone
            Scenario.of("hover", ["num_envs"], task_options=given)
        assert "weather" not in caught.value.allowed and "num_envs" not in caught.value.allowed


def test_its_model_is_that_of_the_aircraft_in_the_world_of_the_task():
    scenario = Scenario.of("landing", vehicle="hexa")
    for model in (scenario.compile_model(), scenario.compile_model(drawn=False)):
        assert model.nu == 6 and model.geom("ground").contype[0] == 1
    assert Scenario.of("hover").compile_model().geom("ground").contype[0] == 0
    assert scenario.altitude >= scenario.aircraft.ground_clearance


def test_a_policy_and_a_training_carry_it():
    config = TrainConfig("hover", variant="robust", vehicle="hexa", aerodynamics="full")
    flown, asked = config.training_scenario, config.scenario
    assert (flown.engine, asked.engine) == ("free_flight", "mujoco")
    assert flown.observe.privileged and not asked.observe.privileged  # that is the critic's
    assert dataclasses.replace(flown, engine="mujoco", observe=asked.observe) == asked
    policy = Policy.pretrained("hover", variant="robust")
    assert policy.scenario.weather == Weather(wind_speed=7.72)
    assert policy.scenario.aircraft.action_scale == 90.0
    assert policy.scenario.task.smoothness_weight == 10.0


def test_wind_that_no_step_of_the_aircraft_resolves_is_refused():
    # 2 k_D v dt / m = 1 at 0.001 / (2 * 5e-3 * 0.005) = 20 m/s for a Crazyflie of 1 g.
    given = {"vehicle": "crazyflie", "vehicle_options": {"mass": 1e-3}, "aerodynamics": "none"}
    for weather in ("severe", {"wind_speed": 15.0, "gust_speed": 5.1}):
        with refused("weather", match="20 m/s"):
            Scenario.of("hover", weather=weather, **given)
    with refused(match="20 m/s"):  # twice the mean wind may be drawn
        Scenario.of("hover", weather={"wind_speed": 11.0}, randomization={"wind": (0, 2)}, **given)
    assert Scenario.of("hover", weather={"wind_speed": 19.9}, **given).aircraft.mass == 1e-3
