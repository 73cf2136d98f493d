"""Flights as pictures and as videos."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import secrets
import sys
from collections.abc import Callable, Generator, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadrl.base.errors import QuadrlError, RenderingUnavailable
from quadrl.base.files import in_a_folder
from quadrl.base.validation import number
from quadrl.core.trajectory import Trajectory
from quadrl.rendering import drawing
from quadrl.rendering.camera import (
    FOLLOW,
    MOVING,
    SMOOTHING,
    keeping,
    moving_camera,
    moving_views,
    smoothed,
)
from quadrl.rendering.drawing import TRAIL_SECONDS, streaks
from quadrl.rendering.overlay import Panel, flight_lines, grid, require, task_title
from quadrl.rendering.scenarios import COMMENT, comment, ffmpeg, put_into_gif
from quadrl.rendering.scene import Renderer

T = TypeVar("T")
OneOrMore = T | Sequence[T]
OnFrame = Callable[[int, int], object]
"""Called with the number of pictures that are drawn, and of all."""
MAX_FPS = 240
LARGEST = {"width": 1920, "height": 1080}  # pixels, as assets/scene.xml makes room for
FFMPEG = ("-preset", "veryfast", "-movflags", "+faststart")
LEAST_RATE = 20.0  # [1/s], at which the states of a flight are interpolated
HOLD = 1.0  # [s] that a video shows its last picture, for the outcome to be read
VIDEOS = ("mp4", "gif")
"""Endings of the names of videos."""


def render_trajectory(
    trajectory: Trajectory,
    model: mujoco.MjModel,
    *,
    width: int = 848,
    height: int = 480,
    fps: float = 20.0,
    camera: str | mujoco.MjvCamera = FOLLOW,
    overlay: bool = True,
    label: str = "",
    times: ArrayLike | None = None,
    fine: bool | None = None,
    speed_trail: bool = False,
) -> Generator[NDArray[np.uint8]]:
    """Draw a flight.

    Args:
        trajectory: The flight.
        model: The drawn model of the aircraft that flew it.
        width: Width of the pictures [pixels].
        height: Height of the pictures [pixels].
        fps: Pictures a second; the recorded states are interpolated.
        camera: "follow", "chase", a camera of the model, or one of your own.
        overlay: Show time, error, speed, reward, wind, horizon, rotor speeds and the outcome.
        label: Title of the panel in place of the task's name.
        times: Increasing moments to draw [s]; None for the whole flight, `fps` a second. Beyond its
            ends a flight stands still.
        fine: As for `Renderer`.
        speed_trail: Show the whole way so far in the colours of its speeds, from blue at rest to
            yellow at the fastest, in place of the last seconds.

    Yields:
        Pictures (height, width, 3).

    Raises:
        RenderingUnavailable: There is no graphics library, or no Pillow for the overlay.
        QuadrlError: The size, the frame rate or the camera is out of range.
    """
    from scipy.integrate import cumulative_trapezoid

    number("fps", fps, 1, MAX_FPS)
    # Speed, trail and camera are those of the flight however few pictures are drawn of it.
    every = math.ceil(LEAST_RATE / fps)
    rate = every * fps
    flight = trajectory.resampled(rate)
    position, last = flight.qpos[:, :3], len(flight.time) - 1
    drawn = np.arange(0, last + 1, every)
    if times is not None:
        drawn = np.searchsorted(flight.time, np.asarray(times) - 0.5 / rate).clip(max=last)
    speed = np.zeros(len(position))
    if len(position) > 1:
        speed = np.linalg.norm(np.gradient(position, flight.time, axis=0), axis=1)
    windy = flight.wind is not None
    wind = np.zeros_like(position) if flight.wind is None else flight.wind
    drift, turned = (
        cumulative_trapezoid(each, flight.time, axis=0, initial=0)
        for each in (wind, flight.rotor_speed)
    )
    strength = np.linalg.norm(wind, axis=1)
    markers, events = flight.markers, flight.events
    if len(markers) == 1:
        markers = [markers[0]] * len(position)
    if len(events) == 1:
        events = [events[0]] * len(position)
    with Renderer(model, width, height, fine=fine) as renderer:
        angles = renderer.spins * turned
        cameras: Sequence[str | mujoco.MjvCamera] = [camera] * len(position)
        if isinstance(camera, str) and camera in MOVING:
            seen = flight.qpos, flight.goal, markers
            views = moving_views(camera, *seen, renderer.scale, renderer.aspect)
            views = smoothed(views, SMOOTHING * rate)
            views = keeping(views, position, renderer.scale, renderer.aspect)
            cameras = [moving_camera(view) for view in views]
        panel = None
        if overlay:
            colours = [model.mat(f"rotor_{k + 1}_paint").rgba[:3] for k in range(model.nu)]
            panel = Panel(height, label or task_title(flight.task), colours, windy)
        for k, same in itertools.groupby(map(int, drawn)):
            first = max(0, k - round(TRAIL_SECONDS * rate))
            shown = streaks(position[k], wind[k], drift[k], renderer.scale)
            if speed_trail:
                way = position[: k + 1], speed[: k + 1], speed.max()
                shown = (drawing.speed_trail(*way, renderer.scale), *shown)
            picture = renderer.frame(
                flight.qpos[k],
                camera=cameras[k],
                rotor_angles=angles[k],
                goal=flight.goal[k],
                trail=None if speed_trail else position[first : k + 1],
                markers=(*markers[k], *shown),
            )
            if panel is not None:
                moment = flight.time[k], flight.error[k], speed[k], flight.reward[k]
                values = flight_lines(*moment, strength[k] if windy else None)
                shares = flight.rotor_speed[k] / flight.max_rotor_speed
                end = flight.outcome if k == last else ""
                panel.draw(picture, [*values.values()], shares, flight.qpos[k, 3:], end, events[k])
            for _ in same:
                yield picture


def write_video(
    trajectory: OneOrMore[Trajectory],
    model: OneOrMore[mujoco.MjModel],
    path: str | os.PathLike[str],
    *,
    fps: float = 20.0,
    label: OneOrMore[str] = "",
    on_frame: OnFrame = lambda done, total: None,
    **options: Any,
) -> Path:
    """Write a flight as an MP4 (H.264, yuv420p) or a GIF. An unfinished file has another name.

    The file carries what was flown, which `quadrl.rendering.read_scenarios` reads from it.

    Several flights are shown side by side; one that is over waits for the others. Ten seconds of
    flight at the defaults cost about 10 s of CPU time without a graphics card.

    Args:
        trajectory: The flight, or several.
        model: The drawn model of the aircraft that flew it; one for all, or one for each.
        path: The file, ending in .mp4 or .gif.
        fps: Frames a second.
        label: Titles in place of the task's name; one for each flight.
        on_frame: Called after each frame with the number of those drawn and of all.
        **options: The others of `render_trajectory`; width and height are those of one flight, and
            must be even for an MP4.

    Returns:
        The path of the file.

    Raises:
        RenderingUnavailable: There is no graphics library, no Pillow or no ffmpeg.
        QuadrlError: The path, the size, the frame rate or the camera does not suit a video.
    """
    path, kind = checked(path, VIDEOS)
    for name in ("width", "height"):
        if kind == "mp4" and number(name, options.get(name, 2), 1, LARGEST[name], whole=True) % 2:
            raise QuadrlError(name=name, value=options[name], allowed="even for a video")
    flights = listed(trajectory)
    start, end = min(one.time[0] for one in flights), max(one.time[-1] for one in flights)
    number("fps", fps, 1, MAX_FPS)
    times = np.arange(start, end + 1e-9, 1 / fps)
    if any(flight.outcome for flight in flights):
        times = np.append(times, end + np.arange(1, 1 + round(HOLD * fps)) / fps)
    encoding: dict[str, Any] = {"codec": "gif"}
    carried = comment(flight.scenario for flight in flights)
    if kind == "mp4":
        command = (*FFMPEG, "-metadata", f"{COMMENT}={carried}")
        encoding = dict(crf=20, encoded_format="yuv420p", ffmpeg_args=command)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(8)}.{kind}")
    drawn = _together(flights, model, label, fps=fps, times=times, **options)
    with contextlib.closing(drawn) as frames:
        first = next(frames)  # what cannot be drawn fails here, before ffmpeg begins
        writer = _mediapy().VideoWriter(temporary, first.shape[:2], fps=fps, **encoding)
        try:
            writer.__enter__()
            with contextlib.suppress(BrokenPipeError):  # ffmpeg says itself why it stopped
                for k, frame in enumerate(itertools.chain([first], frames)):
                    writer.add_image(frame)
                    on_frame(k + 1, len(times))
            writer.close()
            if kind == "gif":
                put_into_gif(temporary, carried)
            os.replace(temporary, path)
        except RuntimeError as error:
            raise RenderingUnavailable(f"{path} could not be written: {error}") from error
        finally:
            with contextlib.suppress(RuntimeError):  # the first failure is the one to raise
                writer.close()
            temporary.unlink(missing_ok=True)
    return path


def help_notebooks() -> None:
    """Let `mediapy.show_video` find an ffmpeg, where mediapy is imported or a notebook runs."""
    if {"mediapy", "IPython"} & sys.modules.keys():
        with contextlib.suppress(RenderingUnavailable):  # there is no mediapy, or no ffmpeg
            _mediapy()


def _together(
    flights: Sequence[Trajectory], model: Any, label: Any, **options: Any
) -> Generator[NDArray[np.uint8]]:
    """Pictures of one flight, or of several side by side."""
    labels, models = listed(label, len(flights)), listed(model, len(flights))
    drawings = [
        render_trajectory(flight, of, label=text, **options)
        for flight, of, text in zip(flights, models, labels, strict=True)
    ]
    with contextlib.ExitStack() as stack:
        for drawing in drawings:
            stack.enter_context(contextlib.closing(drawing))
        for pictures in zip(*drawings, strict=True):
            yield pictures[0] if len(pictures) == 1 else grid(pictures)


def listed(one_or_more: Any, count: int = 1) -> list[Any]:
    """A list of several, or of one repeated as often as it is needed."""
    several = isinstance(one_or_more, Iterable) and not isinstance(one_or_more, str)
    return list(one_or_more) if several else [one_or_more] * count


def checked(path: str | os.PathLike[str], kinds: Sequence[str]) -> tuple[Path, str]:
    """A path in a folder that exists, which ends in one of some kinds, and the kind."""
    path = Path(path)
    kind = path.suffix.removeprefix(".").lower()
    if kind not in kinds or path.is_dir():
        allowed = f"the name of a file ending in .{' or .'.join(kinds)}"
        raise QuadrlError(name="path", value=str(path), allowed=allowed)
    return in_a_folder(path), kind


def _mediapy() -> Any:
    """Import mediapy and tell it where ffmpeg is."""
    mediapy = require("mediapy")
    mediapy.set_ffmpeg(ffmpeg())
    return mediapy
