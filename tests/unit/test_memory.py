"""Policies that remember: the unit, its gradients, its training, its file, its flights."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers import refused
from policies import WIDTH, make_remembering
from runs import (
    actor_critic,
    assert_same_run,
    changed,
    contents,
    disturbed,
    one_thread,  # noqa: F401
    stopped,
    train,
)
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode

from quadrl import tasks
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly
from quadrl.learning import checkpoint
from quadrl.learning.networks import BEGINS, STATE, Memory, make_actor_critic
from quadrl.learning.numpy_policy import export
from quadrl.learning.ppo import PPO
from quadrl.learning.settings import PPOConfig, TRPOConfig, VPGConfig
from quadrl.learning.train import Training
from quadrl.learning.trpo import TRPO
from quadrl.learning.vpg import VPG
from quadrl.rendering.live.flight import Flight

SIZE, ACTIONS = 5, 2
ROWS, STEPS = 6, 9
RECURRENT = changed(memory="gru", memory_width=WIDTH)
pytestmark = pytest.mark.usefixtures("one_thread")
KINDS = {PPO: PPOConfig(fused=False), TRPO: TRPOConfig(), VPG: VPGConfig()}


def remembering(privileged=0, memory="gru"):
    """Networks whose policy remembers, and whose normaliser has seen something."""
    given = {"memory": memory, "memory_width": WIDTH, "privileged": privileged}
    actor, critic, normalisers = actor_critic(0, SIZE, ACTIONS, **given)
    disturbed(actor)
    normalisers["observation"].update(2 * torch.randn(100, SIZE) + 1)
    return actor, critic, normalisers


def sequences(seed=0):
    """Observations (ROWS, STEPS, SIZE), first states, and begins in the middle and at the first."""
    generator = torch.Generator().manual_seed(seed)
    observation = 2 * torch.randn(ROWS, STEPS, SIZE, generator=generator)
    state = torch.rand(ROWS, WIDTH, generator=generator) - 0.5
    begins = torch.zeros(ROWS, STEPS, 1, dtype=torch.bool)
    begins[0, 3] = begins[1, 1] = begins[1, 2] = begins[2, STEPS - 1] = True
    state[3] = 0.0
    return observation, state, begins


def unrolled(actor, observation, state, begins):
    """Mean and deviation (ROWS, STEPS, ACTIONS) by a loop over time with torch's own unit."""
    (memory,) = (module for module in actor.modules() if isinstance(module, Memory))
    own = memory.cell
    loc, scale = [], []
    for t in range(observation.shape[1]):
        state = torch.where(begins[:, t], torch.zeros_like(state), state)
        seen = memory.normaliser(observation[:, t])
        seen = seen if memory.first is None else memory.first(seen).clamp(min=0)
        weights = (own.weight_ih, own.weight_hh, own.bias_ih, own.bias_hh)
        state = torch.gru_cell(seen, state, *weights)
        read = torch.cat([seen, state], -1) if memory.first is None else state
        mean, deviation = memory.network(read)
        loc.append(mean)
        scale.append(deviation)
    return torch.stack(loc, 1), torch.stack(scale, 1)


def sequence_batch(observation, state, begins):
    states = torch.full((ROWS, STEPS, WIDTH), 9.0)  # only the first counts
    states[:, 0] = state
    entries = {"observation": observation, STATE: states, BEGINS: begins}
    return TensorDict(entries, [ROWS, STEPS])


# ------------------------------------------------------------------- what it computes


@pytest.mark.parametrize("memory", ["gru", "raptor"])
def test_an_exported_policy_flies_a_sequence_as_the_actor_does(memory, tmp_path):
    actor, _, _ = remembering(memory=memory)
    observation, state, begins = sequences()
    observation[4] *= 100 if memory == "raptor" else 1  # its inputs are clipped nowhere
    with torch.no_grad(), set_recurrent_mode():
        mean = actor.get_dist(sequence_batch(observation, state, begins)).mean
    assert (mean.abs() > 1).any() and (mean.abs() < 1).any()
    export(actor, "hover", {}).save(tmp_path / "policy.safetensors")
    policy = Policy.load(tmp_path)
    state = state.numpy()
    for t in range(STEPS):
        state[begins[:, t, 0].numpy()] = policy.initial_state()
        action, state = policy.step(observation[:, t].numpy(), state)
        np.testing.assert_allclose(action, mean[:, t].clamp(-1, 1), atol=2e-6)


@pytest.mark.parametrize(("kind", "memory"), [*((kind, "gru") for kind in KINDS), (PPO, "raptor")])
def test_gradients_are_those_of_a_loop_over_time(kind, memory):
    """Of the surrogate at the policy that acted: of ratio times advantage."""
    actor, critic, _ = remembering(memory=memory)
    observation, state, begins = sequences()
    torch.manual_seed(1)
    batch = sequence_batch(observation, state, begins)
    with torch.no_grad():
        loc, scale = unrolled(actor, observation, state, begins)
        batch["action"] = torch.normal(loc, scale)
        batch["action_log_prob"] = (
            torch.distributions.Normal(loc, scale).log_prob(batch["action"]).sum(-1)
        )
    batch["loc"], batch["scale"] = loc, scale
    batch["advantage"] = torch.randn(ROWS, STEPS, 1)
    batch["value_target"] = torch.randn(ROWS, STEPS, 1)
    loss = kind(actor, critic, KINDS[kind]).loss
    got = torch.autograd.grad(loss(batch.clone())["loss_objective"], list(actor.parameters()))
    loc, scale = unrolled(actor, observation, state, begins)
    log_prob = torch.distributions.Normal(loc, scale).log_prob(batch["action"]).sum(-1)
    # The gradient of a ratio that is 1 is that of its logarithm.
    expected = -(log_prob * batch["advantage"][..., 0]).mean()
    for a, b in zip(got, torch.autograd.grad(expected, list(actor.parameters())), strict=True):
        assert b.abs().max() > 1e-4
        torch.testing.assert_close(a, b, rtol=1e-3, atol=2e-6)


# ------------------------------------------------------------------- training


def batches_of(config, folder):
    """Each batch of a training as it is learned from, with the log-probabilities anew."""
    training, seen = Training(config, folder), []
    update = training.algorithm.update

    def spy(batch, remaining):
        with torch.no_grad(), set_recurrent_mode():
            present = training.actor.get_dist(batch.select(*training.actor.in_keys))
        again = present.log_prob(batch["action"])
        seen.append((batch.clone(), again))
        return update(batch, remaining)

    training.algorithm.update = spy
    training.run()
    return seen


def test_what_is_learned_from_is_what_was_flown(tmp_path):
    """Episodes of ten steps in batches of four: they begin at steps 0, 10 and 20."""
    seen = batches_of(RECURRENT, tmp_path / "run")
    assert len(seen) == 6
    for k, (batch, again) in enumerate(seen):
        assert batch.batch_size == (8, 4)  # whole aircraft
        torch.testing.assert_close(again, batch["action_log_prob"], rtol=0, atol=1e-5)
        steps = range(4 * k, 4 * k + 4)
        assert (batch[BEGINS][0, 1:, 0].tolist()) == [t % 10 == 0 for t in steps[1:]]
        assert (batch[STATE] == 0).all(-1)[0].tolist() == [t % 10 == 0 for t in steps]


@pytest.mark.parametrize("memory", ["none", "gru"])
def test_a_minibatch_holds_as_many_transitions(memory):
    config = PPOConfig(minibatch=48, fused=memory == "none")
    algorithm = PPO(*make_actor_critic(3, 2, changed(memory=memory))[:2], config)
    for size, rows in (([256, 16], 3), ([256 * 16], 48), ([4, 100], 1)):
        assert len(next(algorithm.minibatches(TensorDict({}, size), epochs=1))) == rows


def test_it_continues_bit_for_bit(tmp_path):
    """What a slow test holds of every algorithm, with the state of the memory beside it."""
    config = dataclasses.replace(RECURRENT, task="target_following", training_options={})
    alone = train(config, tmp_path / "alone")
    # Checkpoints are those of the iteration before: at step 4 of an episode, and where all begin.
    stopped(config, tmp_path / "run", 2)
    stopped(config, tmp_path / "run", 6, resume=True)
    assert_same_run(alone, train(config, tmp_path / "run", resume=True))


def test_a_checkpoint_without_the_memory_is_refused(tmp_path):
    folder = stopped(RECURRENT, tmp_path / "run", 3)
    path = folder / checkpoint.CHECKPOINT
    tensors, numbers = checkpoint.load(path)
    for damaged in (
        {k: v for k, v in tensors["environment"].items() if k != STATE},
        tensors["environment"] | {STATE: torch.zeros(8, WIDTH + 1)},
    ):
        checkpoint.save(path, tensors | {"environment": damaged}, numbers)
        before = contents(folder)
        with refused(match=str(path)):
            Training(RECURRENT, folder, resume=True)
        assert contents(folder) == before


# ------------------------------------------------------------------- the privileged critic


@pytest.mark.parametrize("memory", ["none", "gru"])
def test_the_critic_alone_reads_what_is_privileged(tmp_path, memory):
    drawn = {"mass": (0.9, 1.1)}
    config = changed(memory=memory, observe={"privileged": True}, randomization=drawn)
    training = Training(config, tmp_path / "run")
    assert training.critic.in_keys == ["observation", "privileged"]
    assert "privileged" not in training.actor.in_keys
    policy, told = training.run(), training.env.environment.privileged
    assert policy.size == training.env.environment.size
    assert training.normalisers["privileged"].mean.shape == told.shape[1:]
    assert (training.normalisers["privileged"].mean != 0).any()  # it has seen something
    stopped(config, tmp_path / "other", 3)
    assert_same_run(tmp_path / "run", train(config, tmp_path / "other", resume=True))


# ------------------------------------------------------------------- the policy


def test_it_does_not_forget_in_silence():
    policy = make_remembering()
    for call in (policy, policy.sampled):
        with refused(match="flying"):
            call(0)
    assert "memory of 7" in repr(policy) and policy.state_size == WIDTH
    plain = Policy.pretrained("hover")
    assert plain.state_size == 0 and plain.initial_state(3).shape == (3, 0)


@pytest.mark.parametrize(
    ("observation", "state"),
    [((3, 22), (2, WIDTH)), ((3, 22), (3, WIDTH + 1)), ((22,), (1, WIDTH)), ((3, 22), (WIDTH,))],
)
def test_a_state_of_another_shape_is_refused(observation, state):
    with refused(name="state shape", value=state):
        make_remembering().step(np.zeros(observation), np.zeros(state))


def test_a_flyer_remembers_and_forgets_rows():
    policy = make_remembering()
    observation = np.random.default_rng(1).normal(size=(4, 3, 22))
    flyer, state = policy.flying(3), policy.initial_state(3)
    for seen in observation[:3]:
        expected, state = policy.step(seen, state)
        np.testing.assert_array_equal(flyer(seen), expected)
    first, _ = policy.step(observation[3], policy.initial_state(3))
    later, _ = policy.step(observation[3], state)
    assert (first != later).any(-1).all()
    flyer.reset(np.array([False, True, False]))
    mixed = flyer(observation[3])
    np.testing.assert_array_equal(mixed, np.where([[False], [True], [False]], first, later))
    flyer.reset()
    np.testing.assert_allclose(flyer(observation[3]), first, atol=1e-7)
    alone = policy.flying()
    np.testing.assert_allclose(alone(observation[3, 0]), first[0], atol=1e-6)


@pytest.mark.parametrize("policy", [make_remembering(), Policy.pretrained("hover")], ids=repr)
def test_every_policy_flies_with_its_memory(policy):
    rollout = fly(policy, "hover", episodes=3)
    environment = Environment("hover", num_envs=3, seed=1 << 53)
    observation, state = environment.flatten(environment.reset()), policy.initial_state(3)
    for taken in rollout.action[: rollout.length.min()]:
        action, state = policy.step(observation, state)
        np.testing.assert_array_equal(taken, action)
        observation = environment.flatten(environment.step(action).observation)
    again = fly(policy.flying(3), "hover", episodes=3)
    np.testing.assert_array_equal(again.action, rollout.action)


def test_sampled_actions_of_a_memory_are_those_of_its_seed():
    policy = make_remembering()
    one, other = (evaluate(policy, episodes=3, sampled=True).metrics for _ in range(2))
    assert one == other != evaluate(policy, episodes=3).metrics


def test_a_sampled_policy_commands_what_it_was_trained_to():
    # Velocity setpoints of zero hold an aircraft in the air; as rotor commands they would, too, but
    # a policy with a mode is not to be flown in another.
    policy = make_remembering(control_mode="velocity")
    assert policy.flying(2, seed=0).control_mode == "velocity"
    with refused("control_mode"):
        fly(policy.flying(2, seed=0), "hover", episodes=2, control_mode="rotor")


def test_a_live_flight_forgets_the_rows_that_begin_anew():
    task = tasks.make("hover", time_limit=0.2)
    flight = Flight(make_remembering(), Scenario.of(task), num_envs=2)
    for _ in range(4):  # to the end of the episodes
        flight.step()
    assert flight.episodes == 2 and (flight._act.state == 0).all()
    flight.step()
    assert (flight._act.state != 0).all()
    flight.reset()
    assert (flight._act.state == 0).all()
