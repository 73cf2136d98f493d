"""Pictures of predictions over measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from quadrl.aircraft.vehicle import Vehicle
from quadrl.evaluation import plotting
from quadrl.evaluation.open_loop import HORIZONS, Window, fly, measured

PANELS = {
    "body_rate": [f"{axis} rate [rad/s]" for axis in ("roll", "pitch", "yaw")],
    "velocity": [f"velocity {axis} [m/s]" for axis in ("x", "y", "up")],
}
"""What a picture shows, by quantity: a label for each axis."""
COLOURS = (plotting.BLACK, plotting.ORANGE, plotting.BLUE, plotting.GREEN)
EVERY = 0.01  # [s] between two points of a prediction


@plotting.styled
def picture(
    where: Window, models: Mapping[str, Vehicle], panels: Sequence[tuple[str, int, str]] = ()
) -> Figure:
    """Predictions of half a second after each other, over what was measured.

    Args:
        where: Windows that follow each other.
        models: Up to three aircraft by name.
        panels: Quantity, axis and label of each panel; all of PANELS that were logged by default.
    """
    times = (np.arange(1, round(HORIZONS[-1] / EVERY) + 1) * EVERY).tolist()
    motions = {"measured": measured([where], times)}
    motions |= {name: fly(vehicle, [where], times) for name, vehicle in models.items()}
    known = ((q, k, label) for q, labels in PANELS.items() for k, label in enumerate(labels))
    panels = panels or [panel for panel in known if panel[0] in motions["measured"]]
    size = (8.0, 2.6 if len(panels) == 1 else 0.5 + 1.4 * len(panels))
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (quantity, axis, label) in zip(grid, panels, strict=True):
        for (model, motion), colour in zip(motions.items(), COLOURS, strict=False):
            lines = axes.plot(
                where[1] + np.array(times)[:, None], motion[quantity][..., axis], color=colour
            )
            lines[0].set_label(model)
        low, high = np.quantile(motions["measured"][quantity][..., axis], (0, 1))
        limits = low - (high - low) / 2, high + (high - low) / 2
        axes.set(ylabel=label, ylim=limits)
        plotting.tidy(axes)
    grid[0].legend(frameon=False, ncols=3)
    grid[-1].set_xlabel("time [s]")
    return figure


def draw(path: Path, where: Window, models: Mapping[str, Vehicle]) -> Path:
    """Write a `picture`, as `plotting.save` does."""
    return plotting.save(picture(where, models), path)
