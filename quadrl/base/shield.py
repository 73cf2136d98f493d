"""Triton and Mesa in one process: `import quadrl` prevents that they crash."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.util
import os
import sys
from pathlib import Path


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
