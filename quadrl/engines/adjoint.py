"""Derivatives of free flight: how where an aircraft will be depends on where it is and its rotors.

`native/adjoint.c` is the reverse of the steps of `native/free_flight.c`, with every force: the
paper's, wind, and what the air does to rotors. Forces that are defined piece by piece (the largest
rotor speed, rotors that rise and fall at different rates, the limits of lift, the vortex ring
state) have the derivative of the piece that they are on; at an edge, where there is none, that of
one side. The wind counts as given, although its mean depends on the height.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from quadrl.aircraft.parameters import MAX_ROTORS
from quadrl.engines import native
from quadrl.engines.free_flight import LANES

COORDINATES = 13
"""Numbers of a motion beside its rotor speeds: 7 of qpos, 6 of qvel."""


@dataclasses.dataclass(frozen=True)
class Leg:
    """What N aircraft flew from and in, for some physics steps."""

    start: np.ndarray  # (N, 13 + R): qpos, qvel and rotor speeds side by side
    command: np.ndarray  # (N, R) of the rotors [rad/s]
    air: np.ndarray  # (N, AIR), as `parameters.AIR` has it
    parameters: np.ndarray  # (1,) row for all, or blocks of LANES, as free flight has them
    world: np.ndarray  # (3,), of `free_flight.world`
    steps: int  # physics steps

    def fly(self) -> np.ndarray:
        """Where it led, (N, 13 + R)."""
        return self._run(None)[0]

    def pull(self, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The derivatives of a number, of each aircraft, by `start` and by `command`.

        Args:
            given: Those by where the leg led, (N, 13 + R).

        Returns:
            (N, 13 + R) and (N, R). A quaternion counts as four numbers; only its direction matters.
        """
        return self._run(np.ascontiguousarray(given, dtype=np.float64))[1:]

    def _run(self, given: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        end, from_start = np.empty_like(self.start), np.empty_like(self.start)
        from_command = np.empty_like(self.command)
        path = np.empty((self.steps, COORDINATES + MAX_ROTORS, LANES))
        taken = (self.start, self.command, self.air, self.parameters)
        own = (self.world, end, from_start, from_command, path)
        block = self.parameters[0].size if self.parameters.ndim > 1 else 0
        # As `Legs` in native/adjoint.c.
        legs = np.array(
            [*(array.ctypes.data for array in taken), 0 if given is None else given.ctypes.data,
             *(array.ctypes.data for array in own), block, self.command.shape[1]]
        )  # fmt: skip
        native.adjoint().quadrl_adjoint(legs.ctypes.data, len(end), self.steps)
        return end, from_start, from_command
