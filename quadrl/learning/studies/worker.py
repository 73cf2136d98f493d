"""A process that carries out one training of a study.

It reads its order, a line of JSON, from standard input, and ends as soon as standard input ends:
whoever ordered it is gone. A run that is killed at any moment can be continued.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from quadrl.base.errors import QuadrlError
from quadrl.base.signals import Stopped, heeded, unheeded
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import CONFIG, EVALUATION
from quadrl.learning.studies.plan import PlannedRun, fields

FAILED = 2
"""Exit code: the training ended with an error that the log tells."""


def order(run: PlannedRun, episodes: int, own: tuple[Path, ...] = ()) -> dict[str, Any]:
    """What a worker is to do.

    Args:
        run: The training.
        episodes: Of the evaluation.
        own: Files that register what the training needs.
    """
    return {
        "config": fields(run.config),
        "versions": run.config.resolved()["versions"],
        "folder": str(run.folder.absolute()),
        "episodes": episodes,
        "own": [str(path.absolute()) for path in own],
    }


def start(what: dict[str, Any], log: Path) -> subprocess.Popen[bytes]:
    """Start a worker, in a session of its own: a Ctrl-C does not reach it."""
    log.parent.mkdir(parents=True, exist_ok=True)
    search = os.pathsep.join(path or os.getcwd() for path in sys.path)
    with open(log, "wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", f"from {__name__} import main; main()"],
            env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": search},
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    assert process.stdin
    try:
        process.stdin.write(json.dumps(what).encode() + b"\n")
        process.stdin.flush()
    except BrokenPipeError:  # it ended at once: the log says why
        pass
    return process


def stop(process: subprocess.Popen[bytes]) -> None:
    """Stop a worker, and wait for it; the run can be continued."""
    process.kill()
    process.wait()
    if process.stdin:
        try:
            process.stdin.close()
        except BrokenPipeError:
            pass


def last_line(log: Path) -> str:
    """The last line of a log."""
    text = log.read_text(errors="replace") if log.exists() else ""
    return ([line for line in text.splitlines() if line.strip()] or ["no output"])[-1].strip()


def carry_out(what: dict[str, Any]) -> None:
    """Begin or continue a training, evaluate it, draw its curve and its flights.

    Raises:
        QuadrlError: It cannot be trained, or other versions are installed here than where it was
            ordered.
    """
    from quadrl.core.rules import import_own
    from quadrl.learning.run import Run, train_in

    for path in what["own"]:
        import_own(Path(path))
    config, folder = TrainConfig(**what["config"]), Path(what["folder"])
    if (here := config.resolved()["versions"]) != what["versions"]:
        name = next(name for name in here if here[name] != what["versions"].get(name))
        allowed = f"{what['versions'].get(name)}, as where the study was started"
        raise QuadrlError(name=f"version of {name}", value=here[name], allowed=allowed)
    if PlannedRun(config, folder).done:
        return
    again = (folder / CONFIG).exists()
    finished: Run = train_in(
        folder,
        config,
        resume=again,
        episodes=what["episodes"],
        show=lambda progress: None,
        heed=heeded,
    )
    for _ in finished.draw(video=False):
        pass


def main() -> None:
    """Read the order and carry it out."""
    what = json.loads(sys.stdin.buffer.readline())

    def watch() -> None:
        sys.stdin.buffer.raw.read()  # type: ignore[attr-defined] - returns once nobody can write
        if scratch := what.get("scratch"):
            shutil.rmtree(scratch, ignore_errors=True)
        os._exit(FAILED)

    threading.Thread(target=watch, daemon=True).start()
    signal.signal(signal.SIGUSR1, unheeded)
    try:
        carry_out(what)
    except (QuadrlError, OSError) as error:
        print(f"quadrl: {error}", flush=True)
        sys.exit(FAILED)
    except Stopped as stop:  # its run can be continued, as that of a process that was killed
        signal.signal(stop.number, signal.SIG_DFL)
        signal.raise_signal(stop.number)
    # What hangs at the end of the interpreter must not turn a finished training into a lost one.
    sys.stdout.flush()
    os._exit(0 if (Path(what["folder"]) / EVALUATION).exists() else FAILED)
