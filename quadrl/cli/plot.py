"""`quadrl plot`."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from quadrl.base.errors import QuadrlError
from quadrl.cli import choices
from quadrl.cli.console import say
from quadrl.learning.folder import LEARNING_CURVE
from quadrl.learning.show import curve, curves


@choices.command
class Plot:
    """Draw the learning curve of one run, or the curves of several runs in one picture.

    A csv beside the runs is the curve of another program, labelled by its name: columns of steps
    and of success or return, as in a progress.csv or monitor.csv of Stable-Baselines3 or an export
    of W&B or TensorBoard.
    """

    run_folders: Positional[tuple[Path, ...]]
    """Run folders, or csv files. Several are drawn together: a picture for each task, with a curve
    for each algorithm and the spread over its runs."""
    out: Path | None = None
    """Output file; its extension (png, pdf, svg) sets the format. By default learning_curve.png in
    the run folder or, for several runs, learning_curves_TASK.png here."""

    def run(self) -> None:
        """Write the pictures."""
        from quadrl.evaluation.plotting import save

        if not self.run_folders:
            raise QuadrlError("give a run folder, or several: quadrl plot runs/*")
        (folder, *more) = self.run_folders
        if not more and folder.suffix != ".csv":
            figures = {self.out or folder / LEARNING_CURVE: curve(folder)}
        else:
            found = curves(self.run_folders, lambda error: say(f"left out: {error}"))
            base = self.out or Path("learning_curves.png")
            one = self.out and len(found) == 1  # the name needs no task
            figures = {
                base if one else base.with_name(f"{base.stem}_{task}{base.suffix}"): figure
                for task, figure in found.items()
            }
        if not figures:
            many = len(self.run_folders)
            raise QuadrlError(f"none of the {many} folders holds a run to plot")
        for path, figure in figures.items():
            say(f"wrote {save(figure, path)}")
