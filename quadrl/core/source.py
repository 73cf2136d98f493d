"""A whole control step as one text, for compilers that know nothing of quadrl: C++ and CUDA.

It is `native/free_flight.c` with its headers, word for word, and the functions that are traced from
the control mode, the sensors and the task. NVRTC compiles it as it stands; each aircraft is then a
thread of its own, with LANES 1. Compiled for a processor it gives the bits of the library.
"""

from __future__ import annotations

import re
from pathlib import Path

from quadrl.aircraft.parameters import c_structs
from quadrl.base.trace import NotCompilable
from quadrl.control.autopilot import Laws
from quadrl.control.modes import ControlMode
from quadrl.core.program import Program
from quadrl.engines import native

FOLDER = Path(native.__file__).parent
TEXT = """// {name}: quadrl's control step for a {vehicle}, written by quadrl/core/source.py.
#ifndef LANES
#define LANES 1
#endif
#ifdef __CUDACC_RTC__
typedef signed char int8_t;
typedef unsigned char uint8_t;
typedef int int32_t;
typedef unsigned int uint32_t;
typedef long long int64_t;
typedef unsigned long long uint64_t;
#define HUGE_VAL __longlong_as_double(0x7ff0000000000000)
#define INFINITY HUGE_VAL
#define NAN __longlong_as_double(0x7ff8000000000000)
#define LINKAGE extern "C" __device__
#else
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#define VISIBLE __attribute__((visibility("default")))
#ifdef __cplusplus
#define LINKAGE extern "C" VISIBLE
#else
#define LINKAGE VISIBLE
#endif
#endif
#ifdef __cplusplus
#define restrict __restrict__
#endif
#ifdef __CUDACC__
#define __builtin_prefetch(...)
#define KEPT_APART
#endif
#define QUADRL_EXPORT_H_
#define QUADRL_EXPORT LINKAGE
#define VECTORISED
#define RUN(step, function, x, y, rows) function##_function(NULL, x, y, rows)
#define NUMBERS(step, function, numbers) function##_##numbers
typedef double Lanes[LANES];
{functions}
{flight}
#ifdef __CUDACC__
// A thread for each of n aircraft. `marked` adds up what quadrl_step returns.
extern "C" __global__ void control_step(const Step* s, int64_t n, int64_t parts, int64_t begin,
                                        int64_t end, unsigned long long* marked) {{
  const int64_t row = (int64_t)blockIdx.x * blockDim.x + threadIdx.x;
  if (row >= n) return;
  const int64_t found = quadrl_step(s, NULL, row, row + 1, parts, begin, end);
  if (found) atomicAdd(marked, (unsigned long long)found);
}}
#endif
"""


def whole(program: Program, mode: ControlMode) -> str:
    """The text of a control step: commands, physics, sensors, the task.

    `quadrl_begin` is in it where `Program.start` can be compiled.

    Args:
        program: The task's part.
        mode: The control mode that flies.

    Raises:
        NotCompilable: The mode does more than arithmetic.
    """
    engine = program.written.engine
    begin, command = Laws(mode, engine).functions()
    functions = {"begin": begin, "command": command, "finish": program.function}
    parts: list[str] = []
    try:
        functions["start"] = program.start
    except NotCompilable:
        parts.append("#define WITHOUT_STARTS")
    for name, function in functions.items():
        sizes = f"enum {{ {name}_taken = {function.taken}, {name}_given = {function.width} }};"
        parts += [sizes, function.text(f"{name}_function")]
    named = {"name": program.task.name, "vehicle": engine.vehicle.name}
    return TEXT.format(functions="\n".join(parts), flight=_opened("free_flight.c", set()), **named)


def _opened(name: str, seen: set[str]) -> str:
    """One of our C files with those that it includes, each once, and without the library's."""
    if name in seen:
        return ""
    seen.add(name)
    text = c_structs() if name == "layout.h" else (FOLDER / name).read_text()
    text = re.sub(r"#include <.*\n", "", text)
    text = re.sub(r"#define LANES .*\n", "", text)
    return re.sub(r'#include "(.+?)".*\n', lambda found: _opened(found[1], seen), text)
