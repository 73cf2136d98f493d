"""A whole control step as one text, for compilers that know nothing of quadrl: C++ and CUDA.

It is `native/kernel.h` with the headers that free flight shares with it, word for word, and the
functions that are traced from the control mode and the task. A GPU gives each aircraft a thread of
its own. Compiled for a processor in double precision it gives the bits of `Environment`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from statistics import NormalDist
from typing import Any, Literal, cast, get_args

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import AIRCRAFT, ROTOR, c_structs
from quadrl.base.philox import LINK, MEMBERS, POOL, PUSHES, START
from quadrl.base.trace import NotCompilable
from quadrl.conditions.weather import noise_time_of
from quadrl.control.autopilot import Laws
from quadrl.core.columns import Layout
from quadrl.core.environment import Environment
from quadrl.core.program import MAX_DRAWN, Program
from quadrl.engines import native
from quadrl.engines.air import ROWS, c_weather
from quadrl.engines.rays import LEAST, Frame
from quadrl.engines.rowwise import WITHOUT_HEX

Precision = Literal["float32", "float64"]
FOLDER = Path(native.__file__).parent
TEXT = """// {name}: a control step of the {vehicle}, written by quadrl/core/source.py.
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
#include <string.h>
#endif
#define VECTORISED
{structs}
enum {{ {sizes} }};
{defines}
#define FREE_WORLD {{{timestep}, {gravity}, -HUGE_VAL, 0}}
typedef double Lanes[LANES];
{functions}
// The parameters of an aircraft.
static inline void aircraft(Aircraft* a, const double* column, int64_t columns) {{
  {aircraft}
}}
// What the task's part and the start take.
static inline void finish_takes(Lanes* x, const Lanes* last, const double* action,
                                const Lanes* mean, const Lanes* air, const double* column,
                                int64_t columns, const Aircraft* a, double clearance,
                                const double* read) {{
  {finish_takes}
}}
static inline void start_takes(Lanes* x, const Aircraft* a) {{
  {start_takes}
}}
{weather}
{world}
{kernel}
"""
NUMBER = r"(?<![\w.])(0x[\da-fA-F]*\.?[\da-fA-F]*p[+-]?\d+|\d+\.\d*(?:e[+-]?\d+)?|\d+e[+-]?\d+)\b"
"""A literal of a double."""
WEATHER = """
static inline void weather_takes(Lanes* t, const double* column, int64_t columns) {{
  {takes}
}}
static inline void weather_gives(const Lanes* t, double* column, int64_t columns) {{
  {gives}
}}
"""
TAKE_SOLID = """
static inline void take_solid(Solid* solid, int k, const double* column, int64_t columns) {
  double* to = (double*)solid;
  int64_t at = AT_SOLIDS + solid_first[k];
  for (int j = 0; j < 16; ++j) {
    to[j] = solid_varies[k] >> j & 1 ? column[at++ * columns] : solid_numbers[16 * k + j];
  }
}
"""


def text(environment: Environment, precision: Precision = "float64") -> str:
    """The text of a control step of an environment whose episodes have begun.

    Raises:
        NotCompilable: The task or the mode does more than arithmetic.
    """
    layout, vehicle, engine = Layout(environment), environment.vehicle, environment.engine
    program, mode, observer = layout.program, environment.control_mode, environment.observer
    first, command = Laws(mode, engine).functions()
    functions = {"begin": first, "finish": program.function}
    if not layout.pooled:
        functions["start"] = program.start
    if mode.has_loops:
        functions["command"] = command
    draws = [*observer.senses.draws.values()] if observer else []
    randomizer = environment.randomizer
    sizes: dict[str, int] = {"ROTORS": vehicle.rotor_count, "ACTIONS": mode.size}
    sizes |= {"SUBSTEPS": vehicle.substeps, "KEPT": layout.kept, "SEEN": layout.seen}
    sizes |= {"OBSERVED": layout.observed, "PRIVILEGED": int(min(layout.privileged, default=0))}
    sizes |= {"TRUTH": program.seen.end - program.remembered.end - layout.observed}
    sizes |= {"TERMS": len(layout.terms), "ENDS": len(layout.ends), "DRAWN": program.drawn}
    sizes |= {"BEGUN": layout.begun, "LENGTH": layout.late}
    sizes |= {"AT_STEPS": layout.motion + program.kept.end - 3}  # of the record `Episode`
    sizes |= {f"AT_{name.upper()}": at for name, at in layout.first.items()}
    streams = {"START": START, "MEMBERS": MEMBERS, "POOL": POOL, "PUSHES": PUSHES, "LINK": LINK}
    for name, function in functions.items():
        sizes |= {f"{name}_taken": function.taken, f"{name}_given": function.width}
    defines: dict[str, Any] = {
        "LOOPS": mode.has_loops,
        "EFFECTS": vehicle.aerodynamics.effects,
        "POOLED": layout.pooled,
        "LATE": layout.late > 0,
        "LINKED": layout.linked,
        "AGED": len(randomizer.past) > 0,
        "PUSHED": randomizer.push_chance > 0,
        "SENSES": observer is not None,
        "SENSORS": len(draws),
        "BLOWS": environment.blowing is not None,
        "SOLIDS": len(layout.solids),
        **({"SINGLE": 1} if precision == "float32" else {}),
    }
    pushes = environment.randomization.pushes
    defines |= {"PUSH_CHANCE": literal(randomizer.push_chance)}
    defines |= {"PUSH_VELOCITY": literal(pushes.velocity)}
    defines |= {"PUSH_BODY_RATE": literal(pushes.body_rate)}
    weather, about = _weather(environment, layout), _world(environment, layout)
    defines |= weather[0] | about[0]
    opened = {"layout.h", "export.h"}
    known = (
        f"static const int64_t sensed[][2] = {{{', '.join(f'{{{a}, {b}}}' for a, b in draws)}}};"
    )
    whole = TEXT.format(
        name=environment.task.name,
        vehicle=vehicle.name,
        structs=c_structs() + c_weather(),
        sizes=", ".join(f"{name} = {size}" for name, size in (sizes | streams).items()),
        defines="\n".join(
            f"#define {k} {int(v) if isinstance(v, bool) else v}" for k, v in defines.items()
        ),
        timestep=vehicle.physics_timestep.hex(),
        gravity=float(engine.model.opt.gravity[2]).hex(),
        functions="\n".join(f.text(f"{name}_function") for name, f in functions.items())
        + (known if draws else ""),
        aircraft="\n  ".join(_aircraft(environment, layout)),
        finish_takes="\n  ".join(_finish_takes(environment, layout)),
        start_takes=""
        if layout.pooled
        else "\n  ".join(_parameters(environment, program.start.places, 1 + MAX_DRAWN)),
        weather=weather[1],
        world=(_opened("solids.h", opened) if about[1] else "") + about[1],
        kernel=_opened("kernel.h", opened),
    )
    return single(whole) if precision == "float32" else whole


def _weather(environment: Environment, layout: Layout) -> tuple[dict[str, Any], str]:
    """Numbers of the weather, and the functions that read and write its rows."""
    if (process := environment.blowing) is None:
        return {}, ""
    weather, vehicle = environment.weather, environment.vehicle
    noisy = vehicle.rotor_count if noise_time_of(vehicle) else 0
    defines = {
        "NOISY": noisy,
        "PER_ROUGHNESS": literal(1 / weather.roughness),
        "CONTROL_TIMESTEP": literal(vehicle.control_timestep),
        "PER_GUST_TIME": literal(1 / weather.gust_time),
    }
    first, takes, gives = layout.first["weather"], list[str](), list[str]()
    for k in range(len(ROWS)):
        if k in layout.weather:
            place = f"column[{first + layout.weather.index(k)} * columns]"
            takes.append(f"t[{k}][0] = {place};")
            if k >= ROWS.index("steps"):
                gives.append(f"{place} = t[{k}][0];")
        else:
            takes.append(f"t[{k}][0] = {literal(float(process.table[k, 0]))};")
    return defines, WEATHER.format(takes="\n  ".join(takes), gives="\n  ".join(gives))


def _world(environment: Environment, layout: Layout) -> tuple[dict[str, Any], str]:
    """Numbers of the rays of a sensor, and what measures them and the solids."""
    observer, engine, parts = environment.observer, environment.engine, list[str]()
    defines: dict[str, Any] = {"RAYS": 0}
    for name, own in observer.senses.rays.items() if observer else ():
        if own is None:
            continue
        senses = cast(Any, observer).senses
        places = dict(zip(senses.given, np.cumsum([0, *senses.given.values()]), strict=False))
        numbers = {"NOISE": own.noise, "SHARE": own.share, "REACH": own.reach, "STEP": own.step}
        numbers["LOST"] = NormalDist().inv_cdf(1 - own.dropout) if own.dropout else 0.0
        numbers["LEAST"] = LEAST
        defines = {f"RAY_{k}": literal(float(x)) for k, x in numbers.items()}
        defines |= {"RAYS": own.count, "MAX_RAYS": own.count, "RAYS_DRAWN": own.drawn}
        defines |= {"RAY_STREAM": senses.channels[name].stream, "RAY_LOG": own.log}
        defines |= {"RAY_DROPOUT": own.dropout > 0, "RAY_FRAME": get_args(Frame).index(own.frame)}
        defines |= {"RAY_BIASED": name in places, "RAY_BIAS": places.get(name, 0)}
        parts += [_array("ray_along", own.along.T), _array("ray_place", np.array(own.place))]
    if not (layout.solids or parts):
        return defines, ""
    outline = engine.solids.outline
    defines |= {"BALLS": len(outline), "BALLS_REACH": literal(float(outline[:1, 4].sum()))}
    rows = ", ".join(
        f"{{{{{literal(x)}, {literal(y)}, {literal(z)}}}, {literal(r)}, {literal(far)}}}"
        for x, y, z, r, far in outline.tolist()
    )
    parts.append(f"static const Ball balls[] = {{{rows}}};")
    if layout.solids:
        parts += _take_solid(layout)
    return defines, "\n".join(parts)


def single(whole: str) -> str:
    """The same text in single precision."""
    whole = re.sub(NUMBER, r"\1f", re.sub(r"\bdouble\b", "float", whole))
    return whole.replace("__longlong_as_double(0x7ff0000000000000)", "__int_as_float(0x7f800000)")


def _array(name: str, numbers: np.ndarray) -> str:
    """A constant array in C."""
    flat = ", ".join(literal(number) for number in numbers.ravel().tolist())
    return f"static const double {name}[] = {{{flat}}};"


def _take_solid(layout: Layout) -> Iterator[str]:
    """What gives a solid of a row: its own numbers, and those that are the same for all."""
    firsts = np.cumsum([0, *(varies.sum() for _, varies in layout.solids)])[:-1].tolist()
    masks = [int((2 ** np.flatnonzero(varies)).sum()) for _, varies in layout.solids]
    yield _array("solid_numbers", np.stack([numbers for numbers, _ in layout.solids]))
    for name, whole in (("first", firsts), ("varies", masks)):
        yield f"static const int32_t solid_{name}[] = {{{', '.join(map(str, whole))}}};"
    yield TAKE_SOLID


def _aircraft(environment: Environment, layout: Layout) -> Iterator[str]:
    """The statements that fill an Aircraft."""
    rotors, first = environment.vehicle.rotor_count, layout.first["parameters"]
    places = dict(zip(layout.varying, range(first, first + len(layout.varying)), strict=True))
    own = _fields(environment.engine.begun[:1], rotors)
    for (path, number), (_, at) in zip(own, _fields(parameters.PLACES, rotors), strict=True):
        place = places.get(int(at))
        yield f"{path} = {literal(number) if place is None else f'column[{place} * columns]'};"


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


def _finish_takes(environment: Environment, layout: Layout) -> Iterator[str]:
    """The statements that gather what the task's part takes after the motion.

    Raises:
        NotCompilable: It reads something of solids that is not measured here.
    """
    program, motion, given = layout.program, layout.motion, layout.first["given"]
    texts = {
        "last_motion": "last[{}][0]",
        "action": "action[{}]",
        "command": "mean[{}][0]",
        "was": f"column[({motion} + {{}}) * columns]",
        "wind": "air[{}][0]",
        "given": f"column[({given} + {{}}) * columns]",
    }
    first = motion + 1 + sum(program.sensed.values())
    for name, count in program.parts.items():
        known = _measured(program) if name == "world" else {}
        for number, place in program.function.places.items():
            if not 0 <= number - first < count or name == "parameters":
                continue
            if name not in texts and number - first not in known:
                raise NotCompilable("it reads more of solids than clearance, touch and rays")
            text = known.get(number - first) or texts[name].format(number - first)
            yield f"x[{place}][0] = {text};"
        if name == "parameters":
            yield from _parameters(environment, program.function.places, first)
        first += count


def _measured(program: Program) -> dict[int, str]:
    """What is measured of the world, by its place.

    A solid is touched where the clearance, a lower bound, is not positive; which one, nobody asks.
    """
    if not program.world.end:
        return {}
    _, clearance, touched, *_, rays = program.world.views(np.arange(program.world.end)[:, None])
    found = {int(clearance.item()): "clearance"}
    found |= {int(at): "clearance <= 0" if not k else "0" for k, at in enumerate(touched.flat)}
    return found | {int(at): f"read[{k}]" for k, at in enumerate(rays.flat)}


def _parameters(environment: Environment, places: dict[int, int], first: int) -> Iterator[str]:
    """The statements that gather the parameters that a task sees, which come from a place on."""
    seen, true = parameters.numbers(environment.seen_rows[:1])[0], environment.sees_true_parameters
    names = {int(at): path for path, at in _fields(parameters.PLACES, parameters.MAX_ROTORS)}
    for number, place in places.items():
        at = number - first
        if 0 <= at < parameters.ROW_SIZE:
            yield f"x[{place}][0] = {names[at] if true else literal(float(seen[at]))};"


def literal(number: float) -> str:
    """A number as C has it, every bit of it."""
    return f"({number.hex()})" if np.isfinite(number) else WITHOUT_HEX[str(number)]


def _opened(name: str, seen: set[str]) -> str:
    """One of our C files with those that it includes, each once, and without the library's."""
    if name in seen:
        return ""
    seen.add(name)
    whole = re.sub(
        r"#include <.*\n|#define LANES .*\n|#pragma GCC optimize.*\n",
        "",
        (FOLDER / name).read_text(),
    )
    return re.sub(r'#include "(.+?)".*\n', lambda found: _opened(found[1], seen), whole)
