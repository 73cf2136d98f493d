"""The update of TRPO against its definition, and its line search."""

import numpy as np
import pytest
import torch
from runs import actor_critic, batch_of, disturbed, one_thread  # noqa: F401
from tensordict import TensorDict
from torch.func import functional_call, jacrev
from torchrl.modules import set_recurrent_mode

from quadrl.learning.networks import BEGINS, STATE
from quadrl.learning.settings import TRPOConfig
from quadrl.learning.trpo import TRPO, conjugate_gradients, flat

SIZE, ACTIONS, ROWS = 5, 2, 24
pytestmark = pytest.mark.usefixtures("one_thread")


def trpo(seed=0, memory="none", **settings):
    """A policy away from the start, and its update."""
    actor, critic, _ = actor_critic(seed, SIZE, ACTIONS, memory=memory, memory_width=4)
    return disturbed(actor), TRPO(actor, critic, TRPOConfig(**settings))


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
    batch = batch_of(actor, SIZE)
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


@pytest.mark.parametrize("seed", range(3))
def test_no_step_breaks_the_bound_or_loses(seed):
    actor, algorithm = trpo(seed, max_kl=0.01)
    for k in range(6):
        batch = batch_of(actor, SIZE, seed=100 * seed + k, rows=256)
        with torch.no_grad():
            before, _ = algorithm.loss.surrogate_and_kl(batch)
        metrics = algorithm.natural_step(batch)
        with torch.no_grad():
            after, kl = algorithm.loss.surrogate_and_kl(batch)
        assert kl.item() <= 0.01
        assert after.item() >= before.item()
        assert metrics["kl"] == pytest.approx(kl.item(), abs=1e-6)
        assert metrics["step"] > 0 and metrics["surrogate_gain"] > 0


@pytest.mark.parametrize("cause", ["no iteration", "no gain", "not a number", "a bound too wide"])
def test_without_a_step_the_policy_stays_bit_for_bit(cause):
    wide = {"max_kl": 1e4, "backtracks": 1} if cause == "a bound too wide" else {}
    actor, algorithm = trpo(**{"max_kl": 0.02, "backtracks": 3} | wide)
    batch = batch_of(actor, SIZE)
    if cause == "no gain":
        batch["advantage"] = torch.zeros(ROWS, 1)
    if cause == "not a number":
        batch["advantage"][0] = float("nan")
    before = flat([p.detach() for p in algorithm.policy]).clone()
    if cause == "no iteration":
        algorithm.shorter = lambda _: 1.0
        algorithm.loss.surrogate_and_kl = refusing(algorithm.loss.surrogate_and_kl)
    metrics = algorithm.natural_step(batch)
    assert metrics == {"kl": 0.0, "step": 0.0, "surrogate_gain": 0.0}
    assert torch.equal(flat([p.detach() for p in algorithm.policy]), before)


def refusing(evaluate):
    """Of a tried step, the surrogate is lower whatever it is."""

    def lower(batch):
        surrogate, kl = evaluate(batch)
        return (surrogate, kl) if surrogate.requires_grad else (surrogate - 1e3, kl)

    return lower


def test_a_policy_with_a_memory_keeps_the_bound():
    """Its batch is (aircraft, time), and each divergence is that of the unrolled memory."""
    actor, algorithm = trpo(memory="gru", max_kl=0.01)
    torch.manual_seed(2)
    rows, steps = 16, 6
    begins = torch.rand(rows, steps, 1) < 0.2
    batch = TensorDict({"observation": torch.randn(rows, steps, SIZE)}, [rows, steps])
    batch[STATE], batch[BEGINS] = torch.zeros(rows, steps, 4), begins
    with torch.no_grad(), set_recurrent_mode():
        batch = actor(batch)
        batch["advantage"] = torch.randn(rows, steps, 1)
        batch["value_target"] = torch.randn(rows, steps, 1)
        before, _ = algorithm.loss.surrogate_and_kl(batch)
    metrics = algorithm.update(batch, remaining=1.0)
    assert metrics["step"] > 0
    losses = algorithm.loss(batch)  # it unrolls the memory by itself
    assert losses["kl"].item() == pytest.approx(metrics["kl"], rel=1e-3) and metrics["kl"] <= 0.01
    assert -losses["loss_objective"].item() > before.item()
