"""The reports: their bookkeeping by hand, and each measurement in a small version."""

import dataclasses
import importlib.machinery
import json
import math
import shutil
import sys
import types

import mujoco
import numpy as np
import pytest

import quadrl
from quadrl.aircraft.presets import VEHICLES
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.core.task import Target
from quadrl.deploy.foundation_policy import Raptor
from quadrl.engines.engine import ENGINES
from quadrl.evaluation.policy import SHIPPED, Policy
from quadrl.evaluation.rollout import fly, summarize
from quadrl.learning import benchmark
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import write_config
from quadrl.tasks.hover import Hover
from quadrl.tasks.random_waypoint import RandomWaypoint
from scripts.reports import (
    flights,
    measure,
    pages,
    report,
    robustness,
    shipping,
    world,
)


@pytest.fixture(autouse=True)
def results(tmp_path, monkeypatch):
    """Results, pictures and runs go to a folder of their own."""
    for name in ("RESULTS", "IMAGES", "RUNS"):
        monkeypatch.setattr(report, name, tmp_path / name.lower())
    for folder in ("curves", "robustness"):
        (report.IMAGES / folder).mkdir(parents=True)
    return tmp_path


def test_parts_are_spliced_into_a_page(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "DOCS", tmp_path / "docs")
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- begin x -->\nold\n<!-- end x -->\n")
    text = pages.written(page, {"x": lambda: "[new](tasks.md#a) [b](../b.py)"})
    assert "old" not in text and "[new](docs/tasks.md#a) [b](b.py)" in text
    with pytest.raises(KeyError):
        pages.written(page, {})


def test_results_keep_machine_commit_and_five_digits():
    rows = [{"a": 1, "b": {"c": 2.0}}, {"a": 3, "b": {"c": math.inf}}]
    mixed = [{"d": k} for k in range(3)] + [{"d": k, "e": None} for k in range(3)]
    whole = {"a": [1 / 3, math.nan], "rows": rows, "others": [{"a": 1}, {"b": 1}], "mixed": mixed}
    report.save("x", whole)
    text = (report.RESULTS / "x.json").read_text()
    assert text.count('"c"') == 2 and text.count('"a"') == 3  # a name of a column stands once
    assert text.count('"d"') == 2
    saved = report.load("x")
    assert saved["a"] == [0.33333, None] and saved["others"] == [{"a": 1}, {"b": 1}]
    assert saved["mixed"] == mixed
    assert saved["rows"] == [{"a": 1, "b": {"c": 2.0}}, {"a": 3, "b": {"c": None}}]
    assert saved["machine"]["mujoco"] == mujoco.__version__
    assert f"Measured at commit {saved['commit']}." in report.source(saved)


def test_rows_of_other_cases_are_kept_with_their_commit(monkeypatch):
    def measured(seed):
        return lambda: {"rows": [{"seed": seed}], "more": [{"seed": -seed}]}

    report.gather("x", "task", {"hover": measured(1), "landing": measured(2)}, table=[{"a": 1}])
    before = report.commit()
    monkeypatch.setattr(report, "commit", lambda: "later")
    again = {"race": measured(5), "hover": measured(3), "landing": measured(4)}
    report.gather("x", "task", again, only=("hover",), episodes=7)
    found = report.load("x")
    assert found["rows"] == [
        {"commit": "later", "task": "hover", "seed": 3},
        {"commit": before, "task": "landing", "seed": 2},
    ]
    assert [row["seed"] for row in found["more"]] == [-3, -2]
    assert found["table"] == [{"a": 1}] and found["episodes"] == 7 and found["commit"] == "later"
    assert "later." in report.source(found, found["rows"][:1])


def test_a_report_that_is_stopped_keeps_what_it_has_measured():
    def stopped():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        report.gather("x", "task", {"hover": lambda: {"rows": [{"a": 1}]}, "race": stopped})
    assert [row["task"] for row in report.load("x")["rows"]] == ["hover"]


def test_shares_of_the_benchmark_are_within_one_turn():
    measured = benchmark.benchmark("hover", num_envs=3, seconds=0.01, repeats=2)
    assert {row["target"] for row in measured["rates"]} == {
        None,
        0.90,
        20.0,
        4.0,
        0.80,
        0.75,
        0.35,
        1 / 3,
    }
    for of in (benchmark.ALL_CORES, benchmark.ONE_CORE, benchmark.FREE_FLIGHT, benchmark.KERNEL):
        group = [row for row in measured["rates"] if row["of"] == of]
        bare = [row for row in group if row["what"].startswith("mj_step")]
        bare = bare or [row for row in measured["rates"] if row["what"].endswith(of)]
        yardstick = max(bare, key=lambda row: np.median(row["repeats"]))
        assert group
        for row in group:
            assert row["rate"] == max(row["repeats"]) > 0
            ratios = np.array(row["repeats"]) / yardstick["repeats"]
            assert row["share"] == pytest.approx(np.median(ratios))
    assert len(benchmark.rows(measured)) == 1 + len(measured["rates"])


def test_trainings_are_evaluated_beside_the_controller_and_drawn(monkeypatch):
    monkeypatch.setattr(measure, "EPISODES", 2)
    for engine in ENGINES:
        settings = {"steps": 4096, "engine": engine}
        study = {"tasks": ["hover"], "seeds": [1, 2], "episodes": 2, "settings": settings}
        quadrl.study(study, out=report.RUNS / engine)
    measure.training((*report.RUNS.glob("*/*"),))
    result = report.load("training")
    assert [(run["engine"], run["seed"]) for run in result["runs"]] == [
        (engine, seed) for engine in sorted(ENGINES) for seed in (1, 2)
    ]
    assert all(run["metrics"]["success_rate"] == 0 for run in result["runs"])
    (own,) = result["yardstick"]
    assert own["metrics"]["success_rate"] == 1
    rows, seeds = measure.reached("hover")
    assert seeds == [1, 2] and rows[0] == ("successful", "at least 100 %", "0 %", "0 %", "100 %")
    assert measure.hover_table().count("\n| paper |") == 4
    assert (report.IMAGES / "curves" / "hover.png").stat().st_size > 0


def test_policies_for_uncertain_aircraft_fly_beside_the_controller():
    report.save("tuning", {"tasks": {"hover": {"uncertain": [1.6, 1.0]}}})
    report.save("robust", {"rows": []})
    what = {"variant": "robust", "steps": 8192}
    study = {"tasks": ["hover"], "seeds": [645, 646], "episodes": 2, "settings": what}
    quadrl.study(study, out=report.RUNS)
    robustness.robust((*report.RUNS.iterdir(),), episodes=3)
    rows = report.load("robust")["rows"]
    assert len(rows) == 3 * len(robustness.UNSURE)
    robustness.robust(episodes=4)  # the controller alone, beside what is known of the policies
    again = report.load("robust")["rows"]
    assert [row["seed"] for row in again] == [row["seed"] for row in rows]
    assert again[: 2 * len(robustness.UNSURE)] == rows[: 2 * len(robustness.UNSURE)]
    assert again[-1] != rows[-1]  # in four flights instead of three
    calm = {row["seed"]: row["success"] for row in rows if row["condition"] == "nothing"}
    assert calm.pop("controller") == 1.0
    assert set(calm.values()) == {0.0} and len(calm) == 2  # two batches teach nothing
    text = robustness.robust_table()
    assert "| 100.0, " in text and "| 0.0 [0.0, 0.0], " in text and "rad/s |" in text
    ways = robustness.ways_table().splitlines()[2:]
    assert len(ways) == 2 * len(robustness.WAYS_OF)
    circling = {tuple(row.split("|")[2:4]): float(row.split("|")[5].split()[-2]) for row in ways}
    calm, fallen = (
        circling[f" {who} ", " nothing "] for who in ("tuned controller", "robust policies")
    )
    assert calm < 0.05 < fallen


def test_every_policy_is_flown_in_every_condition(monkeypatch):
    every = robustness.conditions()
    assert {"nothing", "all together", "weather severe", "mass as in `full`"} < set(every)
    few = {name: every[name] for name in ("nothing", "weather severe")}
    monkeypatch.setattr(robustness, "conditions", lambda: few)
    report.save("tuning", {"tasks": {"hover": dict.fromkeys(few, [1.3, 0.5])}})

    class Card:
        table = [("half of the flights fail at", "policy"), ("mean wind [m/s]", "6.1")]

        def save(self, path):
            assert path.name.startswith("hover")

    Card.figure = Card.maps = Card()
    monkeypatch.setattr(robustness.quadrl, "robustness", lambda *_, **__: Card())
    robustness.robustness(episodes=3)
    calm, severe = report.load("robustness")["alone"]
    flyers = ("policy", "robust policy", "controller", "tuned controller")
    assert [calm[name] for name in flyers] == [1.0] * 4
    assert [severe[name] for name in flyers] == [0.0] * 4
    told = robustness.alone_table()
    assert "| weather severe, drag only | 0 / 0 / 0 / 0 |" in told
    assert "Every flight of all four succeeds with nothing. " in told and "| nothing |" not in told
    assert "| hover | policy | 6.1 |" in robustness.half_table()


def test_an_integral_takes_away_the_lasting_error_of_an_unknown_mass():
    heavy = {"randomization": {"mass": (1.1, 1.2)}}
    found = {}
    for integral in (0.0, 1.0):
        report.save("tuning", {"tasks": {"hover": {"nothing": [1.3, integral]}}})
        tuned = robustness.tuned("hover", "nothing", {})
        found[integral] = robustness.flown(tuned, "hover", heavy, 4)
    # k_z k_v e = g (mass - 1), of the factor: the aircraft hangs e below the goal.
    assert found[0.0]["position_error_m"] > 0.1 > 5 * found[1.0]["position_error_m"]
    assert found[1.0]["success"] == 1.0


def test_policies_that_ship_are_judged_where_nothing_disturbs_them(tmp_path, monkeypatch):
    for name in ("hover_ppo", "random_waypoint_robust", "race_apg"):
        for end in (".json", ".safetensors"):
            shutil.copy(SHIPPED / f"{name}{end}", tmp_path)
    monkeypatch.setattr(shipping, "SHIPPED", tmp_path)
    shipping.shipped(episodes=4)
    hover, race, robust = report.load("shipped")["rows"]
    assert robust["as_flown"] == {} and [*race["as_flown"]] == [*hover["as_flown"]]
    late = quadrl.evaluate("race", episodes=4, randomization={"command_delay": 0.02}).metrics
    assert race["as_flown"]["as flown, 20 ms late"]["in_time_rate"] == late["in_time_rate"] == 0
    said = shipping.policies("race").splitlines()
    assert any(line.startswith("| as flown, 20 ms late | | 0 % |") for line in said)
    assert hover["undisturbed"]["episodes"] == 4
    flown = quadrl.evaluate("random_waypoint_robust", episodes=4).metrics  # as it was trained
    assert robust["circling_m_s"] == pytest.approx(flown["circling_m_s"], 1e-4)
    assert robust["undisturbed"]["circling_m_s"] < 0.05 < robust["circling_m_s"]  # in wind
    asked = Target("yaw_rate_rad_s", "yaw rate over the last 2 s", 1e-6)
    monkeypatch.setattr(RandomWaypoint, "targets", (asked,))
    head, _, first, _, second = shipping.policies().splitlines()[:5]
    assert "| circling over the last 2 s |" in head and first.endswith("| none |")
    assert "yaw rate over the last 2 s 0.0" in second and "rad/s, asked at most" in second
    assert "hover" not in shipping.policies("random_waypoint")
    assert "None comes" in shipping.policies("landing")


def test_the_lowest_seed_is_shipped(tmp_path, monkeypatch, capsys):
    def run(name, policy, seed, **settings):
        (tmp_path / name).mkdir(exist_ok=True)
        config = TrainConfig(**{"task": "hover", "seed": seed, **settings})
        write_config(tmp_path / name, config.resolved())
        said = {k: x for k, x in policy.metadata.items() if k != "run"} | {"seed": seed}
        own = dataclasses.replace(policy, metadata=said)
        own.save(tmp_path / name / "policy.safetensors")

    source = Policy.pretrained("hover")
    seed = source.metadata["seed"]
    run("a", source, seed + 1)
    run("b", source, seed)
    monkeypatch.setattr(shipping, "EPISODES", 20)
    shipping.ship((tmp_path / "a", tmp_path / "b", tmp_path / "none"), tmp_path / "out")
    beside = json.loads((tmp_path / "out" / "hover_ppo.json").read_text())
    assert beside["command"] == f"quadrl train hover --algo ppo --seed {seed}"
    assert beside["evaluation"] == summarize(fly(source, "hover", episodes=20))
    run("b", Policy.pretrained("hover", variant="robust"), seed, variant="robust")
    shipping.ship((tmp_path / "b",), tmp_path / "out")
    beside = json.loads((tmp_path / "out" / "hover_robust.json").read_text())
    assert beside["command"].endswith(f"--seed {seed} --variant robust")
    practised = {"training_options": {"faces_east": False}}  # the command says what is not usual
    flying = Policy.pretrained("random_waypoint", variant="robust")
    run("c", flying, seed, task="random_waypoint", variant="robust", **practised)
    shipping.ship((tmp_path / "c",), tmp_path / "out")
    beside = json.loads((tmp_path / "out" / "random_waypoint_robust.json").read_text())
    assert beside["command"].endswith("--training-options faces_east=false --variant robust")
    (tmp_path / "out" / "random_waypoint_robust.json").unlink()
    (tmp_path / "out" / "random_waypoint_robust.safetensors").unlink()
    capsys.readouterr()
    asked = Target("position_error_m", "error over the last 2 s", 1e-12)
    monkeypatch.setattr(Hover, "targets", (asked,))  # they miss that now, and go
    shipping.ship((tmp_path / "a", tmp_path / "b"), tmp_path / "out")
    told = capsys.readouterr().err
    assert told.count(f"misses what its task asks: seed {seed}") == 1
    assert f"successful; {asked.words} " in told
    assert not list((tmp_path / "out").iterdir())


def test_fits_to_real_flights_are_those_of_the_page():
    recorded = json.loads((report.DOCS / "results" / "flights.json").read_text())["fits"]
    flights.flights()
    again = report.load("flights")["fits"]
    kept = dict(zip(recorded["columns"], zip(*recorded["rows"], strict=True), strict=True))
    assert [row["model"] for row in again] == [*kept["model"]]
    for row, factors in zip(again, kept["factors"], strict=True):
        assert row["factors"] == pytest.approx(factors, rel=0.01)
    assert {path.stem for path in report.IMAGES.glob("*.png")} == {*flights.PICTURES}


def test_a_row_of_the_world_is_flown_by_who_knows_as_much(monkeypatch):
    asked = []

    class Published:
        def reset(self):
            pass

        def evaluate_step(self, observation):
            asked.append(len(observation))
            return np.zeros((len(observation), 4))

    module = types.SimpleNamespace(
        Raptor=Published, __spec__=importlib.machinery.ModuleSpec("x", None)
    )
    monkeypatch.setitem(sys.modules, "foundation_policy", module)
    kept = report.DOCS / "results" / "forest.json"
    report.RESULTS.mkdir()
    shutil.copy(kept, report.RESULTS)
    monkeypatch.setattr(world, "TRIES", 3)
    short = {"hover": world.ROWS["hover"], "forest": world.ROWS["forest, 36 trees"]}
    short["recovery"] = dataclasses.replace(
        world.ROWS["recovery, 3 m up"], options={"time_limit": 2.0}
    )
    monkeypatch.setattr(world, "ROWS", short)
    monkeypatch.setattr(world, "TRIED", 4)
    world.world(episodes=6, beside=2)
    assert {*asked} == {1, 2}  # on drawn aircraft one of each layout
    hover, forest, recovery, drawn = report.load("world")["rows"]
    assert hover["policy"]["success_rate"] == hover["yardstick"]["success_rate"] == 1
    assert (
        0 < hover["yardstick"]["position_error_m"] < 1e-4 and hover["raptor"]["success_rate"] == 0
    )
    assert set(hover["settings"]) == set(world.BETWEEN) and not recovery["settings"]
    assert forest["raptor"] == {} == drawn["yardstick"]
    # Settings are chosen in other flights, and only a better one replaces those of the task.
    usual = Scenario.of("hover", engine="free_flight")
    gains = world._tuned(world.ROWS["hover"], usual)[1]
    assert gains == pytest.approx(hover["settings"], 1e-3)
    lines = world.world_table().splitlines()
    assert lines[2].startswith("| hover | 100 % (61 to 100), ") and "µm" in lines[2]
    assert "(sampler)" in lines[3] and "(turns over)" in lines[4] and lines[5].startswith("| any")
    before = report.load("world")["rows"]
    world.world(only=("recovery",), episodes=3, beside=0)
    after = report.load("world")["rows"]
    assert [row["flights"] for row in after] == [6, 6, 3, 6] and after[0] == before[0]


@pytest.mark.parametrize("vehicle", ["paper", "crazyflie", "racer"])
def test_another_projects_policy_is_given_and_asked_for_what_it_means(monkeypatch, vehicle):
    seen, asked = [], np.array([1.0, 0.0, 0.0, -1.0])  # front right, back right, back left, left

    class Published:
        def reset(self):
            seen.clear()

        def evaluate_step(self, observation):
            seen.append(observation)
            return np.tile(asked, (len(observation), 1))

    module = types.SimpleNamespace(Raptor=Published)
    monkeypatch.setitem(sys.modules, "foundation_policy", module)
    scale = float(VEHICLES[vehicle].max_speed.max())  # every speed can be commanded
    scenario = Scenario.of("hover", vehicle=vehicle, vehicle_options={"action_scale": scale})
    environment = Environment(scenario, num_envs=3, seed=2)
    first = environment.reset()
    policy = Raptor(scenario)
    environment.step(policy(environment.flatten(first)))
    command = environment.engine.ctrl / environment.vehicle.max_speed
    x, y = np.array([one.position[:2] for one in environment.vehicle.rotors]).T
    if vehicle == "paper":  # ahead is front right, on the left front left
        x, y = (x + y) / np.sqrt(2), (y - x) / np.sqrt(2)
    for at, share in (((1, -1), 1.0), ((-1, -1), 0.5), ((-1, 1), 0.5), ((1, 1), 0.0)):
        (k,) = np.flatnonzero((np.sign(x) == at[0]) & (np.sign(y) == at[1]))
        np.testing.assert_allclose(command[:, k], share, atol=1e-6)
    state = environment.snapshot.state
    policy(environment.flatten(environment.task.observe(environment.snapshot)))
    position, way, velocity, rate, last = np.split(seen[-1], [3, 12, 15, 18], axis=1)
    frame = np.eye(3)
    if vehicle == "paper":
        frame[:2, :2] = np.array([[1, 1], [-1, 1]]) / np.sqrt(2)  # into the turned frame
    np.testing.assert_allclose(position, state.position @ frame.T, atol=1e-6)  # the goal is at 0
    turned = frame @ state.rotation @ frame.T
    np.testing.assert_allclose(way, turned.reshape(-1, 9), atol=1e-5)
    np.testing.assert_allclose(velocity, state.velocity @ frame.T, atol=1e-5)
    np.testing.assert_allclose(rate, state.body_rate @ frame.T, atol=1e-5)
    np.testing.assert_array_equal(last, np.tile(asked, (3, 1)))
