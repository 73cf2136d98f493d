"""Pictures of a robustness card: success and error over each disturbance, and recovery maps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from quadrl.evaluation.plotting import COLOURS, GREY, LEAST_ERROR, head, styled, tidy

MARKS, DASHES = "osD^vPX*", ("-", "--", "-.", ":", "-", "--", "-.", ":")
COLUMNS = 5
PANEL, GAP = (2.45, 3.1), 1.1  # [inches]
HATCHED: Any = {"fc": "none", "hatch": "////", "lw": 0.0, "alpha": 0.45}
NEAR = 0.5  # of the span of the levels: so far beyond them it is drawn where actions end
BANDS = 3  # as many can be told apart
SHADES = "cividis"


@styled
def card(found: Mapping[str, Any]) -> Figure:
    """Success with its interval over error with its quartiles, a column for each disturbance.

    A ring marks where half of the flights fail. Levels at which no aircraft can hover are shaded,
    those at which actions do not reach as far are hatched.
    """
    axes, flown = found["axes"], found["flown"]
    columns = min(COLUMNS, len(axes))
    rows = math.ceil(len(axes) / columns)
    size = max(columns * PANEL[0], 2 * PANEL[0]), rows * PANEL[1] + GAP
    figure = Figure(figsize=size, layout="constrained")
    shared: Any = {"sharey": "row", "squeeze": False, "height_ratios": [1.25, 1] * rows}
    grid: Any = figure.subplots(2 * rows, columns, **shared)
    for k, axis in enumerate(axes.values()):
        row, column = divmod(k, columns)
        upper, lower = grid[2 * row, column], grid[2 * row + 1, column]
        _panels(upper, lower, axis, flown)
        if column == 0:
            upper.set_ylabel("success [%]")
            lower.set_ylabel("error [m]")
    for panel in grid.flat:
        panel.set_visible(panel.has_data())
    words = f"{found['task']}, aircraft {found['vehicle']}, {found['episodes']} flights a level"
    hatched = any(_beyond(axis, name) for axis in axes.values() for name in flown)
    _head(figure, words, hatched, *grid[0, 0].get_legend_handles_labels())
    return figure


def _panels(upper: Any, lower: Any, axis: Mapping[str, Any], flown: list[str]) -> None:
    """Success and error over one disturbance."""
    levels = np.array(axis["levels"])
    for i, name in enumerate(flown):
        reached = axis["flown"][name]
        known = np.array([share is not None for share in reached["success"]])
        x, colour = levels[known], COLOURS[i % len(COLOURS)]
        share, low, high = (
            100 * np.array([y for y in reached[which] if y is not None])
            for which in ("success", "low", "high")
        )
        line = {"color": colour, "ls": DASHES[i % len(DASHES)], "lw": 1.4}
        line |= {"marker": MARKS[i % len(MARKS)], "ms": 3.5}
        upper.plot(x, share, label=name, **line)
        bars = np.maximum([share - low, high - share], 0)
        upper.errorbar(x, share, bars, fmt="none", ecolor=colour, elinewidth=0.9, capsize=1.8)
        quartiles = np.array([y for y in reached["error_m"] if y is not None])
        quartiles = np.maximum(quartiles, LEAST_ERROR)
        lower.plot(x, quartiles[:, 1], **line)
        if len(flown) <= BANDS:
            lower.fill_between(x, *quartiles[:, [0, 2]].T, color=colour, alpha=0.15, lw=0)
        for half in (level for level in reached["half"] if level is not None):
            ring = {"marker": "o", "ms": 8, "mfc": "none", "mew": 1.6, "color": colour}
            upper.plot([half], [50], ls="none", zorder=5, **ring)
        unknown = _outside(levels[0], levels[-1], x[0], x[-1])
        for panel, span in itertools.product((upper, lower), unknown):
            panel.axvspan(*span, color=GREY, alpha=0.18, lw=0)
    _hatch((upper, lower), axis, flown)
    upper.axhline(50, color=GREY, lw=0.7, zorder=0)
    upper.set(ylim=(-4, 104), yticks=(0, 25, 50, 75, 100))
    upper.set_title(axis["label"], loc="left", fontweight="bold")
    lower.set_yscale("log")
    lower.set_xlabel(f"[{axis['unit']}]" if "of" not in axis["unit"] else f"{axis['unit']}")
    for panel in (upper, lower):
        panel.set_xlim(*_view(axis))
        tidy(panel)
        if axis["usual"] != levels[0]:
            panel.axvline(axis["usual"], color=GREY, lw=0.7, zorder=0)
    upper.tick_params(labelbottom=False)


def _view(axis: Mapping[str, Any]) -> tuple[float, float]:
    """The levels with a margin on both sides, and with where actions end if that is near."""
    first, last = axis["levels"][0], axis["levels"][-1]
    margin, far = 0.03 * (last - first), NEAR * (last - first)
    ends = (end for pair in axis["reach"].values() for end in pair if end is not None)
    near = [end for end in ends if first - far < end < last + far]
    low = min([first - margin, *(end - 3 * margin for end in near if end < axis["usual"])])
    high = max([last + margin, *(end + 3 * margin for end in near if end > axis["usual"])])
    return low, high


def _beyond(axis: Mapping[str, Any], name: str) -> list[tuple[float, float]]:
    """Stretches of the view that the actions of one that flew do not reach."""
    (start, end), (low, high) = _view(axis), axis["reach"].get(name, (None, None))
    return _outside(start, end, start if low is None else low, end if high is None else high)


def _hatch(panels: tuple[Any, Any], axis: Mapping[str, Any], flown: list[str]) -> None:
    """Hatch what actions do not reach, in grey where that is the same for all."""
    alike: dict[tuple[tuple[float, float], ...], list[str]] = {}
    for name in flown:
        alike.setdefault(tuple(_beyond(axis, name)), []).append(name)
    for spans, names in alike.items():
        index = flown.index(names[0])
        colour = GREY if len(names) == len(flown) else COLOURS[index % len(COLOURS)]
        for panel, (start, end) in itertools.product(panels, spans):
            panel.axvspan(start, end, **HATCHED, ec=colour, zorder=0)


def _outside(start: float, end: float, low: float, high: float) -> list[tuple[float, float]]:
    """The parts of a stretch that lie below and above two levels."""
    return [(first, last) for first, last in ((start, low), (high, end)) if first < last]


@styled
def maps(found: Mapping[str, Any]) -> Figure:
    """Share of flights that recover: a row for each that flew, a column for each map."""
    charts, flown = found["recovery"], found["flown"]
    size = 3.4 * len(charts) + 0.8, 2.75 * len(flown) + 0.5
    figure = Figure(figsize=size, layout="constrained")
    grid: Any = figure.subplots(len(flown), len(charts), squeeze=False)
    shown: Any = None
    for row, name in zip(grid, flown, strict=True):
        for axis, chart in zip(row, charts.values(), strict=True):
            x, y = (np.array(chart[side]["levels"]) for side in "xy")
            share = 100 * np.array(chart["flown"][name])
            shown = axis.pcolormesh(x, y, share, vmin=0, vmax=100, cmap=SHADES, shading="nearest")
            if share.min() < 50 < share.max():
                axis.contour(x, y, share, levels=[50], colors="white", linewidths=1.6)
            x_side, y_side = chart["x"], chart["y"]
            axis.set_ylabel(f"{y_side['label']} [{y_side['unit']}]")
            axis.set_xlabel(f"{x_side['label']} [{x_side['unit']}]")
            axis.set_title(name, loc="left", fontweight="bold")
            if x_side["unit"] == "deg":
                axis.set_xticks(range(0, 181, 45))
    bar = figure.colorbar(shown, ax=grid, shrink=min(1.0, 1.2 / len(flown) + 0.3), pad=0.015)
    bar.set_label("flights that recover [%]; white line: half")
    bar.outline.set_visible(False)
    head(figure, f"Starts that recover, task {found['task']}, aircraft {found['vehicle']}")
    return figure


def _head(figure: Figure, words: str, hatched: bool, handles: list[Any], names: list[str]) -> None:
    """The title, and what each line is, above the panels."""
    head(figure, words)
    ring = Line2D([], [], color=GREY, marker="o", ms=8, mfc="none", ls="none")
    marks: dict[str, Any] = {"half of the flights fail": ring}
    if hatched:
        marks["beyond the reach of the actions (no level hover)"] = Patch(**HATCHED, ec=GREY)
    columns = max(1, min(4, round(figure.get_figwidth() / PANEL[0]) - 1))
    legend: dict[str, Any] = {"loc": "outside lower left", "ncols": columns, "frameon": False}
    figure.legend([*handles, *marks.values()], [*names, *marks], **legend)
