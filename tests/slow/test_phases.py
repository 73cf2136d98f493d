"""Trainings in turn as one run."""

import contextlib
import json

import numpy as np
import pytest
from runs import TINY, Stop, assert_same_run, changed

import quadrl
from quadrl.base.errors import QuadrlError
from quadrl.evaluation.policy import Policy
from quadrl.learning import phases
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import read_metrics
from quadrl.learning.run import train_in
from quadrl.learning.show import curve

FIRST = {"algo": "apg", "steps": 128, "num_envs": 8, "rollout": 4}
THREE = changed(phases=(FIRST, {"algo": "ppo", "steps": 96}))


def assert_same_weights(a, b):
    one, other = Policy.load(a), Policy.load(b)
    for own, weights in zip(one.weights, other.weights, strict=True):
        np.testing.assert_array_equal(own, weights)


def go(config, folder, *, resume=False, after=None):
    """Train; stop in a phase (from 1 on) after an iteration."""
    seen = []

    def show(now):
        seen.append((now.phase, now.iteration))
        if after and seen[-1] == (f"phase {after[0]} of 3", after[1]):
            raise Stop

    stops = pytest.raises(Stop) if after else contextlib.nullcontext()
    with stops:
        train_in(folder, config, resume=resume, show=show)
    return folder, seen


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of three trainings; not to be written to."""
    return go(THREE, tmp_path_factory.mktemp("runs") / "whole")


def test_it_is_what_trainings_by_hand_make_of_it(whole, tmp_path):
    folder, seen = whole
    assert [name for name, _ in seen] == [
        *["phase 1 of 3"] * 4, *["phase 2 of 3"] * 3, *["phase 3 of 3"] * 6,
    ]  # fmt: skip
    networks = {"hidden": (16,), "critic_hidden": (16,), "task_options": {"time_limit": 0.5}}
    own = networks | {"seed": 0, "evaluations": 0, "holds_goal": False}
    quadrl.train("hover", out=tmp_path / "1", **FIRST, **own)
    ppo = own | {"num_envs": 8, "rollout": 4, "ppo": TINY.ppo}
    quadrl.train("hover", steps=96, from_run=tmp_path / "1", out=tmp_path / "2", **ppo)
    quadrl.train("hover", steps=192, from_run=tmp_path / "2", out=tmp_path / "3", **ppo)
    for by_hand, in_turn in (("1", folder / "phase_1"), ("2", folder / "phase_2"), ("3", folder)):
        assert_same_weights(tmp_path / by_hand, in_turn)


@pytest.mark.parametrize("after", [(1, 2), (2, 1), (3, 4)])
def test_stopped_in_any_of_them_it_ends_as_without_that(whole, tmp_path, after):
    folder, _ = go(THREE, tmp_path / "run", after=after)
    read = TrainConfig.of_folder(folder)
    assert read.phases == THREE.phases
    go(read, folder, resume=True)
    assert_same_run(whole[0], folder)
    for name in ("phase_1", "phase_2"):
        assert_same_weights(whole[0] / name, folder / name)
    _, seen = go(read, folder, resume=True)
    assert not seen  # it is over


def test_more_steps_are_those_of_the_last_training(whole, tmp_path):
    folder, _ = go(THREE, tmp_path / "run", after=(1, 2))
    longer = TrainConfig.of_saved(json.loads((folder / "config.json").read_text()), steps=256)
    go(longer, folder, resume=True)
    assert read_metrics(folder / "phase_2" / "metrics.csv")["steps"][-1] == 96
    assert read_metrics(folder / "metrics.csv")["steps"][-1] == 256
    assert_same_weights(whole[0] / "phase_2", folder / "phase_2")


def test_the_curve_goes_through_all_of_them(whole):
    folder, _ = whole
    metrics, evaluated, ends = phases.curve(folder)
    assert ends == [128, 224]
    assert (np.diff(metrics["steps"]) > 0).all() and (np.diff(metrics["seconds"]) > 0).all()
    assert metrics["steps"][-1] == ends[-1] + 192 and evaluated is None
    assert len(metrics["kl"]) == 13 and np.isnan(metrics["kl"][:4]).all()  # which apg has not
    assert len(curve(folder).axes[0].lines) == 1 + len(ends)
    took = json.loads((folder / "evaluation.json").read_text())["training_s"]
    assert took == pytest.approx(metrics["seconds"][-1], abs=0.2)


def test_a_folder_that_holds_a_run_is_refused_before_anything_is_trained(whole):
    folder, _ = whole
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("*")}
    with pytest.raises(QuadrlError, match="already holds a run"):
        go(THREE, folder)
    assert before == {p: p.stat().st_mtime_ns for p in folder.rglob("*")}
