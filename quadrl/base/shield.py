"""The graphics library: `import quadrl` prevents crashes beside triton, and waits after a fork."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

from quadrl.base.errors import RenderingUnavailable

_drew: int | None = None
"""The process that has drawn: this one, or one that it was forked from."""


@functools.cache
def shield_triton() -> None:
    """Load triton's library, if it is installed, so that it works beside Mesa's in one process.

    Each brings its own LLVM. Mesa's is visible to every library that is loaded after it, and
    triton's would call into it and crash. Opened with RTLD_DEEPBIND it uses its own symbols, and
    `import triton` then finds it loaded. This takes 0.05 s and must come before `import triton`;
    pictures may be drawn before or after.
    """
    if "triton" in sys.modules or not hasattr(os, "RTLD_DEEPBIND"):
        return
    found = importlib.util.find_spec("triton")
    for folder in (found and found.submodule_search_locations) or ():
        for library in Path(folder, "_C").glob("libtriton*.so"):
            with contextlib.suppress(OSError):
                ctypes.CDLL(str(library), mode=os.RTLD_LOCAL | os.RTLD_NOW | os.RTLD_DEEPBIND)


def refuse_after_fork() -> None:
    """Note that this process draws.

    Raises:
        RenderingUnavailable: It was forked from one that had drawn. The threads of the graphics
            library are not in it, and a picture would never come.
    """
    global _drew
    _drew = _drew or os.getpid()
    if _drew != os.getpid():
        raise RenderingUnavailable(
            "this process was forked from one that had drawn, and cannot draw: start it by spawn "
            "or forkserver, as in gymnasium's AsyncVectorEnv(..., context='spawn')"
        )


def _before_fork() -> None:
    """Note that other code has drawn: its context is current, or Mesa's threads are there."""
    global _drew
    egl: Any = sys.modules.get("OpenGL.EGL")
    if egl and not _drew:
        threads = Path("/proc/self/task").glob("*/comm")
        with contextlib.suppress(OSError):  # of a thread that ends just now
            if egl.eglGetCurrentContext() or any(b"llvmpipe" in f.read_bytes() for f in threads):
                _drew = os.getpid()


os.register_at_fork(before=_before_fork)
