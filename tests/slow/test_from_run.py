"""Trainings that begin with the networks of another run."""

import dataclasses
import shutil

import numpy as np
import pytest
import torch
from helpers import refused
from runs import TINY, assert_same_run, changed, contents, stopped, train

import quadrl
from quadrl.learning.config import TrainConfig
from quadrl.learning.train import Training


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A run of apg that is over, with networks of its own; not to be written to."""
    config = changed(algo="apg", hidden=(12,), critic_hidden=(8, 8), seed=3)
    return train(config, tmp_path_factory.mktemp("runs") / "first")


def after(first, **settings):
    """Settings of a training that begins with its networks."""
    own = {"task": "hover", "num_envs": 8, "rollout": 4, "steps": 192, "checkpoint_seconds": 0.0}
    own |= {"task_options": {"time_limit": 0.5}, "ppo": TINY.ppo}
    return TrainConfig(from_run=str(first), **own | settings)


def test_a_training_begins_with_policy_and_critic_of_another_algorithm(first, tmp_path):
    config = after(first, task_options={"time_limit": 0.5, "tolerance": 0.3})
    assert config.hidden == (12,) and config.critic_hidden == (8, 8) and not config.holds_goal
    ours, theirs = Training(config, tmp_path / "run").policy(), quadrl.Policy.load(first)
    seen = np.random.default_rng(0).normal(size=(5, 22))
    np.testing.assert_array_equal(ours(seen), theirs(seen))
    assert (ours.mean == theirs.mean).all() and (ours.mean != 0).any()


def test_what_is_known_of_the_observations_is_kept_and_added_to(first, tmp_path):
    training = Training(after(first), tmp_path / "run")
    known = training.normalisers["observation"]
    before, mean = float(known.count), known.mean.clone()
    assert before == 192  # what the first run saw
    training.run()
    assert known.count == 192 + 192 and (known.mean != mean).any()
    assert torch.isfinite(known.mean).all()


def test_it_is_reproducible_and_resumes_without_the_other_run(first, tmp_path):
    other = shutil.copytree(first, tmp_path / "other")
    whole = train(after(other), tmp_path / "whole")
    half = stopped(after(other), tmp_path / "half", after=3)
    shutil.rmtree(other)
    train(TrainConfig.of_folder(half), half, resume=True)
    assert_same_run(whole, half)
    sources = {name: where for name, _, where in TrainConfig.of_folder(half).sources()}
    assert sources["from_run"] == "given"


def test_a_run_says_whose_networks_it_began_with(first):
    assert TINY.resolved()["from_run"] == ""
    assert after(first).resolved()["from_run"].startswith(f"{first}@")
    names = {name: where for name, _, where in after(first).sources()}
    assert names["hidden"] == names["critic_hidden"] == f"run {first}"


def test_a_run_that_learned_on_is_another_one(first, tmp_path):
    other = shutil.copytree(first, tmp_path / "other")
    config = after(other)
    train(TrainConfig.of_folder(other), other, resume=True)  # over already: as it was
    longer = TrainConfig.of_folder(other)
    train(dataclasses.replace(longer, steps=224), other, resume=True)
    with refused("from", allowed=config.from_run):
        Training(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_what_differs_is_said_and_nothing_is_made(first, tmp_path):
    before = contents(first)
    wide = after(first, task="target_following", training_options={})
    six = after(first, vehicle="hexa")
    informed = after(first, observe={"privileged": True})
    for config, words in (
        (wide, "22 numbers in an observation, this training 25"),
        (six, "22 numbers in an observation, this training 24"),
        (informed, "its critic sees other numbers"),
    ):
        with refused("from", str(first)) as caught:
            Training(config, tmp_path / "run")
        assert words in str(caught.value)
    with refused("hidden", (16,), "(12,)"):
        after(first, hidden=(16,))
    with refused() as caught:
        after(tmp_path / "none")
    assert "holds no run" in str(caught.value)
    assert not (tmp_path / "run").exists() and contents(first) == before
