"""Trainings whose aircraft fly where the networks are, on a processor for the sake of the test."""

import warnings

import pytest

pytest.importorskip("torchrl")
import torch

from quadrl.base.errors import QuadrlWarning
from quadrl.core import batch as batch_module
from quadrl.learning import run
from quadrl.learning.advantages import add_values
from quadrl.learning.config import TrainConfig
from quadrl.learning.device import DeviceTraining, elsewhere
from quadrl.learning.train import Training

SMALL = {"num_envs": 64, "rollout": 8, "steps": 64 * 8 * 6, "evaluations": 0}
SMALL |= {"checkpoint_seconds": 1e-9}


@pytest.fixture(autouse=True)
def _quickly(monkeypatch):
    monkeypatch.setattr(batch_module, "FEWEST", 64)
    monkeypatch.setenv("QUADRL_CFLAGS", "-O1")


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["ideal", "robust"])
def test_a_training_that_was_stopped_ends_with_the_same_policy(variant, tmp_path):
    config = TrainConfig("hover", variant=variant, **SMALL)
    whole = DeviceTraining(config, tmp_path / "whole")
    policy = whole.run()
    first = DeviceTraining(config, tmp_path / "parts")
    first.run(lambda progress: first.ask(stop=progress.iteration == 3))
    assert first.iteration == 3
    second = DeviceTraining(config, tmp_path / "parts", resume=True)
    again = second.run()
    for one, other in zip(policy.weights, again.weights, strict=True):
        assert (one == other).all()


def test_its_gradient_steps_are_those_of_a_training_on_the_processor(tmp_path):
    """From the same transitions: advantages, targets and log-probabilities agree to rounding."""
    training = DeviceTraining(TrainConfig("hover", **SMALL), tmp_path / "run")
    learner = training._learner
    with torch.no_grad():
        learner._fly()
        learner._update(training.normalisers)
        part = learner._prepare()
        part["before"] = learner._log_probability(part["policy"], part["action"])
        learner._advantages(part)
    batch, layout = training.env.batch, training.env.batch.layout
    seen = learner._observed()["observation"].reshape(8, 64, -1).transpose(0, 1)
    final = batch.out[:, layout.seen : layout.reward].permute(2, 0, 1)
    column = {"done": batch.flags[:, 0], "terminated": batch.flags[:, 1]}
    after = {k: x.T[..., None] for k, x in column.items()}
    reward = training.config.reward_scale * batch.out[:, layout.reward].T[..., None]
    after |= {"observation": final, "reward": reward}
    from tensordict import TensorDict

    whole = TensorDict({"observation": seen, "next": after}, batch_size=[64, 8])
    with torch.no_grad():
        add_values(whole, training.critic)
        training.advantages(whole, None)
    rows = {"advantage": whole["advantage"], "target": whole["value_target"]}
    for name, expected in rows.items():
        found = part[name].reshape(8, 64).T
        torch.testing.assert_close(found, expected[..., 0], rtol=1e-4, atol=1e-5)


def test_who_trains_where(monkeypatch):
    monkeypatch.setattr(run, "make_device", torch.device)
    assert run.kind_of(TrainConfig("hover")) is Training
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run.kind_of(TrainConfig("hover", device="cuda")) is DeviceTraining
    with pytest.warns(QuadrlWarning, match=r"a processor flies .* no contact"):
        assert run.kind_of(TrainConfig("landing", device="cuda")) is Training
    assert "memory" in elsewhere(TrainConfig("hover", memory="gru"))
    assert "algo" in elsewhere(TrainConfig("hover", algo="trpo"))
    assert elsewhere(TrainConfig("navigation", variant="robust")) == ""
