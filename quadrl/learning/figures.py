"""Plots of runs and flights, in the manner of the paper's figures 3 and 6."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from quadrl.errors import QuadrlError
from quadrl.learning.evaluate import Record
from quadrl.policy import write_whole

STYLE = {
    "blue": "#2a6fbb",
    "orange": "#e8743b",
    "green": "#3a9a5b",
    "grey": "#6b7280",
    "violet": "#7c5cbf",
}
DPI = 130
PANELS = {
    "return": ("return of an episode", "blue"),
    "success": ("share of episodes", "green"),
    "error": ("error [m]", "orange"),
}
"""Of a learning curve: column of metrics.csv, label and colour."""


class FigureError(QuadrlError):
    """A plot of something that is not there."""


def read_metrics(path: Path) -> dict[str, np.ndarray]:
    """Columns of a metrics.csv, (iterations,) each; what is missing is not a number.

    Raises:
        FigureError: There is none, or nothing in it, or something else.
    """
    if not path.is_file():
        raise FigureError(f"nothing to plot: there is no {path}")
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise FigureError(f"nothing to plot yet: {path} has no rows")
    try:
        metrics = {
            name: np.array([float(row[name]) if row[name] else np.nan for row in rows])
            for name in rows[0]
        }
    except (TypeError, ValueError) as error:
        raise FigureError(f"{path} holds something that is no number: {error}") from error
    if missing := {"steps", "seconds", *PANELS, "survival"} - set(metrics):
        raise FigureError(f"{path} has no column {', '.join(sorted(missing))}")
    return metrics


def learning_curve(metrics: dict[str, np.ndarray], title: str, path: Path) -> Path:
    """Return, success and error over the steps of a training; figure 3 of the paper."""
    figure, axes = _figure(3, (8.0, 7.2), sharex=True)
    steps = metrics["steps"] / 1e3
    for axis, (name, (label, colour)) in zip(axes, PANELS.items(), strict=True):
        ended = np.isfinite(metrics[name])  # in some batches no episode ends
        axis.plot(steps[ended], metrics[name][ended], color=STYLE[colour], lw=2, label=name)
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0 if name != "return" else None)
    ended = np.isfinite(metrics["survival"])
    survival = metrics["survival"][ended]
    axes[1].plot(steps[ended], survival, color=STYLE["grey"], lw=1.5, label="survival")
    axes[1].set_ylim(-0.03, 1.03)
    axes[1].legend(frameon=False, loc="lower right")
    axes[0].set_title(title, loc="left", fontweight="bold")
    axes[-1].set_xlabel("control steps [thousands], actions sampled from the policy")
    top = axes[0].secondary_xaxis("top", functions=_steps_to_seconds(steps, metrics["seconds"]))
    top.set_xlabel("wall clock [s]")
    return _write(figure, path)


def trajectory(record: Record, title: str, path: Path, episodes: int = 8) -> Path:
    """Flights in space and by axis, with what was to be reached; figure 6 of the paper."""
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    grid = figure.add_gridspec(4, 2, width_ratios=(1.25, 1))
    space = figure.add_subplot(grid[:, 0], projection="3d")
    rows = [figure.add_subplot(grid[k, 1]) for k in range(4)]
    shown = min(episodes, record.position.shape[1])
    colours = [STYLE[name] for name in ("blue", "orange", "green", "violet")]
    time = np.arange(1, len(record.error) + 1) * record.control_step
    for i in range(shown):
        colour = colours[i % len(colours)]
        x, y, z = record.position[:, i].T
        space.plot(x, y, z, color=colour, lw=1.4, alpha=0.9)
        space.scatter(x[:1], y[:1], z[:1], color=colour, s=18, marker="o")
        for k, axis in enumerate(rows[:3]):
            axis.plot(time, record.position[:, i, k], color=colour, lw=1.2, alpha=0.85)
        rows[3].semilogy(time, np.maximum(record.error[:, i], 1e-4), color=colour, lw=1.2)
    goal = record.goal[:, 0]
    space.plot(*goal.T, color="black", lw=1, ls="--")
    space.scatter(*goal[:1].T, color="black", marker="*", s=120, label="goal")
    for k, (axis, name) in enumerate(zip(rows, ("x", "y", "z", "error"), strict=True)):
        axis.set_ylabel(f"{name} [m]")
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
        if k < 3:
            axis.plot(time, goal[:, k], color="black", lw=1, ls="--")
            axis.tick_params(labelbottom=False)
    rows[3].set_xlabel("time [s]")
    space.set(xlabel="x east [m]", ylabel="y north [m]", zlabel="z up [m]")
    _equal_axes(space, record.position[:, :shown], goal)
    space.legend(frameon=False, loc="upper left")
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
    return _write(figure, path)


def _figure(rows: int, size: tuple[float, float], sharex: bool) -> tuple[Figure, Sequence]:
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, 1, sharex=sharex)
    for axis in axes:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _steps_to_seconds(steps: np.ndarray, seconds: np.ndarray) -> tuple:
    """The two directions between the axes below and above; both grow with the iterations."""
    x, y = np.concatenate([[0.0], steps]), np.concatenate([[0.0], seconds])
    slope = (y[-1] / x[-1]) if x[-1] else 1.0
    forward = lambda s: np.where(s > x[-1], s * slope, np.interp(s, x, y))  # noqa: E731
    backward = lambda s: np.where(s > y[-1], s / slope, np.interp(s, y, x))  # noqa: E731
    return forward, backward


def _equal_axes(axis: object, *points: np.ndarray) -> None:
    """The same scale on every axis, so that a path keeps its shape."""
    everything = np.concatenate([p.reshape(-1, 3) for p in points])
    low, high = np.nanmin(everything, 0), np.nanmax(everything, 0)
    centre, half = (low + high) / 2, max((high - low).max() / 2, 0.1) * 1.05
    for k, name in enumerate("xyz"):
        getattr(axis, f"set_{name}lim")(centre[k] - half, centre[k] + half)
    axis.set_box_aspect((1, 1, 1))  # type: ignore[attr-defined]


def _write(figure: Figure, path: Path) -> Path:
    kinds = FigureCanvasAgg(figure).get_supported_filetypes()
    kind = path.suffix.removeprefix(".").lower()
    if kind not in kinds:
        raise FigureError(f"{path}: a picture's name ends in one of .{', .'.join(sorted(kinds))}")
    picture = io.BytesIO()
    figure.savefig(picture, dpi=DPI, format=kind)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, picture.getvalue())
    return path
