"""A process that carries out one training of a study.

It reads its order, a line of JSON, from standard input, and ends as soon as standard input ends,
since then the study is gone. A run that is killed at any moment can be continued.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

from quadrl.base.errors import QuadrlError
from quadrl.base.signals import Stopped, heeded, unheeded
from quadrl.core.record import import_own
from quadrl.learning.config import TrainConfig
from quadrl.learning.executor import POLL_SECONDS, PlannedRun
from quadrl.learning.folder import CONFIG, EVALUATION, lock_folder

LOCKED_SECONDS = 120.0
"""Time that a training waits until a shared file system says that a lost one left its folder."""
FAILED = 2
"""Exit code of a process whose training ended with an error, which is in its log."""


def carry_out(what: dict[str, Any]) -> None:
    """Begin or continue a training, evaluate its policy, and draw its curve and flights.

    Raises:
        QuadrlError: It cannot be trained, or other versions are installed here than where the study
            was started.
    """
    from quadrl.learning.run import train_in  # which takes seconds

    for path in what["own"]:
        import_own(Path(path))
    config, folder = TrainConfig(**what["config"]), Path(what["folder"])
    if (here := config.resolved()["versions"]) != what["versions"]:
        name = next(name for name in here if here[name] != what["versions"].get(name))
        allowed = f"{what['versions'].get(name)}, as where the study was started"
        raise QuadrlError(name=f"version of {name}", value=here[name], allowed=allowed)
    folder.mkdir(parents=True, exist_ok=True)
    until = time.monotonic() + LOCKED_SECONDS
    while True:  # a lost training may go on here for a while
        try:
            lock_folder(folder)()
            break
        except QuadrlError:
            if time.monotonic() > until:
                raise
        time.sleep(POLL_SECONDS)
    if PlannedRun(config, folder).done:  # by the lost one
        return
    resume = (folder / CONFIG).exists()
    finished = train_in(folder, config, resume=resume, show=lambda progress: None, heed=heeded)
    for _ in finished.draw(video=False):
        pass


def main() -> None:
    """Read the order and carry it out."""
    what = json.loads(sys.stdin.buffer.readline())

    def watch() -> None:
        sys.stdin.buffer.raw.read()  # type: ignore[attr-defined] - returns once nobody can write
        os._exit(FAILED)

    threading.Thread(target=watch, daemon=True).start()
    signal.signal(signal.SIGUSR1, unheeded)
    try:
        carry_out(what)
    except (QuadrlError, OSError) as error:
        sys.stdout.write(f"quadrl: {error}\n")
        sys.exit(FAILED)
    except Stopped as stop:  # end like a killed process, whose run can be continued
        signal.signal(stop.number, signal.SIG_DFL)
        signal.raise_signal(stop.number)
    # A hang at the exit of the interpreter must not turn a finished training into a lost one.
    sys.stdout.flush()
    os._exit(0 if (Path(what["folder"]) / EVALUATION).exists() else FAILED)
