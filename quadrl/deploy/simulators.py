"""Simulators that others wrote, each in an environment of its own."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.files import lock
from quadrl.base.validation import choice
from quadrl.engines.native.compiling import cache_folder

SIMULATORS = {"rotorpy": "rotorpy>=3,<4", "crazyflow": "crazyflow>=0.4"}
"""What pip installs for each."""
DRIVER = Path(__file__).with_name("driver.py")
INSTALLED = "quadrl-installed"
"""A file in an environment that is whole."""


def there(name: str) -> bool:
    """Whether a simulator is installed."""
    return (_folder(name) / INSTALLED).exists()


def environment_of(name: str, said: Callable[[str], None] = lambda text: None) -> Path:
    """The Python in which a simulator is installed; it is made at the first use.

    Args:
        name: One of SIMULATORS.
        said: Told what is about to be installed.

    Raises:
        QuadrlError: It is not there and may not be installed, or cannot be.
    """
    wanted = SIMULATORS[choice("simulator", name, SIMULATORS)]
    folder = _folder(name)
    python = folder / "bin" / "python"
    pip = python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", wanted
    install(name, wanted, ((sys.executable, "-m", "venv", folder), pip), said)
    return python


def install(
    name: str, wanted: str, lines: Iterable[Sequence[str | Path]], said: Callable[[str], None]
) -> Path:
    """The folder of a simulator, in which command lines install it at the first use.

    Raises:
        QuadrlError: It is not there and may not be installed, or a line fails.
    """
    folder = _folder(name)
    if there(name):
        return folder
    if os.environ.get("QUADRL_INSTALL") == "no":
        where = f"{wanted} is not in {folder}, and QUADRL_INSTALL=no"
        raise QuadrlError(f"{where}: run again without it, or without {name}")
    folder.mkdir(parents=True, exist_ok=True)
    try:
        descriptor = lock(folder)
    except BlockingIOError:
        raise QuadrlError(f"another process is installing {name}: run again after it") from None
    try:
        said(f"installing {wanted} in {folder} (QUADRL_INSTALL=no prevents it)")
        for line in lines:
            done = subprocess.run(line, capture_output=True, text=True, cwd=folder)
            if done.returncode:
                last = (done.stderr.strip() or done.stdout.strip() or "?").splitlines()[-1]
                raise QuadrlError(f"{name} cannot be installed: {last}; run again without it")
        (folder / INSTALLED).touch()
    finally:
        os.close(descriptor)
    return folder


def _folder(name: str) -> Path:
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    return cache_folder().absolute() / "simulators" / f"{name}-{version}"


class Simulator:
    """A simulator that runs beside this process, with one kind of aircraft."""

    def __init__(self, name: str, python: Path, given: Mapping[str, Any]) -> None:
        """Start it.

        Args:
            name: One of SIMULATORS.
            python: As `environment_of` gives it.
            given: The aircraft, as the classes of `driver.py` take it.

        Raises:
            QuadrlError: It does not start.
        """
        self.name, self._errors = name, tempfile.TemporaryFile()
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": self._errors}
        pipes["cwd"] = python.parent.parent  # where MuJoCo writes its log
        self._process = subprocess.Popen([str(python), "-I", str(DRIVER), name], **pipes)
        self._to: Any = self._process.stdin
        self._come: Any = self._process.stdout
        try:
            self._send(json.dumps(given).encode())
            found = json.loads(self._come.readline() or self._died())
        except BaseException:
            self.close()
            raise
        self.version: str = found["version"]
        self.hover_speed: float = found["hover"]
        """Rotor speed that carries its aircraft [rad/s], the mean of its rotors."""

    def advance(self, motion: np.ndarray, command: np.ndarray, seconds: float) -> np.ndarray:
        """Fly aircraft for a while.

        Args:
            motion: (n, 17) qpos, qvel and rotor speeds, as in `Engine`.
            command: (n, 4) rotor speeds [rad/s]; NaN where a row is not to be flown.
            seconds: For how long.

        Returns:
            Their motion (n, 17) then.

        Raises:
            QuadrlError: It has died.
        """
        arrays = (np.ascontiguousarray(x, dtype=float).tobytes() for x in (motion, command))
        self._send(json.dumps([len(motion), seconds]).encode(), *arrays)
        return np.frombuffer(self._come.read(8 * motion.size) or self._died()).reshape(motion.shape)

    def close(self) -> None:
        """Stop it."""
        for pipe in (self._to, self._come, self._errors):
            with contextlib.suppress(OSError):
                pipe.close()
        self._process.wait()

    def _send(self, line: bytes, *arrays: bytes) -> None:
        try:
            self._to.write(b"".join((line, b"\n", *arrays)))
            self._to.flush()
        except BrokenPipeError:
            self._died()

    def _died(self) -> Any:
        self._process.wait()
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        raise QuadrlError(f"{self.name} has stopped: {lines[-1] if lines else 'without a word'}")
