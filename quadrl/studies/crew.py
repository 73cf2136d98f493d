"""Trainings side by side: what waits, what runs, what was lost and begins again, what failed."""

from __future__ import annotations

import collections
import dataclasses
import subprocess
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol

from quadrl.errors import QuadrlError
from quadrl.learning.folder import METRICS
from quadrl.machine import cores
from quadrl.studies import worker
from quadrl.studies.plan import PlannedRun

ATTEMPTS = 3
"""Times that a training is begun or continued before it counts as failed."""
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
    waiting = collections.deque((run, 1) for run in given if not run.done)
    done = len(given) - len(waiting)
    if done:
        say(f"{done} of {len(given)} trainings are done already")
    going: list[tuple[Worker, PlannedRun, int]] = []
    failed: dict[str, str] = {}
    news = time.monotonic()
    try:
        while waiting or going:
            while waiting and len(going) < crew.slots():
                run, attempt = waiting.popleft()
                log = log_of(run)
                going.append((crew.begin(run, log), run, attempt))
                again = f" (attempt {attempt} of {ATTEMPTS})" if attempt > 1 else ""
                say(f"{run.name}: begun{again}, {len(waiting)} waiting")
            for each in list(going):
                at_work, run, attempt = each
                if (end := at_work.poll()) is None:
                    continue
                going.remove(each)
                if not end.message and run.done:
                    done += 1
                    say(f"{run.name}: done, {done} of {len(given)}")
                elif end.lost and attempt < ATTEMPTS:
                    say(f"{run.name}: {end.message}; it goes on from its last checkpoint")
                    waiting.appendleft((run, attempt + 1))
                else:
                    failed[run.name] = f"{end.message or 'it left no result'} (see {log_of(run)})"
                    say(f"{run.name}: failed: {failed[run.name]}")
            if time.monotonic() - news > NEWS_SECONDS:
                news = time.monotonic()
                at = ", ".join(f"{run.name} {100 * _share(run):.0f} %" for _, run, _ in going)
                say(f"{done} of {len(given)} done; {at}")
            time.sleep(POLL_SECONDS)
    finally:
        for at_work, _, _ in going:  # after a Ctrl-C: each run can be continued
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
