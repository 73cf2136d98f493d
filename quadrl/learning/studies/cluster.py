"""Trainings on a Ray cluster: the same processes, started by Ray's actors, and their files.

What a training writes comes to the driver's disk with each checkpoint. A node that dies with its
disk costs the time since then: the training begins elsewhere from what the driver holds.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import socket
import tempfile
import time
import weakref
from collections.abc import Generator
from pathlib import Path
from typing import Any

from quadrl.base.errors import QuadrlError
from quadrl.base.files import PART, write_whole
from quadrl.base.machine import cores
from quadrl.learning.folder import CONFIG, EVALUATION, LOCK, METRICS, lock_folder
from quadrl.learning.studies import worker
from quadrl.learning.studies.crew import End, ended
from quadrl.learning.studies.plan import PlannedRun

CHECKPOINT = "checkpoint.safetensors"
REACH_SECONDS = 5.0
WAIT_SECONDS = 0.5  # that a node waits for something new before it says that there is nothing
STORE_BYTES = 100 << 20  # of Ray's store on this machine: a run folder is some 100 kB
QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is sent anywhere
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_DISABLE_DOCKER_CPU_WARNING": "1",
}
Files = dict[str, bytes]
"""Contents by path in the run folder, in the order in which they are to be written."""


class Remote:
    """On a node: a training in a process and a folder of its own. Ray makes it an actor."""

    def __init__(self, what: dict[str, Any], files: Files, own: dict[str, bytes]) -> None:
        """Write the folder as the driver has it, and start the process."""
        base = Path(tempfile.mkdtemp(prefix="quadrl-study-"))
        self._folder, self._log = base / "run", base / "log.txt"
        self._folder.mkdir()
        write_files(self._folder, files)
        write_files(base / "own", own)
        paths = [str(base / "own" / name) for name in own]
        self._seen = _stamps(self._folder)
        here = {"folder": str(self._folder), "own": paths, "scratch": str(base)}
        self._process = worker.start(what | here, self._log)

    def news(self) -> tuple[Files, int | None, str]:
        """What has changed since the last call: files, exit code, the log once it has ended.

        While the process works, there are files only with a new checkpoint.
        """
        until = time.monotonic() + WAIT_SECONDS
        while (code := self._process.poll()) is None and time.monotonic() < until:
            if _stamps(self._folder).get(CHECKPOINT) != self._seen.get(CHECKPOINT):
                break
            time.sleep(0.02)
        now = _stamps(self._folder)
        if code is None and now.get(CHECKPOINT) == self._seen.get(CHECKPOINT):
            return {}, None, ""
        changed = [name for name in now if now[name] != self._seen.get(name)]
        self._seen = now
        text = "" if code is None else self._log.read_text(errors="replace")
        files = read_files(self._folder, changed)
        if code is not None:
            shutil.rmtree(self._folder.parent, ignore_errors=True)
        return files, code, text


class RayWorker:
    """A training on some node, and its copy in the driver's folder."""

    def __init__(self, actor: Any, run: PlannedRun, log: Path) -> None:
        """Follow an actor; the folder is locked until it ends."""
        self._actor, self._run, self._log = actor, run, log
        self._ran = False
        run.folder.mkdir(parents=True, exist_ok=True)
        self._unlock = weakref.finalize(self, lock_folder(run.folder))
        self._news = actor.news.remote()

    def poll(self) -> End | None:
        """How it ended; None while it works."""
        import ray
        import ray.exceptions

        ready, _ = ray.wait([self._news], timeout=0)
        if not ready:
            return None
        try:
            files, code, text = ray.get(self._news)
        except ray.exceptions.RayError as error:
            self.stop()
            reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
            ran = self._ran or getattr(error, "actor_init_failed", False)
            return End(f"its node or its process there was lost ({reason})", lost=True, ran=ran)
        self._ran = True
        write_files(self._run.folder, files)
        if code is None:
            self._news = self._actor.news.remote()
            return None
        self._log.parent.mkdir(parents=True, exist_ok=True)
        self._log.write_text(text)
        self.stop()
        return ended(code, worker.last_line(self._log))

    def stop(self) -> None:
        """Kill the actor: its process ends with it."""
        import ray

        ray.kill(self._actor)
        self._unlock()


class RayCrew:
    """The nodes of a cluster."""

    def __init__(self, episodes: int, jobs: int | None, own: tuple[Path, ...]) -> None:
        """Remember what all trainings share."""
        import ray

        self._episodes, self._jobs = episodes, jobs
        self._own = {path.name: path.read_bytes() for path in own}
        # An actor is never restarted by Ray: it would not have the newest checkpoint.
        self._remote: Any = ray.remote(max_restarts=0)(Remote)

    def slots(self) -> int:
        """How many at the same time: one per CPU of the cluster as it is now."""
        import ray

        return self._jobs or max(1, int(ray.cluster_resources().get("CPU", 1)))

    def begin(self, run: PlannedRun, log: Path) -> RayWorker:
        """Begin a training, or continue it, on a node with a CPU to spare."""
        files = read_files(run.folder, list(_stamps(run.folder)))
        gpus = 1 if run.config.device.startswith("cuda") else 0
        remote = self._remote.options(num_cpus=1, num_gpus=gpus)
        return RayWorker(
            remote.remote(worker.order(run, self._episodes), files, self._own), run, log
        )


@contextlib.contextmanager
def on_ray(
    address: str, episodes: int, jobs: int | None, own: tuple[Path, ...]
) -> Generator[RayCrew]:
    """The nodes of the cluster at an address.

    Args:
        address: HOST:PORT; "auto" for the cluster that this machine belongs to; "local" for a
            cluster of this machine alone that ends with the study.
        episodes: Of the evaluation of each training.
        jobs: Trainings at the same time; None for one per CPU of the cluster.
        own: Files that register what the trainings need; the nodes get copies.

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
        yield RayCrew(episodes, jobs, own)
    finally:
        if mine:
            ray.shutdown()


def _connect(ray: Any, address: str, jobs: int | None) -> None:
    """Join a cluster, or begin one on this machine."""
    given: dict[str, Any] = {"address": address}
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
            raise QuadrlError(_nobody(address)) from error
    try:
        ray.init(**given, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        raise QuadrlError(f"{_nobody(address)} ({str(error).splitlines()[0]})") from error


def _nobody(address: str) -> str:
    return (
        f"there is no Ray cluster at {address}: start one with ray start --head, join machines to "
        "it with ray start --address, and give the address that it prints"
    )


def read_files(folder: Path, names: list[str]) -> Files:
    """Contents of files, the checkpoint first: what is read later is at least as new."""
    found: Files = {}
    for name in sorted(names, key=lambda name: name != CHECKPOINT):
        with contextlib.suppress(FileNotFoundError):  # replaced while it was listed
            found[name] = (folder / name).read_bytes()
    return found


def write_files(folder: Path, files: Files) -> None:
    """Write files, each whole or not at all: settings and log first, the result last.

    Whatever is missing after a kill in between, the training continues from what there is.
    """
    ranks = {CONFIG: 0, METRICS: 1, CHECKPOINT: 3, EVALUATION: 4}
    for name in sorted(files, key=lambda name: ranks.get(name, 2)):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, files[name])


def _stamps(folder: Path) -> dict[str, tuple[int, int]]:
    """Time of change [ns] and size of the files of a folder."""
    found = {}
    for path in sorted(folder.rglob("*")) if folder.exists() else ():
        if path.suffix == PART or path.name == LOCK:  # not whole yet, or of this machine alone
            continue
        with contextlib.suppress(FileNotFoundError):
            known = path.stat()
            if path.is_file():
                found[str(path.relative_to(folder))] = (known.st_mtime_ns, known.st_size)
    return found
