"""PPO's gradients by hand against TorchRL's loss, and the behaviour policy against its actor."""

import copy
import math

import pytest
import torch
from helpers import refused
from runs import actor_critic, disturbed, one_thread  # noqa: F401
from tensordict import TensorDict
from torch import nn

from quadrl.evaluation.policy import LOG_VARIANCE
from quadrl.evaluation.policy_file import CLIP
from quadrl.learning.config import TrainConfig
from quadrl.learning.fused import BehaviourPolicy
from quadrl.learning.networks import make_actor_critic
from quadrl.learning.ppo import PPO
from quadrl.learning.settings import PPOConfig

pytestmark = pytest.mark.usefixtures("one_thread")
ROWS = 60
CASES = {
    "plain": {},
    "one layer": {"hidden": (), "critic_hidden": ()},
    "narrowing": {"hidden": (9, 5, 3), "critic_hidden": (12, 4)},
    "holds the goal": {"holds_goal": True},
    "privileged": {"privileged": 3},
    "both": {"holds_goal": True, "privileged": 3},
    "holds the goal of some of several tasks": {"task": "all", "holds_goal": True, "size": 31},
}
SETTINGS = [{}, {"clip": 0.1, "entropy": 0.25, "critic": 0.75}, {"critic": 0.0}]


def networks(**settings):
    """Actor and critic in double precision, away from the start, and their normalisers."""
    # Of the size of hover, whose goal one of the policies holds.
    settings = {"hidden": (16,), "critic_hidden": (8, 8), "size": 22} | settings
    actor, critic, normalisers = actor_critic(actions=4, **settings)
    for network in (actor, critic):
        disturbed(network, 0.2).double()
    for normaliser in normalisers.values():
        normaliser.update(2 * torch.randn(100, len(normaliser.mean)) + 1)
    return actor, critic, normalisers


def batch_of(actor, normalisers, rows=ROWS, dtype=torch.float64):
    """Taken a while ago, by a policy that differs; of the observations some are clipped."""
    torch.manual_seed(1)
    batch = TensorDict({}, [rows])
    for name, normaliser in normalisers.items():
        size = len(normaliser.mean)
        batch[name] = 2 * torch.randn(rows, size) + 1
        batch[name][:3] *= 100
    batch = batch.to(dtype)
    with torch.no_grad():
        flown = actor.get_dist(batch)
        batch["action"] = flown.sample()
        batch["action_log_prob"] = flown.log_prob(batch["action"])
    batch["action_log_prob"] += 0.3 * torch.randn(rows).to(dtype)
    batch["advantage"] = torch.randn(rows, 1).to(dtype)
    batch["value_target"] = torch.randn(rows, 1).to(dtype)
    return batch


def compare(actor, critic, batch, /, digits=1e-12, **settings):
    """What is logged, and the gradients of all parameters."""
    algorithm = PPO(actor, critic, PPOConfig(**settings))
    expected = algorithm.loss(batch.clone())
    assert 0.02 < expected["clip_fraction"] < 0.9
    parameters = algorithm.parameters
    losses = sum(value for name, value in expected.items() if name.startswith("loss_"))
    wanted = torch.autograd.grad(losses, parameters, allow_unused=True)
    for parameter in parameters:
        parameter.grad = torch.full_like(parameter, 9.0)  # of an earlier step: replaced
    fused = algorithm.fused
    found = fused.figures(*fused.gradients(fused.prepare(batch)))
    for name in found.keys() & expected.keys():
        torch.testing.assert_close(found[name], expected[name].detach(), rtol=digits, atol=digits)
    for parameter, gradient in zip(parameters, wanted, strict=True):
        if gradient is None:  # of a critic without weight
            assert not parameter.grad.any()
        else:
            assert gradient.abs().max() > 1e-7
            assert (parameter.grad - gradient).norm() <= digits * gradient.norm()


# ------------------------------------------------------------------- gradients and steps


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
@pytest.mark.parametrize("case", CASES)
def test_the_gradients_are_those_of_torchrl(case, settings):
    actor, critic, normalisers = networks(**CASES[case])
    batch = batch_of(actor, normalisers)
    seen = normalisers["observation"](batch["observation"]).abs()
    assert (seen == CLIP).any() and not (seen == CLIP).all()
    compare(actor, critic, batch, **settings)
    compare(actor, critic, batch.reshape(6, 10), **settings)


@pytest.mark.parametrize("case", ["plain", "holds the goal"])
def test_at_the_bounds_of_the_log_variance_they_are_the_same(case):
    actor, critic, normalisers = networks(**CASES[case])
    last = [module for module in actor.modules() if isinstance(module, nn.Linear)][-1]
    with torch.no_grad():
        last.bias[-4:] = torch.tensor([LOG_VARIANCE[0], LOG_VARIANCE[1], 0.0, -1.0])
    batch = batch_of(actor, normalisers)
    log_variance = 2 * actor.get_dist(batch.clone()).base_dist.scale.log()
    for bound in LOG_VARIANCE:
        at_bound = (log_variance - bound).abs() < 1e-12
        assert at_bound.any() and not at_bound.all(0).any()
    # An error of the mean counts a hundredfold where the deviation is a hundredth, and squared.
    compare(actor, critic, batch, digits=1e-10, entropy=0.25)


def test_twenty_steps_end_with_the_same_weights():
    ends = []
    for fused in (True, False):
        actor, critic, normalisers = networks(**CASES["both"])
        config = PPOConfig(epochs=5, minibatch=16, entropy=0.25, fused=fused)
        algorithm = PPO(actor, critic, config)
        batch = batch_of(actor, normalisers, rows=64)
        before = copy.deepcopy(algorithm.parameters)
        torch.manual_seed(2)
        metrics = algorithm.update(batch, remaining=1.0)
        ends.append((algorithm.parameters, metrics))
        for parameter, old in zip(algorithm.parameters, before, strict=True):
            assert (parameter != old).any()
    (got, found), (expected, logged) = ends
    for a, b in zip(got, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)
    assert found.keys() == logged.keys()
    for name, value in logged.items():
        assert math.isclose(found[name], value, rel_tol=1e-8, abs_tol=1e-12)


def test_a_memory_is_refused_by_the_fused_loss():
    config = TrainConfig(memory="gru", memory_width=3, ppo={"minibatch": 8, "epochs": 2})
    assert not config.ppo.fused and TrainConfig().ppo.fused
    actor, critic, _ = make_actor_critic(5, 2, config)
    with refused(name="ppo.fused", value=True):
        PPO(actor, critic, PPOConfig())


# ------------------------------------------------------------------- what a collector flies with


@pytest.mark.parametrize("case", [name for name in CASES if "privileged" not in CASES[name]])
def test_the_behaviour_policy_gives_what_its_actor_gives(case):
    actor, _, normalisers = networks(**CASES[case])
    plain = actor.module[0].plain
    behaviour, batch = BehaviourPolicy(plain), batch_of(actor, normalisers)
    for _ in range(2):
        flown = behaviour(batch.select(*behaviour.in_keys))
        assert set(flown.keys()) - set(behaviour.in_keys) == set(actor.out_keys)
        expected = actor.get_dist(flown)
        for name, value in (
            ("loc", expected.base_dist.loc),
            ("scale", expected.base_dist.scale),
            ("action_log_prob", expected.log_prob(flown["action"])),
        ):
            torch.testing.assert_close(flown[name], value, rtol=1e-12, atol=1e-12)
        assert not flown["action"].requires_grad
        with torch.no_grad():
            for weight in plain.weights():  # they are the actor's
                weight *= 1.1


def test_the_behaviour_policy_draws_from_the_normal_distribution():
    actor, _, _ = networks()
    rows = TensorDict({"observation": torch.ones(20_000, 22, dtype=torch.float64)}, [20_000])
    flown = BehaviourPolicy(actor.module[0].plain)(rows)
    drawn = (flown["action"] - flown["loc"]) / flown["scale"]
    deviation = drawn.numel() ** -0.5
    assert drawn.mean().abs() < 5 * deviation
    assert (drawn.std() - 1).abs() < 5 * deviation
    correlation = (drawn.T @ drawn / len(drawn)).fill_diagonal_(0)
    assert correlation.abs().max() < 5 * len(drawn) ** -0.5
