"""An actor of torch as a policy of NumPy, which computes the same function as a plain network."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import nn
from torchrl.modules import GRUCell, ProbabilisticActor

from quadrl.evaluation.memory import GRU
from quadrl.evaluation.policy import Policy
from quadrl.learning.config import TrainConfig
from quadrl.learning.networks import HoldsGoal, Memory
from quadrl.learning.normaliser import Normaliser

UNCLIPPED = 1024.0
"""Deviation of what is clipped nowhere; a power of two, which rounds nothing."""
SURE = 60.0
"""Weight of a flag, less a half of it: tanh of that is -1 or 1."""


def export(actor: ProbabilisticActor, task: str, metadata: dict[str, Any]) -> Policy:
    """Convert an actor to a NumPy policy."""
    (normaliser,) = (module for module in actor.modules() if isinstance(module, Normaliser))
    mean, deviation = _array(normaliser.shift), _array(normaliser.deviation)
    kept = [module for module in actor.modules() if isinstance(module, Memory)]
    first = kept[0].first if kept else None
    layers = [x for x in actor.modules() if isinstance(x, nn.Linear) and x is not first]
    cells = [module for module in actor.modules() if isinstance(module, GRUCell)]
    memory = [GRU(*map(_array, (c.weight_ih, c.weight_hh, c.bias_ih, c.bias_hh))) for c in cells]
    if first is not None:  # the same function, without normalised observations that are clipped
        weight, bias = _array(first.weight) / deviation, _array(first.bias)
        bias = bias - weight @ mean
        mean, deviation = np.zeros_like(mean), np.full_like(deviation, UNCLIPPED)
        own = {"first_weight": weight * np.float32(UNCLIPPED), "first_bias": bias}
        memory = [dataclasses.replace(memory[0], **own)]
    weights = [_array(layer.weight) for layer in layers]
    biases = [_array(layer.bias) for layer in layers]
    for module in actor.modules():
        if isinstance(module, HoldsGoal):  # the same function, as a plain network
            weights[0] *= _array(module.looks)
            _subtract(module, weights, biases)
    return Policy(
        weights=tuple(weights),
        biases=tuple(biases),
        mean=mean,
        deviation=deviation,
        task=task,
        metadata=metadata,
        memory=memory[0] if memory else None,
    )


def metadata_of(config: TrainConfig, run: str, steps: int) -> dict[str, Any]:
    """What a policy says of itself: its training, the run, and the control steps so far."""
    return {
        "algo": config.algo,
        "seed": config.seed,
        "run": run,
        "variant": config.variant,
        "steps": steps,
        "rotors": config.scenario.vehicle.rotor_count,
        **config.resolved()["scenario"],
        "engine": "mujoco",
        "observe": dataclasses.asdict(config.scenario.observe),
    }


def _subtract(held: HoldsGoal, weights: list[np.ndarray], biases: list[np.ndarray]) -> None:
    """Let plain layers subtract the mean at the goal, but where another task is flown.

    The flag of each of those passes the hidden layers as -1 or 1, in a unit of its own.
    """
    mean, flags = _array(held.mean_at_goal()), held.others
    biases[-1][: len(mean)] -= mean
    if not (count := len(flags)):
        return
    sure = SURE * np.eye(count, dtype=np.float32)
    for k, weight in enumerate(weights[:-1]):
        if k:
            told, below = np.pad(sure, ((0, 0), (weight.shape[1], 0))), np.zeros(count)
        else:
            told = np.zeros((count, weight.shape[1]), np.float32)
            told[:, flags] = sure * _array(held.normaliser.deviation)[flags]
            below = SURE * (_array(held.normaliser.shift)[flags] - 0.5)
        wide = np.pad(weight, ((0, 0), (0, told.shape[1] - weight.shape[1])))
        weights[k] = np.concatenate([wide, told])
        biases[k] = np.concatenate([biases[k], below.astype(np.float32)])
    half = np.zeros((len(biases[-1]), count), np.float32)
    half[: len(mean)] = mean[:, None] / 2
    weights[-1] = np.concatenate([weights[-1], half], axis=1)
    biases[-1] += half.sum(1)


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().float().numpy().copy()
