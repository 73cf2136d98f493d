"""The compiled part: callbacks of the rotors, free flight, state, weather, random numbers.

Its sources stand beside this file; `compiling` says when and how they are compiled.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import threading
import warnings
from collections.abc import Generator
from pathlib import Path

import mujoco
import numpy as np

from quadrl.base.errors import NativeError
from quadrl.engines.native.compiling import build, open_library

MARK_SLOT = 9
"""Index of MARK in an actuator's `dynprm`."""
CALLBACKS = ("act_dyn", "act_gain", "passive")
INTERFERING = ("control", "contactfilter")
"""Callbacks that quadrl leaves empty, and with which other code would change a flight. The others
change none: no model of quadrl's has what `act_bias` and `sensor` compute."""
MAX_WARNINGS = 500
"""Largest number of lines in a file of MuJoCo's warnings, at most 60 kB."""

_POINTER, _INTEGER, _REAL = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
_ACTUATOR_CALLBACK = ctypes.CFUNCTYPE(ctypes.c_double, _POINTER, _POINTER, ctypes.c_int)
_KINDS = {
    "act_dyn": _ACTUATOR_CALLBACK,
    "act_gain": _ACTUATOR_CALLBACK,
    "passive": ctypes.CFUNCTYPE(None, _POINTER, _POINTER),
    "time": ctypes.CFUNCTYPE(ctypes.c_double),
    "warning": ctypes.CFUNCTYPE(None, ctypes.c_char_p),
}
"""Types of the functions that MuJoCo calls."""
_KERNELS = {
    "state": (_INTEGER, _POINTER, _INTEGER, _POINTER, _POINTER),
    "unsound_air": (_INTEGER, _POINTER, _INTEGER),
    "clearance": (_INTEGER, _POINTER, _INTEGER, _INTEGER, _POINTER, _POINTER),
    "stand": (None, _POINTER, _INTEGER),
    "rays": (_INTEGER, _POINTER, _INTEGER, _INTEGER, _POINTER, _POINTER),
    "free_flight": (_INTEGER, _POINTER, _INTEGER, _INTEGER, _INTEGER),
    "step": (_INTEGER, _POINTER, _POINTER, *[_INTEGER] * 5),
    "begin": (
        *(_INTEGER, _POINTER, _POINTER, _INTEGER, _POINTER, _INTEGER),
        *(_POINTER, _POINTER, _INTEGER, _INTEGER, _INTEGER, _POINTER),
    ),
    "place": (None, _POINTER, _POINTER, _INTEGER, _POINTER, _INTEGER, _INTEGER),
    "weather": (None, _POINTER, _INTEGER, _POINTER, _INTEGER),
    "push": (None, _INTEGER, *[_POINTER] * 3, _INTEGER, *[_REAL] * 3, _POINTER, _INTEGER),
    "link": (None, _INTEGER, *[_POINTER] * 3, _INTEGER, *[_POINTER] * 4, _INTEGER, *[_POINTER] * 2),
    "normal": (None, _INTEGER, *[_POINTER] * 3, _INTEGER, _INTEGER, _POINTER),
    "uniform": (None, _INTEGER, _POINTER, _POINTER, _INTEGER, _INTEGER, _INTEGER, _POINTER),
    "write_warnings": (None, ctypes.c_char_p, ctypes.c_int),
}
"""Functions that Python calls: the types of the result and of the arguments of each."""


def load(path: Path) -> ctypes.CDLL:
    """Open a compiled library and check that it was compiled against the running mujoco.

    Raises:
        NativeError: It was compiled against another version.
    """
    opened = open_library(path)
    built, running = opened.quadrl_mujoco_version(), mujoco.mj_version()
    if built != running:
        raise NativeError(
            f"{path} was compiled against mujoco {built}, but mujoco {running} is running; "
            "delete it, and it is compiled again at the next use"
        )
    for name, kind in _KINDS.items():
        setattr(opened, name, ctypes.cast(getattr(opened, f"quadrl_{name}"), kind))
    for name, (result, *arguments) in _KERNELS.items():
        kernel = getattr(opened, f"quadrl_{name}")
        kernel.restype, kernel.argtypes = result, arguments
    return opened


def address(array: np.ndarray) -> int:
    """The address of an array's data, in a third of the time of `array.ctypes.data`.

    The array must be contiguous, writable and not empty.
    """
    return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]


def struct(*members: np.ndarray | int | None) -> np.ndarray:
    """A C struct of pointers to arrays (None for NULL) and 64-bit integers, in order.

    It does not keep the arrays alive.
    """
    return np.array([x.ctypes.data if isinstance(x, np.ndarray) else x or 0 for x in members])


_LOCK = threading.Lock()


def library() -> ctypes.CDLL:
    """The library for this process, compiled when needed."""
    with _LOCK:  # one library for all threads, since MuJoCo has one set of callbacks
        return _library()


@functools.cache
def _library() -> ctypes.CDLL:
    return load(build())


@functools.cache
def _stop_clock() -> None:
    """Save the time in which MuJoCo reads the clock at every step, unless a clock is installed.

    Done once per process. Physics does not depend on it, but `mjData.timer` of every model then
    shows no durations. To keep them, set `$QUADRL_KEEP_CLOCK` to 1 before the first model is made,
    or call `mujoco.set_mjcb_time(None)` at any time.
    """
    if os.environ.get("QUADRL_KEEP_CLOCK", "0") in ("", "0") and mujoco.get_mjcb_time() is None:
        mujoco.set_mjcb_time(library().time)


@functools.cache
def _take_warnings() -> None:
    """Write a few of MuJoCo's warnings to stderr and none to a file, unless a handler is installed.

    Done once per process. MuJoCo itself writes all of them, also to MUJOCO_LOG.TXT in the working
    folder; `mujoco.set_mju_user_warning(None)` brings that back at any time.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(library().warning)


@contextlib.contextmanager
def warnings_in(path: Path) -> Generator[None]:
    """Append MuJoCo's warnings to a file of at most MAX_WARNINGS lines instead of stderr.

    The first warning creates it. A handler that other code installed keeps its warnings.
    """
    lines = len(path.read_text(errors="replace").splitlines()) if path.exists() else 0
    write = library().quadrl_write_warnings
    write(os.fsencode(path.absolute()), max(MAX_WARNINGS - lines, 0))
    try:
        yield
    finally:
        write(None, 0)


def install(replace: bool = False) -> None:
    """Install the rotor callbacks in this process (idempotent).

    Every model of `quadrl.engines.mjcf` needs them, which calls this itself. A process that
    receives such a model from elsewhere (a spawned worker) calls it once.

    Args:
        replace: Replace callbacks that other code installed, with a warning.

    Raises:
        NativeError: Other code has installed a callback, and `replace` is False.
    """
    ours = library()
    foreign = [
        name
        for name in CALLBACKS
        if (current := _current(name)) is not None and current != getattr(ours, name)
    ]
    if foreign and not replace:
        raise NativeError(
            f"another callback is installed as {_names(foreign)}; quadrl does not replace it "
            "unless asked: remove it, or call quadrl.engines.native.install(replace=True)"
        )
    if foreign:
        warnings.warn(f"quadrl replaces the callback {_names(foreign)}", stacklevel=2)
    for name in CALLBACKS:
        getattr(mujoco, f"set_mjcb_{name}")(getattr(ours, name))
    _stop_clock()
    _take_warnings()


def check_installed() -> None:
    """Raise unless the rotor callbacks are in place, and no other that acts on an aircraft.

    Raises:
        NativeError: One of them was removed or replaced, or one of INTERFERING is installed, so
            that the physics would be wrong.
    """
    ours = library()
    if (
        mujoco.get_mjcb_act_dyn() is ours.act_dyn
        and mujoco.get_mjcb_act_gain() is ours.act_gain
        and mujoco.get_mjcb_passive() is ours.passive
        and mujoco.get_mjcb_control() is None
        and mujoco.get_mjcb_contactfilter() is None
    ):
        return
    if missing := [name for name in CALLBACKS if _current(name) != getattr(ours, name)]:
        raise NativeError(
            f"the rotor callback {_names(missing)} was removed or replaced by other code, and "
            "the physics would be wrong; call quadrl.engines.native.install() again"
        )
    others = [name for name in INTERFERING if _current(name) is not None]
    raise NativeError(
        f"other code has installed {_names(others)}, which acts on every model in the process "
        "and would change this flight; remove it before an aircraft of quadrl's flies: "
        f"mujoco.set_mjcb_{others[0]}(None)"
    )


def _current(name: str) -> object:
    return getattr(mujoco, f"get_mjcb_{name}")()


def _names(callbacks: list[str]) -> str:
    return ", ".join(f"mjcb_{name}" for name in callbacks)
