"""What a measurement was made on."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import platform
from pathlib import Path


def machine() -> dict[str, str | int]:
    """What the figures were measured on."""
    versions = {}
    for name in ("mujoco", "gymnasium", "dm-control", "torch", "torchrl"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    system = f"{platform.system()} {platform.machine()}"
    known = {"cpu": processor(), "cores": cores(), "system": system}
    return known | {"python": platform.python_version()} | versions


def _cpuinfo() -> dict[str, str]:
    """What Linux says of the first core; empty elsewhere."""
    try:
        lines = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
    except OSError:
        return {}
    pairs = (line.partition(":") for line in lines)
    return {name.strip(): value.strip() for name, _, value in pairs}


def processor() -> str:
    """The name of the processor."""
    return _cpuinfo().get("model name") or platform.processor() or platform.machine()


def processor_kind() -> str:
    """What torch chooses its instructions by, and with them the last bits of its numbers."""
    known = _cpuinfo()
    numbers = (f"{name} {known[name]}" for name in ("cpu family", "model") if name in known)
    return ", ".join((processor(), *numbers))


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
