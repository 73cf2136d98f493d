"""Plots in one style, and learning curves in it, in the manner of the paper's figures 3 to 5."""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from quadrl.base.errors import QuadrlError
from quadrl.base.files import in_a_folder, write_whole
from quadrl.base.validation import choice

Metrics = Mapping[str, np.ndarray]
"""Columns of a metrics.csv, (iterations,) each; missing values are NaN."""

COLOURS = "#0072b2 #d55e00 #009e73 #cc79a7 #e69f00 #56b4e9 #332288 #882255".split()
"""Of what is compared (Okabe and Ito, then Tol): readers who confuse red and green tell them
apart."""
BLUE, ORANGE, GREEN, VIOLET = COLOURS[:4]
GREY, BLACK = "#6b7280", "black"
ALGORITHM_COLOURS = {"ppo": BLUE, "trpo": ORANGE, "vpg": GREEN, "apg": VIOLET}
"""Others get the remaining ones."""
DPI = 130
LEAST_ERROR = 1e-4  # [m], that is drawn
STYLE: Any = {
    **{"font.size": 9, "axes.titlesize": 9.5, "axes.labelsize": 9, "legend.fontsize": 9},
    **{"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "quadrl"},  # text stays text
}
PANELS = {
    "return": ("return of an episode", BLUE),
    "success": ("share of episodes", GREEN),
    "error": ("error [m]", ORANGE),
}
"""Of a learning curve: column of metrics.csv, label and colour."""
CLOCKS = {
    "steps": ("control steps [thousands]", 1e-3),
    "seconds": ("wall clock of the training [s]", 1.0),
}
"""What learning curves are drawn over: column of metrics.csv, label and factor."""
CURVE_POINTS = 200
OVER_RUNS = {"return": "return of an episode", "success": "success [share]"}
"""What learning curves of several runs show: column and label."""
styled = matplotlib.rc_context(STYLE)
"""Decorates whatever draws."""


@styled
def content(figure: Figure, kind: str, name: str = "kind", comment: str = "") -> bytes:
    """The file of a figure; the same numbers make the same bytes.

    Args:
        figure: The figure.
        kind: The ending of the file, such as png, pdf or svg.
        name: What an error calls it.
        comment: Written into a png, where it can be read again.

    Raises:
        QuadrlError: The kind is unknown.
    """
    choice(name, kind, sorted(FigureCanvasAgg(figure).get_supported_filetypes()))
    picture = io.BytesIO()
    said: Any = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}  # undated
    said["png"] = {"comment": comment} if comment else {}
    figure.savefig(picture, dpi=DPI, format=kind, metadata=said.get(kind))
    return picture.getvalue()


def save(figure: Figure, path: Path, comment: str = "") -> Path:
    """Write a figure, whole or not at all; its kind is what the name ends in.

    Raises:
        QuadrlError: The name ends in no kind of picture, or there is no such folder.
    """
    kind = path.suffix.removeprefix(".").lower()
    written = content(figure, kind, f"ending of {path}", comment)
    write_whole(in_a_folder(path), written)
    return path


def tidy(axis: Any) -> None:
    """Draw a light grid, and no frame above and to the right."""
    axis.grid(alpha=0.25, lw=0.6)
    axis.spines[["top", "right"]].set_visible(False)


def head(figure: Figure, title: str) -> None:
    """Write a title over all panels."""
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)


@styled
def learning_curve(
    metrics: Metrics,
    title: str,
    evaluated: Metrics | None = None,
    ends: Sequence[float] = (),
) -> Figure:
    """Return, success and error over the steps of a run; figure 3 of the paper.

    The main line is the mean action, as it was evaluated along the training; beside it, or alone
    where there was no evaluation, are the sampled actions of the training itself. Lines mark the
    `ends` of trainings before the last [control steps].
    """
    figure = Figure(figsize=(8.0, 7.2), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    for axis, (name, (label, colour)) in zip(axes, PANELS.items(), strict=True):
        if evaluated is not None:
            _curve(axis, metrics, name, color=colour, lw=1.0, alpha=0.4)
            _curve(axis, evaluated, name, color=colour, lw=2, marker="o", ms=4, label=name)
        else:
            _curve(axis, metrics, name, color=colour, lw=2, label=name)
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0 if name != "return" else None)
        for end in ends:
            axis.axvline(end / 1e3, color=GREY, lw=1, ls=":")
        tidy(axis)
    _curve(axes[1], evaluated or metrics, "survival", color=GREY, lw=1.5, label="survival")
    axes[1].set_ylim(-0.03, 1.03)
    axes[1].legend(frameon=False, loc="best")
    flown = "sampled actions" if evaluated is None else "mean action; thin: sampled actions"
    flown += "; dotted: a training from here on" * bool(ends)
    axes[-1].set_xlabel(f"control steps [thousands], {flown}")
    seconds = _steps_to_seconds(metrics["steps"] / 1e3, metrics["seconds"])
    top = axes[0].secondary_xaxis("top", functions=seconds)
    top.set_xlabel("wall clock [s]")
    head(figure, title)
    return figure


def _curve(axis: Any, metrics: Metrics, name: str, **style: Any) -> None:
    """Draw a column over the steps; in some batches of a training no episode ends."""
    ended = np.isfinite(metrics[name])
    axis.plot(metrics["steps"][ended] / 1e3, metrics[name][ended], **style)


def _steps_to_seconds(steps: np.ndarray, seconds: np.ndarray) -> tuple:
    """The functions from the lower axis to the upper one and back; both grow with iterations."""
    x, y = np.concatenate([[0.0], steps]), np.concatenate([[0.0], seconds])
    slope = (y[-1] / x[-1]) if x[-1] else 1.0
    forward = lambda s: np.where(s > x[-1], s * slope, np.interp(s, x, y))  # noqa: E731
    backward = lambda s: np.where(s > y[-1], s / slope, np.interp(s, y, x))  # noqa: E731
    return forward, backward


@styled
def learning_curves(
    groups: Mapping[str, Sequence[Metrics]],
    title: str,
    clocks: Sequence[str] = ("steps", "seconds"),
) -> Figure:
    """Several trainings in one figure; figures 3 to 5 of the paper.

    Of each algorithm it shows the median over its runs, and the band from the worst to the best.

    Args:
        groups: The metrics of the runs of each algorithm, or their evaluations; any column but the
            steps may be missing.
        title: Title of the figure.
        clocks: Names of CLOCKS, a row each.

    Raises:
        QuadrlError: No episode has ended in any of the runs.
    """
    every = [*itertools.chain(*groups.values())]
    clocks = [clock for clock in clocks if any(clock in run for run in every)]
    figure = Figure(figsize=(9.2, 0.6 + 2.6 * len(clocks)), layout="constrained")
    axes: Any = figure.subplots(len(clocks), len(OVER_RUNS), squeeze=False)
    spare = itertools.cycle(c for c in COLOURS if c not in ALGORITHM_COLOURS.values())
    for algo, runs in groups.items():
        colour = ALGORITHM_COLOURS.get(algo) or next(spare)
        known = algo.partition(" ")[0] in ALGORITHM_COLOURS
        label = f"{algo.upper() if known else algo}, {len(runs)} seed{'s' * (len(runs) > 1)}"
        for (clock, panel), axis in zip(
            itertools.product(clocks, OVER_RUNS), axes.flat, strict=True
        ):
            axis.set(xlabel=CLOCKS[clock][0], ylabel=OVER_RUNS[panel])
            if (band := spread(runs, panel, clock)) is None:
                continue
            x, (low, median, high) = band[0] * CLOCKS[clock][1], band[1]
            axis.fill_between(x, low, high, color=colour, alpha=0.18, lw=0)
            axis.plot(x, median, color=colour, lw=1.8, label=label)
    for panel, column in zip(OVER_RUNS, axes.T, strict=True):
        for axis in column:
            tidy(axis)
            axis.set_xlim(left=0)
            if panel == "success":
                axis.set_ylim(-0.03, 1.03)
    if not (drawn := [axis for axis in axes.flat if axis.lines]):
        raise QuadrlError(f"nothing to plot yet for {title}: no episode has ended")
    most = max(drawn, key=lambda axis: len(axis.lines))
    most.legend(frameon=False, loc="best")
    head(figure, title)
    return figure


def spread(runs: Sequence[Metrics], name: str, clock: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Worst, median and best (3, n) of a column over runs, and where (n,); None without any.

    The points lie evenly where every run has been; between the batches in which episodes ended a
    run is interpolated.
    """
    curves = []
    for run in runs:
        if not {name, clock} <= {*run}:
            continue
        ended = np.isfinite(run[name]) & np.isfinite(run[clock])
        if ended.any():
            curves.append((run[clock][ended], run[name][ended]))
    if not curves:
        return None
    low, high = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    if high < low:  # one was stopped before another's first episode ended
        return None
    points = np.linspace(low, high, CURVE_POINTS)
    values = np.array([np.interp(points, x, y) for x, y in curves])
    return points, np.quantile(values, (0.0, 0.5, 1.0), axis=0)
