"""Carry out trainings side by side, each in a process of its own, and again if one dies."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from quadrl.base.errors import QuadrlError
from quadrl.base.machine import cores
from quadrl.base.progress import TimeLeft
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import CONFIG, EVALUATION, FREE, METRICS

ATTEMPTS = 3
"""Times that a training is begun or continued until it counts as failed."""
STOP_SECONDS = 30.0
"""Time that a training has for its last iteration and checkpoint when the study is stopped."""
POLL_SECONDS, NEWS_SECONDS = 0.1, 10.0  # the latter between two lines of progress
WORKER = "quadrl.learning.worker"
"""The module whose `main` a process runs."""


@dataclasses.dataclass(frozen=True)
class PlannedRun:
    """One training of a study."""

    config: TrainConfig
    folder: Path
    variant: str = ""
    """The name of its settings in the study."""

    @property
    def name(self) -> str:
        """The name of its folder."""
        return self.folder.name

    @property
    def done(self) -> bool:
        """Whether it is trained and evaluated.

        Raises:
            QuadrlError: The folder holds a run with other settings.
        """
        # A listing, since a shared file system caches for a while which files do not exist.
        files = os.listdir(self.folder) if self.folder.is_dir() else []
        if CONFIG not in files:
            return False
        free = {name: getattr(TrainConfig, name) for name in FREE}
        run = TrainConfig.of_folder(self.folder)
        found, own = (dataclasses.replace(config, **free) for config in (run, self.config))
        if found != own or run.base != self.config.base:
            raise QuadrlError(
                f"{self.folder} holds a run with other settings than this study's: "
                "choose another folder (--out), or move that run away"
            )
        return EVALUATION in files

    @property
    def share(self) -> float:
        """The share of it that is done, by the rows that it has written."""
        file = self.folder / METRICS
        rows = file.read_bytes().count(b"\n") - 1 if file.exists() else 0
        return max(0, rows) / self.config.iterations

    @property
    def log(self) -> Path:
        """The file that its process writes to."""
        return self.folder.parent / "logs" / f"{self.name}.txt"


@dataclasses.dataclass(frozen=True)
class End:
    """How a training ended."""

    message: str = ""
    """Why it failed; empty if it did not."""
    lost: bool = False
    """Whether its process or its machine died, and another attempt may succeed."""


def order(run: PlannedRun, own: Iterable[Path] = ()) -> dict[str, Any]:
    """Make the order for a process: train and evaluate, after importing files of one's own."""
    return {
        "config": dataclasses.asdict(run.config),
        "versions": run.config.resolved()["versions"],
        "folder": str(run.folder.absolute()),
        "own": [str(path.absolute()) for path in own],
    }


class Process:
    """A process on this machine, in a session of its own: a Ctrl-C does not reach it."""

    def __init__(self, what: dict[str, Any], log: Path) -> None:
        """Start it; what it prints goes to a file."""
        self._log, self._asked = log, False
        log.parent.mkdir(parents=True, exist_ok=True)
        search = os.pathsep.join(path or os.getcwd() for path in sys.path)
        with open(log, "wb") as file:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", f"from {WORKER} import main; main()"],
                env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": search},
                stdin=subprocess.PIPE,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        with contextlib.suppress(BrokenPipeError):  # it ended at once: the log says why
            assert self._process.stdin
            self._process.stdin.write(json.dumps(what).encode() + b"\n")
            self._process.stdin.flush()

    def poll(self) -> End | None:
        """Return how it ended; None while it works."""
        return None if self._process.poll() is None else self.wait()

    def wait(self) -> End:
        """Wait until it ends, and return how it ended."""
        code = self._process.wait()
        self.stop()
        if code < 0:
            return End(f"its process was killed by signal {-code}", lost=True)
        lines = self._log.read_text(errors="replace").strip().splitlines() or ["no output"]
        return End(lines[-1].strip().removeprefix("quadrl: ") if code else "")

    def ask(self) -> None:
        """Ask it, once, to write a checkpoint at the end of its iteration and to stop."""
        if not self._asked:
            self._asked = True
            self._process.terminate()

    def stop(self) -> None:
        """Ask it to stop, and kill it if it does not."""
        self.ask()
        try:
            self._process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        with contextlib.suppress(BrokenPipeError):
            assert self._process.stdin
            self._process.stdin.close()


@dataclasses.dataclass(frozen=True)
class Local:
    """Processes on this machine."""

    jobs: int | None = None
    """Trainings at a time; None for one per core."""
    own: tuple[Path, ...] = ()

    def slots(self) -> int:
        """Number of trainings at a time."""
        return self.jobs or cores()

    def begin(self, run: PlannedRun) -> Any:
        """Begin a training, or continue it; returns what can `poll` and `stop` it."""
        return Process(order(run, self.own), run.log)


def train_all(
    runs: Iterable[PlannedRun], executor: Local, say: Callable[[str], None]
) -> dict[str, str]:
    """Train and evaluate the runs that are not done; those that were begun are continued.

    Args:
        runs: The runs, each with a name of its own.
        executor: Where they are carried out.
        say: Called with a line about each event.

    Returns:
        Why trainings failed, by name; empty if all are done.

    Raises:
        QuadrlError: A folder holds a run with other settings; nothing was begun.
    """
    given = {run.name: run for run in runs}
    waiting = [name for name, run in given.items() if not run.done]
    going: dict[str, Any] = {}
    attempts: Counter[str] = Counter()
    failed: dict[str, str] = {}
    clock, news, done = TimeLeft(), time.monotonic(), len(given) - len(waiting)
    clock.left(done + sum(given[name].share for name in waiting), len(given))
    if done:
        say(f"{done} of {len(given)} trainings are done already")
    try:
        while waiting or going:
            while waiting and len(going) < executor.slots():
                name = waiting.pop(0)
                going[name] = executor.begin(given[name])
                attempts[name] += 1
                again = f" (attempt {attempts[name]} of {ATTEMPTS})" if attempts[name] > 1 else ""
                say(f"{name}: begun{again}, {len(waiting)} waiting")
            for name, worker in list(going.items()):
                if (end := worker.poll()) is None:
                    continue
                del going[name]
                why = end.message or "it left no result"
                if not end.message and given[name].done:
                    done += 1
                    say(f"{name}: done, {done} of {len(given)}")
                elif end.lost and attempts[name] < ATTEMPTS:
                    waiting.insert(0, name)
                    say(f"{name}: {why}; it goes on from its last checkpoint")
                else:
                    failed[name] = f"{why} (see {given[name].log})"
                    say(f"{name}: failed: {failed[name]}")
            if time.monotonic() - news > NEWS_SECONDS:
                news = time.monotonic()
                at = ", ".join(f"{name} {100 * given[name].share:.0f} %" for name in going)
                parts = sum(given[name].share for name in (*going, *waiting))
                say(f"{done} of {len(given)} done; {at}{clock.left(done + parts, len(given))}")
            time.sleep(POLL_SECONDS)
    finally:
        for worker in going.values():  # after a Ctrl-C: each run can be continued
            worker.ask()
        for worker in going.values():
            worker.stop()
    return failed


def complaint(failed: dict[str, str]) -> str:
    """Say in one line which trainings failed."""
    each = "; ".join(f"{name}: {why}" for name, why in failed.items())
    return f"{len(failed)} of the trainings failed: {each}; the same command tries them again"
