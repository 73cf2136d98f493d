"""Studies: what a file expands to or is refused for, and what follows when trainings die."""

import json
from pathlib import Path

import pytest
from helpers import refused

import quadrl
from quadrl.base.files import write_json
from quadrl.base.philox import seeds
from quadrl.cli.console import console
from quadrl.cli.study import carry_out
from quadrl.learning import executor
from quadrl.learning.config import TrainConfig
from quadrl.learning.executor import End, PlannedRun, train_all
from quadrl.learning.folder import EVALUATION, write_config
from quadrl.learning.plan import read_plan
from quadrl.learning.study import FIGURES, StudyResult, interval

STUDY = """
tasks = ["hover", "landing"]
algorithms = ["ppo", "gae"]
seeds = "3:5"
episodes = 7

[settings]
steps = 4096
ppo = {epochs = 2}

[[variants]]
name = "narrow"

[[variants]]
name = "wide"
hidden = [256]
ppo = {minibatch = 64}
"""


@pytest.fixture
def write(tmp_path):
    def written(text, name="study.toml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return written


def test_every_combination_is_planned(write, tmp_path):
    plan = read_plan(write(STUDY), tmp_path / "out")
    assert len(plan.runs) == 2 * 2 * 2 * 2 and {run.config.episodes for run in plan.runs} == {7}
    names = [run.name for run in plan.runs]
    assert names[:2] == ["hover-ppo-narrow-3", "hover-ppo-wide-3"] and len(set(names)) == 16
    wide = next(run for run in plan.runs if run.name == "landing-ppo-wide-4")
    ppo = {"epochs": 2, "minibatch": 64}
    alone = TrainConfig(
        "landing", seed=4, steps=4096, hidden=(256,), ppo=ppo, num_threads=1, episodes=7
    )
    assert wide.config == alone and wide.folder == tmp_path / "out" / "landing-ppo-wide-4"


def test_a_table_serves_the_algorithms_that_it_is_for(write):
    both = {"ppo": {"epochs": 2}, "vpg": {"critic_epochs": 3}}
    content = {"tasks": ["hover"], "algorithms": ["ppo", "gae"], "settings": both}
    first, second = (run.config for run in read_plan(content, None).runs)
    assert first.ppo.epochs == 2 and second.vpg.critic_epochs == 3
    content["only"] = [{"algorithms": ["gae"], "ppo": {"epochs": 4}}]  # it would do nothing
    with refused(match="the study: hover-gae-0: ppo.epochs = 4: must be left out with algo vpg"):
        read_plan(content, None)


def test_json_and_a_dict_are_the_same(write):
    content = {"tasks": ["hover"], "settings": {"hidden": [8]}}
    (file,), (given,) = (
        read_plan(one, None).runs for one in (write(json.dumps(content), "one.json"), content)
    )
    assert str(file.folder) == "runs/one/hover-ppo-0" and file.config == given.config


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("tasks =", "task ="), "did you mean tasks"),
        (('tasks = ["hover", "landing"]', ""), "tasks is missing"),
        (('"hover", "landing"', '"hower"'), "did you mean hover"),
        (('"hover", "landing"', ""), "tasks = .*a list of different names"),
        (('"hover", "landing"', '"hover", "hover"'), "different names"),
        (('"ppo", "gae"', '"ppo", "gae", "vpg"'), "hover-gae-narrow-3 and hover-vpg-narrow-3"),
        (("3:5", "5:5"), "seeds = '5:5'"),
        (("episodes = 7", "episodes = 0"), "episodes = 0"),
        (("steps = 4096", "step = 4096"), "setting in settings = 'step'"),
        (("steps = 4096", "lr = 1e-3"), "did you mean ppo.learning_rate"),
        (("steps = 4096", "apg = {epochs = 3}"), "hover-ppo-narrow-3: apg.epochs = 3: .*left out"),
        (("steps = 4096", "seed = 4"), r"settings.seed = 4: must be the key seeds"),
        (("steps = 4096", "num_threads = 4"), "settings.num_threads"),
        (("steps = 4096", "episodes = 4"), "settings.episodes = 4: must be the key episodes"),
        (("hidden = [256]", "hiden = [256]"), "setting in variants.wide = 'hiden'"),
        (("hidden = [256]", "hidden = [0]"), "hover-ppo-wide-3: width of a hidden layer = 0"),
        (("epochs = 2", "epoch = 2"), "hover-ppo-narrow-3: .*epoch"),
        (('"wide"', '"narrow"'), "variants.name = 'narrow': must be a name of its own"),
        (('"wide"', '"../up"'), "variants.name"),
        (("hidden = [256]\nppo = {minibatch = 64}", ""), "have the same settings"),
        (("[settings]", "[settings"), "is not TOML"),
    ],
)
def test_a_wrong_file_is_refused_with_its_name_and_the_key(write, change, said):
    assert change[0] in STUDY
    file = write(STUDY.replace(*change))
    with refused(match=said) as caught:
        quadrl.study(file)
    assert str(caught.value).startswith(str(file))


def test_other_files_are_refused(tmp_path, write):
    for path, said in (
        (tmp_path / "none.toml", "No such file"),
        (write("", "study.yaml"), ".toml or a .json"),
        (write("[1]", "list.json"), "must hold a table"),
        (write("{", "half.json"), "is not JSON"),
    ):
        with refused(match=said):
            read_plan(path, None)


def test_a_run_with_other_settings_stops_the_study_before_it_begins(tmp_path):
    folder = tmp_path / "hover-ppo-1"
    folder.mkdir()
    write_config(folder, TrainConfig("hover", seed=1, steps=64).resolved())
    with refused(match="hover-ppo-1 holds a run with other settings"):
        quadrl.study({"tasks": ["hover"], "seeds": [0, 1]}, out=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["hover-ppo-1"]


WRONG = ["", "a", "1,1", "2:2", "5:1", "1:2:3", "-1:2", "0:99999999999999999999", "8"]


@pytest.mark.parametrize("given", [*WRONG, [], [0.5], [True], 3])
def test_wrong_seeds(given):
    with refused(match="seeds"):
        seeds(given, largest=7)


def test_seeds():
    assert seeds("3,5,8", 8) == seeds([3, 5, 8], 8) == [3, 5, 8]
    assert seeds("2:4", 8) == [2, 3]


def test_intervals_by_hand():
    # Three seeds: t is 4.303, the deviation 1, so half of the interval is 4.303 / sqrt(3) = 2.484.
    mean, low, high = interval([1.0, 2.0, 3.0], low=0.0)
    assert (mean, low) == (2.0, 0.0) and high == pytest.approx(2 + 2.484, abs=1e-3)
    assert interval([0.5]) == (0.5, None, None)
    assert interval([None, float("nan")]) == (None, None, None)


def test_the_file_on_the_page(write):
    page = (Path(__file__).parents[2] / "docs" / "studies.md").read_text()
    plan = read_plan(write(page.partition("```toml\n")[2].partition("```")[0]), None)
    assert len(plan.runs) == 40 and {run.config.seed for run in plan.runs[:8]} == {0}


DIED, WRONG_END, DONE = End("its machine was lost", lost=True), End("it diverged"), End()


class Pretended:
    """One at a time; `ends` has what becomes of each training, begin by begin."""

    def __init__(self, **ends):
        self.ends, self.begun = ends, []

    def slots(self):
        return 1

    def begin(self, run):
        self.begun.append(run.name)
        self.run = run
        return self

    def poll(self):
        end = self.ends[self.run.name].pop(0)
        if end == DONE:
            self.run.folder.mkdir(exist_ok=True)
            write_config(self.run.folder, self.run.config.resolved())
            write_json(self.run.folder / EVALUATION, {})
        return end


@pytest.mark.parametrize(
    ("ends", "begun", "failed"),
    [
        ({"one": [DIED, DIED, DONE], "two": [DONE]}, ["one", "one", "one", "two"], {}),
        ({"one": [DIED] * 3}, ["one"] * 3, {"one": "its machine was lost (see "}),
        ({"one": [WRONG_END], "two": [DONE]}, ["one", "two"], {"one": "it diverged (see "}),
        ({"one": [None, None, DONE]}, ["one"], {}),
    ],
    ids=["twice lost", "given up", "a fault of its own", "it takes a while"],
)
def test_what_follows_the_end_of_a_training(tmp_path, monkeypatch, ends, begun, failed):
    monkeypatch.setattr(executor, "POLL_SECONDS", 0.0)
    runs = [
        PlannedRun(TrainConfig("hover", seed=k), tmp_path / name) for k, name in enumerate(ends)
    ]
    pretended, lines = Pretended(**ends), []
    found = train_all(runs, pretended, lines.append)
    assert pretended.begun == begun and found.keys() == failed.keys()
    assert all(found[name].startswith(words) for name, words in failed.items())
    attempts = [line for line in lines if "attempt" in line]
    assert len(attempts) == len(begun) - len(runs)
    assert len(runs) == sum(run.done for run in runs) + len(failed)


def test_settings_of_some_tasks_and_algorithms_alone():
    only = [
        {"tasks": ["landing"], "steps": 8192},
        {"tasks": ["landing"], "algorithms": ["vpg"], "num_envs": 32},
    ]
    given = {"tasks": ["hover", "landing"], "algorithms": ["ppo", "vpg"]}
    usual, changed = (read_plan(given | more, None).runs for more in ({}, {"only": only}))
    usual, changed = ({run.name: run.config for run in runs} for runs in (usual, changed))
    assert [name for name in usual if usual[name] != changed[name]] == [
        "landing-ppo-0",
        "landing-vpg-0",
    ]
    ppo, vpg = changed["landing-ppo-0"], changed["landing-vpg-0"]
    assert ppo.steps == vpg.steps == 8192 and vpg.num_envs == 32
    assert ppo.num_envs == usual["landing-ppo-0"].num_envs


@pytest.mark.parametrize(
    ("only", "said"),
    [
        (3, r"only = 3: must be a list of tables: \[\[only\]\]"),
        ([{"tasks": ["lading"]}], "only.tasks = 'lading': must be one of hover"),
        ([{"algorithms": ["trpo"]}], "only.algorithms = 'trpo': must be one of ppo"),
        ([{"algorithms": "ppo"}], "only.algorithms = 'ppo': must be a list"),
        ([{"num_env": 32}], "setting in only = 'num_env'"),
        ([{"seed": 1}], "only.seed = 1: must be the key seeds"),
    ],
)
def test_wrong_settings_of_some(only, said):
    with refused(match=said):
        read_plan({"tasks": ["hover"], "algorithms": ["ppo"], "only": only}, None)


@pytest.mark.parametrize("columns", [80, 220])
def test_the_table_fits_the_terminal(monkeypatch, capsys, columns):
    figures = {name: 0.0123 for name in FIGURES}
    spread = {f"{name}_{end}": 0.0123 for name in FIGURES for end in ("low", "high")}
    row = {"task": "straight_and_level", "algo": "trpo", "variant": "", "seeds": 3}
    found = StudyResult(Path("runs/x"), (), (row | figures | spread,) * 2, {})
    monkeypatch.setattr("quadrl.learning.study.study", lambda *what, **how: found)
    monkeypatch.setattr(console, "_width", columns)
    carry_out({})
    _, head, *rows = capsys.readouterr().out.splitlines()
    assert len(head) <= columns and head.split()[-1] == "training" and "variant" not in head
    assert rows[0] == rows[1] and rows[0].startswith("straight_and_level  trpo      3")
    assert ("along the training" in head) == (columns == 220)
    assert ("1 % (1 % to 1 %)" in rows[0]) == (columns == 220)  # a row is a line
