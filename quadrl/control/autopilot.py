"""The autopilot of N aircraft: a control mode with loops, compiled if there is a compiler.

At every physics step the loops turn the present state and the setpoint into rotor commands. They
are written once (`quadrl.control.modes`, `loops`), as functions of arrays; without a compiler NumPy
runs them, with the same results.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable

import numpy as np

from quadrl.base.errors import NativeError
from quadrl.base.rotation import Array
from quadrl.control.mode import ControlMode
from quadrl.engines.engine import Engine
from quadrl.engines.rowwise import RowFunction, reverse
from quadrl.engines.state import State

COORDINATES = 7, 6
"""Sizes of a row of qpos and of qvel; rotor speeds follow."""


class Laws:
    """A control mode as functions of coordinates instead of a state."""

    def __init__(self, mode: ControlMode, engine: Engine) -> None:
        """Take the mode, and the origin of the task's frame."""
        self.mode, self._origin = mode, engine.origin
        self.widths = *COORDINATES, mode.vehicle.rotor_count
        """Sizes of a row of qpos, qvel and rotor speeds, the first arguments of both functions."""

    def functions(self) -> tuple[RowFunction, RowFunction]:
        """The functions to compile: setpoint and rotor commands.

        Raises:
            NotCompilable: The mode does more than arithmetic.
        """
        first = RowFunction(self.setpoint, *self.widths, self.mode.size)
        return first, RowFunction(self.command, *self.widths, first.width)

    def setpoint(self, qpos: Array, qvel: Array, act: Array, action: Array) -> Array:
        """The setpoint (N, n), as `ControlMode.setpoint` gives it."""
        return self.mode.setpoint(self._state(qpos, qvel, act), action)

    def command(self, qpos: Array, qvel: Array, act: Array, setpoint: Array) -> Array:
        """Rotor commands (N, R) [rad/s], as `ControlMode.rotor_command` gives them."""
        return self.mode.rotor_command(self._state(qpos, qvel, act), setpoint)

    def _state(self, qpos: Array, qvel: Array, act: Array) -> State:
        parts = qpos[:, :3] - self._origin, qpos[:, 3:], qvel[:, :3], qvel[:, 3:], act
        return State.of_coordinates(*parts, origin_height=float(self._origin[2]))


class Autopilot:
    """Flies the rows of an engine with the loops of a mode."""

    def __init__(self, mode: ControlMode, engine: Engine, action: np.ndarray) -> None:
        """Compile the loops.

        Args:
            mode: A mode with loops.
            engine: The engine that flies the aircraft.
            action: (N, k), live: it is read when a control step begins.
        """
        self._mode, self._engine, self._action = mode, engine, action
        self.rotor_command = np.zeros(engine.act.shape)
        """The last commands (N, R) [rad/s]."""
        self._compiled: tuple[Callable[[], None], Callable[[], None]] | None = None
        live = engine.qpos, engine.qvel, engine.act
        self.functions = first, second = Laws(mode, engine).functions()
        """The functions to compile: setpoint and rotor commands."""
        self.setpoint = np.zeros((engine.num_envs, first.width))
        """The setpoint (N, n) of this control step."""
        with contextlib.suppress(NativeError):
            at_first = first.on(*live, action, self.setpoint)
            self._compiled = at_first, second.on(*live, self.setpoint, self.rotor_command)

    @functools.cached_property
    def reversed(self) -> Reversed:
        """The derivatives of its commands."""
        return Reversed(self._mode, self._engine)

    @property
    def is_compiled(self) -> bool:
        """Whether C runs the loops."""
        return self._compiled is not None

    def begin(self) -> None:
        """Compute the setpoint of a control step that begins."""
        if self._compiled:
            self._compiled[0]()
        else:
            self.setpoint[:] = self._mode.setpoint(self._engine.peek(), self._action)

    def command(self) -> np.ndarray:
        """Rotor commands (N, R) [rad/s] for the next physics step; valid until the one after.

        Those of an aircraft that has diverged may be NaN.
        """
        if self._compiled:
            self._compiled[1]()
        else:
            with np.errstate(invalid="ignore", over="ignore"):
                found = self._mode.rotor_command(self._engine.peek(), self.setpoint)
            self.rotor_command[:] = found
        return self.rotor_command


class Reversed:
    """The derivatives of an autopilot's commands by the motion and the actions of aircraft."""

    def __init__(self, mode: ControlMode, engine: Engine) -> None:
        """Trace the functions; they are compiled at their first use."""
        laws = Laws(mode, engine)
        self._width = sum(laws.widths)
        setpoint = RowFunction(laws.setpoint, *laws.widths, mode.size)
        widths = *laws.widths, setpoint.width
        rotors = mode.vehicle.rotor_count
        self._command = RowFunction(reverse(laws.command), *widths, rotors)
        widths = *laws.widths, mode.size
        self._setpoint = RowFunction(reverse(laws.setpoint), *widths, setpoint.width)
        self.functions = self._command, self._setpoint
        """The functions to compile."""

    def compile(self) -> None:
        """Compile the functions that are not in the cache.

        Raises:
            NativeError: There is no compiler, or it refused the source.
        """
        for function in self.functions:
            function.load()

    def command(
        self, motion: np.ndarray, setpoint: np.ndarray, given: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of a scalar by motion and setpoint, from those by rotor commands.

        Args:
            motion: (N, 13 + R), qpos, qvel and rotor speeds side by side.
            setpoint: (N, n).
            given: The derivatives (N, R) by the rotor commands.
        """
        return self._split(self._command(*self._parts(motion), setpoint, given))

    def setpoint(
        self, motion: np.ndarray, action: np.ndarray, given: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of a scalar by motion and action, from those by the setpoint (N, n)."""
        return self._split(self._setpoint(*self._parts(motion), action, given))

    def _parts(self, motion: np.ndarray) -> list[np.ndarray]:
        return np.split(motion, np.cumsum(COORDINATES), axis=1)

    def _split(self, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return found[:, : self._width], found[:, self._width :]
