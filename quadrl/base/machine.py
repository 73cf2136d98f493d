"""The machine: processor, cores, versions of packages, and free memory."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import math
import os
import platform
import resource
from collections.abc import Mapping
from pathlib import Path

from quadrl.base.errors import QuadrlError
from quadrl.base.version import __version__

GIB = 1 << 30
CGROUP = Path("/sys/fs/cgroup")
WORTH_ASKING = 1 << 26  # [bytes]: smaller allocations are not checked, since that takes time


def machine() -> dict[str, str | int]:
    """Describe the machine: processor, cores, system, and versions of packages."""
    versions: dict[str, str | int] = {}
    for name in ("mujoco", "gymnasium", "dm-control", "torch", "torchrl"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    system = f"{platform.system()} {platform.machine()}"
    known = {"cpu": processor(), "cores": cores(), "system": system}
    return known | {"python": platform.python_version()} | versions


@functools.cache
def deciding_versions() -> dict[str, str]:
    """Versions of quadrl and of the packages that decide results; cached, since files have them."""
    packages = ("mujoco", "torch", "torchrl", "numpy")
    return {"quadrl": __version__} | {name: importlib.metadata.version(name) for name in packages}


def in_a_line(known: Mapping[str, str | int]) -> str:
    """The description that `machine` returns, as a line of text."""
    rest = dict(known)
    cpu, count, system = (rest.pop(name) for name in ("cpu", "cores", "system"))
    versions = ", ".join(f"{name} {version}" for name, version in rest.items())
    return f"{cpu}, {count} core{'s' if count != 1 else ''}, {system}, {versions}"


def _cpuinfo() -> dict[str, str]:
    """The entries of /proc/cpuinfo for the first core; empty where there is no such file."""
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
    """The kind of processor, by which torch chooses its instructions and so the last bits."""
    known = _cpuinfo()
    numbers = (f"{name} {known[name]}" for name in ("cpu family", "model") if name in known)
    return ", ".join((processor(), *numbers))


def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def free_memory() -> float:
    """Memory that this process may still allocate [bytes]; infinite where it is unknown.

    The least of three: what Linux reports as available, the rest of the limit of the process's
    control group (a container's), and the rest of its own limit (`ulimit -v`).
    """
    left = [math.inf]
    with contextlib.suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        left.append(1024 * next(int(x.split()[1]) for x in lines if x.startswith("MemAvailable")))
    with contextlib.suppress(OSError, ValueError):
        most, used = (int((CGROUP / f"memory.{name}").read_text()) for name in ("max", "current"))
        stat = dict(line.split() for line in (CGROUP / "memory.stat").read_text().splitlines())
        left.append(most - used + int(stat.get("inactive_file", 0)))  # files give way
    with contextlib.suppress(OSError, ValueError):
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            taken = int(Path("/proc/self/statm").read_text().split()[0])
            left.append(limit - taken * resource.getpagesize())
    return max(0.0, min(left))


def check_memory(what: str, size: float) -> None:
    """Refuse an allocation that is larger than the free memory, before it is made.

    Args:
        what: What is to be allocated, in words.
        size: Memory that it takes at least [bytes].

    Raises:
        QuadrlError: There is less; the message has both numbers.
    """
    if size > WORTH_ASKING and size > (free := free_memory()):
        reason = f"{what} would take {size / GIB:.1f} GiB of memory, and {free / GIB:.1f} are free"
        raise QuadrlError(f"{reason}: ask for fewer")
