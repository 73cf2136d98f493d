"""Draw one picture with MuJoCo: the aircraft in any pose, and what else there is to see."""

from __future__ import annotations

import contextlib
import math
import weakref
from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadrl.base.errors import QuadrlError
from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array
from quadrl.base.validation import choice, number
from quadrl.core.markers import Marker
from quadrl.rendering import drawing, gl
from quadrl.rendering.camera import (
    CHASE,
    FOLLOW,
    MOVING,
    aircraft_scale,
    moving_camera,
    moving_views,
)

MAX_SHAPES = 2000
SHADOW, SHADOW_OF_DISC = (0.0, 0.0, 0.0, 0.55), (0.0, 0.0, 0.0, 0.22)
SHADOW_HEIGHT = 0.0015  # [m], above what is painted on the ground
THINNEST = 0.55  # [pixels], half of a line's width: a thinner one would break up


class Renderer(contextlib.AbstractContextManager):
    """Draws a model's aircraft in any pose; holds a graphics context, so use it in a `with`."""

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int = 1280,
        height: int = 720,
        *,
        fine: bool | None = None,
    ) -> None:
        """Open an off-screen context.

        Args:
            model: What is drawn.
            width: Width of the pictures [pixels].
            height: Height of the pictures [pixels].
            fine: Draw smooth edges and true shadows, which cost a processor six times the rest of
                a picture; None: only where a graphics card draws.

        Raises:
            RenderingUnavailable: There is no graphics library to draw with.
            QuadrlError: The picture is larger than the model's off-screen buffer.
        """
        limit = model.vis.global_
        width = number("width", width, 1, limit.offwidth, whole=True)
        height = number("height", height, 1, limit.offheight, whole=True)
        self.model = model
        self.aspect = width / height
        """Width over height of its pictures."""
        self._data = mujoco.MjData(model)
        self.scale = aircraft_scale(model)
        """Size of the aircraft, as a multiple of the drawings in assets/."""
        self.spins = -np.sign(model.actuator_gear[:, 5])  # the aircraft feels the opposite torque
        """(R,) 1 where a rotor turns counter-clockwise seen from above, else -1."""
        self._painted = {model.geom(name).id for name in drawing.PAINTED}
        self._pixel = 2 * math.tan(math.radians(model.vis.global_.fovy / 2)) / height  # 1 m away
        self._fine = not gl.drawn_by_processor() if fine is None else fine
        self._renderer = gl.open_renderer(model, width, height, MAX_SHAPES, self._fine)
        self._close = weakref.finalize(self, gl.close, self._renderer)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The names that `frame` takes for its camera: those that move, and the model's."""
        fixed = (self.model.cam(k).name for k in range(self.model.ncam))
        return tuple(dict.fromkeys((FOLLOW, *fixed, CHASE)))

    def frame(
        self,
        qpos: ArrayLike,
        *,
        camera: str | mujoco.MjvCamera = FOLLOW,
        rotor_angles: ArrayLike | None = None,
        goal: ArrayLike | None = None,
        trail: ArrayLike | None = None,
        markers: Sequence[Marker | Primitive] = (),
    ) -> NDArray[np.uint8]:
        """Draw one picture.

        Args:
            qpos: (7,) position [m] and attitude (w, x, y, z) of the aircraft, world frame.
            camera: One of `cameras`, or a camera of your own.
            rotor_angles: (R,) angle by which each rotor has turned about its axis [rad].
            goal: (3,) [m] where the aircraft should be; the cameras "follow" and "chase" keep it
                in view, and "follow" the spheres, rings, pads and paths of `markers` as well.
            trail: (n, 3) [m] where it has been, oldest first.
            markers: What else to draw, world frame: markers, and primitives as they are.

        Returns:
            (height, width, 3) colours.

        Raises:
            QuadrlError: There is no such camera, or there is too much to draw.
        """
        model, data = self.model, self._data
        if isinstance(camera, str):
            choice("camera", camera, self.cameras)
        data.qpos[:7] = qpos
        place(model, data, np.zeros(model.nu) if rotor_angles is None else rotor_angles)
        position = data.qpos[:3].copy()
        target = position if goal is None else np.asarray(goal, dtype=float)
        if isinstance(camera, str) and camera in MOVING:
            seen = data.qpos[None], target[None], [markers]
            camera = moving_camera(moving_views(camera, *seen, self.scale, self.aspect)[0])
        self._renderer.update_scene(data, camera)
        for geom in self._renderer.scene.geoms[: model.ngeom]:
            if geom.objid in self._painted:
                geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # casts no shadow on itself
        shown: list[Marker | Primitive] = [] if self._fine else self._shadow()
        if trail is not None:
            shown.append(drawing.trail(np.asarray(trail, dtype=float), self.scale))
        if goal is not None:
            shown.append(drawing.goal(target, position, self.scale))
        add(self._renderer.scene, drawing.markers([*shown, *markers]), self._pixel)
        with gl.current_context_kept():
            return self._renderer.render()

    def close(self) -> None:
        """Free the graphics context."""
        self._close()

    def __exit__(self, *_: object) -> None:
        """Close the context."""
        self.close()

    def _shadow(self) -> list[Marker | Primitive]:
        """The aircraft's shadow on the ground: hull, arms and rotors, flat."""
        model, data = self.model, self._data
        sun = data.light("sun").xdir
        centre = data.qpos[:3].copy()
        hubs = [data.geom(f"rotor_{k + 1}_hub").xpos for k in range(model.nu)]
        if min(point[2] for point in (centre, *hubs)) < 0:
            return []

        def cast(point: Array) -> Array:
            return np.append((point - sun * (point[2] / sun[2]))[:2], SHADOW_HEIGHT)

        below, hull = cast(centre), (0.055 * self.scale, 1e-4, 0.0)
        shown: list[Marker | Primitive] = [Primitive("cylinder", hull, below, rgba=SHADOW)]
        for k, hub in enumerate(map(cast, hubs)):
            disc = (model.geom(f"rotor_{k + 1}_disc").size[0], 1e-4, 0.0)
            shown.append(Primitive("cylinder", disc, hub, rgba=SHADOW_OF_DISC))
            way = hub - below
            length, half = float(np.linalg.norm(way)), math.atan2(way[1], way[0]) / 2
            arm = (length / 2, 0.011 * self.scale, 1e-4)
            turned = (math.cos(half), 0.0, 0.0, math.sin(half))
            shown.append(Primitive("box", arm, (hub + below) / 2, turned, SHADOW))
        return shown


def place(model: mujoco.MjModel, data: mujoco.MjData, rotor_angles: ArrayLike) -> None:
    """Place all that is drawn for the pose of the data, with the blades turned.

    Args:
        model: A drawn model.
        data: Its pose is `qpos`.
        rotor_angles: (R,) angle by which each rotor has turned about its axis [rad].
    """
    for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):
        stage(model, data)
    for k, angle in enumerate(np.asarray(rotor_angles, dtype=float)):
        hub, cos, sin = data.geom(f"rotor_{k + 1}_hub"), math.cos(angle), math.sin(angle)
        axes = hub.xmat.reshape(3, 3)
        turn = axes @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ axes.T
        for blade in (data.geom(f"rotor_{k + 1}_blade_{side}") for side in "ab"):
            blade.xpos = hub.xpos + turn @ (blade.xpos - hub.xpos)
            blade.xmat = (turn @ blade.xmat.reshape(3, 3)).ravel()


def add(scene: mujoco.MjvScene, primitives: Iterable[Primitive], pixel: float = 0.0) -> None:
    """Add primitives to what MuJoCo draws; meshes are parts of models, and not among them.

    Args:
        scene: What is drawn.
        primitives: World frame.
        pixel: Size of a pixel a metre from the camera [m], for lines that are not to break up.

    Raises:
        QuadrlError: There is too much to draw.
    """
    for one in primitives:
        if one.shape == "line":
            _add_line(scene, one, pixel)
            continue
        size, axes = np.broadcast_to(np.asarray(one.size, dtype=float), 3), np.empty(9)
        mujoco.mju_quat2Mat(axes, np.asarray(one.quaternion, dtype=float))
        geom = _add_geom(scene, one.shape, one.rgba, one, size, axes)
        if one.shape == "label":
            geom.label = one.name
        elif one.shape == "arrow":
            start, end = np.asarray(one.points, dtype=float)
            width = max(float(size[0]), _thinnest(scene, start, end - start, pixel))
            mujoco.mjv_connector(geom, geom.type, width, start, end)
            geom.size = (width, width, 2 * geom.size[2])  # MuJoCo draws half of it


def _add_geom(
    scene: mujoco.MjvScene, shape: str, rgba: ArrayLike, one: Primitive, size: Array, axes: Array
) -> mujoco.MjvGeom:
    if scene.ngeom >= scene.maxgeom:
        allowed = f"at most {scene.maxgeom}: give fewer markers"
        raise QuadrlError(name="shapes to draw", value=scene.ngeom + 1, allowed=allowed)
    geom, kind = scene.geoms[scene.ngeom], getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}")
    scene.ngeom += 1
    colour = np.array(rgba, dtype=np.float32)
    colour[:3] *= 1.0 - 0.4 * one.glow  # the light comes on top of it
    mujoco.mjv_initGeom(geom, kind, size, np.asarray(one.position, dtype=float), axes, colour)
    geom.emission, geom.shininess = one.glow, one.shine
    casts_shadow = one.glow < 1.0
    categories = mujoco.mjtCatBit
    geom.category = categories.mjCAT_DYNAMIC if casts_shadow else categories.mjCAT_DECOR
    return geom


def _add_line(scene: mujoco.MjvScene, line: Primitive, pixel: float) -> None:
    """Connect the points of a line with boxes, the cheapest shape: capsules took 40 ms a trail."""
    points = np.asarray(line.points, dtype=float)
    colours, widths = np.broadcast_to(line.rgba, (len(points), 4)), np.asarray(line.size)
    widths, ways = np.broadcast_to(widths, len(points)), np.diff(points, axis=0)
    for k in np.flatnonzero(np.linalg.norm(ways, axis=1) > 1e-6):
        geom = _add_geom(scene, "box", colours[k], line, np.zeros(3), np.eye(3).ravel())
        width = max(float(widths[k]), _thinnest(scene, points[k], ways[k], pixel))
        geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER  # a connector is no box
        mujoco.mjv_connector(geom, geom.type, width, points[k], points[k + 1])
        geom.type = mujoco.mjtGeom.mjGEOM_BOX


def _thinnest(scene: mujoco.MjvScene, start: Array, way: Array, pixel: float) -> float:
    """Half of the least width [m] at which a line is visible, where it is nearest."""
    eye = scene.camera[0].pos - start
    nearest = eye - way * np.clip(eye @ way / (way @ way), 0.0, 1.0)
    return THINNEST * pixel * math.sqrt(nearest @ nearest)
