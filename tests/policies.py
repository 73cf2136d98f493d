"""Policies that are small enough to be worked out by hand, or of random numbers."""

import numpy as np

from quadrl.evaluation.memory import GRU
from quadrl.evaluation.policy import Policy

WIDTH = 7
"""Numbers that a policy of `make_remembering` remembers."""


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


def make_remembering(seed=0, size=22, actions=4, **metadata) -> Policy:
    """One layer behind a memory, of random numbers, for hover."""
    random = np.random.default_rng(seed)

    def array(*shape):
        return random.normal(0, 0.3, shape).astype(np.float32)

    unit = GRU(array(3 * WIDTH, size), array(3 * WIDTH, WIDTH), array(3 * WIDTH), array(3 * WIDTH))
    weights, biases = (array(2 * actions, size + WIDTH),), (array(2 * actions),)
    return Policy(weights, biases, array(size), array(size) + 2, "hover", metadata, unit)


def parts(policy: Policy) -> dict[str, np.ndarray]:
    """Its arrays by their names in a file."""
    arrays = {"mean": policy.mean, "deviation": policy.deviation}
    for k, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        arrays |= {f"weight_{k}": weight, f"bias_{k}": bias}
    return arrays | (policy.memory.arrays() if policy.memory else {})
