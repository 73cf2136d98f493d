"""TRPO's loss as a module of TorchRL: names, shapes, estimators, distributions."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical, Normal
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    IndependentNormal,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    TruncatedNormal,
    ValueOperator,
)
from torchrl.objectives import ValueEstimators

from quadrl.learning.trpo_loss import TRPOLoss

SIZE, ACTIONS = 3, 2
ROWS, STEPS = 5, 4
NAMES = {
    "advantage": "gain",
    "value_target": ("critic", "target"),
    "value": ("critic", "value"),
    "action": ("agent", "action"),
    "sample_log_prob": ("agent", "log_prob"),
    "reward": ("agent", "reward"),
    "done": "over",
    "terminated": "ended",
}


def make_actor(
    kind=TanhNormal, action="action", log_prob="action_log_prob", names=("loc", "scale")
):
    """A policy of one layer, its parameters under any names."""
    if kind is Categorical:
        network, names = nn.Linear(SIZE, ACTIONS), ("logits",)
    else:
        network = nn.Sequential(nn.Linear(SIZE, 2 * ACTIONS), NormalParamExtractor())
    reads = list(names) if kind is Categorical else dict(zip(("loc", "scale"), names, strict=True))
    return ProbabilisticActor(
        TensorDictModule(network, ["observation"], list(names)),
        in_keys=reads,
        out_keys=[action],
        distribution_class=kind,
        return_log_prob=True,
        log_prob_key=log_prob,
    )


def make_critic(value="state_value"):
    return ValueOperator(nn.Linear(SIZE, 1), in_keys=["observation"], out_keys=[value])


def acted(actor, data):
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        return actor(data)


def rollout(actor, names=None, batch=(ROWS, STEPS)):
    """What a collector gives: trajectories (ROWS, STEPS), without advantages."""
    names = names or {}
    data = TensorDict({"observation": torch.randn(*batch, SIZE)}, list(batch))
    data = acted(actor, data)
    data["next", "observation"] = torch.randn(*batch, SIZE)
    for name, entry in (
        ("reward", torch.randn(*batch, 1)),
        ("done", torch.rand(*batch, 1) < 0.2),
        ("terminated", torch.zeros(*batch, 1, dtype=torch.bool)),
    ):
        key = names.get(name, name)
        data[("next", key) if isinstance(key, str) else ("next", *key)] = entry
    return data


def moved(module, by=0.2):
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += by * torch.randn_like(parameter)


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.mark.parametrize("kind", [IndependentNormal, TanhNormal, Categorical])
@pytest.mark.parametrize("functional", [True, False])
def test_the_gradient_at_the_acting_policy_is_the_policy_gradient(kind, functional):
    actor, critic = make_actor(kind), make_critic()
    data = rollout(actor)
    loss = TRPOLoss(actor, critic, functional=functional)
    advantage = data["advantage"] = torch.randn(ROWS, STEPS, 1)
    data["value_target"] = torch.randn(ROWS, STEPS, 1)
    parameters = list(actor.parameters())
    log_prob = actor.get_dist(data.select("observation")).log_prob(data["action"])
    expected = torch.autograd.grad(-(log_prob * advantage[..., 0]).mean(), parameters)
    found = loss(data)
    (found["loss_objective"] + found["loss_critic"]).backward()
    own = [parameter for name, parameter in loss.named_parameters() if "actor" in name]
    assert len(own) == len(expected)
    assert {id(parameter) for parameter in own} == {id(parameter) for parameter in parameters}
    for parameter, gradient in zip(parameters, expected, strict=True):
        assert gradient.abs().max() > 1e-3
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-4, atol=1e-6)
    assert all(parameter.grad.abs().max() > 0 for parameter in critic.parameters())
    assert found["kl"].item() == pytest.approx(0, abs=1e-6)


def test_every_name_can_be_another():
    plain, critic = make_actor(), make_critic()
    data = rollout(plain)
    expected = TRPOLoss(plain, critic, functional=False)(data)
    actor = make_actor(
        action=NAMES["action"], log_prob=NAMES["sample_log_prob"], names=(("p", "m"), ("p", "s"))
    )
    other = make_critic(NAMES["value"])
    actor.load_state_dict(plain.state_dict())
    other.load_state_dict(critic.state_dict())
    renamed = TensorDict({"observation": data["observation"]}, data.batch_size)
    renamed["next", "observation"] = data["next", "observation"]
    renamed["p", "m"], renamed["p", "s"] = data["loc"], data["scale"]
    for name, key in NAMES.items():
        if name in ("action", "sample_log_prob"):
            renamed[key] = data["action" if name == "action" else "action_log_prob"]
        elif name in ("reward", "done", "terminated"):
            renamed[("next", key) if isinstance(key, str) else ("next", *key)] = data["next", name]
    loss = TRPOLoss(actor, other)
    loss.set_keys(**NAMES)
    found = loss(renamed)
    assert set(found.keys()) == set(expected.keys())
    for name in expected.keys():  # noqa: SIM118 - a TensorDict iterates over its rows
        torch.testing.assert_close(found[name], expected[name])
    assert NAMES["advantage"] not in renamed.keys()  # noqa: SIM118 - the input stays as it is
    for name in ("action", "sample_log_prob"):
        assert NAMES[name] in loss.in_keys
    assert {("next", "agent", "reward"), ("next", "over"), ("next", "ended")} <= set(loss.in_keys)
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        loss.set_keys(reply="reply")


@pytest.mark.parametrize("computed", [True, False])
def test_a_call_with_arguments_is_one_with_a_tensordict(computed):
    actor, critic = make_actor(IndependentNormal), make_critic()
    data = rollout(actor)
    moved(actor)
    loss = TRPOLoss(actor, critic)
    if not computed:
        data["advantage"] = torch.randn(ROWS, STEPS, 1)
        data["value_target"] = torch.randn(ROWS, STEPS, 1)
    expected = loss(data)
    flat = {"_".join(k) if isinstance(k, tuple) else k: data[k] for k in loss.in_keys if k in data}
    assert len(flat) == len(loss.in_keys) - 2 * computed
    assert loss.out_keys == ["loss_objective", "kl", "loss_critic"]
    for found in (loss(**flat), loss(*flat.values())):
        assert len(found) == 3
        for name, value in zip(loss.out_keys, found, strict=True):
            assert value.item() == expected[name].item() != 0


@pytest.mark.parametrize("kind", [ValueEstimators.GAE, ValueEstimators.TD0])
def test_it_computes_the_advantage_itself(kind):
    actor, critic = make_actor(), make_critic()
    data = rollout(actor)
    loss = TRPOLoss(actor, critic)
    loss.make_value_estimator(kind, gamma=0.7)
    found = loss(data)
    with torch.no_grad():
        given = loss.value_estimator(data.clone(), params=loss.critic_network_params)
    again = TRPOLoss(actor, critic)(given)
    for name in ("loss_objective", "loss_critic"):
        torch.testing.assert_close(found[name], again[name])
    if kind is ValueEstimators.TD0:
        with torch.no_grad():
            after = critic.module(data["next", "observation"])
        target = data["next", "reward"] + 0.7 * after  # no row of the rollout has terminated
        torch.testing.assert_close(given["value_target"], target)


def test_the_divergence_in_closed_form():
    for kind in (IndependentNormal, TanhNormal):  # it does not change under tanh
        actor = make_actor(kind, names=("middle", "width"))
        data = rollout(actor)
        moved(actor)
        data["advantage"] = torch.randn(ROWS, STEPS, 1)
        now = actor.module[0](data.select("observation"))
        acting, present = (Normal(each["middle"], each["width"]) for each in (data, now))
        expected = torch.distributions.kl_divergence(acting, present).sum(-1).mean()
        assert expected > 1e-3
        torch.testing.assert_close(TRPOLoss(actor)(data)["kl"], expected, rtol=1e-4, atol=1e-6)
    actor = make_actor(Categorical)
    data = rollout(actor)
    moved(actor)
    data["advantage"] = torch.randn(ROWS, STEPS, 1)
    before, now = (
        d.log_softmax(-1) for d in (data["logits"], actor.module[0](data.clone())["logits"])
    )
    expected = (before.exp() * (before - now)).sum(-1).mean()
    torch.testing.assert_close(TRPOLoss(actor)(data)["kl"], expected, rtol=1e-4, atol=1e-6)


def test_a_divergence_without_a_closed_form_is_estimated_from_the_actions():
    """The mean of r - 1 - log(r)."""
    actor = make_actor(TruncatedNormal)
    data = rollout(actor)
    acting = data["action_log_prob"]
    moved(actor)
    data["advantage"] = torch.randn(ROWS, STEPS, 1)
    log_ratio = actor.get_dist(data.select("observation")).log_prob(data["action"]) - acting
    expected = (log_ratio.exp() - 1 - log_ratio).mean()
    assert expected > 1e-3
    torch.testing.assert_close(TRPOLoss(actor)(data)["kl"], expected, rtol=1e-4, atol=1e-6)


def test_advantages_are_normalised_and_padded_rows_do_not_count():
    actor = make_actor()
    data = rollout(actor)
    data["advantage"] = 5 + 3 * torch.randn(ROWS, STEPS, 1)
    terms = TRPOLoss(actor, normalize_advantage=True, reduction="none")(data)["loss_objective"]
    advantage = data["advantage"][..., 0]
    torch.testing.assert_close(terms, -(advantage - advantage.mean()) / advantage.std())
    moved(actor)
    expected = TRPOLoss(actor)(data[:3])
    data["collector", "mask"] = (torch.arange(ROWS) < 3)[:, None, None].expand(ROWS, STEPS, 1)
    found = TRPOLoss(actor)(data)
    for name in ("loss_objective", "kl"):
        torch.testing.assert_close(found[name], expected[name])


def test_the_critic_is_a_choice():
    actor, critic = make_actor(), make_critic()
    data = rollout(actor)
    with pytest.raises(KeyError, match="without a critic"):
        TRPOLoss(actor)(data)
    half, whole = (TRPOLoss(actor, critic, critic_coeff=c)(data) for c in (0.5, None))
    torch.testing.assert_close(half["loss_critic"], 0.5 * whole["loss_critic"])
    none = TRPOLoss(actor, critic, critic_coeff=0.0)
    assert none.out_keys == ["loss_objective", "kl"]
    assert none(data)["loss_objective"] == whole["loss_objective"]
    assert "loss_critic" not in none(data)


def test_what_cannot_be_is_refused():
    actor = make_actor()
    data = rollout(actor)
    data["advantage"] = torch.randn(ROWS, STEPS, 1)
    with pytest.raises(KeyError, match="loc.*parameters of the policy that acted"):
        TRPOLoss(actor)(data.exclude("loc"))
    with pytest.raises(ValueError, match="outer product"):
        TRPOLoss(actor)(data[:, 0].set("advantage", torch.randn(ROWS)))
    for name in ("delay_actor", "entropy_bonus"):
        with pytest.raises(ValueError, match=name):
            TRPOLoss(actor, **{name: True})
