"""A policy as an ONNX model: its network, with the normalisation and the clipping around it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from onnx import checker, helper, numpy_helper, parser

from quadrl.evaluation.memory import PREFIX
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.policy_file import CLIP

# Versions of the file and of the operators: those of 2022, which every runtime of today reads.
MODEL = """<ir_version: 8, opset_import: ["" : 17], producer_name: "quadrl">
policy ({inputs}) => ({outputs}) {{{nodes}}}"""
SEEN = """
  from_mean = Sub (observation, mean)
  normalised = Div (from_mean, deviation)
  seen = Clip (normalised, nearest, farthest)"""
FIRST = """
  sum_first = Gemm <transB = 1> (seen, first_weight, first_bias)
  first = Relu (sum_first)"""
MEMORY = """
  new = Gemm <transB = 1> ({below}, input_weight, input_bias)
  old = Gemm <transB = 1> (state, state_weight, state_bias)
  new_reset, new_update, new_candidate = Split <axis = 1> (new)
  old_reset, old_update, old_candidate = Split <axis = 1> (old)
  both_reset = Add (new_reset, old_reset)
  reset = Sigmoid (both_reset)
  both_update = Add (new_update, old_update)
  update = Sigmoid (both_update)
  kept = Mul (reset, old_candidate)
  both_candidate = Add (new_candidate, kept)
  candidate = Tanh (both_candidate)
  change = Sub (state, candidate)
  part = Mul (update, change)
  next_state = Add (candidate, part)"""
BESIDE = """
  remembered = Concat <axis = 1> (seen, next_state)"""
LAYER = """
  sum_{k} = Gemm <transB = 1> ({below}, weight_{k}, bias_{k})"""
BETWEEN = """
  layer_{k} = Tanh (sum_{k})"""
ACTION = """
  action = Clip (sum_{k}, least, most)
"""


def content(policy: Policy, metadata: Mapping[str, str]) -> bytes:
    """The file of a model in single precision.

    From `observation` (batch, size) it makes `action` (batch, k), within [-1, 1]. With a memory it
    also takes `state` (batch, state_size), zeros as an episode begins, and gives `next_state`.

    Args:
        policy: The policy.
        metadata: Entries of the file's metadata.
    """
    arrays = {"mean": policy.mean, "deviation": policy.deviation}
    bounds = {"nearest": -CLIP, "farthest": CLIP, "least": -1, "most": 1}
    arrays |= {name: np.array(bound, np.float32) for name, bound in bounds.items()}
    inputs, outputs = {"observation": policy.size}, {"action": policy.action_size}
    nodes, below = SEEN, "seen"
    if unit := policy.memory:
        inputs["state"] = outputs["next_state"] = policy.state_size
        if unit.alone:
            nodes, below = nodes + FIRST + MEMORY.format(below="first"), "next_state"
        else:
            nodes, below = nodes + MEMORY.format(below="seen") + BESIDE, "remembered"
        arrays |= {name.removeprefix(PREFIX): array for name, array in unit.arrays().items()}
    for k, (weight, bias) in enumerate(policy.mean_layers):
        nodes += BETWEEN.format(k=k - 1) * (k > 0) + LAYER.format(k=k, below=below)
        arrays |= {f"weight_{k}": weight, f"bias_{k}": bias}
        below = f"layer_{k}"
    nodes += ACTION.format(k=len(policy.mean_layers) - 1)
    shapes = (
        ", ".join(f"float[batch, {size}] {name}" for name, size in entries.items())
        for entries in (inputs, outputs)
    )
    ends = dict(zip(("inputs", "outputs"), shapes, strict=True))
    model = parser.parse_model(MODEL.format(nodes=nodes, **ends))
    own = [numpy_helper.from_array(array, name) for name, array in arrays.items()]
    model.graph.initializer.extend(own)
    helper.set_model_props(model, dict(metadata))
    checker.check_model(model)
    return model.SerializeToString()
