"""Trainings on the nodes of a Ray cluster, in a folder that all machines share."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import socket
from collections.abc import Generator
from pathlib import Path
from typing import Any

from quadrl.base.errors import QuadrlError
from quadrl.base.files import write_whole
from quadrl.base.machine import cores
from quadrl.learning.executor import End, Local, Process, order
from quadrl.learning.plan import PlannedRun

REACH_SECONDS = 5.0
STORE_BYTES = 100 << 20  # of Ray's store on this machine, in which nothing is kept
QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is sent anywhere
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_DISABLE_DOCKER_CPU_WARNING": "1",
}


def carry_out_here(what: dict[str, Any], log: Path) -> End:
    """On a node: carry out a training in a process, which dies with this one."""
    if not Path(what["folder"]).is_dir():
        allowed = "a folder that all machines share (--out)"
        return End(f"{socket.gethostname()} has no {what['folder']}: the study needs {allowed}")
    return Process(what, log).wait()


class Task:
    """A training on some node, as a task of Ray."""

    def __init__(self, task: Any, log: Path) -> None:
        """Follow a task, which writes the log as soon as it runs."""
        self._task, self._log = task, log

    def poll(self) -> End | None:
        """How it ended; None while it works or waits for a node."""
        import ray
        import ray.exceptions

        if not ray.wait([self._task], timeout=0)[0]:
            return None
        try:
            return ray.get(self._task)
        except ray.exceptions.RayError as error:
            reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
            ran = self._log.name in os.listdir(self._log.parent)
            return End(f"its node or its process there was lost ({reason})", lost=True, ran=ran)

    def stop(self) -> None:
        """Kill the task: its process ends with it."""
        import ray

        ray.cancel(self._task, force=True)


@dataclasses.dataclass(frozen=True)
class Nodes(Local):
    """The nodes of a cluster. They see the folders of the runs under the same paths."""

    def slots(self) -> int:
        """How many at the same time: one per CPU of the cluster as it is now."""
        import ray

        return self.jobs or max(1, int(ray.cluster_resources().get("CPU", 1)))

    def begin(self, run: PlannedRun, log: Path) -> Task:
        """Begin a training, or continue it, on a node with a CPU to spare."""
        import ray

        own = run.folder.absolute().parent / "own"
        for folder in (run.folder, log.parent, *([own] if self.own else [])):
            folder.mkdir(parents=True, exist_ok=True)
        for path in self.own:
            write_whole(own / path.name, path.read_bytes())
        log.unlink(missing_ok=True)
        what = order(run, self.episodes, [own / path.name for path in self.own])
        gpus = 1 if run.config.device.startswith("cuda") else 0
        # Ray does not begin a task again: that it was lost is counted, and said.
        remote: Any = ray.remote(max_retries=0, num_cpus=1, num_gpus=gpus)(carry_out_here)
        return Task(remote.remote(what, log.absolute()), log)


@contextlib.contextmanager
def on_ray(
    address: str, episodes: int, jobs: int | None, own: tuple[Path, ...]
) -> Generator[Nodes]:
    """The nodes of the cluster at an address.

    Args:
        address: HOST:PORT; "auto" for the cluster that this machine belongs to; "local" for a
            cluster of this machine alone that ends with the study.
        episodes: Of the evaluation of each training.
        jobs: Trainings at the same time; None for one per CPU of the cluster.
        own: Files that register what the trainings need; copies are put beside the runs.

    Raises:
        QuadrlError: Ray is not installed, or there is no cluster at the address.
    """
    os.environ.update({name: os.environ.get(name, value) for name, value in QUIET.items()})
    try:
        import ray
    except ImportError as error:
        raise QuadrlError(
            "Ray is not installed: python -m pip install 'quadrl[ray]' installs it"
        ) from error
    mine = not ray.is_initialized()
    if mine:
        _connect(ray, address, jobs)
    try:
        yield Nodes(episodes, jobs, own)
    finally:
        if mine:
            ray.shutdown()


def _connect(ray: Any, address: str, jobs: int | None) -> None:
    """Join a cluster, or begin one on this machine."""
    given: dict[str, Any] = {"address": address}
    nobody = (
        f"there is no Ray cluster at {address}: start one with ray start --head, join machines to "
        "it with ray start --address, and give the address that it prints"
    )
    if address == "local":
        given |= {"num_cpus": jobs or cores(), "object_store_memory": STORE_BYTES}
        given |= {"include_dashboard": False}
    elif address != "auto":
        host, colon, port = address.rpartition(":")
        if not colon or not host or "/" in host or not port.isdecimal():
            allowed = "HOST:PORT such as 10.0.0.1:6379, auto, or local"
            raise QuadrlError(name="ray", value=address, allowed=allowed)
        try:
            socket.create_connection((host, int(port)), REACH_SECONDS).close()
        except (OSError, OverflowError) as error:
            raise QuadrlError(nobody) from error
    try:
        ray.init(**given, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        raise QuadrlError(f"{nobody} ({str(error).splitlines()[0]})") from error
