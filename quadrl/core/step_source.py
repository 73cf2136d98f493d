"""The C function of a compiled step: its source, and where it finds its rows."""

from __future__ import annotations

import ctypes

FLAGS = ("terminated", "truncated", "is_success", "diverged")
POINTERS = (
    *("constants", "parameters", "action", "command", "diverged"),
    *("state", "last_state", "estimate", "sensed", "last_sensed", "was", "out", "rest"),
)
SOURCE = """#include <math.h>
#include <stdint.h>
typedef struct {{
  const double *constants, *parameters, *action, *command;
  const uint8_t* diverged;
  const double *state, *last_state, *estimate, *sensed, *last_sensed, *was;
  double *out, *rest;
  int64_t stride, columns;
}} Rows;
__attribute__((visibility("default"))) void step(const Rows* rows, int64_t n) {{
  const double *restrict c = rows->constants, *restrict p = rows->parameters;
  const double *restrict action = rows->action, *restrict command = rows->command;
  const double *restrict state = rows->state, *restrict last_state = rows->last_state;
  const double *restrict estimate = rows->estimate, *restrict was = rows->was;
  const double *restrict sensed = rows->sensed, *restrict last_sensed = rows->last_sensed;
  const uint8_t* restrict diverged = rows->diverged;
  double *restrict out = rows->out, *restrict rest = rows->rest;
  const int64_t stride = rows->stride, columns = rows->columns;
  uint8_t* restrict flags = (uint8_t*)(rest + {flags} * columns);
  for (int64_t i = 0; i < n; ++i) {{
    {body}
  }}
}}
"""


class Rows(ctypes.Structure):
    """Where the function finds its rows; as in SOURCE."""

    _fields_ = [(name, ctypes.c_void_p) for name in POINTERS]
    _fields_ += [("stride", ctypes.c_int64), ("columns", ctypes.c_int64)]
