"""Overlays of a picture: a panel in its corner, the outcome, a time stamp."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadrl.base.errors import RenderingUnavailable
from quadrl.base.extras import needed
from quadrl.base.rotation import Array, roll_pitch_yaw
from quadrl.base.units import LENGTHS, length
from quadrl.core.trajectory import FAILURE, SUCCESS, TIME_OVER
from quadrl.rendering.horizon import horizon

MARGIN, HEIGHT = 18, 146  # [pixels] at a height of 720, as are those below
SMALL, USUAL, LARGE = 15, 17, 20  # print
FIRST, LINE = 43, 23  # where the lines begin, and from one to the next
DIAL, DIAL_LEFT = 90, 194  # diameter of the horizon, and where it begins
BARS, BAR = 302, 21  # where the bars begin, and from one to the next
TOP, BOTTOM, BELOW = 17, 108, 113  # of the bars, and of what is written below them
CHIP = 42  # from a line below the panel to the next
ROOM = 0.8  # share of a picture's width that the panel may take
GREY, WHITE, DARK = (150, 163, 180), (236, 240, 246), (44, 52, 64)
OUTCOMES = {SUCCESS: (38, 148, 84), FAILURE: (196, 58, 54), TIME_OVER: (176, 124, 30)}


class Panel:
    """A panel of values, drawn into pictures of one height."""

    def __init__(
        self, height: int, title: str, colours: Sequence[Sequence[float]], windy: bool = False
    ) -> None:
        """Lay it out.

        Args:
            height: Height of the pictures [pixels].
            title: Its first line; cut where it is too long.
            colours: Red, green and blue (0 to 1) of each rotor's bar.
            windy: Whether it has a line for the wind.
        """
        self._image, self._draw, font = (
            require(f"PIL.{name}") for name in ("Image", "ImageDraw", "ImageFont")
        )
        self._scale = max(height / 720, 0.8)  # 12 pixels: smaller print cannot be read
        self._colours = [tuple(round(255 * part) for part in colour) for colour in colours]
        self._fonts = {k: font.load_default(size=k * self._scale) for k in (SMALL, USUAL, LARGE)}
        room = (DIAL_LEFT - 22) * self._scale
        while self._fonts[LARGE].getlength(title) > room and len(title) > 2:
            title = title.rstrip("…")[:-1] + "…"
        # What stays is drawn once.
        labels = flight_lines(wind=0.0 if windy else None)
        self._height = HEIGHT + LINE * windy
        width = BARS + BAR * len(colours) + 12
        self._background = self._rounded(width, self._height, 14, (13, 18, 26))
        draw = self._draw.Draw(self._background)
        self._write(draw, 16, 11, title, LARGE, (255, 255, 255))
        for row, label in enumerate(labels):
            self._write(draw, 16, FIRST + LINE * row, label, USUAL, GREY)
        for rotor in range(len(colours)):
            self._write(draw, BARS + BAR * rotor + 6, BELOW, str(rotor + 1), SMALL, GREY, "ma")

    def fits(self, width: int, height: int) -> bool:
        """Whether it is small enough for a picture."""
        own_width, own_height = self._background.size
        return own_width <= ROOM * width and own_height <= ROOM * height / 2

    def draw(
        self,
        picture: NDArray[np.uint8],
        values: Sequence[str],
        shares: ArrayLike,
        attitude: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        outcome: str = "",
        events: str = "",
    ) -> None:
        """Draw into a picture, in place.

        Args:
            picture: (height, width, 3).
            values: Those of `flight_lines`, one below the other.
            shares: Speeds of the rotors (R,), 1 at most.
            attitude: (w, x, y, z), for the horizon.
            outcome: How the episode ended.
            events: What has happened to the aircraft.
        """
        margin = round(MARGIN * self._scale)
        width, height = self._background.size
        corner = picture[margin : margin + height, margin : margin + width]
        image = self._image.fromarray(corner)
        image.paste(self._background, mask=self._background)
        dial, cover = horizon(round(DIAL * self._scale), np.asarray(attitude, dtype=float))
        cover = self._image.fromarray(cover)
        image.paste(self._image.fromarray(dial), self._at(DIAL_LEFT, TOP - 2), cover)
        draw = self._draw.Draw(image)

        for row, value in enumerate(values):
            self._write(draw, DIAL_LEFT - 16, FIRST + LINE * row, value, USUAL, WHITE, "ra")
        middle, heading = DIAL_LEFT + DIAL / 2, f"{bearing(attitude):03.0f}°"
        self._write(draw, middle, BELOW, heading, SMALL, GREY, "ma")
        for rotor, share in enumerate(np.clip(shares, 0, 1)):
            left, level = BARS + BAR * rotor, BOTTOM - float(share) * (BOTTOM - TOP)
            for upper, fill in ((TOP, DARK), (level, self._colours[rotor])):
                draw.rectangle((*self._at(left, upper), *self._at(left + 12, BOTTOM)), fill=fill)
        corner[:] = np.asarray(image)
        below = MARGIN + self._height + 10
        for text, fill in ((events, DARK), (outcome, OUTCOMES.get(outcome, DARK))):
            if text:
                self.write(picture, text, MARGIN, below, fill, 225)
                below += CHIP

    def write(
        self,
        picture: NDArray[np.uint8],
        text: str,
        left: float,
        top: float,
        fill: tuple[int, ...] = (13, 18, 26),
        opacity: int = 165,
    ) -> None:
        """Write a line of text, on a rounded background, into a picture in place."""
        x, y = self._at(left, top)
        font = self._fonts[LARGE]
        ground = self._rounded(font.getlength(text) / self._scale + 32, 34, 17, fill, opacity)
        place = picture[y : y + ground.height, x : x + ground.width]
        image = self._image.fromarray(place)
        image.paste(ground, mask=ground)
        middle = ground.width / 2, ground.height / 2
        self._draw.Draw(image).text(middle, text, font=font, fill=(255, 255, 255), anchor="mm")
        place[:] = np.asarray(image)

    def _write(
        self, draw: Any, x: float, y: float, text: str, size: int, fill: tuple, anchor: str = "la"
    ) -> None:
        draw.text(self._at(x, y), text, font=self._fonts[size], fill=fill, anchor=anchor)

    def _rounded(
        self, width: float, height: float, radius: float, fill: tuple[int, ...], opacity: int = 165
    ) -> Any:
        """A rectangle with round corners; drawn larger and then reduced, for a smooth edge."""
        width, height = self._at(width, height)
        large = self._image.new("RGBA", (4 * width, 4 * height), (*fill, 0))
        box, corner = (0, 0, 4 * width - 1, 4 * height - 1), round(4 * radius * self._scale)
        self._draw.Draw(large).rounded_rectangle(box, corner, fill=(*fill, opacity))
        return large.resize((width, height))

    def _at(self, x: float, y: float) -> tuple[int, int]:
        return round(x * self._scale), round(y * self._scale)


def flight_lines(
    time: float = 0.0,
    error: float = 0.0,
    speed: float = 0.0,
    reward: float = 0.0,
    wind: float | None = None,
) -> dict[str, str]:
    """Lines of the panel, by label: time [s], error [m], speed [m/s] and reward of the last step.

    There is one for the wind [m/s] where that is not None.
    """
    return {
        "time": f"{time:.2f} s",
        "error": length(error, LENGTHS[:-1]),  # the font has no µ
        "speed": f"{speed:.2f} m/s",
        "reward": f"{reward:+.2f}",
        **({} if wind is None else {"wind": f"{wind:.1f} m/s"}),
    }


def task_title(task: str) -> str:
    """The name of a task as a title."""
    return task.replace("_", " ").capitalize()


def bearing(attitude: ArrayLike) -> float:
    """Heading as a compass shows it: 0 north, 90 east [deg]."""
    yaw = roll_pitch_yaw(np.asarray(attitude, dtype=float))[2]
    return round(90.0 - math.degrees(yaw)) % 360


def grid(pictures: Sequence[Array], columns: int = 0) -> Array:
    """Pictures of one size side by side; by default in as many rows as columns or one less."""
    columns = columns or math.ceil(math.sqrt(len(pictures)))
    blank = np.zeros_like(pictures[0])
    filled = [*pictures, *[blank] * (-len(pictures) % columns)]
    return np.vstack([np.hstack(filled[k : k + columns]) for k in range(0, len(filled), columns)])


def require(module: str) -> Any:
    """A module that only pictures need; RenderingUnavailable if its package is not installed."""
    try:
        with needed("drawing"):
            return importlib.import_module(module)
    except ImportError as error:
        raise RenderingUnavailable(str(error)) from error
