"""Derivatives of free flight by the state and by the rotor commands.

`native/adjoint.c` is the reverse mode of the steps of `native/free_flight.c`, with every force: the
paper's, wind, and effects of the air on rotors. `quadrl.base.trace` generates the reverse of the
equations from `dynamics.derivative`, for the effects of the air and the number of rotors that are
flown. Forces that are defined piece by piece (the largest rotor speed, rotors that rise and fall at
different rates, the limits of lift, the vortex ring state) have the derivative of the piece in use;
at an edge, where there is none, that of one side. The wind counts as given, although its mean
depends on the height.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from quadrl.aircraft.aerodynamics import GROUND_EFFECT, ROTOR_EFFECTS, STILL_AIR
from quadrl.aircraft.parameters import AIR, MAX_ROTORS, PLACES, Parameters
from quadrl.base.rotation import Array
from quadrl.base.trace import Trace
from quadrl.engines import dynamics, native
from quadrl.engines.native import compiling
from quadrl.engines.threads import LANES

COORDINATES = 13
"""Size of a motion without rotor speeds: 7 of qpos, 6 of qvel."""
STEP_ROWS = 4 * (COORDINATES + MAX_ROTORS) + 4
"""Rows of `Step` in native/adjoint.c, of LANES numbers each."""
SOURCE = """enum {{ EFFECTS = {effects}, ROTORS = {rotors} }};
static const double c[] = {{{constants}}};

// From the derivatives of a scalar by the rates of change of motions m to those by the motions,
// which are set, and by the commands, which are added to. p: the numbers of an Aircraft.
VECTORISED static void back_derivative(
    const Lanes* restrict p, const Lanes* restrict m, const Lanes* restrict command,
    const Lanes* restrict air, const Lanes* restrict rate_, Lanes* restrict m_,
    Lanes* restrict command_) {{
  for (int i = 0; i < LANES; ++i) {{
    {body}
  }}
}}
"""


def reverse(effects: int, rotors: int) -> str:
    """C of the reverse of `dynamics.derivative`, for effects of the air and a number of rotors."""
    trace, size = Trace(max_operations=math.inf), COORDINATES + rotors

    def read(name: str, rows: Array) -> Array:
        return trace.read(f"{name}[{{}}][i]", rows)

    parameters = Parameters.of(PLACES, rotors=rotors).map(functools.partial(read, "p"))
    sizes = {"m": size, "command": rotors, "air": AIR, "rate_": size}
    m, command, air, given = (read(name, np.arange(n)[None]) for name, n in sizes.items())
    parts = m[:, :3], m[:, 3:7], m[:, 7:10], m[:, 10:13], m[:, 13:]
    motion = dynamics.Motion(*parts)
    rate = dynamics.derivative(parameters, motion, command, air, 0.0, effects)
    results = np.concatenate(list(vars(rate).values()), axis=-1)
    by = trace.vector_jacobian_product(results[0], given[0], [*m[0], *command[0]])
    sums = read("command_", np.arange(rotors)) + np.array(by[size:], dtype=object)
    outputs = {f"m_[{k}][i]": value for k, value in enumerate(by[:size])}
    body = trace.body(outputs | {f"command_[{k}][i]": value for k, value in enumerate(sums)})
    constants = ", ".join(map(float.hex, trace.constants))
    return SOURCE.format(effects=effects, rotors=rotors, constants=constants, body=body)


def build(effects: int, rotors: int, target: compiling.Target = compiling.HERE) -> Path:
    """Compile native/adjoint.c by `compiling.build`; the other arguments are those of `kernel`."""
    generated = {"reverse.h": reverse(effects, rotors)}
    return compiling.build(("adjoint.c",), "adjoint", generated, target=target)


@functools.cache
def kernel(effects: int, rotors: int) -> Callable[[int, int, int], None]:
    """`quadrl_adjoint` of native/adjoint.c, compiled unless it is in the cache.

    Args:
        effects: The largest `Aerodynamics.effects` of the aircraft.
        rotors: Number of rotors of each.

    Raises:
        NativeError: There is no compiler, or it refused the sources.
    """
    function = compiling.open_library(build(effects, rotors)).quadrl_adjoint
    function.restype = None
    function.argtypes = [ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64]
    return function


@dataclasses.dataclass(frozen=True)
class Leg:
    """A flight of N aircraft over some physics steps: its start, commands, air and parameters."""

    start: np.ndarray  # (N, 13 + R): qpos, qvel and rotor speeds side by side
    command: np.ndarray  # (N, R) of the rotors [rad/s]
    air: np.ndarray  # (N, AIR), as `parameters.AIR` has it
    parameters: np.ndarray  # (1,) row for all, or blocks of LANES, as free flight has them
    world: np.ndarray  # (3,), of `free_flight.world`
    steps: int  # number of physics steps

    def fly(self) -> np.ndarray:
        """The state at its end, (N, 13 + R)."""
        return self._run(None)[0]

    def vector_jacobian_product(self, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The derivatives of a scalar of each aircraft by `start` and by `command`.

        Args:
            given: Those by the state at its end, (N, 13 + R).

        Returns:
            (N, 13 + R) and (N, R). A quaternion counts as four numbers; only its direction matters.
        """
        return self._run(np.ascontiguousarray(given, dtype=np.float64))[1:]

    def _run(self, given: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        end, from_start = np.empty_like(self.start), np.empty_like(self.start)
        from_command = np.empty_like(self.command)
        path = np.empty((self.steps, STEP_ROWS, LANES))
        left = np.ones(-(-len(end) // LANES), dtype=np.int8)
        taken = (self.start, self.command, self.air, self.parameters)
        filled = (self.world, end, from_start, from_command, path, left)
        block = self.parameters[0].size if self.parameters.ndim > 1 else 0
        # As `Legs` in native/adjoint.c.
        legs = native.struct(*taken, given, *filled, block)
        column = int(PLACES["effects"][0])
        own = self.parameters[:, column] if block else self.parameters["effects"]
        # A row with another value is damaged; its results are NaN.
        found = (kind for kind in (ROTOR_EFFECTS, GROUND_EFFECT) if (own == kind).any())
        most = max(found, default=STILL_AIR)
        for effects in (min(most, ROTOR_EFFECTS), most):  # few come near the ground
            if left.any():
                kernel(effects, self.command.shape[1])(legs.ctypes.data, len(end), self.steps)
        return end, from_start, from_command
