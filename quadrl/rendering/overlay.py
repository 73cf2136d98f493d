"""The small panel in the corner of a video: labelled values and a bar for each rotor's speed."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadrl.errors import RenderingUnavailable

MARGIN, HEIGHT, BARS, BAR = 18, 138, 190, 21  # [pixels] at a height of 720; where bars begin
TOP, BOTTOM = 17, 103  # of the bars [pixels]
GREY, WHITE, DARK = (150, 163, 180), (236, 240, 246), (44, 52, 64)


class Panel:
    """Draws itself into pictures of one height."""

    def __init__(self, height: int, title: str, colours: Sequence[Sequence[float]]) -> None:
        """Lay it out.

        Args:
            height: Of the pictures [pixels].
            title: Its first line.
            colours: Red, green and blue (0 to 1) of each rotor's bar.
        """
        self._image, self._draw, font = (
            require(f"PIL.{name}", "Pillow") for name in ("Image", "ImageDraw", "ImageFont")
        )
        self._scale = max(height / 720, 0.72)  # smaller print cannot be read
        self._title = title.replace("_", " ").capitalize()
        self._colours = [tuple(round(255 * part) for part in colour) for colour in colours]
        self._fonts = {k: font.load_default(size=k * self._scale) for k in (13, 15, 18)}
        width, height = self._at(BARS + BAR * len(colours) + 12, HEIGHT)
        large = self._image.new("RGBA", (4 * width, 4 * height), (13, 18, 26, 0))
        box, corner = (0, 0, 4 * width - 1, 4 * height - 1), round(56 * self._scale)
        self._draw.Draw(large).rounded_rectangle(box, corner, fill=(13, 18, 26, 165))
        self._background = large.resize((width, height))  # drawn larger, for a smooth edge

    def draw(
        self, picture: NDArray[np.uint8], lines: Sequence[tuple[str, str]], shares: ArrayLike
    ) -> None:
        """Draw labelled values and rotor speeds (R,), 1 at most, into a picture, in place."""
        margin = round(MARGIN * self._scale)
        width, height = self._background.size
        corner = picture[margin : margin + height, margin : margin + width]
        image = self._image.fromarray(corner)
        image.paste(self._background, mask=self._background)
        draw = self._draw.Draw(image)

        def write(
            x: float, y: float, text: str, size: int, fill: tuple, anchor: str = "la"
        ) -> None:
            draw.text(self._at(x, y), text, font=self._fonts[size], fill=fill, anchor=anchor)

        write(16, 11, self._title, 18, (255, 255, 255))
        for row, (label, value) in enumerate(lines):
            write(16, 41 + 21 * row, label, 15, GREY)
            write(166, 41 + 21 * row, value, 15, WHITE, "ra")
        for rotor, share in enumerate(np.clip(shares, 0, 1)):
            left, level = BARS + BAR * rotor, BOTTOM - float(share) * (BOTTOM - TOP)
            for upper, fill in ((TOP, DARK), (level, self._colours[rotor])):
                draw.rectangle((*self._at(left, upper), *self._at(left + 12, BOTTOM)), fill=fill)
            write(left + 6, 109, str(rotor + 1), 13, GREY, "ma")
        corner[:] = np.asarray(image)

    def _at(self, x: float, y: float) -> tuple[int, int]:
        return round(x * self._scale), round(y * self._scale)


def require(module: str, package: str) -> Any:
    """A module that only videos need; RenderingUnavailable if its package is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise RenderingUnavailable(
            f"videos need {package}: install the extra `video` of quadrl; simulation and training "
            "work without it"
        ) from error
