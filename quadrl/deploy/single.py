"""Functions in single precision, in C and in NumPy with the same bits.

Only operations whose rounding IEEE 754 prescribes are used, one after the other, so that every
compiler that does not contract or reorder them gives these bits. Exponentials and the like of a
task of one's own are the library's.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from quadrl.base.trace import Symbol
from quadrl.engines.rowwise import RowFunction

TANH = """// tanh to 4e-7.
static float {name}_tanh(float x) {{
  const float a = x < -9.0f ? -9.0f : x > 9.0f ? 9.0f : x, square = a * a;
  float over = {over[5]}, under = {under[3]};
  over = {over[4]} + square * over;
  over = {over[3]} + square * over;
  over = {over[2]} + square * over;
  over = {over[1]} + square * over;
  over = {over[0]} + square * over;
  under = {under[2]} + square * under;
  under = {under[1]} + square * under;
  under = 1.0f + square * under;
  return a * over / under;
}}
"""
SINE = """// Sine of x and some quarters of a turn, to 1e-6; of large angles by the library.
static float {name}_sine(float x, int32_t quarters) {{
  if (!(fabsf(x) < {most})) return quarters ? cosf(x) : sinf(x);
  const int32_t whole = (int32_t)(x * {per_quarter} + (x < 0.0f ? -0.5f : 0.5f));
  const float n = (float)whole;
  const float r = ((x - n * 1.5703125f) - n * {more}) - n * {rest_of_quarter}, square = r * r;
  const float found =
      (whole + quarters) & 1
          ? 1.0f + square * (-0.5f + square * ({c4} + square * (-{c6} + square * {c8})))
          : r + r * square * (-{c3} + square * ({c5} + square * (-{c7} + square * {c9})));
  return (whole + quarters) & 2 ? -found : found;
}}
"""
MORE = round((math.pi / 2 - 1.5703125) * 2**21) / 2**21
"""The next bits of a quarter of a turn, so few that their products with whole numbers are exact."""
SERIES = {f"c{n}": 1 / math.factorial(n) for n in range(3, 10)} | {
    "most": 8192.0, "per_quarter": 2 / math.pi, "more": MORE,
    "rest_of_quarter": math.pi / 2 - 1.5703125 - MORE,
}  # fmt: skip
S = {name: np.float32(value) for name, value in SERIES.items()}
ONE, HALF = np.float32(1), np.float32(0.5)
OVER = 0.99999994, 0.12919229, 2.9207636e-3, 9.267436e-6, -1.2780486e-8, 1.8255359e-11
UNDER = 1.0, 0.46252513, 2.3763176e-2, 2.2810043e-4
"""tanh x / x as a quotient of polynomials of x^2, fitted from -9 to 9 for the least relative error,
which is 6e-8 before rounding."""
LIBRARY = ("exp", "log", "tan", "tanh", "arcsin", "arccos", "arctan", "arctan2")
"""Operations that are the C library's, so that the last bits may differ."""
CALLS = ("sqrt", "exp", "log", "tan", "tanh", "floor", "fabs", "asin", "acos", "atan", "atan2")


def tanh(x: np.ndarray) -> np.ndarray:
    """Tanh as TANH computes it."""
    nine = np.float32(9)
    a = np.where(x < -nine, -nine, np.where(x > nine, nine, x))
    over, under = (
        functools.reduce(lambda sum, c: np.float32(c) + a * a * sum, terms[::-1], np.zeros_like(a))
        for terms in (OVER, UNDER)
    )
    return a * over / under


def sine(x: np.float32, quarters: int = 0) -> np.float32:
    """Sine of an angle and some quarters of a turn as SINE computes it."""
    if not abs(x) < S["most"]:
        return np.cos(x) if quarters else np.sin(x)
    n = np.trunc(x * S["per_quarter"] + (-HALF if x < 0 else HALF))
    r = ((x - n * np.float32(1.5703125)) - n * S["more"]) - n * S["rest_of_quarter"]
    square, at = r * r, int(n) + quarters
    even = ONE + square * (-HALF + square * (S["c4"] + square * (-S["c6"] + square * S["c8"])))
    odd = -S["c3"] + square * (S["c5"] + square * (-S["c7"] + square * S["c9"]))
    found = even if at & 1 else r + r * square * odd
    return -found if at & 2 else found


OWN: dict[str, Callable[..., Any]] = {"sin": sine, "cos": lambda x: sine(x, 1)}
"""Operations that are not NumPy's."""


def functions(name: str, traced: Iterable[RowFunction]) -> str:
    """C of the functions that traced ones and the network call; their names begin with a name."""
    over, under = ([*map(number, terms)] for terms in (OVER, UNDER))
    found = TANH.format(name=name, over=over, under=under)
    if {"sin", "cos"} & {s.operation for f in traced for s in f.trace.known.values()}:
        found += "\n" + SINE.format(name=name, **{k: number(x) for k, x in SERIES.items()})
    return found


def function(name: str, what: str, traced: RowFunction) -> str:
    """C of a traced function, `NAME_WHAT`."""
    body = re.sub(r"\b([xy]\[\d+\])\[i\]", r"\1", traced.body).replace("double", "float")
    body = re.sub(rf"\b({'|'.join(CALLS)})\(", r"\1f(", body).replace("(int64_t)", "(int)")
    for call, quarters in (("sin", 0), ("cos", 1)):
        body = re.sub(rf"\b{call}\((\w+)\)", rf"{name}_sine(\1, {quarters})", body)
    constants = f"static const float c[] = {{{numbers(traced.constants)}}};"
    head = f"static void {name}_{what}(const float* x, float* y) {{\n  {constants}\n  (void)c;\n"
    return f"{head}    {body}\n}}\n"


def is_exact(traced: RowFunction) -> bool:
    """Whether every compiler gives the same bits."""
    return not {symbol.operation for symbol in traced.trace.known.values()} & {*LIBRARY}


def in_single(traced: RowFunction, given: np.ndarray) -> np.ndarray:
    """What a traced function gives of numbers (k,), an operation after the other."""
    trace, values = traced.trace, dict[Any, Any]()

    def value(operand: Any) -> Any:
        if isinstance(operand, Symbol):
            return values[operand]
        return operand if isinstance(operand, (bool, np.bool_)) else np.float32(operand)

    for symbol in trace.known.values():
        if not symbol.operands:
            (place,) = re.findall(r"x\[(\d+)\]", symbol.text)
            values[symbol] = np.float32(given[int(place)])
        elif symbol.operation == "look_up":
            first, count = map(int, re.findall(r"c\[(\d+) \+ (\d+)", symbol.text)[0])
            place = first + count * int(values[symbol.operands[0]])
            values[symbol] = np.float32(trace.constants[place])
        else:
            call = OWN.get(symbol.operation) or getattr(np, symbol.operation)
            with np.errstate(all="ignore"):
                values[symbol] = call(*map(value, symbol.operands))
    return np.array([value(one) for one in traced.result], np.float32)


def numbers(values: Iterable[float]) -> str:
    """Numbers in single precision, to the bit, as C."""
    return ", ".join(number(value) for value in values)


def number(value: float) -> str:
    """A number in single precision, to the bit, as C."""
    single = float(np.float32(value))
    if math.isfinite(single):
        return re.sub(r"\.?0+p", "p", single.hex()) + "f"
    return "NAN" if math.isnan(single) else ("INFINITY" if single > 0 else "-INFINITY")
