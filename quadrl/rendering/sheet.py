"""Contact sheets: moments of flights in one picture."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from quadrl.base.files import write_whole
from quadrl.core.trajectory import Trajectory
from quadrl.rendering.overlay import Panel, grid, require
from quadrl.rendering.scenarios import COMMENT, comment
from quadrl.rendering.video import OneOrMore, OnFrame, checked, listed, render_trajectory

SHEETS = ("png", "jpg", "jpeg")
"""Endings of the names of contact sheets."""
COLUMNS, PICTURES = 4, 12


def write_contact_sheet(
    trajectory: OneOrMore[Trajectory],
    model: OneOrMore[mujoco.MjModel],
    path: str | os.PathLike[str],
    *,
    width: int = 480,
    height: int = 270,
    label: OneOrMore[str] = "",
    on_frame: OnFrame = lambda done, total: None,
    **options: Any,
) -> Path:
    """Write moments of a flight, with their times, as one picture; several have a row each.

    `quadrl.rendering.read_scenarios` reads from it what was flown.

    Args:
        trajectory: The flight, or several.
        model: The drawn model of the aircraft that flew it; one for all, or one for each.
        path: The file, ending in .png, .jpg or .jpeg.
        width: Width of a moment [pixels].
        height: Height of a moment [pixels].
        label: Written beside the first moment, one for each flight.
        on_frame: Called after each moment with the number of those drawn and of all.
        **options: Others of `render_trajectory`: camera, fine.

    Returns:
        The path of the file.

    Raises:
        RenderingUnavailable: There is no graphics library, or no Pillow.
        QuadrlError: The path, the size or the camera does not suit a picture.
    """
    path, kind = checked(path, SHEETS)
    flights = listed(trajectory)
    labels, models = listed(label, len(flights)), listed(model, len(flights))
    count = PICTURES if len(flights) == 1 else COLUMNS
    options = {"fine": True} | options | {"width": width, "height": height, "overlay": False}
    tiles, total = [], count * len(flights)
    for flight, of, text in zip(flights, models, labels, strict=True):
        times = np.linspace(flight.time[0], flight.time[-1], count)
        panel = Panel(height, "", [])
        for k, drawn in enumerate(render_trajectory(flight, of, times=times, **options)):
            tile = drawn.copy()
            words = text * (k == 0), f"{times[k]:.2f} s", flight.outcome * (k == count - 1)
            panel.write(tile, ", ".join(filter(None, words)), 14, 14)
            tiles.append(np.pad(tile, ((1, 1), (1, 1), (0, 0)), constant_values=255))
            on_frame(len(tiles), total)
    sheet = io.BytesIO()
    image = require("PIL.Image").fromarray(grid(tiles, COLUMNS))
    carried = comment(flight.scenario for flight in flights)
    if kind == "png":
        text = require("PIL.PngImagePlugin").PngInfo()
        text.add_text(COMMENT, carried)
        image.save(sheet, format="png", pnginfo=text)
    else:
        image.save(sheet, format="jpeg", quality=90, comment=carried)
    write_whole(path, sheet.getvalue())
    return path
