"""A whole control step as one text, for compilers that know nothing of quadrl: C++ and CUDA.

It is `native/kernel.h` with the headers that free flight shares with it, word for word, and the
functions that are traced from the control mode and the task. A GPU gives each aircraft a thread of
its own. Compiled for a processor in double precision it gives the bits of `Environment`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import AIRCRAFT, ROTOR, c_structs
from quadrl.base.philox import MEMBERS, START
from quadrl.control.autopilot import Laws
from quadrl.core.environment import Environment
from quadrl.core.program import MAX_DRAWN, Program
from quadrl.engines import native
from quadrl.engines.rowwise import WITHOUT_HEX

Precision = Literal["float32", "float64"]
FOLDER = Path(native.__file__).parent
TEXT = """// {name}: a control step of the {vehicle}, written by quadrl/device/text.py.
#define LANES 1
#ifdef __CUDACC__
typedef signed char int8_t;
typedef unsigned char uint8_t;
typedef int int32_t;
typedef unsigned int uint32_t;
typedef long long int64_t;
typedef unsigned long long uint64_t;
#define HUGE_VAL __longlong_as_double(0x7ff0000000000000)
#define INFINITY HUGE_VAL
#define NAN __longlong_as_double(0x7ff8000000000000)
#define KEPT_APART
#define restrict __restrict__
#pragma nv_diag_suppress 177  // functions that this step does not call
#else
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#define QUADRL_EXPORT __attribute__((visibility("default")))
#endif
#define VECTORISED
{structs}
enum {{ {sizes} }};
#define LOOPS {loops}
#define EFFECTS {effects}
#define WORLD {{{timestep}, {gravity}, -HUGE_VAL, 0}}
typedef double Lanes[LANES];
// A random word as a number in [0, 1).
static inline double uniform(uint32_t word) {{ return {uniform}; }}
{functions}
// The parameters of an aircraft.
static inline void aircraft(Aircraft* a, const double* column, int64_t columns) {{
  {aircraft}
}}
// What the task's part and the start take.
static inline void finish_takes(Lanes* x, const Lanes* last, const double* action,
                                const Lanes* mean, const double* column, int64_t columns,
                                const Aircraft* a) {{
  {finish_takes}
}}
static inline void start_takes(Lanes* x, const Aircraft* a) {{
  {start_takes}
}}
{kernel}
"""
NUMBER = r"(?<![\w.])(0x[\da-fA-F]*\.?[\da-fA-F]*p[+-]?\d+|\d+\.\d*(?:e[+-]?\d+)?|\d+e[+-]?\d+)\b"
"""A literal of a double."""
UNIFORM = {"float64": "word * 0x1p-32", "float32": "(word >> 8) * 0x1p-24"}


class Layout:
    """Where the numbers of an aircraft stand in the tables of a batch."""

    def __init__(self, environment: Environment) -> None:
        """Lay them out for an environment whose episodes have begun."""
        program: Program = environment._step._program  # type: ignore[union-attr]
        self.program, self.motion = program, 13 + environment.vehicle.rotor_count
        self.kept, self.seen = program.remembered.end, environment.size
        self.terms, self.ends = program.rewarded, program.ended
        self.rows = self.motion + self.kept
        """Rows of what is remembered."""
        self.reward = 2 * self.seen
        self.out = self.reward + 2 + len(self.terms)
        """Rows of what a step gives."""
        self.flags = 5 + len(self.ends)


def text(environment: Environment, precision: Precision = "float64") -> str:
    """The text of a control step of an environment whose episodes have begun.

    Raises:
        NotCompilable: The task or the mode does more than arithmetic.
    """
    layout, vehicle, engine = Layout(environment), environment.vehicle, environment.engine
    program, mode = layout.program, environment.control_mode
    first, command = Laws(mode, engine).functions()
    functions = {"begin": first, "finish": program.function, "start": program.start}
    if mode.has_loops:
        functions["command"] = command
    sizes: dict[str, int] = {"ROTORS": vehicle.rotor_count, "ACTIONS": mode.size}
    sizes |= {"SUBSTEPS": vehicle.substeps, "KEPT": layout.kept, "SEEN": layout.seen}
    sizes |= {"TERMS": len(layout.terms), "ENDS": len(layout.ends), "DRAWN": program.drawn}
    sizes |= {"START": START, "MEMBERS": MEMBERS}
    for name, function in functions.items():
        sizes |= {f"{name}_taken": function.taken, f"{name}_given": function.width}
    whole = TEXT.format(
        name=environment.task.name,
        vehicle=vehicle.name,
        structs=c_structs(),
        sizes=", ".join(f"{name} = {size}" for name, size in sizes.items()),
        loops=int(mode.has_loops),
        effects=vehicle.aerodynamics.effects,
        timestep=vehicle.physics_timestep.hex(),
        gravity=float(engine.model.opt.gravity[2]).hex(),
        uniform=UNIFORM[precision],
        functions="\n".join(f.text(f"{name}_function") for name, f in functions.items()),
        aircraft="\n  ".join(_aircraft(engine.begun[:1], vehicle.rotor_count)),
        finish_takes="\n  ".join(_finish_takes(program)),
        start_takes="\n  ".join(_parameters(program.start.places, 1 + MAX_DRAWN)),
        kernel=_opened("kernel.h", {"layout.h"}),
    )
    return single(whole) if precision == "float32" else whole


def single(whole: str) -> str:
    """The same text in single precision."""
    whole = re.sub(NUMBER, r"\1f", re.sub(r"\bdouble\b", "float", whole))
    return whole.replace("__longlong_as_double(0x7ff0000000000000)", "__int_as_float(0x7f800000)")


def _aircraft(row: np.ndarray, rotors: int) -> Iterator[str]:
    """The statements that fill an Aircraft."""
    for path, number in _fields(row, rotors):
        yield f"{path} = {literal(number)};"


def _fields(row: np.ndarray, rotors: int) -> Iterator[tuple[str, float]]:
    """Each number of a row as C names it, and its value."""
    for name in AIRCRAFT.names or ():
        parts = [(f"a->{name}", row[name][0])]
        if name == "rotor":
            each = [(k, field) for k in range(rotors) for field in ROTOR.names or ()]
            parts = [(f"a->rotor[{k}].{field}", row[name][0, k][field]) for k, field in each]
        for path, value in parts:
            for place, number in np.ndenumerate(np.asarray(value)):
                yield path + "".join(f"[{k}]" for k in place) + "[0]", float(number)


def _finish_takes(program: Program) -> Iterator[str]:
    """The statements that gather what the task's part takes after the motion."""
    motion = program.parts["last_motion"]
    texts = {
        "last_motion": "last[{}][0]",
        "action": "action[{}]",
        "command": "mean[{}][0]",
        "was": f"column[({motion} + {{}}) * columns]",
    }
    first = motion + 1 + sum(program.sensed.values())
    for name, count in program.parts.items():
        if name in texts:
            for number, place in program.function.places.items():
                if 0 <= number - first < count:
                    yield f"x[{place}][0] = {texts[name].format(number - first)};"
        elif name == "parameters":
            yield from _parameters(program.function.places, first)
        first += count


def _parameters(places: dict[int, int], first: int) -> Iterator[str]:
    """The statements that gather parameters of an aircraft, which come from a place on."""
    names = {int(at): path for path, at in _fields(parameters.PLACES, parameters.MAX_ROTORS)}
    for number, place in places.items():
        if 0 <= number - first < parameters.ROW_SIZE:
            yield f"x[{place}][0] = {names[number - first]};"


def literal(number: float) -> str:
    """A number as C has it, every bit of it."""
    return f"({number.hex()})" if np.isfinite(number) else WITHOUT_HEX[str(number)]


def _opened(name: str, seen: set[str]) -> str:
    """One of our C files with those that it includes, each once, and without the library's."""
    if name in seen:
        return ""
    seen.add(name)
    whole = re.sub(r"#include <.*\n", "", (FOLDER / name).read_text())
    return re.sub(r'#include "(.+?)".*\n', lambda found: _opened(found[1], seen), whole)
