"""Compile C at its first use, and keep the libraries in a cache.

C is compiled with the machine's own compiler against the headers of the installed mujoco, because
it reads the structs of exactly that version. A library is kept in a cache folder (`$QUADRL_CACHE`,
else the user's cache folder), one for each version of mujoco, of the sources and of the flags;
`$QUADRL_CFLAGS` adds flags at the end of these (`scripts/sanitize` does). Its name ends with a
digest of its bytes, so that one that was damaged is known before it is loaded, and built anew.
A wheel for one kind of machine brings libraries of the same names, which come first: they need no
compiler (`quadrl.deploy.wheels` makes them).
`layout.h`, which declares a row of parameters and the rows of the state and of the weather, is
written into the build from `quadrl.aircraft.parameters`, `quadrl.engines.state` and
`quadrl.engines.air`.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import dataclasses
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path

import mujoco

from quadrl.aircraft.parameters import c_structs
from quadrl.base.errors import NativeError
from quadrl.base.files import lock, put
from quadrl.engines.air import c_weather
from quadrl.engines.state import c_rows

SOURCES = ("callbacks.c", "free_flight.c", "state.c", "random.c", "weather.c",
           "disturbances.c", "solids.c", "warnings.c")  # fmt: skip
HEADERS = ("aero.h", "contacts.h", "export.h", "philox.h", "runge_kutta.h", "solids.h")
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

_FOLDER = Path(__file__).parent
PREBUILT = _FOLDER / "prebuilt"
"""Libraries that a wheel for this kind of machine brings; there is no such folder without one."""
_SCRATCH = "quadrl-build-"
_ALONE: dict[Path, contextlib.ExitStack] = {}
"""Libraries of this process alone that are not loaded yet, and what removes each."""
_NOTED: list[list[str]] = []
"""Of each `noted` that is entered, the sources."""


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
    prebuilt = sorted({path.name.split("-")[2] for path in PREBUILT.glob("quadrl-mujoco-*.so")})
    other = prebuilt and mujoco.__version__ not in prebuilt
    raise NativeError(
        "no C compiler found (looked for $CC, cc, gcc, clang); install one: "
        "`apt-get install build-essential` on Debian or Ubuntu, `dnf install gcc` on Fedora, "
        "`xcode-select --install` on macOS"
        + (f"; with mujoco {' or '.join(prebuilt)} none would be needed" if other else "")
    )


@dataclasses.dataclass(frozen=True)
class Target:
    """What libraries are compiled for."""

    machine: str = platform.machine()
    """The kind of machine, as `platform.machine` names it there."""
    compiler: str = ""
    """The command that compiles for it; empty for what `compiler` finds."""
    folder: Path | None = None
    """Where the libraries go, and nowhere else; None for the cache."""


HERE = Target()


def build(
    sources: Sequence[str] = SOURCES,
    name: str = "mujoco",
    generated: Mapping[str, str] | None = None,
    include: Path | None = None,
    target: Target = HERE,
) -> Path:
    """Compile a library unless it is prebuilt or the cache holds it.

    Args:
        sources: Files beside this one.
        name: Name of the library, with the version of mujoco behind it.
        generated: Headers that they include besides, by name.
        include: Folder with mujoco's headers; None for those of the installed package.
        target: What it is compiled for.

    Returns:
        The path of the shared library.

    Raises:
        NativeError: There is no compiler, or it refused the sources.
    """
    include = include or Path(mujoco.__file__).parent / "include"
    digest = hashlib.sha256(" ".join((*flags(), target.machine)).encode())
    written = {"layout.h": c_structs() + c_rows() + c_weather()} | dict(generated or {})
    digest.update("".join(written.values()).encode())
    for file in (*HEADERS, *sources):
        digest.update((_FOLDER / file).read_bytes())
    digest.update((include / "mujoco" / "mujoco.h").read_bytes())
    whole = f"quadrl-{name}-{mujoco.__version__}-{digest.hexdigest()[:16]}"
    paths = [str(_FOLDER / source) for source in sources]
    return _cached(whole, [f"-I{include}", *paths], written, target)


def build_generated(source: str, target: Target = HERE) -> Path:
    """Compile a library of C that was generated, unless it is prebuilt or the cache holds it.

    Args:
        source: The C.
        target: What it is compiled for.

    Returns:
        Its path.

    Raises:
        NativeError: There is no compiler, or it refused the source.
    """
    digest = hashlib.sha256(" ".join((*flags(), target.machine, source)).encode())
    name = digest.hexdigest()[:16]
    return _cached(f"quadrl-generated-{name}", [], {f"{name}.c": source}, target)


def compile_generated(source: str) -> ctypes.CDLL:
    """Open the library of C that was generated, as `build_generated` makes it, once."""
    if _NOTED:
        _NOTED[-1].append(source)
        raise NativeError("the source is noted, not compiled")
    return opened_generated(source)


@functools.cache
def opened_generated(source: str) -> ctypes.CDLL:
    """The library that `compile_generated` opens."""
    return open_library(build_generated(source))


@contextlib.contextmanager
def noted() -> Generator[list[str]]:
    """Note what `compile_generated` is asked for, and compile nothing."""
    _NOTED.append([])
    try:
        yield _NOTED[-1]
    finally:
        _NOTED.pop()


def _cached(name: str, arguments: list[str], written: dict[str, str], target: Target) -> Path:
    """A library, prebuilt or of the cache, compiled first where there is no sound one.

    Args:
        name: Name of its file, without digest and ending; another one for other contents.
        arguments: Further ones of the compiler.
        written: Files that are written first, by name: headers, and sources to compile.
        target: What it is compiled for.
    """
    folder = target.folder or cache_folder()
    for place in [folder] if target.folder else [PREBUILT, folder]:
        with contextlib.suppress(OSError):  # a folder that may not be looked into
            for path in place.glob(f"{name}-*.so"):
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
        command = [target.compiler or compiler(), *flags(), f"-I{scratch}"]
        command += ["-o", f"{scratch}/built.so", *arguments, *sources, "-lm"]
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
