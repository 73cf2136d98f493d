"""Flights as pictures and as videos."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import shutil
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from quadrl.errors import QuadrlError, RenderingUnavailable
from quadrl.rendering.camera import FOLLOW, SMOOTHING, aircraft_scale, follow_cameras, in_view
from quadrl.rendering.overlay import Panel, require
from quadrl.rendering.scene import Renderer
from quadrl.rendering.trajectory import Trajectory
from quadrl.validation import number

TRAIL_SECONDS = 4.0
MAX_FPS = 240
FFMPEG = "-preset veryfast -movflags +faststart"
LEAST_RATE = 20.0  # [1/s], at which a flight is followed


def render_trajectory(
    trajectory: Trajectory,
    model: mujoco.MjModel,
    *,
    width: int = 848,
    height: int = 480,
    fps: float = 25.0,
    camera: str = FOLLOW,
    overlay: bool = True,
) -> Generator[NDArray[np.uint8]]:
    """Draw a flight.

    Args:
        trajectory: What was flown.
        model: The drawn model of the aircraft that flew it.
        width: Of the pictures [pixels].
        height: Of the pictures [pixels].
        fps: Pictures a second; the recorded states are interpolated.
        camera: "follow", or a camera of the model.
        overlay: Show time, error, speed, reward and rotor speeds.

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
    position = flight.qpos[:, :3]
    spins = -np.sign(model.actuator_gear[:, 5])  # the aircraft feels the opposite torque
    angles = spins * cumulative_trapezoid(flight.rotor_speed, flight.time, axis=0, initial=0)
    speed = np.zeros(len(position))
    if len(position) > 1:
        speed = np.linalg.norm(np.gradient(position, flight.time, axis=0), axis=1)
    markers = flight.markers
    if len(markers) == 1:
        markers = [markers[0]] * len(position)
    cameras: Sequence[str | mujoco.MjvCamera] = [camera] * len(position)
    if camera == FOLLOW:
        shown = [in_view(*seen) for seen in zip(flight.goal, markers, strict=True)]
        cameras = follow_cameras(position, shown, SMOOTHING * rate, aircraft_scale(model))
    panel = None
    if overlay:
        colours = [model.mat(f"rotor_{k + 1}_paint").rgba[:3] for k in range(model.nu)]
        panel = Panel(height, flight.task, colours)
    with Renderer(model, width, height) as renderer:
        for k in range(0, len(position), every):
            picture = renderer.frame(
                flight.qpos[k],
                camera=cameras[k],
                rotor_angles=angles[k],
                goal=flight.goal[k],
                trail=position[max(0, k - round(TRAIL_SECONDS * rate)) : k + 1],
                markers=markers[k],
            )
            if panel is not None:
                lines = (
                    ("time", f"{flight.time[k]:.2f} s"),
                    ("error", f"{flight.error[k]:.2f} m"),
                    ("speed", f"{speed[k]:.2f} m/s"),
                    ("reward", f"{flight.reward[k]:+.2f}"),
                )
                panel.draw(picture, lines, flight.rotor_speed[k] / flight.max_rotor_speed)
            yield picture


def write_video(
    trajectory: Trajectory,
    model: mujoco.MjModel,
    path: str | os.PathLike[str],
    *,
    fps: float = 25.0,
    **options: Any,
) -> Path:
    """Write a flight as an MP4 (H.264, yuv420p). An unfinished file never has its final name.

    Ten seconds of flight at the defaults cost about 35 s of CPU time, on all cores, without a GPU.

    Args:
        trajectory: What was flown.
        model: The drawn model of the aircraft that flew it.
        path: The file, ending in .mp4.
        fps: Frames a second.
        **options: The others of `render_trajectory`; width and height must be even.

    Returns:
        The path of the file.

    Raises:
        RenderingUnavailable: There is no graphics library, no Pillow or no ffmpeg.
        QuadrlError: The path, the size, the frame rate or the camera does not suit a video.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4" or path.is_dir():
        raise QuadrlError(name="path", value=str(path), allowed="the name of a file ending in .mp4")
    for name in ("width", "height"):
        if options.get(name, 0) % 2:
            raise QuadrlError(name=name, value=options[name], allowed="even for a video")
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.mp4")
    with contextlib.closing(render_trajectory(trajectory, model, fps=fps, **options)) as frames:
        first = next(frames)  # what cannot be drawn fails here, before ffmpeg begins
        encoding = dict(crf=20, encoded_format="yuv420p", ffmpeg_args=FFMPEG)
        writer = _mediapy().VideoWriter(temporary, first.shape[:2], fps=fps, **encoding)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            writer.__enter__()
            with contextlib.suppress(BrokenPipeError):  # ffmpeg says itself why it stopped
                for frame in itertools.chain([first], frames):
                    writer.add_image(frame)
            writer.close()
            os.replace(temporary, path)
        except RuntimeError as error:
            raise RenderingUnavailable(f"{path} could not be written: {error}") from error
        finally:
            with contextlib.suppress(RuntimeError):  # the first failure is the one to raise
                writer.close()
            temporary.unlink(missing_ok=True)
    return path


def _mediapy() -> Any:
    """Mediapy with an ffmpeg: the system's, else the one that imageio-ffmpeg brings."""
    mediapy = require("mediapy", "mediapy")
    if shutil.which("ffmpeg") is None:
        mediapy.set_ffmpeg(require("imageio_ffmpeg", "imageio-ffmpeg").get_ffmpeg_exe())
    return mediapy
