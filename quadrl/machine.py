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
    cpu = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
        cpu = next(named, cpu)
    known = {"cpu": cpu, "cores": cores(), "system": f"{platform.system()} {platform.machine()}"}
    return known | {"python": platform.python_version()} | versions


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
