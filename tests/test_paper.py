"""The paper's experiments: gusts, sampled actions, smoothness, studies, what is said of them."""

import dataclasses
import json
import math
import os
import shutil
import subprocess
import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from test_learning import brake, make_record

import quadrl
from quadrl.environment import Environment
from quadrl.learning import study
from quadrl.learning.config import RunError, recipe
from quadrl.learning.evaluate import EVALUATION_SEED, fly, judge, make_gusts, smoothness
from quadrl.learning.figures import FigureError, learning_curves, lines, spread
from quadrl.learning.policy import export, make_actor_critic
from quadrl.learning.train import Training
from quadrl.policy import Policy
from quadrl.task import OptionError

REPOSITORY = Path(__file__).parents[1]


def script(name):
    """A script of the repository as a module."""
    loader = SourceFileLoader(name, str(REPOSITORY / "scripts" / name))
    module = module_from_spec(spec_from_loader(name, loader))
    bytecode, sys.dont_write_bytecode = sys.dont_write_bytecode, True  # nothing into scripts/
    loader.exec_module(module)
    sys.dont_write_bytecode = bytecode
    return module


paper, ship = script("paper_figures"), script("ship_policies")


# Gusts and sampled actions.


def test_gusts_have_their_strength_and_their_memory():
    wind = make_gusts(3.0, 200_000, 0.05, seed=0)
    # 10,000 s of a process that remembers 1 s are some 5,000 independent values: the deviation is
    # known to 1 % (one sigma), and the correlations to 0.02 or so.
    np.testing.assert_allclose(wind.std(axis=0), 3.0, rtol=0.05)
    for lag, expected in ((1, math.exp(-0.05)), (20, math.exp(-1.0)), (60, math.exp(-3.0))):
        correlation = (wind[lag:] * wind[:-lag]).mean(axis=0) / wind.var(axis=0)
        np.testing.assert_allclose(correlation, expected, atol=0.06)
    starts = np.array([make_gusts(3.0, 1, 0.05, seed=k)[0] for k in range(2000)])
    np.testing.assert_allclose(starts.std(axis=0), 3.0, rtol=0.06)  # from the first step on


def test_an_aircraft_in_gusts_is_the_single_one_in_that_wind():
    seed = EVALUATION_SEED + 7
    record = fly(brake, "hover", episodes=3, seed=seed, gusts=4.0)
    for i in range(3):
        alone = Environment("hover", seed=seed + i)
        wind = make_gusts(4.0, alone.horizon_steps, 0.05, seed=[seed + i, 1])
        observation = alone.flatten(alone.reset())
        for t in range(record.length[i]):
            alone.simulation.model.opt.wind = wind[t]
            now = alone.step(brake(observation))
            observation = alone.flatten(now.observation)
            np.testing.assert_array_equal(alone.simulation.state.position, record.position[t, i])
        assert now.terminated or now.truncated


def test_gusts_that_cannot_be_are_refused():
    for gusts in (-1.0, math.nan, math.inf):
        with pytest.raises(OptionError, match="a speed in m/s, at least 0, is allowed"):
            fly(brake, "hover", episodes=1, gusts=gusts)


def test_sampled_actions_are_those_of_the_actor():
    torch.manual_seed(0)
    actor, _, normaliser = make_actor_critic(
        6, 4, hidden=(16,), critic_hidden=(3,), initial_deviation=0.1
    )
    for parameter in actor.parameters():
        parameter.data += 0.05 * torch.randn_like(parameter)
    observation = torch.randn(1, 6)
    normaliser.update(torch.randn(50, 6))
    policy = export(actor, "hover", {})
    with torch.no_grad():
        out = actor.get_dist(TensorDict({"observation": observation}, [1])).base_dist
    draws = policy.sampled(0)(observation.numpy().repeat(100_000, axis=0))
    # 100,000 draws: the mean to deviation / 316, the deviation to 0.22 % (one sigma); nothing is
    # clipped, five deviations from the bounds.
    assert (out.loc.abs() + 5 * out.scale < 1).all()
    assert (np.abs(draws.mean(0) - out.loc[0].numpy()) < 4 * out.scale[0].numpy() / 316).all()
    np.testing.assert_allclose(draws.std(0), out.scale[0], rtol=0.01)


def test_sampled_actions_follow_their_seed():
    policy = Policy.pretrained("hover")
    observations = np.zeros((5, 22))
    first, again, other = (policy.sampled(seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first(observations), again(observations))
    assert (first(observations) != other(observations)).any()
    assert np.abs(first(100 * np.ones((1000, 22)))).max() <= 1.0


# Smoothness.


def test_smoothness_by_hand():
    record = make_record(is_success=np.array([True, False, False]))
    time = 0.05 * np.arange(100)
    rate, action = record.body_rate.copy(), record.action.copy()
    velocity = record.velocity.copy()
    rate[:, 0, 1] = 0.3 * np.sin(2 * np.pi * 4.0 * time)
    action[::2, 0] = 0.1
    velocity[:, 0, 2] = 0.5 * 7.0 * time**2
    rate[:, 1:] = 5.0  # of the flights that do not succeed
    figures = smoothness(
        dataclasses.replace(record, body_rate=rate, action=action, velocity=velocity)
    )
    assert figures["flights"] == 1
    # 0.1 there and back: 0.1 in each 0.05 s.
    assert figures["action_variation_1_s"] == pytest.approx(2.0)
    # The root mean square of a sine is its amplitude over sqrt(2): 0.2121; 4 Hz are 20 whole
    # periods in 5 s.
    assert figures["body_rate_rad_s"] == pytest.approx(0.3 / math.sqrt(2))
    assert figures["wobble_rad_s"] == pytest.approx(0.3 / math.sqrt(2))
    # a = 7 t, so the jerk is 7.
    assert figures["jerk_m_s3"] == pytest.approx(7.0)
    # Differences of a sine of frequency f: amplitude times 2 sin(pi f dt) / dt = 23.51 per second.
    expected = 0.3 / math.sqrt(2) * 2 * math.sin(math.pi * 4 * 0.05) / 0.05
    assert figures["angular_acceleration_rad_s2"] == pytest.approx(expected, rel=0.01)
    # All of the power, 0.3^2 / 2 = 0.045, is at 4 Hz.
    power = np.array(figures["body_rate_spectrum"])
    assert figures["frequency_hz"][int(power.argmax())] == 4.0
    assert power.sum() * 0.5 == pytest.approx(0.045, rel=0.01)
    assert figures["wobble_share"] == pytest.approx(1.0, abs=1e-6)


def test_a_slow_turn_is_no_wobble_and_no_flight_is_no_number():
    record = make_record(is_success=np.array([True, False, False]))
    rate = record.body_rate.copy()
    rate[:, 0, 0] = np.sin(2 * np.pi * 0.5 * 0.05 * np.arange(100))
    assert smoothness(dataclasses.replace(record, body_rate=rate))["wobble_share"] < 1e-3
    nobody = smoothness(dataclasses.replace(record, is_success=np.zeros(3, bool)))
    assert nobody["flights"] == 0 and math.isnan(nobody["jerk_m_s3"])
    everybody = smoothness(dataclasses.replace(record, is_success=np.ones(3, bool)))
    assert everybody["flights"] == 2  # the second lasts a second


# A study.


def test_a_plan_has_whole_seeds_first():
    runs = study.plan(Path("x"), ("hover", "landing"), ("gae", "ppo"), (3, 4), num_threads=1)
    names = [run.name for run in runs]
    assert (
        names[:5] == ["hover-gae-3", "hover-ppo-3", "landing-gae-3", "landing-ppo-3"] + names[4:5]
    )
    assert len(names) == 8 and names[4] == "hover-gae-4"
    for run in runs:
        usual = recipe(run.config.task, run.config.algo)
        assert run.config == dataclasses.replace(usual, seed=run.config.seed, num_threads=1)


def small(out, seeds=(0,)):
    return study.plan(out, ("hover",), ("ppo",), seeds, steps=1, num_threads=1)


class Stop(Exception):
    pass


def test_a_study_goes_on_with_what_is_half_done_and_leaves_alone_what_is_done(tmp_path):
    half, damaged = small(tmp_path / "study", (0, 1))
    # Two batches, so that there is something to go on with.
    config = dataclasses.replace(half.config, steps=2 * 256 * 16, checkpoint_seconds=0.0)
    half, damaged = (
        dataclasses.replace(run, config=dataclasses.replace(config, seed=run.config.seed))
        for run in (half, damaged)
    )
    alone = Training(config, tmp_path / "alone")
    alone.run()

    def stop(progress):
        if progress.iteration == 2:
            raise Stop

    for run in (half, damaged):
        with pytest.raises(Stop):
            Training(run.config, run.folder).run(stop)
    (damaged.folder / "checkpoint.safetensors").write_bytes(b"nothing")
    said = []
    failed = study.train((half, damaged), 2, episodes=2, report=said.append)
    (line,) = failed
    assert line.startswith("hover-ppo-1: quadrl: ") and "is damaged" in line
    assert {"hover-ppo-0: begun, 1 waiting", "hover-ppo-0: done", line} <= set(said)
    policies = [folder / "policy.safetensors" for folder in (half.folder, tmp_path / "alone")]
    assert policies[0].read_bytes() == policies[1].read_bytes()
    said.clear()
    assert study.train((half,), 1, episodes=2, report=said.append) == [] and said == []
    threads = dataclasses.replace(half.config, num_threads=2)  # changes no number
    assert dataclasses.replace(half, config=threads).done
    other = dataclasses.replace(half, config=dataclasses.replace(half.config, gamma=0.5))
    with pytest.raises(RunError, match="holds a run with other settings"):
        study.train((other,), 1, episodes=2, report=said.append)
    # What is measured of it is what flying it gives.
    measured = study.measure(half, episodes=5, gusts=(4.0,))
    policy = Policy.load(half.folder)
    judged = judge(fly(policy, "hover", episodes=5))
    assert judged.items() <= measured["mean"].items()
    judged = judge(fly(policy, "hover", episodes=5, gusts=4.0))
    level = measured["gusts"][0]
    assert level["deviation_m_s"] == 4.0 and level["mean"].items() <= judged.items()
    assert level["sampled"] != level["mean"] and measured["steps"] == 8192
    json.dumps(paper.rounded(measured), allow_nan=False)


def test_a_new_run_begins_with_the_command_that_anybody_would_give(tmp_path):
    (run,) = small(tmp_path)
    assert run.command(7) == [
        "train", "hover", "--algo", "ppo", "--seed", "0", "--steps", "1",
        "--vehicle", "paper", "--engine", "flight", "--num-threads", "1", "--out",
        str(tmp_path / "hover-ppo-0"), "--no-video", "--episodes", "7",
    ]  # fmt: skip


def make_metrics(returns, **changes):
    count = len(returns)
    return {
        "steps": 100.0 * np.arange(1, count + 1),
        "seconds": np.arange(1.0, count + 1),
        "return": np.array(returns, dtype=float),
        "success": np.linspace(0, 1, count),
        **changes,
    }


def test_first_best_and_final_return():
    # 40 batches: means over 2, so the lucky 100 counts for half.
    returns = [0.0, 2.0, *[50.0] * 17, 100.0, *[50.0] * 18, 30.0, 20.0]
    figures = study.curve_figures(make_metrics(returns))
    assert (figures["first"], figures["best"], figures["final"]) == (1.0, 75.0, 25.0)
    assert figures["steps"][0] == 100 and figures["steps"][-1] == 4000
    assert figures["return"][0] == 0.0 and figures["return"][-1] == 20.0
    nothing = study.curve_figures(make_metrics([math.nan, math.nan]))
    assert nothing["best"] is None


def test_noise_on_the_weights_has_the_length_of_a_share_of_them():
    policy = Policy.pretrained("hover")
    noisy = study.with_noisy_weights(policy, 0.1, seed=3)
    for before, after in zip(policy.weights, noisy.weights, strict=True):
        share = np.linalg.norm(after - before, axis=1) / np.linalg.norm(before, axis=1)
        np.testing.assert_allclose(share, 0.1, rtol=1e-4)
    for before, after in zip(policy.biases, noisy.biases, strict=True):
        np.testing.assert_array_equal(before, after)


# Pictures.


def test_spread_is_worst_median_and_best_where_every_run_has_been():
    short = make_metrics([0.0, 10.0, 20.0])
    # In its second batch no episode ended: 5 + (9 - 5) / 2 = 7 is read off the line.
    long = make_metrics([5.0, math.nan, 9.0, 100.0])
    middle = make_metrics([1.0, 8.0, 12.0])
    points, (low, median, high) = spread([short, long, middle], "return", "steps")
    assert points[0] == 100 and points[-1] == 300
    for at, expected in ((100, (0, 1, 5)), (200, (7, 8, 10)), (300, (9, 12, 20))):
        got = [np.interp(at, points, x) for x in (low, median, high)]
        # 200 points from 100 to 300: none is exactly 200, and the lines bend there.
        np.testing.assert_allclose(got, expected, atol=0.06)
    assert spread([make_metrics([math.nan])], "return", "steps") is None


def test_overlaid_curves_are_pictures_and_the_same_every_time(tmp_path):
    groups = {"ppo": [make_metrics([1, 2, 3]), make_metrics([2, 3, 4])], "own": [make_metrics([1])]}
    for name in ("a.svg", "b.svg"):
        learning_curves(groups, "hover", tmp_path / name)
    text = (tmp_path / "a.svg").read_text()
    assert text == (tmp_path / "b.svg").read_text()
    assert "<svg" in text and "PPO, 2 seeds" in text and "OWN, 1 seed" in text
    with pytest.raises(FigureError, match="no episode has ended"):
        learning_curves({"ppo": [make_metrics([math.nan])]}, "hover", tmp_path / "c.png")
    values = np.array([[1.0, 2.0], [math.nan, 1.0]])
    panels = {"hover": {"PPO sampled": ([0.0, 1.0], values), "GAE mean": ([0.0, 1.0], values[1:])}}
    path = lines(panels, ("x", "y"), "title", tmp_path / "d.svg", logarithmic=True)
    assert "PPO sampled" in path.read_text() and "GAE mean" not in path.read_text()


# What is said of it.


def make_run(task, algo, seed, **changes):
    """A run of an algorithm of which only some figures matter; others are the same for all."""
    smooth = {name: 1.0 for name in paper.ROUGHNESS} | {
        "wobble_rad_s": 0.1, "wobble_share": 0.1,
        "frequency_hz": [0.0, 1.0], "body_rate_spectrum": [1.0, 1.0],
    }  # fmt: skip
    way = {
        "success_rate": 1.0,
        "survival_rate": 1.0,
        "position_error_m": 0.02,
        "touchdown_speed_median_m_s": 0.3,
        "return_mean": 2000.0 + seed,
        "smoothness": smooth,
    }
    wobbly = smooth | {name: 2.0 for name in ("action_variation_1_s", "wobble_rad_s")}
    values = {
        "task": task,
        "algo": algo,
        "seed": seed,
        "steps": 1000,
        "training_s": 60.0,
        "curve": {"first": 0.0, "best": 1900.0, "final": 1900.0},
        "mean": way,
        "sampled": way | {"smoothness": wobbly},
        "gusts": [
            {"deviation_m_s": g, "mean": way, "sampled": way | {"success_rate": 0.5}}
            for g in paper.GUSTS
        ],
        "return_noisy_weights": 1900.0,
    }
    for path, value in changes.items():
        part, _, name = path.partition("__")
        if name:
            values[part] = values[part] | {name: value}
        else:
            values[part] = value
    return values


def make_measured(**of_algo):
    """A study in which an algorithm differs by what is given for it, a function of the seed."""
    yardstick = make_run("hover", "geometric", 0)["mean"] | {
        "position_error_m": 0.01,
        "touchdown_speed_median_m_s": 0.2,
    }
    geometric = {
        "mean": yardstick,
        "gusts": [{"deviation_m_s": g, "mean": yardstick} for g in paper.GUSTS],
    }
    runs = [
        make_run(task, algo, seed, **of_algo.get(algo, lambda seed: {})(seed))
        for task in paper.TASKS
        for algo in paper.ALGORITHMS
        for seed in range(5)
    ]
    machine = {"cpu": "a", "cores": 2, "system": "b", "python": "3"}
    return {
        "quick": False, "command": "scripts/paper_figures", "machine": machine,
        "seeds": [0, 1, 2, 3, 4], "episodes": 100, "wall_clock_s": 60.0, "runs": runs,
        "geometric": dict.fromkeys(paper.TASKS, geometric),
    }  # fmt: skip


def said(measured):
    """The verdicts by the first words of the sentences."""
    return {
        " ".join(sentence.split()[:4]): paper.verdict(judged(measured)[0])
        for sentence, _, judged in paper.SENTENCES
    }


def test_tests_by_hand():
    # Five against five, all smaller: one of C(10, 5) = 252 orders, p = 0.004.
    assert paper.smaller([1, 2, 3, 4, 5], [6, 7, 8, 9, 10]) == 1
    assert paper.smaller([6, 7, 8, 9, 10], [1, 2, 3, 4, 5]) == -1
    # Two against two: one of 6 orders, p = 0.17, is not enough; nor is nothing.
    assert paper.smaller([1, 2], [3, 4]) == 0
    assert paper.smaller([], [1, 2, 3]) == 0 and paper.smaller([1, 1], [1, 1]) == 0
    # Five of five: p = 1/32; four of five: 6/32. Zeros and what is no number do not count.
    assert paper.mostly([1, 2, 1, 1, 3]) == 1 and paper.mostly([1, 2, 1, 1, -3]) == 0
    assert paper.mostly([-1, -2, -1, -1, -3, 0.0, math.nan]) == -1
    assert paper.mostly([]) == 0
    # F(4, 4) exceeds 6.39 in a twentieth of the cases: deviations of a ratio of 2.53.
    values = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    assert paper.steadier(values, 2.6 * values) == 1 and paper.steadier(2.6 * values, values) == -1
    assert paper.steadier(values, 2.4 * values) == 0 and paper.steadier([1.0], [2.0]) == 0
    assert paper.steadier([1.0] * 5, values) == 1 and paper.steadier([1.0] * 5, [1.0] * 5) == 0


@pytest.mark.parametrize(
    ("votes", "word"),
    [
        ([1, 1, 1], "agrees"),
        ([1, 1, -1], "agrees"),
        ([-1, 0, -1], "disagrees"),
        ([1, -1, 0], "mixed"),
        ([1, 0, 0], "not shown"),
        ([0, 0, 0], "not shown"),
    ],
)
def test_verdicts(votes, word):
    assert paper.verdict(votes) == word


def test_where_all_algorithms_are_alike_nothing_is_said_between_them():
    words = said(make_measured())
    for between in (
        "Over all, PPO and", "PPO is the most", "TRPO learns to fly", "The reason may be",
        "GAE's performance varies more", "GAE is prone to", "GAE is less suited",
    ):  # fmt: skip
        assert words[between] == "not shown", between
    assert words["Most of the goals"] == words["GAE learns most of"] == "agrees"
    # Sampled: error 2 cm against 1 cm, touchdowns at 0.3 against 0.2 m/s; a larger wobble; half
    # of the flights in gusts are lost, and with the mean action none.
    assert words["A policy whose actions"] == words["Sampling always leaves a"] == "agrees"
    assert words["The mean action flies"] == "agrees"
    assert words["Stochastic policies should stand"] == "disagrees"


def test_a_gae_that_fails_is_said_to(tmp_path):
    def fails(seed):
        # It spreads a hundred times as much, and loses 900 of 2000 at the end.
        return {
            "mean__success_rate": 0.2 * (seed % 2),
            "mean__return_mean": 500.0 + 100.0 * seed,
            "curve": {"first": 0.0, "best": 1900.0, "final": 1000.0 - seed},
        }

    measured = make_measured(gae=fails)
    words = said(measured)
    for sentence in (
        "Over all, PPO and", "GAE's performance varies more", "GAE is prone to",
        "GAE is less suited",
    ):  # fmt: skip
        assert words[sentence] == "agrees", sentence
    assert words["GAE learns most of"] == "disagrees"
    assert words["PPO is the most"] == "not shown"
    page = paper.written(paper.rounded(measured))
    for sentence, rule, _ in paper.SENTENCES:
        assert sentence in page and rule in page
    assert "| hover | GAE | 0 of 5 | 0 (0 to 20) % | 100 % |" in page
    assert "too short" not in page
    assert "too short to learn from" in paper.written(measured | {"quick": True})
    assert "5/5 collapsed" in page
    assert paper.written(paper.rounded(make_measured())) != page


def test_a_smoother_trpo_and_a_sharper_ppo_are_said_to_be():
    def smooth(seed):
        base = make_run("hover", "trpo", seed)["mean"]
        rough = {name: 0.5 + 0.01 * seed for name in paper.ROUGHNESS}
        return {"mean__smoothness": base["smoothness"] | rough}

    def sharp(seed):
        return {"return_noisy_weights": 1000.0 - 10 * seed}

    words = said(make_measured(trpo=smooth, ppo=sharp))
    assert words["TRPO learns to fly"] == words["The reason may be"] == "agrees"
    words = said(make_measured(ppo=smooth, trpo=sharp))
    assert words["TRPO learns to fly"] == words["The reason may be"] == "disagrees"


def test_the_page_is_up_to_date_and_every_picture_on_it_is_there():
    paths = [str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]
    done = subprocess.run(
        [sys.executable, REPOSITORY / "scripts" / "paper_figures", "--check"],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


# Policies that ship.


def test_the_lowest_seed_is_shipped_and_is_the_same_file(tmp_path, capsys, monkeypatch):
    source = Policy.pretrained("hover")
    beside = json.loads((REPOSITORY / "assets" / "policies" / "hover_ppo.json").read_text())
    seed = source.metadata["seed"]
    for name, number in (("a", seed + 1), ("b", seed)):
        folder = tmp_path / name
        folder.mkdir()
        config = dataclasses.replace(recipe("hover"), seed=number, engine="mujoco")
        (folder / "config.json").write_text(json.dumps(config.resolved()))
        dataclasses.replace(source, metadata=source.metadata | {"seed": number}).save(
            folder / "policy.safetensors"
        )
    other = tmp_path / "c"
    shutil.copytree(tmp_path / "b", other)
    config = dataclasses.replace(recipe("landing"), gamma=0.5)
    (other / "config.json").write_text(json.dumps(config.resolved()))
    monkeypatch.setattr(ship, "EPISODES", 20)
    out = tmp_path / "out"
    folders = [str(tmp_path / name) for name in ("a", "b", "c", "nowhere")]
    monkeypatch.setattr(sys, "argv", ["ship_policies", *folders, "--out", str(out)])
    ship.main()
    printed = capsys.readouterr().out
    assert f"hover ppo: seed {seed}, 100.0 % of 20 successful" in printed
    assert "landing ppo: left out" in printed and "other settings" in printed
    assert {p.name for p in out.iterdir()} == {"hover_ppo.safetensors", "hover_ppo.json"}
    assert (out / "hover_ppo.safetensors").read_bytes() == (
        quadrl.policy.SHIPPED / "hover_ppo.safetensors"
    ).read_bytes()
    again = json.loads((out / "hover_ppo.json").read_text())
    command = f"quadrl train hover --algo ppo --seed {seed} --engine mujoco"
    assert again["command"] == beside["command"] == command
    assert again["evaluation"]["episodes"] == 20
    # Shipped before, and no longer worth having: taken away again.
    monkeypatch.setattr(ship, "WORTH_HAVING", 1.1)
    ship.main()
    assert "not worth having" in capsys.readouterr().out and not list(out.iterdir())
