"""Compile the text of a control step and run it: by NVRTC on a GPU, by the C compiler on a CPU."""

# pyright: standard
# cuda.core has no types, and is there only with the extra gpu.
from __future__ import annotations

import ctypes
import functools
import importlib
import io
import re
from collections.abc import Callable
from typing import Any

import torch

from quadrl.base.errors import QuadrlError
from quadrl.base.extras import needed
from quadrl.core.source import Precision
from quadrl.engines.native.compiling import compile_generated

KERNELS = ("step", "start")
THREADS = 128
"""Aircraft of a block of threads."""
OLDEST = (7, 5)
"""The oldest compute capability that NVRTC 13 compiles for."""
Run = Callable[..., None]


def make_device(name: str | torch.device) -> torch.device:
    """Find the device of a name.

    Raises:
        QuadrlError: This torch, or this machine, does not have it.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).cpu()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).strip().partition("\n")[0].partition("Expected one of")[0]
        allowed = "a device that this torch can use, such as cpu, or cuda for a GPU of NVIDIA"
        raise QuadrlError(reason, name="device", value=str(name), allowed=allowed) from error
    return device


def kernels(text: str, precision: Precision, device: torch.device) -> dict[str, Run]:
    """The functions of a text, by name, each called with N and numbers or addresses.

    Raises:
        QuadrlError: There is no such device, or it is too old.
        NativeError: There is no C compiler for a CPU.
    """
    if device.type == "cpu":
        library = compile_generated(text)
        found = {name: getattr(library, name) for name in KERNELS}
        for function in found.values():
            function.argtypes, function.restype = None, None
        return {name: functools.partial(_on_cpu, function) for name, function in found.items()}
    chip = torch.cuda.get_device_capability(device)
    if chip < OLDEST:
        said = ".".join(map(str, OLDEST))
        allowed = f"a GPU of compute capability {said} or newer, not {chip[0]}.{chip[1]}; or cpu"
        raise QuadrlError(name="device", value=str(device), allowed=allowed)
    cuda = _cuda()

    cuda.Device(device.index or 0).set_current()
    code, _ = cubin(text, precision, f"sm_{chip[0]}{chip[1]}")

    def bound(name: str) -> Run:
        kernel = code.get_kernel(name)

        def run(count: int, *given: int) -> None:
            config = cuda.LaunchConfig(grid=-(-count // THREADS), block=THREADS)
            cuda.launch(_Present(device), config, kernel, given[0], count, *given[1:])

        return run

    return {name: bound(name) for name in KERNELS}


def _cuda() -> Any:
    """The library that compiles for GPUs and calls what it compiled.

    Raises:
        MissingLibrary: The extra gpu is not installed.
    """
    with needed("device='cuda'"):
        return importlib.import_module("cuda.core")


def _on_cpu(function: Any, count: int, *given: int) -> None:
    first, *rest = map(ctypes.c_void_p, given)
    function(first, ctypes.c_int64(count), *rest)


class _Present:
    """torch's present stream, as cuda.core takes streams of other libraries."""

    def __init__(self, device: torch.device) -> None:
        self._device = device

    def __cuda_stream__(self) -> tuple[int, int]:
        return 0, torch.cuda.current_stream(self._device).cuda_stream


@functools.lru_cache(maxsize=64)
def cubin(text: str, precision: Precision, arch: str) -> tuple[Any, dict[str, dict[str, int]]]:
    """The machine code of a text, and registers and spilled bytes of each kernel; needs no GPU.

    In double precision it rounds as a processor does.

    Raises:
        MissingLibrary: The extra gpu is not installed.
    """
    cuda = _cuda()
    text = text.replace("#pragma GCC unroll", "#pragma unroll")
    text = re.sub(r'_Pragma\("GCC unroll \d+"\)', "", text)
    fast = {"ftz": True, "prec_div": False, "prec_sqrt": False, "fma": True}
    own: Any = fast if precision == "float32" else {"fma": False}
    own |= {"device_as_default_execution_space": True, "ptxas_options": ["-v"]}
    log = io.StringIO()
    code = cuda.Program(text, "c++", cuda.ProgramOptions(arch=arch, **own)).compile(
        "cubin", logs=log
    )
    used: dict[str, dict[str, int]] = {}
    number = r".*?(\d+) bytes stack frame, (\d+) bytes spill.*?Used (\d+) registers"
    for name, *found in re.findall(rf"entry function '(\w+)'{number}", log.getvalue(), re.S):
        used[name] = dict(zip(("stack", "spilled", "registers"), map(int, found), strict=True))
    return code, used
