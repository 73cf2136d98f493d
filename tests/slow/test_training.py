"""Whole trainings: on any number of cores, stopped by signals, and good enough in the end."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from processes import command
from runs import metrics, train
from scipy import stats

import quadrl
from quadrl import cli
from quadrl.core import catalogue
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.policy import SHIPPED_AS, Policy, shipped
from quadrl.evaluation.rollout import EVALUATION_SEED, fly, summarize
from quadrl.learning import checkpoint
from quadrl.learning.config import TrainConfig
from quadrl.learning.defaults import usual_vehicle


def test_several_seeds_are_a_study(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    short = "--num-envs 8 --rollout 4 --steps 192 --episodes 2 --task-options time_limit=0.5"
    words = ["train", "hover", *short.split(), "--no-video"]
    cli.main([*words, "--seeds", "0:2"])
    folder = Path("runs/hover-ppo-seeds")
    assert f"in {folder}: table.csv" in capsys.readouterr().out
    kept = {path.name for path in folder.iterdir()}
    runs = {"hover-ppo-0", "hover-ppo-1"}
    assert kept == {*runs, "logs", "table.csv", "study.json", "learning_curves_hover.png"}
    cli.main([*words, "--seeds", "0:2"])
    assert "2 of 2 trainings are done already" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        cli.main([*words, "--seeds", "0:2", "--gamma", "0.5"])
    assert "holds a run with other settings" in capsys.readouterr().err


ALIKE = {
    "as it is": {},
    "on one core": {"cores": 1},
    "one thread of OpenMP": {"OMP_NUM_THREADS": "1"},
    "four threads of OpenMP, another hash seed": {"OMP_NUM_THREADS": "4", "PYTHONHASHSEED": "7"},
    "one thread of MKL": {"MKL_NUM_THREADS": "1"},
}
TRAIN = """
import os, sys
from quadrl.cli import main
cores = int(sys.argv[1])
if cores and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
main(["train", "hover", "--seed", "1733", "--steps", "8192", "--episodes", "3", "--no-video",
      "--out", sys.argv[2]])
"""


def test_the_same_command_gives_the_same_policy_on_any_number_of_cores(tmp_path):
    running = []
    for k, settings in enumerate(ALIKE.values()):
        own = {name: value for name, value in settings.items() if name != "cores"}
        words = [sys.executable, "-c", TRAIN, str(settings.get("cores", 0)), str(tmp_path / f"{k}")]
        running.append(subprocess.Popen(words, env=os.environ | own, stdout=subprocess.DEVNULL))
    assert [process.wait(300) for process in running] == [0] * len(ALIKE)
    study = {"tasks": ["hover"], "seeds": [1733], "episodes": 3, "settings": {"steps": 8192}}
    quadrl.study(study, out=tmp_path / "study", jobs=1, on_line=lambda line: None)
    folders = [*(tmp_path / f"{k}" for k in range(len(ALIKE))), tmp_path / "study/hover-ppo-1733"]
    first, *others = ((f / "policy.safetensors").read_bytes() for f in folders)
    assert [content == first for content in others] == [True] * len(ALIKE)
    for folder in folders[1:]:
        assert metrics(folder) == metrics(folders[0])
        one, other = (
            json.loads((f / "evaluation.json").read_text()) | {"training_s": 0}
            for f in (folder, folders[0])
        )
        assert one == other


@pytest.mark.parametrize("algo", ["ppo", "trpo"])
def test_hover_is_learned_by_default(tmp_path, algo):
    """Seeds 0 to 3 of either succeed in all of the episodes, with mean errors of 1 to 4 cm."""
    config = TrainConfig("hover", algo=algo)
    policy = Policy.load(train(config, tmp_path / "run"))
    reached = evaluate(policy, config.scenario.task, episodes=100).metrics
    assert reached["success_rate"] >= 0.9


def test_the_plain_policy_gradient_gets_better_at_hover(tmp_path):
    """It ends well or not, as the seed and the last bit of a sum have it, but it always learns.

    Of 26 seeds, 22 succeed in at least 95 % of the episodes, three in 89 to 93 %, one in 48 %.
    """
    folder = train(TrainConfig("hover", algo="vpg"), tmp_path / "run")
    returns = [float(row["return"] or "nan") for row in metrics(folder)]
    assert np.nanmean(returns[-20:]) > np.nanmean(returns[:20]) + 50


FRESH_SEED, FRESH_EPISODES = EVALUATION_SEED + 1_000_000, 100


@pytest.mark.parametrize("file", shipped(), ids=lambda file: file.stem)
def test_a_shipped_policy_still_reaches_its_metrics(file):
    """On episodes of its own, with what chance allows between two samples of the same policy.

    Success: the recorded share of n episodes leaves, at one in a hundred, a true share as low as
    the lower bound of Clopper and Pearson; with that one the 100 episodes here must not be worse
    than one in a thousand would be. Recorded 500 of 500: at least 0.01^(1/500) = 0.991, so 94.
    Error: the means of two samples differ by less than 4 standard errors of their difference but
    in one of 30,000 cases, if they are normal. The seeds are fixed, so a policy either passes here
    or does not; the margins are for other episodes, not for luck.
    """
    beside = json.loads(file.with_suffix(".json").read_text())
    policy, recorded = Policy.load(file), beside["evaluation"]
    config, metadata = beside["config"], policy.metadata
    variant = metadata.get("variant", "ideal")
    for task, algo in ((policy.task, metadata["algo"]), (config["task"], config["algo"])):
        kind = SHIPPED_AS.get(algo, algo) if variant == "ideal" else variant
        usual = usual_vehicle(catalogue.kind(task), variant)
        made_for = "" if variant == "ideal" or config["vehicle"] == usual else config["vehicle"]
        assert file.stem == "_".join(filter(None, (task, kind, made_for)))
    trained = metadata["seed"], metadata["vehicle"]["name"]
    assert (config["seed"], config["vehicle"]) == trained
    assert beside["command"].split()[:2] == ["quadrl", "train"]
    task = quadrl.tasks.make(policy.task, **metadata.get("task_options", {}))
    settings = {"episodes": FRESH_EPISODES, "seed": FRESH_SEED}
    if task.solids():  # MuJoCo alone takes ten times as long among many
        settings["engine"] = "free_flight"
    reached = summarize(fly(policy, task, **settings))
    n, share = recorded["episodes"], recorded["success_rate"]
    hits = round(n * share)
    lowest = stats.beta.ppf(0.01, hits, n - hits + 1)
    assert reached["success_rate"] * FRESH_EPISODES >= stats.binom.ppf(
        0.001, FRESH_EPISODES, lowest
    )
    deviation, error = recorded["position_error_std_m"], recorded["position_error_m"]
    standard_error = deviation * (1 / n + 1 / FRESH_EPISODES) ** 0.5
    assert reached["position_error_m"] <= error + 4 * standard_error


def judged(file):
    """What the task of a policy asks of its behaviour; who races need not stand still."""
    targets = quadrl.tasks.make(Policy.load(file).task).targets
    return [x for x in targets if x.metric in ("yaw_rate_rad_s", "circling_m_s")]


@pytest.mark.parametrize("file", [*filter(judged, shipped())], ids=lambda file: file.stem)
def test_a_shipped_policy_neither_turns_nor_circles(file):
    task = quadrl.tasks.make(Policy.load(file).task)
    engine = "mujoco" if task.contact else "free_flight"
    given = {"weather": "calm", "randomization": "none", "engine": engine}
    reached = evaluate(file.stem, episodes=FRESH_EPISODES, **given).metrics
    assert [x.metric for x in judged(file) if not x.met(reached)] == []


@pytest.mark.parametrize(
    ("task", "options", "asked"),
    [
        *(
            ("trajectory", {"figure": "lemniscate", "period": period}, ("survival_rate", 0.98))
            for period in (15.0, 5.5, 3.5)
        ),
        *(
            ("perching", {"least_incline": turn, "most_incline": turn}, ("success_rate", 0.9))
            for turn in (0.0, 0.5, 1.0, 1.5708)
        ),
    ],
)
def test_one_policy_flies_every_figure_and_perches_at_every_incline(task, options, asked):
    """The mean over a task's episodes would hide a figure or an incline that always fails."""
    given = {"task_options": options, "seed": 12_345, "engine": "free_flight"}
    reached = evaluate(task, episodes=FRESH_EPISODES, **given).metrics
    assert reached[asked[0]] >= asked[1]
    if task == "trajectory":
        assert reached["distance_m"] < 0.04


TINY = ["--num-envs", "8", "--rollout", "4", "--steps", "192", "--hidden", "16", "--episodes", "2"]


def stopped(words, folder, signal_number, awaited):
    """Exit code and errors of a command that gets a signal as soon as a file is in its folder."""
    process = subprocess.Popen(
        [sys.executable, "-m", "quadrl", *words, "--out", str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell starts what runs in the background with it ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 300
    while not list(folder.glob(awaited)) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal_number)
    _, error = process.communicate()
    return process.returncode, error


LONG = "--num-envs 8 --rollout 4 --hidden 16 --steps 3200000 --checkpoint-seconds 1e9"
RARELY = ["train", "hover", *LONG.split()]
"""Its one checkpoint is the one that a signal asks for."""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_it_has_a_checkpoint_and_says_how_to_go_on(tmp_path, number):
    code, error = stopped(RARELY, tmp_path, number, "metrics.csv")
    assert code == 128 + number
    (line,) = error.splitlines()
    advice = f"continue it: quadrl train --resume {tmp_path}"
    assert line == f"quadrl: stopped; the run is kept, {advice}"
    steps = 32 * len(metrics(tmp_path))  # to the last iteration that was begun
    assert steps and Policy.load(tmp_path).metadata["steps"] == steps
    assert checkpoint.load(tmp_path / "checkpoint.safetensors")[1]["iteration"] * 32 == steps


def test_terminated_while_it_draws_it_leaves_nothing_half_written(tmp_path):
    folder = tmp_path / "run"
    words = ["train", "hover", *TINY]
    code, error = stopped(words, folder, signal.SIGTERM, ".flight*")
    assert code == 128 + signal.SIGTERM and not error
    left = {file.name for file in folder.iterdir()}
    assert not {name for name in left if name.startswith(".") or name.endswith(".part")}
    assert "flight.mp4" not in left  # it was not finished
    assert evaluate(folder, episodes=1).metrics["episodes"] == 1


def test_without_graphics_it_trains_and_says_that_there_is_no_video(tmp_path):
    folder = tmp_path / "run"
    done = command("train", "hover", *TINY, "--out", folder, MUJOCO_GL="disabled")
    assert done.stderr == "" and "no video: " in done.stdout
    assert (folder / "trajectory.png").exists() and not (folder / "flight.mp4").exists()
