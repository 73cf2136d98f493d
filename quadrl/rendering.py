"""Pictures and videos of flights, drawn off screen with MuJoCo.

Everything is in the world frame (East-North-Up, metres). Drawing calls only MuJoCo's kinematics,
never its dynamics: it needs no rotor callbacks and leaves the simulation's own data alone.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import itertools
import math
import os
import shutil
import sys
from collections.abc import Generator, Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadrl.errors import QuadrlError
from quadrl.task import GOAL_RGBA, Marker, OptionError, check_choices
from quadrl.vehicle import DRAWN_ARM_LENGTH

Array = NDArray[np.floating[Any]]

# The camera of videos: moves with the aircraft, keeps the goal in view, never turns or rolls.
FOLLOW = "follow"
FOLLOW_AZIMUTH, FOLLOW_ELEVATION = 30.0, -21.0  # [deg]
FOLLOW_DISTANCE = (1.35, 7.0)  # [m]; the nearer one of the paper's aircraft
FOLLOW_ROOM = np.array([2.0, 2.0, 3.0])  # [m] back for each metre east, north and up of the centre
FOLLOW_SMOOTHING = 0.4  # [s], standard deviation of the low pass
TRAIL_SEGMENTS = 120
TRAIL_SECONDS = 4.0
TRAIL_WIDTH = 0.008  # [m]
PAD_RGBA = (0.10, 0.13, 0.17, 1.0)
TRAIL_OLD, TRAIL_NEW = np.array([0.35, 0.55, 0.80, 1.0]), np.array([1.0, 0.72, 0.30, 1.0])
GOAL_RADIUS = 0.08  # [m]
FASTEST_GOAL = 10.0  # [m/s]; one that moves faster has jumped
FRONT, SIDE, BACK = (255, 122, 41), (205, 212, 222), (66, 148, 255)
ROTOR_COLOURS = (FRONT, SIDE, BACK, SIDE)  # rotors 1 to 4: ahead, left, behind, right
MAX_FPS = 240
LEAST_RATE = 20.0  # [1/s], at which a flight is followed
SPIN = np.array([1.0, -1.0, 1.0, -1.0])  # about body z; the reaction torque of (7) is opposite


class RenderingUnavailable(QuadrlError, RuntimeError):
    """Nothing can be drawn here; simulation and training do not need to."""


@dataclasses.dataclass(frozen=True)
class Flight:
    """A recorded flight of T states."""

    time: Array  # (T,) [s], increasing
    qpos: Array  # (T, 7) position [m] and attitude (w, x, y, z), world frame
    rotor_speed: Array  # (T, 4) [rad/s]
    error: Array  # (T,) [m], distance from the goal
    reward: Array  # (T,)
    goal: Array  # (T, 3) [m], world frame
    control_step: float  # [s]
    max_rotor_speed: float  # [rad/s]
    task: str
    markers: Sequence[tuple[Marker, ...]] = ((),)  # one tuple a state, or one for all

    def resampled(self, fps: float) -> Flight:
        """The same flight at `fps` states a second; a goal that jumps is not interpolated."""
        from scipy.interpolate import PchipInterpolator
        from scipy.spatial.transform import Rotation, Slerp

        if len(self.time) < 2:
            return self
        time = np.arange(self.time[0], self.time[-1] + 1e-9, 1 / fps).clip(max=self.time[-1])
        right = np.clip(np.searchsorted(self.time, time, side="right"), 1, len(self.time) - 1)
        blend = (time - self.time[right - 1]) / np.diff(self.time)[right - 1]

        def linear(values: Array) -> Array:
            weight = blend.reshape(-1, *[1] * (values.ndim - 1))
            return (1 - weight) * values[right - 1] + weight * values[right]

        held = right - (blend < 1)
        stride = np.linalg.norm(self.goal[right] - self.goal[right - 1], axis=-1, keepdims=True)
        jump = stride > FASTEST_GOAL * self.control_step
        attitude = Slerp(self.time, Rotation.from_quat(self.qpos[:, 3:], scalar_first=True))(time)
        position = PchipInterpolator(self.time, self.qpos[:, :3])(time)
        markers = self.markers
        if len(markers) > 1:
            pairs = zip(right, blend, strict=True)
            markers = [_between(markers[k - 1], markers[k], share) for k, share in pairs]
        return dataclasses.replace(
            self,
            time=time,
            qpos=np.concatenate([position, attitude.as_quat(scalar_first=True)], axis=1),
            rotor_speed=linear(self.rotor_speed),
            error=linear(self.error),
            reward=self.reward[held],
            goal=np.where(jump, self.goal[held], linear(self.goal)),
            markers=markers,
        )


class Renderer:
    """Draws a model's aircraft in any pose; holds a graphics context, so use it in a `with`."""

    def __init__(self, model: mujoco.MjModel, width: int = 1280, height: int = 720) -> None:
        """Open an off-screen context of width x height pixels.

        Raises:
            RenderingUnavailable: There is no graphics library to draw with.
            ValueError: The picture is larger than the model's off-screen buffer.
        """
        _check_size(model, width, height)
        self.model = model
        self._data = mujoco.MjData(model)
        self._scale = aircraft_scale(model)
        with _current_context_kept():
            self._renderer = _open(model, width, height)
        self._blades = [  # (blade, its hub, index of its rotor)
            (geom, model.geom(f"hub_{name.split('_')[1]}").id, int(name.split("_")[1]) - 1)
            for geom in range(model.ngeom)
            if (name := model.geom(geom).name).startswith("blade_")
        ]

    @property
    def cameras(self) -> tuple[str, ...]:
        """The names that `frame` takes for its camera."""
        return _cameras(self.model)

    def frame(
        self,
        qpos: ArrayLike,
        *,
        camera: str | mujoco.MjvCamera = FOLLOW,
        rotor_angles: ArrayLike | None = None,
        goal: ArrayLike | None = None,
        trail: ArrayLike | None = None,
        markers: Sequence[Marker] = (),
    ) -> NDArray[np.uint8]:
        """Draw one picture.

        Args:
            qpos: (7,) position [m] and attitude (w, x, y, z) of the aircraft, world frame.
            camera: One of `cameras`, or a camera of your own.
            rotor_angles: (4,) angle by which each rotor has turned [rad].
            goal: (3,) [m] where the aircraft should be; the camera "follow" keeps it in view.
            trail: (n, 3) [m] where it has been, oldest first.
            markers: What else to draw.

        Returns:
            (height, width, 3) colours.

        Raises:
            ValueError: There is no such camera.
        """
        model, data = self.model, self._data
        if isinstance(camera, str):
            check_choices([camera], self.cameras, "camera")
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        if rotor_angles is not None:
            self._turn_blades(np.asarray(rotor_angles, dtype=float))
        position = data.qpos[:3].copy()
        target = position if goal is None else np.asarray(goal, dtype=float)
        if camera == FOLLOW:
            camera = follow_cameras(position[None], [in_view(target, markers)], 0.0, self._scale)[0]
        self._renderer.update_scene(data, camera)
        if trail is not None:
            self._draw_trail(np.asarray(trail, dtype=float))
        if goal is not None:
            # It fades as the aircraft comes near, so as not to veil it.
            away = np.linalg.norm(target - position) / self._scale
            rgba = (*GOAL_RGBA[:3], GOAL_RGBA[3] * float(np.clip(away / 0.4, 0.1, 1.0)))
            self._draw_marker(Marker("goal", tuple(target), GOAL_RADIUS * self._scale, rgba))
        for marker in markers:
            self._draw_marker(marker)
        with _current_context_kept():
            return self._renderer.render()

    def close(self) -> None:
        """Give the graphics context back."""
        context = self._renderer._gl_context  # None once it is closed
        if context is not None:
            with _current_context_kept():
                context.make_current()  # what is freed is freed in the current one
                self._renderer.close()

    def __enter__(self) -> Renderer:
        """Enter with the context open."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the context."""
        self.close()

    def _turn_blades(self, angles: Array) -> None:
        data = self._data
        for blade, hub, rotor in self._blades:
            axes = data.geom_xmat[hub].reshape(3, 3)
            cos, sin = math.cos(angles[rotor]), math.sin(angles[rotor])
            turn = axes @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ axes.T
            centre = data.geom_xpos[hub]
            data.geom_xpos[blade] = centre + turn @ (data.geom_xpos[blade] - centre)
            data.geom_xmat[blade] = (turn @ data.geom_xmat[blade].reshape(3, 3)).ravel()

    def _add(
        self, shape: mujoco.mjtGeom, rgba: ArrayLike, size: ArrayLike, position: Array, axes: Array
    ) -> mujoco.MjvGeom:
        """Add a shape to the scene and return it."""
        scene = self._renderer.scene
        if scene.ngeom >= scene.maxgeom:
            raise OptionError(f"more than {scene.maxgeom} shapes to draw; give fewer markers")
        geom = scene.geoms[scene.ngeom]
        scene.ngeom += 1
        colour, extent = np.asarray(rgba, dtype=np.float32), np.asarray(size, dtype=float)
        mujoco.mjv_initGeom(geom, shape, extent, position, axes.ravel(), colour)
        geom.rgba[:3], geom.emission = 0.6 * colour[:3], 1.0  # glows rather than catches the sun
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # casts no shadow
        return geom

    def _connect(
        self, shape: mujoco.mjtGeom, rgba: ArrayLike, width: float, start: Array, end: Array
    ) -> None:
        geom = self._add(shape, rgba, np.zeros(3), start, np.eye(3))
        box = shape == mujoco.mjtGeom.mjGEOM_BOX  # mjv_connector does not know it
        kind = mujoco.mjtGeom.mjGEOM_CYLINDER if box else shape
        mujoco.mjv_connector(geom, kind, width, start, end)
        geom.type = shape
        if shape == mujoco.mjtGeom.mjGEOM_ARROW:
            geom.size = (width, width, 2 * geom.size[2])  # MuJoCo draws half of what it says

    def _draw_chain(
        self, shape: mujoco.mjtGeom, points: Array, colours: Array, widths: Array
    ) -> None:
        for k in np.flatnonzero(np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6):
            self._connect(shape, colours[k], widths[k], points[k], points[k + 1])

    def _draw_trail(self, points: Array) -> None:
        shown = np.unique(np.linspace(0, len(points) - 1, TRAIL_SEGMENTS + 1).astype(int))
        youth = np.linspace(0, 1, len(shown))
        colours = TRAIL_OLD + youth[:, None] * (TRAIL_NEW - TRAIL_OLD)
        # Boxes are the cheapest shape: a trail of capsules took 40 ms a frame.
        box = mujoco.mjtGeom.mjGEOM_BOX
        self._draw_chain(box, points[shown], colours, self._scale * TRAIL_WIDTH * youth**0.7)

    def _draw_marker(self, marker: Marker) -> None:
        shape, size, rgba = mujoco.mjtGeom, marker.size, marker.rgba
        solid = (*rgba[:3], min(1.0, 3.0 * rgba[3]))
        position = np.asarray(marker.position, dtype=float)
        end = position if marker.end is None else np.asarray(marker.end, dtype=float)
        quaternion, axes = np.empty(4), np.empty(9)
        mujoco.mju_quatZ2Vec(quaternion, end - position)  # upright where there is no end
        mujoco.mju_quat2Mat(axes, quaternion)
        axes = axes.reshape(3, 3)
        if marker.kind in ("goal", "sphere"):
            ball = self._add(shape.mjGEOM_SPHERE, rgba, (size,) * 3, position, axes)
            ball.label = marker.label
        if marker.kind == "goal":
            foot = np.array([position[0], position[1], 0.004])  # [m], clear of the ground
            self._add(shape.mjGEOM_SPHERE, solid, (0.22 * size,) * 3, position, axes)
            self._connect(shape.mjGEOM_CYLINDER, (*rgba[:3], 0.55), 0.004, foot, position)
            self._draw_marker(Marker("ring", tuple(foot), 1.8 * size, (*rgba[:3], 0.7)))
        elif marker.kind == "ring":
            self._draw_circle(position, axes, size, rgba)
        elif marker.kind == "pad":
            if marker.end is None:
                position = np.array([position[0], position[1], 0.0])
            self._add(shape.mjGEOM_CYLINDER, PAD_RGBA, (size, 0.002, 0), position, axes)
            for share in (1.0, 0.62):
                self._draw_circle(position, axes, share * size, rgba)
            # The letter H: where its two posts and its bar are, and half of their extents.
            for x, width, height in ((-0.17, 0.045, 0.29), (0.17, 0.045, 0.29), (0, 0.17, 0.04)):
                centre = position + axes @ (size * x, 0.0, 0.003)
                extent = (size * width, size * height, 0.001)
                self._add(shape.mjGEOM_BOX, rgba, extent, centre, axes)
        elif marker.kind == "path":
            points = np.asarray(marker.points, dtype=float)
            colours, width = np.tile(rgba, (len(points), 1)), np.full(len(points), size)
            self._draw_chain(shape.mjGEOM_BOX, points, colours, width)
        elif marker.kind in ("line", "arrow"):
            arrow = marker.kind == "arrow"
            kind = shape.mjGEOM_ARROW if arrow else shape.mjGEOM_CYLINDER
            self._connect(kind, rgba, size, position, end)

    def _draw_circle(
        self, centre: Array, axes: Array, radius: float, rgba: Sequence[float]
    ) -> None:
        angle = np.linspace(0, 2 * np.pi, 49)
        circle = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
        width, colours = np.full(49, 0.02 * radius + 0.003), np.tile((*rgba[:3], 1), (49, 1))
        edge = centre + radius * circle @ axes.T
        self._draw_chain(mujoco.mjtGeom.mjGEOM_CAPSULE, edge, colours, width)


def aircraft_scale(model: mujoco.MjModel) -> float:
    """Size of a model's aircraft, as a multiple of the paper's."""
    return float(np.linalg.norm(model.site("rotor_1").pos[:2])) / DRAWN_ARM_LENGTH


def in_view(goal: Array, markers: Sequence[Marker]) -> Array:
    """What a camera should not lose, (n, 3) [m]: the goal and the spheres, goals to come."""
    return np.array([goal, *(m.position for m in markers if m.kind == "sphere")])


def follow_cameras(
    position: Array, shown: Sequence[Array], smoothing: float = 0.0, scale: float = 1.0
) -> list[mujoco.MjvCamera]:
    """Cameras that follow a flight smoothly and step back to keep some points in view.

    Args:
        position: (T, 3) [m], of the aircraft, world frame.
        shown: T arrays (n, 3) [m], world frame, n at least 1.
        smoothing: Standard deviation of the low pass [states]; it looks both ways, so nothing lags.
        scale: Size of the aircraft, as a multiple of the paper's.

    Returns:
        T cameras.
    """
    from scipy.ndimage import gaussian_filter1d

    boxes = [np.vstack([at, points]) for at, points in zip(position, shown, strict=True)]
    half = np.array([(box.max(0) - box.min(0)) / 2 for box in boxes])
    aside = np.array([box.min(0) for box in boxes]) + half - position
    nearest, farthest = FOLLOW_DISTANCE
    radius = np.linalg.norm(half, axis=-1, keepdims=True)
    # Pictures are wider than high, and what is deep takes little of either.
    room = np.linalg.norm(half * FOLLOW_ROOM, axis=-1, keepdims=True)
    distance = np.clip(0.75 * scale + room, nearest * scale, farthest)
    # The aircraft itself stays in view whatever is far away.
    aside = aside * np.minimum(1.0, farthest / 4 / np.maximum(radius, 1e-9))
    path = np.concatenate([position + aside, distance], axis=1)
    if smoothing > 0:
        path = np.asarray(gaussian_filter1d(path, smoothing, axis=0, mode="nearest"))
    cameras = [mujoco.MjvCamera() for _ in path]
    for camera, row in zip(cameras, path, strict=True):
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat, camera.distance = row[:3], row[3]
        camera.azimuth, camera.elevation = FOLLOW_AZIMUTH, FOLLOW_ELEVATION
    return cameras


def render_flight(
    flight: Flight,
    model: mujoco.MjModel,
    *,
    width: int = 848,
    height: int = 480,
    fps: float = 25.0,
    camera: str = FOLLOW,
    overlay: bool = True,
    trail: bool = True,
) -> Generator[NDArray[np.uint8]]:
    """Draw a flight: pictures (height, width, 3) one at a time, arguments as for `write_video`."""
    from scipy.integrate import cumulative_trapezoid

    # Speed, trail and camera are those of the flight however few pictures are drawn of it.
    every = math.ceil(LEAST_RATE / fps)
    rate = every * fps
    flight = flight.resampled(rate)
    position = flight.qpos[:, :3]
    angles = SPIN * cumulative_trapezoid(flight.rotor_speed, flight.time, axis=0, initial=0)
    speed = np.zeros(len(position))
    if len(position) > 1:
        speed = np.linalg.norm(np.gradient(position, flight.time, axis=0), axis=1)
    markers = flight.markers
    if len(markers) == 1:
        markers = [markers[0]] * len(position)
    cameras: Sequence[str | mujoco.MjvCamera] = [camera] * len(position)
    if camera == FOLLOW:
        shown = [in_view(*seen) for seen in zip(flight.goal, markers, strict=True)]
        cameras = follow_cameras(position, shown, FOLLOW_SMOOTHING * rate, aircraft_scale(model))
    panel = _Panel(height, flight.task) if overlay else None
    with Renderer(model, width, height) as renderer:
        for k in range(0, len(position), every):
            picture = renderer.frame(
                flight.qpos[k],
                camera=cameras[k],
                rotor_angles=angles[k],
                goal=flight.goal[k],
                trail=position[max(0, k - round(TRAIL_SECONDS * rate)) : k + 1] if trail else None,
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
    flight: Flight,
    model: mujoco.MjModel,
    path: str | os.PathLike[str],
    *,
    width: int = 848,
    height: int = 480,
    fps: float = 25.0,
    camera: str = FOLLOW,
    overlay: bool = True,
    trail: bool = True,
) -> Path:
    """Write a flight as an MP4 (H.264, yuv420p). An unfinished file never bears the name.

    Ten seconds of flight at the defaults cost about 35 s of CPU time, on all cores, without a GPU.

    Args:
        flight: What was flown.
        model: The drawn model of the aircraft that flew it.
        path: The file, ending in .mp4.
        width: Of the picture [pixels], even.
        height: Of the picture [pixels], even.
        fps: Frames a second; the recorded states are interpolated.
        camera: "follow", or a camera of the model.
        overlay: Show time, error, speed, reward and rotor speeds.
        trail: Show where the aircraft has been.

    Returns:
        The path of the file.

    Raises:
        RenderingUnavailable: There is no graphics library, mediapy, Pillow or ffmpeg.
        OptionError: The size, the camera, the frame rate or the name is not one for a video.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise OptionError(f"{path}: the name of a video must end in .mp4")
    if path.is_dir():
        raise OptionError(f"{path} is a folder; give the name of a file")
    if width % 2 or height % 2:
        raise OptionError(f"{width}x{height} pixels: a video needs an even width and height")
    if not 1 <= fps <= MAX_FPS:
        raise OptionError(f"fps = {fps}: 1 to {MAX_FPS} frames a second are allowed")
    _check_size(model, width, height)
    check_choices([camera], _cameras(model), "camera")
    mediapy = _video_library()
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.mp4")
    frames = render_flight(
        flight,
        model,
        width=width,
        height=height,
        fps=fps,
        camera=camera,
        overlay=overlay,
        trail=trail,
    )
    writer = mediapy.VideoWriter(
        temporary,
        (height, width),
        fps=fps,
        crf=20,
        encoded_format="yuv420p",
        ffmpeg_args="-preset veryfast -movflags +faststart",
    )
    try:
        with contextlib.closing(frames):
            first = next(frames)  # what cannot be drawn fails here, before ffmpeg begins
            _encode(writer, itertools.chain([first], frames))
        os.replace(temporary, path)
    except (BrokenPipeError, RuntimeError) as error:
        if isinstance(error, RenderingUnavailable):
            raise
        raise RenderingUnavailable(f"{path} could not be written: {error}") from error
    finally:
        temporary.unlink(missing_ok=True)
    return path


def _encode(writer: Any, frames: Iterable[NDArray[np.uint8]]) -> None:  # noqa: ANN401
    """Send frames to a mediapy writer; what goes wrong first is what is raised."""
    writer.__enter__()
    try:
        for frame in frames:
            writer.add_image(frame)
    except BaseException:
        with contextlib.suppress(Exception):
            writer.close()
        raise
    writer.close()


class _Panel:
    """The small panel in the corner of a video."""

    def __init__(self, height: int, title: str) -> None:
        self._image = _require("PIL.Image", "Pillow")
        self._draw = _require("PIL.ImageDraw", "Pillow")
        load_font = _require("PIL.ImageFont", "Pillow").load_default
        self._scale = max(height / 720, 0.72)  # smaller print cannot be read
        self._title = title.replace("_", " ").capitalize()
        self._fonts = {size: load_font(size=size * self._scale) for size in (13, 15, 18)}
        width, height = self._at(286, 138)
        large = self._image.new("RGBA", (4 * width, 4 * height), (13, 18, 26, 0))
        box, corner = (0, 0, 4 * width - 1, 4 * height - 1), round(56 * self._scale)
        self._draw.Draw(large).rounded_rectangle(box, corner, fill=(13, 18, 26, 165))
        self._background = large.resize((width, height))  # drawn larger, for a smooth edge

    def draw(
        self, picture: NDArray[np.uint8], lines: Sequence[tuple[str, str]], shares: Array
    ) -> None:
        """Draw labelled values and rotor speeds (4,), 1 at most, into a picture, in place."""
        margin = round(18 * self._scale)
        width, height = self._background.size
        corner = picture[margin : margin + height, margin : margin + width]
        image = self._image.fromarray(corner)
        image.paste(self._background, mask=self._background)
        draw = self._draw.Draw(image)
        draw.text(self._at(16, 11), self._title, font=self._fonts[18], fill=(255, 255, 255))
        for row, (label, value) in enumerate(lines):
            y = 41 + 21 * row
            draw.text(self._at(16, y), label, font=self._fonts[15], fill=(150, 163, 180))
            draw.text(
                self._at(166, y), value, font=self._fonts[15], fill=(236, 240, 246), anchor="ra"
            )
        for rotor, share in enumerate(np.clip(shares, 0, 1)):
            left, top, bottom = 190 + 21 * rotor, 17, 103
            level = bottom - float(share) * (bottom - top)
            for upper, fill in ((top, (44, 52, 64)), (level, ROTOR_COLOURS[rotor])):
                draw.rectangle((*self._at(left, upper), *self._at(left + 12, bottom)), fill=fill)
            number, at = str(rotor + 1), self._at(left + 6, 109)
            draw.text(at, number, font=self._fonts[13], fill=(150, 163, 180), anchor="ma")
        corner[:] = np.asarray(image)

    def _at(self, x: float, y: float) -> tuple[int, int]:
        return round(x * self._scale), round(y * self._scale)


def _cameras(model: mujoco.MjModel) -> tuple[str, ...]:
    return (FOLLOW, *(model.cam(k).name for k in range(model.ncam)))


def _check_size(model: mujoco.MjModel, width: int, height: int) -> None:
    limit = model.vis.global_
    if not (0 < width <= limit.offwidth and 0 < height <= limit.offheight):
        raise OptionError(
            f"{width}x{height} pixels: at most {limit.offwidth}x{limit.offheight} can be drawn"
        )


def _open(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    try:
        _open_display()
        return mujoco.Renderer(model, height, width, max_geom=2000)
    except Exception as error:  # each platform fails in a way of its own
        raise RenderingUnavailable(
            "no OpenGL context can be had here, so nothing can be drawn; simulation and training "
            "work without. On Debian: apt install libegl1 libgl1-mesa-dri, then MUJOCO_GL=egl "
            f"(now {os.environ.get('MUJOCO_GL', 'unset')}). It failed with: {error}"
        ) from error


def _open_display() -> None:
    """Open the EGL display in mujoco's place, which would close it at the end of the process.

    dm_control shares the display, and could no longer free its own contexts.
    """
    egl: Any = sys.modules.get("mujoco.egl")
    if egl is not None and egl.EGL_DISPLAY is None:
        display = egl.create_initialized_egl_device_display()
        if display != egl.EGL.EGL_NO_DISPLAY:
            egl.EGL_DISPLAY = display


@contextlib.contextmanager
def _current_context_kept() -> Generator[None]:
    """Leave the thread with the EGL context that it had.

    dm_control makes its own current once and takes it for granted; it would go on to draw in ours.
    """
    egl = sys.modules.get("mujoco.egl")
    if egl is None:
        yield
        return
    gl = egl.EGL
    before = gl.eglGetCurrentContext()
    try:
        yield
    finally:
        if egl.EGL_DISPLAY is not None:
            context = before or gl.EGL_NO_CONTEXT
            gl.eglMakeCurrent(egl.EGL_DISPLAY, gl.EGL_NO_SURFACE, gl.EGL_NO_SURFACE, context)


def _require(module: str, package: str) -> Any:  # noqa: ANN401 - a module
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise RenderingUnavailable(
            f"videos need {package}: pip install 'quadrl[video]'; simulation and training do not"
        ) from error


def _video_library() -> Any:  # noqa: ANN401 - a module
    """Mediapy with an ffmpeg: the system's, else the one that imageio-ffmpeg brings."""
    mediapy = _require("mediapy", "mediapy")
    if shutil.which("ffmpeg") is None:
        mediapy.set_ffmpeg(_require("imageio_ffmpeg", "imageio-ffmpeg").get_ffmpeg_exe())
    return mediapy


def _between(
    before: tuple[Marker, ...], after: tuple[Marker, ...], share: float
) -> tuple[Marker, ...]:
    """Markers on their way from one state to the next; those with an end stay until they jump."""
    if before is after or [m.kind for m in before] != [m.kind for m in after]:
        return before
    moved = [
        (1 - share) * np.array(a.position) + share * np.array(b.position)
        for a, b in zip(before, after, strict=True)
    ]
    return tuple(
        a if a.end else dataclasses.replace(a, position=tuple(position))
        for a, position in zip(before, moved, strict=True)
    )
