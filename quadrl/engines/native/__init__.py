"""The compiled part: callbacks of the rotors, free flight, state, weather, random numbers.

The C sources beside this file are compiled at first use with the machine's own compiler against
the headers of the installed mujoco, because they read the structs of exactly that version. The
library is kept in a cache folder (`$QUADRL_CACHE`, else the user's cache folder), one for each
version of mujoco, of the sources and of the flags; `$QUADRL_CFLAGS` adds flags at the end of
these (`scripts/sanitize` does). Its name ends with a digest of its bytes, so that one that was
damaged is known before it is loaded, and built anew. `layout.h`, which declares a row of parameters
and the rows of the state and of the weather, is written into the build from
`quadrl.aircraft.parameters`, `quadrl.engines.state` and `quadrl.engines.air`.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from quadrl.aircraft.parameters import c_structs
from quadrl.base.errors import NativeError
from quadrl.base.files import lock, put
from quadrl.engines.air import c_weather
from quadrl.engines.state import c_rows

SOURCES = ("callbacks.c", "free_flight.c", "state.c", "random.c", "weather.c",
           "disturbances.c", "solids.c", "warnings.c")  # fmt: skip
HEADERS = ("aero.h", "export.h", "philox.h", "runge_kutta.h", "solids.h")
MARK_SLOT = 9
"""Entry of an actuator's `dynprm` that holds MARK."""
# No contraction: a fused multiply-add would round otherwise than NumPy does.
FLAGS = (
    "-std=c11",
    "-O3",
    "-fPIC",
    "-shared",
    "-fvisibility=hidden",
    "-ffp-contract=off",
    "-fno-math-errno",
)
CALLBACKS = ("act_dyn", "act_gain", "passive")
MAX_WARNINGS = 500
"""Lines of a file of MuJoCo's warnings: at most 60 kB."""

_FOLDER = Path(__file__).parent
_POINTER = ctypes.c_void_p
_ACTUATOR_CALLBACK = ctypes.CFUNCTYPE(ctypes.c_double, _POINTER, _POINTER, ctypes.c_int)
_KINDS = {
    "act_dyn": _ACTUATOR_CALLBACK,
    "act_gain": _ACTUATOR_CALLBACK,
    "passive": ctypes.CFUNCTYPE(None, _POINTER, _POINTER),
    "time": ctypes.CFUNCTYPE(ctypes.c_double),
    "warning": ctypes.CFUNCTYPE(None, ctypes.c_char_p),
}
_SCRATCH = "quadrl-build-"
_ALONE: dict[Path, contextlib.ExitStack] = {}
"""Libraries of this process alone that are not loaded yet, and what removes each."""


def cache_folder() -> Path:
    """The folder of compiled libraries: `$QUADRL_CACHE` or the user's cache folder."""
    if chosen := os.environ.get("QUADRL_CACHE"):
        return Path(chosen)
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "quadrl"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "quadrl"


def flags() -> tuple[str, ...]:
    """What the compiler is given: FLAGS, and those of `$QUADRL_CFLAGS`."""
    return (*FLAGS, *shlex.split(os.environ.get("QUADRL_CFLAGS", "")))


def compiler() -> str:
    """Path of the C compiler: `$CC`, cc, gcc or clang.

    Raises:
        NativeError: None is there; the message says what to install.
    """
    for name in filter(None, (os.environ.get("CC"), "cc", "gcc", "clang")):
        if path := shutil.which(name):
            return path
    raise NativeError(
        "no C compiler found (looked for $CC, cc, gcc, clang); install one: "
        "`apt-get install build-essential` on Debian or Ubuntu, `dnf install gcc` on Fedora, "
        "`xcode-select --install` on macOS"
    )


def build(
    sources: Sequence[str] = SOURCES,
    name: str = "mujoco",
    generated: Mapping[str, str] | None = None,
    include: Path | None = None,
) -> Path:
    """Compile a library unless the cache holds it.

    Args:
        sources: Files beside this one.
        name: Of the library, with the version of mujoco behind it.
        generated: Headers that they include besides, by name.
        include: Folder with mujoco's headers; None for those of the installed package.

    Returns:
        The path of the shared library.

    Raises:
        NativeError: There is no compiler, or it refused the sources.
    """
    include = include or Path(mujoco.__file__).parent / "include"
    digest = hashlib.sha256(" ".join((*flags(), platform.machine(), str(include))).encode())
    written = {"layout.h": c_structs() + c_rows() + c_weather()} | dict(generated or {})
    digest.update("".join(written.values()).encode())
    for file in (*HEADERS, *sources):
        digest.update((_FOLDER / file).read_bytes())
    digest.update((include / "mujoco" / "mujoco.h").read_bytes())
    whole = f"quadrl-{name}-{mujoco.__version__}-{digest.hexdigest()[:16]}"
    paths = [str(_FOLDER / source) for source in sources]
    return _cached(whole, [f"-I{include}", *paths], written)


@functools.cache
def compile_generated(source: str) -> ctypes.CDLL:
    """A library of C that was generated, compiled unless the cache holds it.

    Raises:
        NativeError: There is no compiler, or it refused the source.
    """
    digest = hashlib.sha256(" ".join((*flags(), platform.machine(), source)).encode())
    name = digest.hexdigest()[:16]
    return open_library(_cached(f"quadrl-generated-{name}", [], {f"{name}.c": source}))


def _cached(name: str, arguments: list[str], written: dict[str, str]) -> Path:
    """A library of the cache, compiled first where there is no sound one.

    Args:
        name: Of its file, without digest and ending; another one for other contents.
        arguments: Further ones of the compiler.
        written: Files that are written first, by name: headers, and sources to compile.
    """
    folder = cache_folder()
    with contextlib.suppress(OSError):  # a folder that may not be looked into
        for path in folder.glob(f"{name}-*.so"):
            if path == _place(path, name):
                return path
    with contextlib.ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            scratch = stack.enter_context(_scratch(folder))
        except OSError:  # a read-only home: a library for this process alone
            scratch = stack.enter_context(_scratch(Path(tempfile.gettempdir())))
            folder = scratch
        for file, text in written.items():
            (scratch / file).write_text(text)
        sources = [f"{scratch}/{file}" for file in written if file.endswith(".c")]
        command = [compiler(), *flags(), f"-I{scratch}", "-o", f"{scratch}/built.so"]
        command += [*arguments, *sources, "-lm"]
        # What a compiler that is killed leaves behind goes with the rest.
        environment = os.environ | {"TMPDIR": str(scratch)}
        outcome = subprocess.run(command, capture_output=True, text=True, env=environment)
        if outcome.returncode != 0:
            raise NativeError(
                f"the C compiler failed: {' '.join(command)}\n{outcome.stderr.strip()[-2000:]}"
            )
        path = folder / _place(scratch / "built.so", name).name
        put(scratch / "built.so", path)
        if folder == scratch:
            _ALONE[path] = stack.pop_all()
            atexit.register(_ALONE[path].close)  # if it is never loaded
    return path


def _place(library: Path, name: str) -> Path:
    """Where a library belongs by its name and its bytes, in its folder."""
    digest = hashlib.sha256(library.read_bytes()).hexdigest()
    return library.with_name(f"{name}-{digest[:16]}.so")


@contextlib.contextmanager
def _scratch(folder: Path) -> Generator[Path]:
    """A new folder in another one, for a build; those that killed builds left there are removed.

    A build holds the lock of its folder: one that can be locked belongs to nobody any more.
    """
    for left in folder.glob(f"{_SCRATCH}*"):
        with contextlib.suppress(OSError):
            descriptor = lock(left)
            shutil.rmtree(left, ignore_errors=True)
            os.close(descriptor)
    path, descriptor = _locked(folder)
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        if descriptor is not None:
            os.close(descriptor)


def _locked(folder: Path) -> tuple[Path, int | None]:
    """A new folder in another one, and the descriptor that locks it, if the file system can."""
    while True:
        path = Path(tempfile.mkdtemp(prefix=_SCRATCH, dir=folder))
        try:
            descriptor = lock(path)
        except (BlockingIOError, FileNotFoundError):
            continue  # another build was faster, and takes it for one that was left
        except OSError:
            return path, None  # nor can another build lock and remove it
        if path.exists():
            return path, descriptor
        os.close(descriptor)


def open_library(path: Path) -> ctypes.CDLL:
    """Open a compiled library; one for this process alone leaves no file behind.

    Raises:
        NativeError: The system refuses it.
    """
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        reason = f"the compiled library cannot be loaded: {error}; $QUADRL_CACHE names a folder"
        raise NativeError(f"{reason} that programs may be run from") from error
    finally:
        if stack := _ALONE.pop(path, None):
            stack.close()


def load(path: Path) -> ctypes.CDLL:
    """Open a compiled library and make sure that it belongs to the mujoco that runs.

    Raises:
        NativeError: It was compiled against another version of mujoco.
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
    integer = ctypes.c_int64
    for kernel in (opened.quadrl_state, opened.quadrl_unsound_air, opened.quadrl_free_flight):
        kernel.restype = integer
    opened.quadrl_state.argtypes = [_POINTER, integer, _POINTER, _POINTER]
    opened.quadrl_unsound_air.argtypes = [_POINTER, integer]
    opened.quadrl_clearance.restype = None
    opened.quadrl_clearance.argtypes = [_POINTER, integer, _POINTER]
    opened.quadrl_free_flight.argtypes = [_POINTER, integer, integer, integer]
    opened.quadrl_uniform.restype = opened.quadrl_weather.restype = None
    opened.quadrl_write_warnings.restype = None
    opened.quadrl_write_warnings.argtypes = [ctypes.c_char_p, ctypes.c_int]
    opened.quadrl_weather.argtypes = [_POINTER, integer, _POINTER, integer]
    real, stride = ctypes.c_double, integer
    opened.quadrl_estimate.restype = opened.quadrl_push.restype = None
    opened.quadrl_estimate.argtypes = [_POINTER, integer, _POINTER]
    opened.quadrl_push.argtypes = [
        *(integer, _POINTER, _POINTER, _POINTER, integer, real, real, real, _POINTER, stride),
    ]
    opened.quadrl_uniform.argtypes = [
        *(integer, _POINTER, _POINTER, integer, integer, integer, _POINTER),
    ]
    return opened


def address(array: np.ndarray) -> int:
    """Where an array's numbers stand; in a third of the time of `array.ctypes.data`.

    It must be contiguous and writable, and not be empty.
    """
    return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]


_LOCK = threading.Lock()


def library() -> ctypes.CDLL:
    """The library for this process, built when needed."""
    with _LOCK:  # one for all threads, since MuJoCo has one set of callbacks
        return _library()


@functools.cache
def _library() -> ctypes.CDLL:
    return load(build())


@functools.cache
def _stop_clock() -> None:
    """Spare every step MuJoCo's readings of the clock, unless a clock is installed already.

    Done once per process. Physics does not depend on it, but `mjData.timer` of every model then
    shows no durations. To keep them, set `$QUADRL_KEEP_CLOCK` to 1 before the first model is made,
    or call `mujoco.set_mjcb_time(None)` at any time.
    """
    if os.environ.get("QUADRL_KEEP_CLOCK", "0") in ("", "0") and mujoco.get_mjcb_time() is None:
        mujoco.set_mjcb_time(library().time)


@functools.cache
def _take_warnings() -> None:
    """Write a few of MuJoCo's warnings to stderr and none to a file, unless somebody has them.

    Done once per process. MuJoCo itself writes all of them, also to MUJOCO_LOG.TXT in the working
    folder; `mujoco.set_mju_user_warning(None)` brings that back at any time.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(library().warning)


@contextlib.contextmanager
def warnings_in(path: Path) -> Generator[None]:
    """Add MuJoCo's warnings to a file, which has at most MAX_WARNINGS lines, and not to stderr.

    It is made with the first one. A handler of somebody else's keeps its warnings.
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

    Every model that `quadrl.engines.mjcf` makes needs them; it calls this itself. A process that
    receives such a model from elsewhere (a spawned worker) calls it once.

    Args:
        replace: Replace callbacks that other code installed, with a warning.

    Raises:
        NativeError: Somebody else's callback is installed and `replace` is False.
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
    """Raise unless the rotor callbacks are in place.

    Raises:
        NativeError: One of them was removed or replaced: the physics would be wrong.
    """
    ours = library()
    if (
        mujoco.get_mjcb_act_dyn() is ours.act_dyn
        and mujoco.get_mjcb_act_gain() is ours.act_gain
        and mujoco.get_mjcb_passive() is ours.passive
    ):
        return
    missing = [name for name in CALLBACKS if _current(name) != getattr(ours, name)]
    if missing:
        raise NativeError(
            f"the rotor callback {_names(missing)} was removed or replaced by other code, and "
            "the physics would be wrong; call quadrl.engines.native.install() again"
        )


def _current(name: str) -> object:
    return getattr(mujoco, f"get_mjcb_{name}")()


def _names(callbacks: list[str]) -> str:
    return ", ".join(f"mjcb_{name}" for name in callbacks)
