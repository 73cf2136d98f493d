"""Plots of runs and flights, in the manner of the paper's figures 3 to 7."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from quadrl.base.errors import QuadrlError
from quadrl.base.files import write_whole
from quadrl.base.validation import choice
from quadrl.evaluation.rollout import Rollout
from quadrl.learning.folder import METRICS, read_config

Metrics = dict[str, np.ndarray]
"""Columns of a metrics.csv, (iterations,) each; missing values are NaN."""

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
COLOURS = {"ppo": "blue", "trpo": "orange", "vpg": "green", "gae": "green", "apg": "violet"}
"""Of the algorithms, of vpg also by the paper's word; others get the remaining ones."""
CLOCKS = {
    "steps": ("control steps [thousands]", 1e-3),
    "seconds": ("wall clock of the training [s]", 1.0),
}
"""What learning curves are drawn over: column of metrics.csv, label and factor."""
CURVE_POINTS = 200
FLIGHTS = "#2a6fbb #e8743b #3a9a5b #7c5cbf #c23b6b #1aa3a3 #9a7b1f #6b7280".split()
"""Colours of the flights in one picture."""
PLACE = "x east [m]", "y north [m]", "z up [m]"
MOTION = "roll [deg]", "pitch [deg]", "yaw [deg]"
LEAST_ERROR = 1e-4  # [m], that is drawn


def read_metrics(path: Path) -> Metrics:
    """The columns of a metrics.csv.

    Raises:
        QuadrlError: The file is missing, empty or malformed.
    """
    if not path.is_file():
        raise QuadrlError(f"nothing to plot: there is no {path}")
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise QuadrlError(f"nothing to plot yet: {path} has no rows")
    try:
        metrics = {
            name: np.array([float(row[name]) if row[name] else np.nan for row in rows])
            for name in rows[0]
        }
    except (TypeError, ValueError) as error:
        raise QuadrlError(f"{path} is malformed: {error}") from error
    if missing := {"steps", "seconds", *PANELS, "survival"} - set(metrics):
        raise QuadrlError(f"{path} has no column {', '.join(sorted(missing))}")
    return metrics


def learning_curve(folder: Path, path: Path) -> Path:
    """Draw return, success and error over the steps of a run; figure 3 of the paper.

    Raises:
        QuadrlError: The folder holds no run that has begun.
    """
    config, metrics = read_config(folder), read_metrics(folder / METRICS)
    title = f"{config['task']}, {str(config['algo']).upper()}, seed {config['seed']}"
    figure = Figure(figsize=(8.0, 7.2), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    steps = metrics["steps"] / 1e3
    for axis, (name, (label, colour)) in zip(axes, PANELS.items(), strict=True):
        ended = np.isfinite(metrics[name])  # in some batches no episode ends
        axis.plot(steps[ended], metrics[name][ended], color=STYLE[colour], lw=2, label=name)
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0 if name != "return" else None)
        _tidy(axis)
    ended = np.isfinite(metrics["survival"])
    survival = metrics["survival"][ended]
    axes[1].plot(steps[ended], survival, color=STYLE["grey"], lw=1.5, label="survival")
    axes[1].set_ylim(-0.03, 1.03)
    axes[1].legend(frameon=False, loc="best")
    axes[0].set_title(title, loc="left", fontweight="bold")
    axes[-1].set_xlabel("control steps [thousands], actions sampled from the policy")
    top = axes[0].secondary_xaxis("top", functions=_steps_to_seconds(steps, metrics["seconds"]))
    top.set_xlabel("wall clock [s]")
    return save(figure, path)


def learning_curves(
    groups: Mapping[str, Sequence[Metrics]],
    title: str,
    path: Path,
    clocks: Sequence[str] = ("steps", "seconds"),
) -> Path:
    """Draw return and success of several trainings in one picture; figures 3 to 5 of the paper.

    Of each algorithm it shows the median over its runs, and the band from the worst to the best.

    Args:
        groups: The metrics of the runs of each algorithm.
        title: Of the picture.
        path: The picture.
        clocks: Of CLOCKS, a row each.

    Raises:
        QuadrlError: No episode has ended in any of the runs.
    """
    panels = {"return": "return of an episode", "success": "success [share]"}
    figure = Figure(figsize=(9.2, 0.6 + 2.6 * len(clocks)), layout="constrained")
    axes: Any = figure.subplots(len(clocks), len(panels), squeeze=False)
    spare = iter(name for name in STYLE if name not in COLOURS.values())
    drawn = False
    for algo, runs in groups.items():
        colour = STYLE[COLOURS[algo] if algo in COLOURS else next(spare, "grey")]
        label = f"{algo.upper()}, {len(runs)} seed{'s' * (len(runs) > 1)}"
        for (clock, panel), axis in zip(itertools.product(clocks, panels), axes.flat, strict=True):
            if (band := spread(runs, panel, clock)) is None:
                continue
            drawn = drawn or panel == "return"
            x, (low, median, high) = band[0] * CLOCKS[clock][1], band[1]
            axis.fill_between(x, low, high, color=colour, alpha=0.18, lw=0)
            axis.plot(x, median, color=colour, lw=1.8, label=label)
            axis.set_ylabel(panels[panel])
            axis.set_xlabel(CLOCKS[clock][0])
    if not drawn:
        raise QuadrlError(f"nothing to plot yet for {title}: no episode has ended")
    for axis in axes.flat:
        _tidy(axis)
        axis.set_xlim(left=0)
    for axis in axes[:, 1]:
        axis.set_ylim(-0.03, 1.03)
    axes[0, 0].legend(frameon=False, loc="best")
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
    return save(figure, path)


def spread(runs: Sequence[Metrics], name: str, clock: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Worst, median and best (3, n) of a column over runs, and where (n,); None without any.

    The points lie where every run has been; between the batches in which episodes ended a run is
    interpolated.
    """
    curves = []
    for run in runs:
        ended = np.isfinite(run[name])
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


def trajectory(rollout: Rollout, title: str, path: Path, episodes: int = 8) -> Path:
    """Draw flights in space and over time; figure 6 of the paper, and what led to it.

    Each flight has a colour. Goals are dashed: black where all flights have the same one that
    stays, else each in the colour of its flight. Flights in wind show it, and the airspeed. At most
    `episodes` flights are drawn.
    """
    shown = min(episodes, rollout.position.shape[1])
    colours = [FLIGHTS[i % len(FLIGHTS)] for i in range(shown)]
    time = np.arange(1, len(rollout.error) + 1) * rollout.control_timestep
    goals = rollout.goal[:, :shown]
    shared = bool(np.all(np.isnan(goals) | (np.abs(goals - goals[:1, :1]) < 1e-9)))
    figure = Figure(figsize=(14.0, 9.6), layout="constrained")
    upper, lower = cast(Any, figure.subfigures(2, 1, height_ratios=(1.75, 1)))
    wind, velocity = rollout.wind[:, :shown], rollout.velocity[:, :shown]
    windy = bool(np.nan_to_num(wind).any())
    grid = upper.add_gridspec(4 + windy, 3, width_ratios=(1.35, 1, 1))
    space: Any = upper.add_subplot(grid[:, 0], projection="3d")
    rows = [[upper.add_subplot(grid[k, n]) for k in range(4 + windy)] for n in (1, 2)]
    attitude = _attitude(rollout.quaternion[:, :shown])
    values = {name: rollout.position[:, :shown, k] for k, name in enumerate(PLACE)}
    values |= {"wind [m/s]": np.linalg.norm(wind, axis=-1)} if windy else {}
    values |= {"error [m]": np.maximum(rollout.error[:, :shown], LEAST_ERROR)}
    values |= {name: attitude[..., k] for k, name in enumerate(MOTION)}
    values |= {"airspeed [m/s]": np.linalg.norm(velocity - wind, axis=-1)} if windy else {}
    values |= {"speed [m/s]": np.linalg.norm(velocity, axis=-1)}
    for axis, (name, value) in zip(itertools.chain(*rows), values.items(), strict=True):
        _flights(axis, time, value, colours)
        axis.set_ylabel(name)
        axis.tick_params(labelbottom=axis in (rows[0][-1], rows[1][-1]))
    rows[0][-1].set_yscale("log")
    for column in rows:
        column[-1].set_xlabel("time [s]")
        upper.align_ylabels(column)
    for k, axis in enumerate(rows[0][:3]):
        target = goals[:, :1, k] if shared else goals[..., k]
        _flights(axis, time, target, ["black"] if shared else colours, lw=1.0, ls="--")
    for i, colour in enumerate(colours):
        flown = rollout.position[: rollout.length[i], i]
        ended = "successful" if rollout.is_success[i] else "not successful"
        space.plot(*flown.T, color=colour, lw=1.4, alpha=0.9, label=f"flight {i + 1}, {ended}")
        space.scatter(*flown[:1].T, color=colour, s=18, marker="o")
        goal = goals[: rollout.length[i], i]
        if not shared:
            space.plot(*goal.T, color=colour, lw=1.0, ls="--", alpha=0.8)
        if not shared or i == 0:
            mark = "black" if shared else colour
            space.scatter(*goal[-1:].T, color=mark, marker="*", s=110, label=None)
    dashes, words = ("black", "goal") if shared else (STYLE["grey"], "goal of each flight")
    space.plot([], [], [], color=dashes, lw=1.0, ls="--", marker="*", ms=9, label=words)
    space.set(xlabel=PLACE[0], ylabel=PLACE[1], box_aspect=(1, 1, 1))
    space.set_zlabel(PLACE[2], labelpad=-30)  # inside, clear of the next axes
    space.set_aspect("equal", adjustable="datalim")
    space.legend(frameon=False, loc="upper left", fontsize=8, ncols=2, bbox_to_anchor=(0, 1.07))
    rotors, actions = rollout.rotor_speed.shape[-1], rollout.action.shape[-1]
    many = max(rotors, actions)
    commands: Any = lower.subplots(2, many, sharex=True, sharey="row", squeeze=False)
    parts = (rollout.rotor_speed, "rotor", rotors), (rollout.action, "action", actions)
    for axes, (value, name, count) in zip(commands, parts, strict=True):
        for k, axis in enumerate(axes):
            axis.set_visible(k < count)
            if k < count:
                _flights(axis, time, value[:, :shown, k], colours, lw=0.9)
                axis.set_title(f"{name} {k + 1}", loc="left", fontsize=9)
    commands[0][0].set_ylabel("speed [rad/s]")
    commands[1][0].set(ylabel="action", ylim=(-1.05, 1.05))
    for axis in commands[1]:
        axis.set_xlabel("time [s]")
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
    return save(figure, path)


def _flights(
    axis: Any, time: np.ndarray, values: np.ndarray, colours: Sequence[str], **style: Any
) -> None:
    """Draw values (T, n) over time, a colour each."""
    for value, colour in zip(values.T, colours, strict=True):
        axis.plot(time, value, **({"color": colour, "lw": 1.2, "alpha": 0.85} | style))
    _tidy(axis)


def _attitude(quaternion: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw (..., 3) [deg] of (T, ..., 4); right wing down and nose up are positive.

    Yaw is counted from east to north, and does not jump.
    """
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    roll = np.arctan2(2 * (y * z + w * x), 1 - 2 * (x**2 + y**2))
    pitch = np.arcsin(np.clip(2 * (x * z - w * y), -1, 1))
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)), axis=0)
    return np.degrees(np.stack([roll, pitch, yaw], axis=-1))


def save(figure: Figure, path: Path) -> Path:
    """Write a picture, whole or not at all; its kind is what the name ends in.

    Raises:
        QuadrlError: The name ends in no kind of picture.
    """
    kinds = FigureCanvasAgg(figure).get_supported_filetypes()
    kind = choice(f"ending of {path}", path.suffix.removeprefix(".").lower(), sorted(kinds))
    picture = io.BytesIO()
    # Neither the date nor random names: the same metrics make the same file.
    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
    with matplotlib.rc_context({"svg.hashsalt": "quadrl"}):
        figure.savefig(picture, dpi=DPI, format=kind, metadata=undated)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, picture.getvalue())
    return path


def _tidy(axis: Any) -> None:
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)


def _steps_to_seconds(steps: np.ndarray, seconds: np.ndarray) -> tuple:
    """The functions from the lower axis to the upper one and back; both grow with iterations."""
    x, y = np.concatenate([[0.0], steps]), np.concatenate([[0.0], seconds])
    slope = (y[-1] / x[-1]) if x[-1] else 1.0
    forward = lambda s: np.where(s > x[-1], s * slope, np.interp(s, x, y))  # noqa: E731
    backward = lambda s: np.where(s > y[-1], s / slope, np.interp(s, y, x))  # noqa: E731
    return forward, backward
