"""What the policy of a training reaches along the way."""

import json
import sys

import numpy as np
import pytest
import torch
from helpers import refused
from runs import Stop, assert_same_run, changed, metrics
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.metadata import EXPERIMENT_TAG as EXPERIMENT
from tensorboard.plugins.hparams.metadata import SESSION_START_INFO_TAG as SESSION
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

import quadrl
from quadrl.base.extras import MissingLibrary
from quadrl.evaluation.rollout import EVALUATION_SEED, MAX_SEED, fly, summarize
from quadrl.learning import checkpoint, evaluations
from quadrl.learning.config import prepare
from quadrl.learning.environments import SEED_STRIDE
from quadrl.learning.run import train_in


def rows(folder):
    return metrics(folder, "evaluations.csv")


def trained(folder, *, last=None, resume=False, **settings):
    def show(progress):
        if progress.iteration == last:
            raise Stop

    given = {"resume": resume, "show": show}
    return train_in(folder, changed(episodes=2, **settings), **given)


@pytest.fixture
def one_by_one(monkeypatch):
    """Evaluations are flown when they are due, and not together with later ones."""
    monkeypatch.setattr(evaluations, "APART", 1)


@pytest.mark.slow
@pytest.mark.parametrize("memory", ["none", "gru"])
def test_policies_are_evaluated_along_the_way_and_end_as_without(tmp_path, memory):
    alone = trained(tmp_path / "alone", memory=memory)
    seen = trained(tmp_path / "seen", evaluations=3, memory=memory, keep="last")
    assert_same_run(alone.folder, seen.folder)
    assert not (alone.folder / "evaluations.csv").exists()
    found = rows(seen.folder)
    assert [int(row["steps"]) for row in found] == [64, 128, 192]  # of 6 batches of 32
    assert found[0]["error"] != found[-1]["error"]
    flown = {"episodes": int(found[-1]["episodes"]), "seed": evaluations.SEED}
    last = summarize(fly(seen.policy, engine="free_flight", **flown))
    for name, metric in evaluations.FIGURES.items():
        np.testing.assert_allclose(float(found[-1][name]), last[metric], rtol=1e-6)


def test_their_episodes_are_neither_of_trainings_nor_of_the_evaluation_at_the_end():
    assert (MAX_SEED + 1) * SEED_STRIDE <= evaluations.SEED
    assert evaluations.SEED + evaluations.EPISODES[1] <= EVALUATION_SEED


def test_policies_reach_together_what_they_reach_alone(tmp_path, monkeypatch):
    together = trained(tmp_path / "together", evaluations=6, checkpoint_seconds=60.0)
    monkeypatch.setattr(evaluations, "APART", 1)
    alone = trained(tmp_path / "alone", evaluations=6)
    assert rows(together.folder) == rows(alone.folder) and len(rows(alone.folder)) == 6


def test_rows_after_the_checkpoint_are_made_again(tmp_path, one_by_one):
    whole = trained(tmp_path / "whole", evaluations=6)
    with pytest.raises(Stop):  # before the checkpoint of its last iteration
        trained(tmp_path / "run", evaluations=6, last=4)
    assert len(rows(tmp_path / "run")) == 4
    again = trained(tmp_path / "run", evaluations=6, resume=True)
    assert rows(again.folder) == rows(whole.folder) and len(rows(whole.folder)) == 6


def best_of(folder):
    """Steps of the row with the highest success, then the lowest error, then the latest."""
    found = [(float(x["success"]), -float(x["error"]), int(x["steps"])) for x in rows(folder)]
    return max(found)[2]


# With a high rate the last policy is not the best one.
UNSTEADY = {"evaluations": 6, "ppo": {"learning_rate": 0.1, "epochs": 2, "minibatch": 16}}


@pytest.mark.slow
def test_the_best_policy_is_kept_also_by_a_run_that_was_stopped(tmp_path):
    whole = trained(tmp_path / "whole", **UNSTEADY)
    best = best_of(whole.folder)
    assert whole.policy.metadata["steps"] == best < 192
    assert f"after {best} control steps, the best" in whole.kept
    last = trained(tmp_path / "last", keep="last", **UNSTEADY)
    assert last.policy.metadata["steps"] == 192 and last.kept.endswith(
        "192 control steps, the last"
    )
    one, other = (folder / "checkpoint.safetensors" for folder in (whole.folder, last.folder))
    found, expected = (checkpoint.load(path)[0]["actor"] for path in (one, other))
    assert found.keys() == expected.keys()  # to resume from
    assert all(torch.equal(found[name], expected[name]) for name in found)
    for after in (best // 32 + 1, 6):  # batches of 32; before the checkpoint of the last one
        folder = tmp_path / f"stopped{after}"
        with pytest.raises(Stop):
            trained(folder, last=after, **UNSTEADY)
        again = trained(folder, resume=True, **UNSTEADY)
        assert_same_run(again.folder, whole.folder)
        assert rows(again.folder) == rows(whole.folder)


def test_a_training_ends_where_an_evaluation_reaches_what_is_asked(tmp_path):
    whole = trained(tmp_path / "whole", **UNSTEADY)
    asked = {"error": float(rows(whole.folder)[2]["error"]), "survival": 0.0}
    first = next(k for k, x in enumerate(rows(whole.folder)) if float(x["error"]) <= asked["error"])
    run = trained(tmp_path / "run", until=asked, **UNSTEADY)
    assert rows(run.folder) == rows(whole.folder)[: first + 1]
    assert len(metrics(run.folder)) == first + 1
    again = trained(tmp_path / "run", resume=True, until=asked, **UNSTEADY)
    assert_same_run(again.folder, run.folder)
    assert len(metrics(again.folder)) == first + 1
    config, _ = prepare(None, None, run.folder, {"steps": 192})  # as `--resume RUN --steps 192`
    further = train_in(run.folder, config, resume=True, show=lambda progress: None)
    assert_same_run(further.folder, whole.folder)


def test_tensorboard_has_the_evaluations_the_ends_and_the_settings(tmp_path):
    run = trained(tmp_path / "run", evaluations=3, keep="last")
    events = EventAccumulator(str(run.folder / "events")).Reload()
    found, every = rows(run.folder), metrics(run.folder)
    for name, metric in evaluations.FIGURES.items():
        shown = events.Scalars(f"eval/{metric}")
        assert [one.step for one in shown] == [2, 4, 6]
        np.testing.assert_allclose([x.value for x in shown], [float(x[name]) for x in found], 1e-6)
    for name in ("reward/progress", "reward/survival", "end/away", "end/time_limit", "return"):
        written = [float(row[name]) for row in every if row[name]]  # no episode ends in some
        np.testing.assert_allclose([x.value for x in events.Scalars(name)], written, rtol=1e-4)
    assert len(events.Scalars("steps_per_second")) == 5  # from the second batch on
    shown = HParamsPluginData.FromString(events.SummaryMetadata(EXPERIMENT).plugin_data.content)
    named = {one.name.tag for one in shown.experiment.metric_infos}
    assert named == {"eval/success_rate", "steps_per_second"}
    content = HParamsPluginData.FromString(events.SummaryMetadata(SESSION).plugin_data.content)
    settings = content.session_start_info.hparams
    assert settings["ppo.epochs"].number_value == 2 and settings["task"].string_value == "hover"


def test_numbered_policies_are_kept_and_loaded(tmp_path):
    run = trained(tmp_path / "run", checkpoint_every=64)
    names = [f"policy_{steps:09}.safetensors" for steps in (64, 128, 192)]
    assert [path.name for path in sorted(run.folder.glob("policy_*"))] == names
    loaded = [quadrl.Policy.load(run.folder / name) for name in names]
    assert [policy.metadata["steps"] for policy in loaded] == [64, 128, 192]
    np.testing.assert_array_equal(loaded[-1].weights[0], run.policy.weights[0])
    assert (loaded[0].weights[0] != loaded[1].weights[0]).any()


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"until": {"succes": 1.0}}, "until"),
        ({"until": {"success": "all"}}, "until success"),
        ({"until": {"success": 0.9}, "evaluations": 0}, "until"),
        ({"evaluations": 11}, "evaluations"),  # of 6 batches
        ({"checkpoint_every": 193}, "checkpoint_every"),
        ({"keep": "first"}, "keep"),
    ],
)
def test_what_cannot_be_evaluated_or_kept_is_refused(settings, name):
    with refused(name):
        changed(**{"evaluations": 6} | settings)


def shown_offline(folder):
    """The figures by name and iteration, names and settings in W&B's files of a run.

    A file is a head of 7 bytes and blocks of 32 kB with parts of records: checksum, length (2),
    kind (1: 1 whole, 2 first, 3 middle, 4 last) and content.
    """
    records = pytest.importorskip("wandb.proto.wandb_internal_pb2")
    figures, names, settings = {}, [], {}
    for path in sorted(folder.glob("wandb/offline-run-*/*.wandb")):
        content, at, whole = path.read_bytes(), 7, b""
        while at + 7 <= len(content):
            if 32768 - at % 32768 < 7:
                at += 32768 - at % 32768
                continue
            length, kind = int.from_bytes(content[at + 4 : at + 6], "little"), content[at + 6]
            whole += content[at + 7 : at + 7 + length]
            at += 7 + length
            if kind in (1, 4):
                record, whole = records.Record.FromString(whole), b""
                names += [(record.run.display_name, record.run.run_id)] * record.HasField("run")
                settings |= {x.key: json.loads(x.value_json) for x in record.run.config.update}
                row = {
                    x.key or ".".join(x.nested_key): json.loads(x.value_json)
                    for x in record.history.item
                }
                for name in row:
                    figures[name, row["iteration"]] = row[name]
    return figures, names, settings


@pytest.mark.slow
def test_wandb_has_what_tensorboard_has_also_of_a_run_that_goes_on(tmp_path, monkeypatch):
    pytest.importorskip("wandb").teardown()  # it reads the environment once in a process
    monkeypatch.setenv("WANDB_MODE", "offline")
    settings = {"evaluations": 3, "keep": "last", "log": "wandb"}
    with pytest.raises(Stop):
        trained(tmp_path / "run", last=4, **settings)
    run = trained(tmp_path / "run", resume=True, **settings)
    figures, names, config = shown_offline(run.folder)
    events = EventAccumulator(str(run.folder / "events")).Reload()
    expected = {
        (name, one.step): one.value
        for name in events.Tags()["scalars"]
        for one in events.Scalars(name)
    }
    found = {key: x for key, x in figures.items() if key in expected}
    assert len(expected) > 60 and found == pytest.approx(expected, rel=1e-6, nan_ok=True)
    assert {name for name, _ in figures} - {name for name, _ in expected} <= {
        "iteration", "_step", "_runtime", "_timestamp"
    }  # fmt: skip
    assert len(names) == 2 and len({*names}) == 1 and names[0][0] == "run"
    assert config["ppo.epochs"] == 2 and config["task"] == "hover"


def test_where_wandb_is_missing_a_line_says_so_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(MissingLibrary, match=r"needs wandb: .* install 'quadrl\[wandb\]'"):
        trained(tmp_path / "run", log="wandb")
    assert not (tmp_path / "run").exists()


def test_without_an_account_wandb_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    wandb.teardown()  # it reads the environment once in a process
    monkeypatch.setenv("WANDB_MODE", "online")
    monkeypatch.setenv("HOME", str(tmp_path))  # where it looks for a key
    monkeypatch.setenv("NETRC", str(tmp_path / "none"))
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    with refused(match="W&B cannot be used: .*With WANDB_MODE=offline it needs no account"):
        trained(tmp_path / "run", log="wandb")
    assert not (tmp_path / "run").exists()
