"""The command: what it writes and prints, and what it refuses with one line and exit code 2."""

import csv
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from runs import contents, metrics

import quadrl
from quadrl import cli, tasks
from quadrl.aircraft.presets import VEHICLES
from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.cli.flown import parse_options
from quadrl.conditions.weather import Weather
from quadrl.evaluation.rollout import BEHAVIOUR
from quadrl.learning.config import TrainConfig
from quadrl.learning.defaults import own_settings, written
from quadrl.learning.folder import read_config, write_config

SIZE = ["--num-envs", "8", "--rollout", "4", "--steps", "192", "--hidden", "16"]
TINY = [*SIZE, "--task-options", "time_limit=0.5", "--episodes", "2", "--checkpoint-seconds", "0"]
FILES = {
    "config.json",
    "metrics.csv",
    "evaluations.csv",
    "events",
    "checkpoint.safetensors",
    "policy.safetensors",
    "evaluation.json",
    "learning_curve.png",
    "trajectory.png",
}
METRICS = {"success_rate", "survival_rate", "position_error_m", "return_mean", "return_std"}


def command(*arguments: object) -> int:
    """Exit code of the command in this process."""
    try:
        cli.main([str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code or 0
    return 0


@pytest.fixture(scope="module")
def run(cheap_pictures, tmp_path_factory):
    """A run with everything in it; not to be written to."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert command("train", "hover", *TINY, "--out", folder) == 0
    return folder


@pytest.fixture
def copy(run, tmp_path):
    return Path(shutil.copytree(run, tmp_path / "copy"))


@pytest.fixture
def undrawn(monkeypatch):
    """Trainings leave their pictures out, which take longer than they do."""
    monkeypatch.setattr("quadrl.learning.run.Run.draw", lambda *_, **__: ())


@pytest.fixture
def refusal(capsys, monkeypatch):
    """A command with bad input: one line on stderr; returns the error and the line."""

    def refused(*arguments: object, printed: bool = False) -> tuple[Exception, str]:
        capsys.readouterr()
        assert command(*arguments) == 2
        said = capsys.readouterr()
        assert printed or said.out == ""
        assert said.err.startswith("quadrl: ") and said.err.count("\n") == 1, said.err
        monkeypatch.setenv("QUADRL_TRACEBACK", "1")  # raises what was said
        with pytest.raises((QuadrlError, OSError)) as caught:
            command(*arguments)
        monkeypatch.delenv("QUADRL_TRACEBACK")
        capsys.readouterr()
        return caught.value, said.err

    return refused


# --------------------------------------------------------------------------- what it does


@pytest.mark.slow
def test_tasks(capsys):
    assert command("tasks") == 0
    listed = capsys.readouterr().out
    for name in tasks.TASKS:
        assert name in listed
    for numbers in ("3..5", "0..2"):  # deck_landing does not see the position
        assert re.search(rf"sin_attitude +{re.escape(numbers)} ", listed)
    assert command("tasks", "hover") == 0
    shown = " ".join(capsys.readouterr().out.split())  # wherever the lines break
    for words in ("time limit 10 s", "rotor_speed 15..18 1", "tilt 0.2 ", "--gamma 0.9"):
        assert words in shown
    assert "target_velocity" in listed and "target_velocity" not in shown
    assert command("tasks", "--json") == 0
    read = json.loads(capsys.readouterr().out)
    assert list(read) == list(tasks.TASKS)
    assert command("tasks", "landing", "--json") == 0
    assert json.loads(capsys.readouterr().out) == read["landing"]


class Begun(Exception):
    """A training would begin."""


def resolved(monkeypatch, *arguments: str) -> tuple[TrainConfig, Path]:
    """The settings and the folder that `quadrl train` resolves, without training."""

    def begin(*given, **_):
        raise Begun(*given)

    monkeypatch.setattr("quadrl.learning.run.train_in", begin)
    with pytest.raises(Begun) as begun:
        cli.main(["train", *arguments])
    folder, config = begun.value.args
    return config, folder


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((), TrainConfig("hover")),
        # A word that is another option's value is not the task, wherever it stands.
        (("--out", "landing", "hover"), TrainConfig("hover")),
        (("hover", "--out", "landing"), TrainConfig("hover")),
        (("--algo", "gae", "hover"), TrainConfig("hover", algo="vpg")),
        (("hover", "--algo=gae"), TrainConfig("hover", algo="vpg")),
        (("--vehicle", "racer", "landing"), TrainConfig("landing", vehicle="racer")),
        (("hover", "--gamma", "0.5"), TrainConfig("hover", gamma=0.5)),
        (("hover", "--ppo.clip", "0.1"), TrainConfig("hover", ppo={"clip": 0.1})),
        (("hover", "--hidden"), TrainConfig("hover", hidden=())),
        (
            ("hover", "--hidden", "8", "4", "--task-options", "time_limit=2"),
            TrainConfig("hover", hidden=(8, 4), task_options={"time_limit": 2}),
        ),
    ],
)
def test_settings_are_resolved_after_parsing(monkeypatch, arguments, expected):
    assert resolved(monkeypatch, *arguments)[0] == expected


def test_help_says_what_each_setting_means(capsys):
    assert command("train", "--help") == 0
    text = " ".join(capsys.readouterr().out.split())
    for words in (
        "--num-envs INT", "(default: 256)", "--ppo.clip FLOAT", "--dry-run",
        "{hover,", "--algo {ppo,trpo,vpg,apg,dagger,gae}", "--vehicle {paper,", "--import FILE",
        "--memory {none,gru,raptor}",
    ):  # fmt: skip
        assert words in text, words
    assert "None}" not in text


@pytest.mark.parametrize(
    "words", [(), ("landing",), ("landing", "--algo=vpg", "--variant", "robust")]
)
def test_the_defaults_that_help_and_dry_run_show_are_those_of_the_training(capsys, words):
    assert command("train", *words, "--help") == 0
    text = " ".join(capsys.readouterr().out.replace("│", "").split())
    assert command("train", *words, "--dry-run") == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    used = {row[0]: row[1] for row in rows}
    for name in ("steps", "gamma", "num_envs", "vpg.learning_rate" if words[1:] else "ppo.beta2"):
        option = rf"--{name.replace('_', '-')} (?:INT|FLOAT) .*?\(default: (.*?)\)"
        assert re.findall(option, text) == [used[name]], name
    if words[1:]:
        assert ["vpg.learning_rate", "0.00074", "landing", "x", "vpg"] in rows
        assert ["gamma", "0.97", "variant", "robust"] in rows


def test_options_are_read_as_json_where_they_are():
    pairs = ("a=1", "b=2.5", "c=[1,[2,3]]", "d=true", "e=word", "f=x=y", "g=")
    assert parse_options(pairs) == {
        "a": 1, "b": 2.5, "c": (1, (2, 3)), "d": True, "e": "word", "f": "x=y", "g": "",
    }  # fmt: skip


@pytest.mark.slow
def test_train_writes_every_file(run):
    assert {p.name for p in run.iterdir()} == FILES | {"flight.mp4"}
    config = json.loads((run / "config.json").read_text())
    assert (config["task"], config["num_envs"], config["hidden"]) == ("hover", 8, [16])
    assert config["scenario"]["task_options"]["time_limit"] == 0.5
    assert [int(row["steps"]) for row in metrics(run)] == [32, 64, 96, 128, 160, 192]
    assert any(p.name.startswith("events.out.tfevents") for p in (run / "events").iterdir())
    evaluation = json.loads((run / "evaluation.json").read_text())
    assert METRICS < set(evaluation)
    assert evaluation["episodes"] == 2 and evaluation["training_s"] > 0
    policy = quadrl.Policy.load(run)
    # The best of the policies after each batch of 32.
    assert policy.metadata["steps"] in range(32, 193, 32) and policy.weights[0].shape == (16, 22)
    for name in ("learning_curve.png", "trajectory.png"):
        assert (run / name).read_bytes().startswith(b"\x89PNG")
    # States at 0.05 to 0.5 s are 10 frames at 20 a second, and the end is held for a second.
    assert imageio_ffmpeg.count_frames_and_secs(str(run / "flight.mp4"))[0] == 30


def test_a_run_has_a_folder_of_its_own_unless_one_is_given(monkeypatch):
    assert resolved(monkeypatch, "--seed", "3")[1] == Path("runs/hover-ppo-3")
    assert resolved(monkeypatch, "--out", "somewhere")[1] == Path("somewhere")


def test_the_result_comes_before_the_pictures_and_where_to_go_on_without_them(
    tmp_path, capsys, monkeypatch
):
    def skip(*_, **__):
        said = capsys.readouterr().out
        assert "100 %        192 steps" in said and "successful" in said
        raise KeyboardInterrupt

    monkeypatch.setattr("quadrl.learning.run.curve", skip)
    folder = tmp_path / "a folder" / "run"
    assert command("train", "hover", *TINY, "--out", folder) == 0
    assert not {"learning_curve.png", "flight.mp4"} & {*os.listdir(folder)}
    said = capsys.readouterr().out
    for words in (f"quadrl render '{folder}'", f"quadrl evaluate '{folder}'"):
        assert words in said  # on one line, however long


@pytest.mark.slow
def test_train_says_what_late_commands_do(tmp_path, capsys):
    # Nobody has learned anything in 192 steps; within two steps nobody falls, either.
    long = ("--task-options", "time_limit=0.04", "tolerance=9", "heading_tolerance=9")
    words = (*SIZE, *long, "--episodes", "2", "--no-video", "--out", tmp_path / "run")
    assert command("train", "hover", "--vehicle", "crazyflie", *words) == 0
    said = capsys.readouterr().out
    assert "successful with commands that act 10 ms later 100 %, 20 ms later 100 %\n" in said
    assert {p.name for p in (tmp_path / "run").iterdir()} == FILES
    recorded = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert recorded["success_rate_later"] == {"0.01": 1.0, "0.02": 1.0}


def test_evaluate_prints_one_json_object_and_nothing_else(run, capsys):
    printed = []
    for words in ((), (), ("--seed", "9"), ("--task-options", "time_limit=0.25", "radius=0.1")):
        assert command("evaluate", run, "--episodes", "2", "--json", *words) == 0
        said = capsys.readouterr()
        assert said.err == ""
        printed.append(json.loads(said.out))
    first, again, fresh, shorter = printed
    assert first == again  # the mean action, the same episodes
    assert METRICS < set(first) and all(np.isfinite(first[name]) for name in METRICS)
    assert first["episodes"] == 2 and first["task"] == "hover"
    assert first["length_mean_s"] <= 0.5  # the options of the training hold
    assert fresh["return_mean"] != first["return_mean"]
    assert shorter["length_mean_s"] == 0.25
    # That of the training is the same.
    assert first.items() <= json.loads((run / "evaluation.json").read_text()).items()
    assert command("evaluate", run / "policy.safetensors", "--episodes", "2") == 0
    assert "geometric controller" in capsys.readouterr().out


def test_render_writes_a_video_that_plays(run, tmp_path, capsys):
    path = tmp_path / "a.mp4"
    size = ["--width", "160", "--height", "120", "--fps", "20", "--camera", "chase"]
    assert command("render", run, "--out", path, *size) == 0
    assert capsys.readouterr().out.endswith(f"wrote {path}\n")  # after a bar, if it takes long
    # Ten of the flight, and a second of the outcome.
    assert imageio_ffmpeg.count_frames_and_secs(str(path)) == (30, 1.5)


@pytest.mark.slow
def test_json_is_printed_alone(capsys, tmp_path):
    words = ["--disturbances", "wind", "--no-recovery", "--episodes", "2", "--quiet", "--json"]
    flown = ["robustness", "--controller", "geometric", "--out", tmp_path / "card", *words]
    assert command(*flown) == 0
    printed = json.loads(capsys.readouterr().out)
    kept = json.loads((tmp_path / "card" / "robustness.json").read_text())
    assert printed.items() <= kept.items() and printed["axes"]["wind"]["flown"]


def test_quiet_prints_errors_alone(capsys):
    assert command("tasks", "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    assert command("tasks", "hovr", "--quiet") == 2
    assert "did you mean hover?" in capsys.readouterr().err
    assert command("tasks") == 0  # it holds for one command
    assert "hover" in capsys.readouterr().out


def test_plot(copy, capsys):
    before = (copy / "learning_curve.png").read_bytes()
    (copy / "learning_curve.png").unlink()
    assert command("plot", copy) == 0
    assert capsys.readouterr().out == f"wrote {copy / 'learning_curve.png'}\n"
    assert (copy / "learning_curve.png").read_bytes() == before
    assert command("plot", copy, "--out", copy / "curve.pdf") == 0
    assert (copy / "curve.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.slow
def test_plot_of_several_runs(run, tmp_path, capsys, refusal):
    folders = [tmp_path / name for name in ("a", "b", "c")]
    kinds = (("hover", "ppo"), ("hover", "vpg"), ("landing", "ppo"))
    for folder, (task, algo) in zip(folders, kinds, strict=True):
        shutil.copytree(run, folder)
        write_config(folder, read_config(folder) | {"task": task, "algo": algo})
    nothing = tmp_path / "no run"
    nothing.mkdir()
    assert command("plot", *folders, nothing, "--out", "curves.svg") == 0
    assert str(nothing) in capsys.readouterr().out  # it is left out, and said so
    for task, labels in (("hover", ("PPO, 1 seed", "VPG, 1 seed")), ("landing", ("PPO, 1 seed",))):
        picture = Path(f"curves_{task}.svg").read_text()
        assert all(label in picture for label in labels)
    Path("new").mkdir()
    assert command("plot", *folders[:2], "--out", "new/x.pdf") == 0
    assert command("plot", *folders, "--out", "new/x.png") == 0
    assert set(os.listdir("new")) == {"x.pdf", "x_hover.png", "x_landing.png"}
    refusal("plot")
    refusal("plot", nothing, tmp_path / "nowhere", printed=True)


def test_the_name_of_a_task_flies_the_policy_that_ships(capsys, refusal):
    short = ["--episodes", "5", "--json"]
    file = quadrl.evaluation.policy.SHIPPED / "hover_ppo.safetensors"
    shutil.copytree(
        quadrl.evaluation.policy.SHIPPED, "hover"
    )  # a folder of that name is written ./hover
    printed = []
    for policy in ("hover", file):
        assert command("evaluate", policy, *short) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1]
    refusal("evaluate", "./hover")
    refusal("evaluate", "./hover", "--algo", "ppo")
    assert refusal("evaluate", "hover", "--algo", "sac")[0].value == "hover_sac"
    assert command("evaluate", "static_waypoint", "--algo", "vpg", *short) == 0


def test_resume_takes_the_settings_of_the_run(run, copy, undrawn):
    for name in ("policy.safetensors", "checkpoint.safetensors", "metrics.csv"):
        (copy / name).unlink()
    assert command("train", "--resume", copy, "--no-video") == 0
    assert (copy / "policy.safetensors").read_bytes() == (run / "policy.safetensors").read_bytes()
    for words, episodes in (((), 2), (("--episodes", "3"), 3), ((), 3)):  # as many as it was given
        assert command("train", "--resume", copy, "--no-video", *words) == 0
        assert json.loads((copy / "evaluation.json").read_text())["episodes"] == episodes


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(tasks.TASKS))
def test_the_settings_that_are_shown_are_those_of_the_command(refusal, monkeypatch, name):
    """What `quadrl tasks` says that a task is trained with."""
    seen = {}

    def prepared(task, out, resume, settings):
        seen.update(settings)
        raise QuadrlError("enough")

    monkeypatch.setattr(cli.train, "prepare", prepared)
    own = own_settings(tasks.TASKS[name])
    refusal("train", name, *shlex.split(" ".join(written(own))))
    assert set(seen) == set(own)
    assert TrainConfig(name, **seen) == TrainConfig(name)


@pytest.mark.parametrize(
    ("words", "printed"),
    [
        ("--version", quadrl.__version__),
        ("", "quadrl train hover"),  # no words ask for help
        ("train hover --steps 1e6 --dry-run", "1000000"),
    ],
)
def test_what_is_asked_is_answered(capsys, words, printed):
    assert command(*words.split()) == 0
    assert printed in capsys.readouterr().out


def test_completion_knows_the_names(capsys):
    assert command("completion", "bash") == 0
    script = capsys.readouterr().out
    for words in (tasks.TASKS, VEHICLES, ("ppo", "gae"), ("geometric", "lqr"), ("chase",)):
        assert all(word in script for word in words)
    checked = subprocess.run(["bash", "-n"], input=script, text=True, capture_output=True)
    assert checked.returncode == 0, checked.stderr


def test_a_table_of_the_flights(tmp_path, capsys):
    path = tmp_path / "flights.csv"
    assert command("evaluate", "hover", "--episodes", "3", "--seed", "4", "--csv", path) == 0
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["seed"] for row in rows] == ["4", "5", "6"]
    alone = quadrl.evaluate("hover", episodes=1, seed=5)
    # A network rounds otherwise in a batch, which shows in what is nearly zero.
    for name in BEHAVIOUR:
        assert float(rows[1][name]) == pytest.approx(alone.metrics[name], rel=1e-4, abs=1e-6)
    assert float(rows[1]["return"]) == pytest.approx(alone.metrics["return_mean"], rel=1e-5)


def test_evaluations_in_wind_and_with_noise(capsys, refusal):
    drawn = {"mass": [0.9, 1.1], "noise": {"position": 0.01}}
    wind = ("--randomization", json.dumps(drawn), "--weather", '{"wind_speed": 2.0}')
    returns = []
    for words in ((), ("--weather", "light"), ("--sampled",), wind):
        assert command("evaluate", "hover", "--episodes", "3", "--json", *words) == 0
        returns.append(json.loads(capsys.readouterr().out)["return_mean"])
    assert len(set(returns)) == 4
    alone = quadrl.evaluate(
        "hover", episodes=3, randomization=drawn, weather=Weather(wind_speed=2.0)
    )
    assert returns[-1] == pytest.approx(alone.metrics["return_mean"], rel=1e-5)
    for text in ('{"mass": [0.9', '{"masses": 1}'):
        refused, _ = refusal("evaluate", "hover", "--randomization", text)
        assert "randomization" in refused.name


WORDS = '    "Largest distance from the waypoint at the start [m]."\n'
OWN = f"""
import dataclasses

import quadrl
from quadrl.tasks.hover import Hover


@quadrl.register
@dataclasses.dataclass(frozen=True)
class NearHover(Hover):
    name = "near_hover"
    training = {{"gamma": 0.25}}
    radius: float = 0.1
{WORDS}

quadrl.VEHICLES["heavy"] = dataclasses.replace(quadrl.Vehicle(), name="heavy", mass=0.8)
"""


NEAR_HOVER = "quadrl/NearHover-v0"
OWN_NAMES = (tasks.TASKS, "near_hover"), (VEHICLES, "heavy"), (gym.registry, NEAR_HOVER)


@pytest.mark.parametrize("first", [True, False])
def test_a_file_brings_in_tasks_and_aircraft(tmp_path, capsys, monkeypatch, first):
    for registry, name in OWN_NAMES:  # what it registers is taken out again
        monkeypatch.setitem(registry, name, None)
        monkeypatch.delitem(registry, name)
    Path("own.py").write_text(OWN)
    flown = ["--controller", "geometric", "--task", "near_hover", "--vehicle", "heavy"]
    words = ["evaluate", *flown, "--episodes", "2", "--json"]
    own = ["--import", "own.py"]
    assert command(*(own + words if first else words + own)) == 0
    judged = json.loads(capsys.readouterr().out)
    assert judged["task"] == "near_hover" and judged["success_rate"] == 1.0
    assert cli.console.again("tasks") == "quadrl --import own.py tasks"
    assert cli.console.again("render", Path("runs/x")) == "quadrl render runs/x"  # it knows
    assert TrainConfig("near_hover", vehicle="heavy").gamma == 0.25
    assert NEAR_HOVER in gym.registry


# --------------------------------------------------------------------------- what it refuses

REFUSED = {  # words, {run} for the folder of a run, and what the error is about
    "train hover --algo sac": "algo",
    "train hover --episodes 0": "episodes",
    "train hover --task-options time_limit": "task option",
    "train hover --device quantum": "device",
    "train hover --device meta": "device",
    "train --seeds 5:5": "seeds",
    "train --seeds 0:2 --seed 1": "--seed",
    "train --seeds 0:2 --resume {run}": "--resume",
    "train --resume {run} landing": "task",
    "train --resume {run} --ppo.clip 0.1": "ppo",
    "train --resume {run} --out elsewhere": "out",
    "train --resume {run} --steps 100": "steps",
    "train hovr": "task",
    "tasks hovr": "task",
    "evaluate {run} --task hovr": "task",
    "evaluate {run} --episodes 0": "episodes",
    "evaluate {run} --task-options x=1": "hover option",
    "evaluate {run} --controller lqr": None,
    "evaluate --controller pid": "controller",
    "evaluate --controller lqr --sampled": "sampled",
    "evaluate hover --weather windy": "weather",
    "evaluate": None,
    "evaluate nowhere": None,
    "render {run} --task hovr": "task",
    "render {run} --camera chse": "camera",
    "render {run} --width 161": "width",
    "render {run} --out a.avi": "path",
    "plot {run} --out a.xyz": "ending of a.xyz",
    "plot nowhere": None,
    "train --resume nowhere": None,
    "--import nowhere.py tasks": "--import",
}


@pytest.mark.slow
@pytest.mark.parametrize("words", REFUSED)
def test_what_cannot_be_is_refused_by_its_name_and_changes_nothing(refusal, run, tmp_path, words):
    before = contents(run)
    error, line = refusal(*(word.format(run=run) for word in words.split()))
    assert REFUSED[words] in (None, getattr(error, "name", None))
    assert "nowhere" not in words or "nowhere" in line
    assert "hovr" not in words or "hover" in error.allowed
    assert contents(run) == before and not list(tmp_path.iterdir())


MISTYPED = {
    "trian hover": "did you mean train?",
    "train hover --bogus": "--bogus is an unknown option; see quadrl train --help",
    "train hover --stepz 5": "did you mean --steps?",
    "train hover --learning-rate 1e-3": "(did you mean --ppo.learning-rate?); see",
    "train hover --learning_rate=1e-3": "(did you mean --ppo.learning-rate?); see",
    "train hover --lr 1e-3 --algo gae": "(did you mean --vpg.learning-rate?); see",
    "train race --lr 1e-3": "(did you mean --apg.learning-rate?); see",  # as it is trained
    "train hover --ppo.lr 1e-3": "(did you mean --ppo.learning-rate?); see",
    "train hover --epochs 3": "(did you mean --ppo.epochs?); see",
    "train hover --minibatch 64": "(did you mean --ppo.minibatch?); see",
    "train hover --batch-size 64": "(did you mean --ppo.minibatch?); see",
    "train hover --total-timesteps 9": "(did you mean --steps?); see",
    "train hover --eval-every 9": "(did you mean --evaluations?); see",
    "train hover --gpu": "(did you mean --device?); see",
    "train hover --run-name x": "(did you mean --out?); see",
    "train hover --load x": "(did you mean --from?); see",
    "train --env hover": "--env is an unknown option; the task comes first",
    "train hover --cfg x": "(did you mean --config?); see",
    "train hover --wandb": "--wandb is an unknown option (did you mean --log?)",
    "train hover --apg.learning-rate 0.1": "with algo ppo; did you mean ppo.learning_rate?",
    "train hover --seeds 0:2 --apg.step 0.1": "apg.step = 0.1: must be left out with algo ppo",
    "train hover --device gpu": "such as cpu, or cuda for a GPU of NVIDIA",
    "train hover --algo PPO": "(did you mean ppo?)",
    "train hover --algo sac": "Stable-Baselines3 has it",
    "train quadrl/Hover-v0": "(did you mean hover?)",
    "list": "(did you mean tasks?)",
    "new": "(did you mean new-task?)",
    "train hover --camera track": "not an option of quadrl train; commands with it: render; see",
    "benchmark --vehicle x": "not an option of quadrl benchmark; commands with it: check, evaluate",
    "completion tcsh": "shell = 'tcsh': must be one of bash, zsh, fish",
    "evaluate hover --task hovr": "(did you mean hover?), or one of a file that --import names",
    "robustness --controller lqr --control-mode velocity": "'rotor', the mode of this policy or",
    "evaluate hover --weather {": 'or JSON such as {"wind_speed": 5}; Expecting',
    "train hover landing": "landing is one word too many; see quadrl train --help",
    "train --steps many": "steps = 'many': must be a whole number",
    "train --steps 1.5": "steps = '1.5': must be a whole number",
    "train --gamma x": "gamma = 'x': must be a number",
    "train --hidden a b": "hidden = 'a', 'b': must be whole numbers",
    "evaluate hover --episodes": "--episodes needs a value; see quadrl evaluate --help",
    "evaluate hover --seed 1 --seed 2": "option = '--seed': must be given once",
    "evaluate hover --controller zero --controller random": "must be given once",
    "--quiet robustness hover --controller lqr --controller zero --seed 1 --seed 2": "'--seed'",
    "evaluate hover --task-options radius=1 radius=2": "radius = 'radius=2': must be given once",
    "study": "missing: PATH The study: a .toml or .json file",
    "--import": "--import needs a value; see quadrl --help",
}


@pytest.mark.slow
@pytest.mark.parametrize("words", MISTYPED)
def test_a_mistyped_command_is_answered_in_a_line(capsys, tmp_path, words):
    assert command(*words.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("quadrl: ") and MISTYPED[words] in line
    assert not list(tmp_path.iterdir())


def test_an_option_is_that_of_the_algorithm_that_an_own_task_is_trained_by(capsys, monkeypatch):
    for registry, name in OWN_NAMES:  # what it registers is taken out again
        monkeypatch.setitem(registry, name, None)
        monkeypatch.delitem(registry, name)
    Path("own.py").write_text(
        OWN.replace("    training =", "    trained_by = 'vpg'\n    training =")
    )
    assert command("train", "near_hover", "--import", "own.py", "--lr", "1e-3") == 2
    assert "(did you mean --vpg.learning-rate?)" in capsys.readouterr().err


def test_a_dry_run_says_what_was_given_and_steps_may_be_written_as_1e6(capsys):
    assert command("train", "hover", "--steps", "1e6", "--dry-run") == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["steps", "1000000", "given"] in rows and ["task", "hover", "given"] in rows
    assert ["observe", "-", "field"] in rows


def test_folders_that_cannot_be_used(refusal, copy, tmp_path):
    file = tmp_path / "file"
    file.write_text("something")
    _, line = refusal("train", "hover", *TINY, "--out", file / "run")
    assert str(file) in line and "--out" in line
    before = contents(copy)
    _, line = refusal("train", "hover", *TINY, "--out", copy)
    assert str(copy) in line and contents(copy) == before
    for words in (
        ("render", copy, "--out", file / "a.mp4"),
        ("plot", copy, "--out", file / "a.png"),
    ):
        assert str(file) in refusal(*words)[1]
    assert file.read_text() == "something"


@pytest.mark.parametrize(
    "words",
    [
        "evaluate {run} --csv new/a.csv",
        "evaluate {run} --states new/a.csv",
        "render {run} --out new/a.mp4",
        "render {run} --out new/a.png",
        "plot {run} --out new/a.pdf",
        "export hover --to onnx --out new/a.onnx",
        "export crazyflie --to mjcf --out new/a.xml",
    ],
)
def test_a_file_in_a_folder_that_is_none_is_refused_before_the_work(
    refusal, run, tmp_path, monkeypatch, words
):
    for work in ("evaluate.evaluate", "render.render"):
        monkeypatch.delattr(f"quadrl.cli.{work}")
    _, line = refusal(*(word.format(run=run) for word in words.split()))
    assert f"{Path(words.split()[-1])} cannot be written: there is no folder new" in line
    assert not list(tmp_path.iterdir())


BEGIN = """    def begin(self, rng, parameters):
        return super().begin(rng, parameters)[0]

"""
BROKEN = {
    "a word that is none": ("import quadrl\n\nx = quadrl.nothing\n", 3),
    "no Python": ("import quadrl\ndef f(:\n", 2),
    "a start without a state": (
        OWN.replace("    radius", BEGIN + "    radius"),
        8,
    ),
    "an option without words": (OWN.replace("radius", "near").replace(WORDS, ""), 8),
    "an unknown setting of a training": (OWN.replace("gamma", "gama"), 8),
    "a name with a space": (OWN.replace("near_hover", "near hover"), 8),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_file_that_breaks_a_rule(refusal, monkeypatch, case):
    for registry, name in OWN_NAMES:
        monkeypatch.setitem(registry, name, None)
        monkeypatch.delitem(registry, name)
    text, line = BROKEN[case]
    Path("own.py").write_text(text)
    assert f"own.py, line {line}: " in refusal("tasks", "--import", "own.py")[1]


def test_the_tasks_of_a_file_are_checked_in_their_order(monkeypatch):
    names = [f"task_{letter}" for letter in "ebdac"]
    for name in names:
        monkeypatch.setitem(tasks.TASKS, name, None)
        monkeypatch.delitem(tasks.TASKS, name)
    checked = []
    monkeypatch.setattr("quadrl.core.record.check_rules", lambda kind: checked.append(kind.name))
    classes = (f"class {name.upper()}(Hover):\n    name = {name!r}\n" for name in names)
    begin = "from quadrl.tasks import register\nfrom quadrl.tasks.hover import Hover\n"
    Path("own.py").write_text(begin + "".join(f"@register\n{kind}" for kind in classes))
    assert command("--import", "own.py", "tasks", "hover") == 0
    assert checked == names


@pytest.mark.slow
def test_output_that_nobody_reads_ends_quietly():
    words = f"{shlex.quote(sys.executable)} -m quadrl completion | true"
    done = subprocess.run(["bash", "-c", words], capture_output=True, text=True)
    assert done.stderr == ""


def test_a_disk_that_fills_up(capsys, tmp_path, monkeypatch, undrawn):
    def full(*_):
        raise OSError(28, "No space left on device", str(tmp_path / "run" / "checkpoint"))

    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr("quadrl.learning.checkpoint.write_safetensors", full)
        assert command("train", "hover", *TINY, "--no-video", "--out", folder) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "No space left on device" in line and f"quadrl train --resume {folder}" in line
    assert command("train", "--resume", folder, "--no-video", "--episodes", "2") == 0


def test_a_warning_of_quadrl_is_one_line(capsys, monkeypatch):
    def warn(name):
        warnings.warn("half of it is missing", QuadrlWarning, stacklevel=2)
        warnings.warn("half of it is missing", QuadrlWarning, stacklevel=1)  # from another place
        warnings.warn("another library's", FutureWarning, stacklevel=2)

    monkeypatch.setattr("quadrl.cli.evaluate.Evaluate.run", warn)
    with pytest.warns(FutureWarning, match="another library's"):
        assert command("evaluate", "hover") == 0
    assert capsys.readouterr().err == "quadrl: warning: half of it is missing\n"
