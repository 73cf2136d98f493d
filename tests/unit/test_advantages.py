"""Advantages of several tasks in one: those of each with its own discount, normalised alone.

So are the returns that the critic learns.
"""

import dataclasses

import numpy as np
import pytest
import torch
from helpers import refused
from tensordict import TensorDict
from torchrl.objectives.value import GAE

from quadrl.core.catalogue import make
from quadrl.learning.advantages import Advantages
from quadrl.learning.config import TrainConfig
from quadrl.learning.environments import make_env

SHAPE = 6, 12
MEMBERS = ["hover", "static_waypoint"]
CPU = torch.device("cpu")
WHICH = np.tile([0, 1], SHAPE[0] // 2)[:, None].repeat(SHAPE[1], axis=1)
TWO = {"task": "one_of", "task_options": {"members": MEMBERS}}


def batch_of(sizes=(1.0,)):
    """Transitions of aircraft whose rewards have these sizes in turn, with ends within."""
    torch.manual_seed(0)
    entry = lambda: torch.randn(*SHAPE, 1)  # noqa: E731
    done = torch.zeros(*SHAPE, 1, dtype=torch.bool)
    done[:, 5] = done[2, 8] = done[:, -1] = True
    size = torch.tensor(sizes).repeat(SHAPE[0] // len(sizes))[:, None, None]
    after = {"state_value": entry(), "reward": size * entry(), "done": done}
    after["terminated"] = done & (torch.arange(SHAPE[0]) % 3 == 0)[:, None, None]
    return TensorDict({"state_value": entry(), "next": TensorDict(after, SHAPE)}, SHAPE)


def alone(batch, gamma):
    """TorchRL's own, normalised over the batch."""
    estimate = GAE(gamma=gamma, lmbda=0.95, value_network=None, average_gae=True)
    return estimate(batch.clone()).select("advantage", "value_target")


def test_those_of_one_task_are_torchrls():
    batch, config = batch_of(), TrainConfig("hover", gamma=0.9, gae_lambda=0.95)
    expected = alone(batch, 0.9)
    Advantages(config, CPU)(batch, np.zeros(SHAPE, int))
    for name, values in expected.items():
        assert torch.equal(batch[name], values)


def test_those_of_each_of_several_tasks_are_those_of_that_task_alone():
    gammas = 0.5, 0.9
    batch, made = batch_of(sizes=(1.0, 1000.0)), Advantages(TrainConfig(**TWO, gammas=gammas), CPU)
    was = [(2.0, 3.0), (-50.0, 700.0)]  # mean and deviation of the returns of each
    for name, values in zip(made.returns, zip(*was, strict=True), strict=True):
        made.returns[name].copy_(torch.tensor(values))
    made(batch, WHICH)
    for k, gamma in enumerate(gammas):
        own, (mean, deviation) = batch[k::2].clone(), was[k]
        for values in (own, own["next"]):
            values["state_value"] = mean + deviation * values["state_value"]
        expected = alone(own, gamma)
        mean, deviation = (float(values[k]) for values in made.returns.values())
        target = (expected["value_target"] - mean) / deviation
        torch.testing.assert_close(batch["value_target"][k::2], target)
        torch.testing.assert_close(
            batch["advantage"][k::2], expected["advantage"], atol=5e-3, rtol=0.02
        )  # another denominator of the deviation
        assert batch["advantage"][k::2].mean().abs() < 1e-5


def test_the_critic_learns_returns_in_their_own_deviations_from_the_first_batch_on():
    batch, made = batch_of(sizes=(1.0, 1000.0)), Advantages(TrainConfig(**TWO, gamma=0.8), CPU)
    known = batch.clone()
    for values in (known, known["next"]):  # nothing is known before
        values["state_value"].zero_()
    made(batch, WHICH)
    returns = alone(known, 0.8)["value_target"]  # all have gamma where none has its own
    for k in (0, 1):
        own, target = returns[k::2], batch["value_target"][k::2]
        torch.testing.assert_close(made.returns["mean"][k], own.mean())
        torch.testing.assert_close(made.returns["deviation"][k], own.std(correction=0))
        torch.testing.assert_close(target, (own - own.mean()) / own.std(correction=0))
    before = {name: values.clone() for name, values in made.returns.items()}
    made(batch_of(sizes=(1.0, 1e5)), WHICH)
    for name, values in made.returns.items():  # slowly, and of tasks that are not flown not at all
        assert abs(values[0] - before[name][0]) < 0.1
    assert before["deviation"][1] < made.returns["deviation"][1] < 0.3 * 1e5
    kept = {name: values.clone() for name, values in made.returns.items()}
    made(batch_of(), np.zeros(SHAPE, int))
    assert all(values[1] == kept[name][1] for name, values in made.returns.items())


def test_a_training_is_told_which_task_each_step_was_of():
    config = TrainConfig(**TWO, num_envs=5, rollout=4)
    env = make_env(config, torch.device("cpu"))
    env.reset()
    seen = []
    data = env.rand_step(env.reset())
    for _ in range(210):  # past the ends of the first episodes
        seen.append(data["observation"][:, env.environment.layout["task"]].argmax(-1).numpy())
        data = env.step_and_maybe_reset(env.rand_action(data))[1]
    terms, ends, which = env.told()
    assert len(terms) == len(ends) == 211
    np.testing.assert_array_equal(which[:, 1:], np.transpose(seen))
    assert {*which.flat} == {0, 1} and np.ptp(which, axis=1).any()


@pytest.mark.parametrize("gammas", [(0.9,), (0.9, 1.1), (0.9, 0.9, 0.9), "0.9"])
def test_other_discounts_are_refused(gammas):
    with refused(match="^gammas"):
        TrainConfig(**TWO, gammas=gammas)


def test_discounts_of_tasks_are_for_several_tasks_and_no_derivatives():
    with refused("gammas", match="sequence of 1"):
        TrainConfig("hover", gammas=(0.9, 0.9))
    with refused("gammas", match="left out"):
        TrainConfig(**TWO, algo="apg", gammas=(0.9, 0.9))


def test_all_discounts_each_task_as_its_own_training_does_at_every_control_rate():
    for vehicle in ("paper", "crazyflie"):
        config = TrainConfig("all", vehicle=vehicle)
        parts = make("all").parts
        own = [TrainConfig(part.name, vehicle=vehicle).gamma for part in parts]
        assert config.gammas == tuple(own)
        assert TrainConfig.of_saved(config.resolved()).gammas == config.gammas
    assert dataclasses.replace(config, gammas=()).gammas == ()
