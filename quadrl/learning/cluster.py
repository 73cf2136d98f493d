"""Trainings on the nodes of a Ray cluster, in a folder that all machines share.

When a node is lost, Ray starts its training again on another one, where it goes on from its last
checkpoint.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import socket
from collections.abc import Generator
from pathlib import Path
from typing import Any, NamedTuple

from quadrl.base.errors import QuadrlError
from quadrl.base.extras import needed
from quadrl.base.machine import cores
from quadrl.learning.executor import End, Local, PlannedRun, Process, order

REACH_SECONDS = 5.0
QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is sent anywhere
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_DISABLE_DOCKER_CPU_WARNING": "1",
}


def carry_out_here(what: dict[str, Any], log: Path) -> End:
    """Carry out a training on this node, in a process that dies with this one."""
    for path in (what["folder"], *what["own"]):
        if not Path(path).exists():
            shared = "a folder that all machines share (--out), and files there (--import)"
            return End(f"{socket.gethostname()} has no {path}: the study needs {shared}")
    return Process(what, log).wait()


class Task(NamedTuple):
    """A training on a node, as a task of Ray."""

    ray: Any
    task: Any

    def poll(self) -> End | None:
        """Return how it ended; None while it works or waits for a node."""
        if not self.ray.wait([self.task], timeout=0)[0]:
            return None
        try:
            return self.ray.get(self.task)
        except self.ray.exceptions.RayError as error:
            reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
            return End(f"its node or its process there was lost ({reason})", lost=True)

    def ask(self) -> None:
        """Kill the task: its process ends with it."""
        self.ray.cancel(self.task, force=True)

    stop = ask


@dataclasses.dataclass(frozen=True)
class Nodes(Local):
    """The nodes of a cluster, which share the folders of the runs under the same paths."""

    ray: Any = None

    def slots(self) -> int:
        """Number of trainings at a time: one per CPU that the cluster has now."""
        return self.jobs or max(1, int(self.ray.cluster_resources().get("CPU", 1)))

    def begin(self, run: PlannedRun) -> Task:
        """Begin a training, or continue it, on a node with a free CPU."""
        for folder in (run.folder, run.log.parent):
            folder.mkdir(parents=True, exist_ok=True)
        needs = {"num_cpus": 1, "num_gpus": int(run.config.device.startswith("cuda"))}
        remote = self.ray.remote(max_retries=-1, **needs)(carry_out_here)
        what, log = order(run, self.own), run.log.absolute()
        return Task(self.ray, remote.remote(what, log))


@contextlib.contextmanager
def on_ray(address: str, local: Local) -> Generator[Nodes]:
    """Give the nodes of the cluster at an address.

    Args:
        address: HOST:PORT; "auto" for the cluster that this machine belongs to; "local" for a
            cluster of this machine alone that ends with the study.
        local: The processes that one machine alone would use, whose settings the nodes take.

    Raises:
        QuadrlError: Ray is not installed, or there is no cluster at the address.
    """
    os.environ.update(QUIET | os.environ)
    with needed("quadrl.study"):
        import ray
    mine = not ray.is_initialized()
    if mine:
        _connect(ray, address, local.jobs)
    try:
        yield Nodes(local.jobs, local.own, ray)
    finally:
        if mine:
            ray.shutdown()


def _connect(ray: Any, address: str, jobs: int | None) -> None:
    """Join a cluster, or begin one on this machine."""
    given: dict[str, Any] = {"address": address}
    if address == "local":
        given |= {"num_cpus": jobs or cores(), "include_dashboard": False}
    host, _, port = address.rpartition(":")
    if address not in ("local", "auto"):
        if not host or "/" in host or not port.isdecimal():
            allowed = "HOST:PORT such as 10.0.0.1:6379, auto, or local"
            raise QuadrlError(name="ray", value=address, allowed=allowed)
    try:
        if host:  # Ray itself would wait for minutes
            socket.create_connection((host, int(port)), REACH_SECONDS).close()
        ray.init(**given, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, OSError, OverflowError, RuntimeError, ValueError) as error:
        raise QuadrlError(
            f"there is no Ray cluster at {address}: start one with ray start --head, join machines "
            "to it with ray start --address, and give the address that it prints "
            f"({str(error).splitlines()[0]})"
        ) from error
