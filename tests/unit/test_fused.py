"""The fused loss of PPO against TorchRL's, and the behaviour policy against its actor."""

import copy
import math

import pytest
import torch
from runs import changed
from tensordict import TensorDict
from torch import nn
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss

from quadrl.evaluation.policy import CLIP, LOG_VARIANCE
from quadrl.learning.config import TrainConfig
from quadrl.learning.fused import USUAL, FusedPPOLoss, Terms, make_loss
from quadrl.learning.networks import make_actor_critic
from quadrl.learning.plain import BehaviourPolicy, plain_policy
from quadrl.learning.ppo import PPO
from quadrl.learning.settings import PPOConfig

ROWS = 60
CASES = {
    "plain": {},
    "one layer": {"hidden": (), "critic_hidden": ()},
    "narrowing": {"hidden": (9, 5, 3), "critic_hidden": (12, 4)},
    "holds the goal": {"holds_goal": True},
    "privileged": {"privileged": 3},
    "both": {"holds_goal": True, "privileged": 3},
}
SETTINGS = [
    {"clip_epsilon": 0.2, "entropy_bonus": False},
    {"clip_epsilon": 0.1, "entropy_coeff": 0.3, "critic_coeff": 0.7},
    {"clip_epsilon": (0.1, 0.3), "entropy_coeff": 0.3, "reduction": "sum"},
    {"entropy_coeff": 0.3, "critic_coeff": 0.0, "reduction": "none"},
]


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def networks(privileged=0, **settings):
    """Actor and critic in double precision, away from the start, and their normalisers."""
    config = TrainConfig(
        **({"hidden": (16,), "critic_hidden": (8, 8), "holds_goal": False} | settings)
    )
    size, actions = 22, 4  # of hover, whose goal one of the policies holds
    torch.manual_seed(0)
    actor, critic, normalisers = make_actor_critic(size, actions, config, privileged)
    for network in (actor, critic):
        with torch.no_grad():
            for parameter in network.parameters():
                parameter += 0.2 * torch.randn_like(parameter)
        network.double()
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


def pair(actor, critic, **settings):
    return FusedPPOLoss(actor, critic, **settings), ClipPPOLoss(actor, critic, **USUAL, **settings)


def gradients(loss, batch):
    """What a loss gives, and the gradients of all that is weighted."""
    found = loss(batch)
    parameters = list(loss.parameters())
    weighted = sum(found[name].sum() for name in found.keys() if name.startswith("loss_"))
    return found, torch.autograd.grad(weighted, parameters, allow_unused=True)


def assert_same(got, expected, digits=1e-12):
    torch.testing.assert_close(got, expected, rtol=digits, atol=digits)


# ------------------------------------------------------------------- losses and gradients


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
@pytest.mark.parametrize("case", CASES)
def test_losses_and_gradients_are_those_of_torchrl(case, settings):
    actor, critic, normalisers = networks(**CASES[case])
    batch = batch_of(actor, normalisers)
    seen = normalisers["observation"](batch["observation"]).abs()
    assert (seen == CLIP).any() and not (seen == CLIP).all()
    compare(actor, critic, batch, settings, digits=1e-12)


@pytest.mark.parametrize("case", ["plain", "holds goal"])
def test_at_the_bounds_of_the_log_variance_they_are_the_same(case):
    actor, critic, normalisers = networks(holds_goal=case == "holds goal")
    last = [module for module in actor.modules() if isinstance(module, nn.Linear)][-1]
    with torch.no_grad():
        last.bias[-4:] = torch.tensor([LOG_VARIANCE[0], LOG_VARIANCE[1], 0.0, -1.0])
    batch = batch_of(actor, normalisers)
    log_variance = 2 * actor.get_dist(batch.clone()).base_dist.scale.log()
    for bound in LOG_VARIANCE:
        at_bound = (log_variance - bound).abs() < 1e-12
        assert at_bound.any() and not at_bound.all(0).any()
    # An error of the mean counts a hundredfold where the deviation is a hundredth, and squared.
    compare(actor, critic, batch, {"entropy_coeff": 0.3}, digits=1e-10)


def compare(actor, critic, batch, settings, digits):
    """Everything that the two losses give, and all gradients."""
    (found, got), (expected, wanted) = (
        gradients(loss, batch.clone()) for loss in pair(actor, critic, **settings)
    )
    assert 0.1 < expected["clip_fraction"] < 0.9
    assert set(found.keys()) == set(expected.keys())
    for name, value in expected.items():
        assert found[name].shape == value.shape and found[name].dtype == value.dtype
        assert_same(found[name].detach(), value.detach(), digits)
    for a, b in zip(got, wanted, strict=True):
        if b is None:  # of a critic without weight
            assert not a.any()
        else:
            assert b.abs().max() > 1e-6
            assert_same(a / b.norm(), b / b.norm(), digits)


def test_a_mask_is_that_of_torchrl():
    actor, critic, normalisers = networks()
    batch = batch_of(actor, normalisers)
    fused, usual = pair(actor, critic)
    whole = fused(batch.clone())
    batch["collector", "mask"] = torch.rand(ROWS) < 0.5
    found, expected = fused(batch.clone()), usual(batch.clone())
    assert found["loss_objective"] != whole["loss_objective"]
    for name, value in expected.items():
        assert_same(found[name].detach(), value.detach())


def test_a_batch_of_two_dimensions_is_that_of_torchrl():
    actor, critic, normalisers = networks()
    batch = batch_of(actor, normalisers).reshape(6, 10)
    for reduction in ("mean", "none"):
        found, expected = (loss(batch.clone()) for loss in pair(actor, critic, reduction=reduction))
        for name, value in expected.items():
            assert found[name].shape == value.shape
            assert_same(found[name].detach(), value.detach())


@pytest.mark.parametrize("case", ["plain", "both"])
def test_the_gradients_are_those_of_finite_differences(case):
    actor, critic, normalisers = networks(**CASES[case] | {"hidden": (3,), "critic_hidden": (3,)})
    loss = FusedPPOLoss(actor, critic)
    part, count, weights = loss._given(loss.prepare(batch_of(actor, normalisers, rows=7)))
    bounds = torch.tensor([-0.1, 0.1]).double().unbind()

    def terms(*weights):
        return Terms.apply(part, bounds, count, *weights)[:3]

    assert torch.autograd.gradcheck(terms, [w.detach().requires_grad_() for w in weights])


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
@pytest.mark.parametrize("case", CASES)
def test_the_gradients_without_a_graph_are_those_of_the_losses(case, settings):
    actor, critic, normalisers = networks(**CASES[case])
    loss, batch = FusedPPOLoss(actor, critic, **settings), batch_of(actor, normalisers)
    found, expected = gradients(loss, batch.clone())
    for parameter in loss.parameters():
        parameter.grad = torch.full_like(parameter, 9.0)  # of an earlier step: replaced
    said = loss.summary(loss.gradients(loss.prepare(batch)))
    for name in found.keys() & said.keys():
        assert_same(said[name].reshape(found[name].shape), found[name].detach())
    for parameter, gradient in zip(loss.parameters(), expected, strict=True):
        wanted = torch.zeros_like(parameter) if gradient is None else gradient
        assert_same(parameter.grad, wanted)


def test_its_graph_is_one_node_that_gives_no_second_derivative():
    actor, critic, normalisers = networks()
    loss, batch = FusedPPOLoss(actor, critic), batch_of(actor, normalisers)
    objective = loss(batch)["loss_objective"]
    mean, _ = objective.grad_fn.next_functions[0]
    assert type(mean.next_functions[0][0]).__name__ == "TermsBackward"
    first = torch.autograd.grad(objective, list(actor.parameters()), create_graph=True)
    with pytest.raises(RuntimeError, match="does not require grad"):
        first[0].sum().backward()


# ------------------------------------------------------------------- the interface


def test_the_entries_are_those_of_torchrl():
    actor, critic, normalisers = networks(privileged=3)
    batch = batch_of(actor, normalisers)
    fused, usual = pair(actor, critic)
    assert set(fused.in_keys) == set(usual.in_keys) and fused.out_keys == usual.out_keys
    assert [n for n, _ in fused.named_parameters()] == [n for n, _ in usual.named_parameters()]
    expected = usual(batch.clone())
    for loss in (fused, usual):
        loss.set_keys(advantage="gained", value_target="wanted", action="done", sample_log_prob="p")
    assert set(fused.in_keys) == set(usual.in_keys)
    batch.rename_key_("advantage", "gained").rename_key_("value_target", "wanted")
    batch.rename_key_("action", "done").rename_key_("action_log_prob", "p")
    for name, value in fused(batch).items():
        assert_same(value.detach(), expected[name].detach())


def test_without_advantages_it_estimates_them_as_torchrl_does():
    actor, critic, normalisers = networks()
    batch = batch_of(actor, normalisers).exclude("advantage", "value_target").reshape(6, 10)
    batch["next"] = {
        "observation": batch["observation"] + 0.1,
        "reward": torch.randn(6, 10, 1).double(),
        "done": torch.zeros(6, 10, 1, dtype=torch.bool),
        "terminated": torch.zeros(6, 10, 1, dtype=torch.bool),
    }
    found, expected = (loss(batch.clone()) for loss in pair(actor, critic))
    for name, value in expected.items():
        assert_same(found[name].detach(), value.detach())


def test_other_networks_get_the_loss_of_torchrl():
    kind = {True: FusedPPOLoss, False: ClipPPOLoss}
    for settings, fused in (({}, True), ({"memory": "gru", "memory_width": 3}, False)):
        actor, critic, _ = make_actor_critic(5, 2, changed(**settings))
        assert type(make_loss(actor, critic)) is kind[fused]
    actor, critic, _ = make_actor_critic(5, 2, changed())
    for network in (actor.module[0].module, critic.module):
        tanh = network[2]
        network[2] = nn.ReLU()
        assert type(make_loss(actor, critic)) is ClipPPOLoss
        with pytest.raises(TypeError):
            FusedPPOLoss(actor, critic)
        network[2] = tanh
    assert type(make_loss(actor, critic)) is FusedPPOLoss
    actor.module[-1].distribution_kwargs["tanh_loc"] = True
    assert type(make_loss(actor, critic)) is ClipPPOLoss


# ------------------------------------------------------------------- the update


@pytest.mark.parametrize("entropy", [0.0, 0.01])
@pytest.mark.parametrize("case", ["plain", "both"])
def test_twenty_steps_end_with_the_same_weights(case, entropy):
    config = PPOConfig(epochs=5, minibatch=16, entropy=entropy)
    ends = []
    for fused in (True, False):
        actor, critic, normalisers = networks(**CASES[case])
        algorithm = PPO(actor, critic, config)
        assert type(algorithm.loss) is FusedPPOLoss
        if not fused:
            settings = {"entropy_bonus": entropy > 0, "entropy_coeff": entropy}
            algorithm.loss = ClipPPOLoss(actor, critic, **USUAL, **settings)
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


def test_in_single_precision_it_is_rounding():
    actor, critic, normalisers = networks()
    for network in (actor, critic):
        network.float()
    batch = batch_of(actor, normalisers, rows=4096, dtype=torch.float32)
    # A ratio at its bound is a matter of rounding: here none is near.
    (found, got), (expected, wanted) = (
        gradients(loss, batch.clone()) for loss in pair(actor, critic, clip_epsilon=0.9)
    )
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-4, atol=1e-5)
    for a, b in zip(got, wanted, strict=True):
        assert (a - b).norm() < 1e-5 * b.norm()


def test_a_memory_is_trained_through_the_loss_of_torchrl():
    actor, critic, _ = make_actor_critic(5, 2, changed(memory="gru", memory_width=3))
    algorithm = PPO(actor, critic, PPOConfig(minibatch=8, epochs=2))
    torch.manual_seed(3)
    entries = {"observation": torch.randn(4, 6, 5), "recurrent_state": torch.zeros(4, 6, 3)}
    entries |= {"is_init": torch.zeros(4, 6, 1, dtype=torch.bool)}
    entries |= {name: torch.randn(4, 6, 1) for name in ("advantage", "value_target")}
    batch = TensorDict(entries | {"action": torch.randn(4, 6, 2)}, [4, 6])
    with torch.no_grad(), set_recurrent_mode():
        batch["action_log_prob"] = actor.get_dist(batch).log_prob(batch["action"])
    before = copy.deepcopy(algorithm.parameters)
    metrics = algorithm.update(batch, remaining=1.0)
    assert metrics["critic_loss"] > 0 and metrics["kl"] != 0
    for parameter, old in zip(algorithm.parameters, before, strict=True):
        assert (parameter != old).any()


# ------------------------------------------------------------------- what a collector flies with


@pytest.mark.parametrize("case", [name for name in CASES if "privileged" not in CASES[name]])
def test_the_behaviour_policy_gives_what_its_actor_gives(case):
    actor, _, normalisers = networks(**CASES[case])
    plain = plain_policy(actor)
    assert plain is not None
    behaviour, batch = BehaviourPolicy(plain), batch_of(actor, normalisers)
    flown = behaviour(batch.select(*behaviour.in_keys))
    assert set(flown.keys()) - set(behaviour.in_keys) == set(actor.out_keys)
    expected = actor.get_dist(flown)
    assert_same(flown["loc"], expected.base_dist.loc)
    assert_same(flown["scale"], expected.base_dist.scale)
    assert_same(flown["action_log_prob"], expected.log_prob(flown["action"]))
    assert not flown["action"].requires_grad
    with torch.no_grad():
        for weight in plain.weights():
            weight *= 1.1
    again = behaviour(batch.select(*behaviour.in_keys))
    assert_same(again["loc"], actor.get_dist(batch).base_dist.loc)  # its weights are the actor's


def test_the_behaviour_policy_draws_from_the_normal_distribution():
    actor, _, normalisers = networks()
    plain = plain_policy(actor)
    assert plain is not None
    behaviour = BehaviourPolicy(plain)
    rows = TensorDict({"observation": torch.ones(20_000, 22, dtype=torch.float64)}, [20_000])
    flown = behaviour(rows)
    drawn = (flown["action"] - flown["loc"]) / flown["scale"]
    deviation = drawn.numel() ** -0.5
    assert drawn.mean().abs() < 5 * deviation
    assert (drawn.std() - 1).abs() < 5 * deviation
    correlation = (drawn.T @ drawn / len(drawn)).fill_diagonal_(0)
    assert correlation.abs().max() < 5 * len(drawn) ** -0.5
