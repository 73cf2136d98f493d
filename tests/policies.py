"""Policies that are small enough to be worked out by hand, or of random numbers."""

import dataclasses

import numpy as np

from quadrl.evaluation.memory import GRU
from quadrl.evaluation.policy import Policy
from quadrl.learning.config import TrainConfig

WIDTH = 7
"""Numbers that a policy of `make_remembering` remembers."""
NEURONS = 11
"""Of the layer before that memory."""


def make_policy(**changes) -> Policy:
    """A network small enough to be worked out by hand: 3 inputs, 2 hidden units, 4 actions."""
    values = dict(
        weights=(
            np.array([[1, 0, 0], [0, 1, 0]], np.float32),
            np.array([[1, 0], [0, 1], [1, 1], [9, 9], [0, 0], [0, 0], [0, 0], [0, 0]], np.float32),
        ),
        biases=(np.zeros(2, np.float32), np.array([0, 0.5, 0, 0, -1, -1, -1, -1], np.float32)),
        mean=np.array([1, 2, 3], np.float32),
        deviation=np.array([2, 4, 1], np.float32),
        task="hover",
        metadata={"algo": "ppo", "seed": 3, "task_options": {"time_limit": 5}},
    )
    return Policy(**{**values, **changes})


def linear(inputs: int, actions: int, **metadata) -> Policy:
    """One layer of zeros, for any layout."""
    zeros = np.zeros(2 * actions, np.float32)
    weights = (np.zeros((2 * actions, inputs), np.float32),)
    mean = np.zeros(inputs, np.float32)
    return Policy(weights, (zeros,), mean, mean + 1, "hover", metadata)


def make_remembering(seed=0, size=22, actions=4, alone=False, **metadata) -> Policy:
    """One layer behind a memory, of random numbers, for hover; alone, with a layer before it."""
    random = np.random.default_rng(seed)

    def array(*shape):
        return random.normal(0, 0.3, shape).astype(np.float32)

    first = (array(NEURONS, size), array(NEURONS)) if alone else ()
    inputs, read = (NEURONS, WIDTH) if alone else (size, size + WIDTH)
    gates = array(3 * WIDTH, inputs), array(3 * WIDTH, WIDTH), array(3 * WIDTH), array(3 * WIDTH)
    unit = GRU(*gates, *first)
    weights, biases = (array(2 * actions, read),), (array(2 * actions),)
    return Policy(weights, biases, array(size), array(size) + 2, "hover", metadata, unit)


def make_raptor(memory=None, **settings) -> Policy:
    """Random numbers in the shape that PX4's mc_raptor flies, but for what is given."""
    rng, config = np.random.default_rng(0), TrainConfig("hover", variant="raptor", **settings)

    def drawn(*shape):
        return rng.normal(0, 0.4, shape).astype(np.float32)

    unit = GRU(drawn(48, 16), drawn(48, 16), drawn(48), drawn(48), 1024 * drawn(16, 22), drawn(16))
    scale = np.full(22, 1024, np.float32)  # clipped nowhere, as a training writes them
    record = config.resolved()["scenario"] | {"variant": "raptor"}
    record["observe"] = dataclasses.asdict(config.scenario.observe)
    return Policy((drawn(8, 16),), (drawn(8),), drawn(22), scale, "hover", record, memory or unit)


def parts(policy: Policy) -> dict[str, np.ndarray]:
    """Its arrays by their names in a file."""
    arrays = {"mean": policy.mean, "deviation": policy.deviation}
    for k, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        arrays |= {f"weight_{k}": weight, f"bias_{k}": bias}
    return arrays | (policy.memory.arrays() if policy.memory else {})
