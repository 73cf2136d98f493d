"""The robustness card: its statistics, what its levels and its maps fly, its files."""

import dataclasses
import functools
import json
import sys
from typing import Any

import numpy as np
import pytest
from helpers import refused
from scipy.stats import binomtest

import quadrl
from quadrl import Randomization
from quadrl.aircraft.parameters import rows
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlWarning
from quadrl.cli import main
from quadrl.conditions.sampler import DAMAGED, AircraftSampler
from quadrl.conditions.weather import Weather
from quadrl.core.environment import Environment
from quadrl.core.record import import_own
from quadrl.core.scenario import Scenario
from quadrl.evaluation import disturbances
from quadrl.evaluation import robustness as disturbed
from quadrl.evaluation.cache import FILE, digest
from quadrl.evaluation.card import Card, half_level, wilson
from quadrl.evaluation.recovery import MAPS, begin
from quadrl.evaluation.rollout import flights

SHORT: Any = dict(episodes=4, progress=False, time_limit=0.5)


@pytest.fixture(scope="module")
def card():
    flown = {"a": "hover", "again": "hover", "geometric": "geometric"}
    return quadrl.robustness(flown, disturbances=("mass", "gust"), **SHORT)


def test_intervals_are_wilsons():
    for successes in (0, 1, 17, 49, 50):
        exact = binomtest(successes, 50).proportion_ci(method="wilson")
        np.testing.assert_allclose(wilson(successes, 50), exact, rtol=1e-9, atol=1e-12)


def test_half_of_the_flights_fail_where_the_line_crosses():
    assert half_level((0, 1, 2, 4), (1.0, 0.9, 0.7, 0.2)) == pytest.approx(2 + 2 * 0.2 / 0.5)
    assert half_level((1.0, 0.9, 0.8), (1.0, 0.75, 0.25)) == pytest.approx(0.85)
    assert half_level((0, 1), (1.0, 0.5)) is None
    assert half_level((3, 4), (0.4, 0.9)) == 3
    assert half_level((0, 1, 2), (1.0, 0.8, None)) is None


def test_a_level_disturbs_what_it_says():
    heavy, windy = (
        disturbances.disturbed(Scenario.of("hover"), disturbances.DISTURBANCES[name].at(level))
        for name, level in (("mass", 1.3), ("gust", 8.0))
    )
    assert heavy.weather == Weather() and windy.randomization == Randomization()
    assert windy.weather == Weather(gust_speed=8.0)
    environment = Environment(heavy, num_envs=3, seed=0)
    environment.reset()
    mass = environment.engine.parameters.view(rows(Vehicle()).dtype)["mass"].ravel()
    np.testing.assert_allclose(mass, 1.3 * Vehicle().mass)
    nothing = (Randomization(), Weather())
    for axis in disturbances.DISTURBANCES.values():  # only the usual level disturbs nothing
        assert axis.usual in axis.levels and list(axis.levels) == sorted(set(axis.levels))
        assert [x for x in axis.levels if axis.at(x) in nothing] == [axis.usual], axis.name
    beyond: Any = Scenario.of("hover", randomization={"mass": 5.0})  # no aircraft can fly so
    assert disturbed.measured(beyond, beyond, episodes=2, seed=0) is None


def test_one_rotor_is_weaker_and_it_may_be_any():
    sampler = AircraftSampler(Randomization(one_rotor=(0.8, 0.8)), Vehicle())
    paper = rows(Vehicle())
    shares = np.random.default_rng(0).random((200, len(sampler.names)))
    drawn = sampler.sample(shares)
    table, before = sampler.table(drawn), paper["rotor"]["thrust_coefficient"]
    factor = table["rotor"]["thrust_coefficient"][:, :4] / before[:, :4]
    assert set(np.round(np.sort(factor, axis=1), 9).ravel()) == {0.8, 1.0}
    assert (np.isclose(factor, 0.8).sum(axis=1) == 1).all()
    assert set(np.argmin(factor, axis=1)) == {0, 1, 2, 3}
    damaged = sampler.columns(drawn, DAMAGED, 1)[:, 0]
    np.testing.assert_array_equal(np.argmin(factor, axis=1), damaged)
    with refused("rotors"):
        AircraftSampler(Randomization(one_rotor=(0.01, 0.01)), Vehicle())


def test_all_fly_the_same_episodes(card):
    for axis in card.found["axes"].values():
        assert axis["flown"]["a"] == axis["flown"]["again"] != axis["flown"]["geometric"]
    for chart in card.found["recovery"].values():
        assert chart["flown"]["a"] == chart["flown"]["again"]
    flown = quadrl.evaluate("hover", episodes=4, time_limit=0.5).metrics  # undisturbed
    axis = card.found["axes"]["mass"]
    assert axis["flown"]["a"]["success"][axis["levels"].index(1.0)] == flown["success_rate"]


@pytest.mark.parametrize(
    ("policies", "seen"), [(["hover"], "true"), (["hover", "hover_robust"], "estimated")]
)
def test_a_controller_knows_the_rotor_speeds_as_the_policies_beside_it_do(policies, seen):
    what = {"episodes": 1, "disturbances": [], "recovery": False, "progress": False}
    flown = quadrl.robustness(["geometric", *policies], "hover", **what).found["scenarios"]
    own = Scenario.of(flown.pop("geometric controller")).observe
    assert own.given() == ({} if seen == "true" else {"rotor_speed": seen})
    for name, scenario in flown.items():  # as in their trainings
        assert (
            Scenario.of(scenario).observe.given()
            == quadrl.Policy.pretrained(
                "hover", variant="robust" if "robust" in name else "ideal"
            ).scenario.observe.given()
        )
    if seen == "estimated":  # as the command's comparison does
        beside = quadrl.evaluate("hover_robust", episodes=1).yardstick().scenario.observe
        assert beside.given() == {"rotor_speed": seen}


def test_an_action_means_what_it_meant_in_training():
    usual = quadrl.Policy.pretrained("hover")
    options = {"vehicle_options": {"action_scale": 50.0}}
    wide = dataclasses.replace(usual, metadata=usual.metadata | options)
    found = quadrl.robustness(
        {"usual": usual, "wide": wide},
        episodes=3,
        disturbances=["thrust"],
        recovery=False,
        progress=False,
    ).found["axes"]["thrust"]["flown"]
    for name, policy in (("usual", usual), ("wide", wide)):
        errors = flights(quadrl.evaluate(policy, episodes=3).rollout)["position_error_m"]
        assert found[name]["error_m"][0][1] == pytest.approx(np.median(errors), abs=1e-3)
    assert found["usual"]["error_m"] != found["wide"]["error_m"]


def test_a_card_is_read_as_it_was_written(card, tmp_path):
    paths = card.save(tmp_path / "new" / "card")
    assert all(path.stat().st_size > 0 for path in paths)
    assert {path.suffix for path in paths} == {".json", ".csv", ".png", ".pdf"}
    assert Card.load(tmp_path / "new" / "card").found == card.found == Card.load(paths[0]).found
    lines = (tmp_path / "new" / "card" / "robustness.csv").read_text().splitlines()
    levels = sum(len(axis["levels"]) for axis in card.found["axes"].values())
    assert len(lines) == 1 + 3 * levels
    (tmp_path / "other.json").write_text(json.dumps({"format": "other"}))
    (tmp_path / "list.json").write_text("[1]")
    for name in ("other.json", "list.json", "missing.json"):
        with refused(match=name):
            Card.load(tmp_path / name)
    head, *lines = card.table
    assert head[1:] == ("a", "again", "geometric") and len(lines) == 2 + 2
    assert repr(card).count("\n") == 0 and len(repr(card)) < 200
    page = card._repr_html_()
    assert "<table>" in page and page.count("<img") == 2


@pytest.mark.parametrize("chart", MAPS.values(), ids=lambda chart: chart.name)
@pytest.mark.parametrize("task", ["hover", "random_waypoint"])
def test_maps_start_where_they_say(task, chart):
    environment = Environment(task, num_envs=40, seed=5, engine="free_flight")
    environment.reset()
    own = np.array(environment.snapshot.state.position), environment.goals().copy()
    heading = environment.snapshot.state.rotation[:, :2, 0].copy()
    environment.seed(5)
    x, y = np.linspace(1.0, 5.0, 40), np.linspace(1.0, 6.0, 40)
    begin(environment, chart, x, y, 5)
    state = environment.snapshot.state
    np.testing.assert_allclose(environment.goals(), own[1])
    if chart.name == "falling":
        np.testing.assert_allclose(state.height, y)
        np.testing.assert_allclose(state.velocity, np.stack([0 * x, 0 * x, -x], axis=-1))
        np.testing.assert_allclose(state.position[:, :2], own[0][:, :2])
        return
    np.testing.assert_allclose(np.degrees(np.arccos(state.cos_tilt)), x, rtol=1e-6)
    np.testing.assert_allclose(state.position, own[0])
    length = state.angular_speed if chart.name == "tumbling" else state.speed
    np.testing.assert_allclose(length, y)
    ahead = state.rotation[:, :2, 0]  # a small tilt hardly turns the nose
    cosine = (ahead * heading).sum(-1)
    cosine /= np.linalg.norm(ahead, axis=-1) * np.linalg.norm(heading, axis=-1)
    assert cosine.min() > np.cos(0.1)


def test_what_cannot_be_flown_is_refused(capsys):
    wrong = {"disturbance": {"disturbances": ("mas",)}, "episodes": {"episodes": 0}}
    wrong |= {"seed": {"seed": -1}, "engine": {"engine": "jet"}}
    for name, given in wrong.items():
        with refused(name):
            quadrl.robustness("hover", **SHORT | given)
    with refused("controller"):
        quadrl.robustness([])
    for words in ([], ["--controller", "geometrik"], ["nowhere"]):
        with pytest.raises(SystemExit):
            main(["robustness", *words])
    assert "geometric" in capsys.readouterr().err


# ---------------------------------------------------------------- stopped, and gone on with

AXIS: Any = dict(disturbances=("delay",), **SHORT)
LEVELS, FLOWN = 8, 8 + len(MAPS)  # of delay; of one that flies


class Stop(Exception):
    pass


@pytest.fixture
def flights_flown(monkeypatch):
    """Notes what is flown; after `stop_after` of them the next one raises."""

    class Noted(list):
        stop_after = None

    noted = Noted()

    def noting(fly):
        @functools.wraps(fly)
        def flown(*given, **conditions):
            if len(noted) == noted.stop_after:
                raise Stop
            noted.append(given)
            return fly(*given, **conditions)

        return flown

    for name in ("measured", "recovered"):
        monkeypatch.setattr(disturbed, name, noting(getattr(disturbed, name)))
    return noted


def stopped_after(count, flights_flown, **given):
    flights_flown.stop_after = count
    with pytest.raises(Stop):
        quadrl.robustness(**AXIS | given)
    flights_flown.clear()
    flights_flown.stop_after = None


@pytest.mark.parametrize("count", [1, FLOWN + 2])
def test_a_card_that_was_stopped_is_gone_on_with_and_is_the_same(tmp_path, flights_flown, count):
    flyers = ["hover", "geometric"]
    quadrl.robustness(flyers, **AXIS).save(tmp_path / "whole")
    assert len(flights_flown) == 2 * FLOWN
    flights_flown.clear()
    folder = tmp_path / "stopped"
    stopped_after(count, flights_flown, controller=flyers, keep=folder)
    card = quadrl.robustness(flyers, **AXIS, keep=folder)
    assert len(flights_flown) == 2 * FLOWN - count and (folder / FILE).exists()
    card.save(folder)
    whole, again = (tmp_path / name / "robustness.json" for name in ("whole", "stopped"))
    assert whole.read_bytes() == again.read_bytes()
    assert {p.name for p in folder.iterdir()} == {p.name for p in whole.parent.iterdir()}


def own_task(tmp_path, radius):
    """A task of a file of one's own, in the same place whatever is in it."""
    (tmp_path / "own.py").write_text(
        "import dataclasses\n\nfrom quadrl.tasks.hover import Hover\n\n\n"
        "@dataclasses.dataclass(frozen=True)\nclass Own(Hover):\n    name = 'own'\n"
        f"    def distance(self):\n        return {radius}\n"
    )
    import_own(tmp_path / "own.py")
    return sys.modules["own"].Own(time_limit=0.5)


@pytest.mark.parametrize(
    "other",
    [
        *({"seed": 1}, {"episodes": 5}, {"time_limit": 0.6}, {"aerodynamics": "rotor_drag"}),
        *({"engine": "mujoco"}, {"vehicle": Vehicle(mass=0.66)}, {"controller": "hover_robust"}),
    ],
    ids=lambda other: next(iter(other)),
)
def test_what_was_flown_under_other_conditions_is_not_used(tmp_path, flights_flown, other):
    stopped_after(4, flights_flown, controller="hover", keep=tmp_path)
    given = AXIS | {"recovery": False, "keep": tmp_path}
    card = quadrl.robustness(**given | {"controller": "hover"} | other)
    assert len(flights_flown) == LEVELS
    card.save(tmp_path)
    flights_flown.clear()
    quadrl.robustness("hover", **given)  # nor has the other one's card removed it
    assert len(flights_flown) == LEVELS - 4


def test_a_policy_is_known_by_its_numbers_and_a_task_of_ones_own_by_its_file(tmp_path, monkeypatch):
    policy, again = (quadrl.Policy.pretrained("hover") for _ in range(2))
    assert digest(policy) == digest(again)
    again.weights[0][3, 2] = np.nextafter(again.weights[0][3, 2], np.float32(9))
    metadata = policy.metadata | {"control_mode": "velocity"}
    for other in (again, dataclasses.replace(policy, metadata=metadata)):
        assert digest(policy) != digest(other)
    monkeypatch.setattr("quadrl.tasks.TASKS", dict(quadrl.tasks.TASKS))
    first, same, edited = (digest(own_task(tmp_path, radius)) for radius in (1, 1, 2))
    assert first == same != edited


def test_what_ones_own_functions_fly_is_flown_again(tmp_path, flights_flown):
    memory = []

    def own(observation):
        memory.append(observation)
        return np.full((len(observation), 4), 0.01 * len(memory))

    policy = quadrl.Policy.pretrained("hover")
    for flyer in (own, policy.sampled(0)):
        for _ in range(2):
            flights_flown.clear()
            quadrl.robustness(flyer, "hover", **AXIS, recovery=False, keep=tmp_path)
            assert len(flights_flown) == LEVELS
    assert not list(tmp_path.iterdir())


def test_a_damaged_file_is_not_used_and_kept_aside(tmp_path, flights_flown):
    stopped_after(4, flights_flown, controller="hover", keep=tmp_path)
    file = tmp_path / FILE
    text = file.read_text()
    changed = text.replace('"success": 0.0', '"success": 0.5', 1)
    assert changed != text
    for damaged in (text[: len(text) // 2], changed, '{"mine": 1}', "[]"):
        flights_flown.clear()
        file.write_text(damaged)
        with pytest.warns(QuadrlWarning, match=f"{file} is damaged") as caught:
            quadrl.robustness("hover", **AXIS, keep=tmp_path)
        assert caught[0].filename == __file__ and len(flights_flown) == FLOWN
        assert (tmp_path / "flown.unused").read_text() == damaged


def test_ctrl_c_says_that_the_same_command_goes_on(tmp_path, monkeypatch, capsys):
    def interrupted(*given, **conditions):
        raise KeyboardInterrupt

    words = ["robustness", "hover", "--out", str(tmp_path)]
    monkeypatch.setattr(disturbed, "measured", interrupted)
    monkeypatch.setattr(sys, "argv", ["quadrl", *words])
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 130
    again = f"quadrl robustness hover --out {tmp_path}"
    assert capsys.readouterr().err == f"quadrl: stopped; the same command goes on: {again}\n"
