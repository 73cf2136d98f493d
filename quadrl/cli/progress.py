"""The progress bar of a training."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich import progress

from quadrl.cli.console import console

if TYPE_CHECKING:
    from quadrl.learning.train import Progress


class ProgressBar:
    """Steps, steps/s, return, success and time left, redrawn in place (or a line now and then)."""

    LINE_SECONDS = 5.0  # between two lines where nothing can be redrawn

    def __init__(self) -> None:
        """Make the bar."""
        self._progress = progress.Progress(
            progress.BarColumn(bar_width=24),
            progress.TextColumn("{task.description}"),
            progress.TimeRemainingColumn(compact=True),
            console=console,
            disable=not console.is_terminal,
        )
        self._begun: tuple[int, float] | None = None
        self._last_line = 0.0
        self._metrics: dict[str, float] = {}

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *error: object) -> None:
        self._progress.stop()

    def show(self, now: Progress) -> None:
        """Redraw after an iteration."""
        if self._begun is None:
            self._begun = (now.iteration - 1, 0.0 if now.iteration == 1 else now.seconds)
            self._progress.start()
            self._row = self._progress.add_task("", total=now.iterations)
        first, since = self._begun
        share = (now.iteration - first) / now.iteration
        rate = now.steps * share / max(now.seconds - since, 1e-9)
        self._metrics |= now.metrics
        report = (
            f"{now.steps:>9,} steps  {rate:>7,.0f}/s  "
            f"return {self._metrics.get('return', float('nan')):>7.0f}  "
            f"success {100 * self._metrics.get('success', 0.0):>3.0f} %"
        )
        self._progress.update(self._row, completed=now.iteration, description=report)
        last = now.iteration == now.iterations
        if last:
            self._progress.stop()
        if not console.is_terminal and (last or now.seconds - self._last_line > self.LINE_SECONDS):
            self._last_line = now.seconds
            console.print(f"{100 * now.iteration / now.iterations:3.0f} %  {report}")
