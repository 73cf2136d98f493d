"""A batch whose step is one text: built for a processor it has the bits of `Environment`."""

import dataclasses

import numpy as np
import pytest
import torch

from quadrl.base.errors import QuadrlError
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.device import launch
from quadrl.device.batch import Batch
from quadrl.device.text import text

AIRCRAFT, STEPS = 24, 60
CASES = [
    pytest.param("hover", {}, id="hover"),
    pytest.param("race", {"control_mode": "thrust_body_rate"}, id="race with loops"),
    pytest.param("trajectory", {"vehicle": "hexa"}, id="trajectory of a hexacopter"),
]


@pytest.fixture(autouse=True)
def _quickly(monkeypatch):
    monkeypatch.setenv("QUADRL_CFLAGS", "-O1")  # a third of the time to compile


def scenario(task="hover", **settings):
    return Scenario.of(task, engine="free_flight", **settings)


def flat(terms):
    return np.concatenate(list(terms.values()), axis=-1)


def flags(done):
    named = done.terminated, done.truncated, done.is_success, done.diverged
    return np.stack([*named, *done.ends.values()])


def same_flights(batch, environment, steps=STEPS):
    """Fly both; whether all that they give is the same. How many episodes ended."""
    rng, ended = np.random.default_rng(2), 0
    if not np.array_equal(flat(environment.reset()), batch.reset().numpy()):
        return -1
    for _ in range(steps):
        batch.action[0].copy_(torch.from_numpy(rng.normal(0, 0.5, batch.action[0].shape)))
        done, found = environment.step(batch.action[0].numpy()), batch.step()
        for own, expected in (
            (found.final, flat(done.observation)),
            (found.reward, done.reward),
            (found.error, done.error),
            (found.terms, np.stack([*done.reward_terms.values()])),
            (torch.cat([batch.flags[0, 1:]]), flags(done)),
        ):
            if not np.array_equal(own.numpy(), expected):
                return -1
        over = done.terminated | done.truncated
        ended += over.sum()
        if over.any():
            begun = flat(environment.reset(over))
            if not np.array_equal(found.observation.numpy()[over], begun):
                return -1
    return ended


@pytest.mark.parametrize(("task", "settings"), CASES)
def test_a_batch_flies_the_bits_of_an_environment(task, settings):
    flown = scenario(task, **settings)
    batch = Batch(flown, AIRCRAFT, 3, "cpu", "float64")
    assert same_flights(batch, Environment(flown, num_envs=AIRCRAFT, seed=3)) > 0


@pytest.mark.parametrize(
    ("planted", "instead"),
    [
        ("round < 10", "round < 9"),
        ("SUBSTEPS = 5", "SUBSTEPS = 4"),
        ("weight[4] = {1, 2, 2, 1}", "weight[4] = {1, 2, 2, 1.0000000000000002}"),
        ("= episode + 1;", "= episode + 2;"),
        ("force[k] -= drag", "force[k] += drag"),
        ("sound ? m[k][0] : last[k][0]", "last[k][0]"),
    ],
)
def test_a_planted_error_is_seen(planted, instead, monkeypatch):
    whole = launch.compile_generated

    def compiled(source):
        assert planted in source
        return whole(source.replace(planted, instead))

    monkeypatch.setattr(launch, "compile_generated", compiled)
    flown = scenario()
    batch = Batch(flown, AIRCRAFT, 3, "cpu", "float64")
    assert same_flights(batch, Environment(flown, num_envs=AIRCRAFT, seed=3)) == -1


def test_single_precision_is_near_double():
    exact, fast = (Batch(scenario(), AIRCRAFT, 3, "cpu", p) for p in ("float64", "float32"))
    exact.reset(), fast.reset()
    for _ in range(STEPS):
        fast.table.copy_(exact.table)
        fast.episodes.copy_(exact.episodes)
        exact.action[0].normal_(0, 0.4)
        fast.action[0].copy_(exact.action[0])
        exact.action[0].copy_(fast.action[0])
        over = exact.step().over | fast.step().over
        motion, other = (b.table[: b.layout.motion, ~over].double() for b in (exact, fast))
        assert ((motion - other).abs() / (1 + motion.abs())).max() < 1e-5


def test_no_number_of_single_precision_is_a_double():
    environment = Environment(scenario())
    environment.reset()
    whole = text(environment, "float32")
    assert "double" not in whole.replace("__longlong_as_double", "").partition("enum { ROTORS")[2]


def test_a_batch_that_is_restored_continues():
    first, other = (Batch(scenario(), AIRCRAFT, 3, "cpu") for _ in range(2))
    first.reset()
    actions = torch.rand(40, *first.action[0].shape) - 0.5
    for action in actions[:20]:
        first.action[0].copy_(action)
        first.step()
    saved = first.save()
    assert torch.equal(other.restore(saved), first.slots[0].observation)
    for action in actions[20:]:
        for batch in (first, other):
            batch.action[0].copy_(action)
            batch.step()
        assert torch.equal(first.out, other.out) and torch.equal(first.flags, other.flags)
    with pytest.raises(QuadrlError, match="table"):
        Batch(scenario("race"), AIRCRAFT, 3, "cpu").restore(saved)


def test_a_row_goes_on_in_an_environment():
    batch, one = Batch(scenario(), 5, 3, "cpu", "float64"), Environment(scenario())
    batch.reset()
    for _ in range(10):
        batch.action[0].normal_(0, 0.3)
        batch.step()
    assert np.array_equal(flat(one.restore(batch.row(2)))[0], batch.slots[0].observation[2])
    batch.action[0].normal_(0, 0.3)
    done = one.step(batch.action[0, 2:3].numpy())
    assert np.array_equal(flat(done.observation)[0], batch.step().final[2])


def test_what_is_no_number_is_told():
    batch = Batch(scenario(), 5, 3, "cpu")
    batch.reset()
    batch.action[0, 3, 1] = float("nan")
    batch.step()
    with pytest.raises(QuadrlError, match=r"action .*aircraft 3"):
        batch.step()
    batch.action.zero_()
    batch.step()  # it is told once


@pytest.mark.parametrize(
    ("task", "settings", "what"),
    [
        ("landing", {}, "contact"),
        ("hover", {"weather": "light"}, "wind"),
        ("hover", {"observe": {"rotor_speed": "estimated"}}, "sensors"),
        ("hover", {"randomization": "light"}, "randomization"),
        ("hover", {"events": "battery"}, "events"),
    ],
)
def test_what_is_not_covered_is_refused(task, settings, what):
    with pytest.raises(QuadrlError, match=f"on a GPU has no {what}.*allowed: device 'cpu'"):
        Batch(scenario(task, **settings), 5, 3, "cpu")


def test_it_flies_in_free_flight_alone():
    with pytest.raises(QuadrlError, match="engine 'mujoco'"):
        Batch(dataclasses.replace(scenario(), engine="mujoco"), 5, 3, "cpu")
