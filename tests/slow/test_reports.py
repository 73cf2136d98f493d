"""The reports: their bookkeeping by hand, and each measurement in a small version."""

import dataclasses
import functools
import json
import math

import mujoco
import numpy as np
import pytest

from quadrl.aircraft.vehicle import Vehicle
from quadrl.conditions.randomization import Randomization
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly, summarize
from quadrl.learning import benchmark
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import write_config
from quadrl.learning.studies.crew import train_here
from quadrl.learning.studies.plan import PlannedRun
from scripts.reports import (
    claims,
    evaluation,
    goals,
    noise,
    paper,
    report,
    robust,
    search,
    ship,
    significance,
    training,
    trial,
    tuning,
)
from scripts.reports.search import LABELS


@pytest.fixture(autouse=True)
def results(tmp_path, monkeypatch):
    """Results and pictures go to a folder of their own."""
    monkeypatch.setattr(report, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(report, "IMAGES", tmp_path / "images")
    return tmp_path


def test_parts_are_spliced_into_a_page(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "DOCS", tmp_path / "docs")
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- begin x -->\nold\n<!-- end x -->\n<!-- begin y --><!-- end y -->\n")
    parts = {"x": lambda: "[new](tasks.md#a) [b](../b.py)", "y": lambda: report.load("nothing")}
    text = report.written(page, parts)
    assert "old" not in text and "[new](docs/tasks.md#a) [b](b.py)" in text
    assert "run `scripts/report nothing`" in text
    with pytest.raises(KeyError):
        report.written(page, {})


def test_results_keep_machine_commit_and_five_digits():
    report.save("x", {"a": [1 / 3, math.nan], "b": {"c": 2}})
    saved = report.load("x")
    assert (saved["a"], saved["b"]) == ([0.33333, None], {"c": 2})
    assert saved["machine"]["mujoco"] == mujoco.__version__
    assert f"Measured at commit {saved['commit']}." in report.source(saved)
    assert report.spread([3.0, 1.0, math.nan, 2.0], "cm", 100) == "200 (100 to 300) cm"


# ------------------------------------------------------------------------------ speed


def test_shares_of_the_benchmark_are_within_one_turn():
    measured = benchmark.benchmark("hover", num_envs=3, seconds=0.01, repeats=2)
    assert {row["target"] for row in measured["rates"]} == {None, 0.90, 20.0, 0.75, 0.35, 1 / 3}
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
    assert len(benchmark.rows(measured)) == len(measured["rates"])


# ------------------------------------------------------------------------------ others


def test_policies_for_uncertain_aircraft_fly_beside_the_controller(monkeypatch, tmp_path):
    monkeypatch.setattr(robust, "WAYS", {"robust": {"steps": 8192}})
    monkeypatch.setattr(robust, "SEEDS", (1, 2))
    monkeypatch.setattr(robust, "FRESH_SEEDS", {})
    monkeypatch.setattr(robust, "EPISODES", 3)
    monkeypatch.setattr(report, "RUNS", tmp_path)
    best = {"best": {"bandwidth": 1.6, "integral": 1.0}}
    report.save("tuning", {"tasks": {"hover": {"uncertain": best}}})
    robust.main(("hover",), ("robust",))
    found = report.load("robust")["tasks"]["hover"]
    assert [run["seed"] for run in found["robust"]] == [1, 2]
    (controller,) = found[robust.CONTROLLER]
    names = [name for name, *_ in robust.conditions()]
    for run in (*found["robust"], controller):
        assert [*run["flown"]] == names
    assert controller["flown"]["nothing"]["success"] == 1.0
    assert found["robust"][0]["flown"]["nothing"]["success"] == 0.0  # two batches teach nothing
    text = robust.results()
    assert "100.0 (43.9 to 100.0)" in text and "0.0 (0.0 to 39.0) [0.0, 0.0]" in text  # Wilson


def test_trainings_of_other_tasks_are_kept_with_their_commit(monkeypatch, tmp_path):
    monkeypatch.setattr(training, "HOVER_SEEDS", (1,))
    monkeypatch.setattr(training, "VEHICLES", {"paper": None})
    monkeypatch.setattr(training, "EPISODES", 2)
    monkeypatch.setattr(training, "TrainConfig", functools.partial(TrainConfig, steps=4096))
    monkeypatch.setattr(report, "RUNS", tmp_path)
    old = [{"task": task, "vehicle": "paper", "seed": 9} for task in ("landing", "hover")]
    report.save("training", {"yardstick": old, "runs": old})
    file = tmp_path / "results" / "training.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"commit": "before"}))
    training.main(only=("hover",))
    result = report.load("training")
    assert [(run["task"], run["seed"]) for run in result["runs"]] == [
        ("hover", 1),
        ("hover", 1),
        ("landing", 9),
    ]
    assert result["runs"][-1]["commit"] == "before"
    assert report.commits(result["runs"][:2]) == {"commit": report.commit()}
    assert [row["task"] for row in result["yardstick"]] == ["hover", "landing"]


def test_goals_are_counted_over_batches_of_flights(monkeypatch, tmp_path):
    monkeypatch.setattr(goals, "TASKS", {"ppo": ("hover", "random_waypoint")})
    monkeypatch.setattr(goals, "FLIGHTS", 5)
    monkeypatch.setattr(goals, "MANY", {})
    monkeypatch.setattr(goals, "TOGETHER", 2)
    monkeypatch.setattr(goals, "PAIRS", 1)
    monkeypatch.setattr(goals, "FRESH_SEEDS", {})
    monkeypatch.setattr(goals, "TrainConfig", functools.partial(TrainConfig, steps=4096))
    monkeypatch.setattr(report, "RUNS", tmp_path)
    monkeypatch.setattr(goals, "SEEDS", (1,))
    goals.main()
    hover, waypoint = report.load("goals")["runs"]
    updates = report.load("goals")["updates"]
    assert set(updates) == set(goals.LOSSES) and all(took > 0 for took in updates.values())
    assert (hover["flights"], hover["failed"]) == (5, 5)  # one batch teaches nothing
    whole = fly(
        Policy.load(tmp_path / "goals" / "hover-ppo-1"),
        "hover",
        episodes=5,
        seed=goals.EVALUATION_SEED,
        engine="free_flight",
    )
    assert hover["position_error_m"] == pytest.approx(summarize(whole)["position_error_m"], 1e-4)
    assert "heading_error_deg" in hover and "heading_error_deg" not in waypoint
    monkeypatch.setattr(report, "commit", lambda: "later")
    goals.main(only=("hover",))
    again = report.load("goals")["runs"]
    assert again == [hover | {"commit": "later"}, waypoint]
    assert "| 5 of 5 |" in goals.goals()


def test_noise_in_training_is_judged_by_pairs(monkeypatch, tmp_path):
    assert noise.chance(np.array([1.0, 2.0, 3.0, 4.0])) == 2 / 16
    assert noise.chance(np.array([1.0, -1.0, 2.0, -2.0])) == 1.0
    low, high = noise.interval(np.array([1.0, 2.0, 3.0]))
    assert 1 <= low < 2 < high <= 3
    trained = {"neither": {"steps": 8192}, "wind": {"steps": 8192, "weather": "light"}}
    monkeypatch.setattr(noise, "TRAINED", trained)
    monkeypatch.setattr(noise, "QUESTIONS", noise.QUESTIONS[2:4])
    monkeypatch.setattr(noise, "SEEDS", (1, 2))
    monkeypatch.setattr(noise, "EPISODES", 3)
    monkeypatch.setattr(report, "RUNS", tmp_path)
    noise.main()
    assert len(report.load("noise")["success"]) == 4
    assert noise.shares().count("0.0 (0.0 to 0.0)") == 4
    assert noise.verdicts().count("no difference") == 2


def test_an_integral_takes_away_the_lasting_error_of_an_unknown_mass(monkeypatch):
    monkeypatch.setattr(tuning, "BANDWIDTHS", (1.3,))
    monkeypatch.setattr(tuning, "INTEGRALS", (0.0, 1.0))
    monkeypatch.setattr(tuning, "AROUND", ((1.0, 1.4),))
    heavy = tuning.Condition(randomization=Randomization(mass=(1.1, 1.2)))
    found = tuning.searched("hover", 4, heavy)
    without, with_one, _ = (row["position_error_m"] for row in found["tried"])
    # k_z k_v e = g (mass - 1), of the factor: the aircraft hangs e below the goal.
    assert without > 0.1 > 5 * with_one
    assert found["best"]["integral"] in (1.0, 1.4)
    assert found["best"]["fresh"]["success_rate"] == 1.0


def test_gains_are_kept_for_each_task_and_disturbance(monkeypatch):
    every = tuning.conditions("hover")
    windy = tuning.Condition(weather="light", aerodynamics="full")
    few = {"nothing": every["nothing"], "windy": windy}
    report.save("tuning", {"tasks": {"landing": "as it was"}})
    with monkeypatch.context() as patch:
        patch.setattr(tuning, "conditions", lambda task: few)
        tuning.main(("hover",), jobs=2, episodes=2)
        controller = tuning.tuned("hover", "windy")
    found = report.load("tuning")["tasks"]
    assert found["landing"] == "as it was" and [*found["hover"]] == [*few]
    assert len(found["hover"]["windy"]["tried"]) == search.SETTINGS  # as many as the algorithms get
    assert controller.vehicle.aerodynamics != Vehicle().aerodynamics
    assert {"uncertain", "all together", "weather severe"} < set(every)
    assert "uncertain" not in tuning.conditions("landing")


# ------------------------------------------------------------------------------ the paper


def test_smoothness_by_hand():
    rollout = fly(Policy.pretrained("hover"), "hover", episodes=2)
    time = 0.05 * np.arange(200)
    rate = np.zeros((200, 2, 3))
    rate[:, 0, 1] = 0.3 * np.sin(2 * np.pi * 4.0 * time)  # 4 Hz: all of it is wobble
    action = np.zeros_like(rollout.action)
    action[1::2, 0, 0] = 0.4  # one of four rotors, 0.4 at every step of 0.05 s: 2 per second
    velocity = np.zeros_like(rollout.velocity)
    velocity[:, 0, 0] = 0.5 * time**2  # jerk 1 m/s^3
    rows = dict(body_rate=rate, action=action, velocity=velocity)
    rollout = dataclasses.replace(rollout, **rows, is_success=np.array([True, False]))
    smooth = evaluation.smoothness(rollout)
    assert smooth["flights"] == 1
    assert smooth["action_variation_1_s"] == pytest.approx(2.0)
    assert smooth["body_rate_rad_s"] == pytest.approx(0.3 / math.sqrt(2), rel=0.01)
    assert smooth["jerk_m_s3"] == pytest.approx(1.0)
    assert smooth["wobble_share"] > 0.99


def test_a_run_is_measured_by_flying_its_policy(tmp_path):
    run = PlannedRun(TrainConfig("hover", steps=4096, num_threads=1), tmp_path / "run")
    said = []
    train_here([run], 1, 2, said.append)
    assert run.done
    train_here([run], 1, 2, said.append)  # there is nothing left to do
    measured = evaluation.measure(run, episodes=3, weathers=("light",))
    policy = Policy.load(run.folder)
    fresh = {"episodes": 3, "seed": evaluation.FRESH, "engine": "free_flight"}
    assert summarize(fly(policy, "hover", **fresh)).items() <= measured["mean"].items()
    blown = summarize(fly(policy, "hover", **fresh, weather="light"))
    assert measured["windy"][0]["mean"].items() <= blown.items()
    assert measured["sampled"] != measured["mean"] and measured["steps"] == 4096


def test_curve_and_noisy_weights_by_hand():
    # 40 batches: means over 2, so the lucky 1 counts for half. In the first no episode ends.
    shares = [math.nan, 0.0, 0.2, *[0.5] * 17, 1.0, *[0.5] * 18, 0.3, 0.2]
    found = evaluation.curve_figures({"success": np.array(shares)})
    assert found == {"best": 0.75, "final": 0.25}
    policy = Policy.pretrained("hover")
    noisy = evaluation.with_noisy_weights(policy, 0.1, seed=3)
    for before, after in zip(policy.weights, noisy.weights, strict=True):
        share = np.linalg.norm(after - before, axis=1) / np.linalg.norm(before, axis=1)
        np.testing.assert_allclose(share, 0.1, rtol=1e-4)


def test_significance_by_hand():
    # Five against five, all smaller: one of C(10, 5) = 252 orders, p = 0.004; two against two 0.17.
    low, high = [1, 2, 3, 4, 5], [6, 7, 8, 9, 10]
    assert significance.smaller(low, high, 0.05) == 1 == -significance.smaller(high, low, 0.05)
    assert significance.smaller(low, high, 0.0039) == 0
    for a, b in (([1, 2], [3, 4]), ([], [1]), ([1], [1]), ([math.nan], [1])):
        assert significance.smaller(a, b, 0.05) == 0
    # Five of five: p = 1/32; four of five: 6/32. Zeros and NaN do not count.
    assert significance.mostly([1, 2, 1, 1, 3], 0.05) == 1
    assert significance.mostly([1, 2, 1, 1, -3], 0.05) == 0
    assert significance.mostly([-1, -2, -1, -1, -3, 0.0, math.nan], 0.05) == -1
    # Ten of ten against five of ten: p = 0.016; against six of ten 0.043.
    ten, five, six = [1] * 10, [1, 0] * 5, [1] * 6 + [0] * 4
    assert (
        significance.solved_more(ten, five, 0.02) == 1 == -significance.solved_more(five, ten, 0.02)
    )
    assert significance.solved_more(ten, six, 0.02) == 0
    assert significance.middle([9, 1, 2, 3, 4, -7, 0, math.inf]) == 2.5  # of 1, 2, 3 and 4
    assert significance.improvement([2, 3], [1, 2]) == 0.875
    assert significance.improvement_interval([2, 3], [0, 1]) == (1.0, 1.0)
    words = ["agrees", "disagrees", "mixed", "not shown"]
    votes = ([1, 1, -1], [-1, 0, -1], [1, -1, 0], [1, 0, 0])
    assert [trial.verdict(each) for each in votes] == words


def test_verdicts_are_false_no_more_often_than_said():
    """Of thirteen sentences on three tasks, and of spreads with heavy tails (F: 30 %, not 5)."""
    level = significance.level_of(13, 3)
    assert 2 * (3 * level**2 - 2 * level**3) == pytest.approx(0.05 / 13)
    assert significance.level_of(13, 1) == pytest.approx(0.05 / 13 / 2)
    draw, alike = np.random.default_rng(0), 0
    for _ in range(400):
        alike += significance.steadier(*draw.standard_t(2, (2, 10)), 0.025) != 0
    assert alike <= 29  # 0.05 of 400, and two deviations
    assert significance.steadier([1.0] * 5, [1.0] * 5, 0.05) == 0
    assert significance.steadier(0.1 * np.arange(10.0), np.arange(10.0), 0.01) == 1


def test_a_power_grows_with_the_seeds(monkeypatch):
    monkeypatch.setattr(significance, "DRAWS", 60)
    for test in significance.EFFECTS:
        few, many = (significance.power.__wrapped__(test, n, 0.03) for n in (5, 40))
        assert few < 0.8 < many


def test_each_algorithm_searches_as_many_settings(monkeypatch, tmp_path):
    every = {algo: [search.settings(algo, n) for n in range(search.SETTINGS)] for algo in LABELS}
    assert all(len({json.dumps(x) for x in each}) == 16 for each in every.values())
    for rows in zip(*every.values(), strict=True):  # the same batch and the same share of a range
        assert len({(row["num_envs"], row["gae_lambda"]) for row in rows}) == 1
        low, high = search.RATES[0], search.BOUNDS[0]
        rate, bound = rows[0]["vpg"]["learning_rate"], rows[2]["trpo"]["max_kl"]
        assert rate / low == pytest.approx(bound / high, rel=0.1)
    assert search.worth([(1.0, 0.1), (0.9, math.inf)]) < search.worth([(0.96, 0.3), (0.95, 0.3)])
    assert search.worth([(1.0, 0.1)]) > search.worth([(1.0, 0.2)])
    monkeypatch.setitem(search.TASKS, "hover", 2048)
    monkeypatch.setattr(search, "SETTINGS", 2)
    monkeypatch.setattr(search, "FINALISTS", 1)
    monkeypatch.setattr(search, "LABELS", {"vpg": "GAE"})
    monkeypatch.setattr(search, "EPISODES", 2)
    monkeypatch.setattr(report, "RUNS", tmp_path)
    search.main(names=("hover",))
    found = report.load("search")["tasks"]["hover"]["vpg"]
    assert len(found["tried"]) == 2 and len(found["finalists"]) == 1
    assert found["settings"] == search.settings("vpg", found["chosen"])
    assert len([*(tmp_path / "search").glob("hover-vpg-*")]) == 3
    assert "| `hover` | GAE |" in search.chosen()


def test_the_experiments_are_flown_judged_and_drawn(monkeypatch, tmp_path):
    monkeypatch.setattr(significance, "DRAWS", 20)
    monkeypatch.setattr(report, "RUNS", tmp_path)
    chosen = {algo: {"settings": search.settings(algo, 2)} for algo in LABELS}
    report.save("search", {"tasks": {"hover": chosen}})
    best = {"best": {"bandwidth": 1.3, "integral": 0.5}}
    report.save("tuning", {"tasks": {"hover": dict.fromkeys(tuning.conditions("hover"), best)}})
    means = {f"{name}, mean": [0.5] * 10 for name in ("noise", "neither")}
    report.save("noise", {"success": means})
    paper.main(names=("hover",), seeds=(1, 2), episodes=5, steps=8192)
    result = report.load("paper")
    assert len(result["runs"]) == 6 and result["geometric"]["hover"]["mean"]["success_rate"] == 1.0
    assert paper.well().count("0 of 2 (0 to 66 %)") == 3  # Wilson
    assert paper.better().count("0.50 (0.50 to 0.50)") >= 3
    assert "power" in paper.claims() and paper.powers().count("\n") == 5
    names = {path.name for path in (tmp_path / "images" / "paper").iterdir()}
    assert {"figure_3_hover.png", "smoothness.png", "wind.png"} == names


def test_verdicts_follow_what_was_measured(monkeypatch):
    """GAE that fails everywhere, in the results of the paper's page."""
    monkeypatch.setattr(report, "RESULTS", report.DOCS / "results")
    result = report.load("paper")
    for run in result["runs"]:
        if run["algo"] == "vpg":
            run["mean"] |= {"success_rate": 0.1, "return_mean": 100.0 * run["seed"]}
            run["curve"] = {"best": 0.9, "final": 0.1}
    page = claims.judged(result)
    for sentence in (
        "GAE may be less suited to flight control.",
        "GAE is prone to collapse during",
    ):
        assert f"{sentence}" in page
        assert "| **agrees** |" in page.partition(sentence)[2].splitlines()[0]
    assert "10/10 collapsed" in page


def test_the_lowest_seed_is_shipped(tmp_path, monkeypatch):
    source, seed = Policy.pretrained("hover"), Policy.pretrained("hover").metadata["seed"]
    for name, number in (("a", seed + 1), ("b", seed)):
        (tmp_path / name).mkdir()
        config = TrainConfig("hover", seed=number).resolved()
        write_config(tmp_path / name, config)
        own = dataclasses.replace(source, metadata=source.metadata | {"seed": number})
        own.save(tmp_path / name / "policy.safetensors")
    monkeypatch.setattr(ship, "EPISODES", 20)
    ship.main((tmp_path / "a", tmp_path / "b", tmp_path / "none"), tmp_path / "out")
    beside = json.loads((tmp_path / "out" / "hover_ppo.json").read_text())
    assert beside["command"] == f"quadrl train hover --algo ppo --seed {seed}"
    assert beside["evaluation"] == summarize(fly(source, "hover", episodes=20))
    variant = TrainConfig("hover", seed=seed, variant="robust").resolved()
    write_config(tmp_path / "b", variant)
    robust = Policy.pretrained("hover", variant="robust")
    own = dataclasses.replace(robust, metadata=robust.metadata | {"seed": seed})
    own.save(tmp_path / "b" / "policy.safetensors")
    monkeypatch.setattr(ship, "WORTH_HAVING", 0.0)
    ship.main((tmp_path / "b",), tmp_path / "out")
    beside = json.loads((tmp_path / "out" / "hover_robust.json").read_text())
    assert beside["command"].endswith(f"--seed {seed} --variant robust")
    monkeypatch.setattr(ship, "WORTH_HAVING", 1.1)
    ship.main((tmp_path / "a", tmp_path / "b"), tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())
