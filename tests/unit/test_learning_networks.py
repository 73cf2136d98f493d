"""The networks, and TRPO against its definition."""

import copy

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch.func import functional_call, jacrev

import quadrl
from quadrl.learning.algorithm_config import PPOConfig, TRPOConfig, VPGConfig
from quadrl.learning.config import TrainConfig
from quadrl.learning.networks import Normaliser, export, make_actor_critic
from quadrl.learning.ppo import PPO
from quadrl.learning.trpo import TRPO, conjugate_gradients, fisher_product, flat
from quadrl.learning.vpg import VPG

SIZE, ACTIONS, ROWS = 5, 2, 24
ALGORITHMS = {PPO: PPOConfig(minibatch=64), TRPO: TRPOConfig(), VPG: VPGConfig(minibatch=64)}


@pytest.fixture(autouse=True)
def one_thread():
    """As in a training: on a busy machine a second one costs more than it gives."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def actor_critic(seed=0, size=SIZE, actions=ACTIONS, hidden=(6,)):
    torch.manual_seed(seed)
    config = TrainConfig(hidden=hidden, critic_hidden=(6,), initial_deviation=0.5)
    actor, critic, normalisers = make_actor_critic(size, actions, config)
    return actor, critic, normalisers["observation"]


def disturbed(actor):
    """Away from the start, where the mean hardly depends on the weights."""
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
    return actor


def batch_of(actor, seed=0, rows=ROWS):
    torch.manual_seed(seed)
    batch = TensorDict({"observation": torch.randn(rows, SIZE)}, [rows])
    with torch.no_grad():
        batch = actor(batch)
    # Better the nearer the first action is to 0.5: an advantage that a policy can climb.
    advantage = -(batch["action"][:, :1] - 0.5).square()
    batch["advantage"] = (advantage - advantage.mean()) / advantage.std()
    batch["value_target"] = batch["observation"][:, :1].clone()
    return batch


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
    actor, _, normaliser = actor_critic(actions=actions, hidden=hidden)
    disturbed(actor)
    observations = 4 * torch.randn(1000, SIZE) + 2
    normaliser.update(observations[:50])
    policy = export(actor, "hover", {})
    with torch.no_grad():
        mean = actor.get_dist(TensorDict({"observation": observations}, [1000])).mean
    assert (mean.abs() > 1).any() and (mean.abs() < 1).any()
    np.testing.assert_allclose(policy(observations.numpy()), mean.clamp(-1, 1), atol=1e-6)
    policy.save(tmp_path / "policy.safetensors")
    again = quadrl.Policy.load(tmp_path)(observations.numpy())
    np.testing.assert_array_equal(again, policy(observations.numpy()))


def test_actions_start_with_the_deviation_that_was_asked_for():
    actor, _, normaliser = actor_critic(hidden=(16,))
    observations = torch.randn(100, SIZE)
    normaliser.update(observations)
    with torch.no_grad():
        batch = actor(TensorDict({"observation": observations}, [100]))
    np.testing.assert_allclose(batch["scale"], 0.5, atol=0.02)
    np.testing.assert_allclose(batch["loc"], 0.0, atol=0.05)


# ------------------------------------------------------------------------- every algorithm


@pytest.mark.parametrize("kind", ALGORITHMS)
def test_an_update_learns_and_its_optimisers_are_restored_bit_for_bit(kind):
    def made(seed):
        actor, critic, _ = actor_critic(seed)
        return kind(actor, critic, ALGORITHMS[kind])

    one = made(0)
    actor = disturbed(actor_critic(1)[0])
    batch = batch_of(actor, rows=256)
    first = one.update(batch, remaining=1.0)["critic_loss"]
    weights = [parameter.detach().clone() for parameter in one.parameters]
    other = made(2)
    with torch.no_grad():
        for parameter, weight in zip(other.parameters, weights, strict=True):
            parameter.copy_(weight)
    other.restore(copy.deepcopy(one.save()))  # the tensors are live
    for algorithm in (one, other):
        torch.manual_seed(3)
        last = [algorithm.update(batch, remaining=0.5)["critic_loss"] for _ in range(3)][-1]
        assert last < first
    for a, b in zip(one.parameters, other.parameters, strict=True):
        assert torch.equal(a, b)
    assert any((a != b).any() for a, b in zip(one.parameters, weights, strict=True))


@pytest.mark.parametrize("kind", ALGORITHMS)
def test_without_remaining_training_only_trpo_moves_the_policy(kind):
    """Learning rates are zero then; the length of TRPO's step is its bound on the divergence."""
    actor, critic, _ = actor_critic()
    algorithm = kind(actor, critic, ALGORITHMS[kind])
    batch = batch_of(disturbed(actor), rows=256)
    before = [
        parameter.detach().clone() for parameter in (*actor.parameters(), *critic.parameters())
    ]
    algorithm.update(batch, remaining=0.0)
    after = [*actor.parameters(), *critic.parameters()]
    moved = [not torch.equal(a, b) for a, b in zip(before, after, strict=True)]
    policy = len(list(actor.parameters()))
    assert any(moved[:policy]) == (kind is TRPO) and not any(moved[policy:])


# ---------------------------------------------------------------------------- TRPO


def explicit_fisher(actor, observation):
    """Mean over states of J^T diag(1 / sigma^2, 2) J, of mean and log-deviation (normal)."""
    network = actor.module[0].module
    parameters = dict(network.named_parameters())

    def outputs(values, row):
        mean, deviation = functional_call(network, values, (row,))
        return torch.cat([mean, deviation.log()])

    total = 0
    for row in observation:
        jacobian = jacrev(outputs)(parameters, row)
        matrix = torch.cat(
            [jacobian[name].reshape(2 * ACTIONS, -1) for name in parameters], dim=1
        ).double()
        deviation = network(row)[1].detach().double()
        weight = torch.cat([deviation**-2, torch.full((ACTIONS,), 2.0, dtype=torch.float64)])
        total = total + matrix.T @ (weight[:, None] * matrix)
    return total / len(observation)


def trpo(seed=0, **settings):
    actor, critic, _ = actor_critic(seed)
    return disturbed(actor), TRPO(actor, critic, TRPOConfig(**settings))


def test_fisher_product_is_the_explicit_fisher_matrix():
    actor, algorithm = trpo()
    batch = batch_of(actor)
    _, kl = algorithm.loss.surrogate_and_kl(batch)
    product = fisher_product(kl, algorithm.policy, damping=0.0)
    fisher = explicit_fisher(actor, batch["observation"])
    torch.manual_seed(1)
    vector = torch.randn(len(fisher), dtype=torch.float64)
    expected = fisher @ vector
    torch.testing.assert_close(product(vector), expected, rtol=1e-4, atol=1e-4)
    damped = fisher_product(kl, algorithm.policy, damping=0.5)
    torch.testing.assert_close(damped(vector), expected + 0.5 * vector, rtol=1e-4, atol=1e-4)


def test_kl_of_two_normals_in_closed_form():
    """Per state and action: log(s2/s1) + (s1^2 + (m1 - m2)^2) / (2 s2^2) - 1/2."""
    actor, algorithm = trpo()
    batch = batch_of(actor)
    mean, deviation = batch["loc"].double(), batch["scale"].double()
    batch["loc"], batch["scale"] = batch["loc"] + 0.1, batch["scale"] * 1.5
    first, spread = batch["loc"].double(), batch["scale"].double()
    _, kl = algorithm.loss.surrogate_and_kl(batch)
    expected = (deviation / spread).log() - 0.5
    expected = expected + (spread**2 + (first - mean) ** 2) / (2 * deviation**2)
    np.testing.assert_allclose(kl.item(), expected.sum(-1).mean().item(), rtol=1e-5)
    losses = algorithm.loss(batch)
    assert losses["kl"] == kl
    assert losses["loss_critic"] == algorithm.critic_loss(batch)


def test_conjugate_gradients_solve():
    generator = np.random.default_rng(0)
    root = generator.normal(size=(30, 30))
    matrix = torch.from_numpy(root @ root.T + np.eye(30))
    target = torch.from_numpy(generator.normal(size=30))
    solution = conjugate_gradients(lambda x: matrix @ x, target, 60, tolerance=1e-24)
    torch.testing.assert_close(solution, torch.linalg.solve(matrix, target), rtol=1e-9, atol=1e-9)
    few = conjugate_gradients(lambda x: matrix @ x, target, 3)
    assert torch.linalg.norm(matrix @ few - target) > 1e-3  # the limit on iterations holds


def test_the_step_is_the_exact_natural_gradient():
    """sqrt(2 delta / g^T F^-1 g) F^-1 g, with F the explicit matrix and all iterations."""
    actor, algorithm = trpo(max_kl=1e-4, damping=0.1, iterations=400)
    batch = batch_of(actor)
    surrogate, _ = algorithm.loss.surrogate_and_kl(batch)
    gradient = flat(torch.autograd.grad(surrogate, algorithm.policy)).double()
    fisher = explicit_fisher(actor, batch["observation"]) + 0.1 * torch.eye(len(gradient))
    direction = torch.linalg.solve(fisher, gradient)
    expected = direction * torch.sqrt(2 * 1e-4 / (gradient @ direction))
    before = flat([p.detach() for p in algorithm.policy]).double()
    metrics = algorithm.natural_step(batch)
    moved = flat([p.detach() for p in algorithm.policy]).double() - before
    assert metrics["step"] > 0
    torch.testing.assert_close(moved, metrics["step"] * expected, rtol=1e-2, atol=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_no_step_breaks_the_bound_or_loses(seed):
    actor, algorithm = trpo(seed, max_kl=0.01)
    for k in range(6):
        batch = batch_of(actor, seed=100 * seed + k, rows=256)
        with torch.no_grad():
            before, _ = algorithm.loss.surrogate_and_kl(batch)
        metrics = algorithm.natural_step(batch)
        with torch.no_grad():
            after, kl = algorithm.loss.surrogate_and_kl(batch)
        assert kl.item() <= 0.01
        assert after.item() >= before.item()
        assert metrics["kl"] == pytest.approx(kl.item(), abs=1e-6)
        assert metrics["step"] > 0 and metrics["surrogate_gain"] > 0


def test_a_search_that_finds_nothing_leaves_the_policy():
    actor, algorithm = trpo(max_kl=1e4, backtracks=1)
    before = flat([p.detach() for p in algorithm.policy]).clone()
    assert algorithm.natural_step(batch_of(actor))["step"] == 0.0
    assert torch.equal(flat([p.detach() for p in algorithm.policy]), before)
