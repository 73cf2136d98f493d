"""The operations of NumPy that the tracer knows: the C of each, and its derivatives."""

# pyright: standard
# Derivatives are of symbols, which stand for arrays of any kind.
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

OPERATORS = {
    "add": "+", "subtract": "-", "multiply": "*", "divide": "/", "less": "<", "less_equal": "<=",
    "greater": ">", "greater_equal": ">=", "equal": "==", "not_equal": "!=", "bitwise_and": "&",
    "bitwise_or": "|", "bitwise_xor": "^", "logical_and": "&", "logical_or": "|",
}  # fmt: skip
CALLS = {"absolute": "fabs", "arcsin": "asin", "arccos": "acos", "arctan": "atan"}
CALLS |= {name: name for name in ("sqrt", "sin", "cos", "exp", "log", "tan", "tanh", "floor")}
C: dict[str, str] = {
    "negative": "-{}",
    "arctan2": "atan2({}, {})",
    "maximum": "({0} >= {1}) | ({0} != {0}) ? {0} : {1}",
    "minimum": "({0} <= {1}) | ({0} != {0}) ? {0} : {1}",
    "where": "{} ? {} : {}",
    "invert": "!{}",
    "logical_not": "!{}",
}
"""C of each operation, by the name of NumPy's function."""
C |= {name: f"{{}} {sign} {{}}" for name, sign in OPERATORS.items()}
C |= {name: f"{call}({{}})" for name, call in CALLS.items()}
SOUND = {"maximum": "{0} < {1} ? {1} : {0}", "minimum": "{0} > {1} ? {1} : {0}"}
"""The same for operands that are not NaN: with one comparison, so that GCC vectorises it."""
LOGICAL = {name for name in C if name.startswith(("bitwise_", "logical_"))} | {"invert"}
"""Operations on truth values."""
FLAGS = LOGICAL | {name for name in C if name.startswith(("less", "greater", "equal", "not_"))}
"""Operations that give a truth value."""
ARRANGING = {
    np.stack, np.concatenate, np.broadcast_to, np.moveaxis, np.transpose, np.reshape, np.roll,
    np.expand_dims, np.squeeze, np.swapaxes, np.take, np.flip, np.tile, np.repeat, np.split,
    np.array_split, np.zeros_like, np.ones_like, np.empty_like, np.full_like, np.copyto,
    np.result_type, np.clip, np.max, np.min, np.sum, np.prod, np.any, np.all,
}  # fmt: skip
"""Functions that only move numbers or call the operations above; others might inspect objects."""
REVERSE: dict[str, Callable[..., tuple[Any, ...]]] = {
    "add": lambda by, result, x, y: (by, by),
    "subtract": lambda by, result, x, y: (by, -by),
    "multiply": lambda by, result, x, y: (by * y, by * x),
    "divide": lambda by, result, x, y: (by / y, -(by / y) * result),
    "negative": lambda by, result, x: (-by,),
    # Zero where the slope is infinite, so that a length has a derivative everywhere.
    "sqrt": lambda by, result, x: (np.where(result > 0, 0.5 * by / result, 0.0),),
    "absolute": lambda by, result, x: (np.where(x < 0, -by, np.where(x > 0, by, 0.0)),),
    "maximum": lambda by, result, x, y: (np.where(x >= y, by, 0.0), np.where(x >= y, 0.0, by)),
    "minimum": lambda by, result, x, y: (np.where(x <= y, by, 0.0), np.where(x <= y, 0.0, by)),
    "where": lambda by, result, flag, x, y: (0.0, np.where(flag, by, 0.0), np.where(flag, 0.0, by)),
    "sin": lambda by, result, x: (by * np.cos(x),),
    "cos": lambda by, result, x: (-by * np.sin(x),),
    "tan": lambda by, result, x: (by * (1 + result * result),),
    "exp": lambda by, result, x: (by * result,),
    "log": lambda by, result, x: (by / x,),
    "tanh": lambda by, result, x: (by * (1 - result * result),),
    "arctan": lambda by, result, x: (by / (1 + x * x),),
    "floor": lambda by, result, x: (None,),  # constant between its steps
    "look_up": lambda by, result, index: (None,),
}
"""Derivatives by the operands, from the derivative by the result, the result and the operands."""
