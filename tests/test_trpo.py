"""TRPO against its definition: the Fisher matrix, the natural gradient, the bound, the search."""

import dataclasses

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch.func import functional_call, jacrev

from quadrl.learning.config import TRPOConfig
from quadrl.learning.policy import make_actor_critic
from quadrl.learning.trpo import TRPO, conjugate_gradients, fisher_product, flat

SIZE, ACTIONS, ROWS = 5, 2, 24


def actor_critic(seed=0):
    torch.manual_seed(seed)
    actor, critic, _ = make_actor_critic(
        SIZE, ACTIONS, hidden=(6,), critic_hidden=(6,), initial_deviation=0.5
    )
    with torch.no_grad():  # away from the start, where the mean hardly depends on the weights
        for parameter in actor.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
    return actor, critic


def batch_of(actor, seed=0, rows=ROWS):
    torch.manual_seed(seed)
    batch = TensorDict({"observation": torch.randn(rows, SIZE)}, [rows])
    with torch.no_grad():
        batch = actor(batch)
    action = batch["action"]
    # Better the nearer the first action is to 0.5: an advantage that a policy can climb.
    advantage = -(action[:, :1] - 0.5).square()
    batch["advantage"] = (advantage - advantage.mean()) / advantage.std()
    batch["value_target"] = batch["observation"][:, :1].clone()
    return batch


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


def test_fisher_product_is_the_explicit_fisher_matrix():
    actor, critic = actor_critic()
    batch = batch_of(actor)
    trpo = TRPO(actor, critic, TRPOConfig())
    _, kl = trpo.loss.surrogate_and_kl(batch)
    product = fisher_product(kl, trpo.policy, damping=0.0)
    fisher = explicit_fisher(actor, batch["observation"])
    torch.manual_seed(1)
    for _ in range(3):
        vector = torch.randn(len(fisher), dtype=torch.float64)
        expected = fisher @ vector
        torch.testing.assert_close(product(vector), expected, rtol=1e-4, atol=1e-4)
    damped = fisher_product(kl, trpo.policy, damping=0.5)
    torch.testing.assert_close(damped(vector), expected + 0.5 * vector, rtol=1e-4, atol=1e-4)


def test_kl_of_two_normals_in_closed_form():
    """One state, one action: log(s2/s1) + (s1^2 + (m1 - m2)^2) / (2 s2^2) - 1/2."""
    actor, critic = actor_critic()
    batch = batch_of(actor)
    acting_mean, acting_deviation = batch["loc"] + 0.1, batch["scale"] * 1.5
    shifted = batch.clone()
    shifted["loc"], shifted["scale"] = acting_mean, acting_deviation
    _, kl = TRPO(actor, critic, TRPOConfig()).loss.surrogate_and_kl(shifted)
    mean, deviation = batch["loc"].double(), batch["scale"].double()
    first, spread = acting_mean.double(), acting_deviation.double()
    expected = (deviation / spread).log() - 0.5
    expected = expected + (spread**2 + (first - mean) ** 2) / (2 * deviation**2)
    np.testing.assert_allclose(kl.item(), expected.sum(-1).mean().item(), rtol=1e-5)


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
    actor, critic = actor_critic()
    batch = batch_of(actor)
    config = TRPOConfig(max_kl=1e-4, damping=0.1, iterations=400)
    trpo = TRPO(actor, critic, config)
    surrogate, _ = trpo.loss.surrogate_and_kl(batch)
    gradient = flat(torch.autograd.grad(surrogate, trpo.policy)).double()
    fisher = explicit_fisher(actor, batch["observation"]) + 0.1 * torch.eye(len(gradient))
    direction = torch.linalg.solve(fisher, gradient)
    expected = direction * torch.sqrt(2 * config.max_kl / (gradient @ direction))
    before = flat([p.detach() for p in trpo.policy]).double()
    figures = trpo.step(batch)
    moved = flat([p.detach() for p in trpo.policy]).double() - before
    assert figures["step"] > 0
    torch.testing.assert_close(moved, figures["step"] * expected, rtol=1e-2, atol=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_no_step_breaks_the_bound_or_loses(seed):
    actor, critic = actor_critic(seed)
    trpo = TRPO(actor, critic, TRPOConfig(max_kl=0.01))
    for k in range(6):
        batch = batch_of(actor, seed=100 * seed + k, rows=256)
        with torch.no_grad():
            before, _ = trpo.loss.surrogate_and_kl(batch)
        figures = trpo.step(batch)
        with torch.no_grad():
            after, kl = trpo.loss.surrogate_and_kl(batch)
        assert kl.item() <= 0.01
        assert after.item() >= before.item()
        assert figures["kl"] == pytest.approx(kl.item(), abs=1e-6)
        assert figures["step"] > 0 and figures["surrogate_gain"] > 0


def test_a_search_that_finds_nothing_leaves_the_policy():
    actor, critic = actor_critic()
    trpo = TRPO(actor, critic, TRPOConfig(max_kl=1e4, backtracks=1))
    before = flat([p.detach() for p in trpo.policy]).clone()
    assert trpo.step(batch_of(actor))["step"] == 0.0
    torch.testing.assert_close(flat([p.detach() for p in trpo.policy]), before, rtol=0, atol=0)


def test_update_fits_the_critic_and_its_optimiser_comes_back():
    actor, critic = actor_critic()
    trpo = TRPO(actor, critic, dataclasses.replace(TRPOConfig(), minibatch=32, critic_epochs=20))
    batch = batch_of(actor, rows=256)
    losses = [trpo.update(batch, remaining=1.0)["critic_loss"] for _ in range(5)]
    assert losses[-1] < 0.5 * losses[0]
    other = TRPO(actor, critic, trpo.config)
    other.restore(trpo.save())
    for name, tensor in trpo.save()["0"].items():
        torch.testing.assert_close(other.save()["0"][name], tensor, rtol=0, atol=0)
