"""Trainings side by side: what waits, what runs, what was lost and begins again, what failed."""

from __future__ import annotations

import collections
import dataclasses
import subprocess
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol

from quadrl.base.errors import QuadrlError
from quadrl.base.machine import cores
from quadrl.learning.folder import METRICS
from quadrl.learning.studies import worker
from quadrl.learning.studies.plan import PlannedRun

ATTEMPTS = 3
"""Times that a training is begun or continued before it counts as failed."""
BEGINNINGS = 10
"""Times that its machine may be gone before it runs; these are no attempts."""
PAUSE_SECONDS = 5.0
"""After each of them. A cluster needs half a minute to see that a machine is gone."""
POLL_SECONDS = 0.1
NEWS_SECONDS = 10.0  # between two lines of progress
Say = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class End:
    """How a training ended."""

    message: str = ""
    """Why it failed; empty if it did not."""
    lost: bool = False
    """Whether its process or its machine died, and another attempt may succeed."""
    ran: bool = True
    """Whether it ran at all; if not, its machine was gone before."""


class Worker(Protocol):
    """Whoever carries out a training."""

    def poll(self) -> End | None:
        """How it ended; None while it works."""
        ...

    def stop(self) -> None:
        """Stop it, and wait for that; the run can be continued."""
        ...


class Crew(Protocol):
    """Where trainings are carried out."""

    def slots(self) -> int:
        """How many at the same time."""
        ...

    def begin(self, run: PlannedRun, log: Path) -> Worker:
        """Begin a training, or continue it."""
        ...


class LocalWorker:
    """A process on this machine."""

    def __init__(self, process: subprocess.Popen[bytes], log: Path) -> None:
        """Watch a process that writes to a log."""
        self._process, self._log = process, log

    def poll(self) -> End | None:
        """How it ended; None while it works."""
        if (code := self._process.poll()) is None:
            return None
        worker.stop(self._process)
        return ended(code, worker.last_line(self._log))

    def stop(self) -> None:
        """Kill it, and wait for that."""
        worker.stop(self._process)


def ended(code: int, last: str) -> End:
    """How a process ended, from its exit code and the last line of its log."""
    if code == 0:
        return End()
    if code < 0:
        return End(f"its process was killed by signal {-code}", lost=True)
    return End(last.removeprefix("quadrl: "))


@dataclasses.dataclass(frozen=True)
class Local:
    """Processes on this machine."""

    episodes: int
    jobs: int | None = None
    """At a time; None for one per core."""
    own: tuple[Path, ...] = ()

    def slots(self) -> int:
        """How many at the same time."""
        return self.jobs or cores()

    def begin(self, run: PlannedRun, log: Path) -> LocalWorker:
        """Begin a training, or continue it."""
        return LocalWorker(worker.start(worker.order(run, self.episodes, self.own), log), log)


@dataclasses.dataclass(eq=False)
class _Job:
    """A training that waits or is at work."""

    run: PlannedRun
    attempt: int = 1
    never_ran: int = 0
    """Beginnings that were none."""
    after: float = 0.0
    """When it may be begun, on the clock `time.monotonic` [s]."""


def train_all(runs: Iterable[PlannedRun], crew: Crew, say: Say) -> dict[str, str]:
    """Train and evaluate the runs that are not done, and continue those that are half done.

    Args:
        runs: The runs.
        crew: Where they are carried out.
        say: Is told what happens, a line each.

    Returns:
        Why trainings failed, by name; empty if all are done.

    Raises:
        QuadrlError: A folder holds a run with other settings; nothing was begun.
    """
    given = list(runs)
    waiting = collections.deque(_Job(run) for run in given if not run.done)
    done = len(given) - len(waiting)
    if done:
        say(f"{done} of {len(given)} trainings are done already")
    going: list[tuple[Worker, _Job]] = []
    failed: dict[str, str] = {}
    news = time.monotonic()
    try:
        while waiting or going:
            while (job := _next(waiting)) and len(going) < crew.slots():
                waiting.remove(job)
                run = job.run
                going.append((crew.begin(run, log_of(run)), job))
                again = f" (attempt {job.attempt} of {ATTEMPTS})" if job.attempt > 1 else ""
                say(f"{run.name}: begun{again}, {len(waiting)} waiting")
            for each in list(going):
                at_work, job = each
                if (end := at_work.poll()) is None:
                    continue
                going.remove(each)
                run, why = job.run, end.message or "it left no result"
                job.never_ran += not end.ran
                if not end.message and run.done:
                    done += 1
                    say(f"{run.name}: done, {done} of {len(given)}")
                elif not end.ran and job.never_ran < BEGINNINGS:
                    say(f"{run.name}: {why}; it never ran, and begins again in {PAUSE_SECONDS:g} s")
                    job.after = time.monotonic() + PAUSE_SECONDS
                    waiting.appendleft(job)
                elif end.ran and end.lost and job.attempt < ATTEMPTS:
                    say(f"{run.name}: {why}; it goes on from its last checkpoint")
                    job.attempt += 1
                    waiting.appendleft(job)
                else:
                    times = f"; begun {job.never_ran} times, it never ran" if not end.ran else ""
                    failed[run.name] = f"{why}{times} (see {log_of(run)})"
                    say(f"{run.name}: failed: {failed[run.name]}")
            if time.monotonic() - news > NEWS_SECONDS:
                news = time.monotonic()
                shares = [(job.run.name, _share(job.run)) for _, job in going]
                at = ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares)
                say(f"{done} of {len(given)} done; {at}")
            time.sleep(POLL_SECONDS)
    finally:
        for at_work, _ in going:  # after a Ctrl-C: each run can be continued
            at_work.stop()
    return failed


def train_here(runs: Iterable[PlannedRun], jobs: int | None, episodes: int, say: Say) -> None:
    """Train on this machine, all or none failing.

    Raises:
        QuadrlError: A folder holds a run with other settings, or a training failed.
    """
    if failed := train_all(runs, Local(episodes, jobs), say):
        raise QuadrlError(complaint(failed))


def complaint(failed: dict[str, str]) -> str:
    """What failed, in one line."""
    each = "; ".join(f"{name}: {why}" for name, why in failed.items())
    return f"{len(failed)} of the trainings failed: {each}; the same command tries them again"


def _next(waiting: Iterable[_Job]) -> _Job | None:
    """The first that may be begun now."""
    return next((job for job in waiting if job.after <= time.monotonic()), None)


def log_of(run: PlannedRun) -> Path:
    """Where the process of a training writes."""
    return run.folder.parent / "logs" / f"{run.name}.txt"


def _share(run: PlannedRun) -> float:
    """How much of a training is done, by the rows that it has written."""
    try:
        with open(run.folder / METRICS, "rb") as file:
            rows = sum(1 for _ in file) - 1
    except OSError:
        return 0.0
    return max(0, rows) / run.config.iterations
