"""The progress of a training, and a progress bar for terminals, notebooks and log files."""

from __future__ import annotations

import dataclasses
import importlib
import time
from typing import Any

from rich import progress
from rich.console import Console

from quadrl.base.units import duration


@dataclasses.dataclass
class Progress:
    """The state of a training after an iteration."""

    iteration: int
    iterations: int
    steps: int
    seconds: float
    metrics: dict[str, float]
    phase: str = ""
    """Which one it is of trainings in turn."""


class TimeLeft:
    """Estimates the time left of counted work, from its speed since the first call."""

    def __init__(self) -> None:
        """Wait for the first call."""
        self._first: tuple[float, float] | None = None  # how much was done, and when [s]

    def left(self, done: float, total: float) -> str:
        """The time left as text, such as "  2:05 min left"; empty where it is not known."""
        now = time.monotonic()
        self._first = self._first or (done, now)
        before, since = self._first
        if done <= before or done >= total:
            return ""
        return f"  {duration((now - since) * (total - done) / (done - before))} left"


class ProgressBar:
    """A progress bar for a training or other counted work; use it in a `with` statement."""

    LINE_SECONDS = 5.0  # between two lines where the bar cannot be redrawn
    NOTEBOOK_SECONDS = 0.2  # between two updates in a notebook
    WIDTH = 24  # characters of the bar

    def __init__(self, console: Console | None = None, *, lines: bool = True) -> None:
        """Make the bar; with `lines`, a log or a pipe, where it cannot be drawn, gets lines."""
        self._console = console or Console()
        self._lines = lines
        self._notebook: Any = None  # the handle of what is displayed
        self._progress = progress.Progress(
            progress.BarColumn(bar_width=self.WIDTH),
            progress.TextColumn("{task.description}"),
            progress.TimeRemainingColumn(compact=True),
            console=self._console,
            disable=not self._redrawn,
        )
        self._row: progress.TaskID | None = None
        self._begun: tuple[int, float] | None = None  # iteration and seconds of the first update
        self._phase = ""
        self._clock = TimeLeft()
        self._last_line = time.monotonic()
        self._metrics: dict[str, float] = {}

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *error: object) -> None:
        self._progress.stop()

    @property
    def _redrawn(self) -> bool:
        return self._console.is_terminal and not self._console.is_jupyter

    def update(self, done: int, total: int, text: str) -> None:
        """Show that `done` of `total` are done, with a text behind the bar."""
        last = done == total
        if self._redrawn:
            if self._row is None:
                self._progress.start()
                self._row = self._progress.add_task(text, total=total)
            self._progress.update(self._row, completed=done, description=text)
            if last:
                self._progress.stop()
            return
        left = self._clock.left(done, total)
        seconds = self.NOTEBOOK_SECONDS if self._console.is_jupyter else self.LINE_SECONDS
        now = time.monotonic()
        # What takes no time needs no line; a training always has its last one.
        wanted = self._begun is not None or self._console.is_jupyter
        if now - self._last_line < seconds and not (last and wanted):
            return
        self._last_line = now
        if self._console.is_jupyter:
            filled = round(self.WIDTH * done / total)
            self._display(f"{'━' * filled}{'╌' * (self.WIDTH - filled)}  {text}{left}")
        elif self._lines:
            line = f"{100 * done / total:3.0f} %  {text}{left}"
            self._console.print(line, soft_wrap=True, highlight=False)

    def show(self, now: Progress) -> None:
        """Show steps, steps/s, return and success after an iteration of a training."""
        if now.phase != self._phase:  # the next of several trainings
            self._phase, self._begun = now.phase, None
            self._row, self._clock, self._metrics = None, TimeLeft(), {}
        if self._begun is None:
            self._begun = (now.iteration - 1, 0.0 if now.iteration == 1 else now.seconds)
        first, since = self._begun
        share = (now.iteration - first) / now.iteration
        rate = now.steps * share / max(now.seconds - since, 1e-9)
        self._metrics |= now.metrics
        # Until the first whole episodes end there is neither.
        gained, success = (self._metrics.get(name) for name in ("return", "success"))
        report = (
            f"{now.phase}{'  ' * bool(now.phase)}{now.steps:>9,} steps  {rate:>7,.0f}/s  "
            f"return {'-' if gained is None else f'{gained:.0f}':>7}  "
            f"success {'-' if success is None else f'{100 * success:.0f}':>3} %"
        )
        self.update(now.iteration, now.iterations, report)

    def _display(self, line: str) -> None:
        """Show a line in a notebook, in place of the last one."""
        display = importlib.import_module("IPython.display").display
        if self._notebook is None:
            self._notebook = display({"text/plain": line}, raw=True, display_id=True)
        else:
            self._notebook.update({"text/plain": line}, raw=True)
