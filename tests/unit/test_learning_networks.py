"""The networks, and what every algorithm does with them."""

import numpy as np
import pytest
import torch
from runs import actor_critic, batch_of, disturbed, one_thread  # noqa: F401
from tensordict import TensorDict

import quadrl
from quadrl.learning.normaliser import Normaliser
from quadrl.learning.numpy_policy import export
from quadrl.learning.ppo import PPO
from quadrl.learning.settings import PPOConfig, TRPOConfig, VPGConfig
from quadrl.learning.trpo import TRPO, flat
from quadrl.learning.vpg import VPG

SIZE = 5
pytestmark = pytest.mark.usefixtures("one_thread")
ALGORITHMS = {PPO: PPOConfig(minibatch=64), TRPO: TRPOConfig(), VPG: VPGConfig(minibatch=64)}


# ---------------------------------------------------------------- the normaliser and the networks


@pytest.mark.parametrize("sizes", [(500,), (1, 1, 1, 1, 1, 200), (3, 497), (100,) * 5])
def test_normaliser_is_the_mean_and_deviation_of_everything(sizes):
    generator = np.random.default_rng(0)
    # Of the last, the sum of squares minus the square of the sum would lose all digits.
    rows = generator.normal([5.0, -3.0, 1e6], [2.0, 100.0, 0.01], (sum(sizes), 3))
    normaliser, first = Normaliser(3), 0
    for size in sizes:
        normaliser.update(torch.from_numpy(rows[first : first + size]).reshape(size, 1, 3))
        first += size
        seen = rows[:first]
        np.testing.assert_allclose(normaliser.mean, seen.mean(0), rtol=1e-12)
        deviation = np.maximum(seen.std(0), 1e-4)  # of one row, it is nothing
        np.testing.assert_allclose(normaliser.deviation, deviation, rtol=1e-5)
    assert normaliser.count == sum(sizes)
    expected = np.clip((rows - rows.mean(0)) / rows.std(0), -10, 10)[:, :2]
    got = normaliser(torch.from_numpy(rows).float())[:, :2]
    np.testing.assert_allclose(got, expected, atol=1e-3)


@pytest.mark.parametrize("hidden", [(), (7,), (16, 5)])
@pytest.mark.parametrize("actions", [4, 6])
def test_an_exported_policy_is_the_actors_mean(hidden, actions, tmp_path):
    actor, _, normalisers = actor_critic(actions=actions, hidden=hidden)
    disturbed(actor)
    observations = 4 * torch.randn(1000, SIZE) + 2
    normalisers["observation"].update(observations[:50])
    policy = export(actor, "hover", {})
    with torch.no_grad():
        mean = actor.get_dist(TensorDict({"observation": observations}, [1000])).mean
    assert (mean.abs() > 1).any() and (mean.abs() < 1).any()
    np.testing.assert_allclose(policy(observations.numpy()), mean.clamp(-1, 1), atol=1e-6)
    policy.save(tmp_path / "policy.safetensors")
    again = quadrl.Policy.load(tmp_path)(observations.numpy())
    np.testing.assert_array_equal(again, policy(observations.numpy()))


def test_actions_start_with_the_deviation_that_was_asked_for():
    actor, _, normalisers = actor_critic(hidden=(16,))
    observations = torch.randn(100, SIZE)
    normalisers["observation"].update(observations)
    with torch.no_grad():
        batch = actor(TensorDict({"observation": observations}, [100]))
    np.testing.assert_allclose(batch["scale"], 0.5, atol=0.02)
    np.testing.assert_allclose(batch["loc"], 0.0, atol=0.05)


# ------------------------------------------------------------------------- every algorithm


@pytest.mark.parametrize("kind", ALGORITHMS)
def test_without_remaining_training_only_trpo_moves_the_policy(kind):
    """Learning rates are zero then; the length of TRPO's step is its bound on the divergence."""
    actor, critic, _ = actor_critic()
    algorithm = kind(actor, critic, ALGORITHMS[kind])
    batch = batch_of(disturbed(actor), SIZE, rows=256)
    before = [
        parameter.detach().clone() for parameter in (*actor.parameters(), *critic.parameters())
    ]
    algorithm.update(batch, remaining=0.0)
    after = [*actor.parameters(), *critic.parameters()]
    moved = [not torch.equal(a, b) for a, b in zip(before, after, strict=True)]
    policy = len(list(actor.parameters()))
    assert any(moved[:policy]) == (kind is TRPO) and not any(moved[policy:])


def test_a_critic_that_is_far_off_does_not_hold_the_policy_back():
    """Each clips its own gradient: with a common norm the policy's would be a millionth here."""
    policies = []
    for target in (0.0, 1e6):
        actor, critic, _ = actor_critic()
        batch = batch_of(disturbed(actor), SIZE, rows=256)
        batch["value_target"][:] = target
        algorithm = PPO(actor, critic, PPOConfig(minibatch=64, max_gradient=0.01))
        algorithm.update(batch, remaining=1.0)
        policies.append(flat([parameter.detach() for parameter in actor.parameters()]))
        for network in (actor, critic):
            norm = flat([parameter.grad for parameter in network.parameters()]).norm().item()
            assert norm == pytest.approx(0.01, rel=1e-3)
    assert torch.equal(*policies)
