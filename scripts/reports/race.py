"""Show finished races: how fast, how surely, beside what others have published."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from matplotlib.figure import Figure

from quadrl.base.units import quantity
from quadrl.evaluation.plotting import BLUE, GREY, ORANGE, styled, tidy
from scripts.reports.report import Result


@styled
def picture(
    title: str,
    rows: Iterable[Result],
    published: Mapping[str, tuple[float, float]],
    in_time: float,
    enough: float,
) -> Figure:
    """Time from rest to the last gate, and the share of the flights that reach it.

    Args:
        title: What is flown, and by whom.
        rows: What policies of quadrl reached.
        published: Share and time [s] of others, by their name.
        in_time: What is asked for [s].
        enough: The share of the flights that is asked for.
    """
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axis: Any = figure.subplots()
    for k, (label, (success, time)) in enumerate(published.items()):
        axis.plot(time, 100 * success, "s", color=GREY)
        # The first to the left, since quadrl's are on its right; then above and below in turn.
        place, side = ((6, (-9, 5)[k % 2]), "left") if k else ((-6, -9), "right")
        how = {"textcoords": "offset points", "ha": side, "size": 7}
        axis.annotate(label, (time, 100 * success), place, **how)
    for row in rows:
        axis.plot(row["race_time_mean_s"], 100 * row["success_rate"], "o", color=BLUE)
    axis.axvline(in_time, color=ORANGE, lw=0.8)
    axis.axhline(100 * enough, color=ORANGE, lw=0.8)
    times = [in_time, *(time for _, time in published.values())]
    axis.set(xlabel="time [s]", ylabel="successful [%]", title=title)
    axis.set(xlim=(min(times) - 0.6, max(times) + 0.3), ylim=(40, 104))
    tidy(axis)
    return figure


def shown(name: str, value: float) -> str:
    """A figure; hundredths of a second decide races."""
    return f"{value:.2f} s" if name.endswith("_s") else quantity(name, value)
