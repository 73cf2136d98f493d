"""A policy's network as C of single precision, and the same numbers by NumPy.

The network is plain operations in one order, so that every compiler that does not contract or
reorder them gives the bits of the reference here.
"""

from __future__ import annotations

import numpy as np

from quadrl.deploy.single import number, numbers, tanh
from quadrl.evaluation.memory import PREFIX
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.policy_file import CLIP

BLOCKS = 8, 4
"""Numbers of a layer that are summed up side by side: so many that they stay in registers."""
NETWORK = """{layers}
static void {name}_network(const float* observation, float* state, float* action) {{
{arrays}
  QUADRL_ARRAY float a[{widest}], b[{widest}];
  for (int k = 0; k < {size}; ++k) {{
    const float x = (observation[k] - mean[k]) / deviation[k];
    a[k] = x < -{clip} ? -{clip} : x > {clip} ? {clip} : x;
  }}
{body}
}}
"""
LAYER = """// y = bias + weight x, for `out` numbers of `in`, {block} at a time, whose weights
// stand side by side for each number of x. The last ones are filled up with zeros.
static void {name}_layer_{block}(const float* weight, const float* bias, const float* x, float* y,
                                 int out, int in) {{
  for (int k = 0; k < out; k += {block}) {{
    float sum[{block}];
    for (int j = 0; j < {block}; ++j) sum[j] = bias[k + j];
#ifdef __GNUC__
#pragma GCC unroll 8
#endif
    for (int i = 0; i < in; ++i, weight += {block}) {{
      const float value = x[i];
      {sums}
    }}
    for (int j = 0; j < {block}; ++j) y[k + j] = sum[j];
  }}
}}
"""
FIRST = """  {name}_layer_{block}(first_weight, first_bias, a, b, {neurons}, {size});
  for (int k = 0; k < {neurons}; ++k) a[k] = b[k] > 0.0f ? b[k] : 0.0f;
"""
MEMORY = """  QUADRL_ARRAY float seen[{room}], was[{room}];
  {name}_layer_{block}(input_weight, input_bias, a, seen, {three}, {size});
  {name}_layer_{block}(state_weight, state_bias, state, was, {three}, {width});
  for (int k = 0; k < {width}; ++k) {{
    const float reset = 0.5f + 0.5f * {name}_tanh(0.5f * (seen[k] + was[k]));
    const float update = 0.5f + 0.5f * {name}_tanh(0.5f * (seen[{width} + k] + was[{width} + k]));
    const float fresh = {name}_tanh(seen[2 * {width} + k] + reset * was[2 * {width} + k]);
    state[k] = fresh + update * (state[k] - fresh);
    a[{beside} + k] = state[k];
  }}
"""


def network(name: str, policy: Policy) -> str:
    """C of the network of a policy, whose functions begin with a name."""
    layers, arrays, body = policy.mean_layers, list[str](), ""
    outputs = [bias for _, bias in layers]
    size, width = policy.size, policy.state_size
    named = {"mean": policy.mean, "deviation": policy.deviation}
    if policy.memory:
        unit = policy.memory
        for key, array in unit.arrays().items():
            shaped = _in_blocks(array) if array.ndim == 2 else _padded(array)
            named[key.removeprefix(PREFIX)] = shaped
        if unit.first_bias is not None:
            outputs.append(unit.first_bias)
            block, neurons = _block(unit.first_bias), len(unit.first_bias)
            body = FIRST.format(name=name, block=block, neurons=neurons, size=size)
        body += MEMORY.format(
            name=name,
            three=3 * width,
            room=3 * width + BLOCKS[0],
            block=_block(unit.input_bias),
            size=unit.input_weight.shape[1],
            beside=0 if unit.alone else size,
            width=width,
        )
    there, other, count = "a", "b", width + size * (not policy.memory or not policy.memory.alone)
    for k, (weight, bias) in enumerate(layers):
        named |= {f"weight_{k}": _in_blocks(weight), f"bias_{k}": _padded(bias)}
        if k:
            body += f"  for (int k = 0; k < {count}; ++k) {there}[k] = {name}_tanh({there}[k]);\n"
        given = f"weight_{k}, bias_{k}, {there}, {other}, {len(bias)}, {count}"
        body += f"  {name}_layer_{_block(bias)}({given});\n"
        there, other, count = other, there, len(bias)
    body += f"""  for (int k = 0; k < {count}; ++k) {{
    action[k] = {there}[k] < -1.0f ? -1.0f : {there}[k] > 1.0f ? 1.0f : {there}[k];
  }}
  (void)state;"""
    for key, array in named.items():
        arrays.append(f"  static const float {key}[] = {{{numbers(np.ravel(array))}}};")
    return NETWORK.format(
        name=name,
        arrays="\n".join(arrays),
        widest=max(size + width, *(len(bias) + BLOCKS[0] for bias in outputs)),
        layers="\n".join(
            LAYER.format(
                name=name,
                block=block,
                sums="\n      ".join(f"sum[{j}] += weight[{j}] * value;" for j in range(block)),
            )
            for block in BLOCKS
        ),
        size=size,
        clip=number(CLIP),
        body=body,
    )


def acted(
    policy: Policy, observation: np.ndarray, state: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The action and the next state of the network, in single precision."""
    one = np.float32
    x = np.clip((observation - policy.mean) / policy.deviation, -one(CLIP), one(CLIP))
    if unit := policy.memory:
        seen = x
        if unit.first_weight is not None and unit.first_bias is not None:
            seen = np.maximum(_layer(unit.first_weight, unit.first_bias, x), one(0))
        seen = np.split(_layer(unit.input_weight, unit.input_bias, seen), 3)
        was = np.split(_layer(unit.state_weight, unit.state_bias, state), 3)
        half = one(0.5)
        reset, update = (
            half + half * tanh(half * (a + b)) for a, b in zip(seen[:2], was[:2], strict=True)
        )
        fresh = tanh(seen[2] + reset * was[2])
        state = fresh + update * (state - fresh)
        x = state if unit.alone else np.concatenate([x, state])
    for k, (weight, bias) in enumerate(policy.mean_layers):
        x = _layer(weight, bias, x if k == 0 else tanh(x))
    return np.clip(x, -one(1), one(1)), state


def _block(bias: np.ndarray) -> int:
    """In which blocks a layer is summed up."""
    return BLOCKS[0] if len(bias) % BLOCKS[0] == 0 else BLOCKS[1]


def _padded(array: np.ndarray) -> np.ndarray:
    """An array with zeros behind its first axis, to whole blocks."""
    more = -len(array) % _block(array)
    return np.concatenate([array, np.zeros((more, *array.shape[1:]), array.dtype)])


def _in_blocks(weight: np.ndarray) -> np.ndarray:
    """Weights (out, in) as (blocks, in, numbers of a block)."""
    whole, block = _padded(weight), _block(weight)
    return whole.reshape(-1, block, whole.shape[1]).swapaxes(1, 2)


def _layer(weight: np.ndarray, bias: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A layer in the order of the C: a number of the input after the other."""
    total = bias.astype(np.float32)
    for k, value in enumerate(x):
        total = total + weight[:, k].astype(np.float32) * value
    return total
