"""What a step of a policy costs on a board: counted operations, and what each takes there.

Instructions, flash and stack of an operation are fitted to shipped policies on an STM32F405, which
QEMU emulates; `tests/slow/test_board.py` holds the estimates to it. Cycles add what the Cortex-M4's
technical reference manual says beside them: one to load a number, 13 to divide or take a root.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping

from quadrl.engines.rowwise import RowFunction
from quadrl.evaluation.policy import Policy

PER_WEIGHT, PER_TANH, PER_OPERATION, PER_SINE = 3.1, 53.0, 2.0, 47.0  # instructions
PER_LOGARITHM = 140.0
CODE, PER_LINE, PER_CALL = 3560, 7.5, 59.0  # bytes of flash
SINE = r"\b(?:sin|cos)\("
STACK, SPILLED = 256, 0.4  # bytes, and bytes of an operation


@dataclasses.dataclass(frozen=True)
class Cost:
    """Estimates for a Cortex-M4 with a floating-point unit."""

    instructions: int  # of a step
    cycles: int
    flash: int  # [bytes]
    stack: int  # [bytes]

    def said(self, hertz: float = 168e6) -> str:
        """One line of text, with the time of a step at a clock."""
        time = f"{self.cycles / hertz * 1e3:.2f} ms at {hertz / 1e6:.0f} MHz"
        room = f"{self.flash / 1e3:.0f} kB of flash, {self.stack / 1e3:.1f} kB of stack"
        return f"{self.instructions:,} instructions a step, {self.cycles:,} cycles ({time}); {room}"


def cost(policy: Policy, functions: Mapping[str, RowFunction], numbers: int, arrays: int) -> Cost:
    """Estimate what a policy costs.

    Args:
        policy: The policy, of whose network each number is stored.
        functions: The traced functions: all but "begun" run in each step.
        numbers: How many numbers are stored beside the network and the functions.
        arrays: How many numbers a step holds on the stack beside the network's.
    """
    layers = [weight for weight, _ in policy.mean_layers]
    stored, hidden = sum(x.size for x in layers), sum(len(x) for x in layers[:-1])
    if unit := policy.memory:
        stored += sum(x.size for x in unit.arrays().values() if x.ndim == 2)
        hidden += len(unit.input_bias)
    lines = {name: function.body.count("\n") + 1 for name, function in functions.items()}
    bodies = {name: function.body for name, function in functions.items()}
    step = "\n".join(body for name, body in bodies.items() if name != "begun")
    sines, operations = len(re.findall(SINE, step)), sum(lines.values()) - lines["begun"]
    divided = len(re.findall(r" / |\bsqrt\(", step)) + policy.size + hidden
    instructions = PER_WEIGHT * stored + PER_TANH * hidden
    instructions += PER_OPERATION * operations + PER_SINE * sines
    instructions += PER_LOGARITHM * step.count("log(")
    calls = len(re.findall(SINE, "\n".join(bodies.values())))
    numbers += stored + sum(len(function.constants) for function in functions.values())
    widest = max(policy.size + policy.state_size, *(len(x) for x in layers))
    flash = CODE + PER_LINE * sum(lines.values()) + PER_CALL * calls + 4 * numbers
    stack = STACK + 4 * (arrays + 2 * widest) + SPILLED * operations
    return Cost(
        instructions=round(instructions / 100) * 100,
        cycles=round((instructions + stored + 13 * divided) / 1000) * 1000,
        flash=round(flash),
        stack=round(stack),
    )
