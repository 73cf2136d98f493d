"""Several runs: listed, compared, and begun with the settings of another."""

import json
import os
import time

import pytest
from helpers import refused
from runs import changed

import quadrl
from quadrl import cli
from quadrl.cli.console import console, make_table
from quadrl.evaluation import plotting
from quadrl.learning.config import TrainConfig
from quadrl.learning.run import train_in


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with two runs of hover, and one of landing that was stopped before its end."""
    whole = tmp_path_factory.mktemp("runs")
    for seed in (0, 1):
        config = changed(seed=seed, episodes=2)
        train_in(whole / f"hover{seed}", config, resume=False, show=lambda progress: None)
    config = changed(task="landing", seed=7, episodes=2)
    train_in(whole / "deep" / "landing", config, resume=False, show=lambda progress: None)
    (whole / "deep" / "landing" / "evaluation.json").unlink()
    return whole


def printed(capsys, *words):
    cli.main([*map(str, words)])
    return capsys.readouterr().out.splitlines()


def test_the_runs_of_a_folder_are_listed_the_newest_last(folder, capsys, monkeypatch):
    monkeypatch.setattr(console, "width", 80)  # what COLUMNS says counts only when it is made
    old = folder / "hover1" / "config.json"
    os.utime(old, (time.time() - 3 * 86_400 - 5,) * 2)
    (folder / "broken").mkdir()
    (folder / "broken" / "config.json").write_text("{}")
    left, where, head, *rows = printed(capsys, "runs", folder)
    assert left.startswith("left out: ") and "broken" in left and where == f"in {folder}"
    assert head.split() == ["run", "task", "algo", "seed", "success", "age"]
    cells = [row.split() for row in rows]
    assert [row[0] for row in cells] == ["hover1", "hover0", "deep/landing"]
    assert [row[1:4] for row in cells] == [
        ["hover", "ppo", "1"], ["hover", "ppo", "0"], ["landing", "ppo", "7"]
    ]  # fmt: skip
    assert cells[0][-2:] == ["3", "d"] and cells[2][4:6] == ["none", "yet"]
    success = json.loads((folder / "hover0" / "evaluation.json").read_text())["success_rate"]
    assert cells[1][4] == f"{100 * success:.0f}"
    with refused(match="there is no run in"):
        cli.parse(["runs", str(folder / "nothing")]).command.run()


LONG = "a_study_of_many_settings/straight_and_level/straight_and_level-trpo-robust-17"


def test_a_long_name_is_folded_and_no_column_left_out(capsys, monkeypatch):
    monkeypatch.setattr(console, "width", 80)
    rows = [("run", "task", "success", "age"), (LONG, "straight_and_level", "none yet", "24 min")]
    console.print(make_table(rows, 2))
    head, first, second, *rest = (line.rstrip() for line in capsys.readouterr().out.splitlines())
    assert max(map(len, (head, first, second))) <= 80 and rest == []
    assert first.split()[1:] == ["straight_and_level", "none", "yet", "24", "min"]
    assert first.split()[0] + second == LONG


def test_several_runs_are_evaluated_in_one_table_as_each_alone(folder, capsys):
    two = [folder / "hover0", folder / "hover1"]
    (whole,) = printed(capsys, "evaluate", *two, "--episodes", 3, "--json")
    for run in two:
        (alone,) = printed(capsys, "evaluate", run, "--episodes", 3, "--json")
        assert json.loads(whole)[str(run)] == json.loads(alone)
    head, *rows, said = printed(capsys, "evaluate", *two, "--episodes", 3)
    assert head.split()[:2] == ["policy", "successful"] and len(rows) >= 2
    assert said == "3 episodes of hover each, the same for all"
    with refused("task", "hover, landing"):
        cli.parse(["evaluate", *map(str, two), str(folder / "deep" / "landing")]).command.run()
    with refused("file", "flights.csv"):
        cli.parse(["evaluate", *map(str, two), "--csv", "flights.csv"]).command.run()


def test_a_training_begins_with_the_settings_of_a_file_and_those_given_on_top(folder, tmp_path):
    first = folder / "hover0"
    (tmp_path / "own.toml").write_text('task = "landing"\nseed = 5\nppo = { epochs = 3 }\n')
    own = TrainConfig("landing", seed=5, steps=8192, ppo={"epochs": 3})
    once = changed(episodes=2, ppo={"epochs": 1, "minibatch": 16})
    for file, given, expected in (
        (first / "config.json", ["--seed", "9"], changed(episodes=2, seed=9)),
        (first / "config.json", ["--ppo.epochs", "1"], once),
        ("own.toml", ["--steps", "8192"], own),
    ):
        words = ["train", "--config", str(file), *given]
        assert cli.parse(words).command.prepared()[0] == expected


def test_a_name_is_a_folder_in_runs():
    _, out = cli.parse(["train", "hover", "--name", "mine"]).command.prepared()
    assert str(out) == "runs/mine"
    with refused("--name", "mine"):
        cli.parse(["train", "--name", "mine", "--out", "there"]).command.prepared()


OLD = "format of old/config.json = 'quadrl-run-1': must be quadrl-run-2; another version of quadrl "
BAD = {
    "train hover --steps 8192 --evaluations 400": "evaluations = 400: must be at most 2, one after",
    "train hover --steps 8192 --checkpoint-every 8193": "checkpoint_every = 8193: must be a whole",
    "train --config old/config.json": OLD,
    "train --resume old": OLD,
    "plot old": OLD,
    "evaluate hover0 deep/landing": "task = 'hover, landing': must be one for all in a table: give",
    "evaluate hover landing": "task = 'hover, landing': must be one for all in a table: give",
}


@pytest.mark.slow
@pytest.mark.parametrize("words", BAD)
def test_bad_input_is_answered_in_a_line_and_changes_nothing(folder, capsys, monkeypatch, words):
    (folder / "old").mkdir(exist_ok=True)
    was = (folder / "hover0" / "config.json").read_text()
    (folder / "old" / "config.json").write_text(was.replace("quadrl-run-2", "quadrl-run-1"))
    monkeypatch.chdir(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    with pytest.raises(SystemExit) as end:
        cli.main(words.split())
    out, err = capsys.readouterr()
    assert end.value.code == 2 and out == ""
    assert err.startswith(f"quadrl: {BAD[words]}") and err.count("\n") == 1
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


def test_runs_of_different_tasks_are_no_picture_together(folder):
    with refused(match="task = .*'hover', 'landing'.*: must be one for all runs of a picture"):
        quadrl.plot(folder / "hover0", folder / "deep" / "landing")


@pytest.mark.slow
def test_a_curve_of_another_program_is_drawn_beside_a_run(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    csv, bad = tmp_path / "SB3.csv", tmp_path / "bad.csv"
    csv.write_text("steps,success\n0,0\n200,0.5\n")
    bad.write_text("steps,loss\n0,0\n")
    drawn = []
    curves = plotting.learning_curves
    monkeypatch.setattr(plotting, "learning_curves", lambda *a: drawn.append(a) or curves(*a))
    said = printed(capsys, "plot", folder / "hover0", csv, bad)
    assert said[0].startswith("left out: ") and "bad.csv has no column of success" in said[0]
    assert said[1:] == ["wrote learning_curves_hover.png"]
    assert printed(capsys, "plot", csv) == ["wrote learning_curves_others.png"]
    groups, title, _ = drawn[0]
    assert [*groups] == ["ppo", "SB3"] and title == "hover, sampled actions of the runs"
    assert quadrl.plot(folder / "hover0", csv).kind == "png"
