"""The recipes of docs/recipes run through, and their comparison does."""

import importlib.util
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

REPOSITORY = Path(__file__).parents[1]
RECIPES = REPOSITORY / "docs" / "recipes"
TASKS = {"torchrl_ppo": "random_waypoint", "cleanrl_ppo": "landing", "sb3_ppo": "hover"}
FIGURES = {"success_rate", "survival_rate", "position_error_m"}


def run(*arguments):
    """Standard output of Python with this repository's package; a warning is a failure."""
    paths = [str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    done = subprocess.run(
        (sys.executable, *map(str, arguments)),
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_recipe_is_tried():
    assert {path.stem for path in RECIPES.glob("*.py")} == set(TASKS)


@pytest.mark.parametrize("name", TASKS)
def test_recipe_runs_a_few_updates(name):
    options = ("--num-envs", 16, "--num-steps", 16, "--minibatch", 64, "--epochs", 2)
    path = RECIPES / f"{name}.py"
    printed = run(
        "-W", "error", path, "--task", TASKS[name], "--seed", 3, "--total-steps", 768, *options
    )
    judged = json.loads(printed)  # one object and nothing else
    assert (judged["task"], judged["seed"], judged["steps"]) == (TASKS[name], 3, 768)
    assert judged["episodes"] == 100
    assert judged["seconds"] > 0
    assert all(math.isfinite(judged[figure]) for figure in FIGURES)


def test_comparison_gives_each_the_same_wall_clock(tmp_path):
    out = tmp_path / "recipes.json"
    script = REPOSITORY / "scripts" / "compare_recipes"
    run(script, "--seeds", 1, "--recipes", "cleanrl_ppo", "--steps", 4096, "--out", out)
    ours, *others = json.loads(out.read_text())["runs"]
    assert (ours["recipe"], ours["seed"], ours["steps"]) == ("quadrl train", 1, 4096)
    assert [other["settings"] for other in others] == ["library", "quadrl"]
    for other in others:
        assert (other["recipe"], other["seed"]) == ("cleanrl_ppo", 1)
        # It ends with the first batch that is over the time; an empty one would be none.
        assert other["steps"] > 0
        assert other["seconds"] >= ours["seconds"]


# --------------------------------------------------------------- the batch for Stable-Baselines3


@pytest.fixture
def sb3():
    specification = importlib.util.spec_from_file_location("sb3_ppo", RECIPES / "sb3_ppo.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_stable_baselines3_sees_what_gymnasium_gives(sb3):
    adapter = sb3.QuadrotorVecEnv("quadrl/Hover-v0", 8, horizon=0.5)
    envs = gym.make_vec("quadrl/Hover-v0", 8, autoreset_mode="SameStep", horizon=0.5)
    adapter.seed(7)
    np.testing.assert_array_equal(adapter.reset(), envs.reset(seed=7)[0])
    generator, ends = np.random.default_rng(0), 0
    for _ in range(25):
        action = generator.uniform(-1, 1, (8, 4))
        observation, reward, done, infos = adapter.step(action)
        expected, gains, terminated, truncated, info = envs.step(action)
        np.testing.assert_array_equal(observation, expected)
        np.testing.assert_array_equal(reward, gains.astype(np.float32))
        np.testing.assert_array_equal(done, terminated | truncated)
        for i in range(8):
            if not done[i]:
                assert infos[i] == {}
                continue
            ends += 1
            np.testing.assert_array_equal(infos[i]["terminal_observation"], info["final_obs"][i])
            assert infos[i]["TimeLimit.truncated"] == truncated[i]
    assert ends >= 16  # 0.5 s are 10 steps: at least two episodes of each row


def test_stable_baselines3_stops_with_its_wall_clock(sb3):
    watch = sb3.Stopwatch(sb3.Args(seconds=1e9, learning_rate=2.0))
    assert watch._on_step()
    assert watch.rate(0.25) == 0.5  # a quarter of the steps is left, and nearly all of the time
    watch.began -= 0.75e9
    assert watch.rate(0.9) == pytest.approx(0.5)
    watch.began -= 0.5e9
    assert not watch._on_step()
    assert watch.rate(0.9) == 0.0
