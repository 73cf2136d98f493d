"""One picture: the aircraft in any pose, and what else there is to see."""

from __future__ import annotations

import contextlib
import math
import weakref
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array
from quadrl.base.validation import choice, number
from quadrl.core.markers import GOAL_RGBA, Marker
from quadrl.engines import landmarks
from quadrl.rendering import gl
from quadrl.rendering.camera import (
    CHASE,
    FOLLOW,
    MOVING,
    aircraft_scale,
    follow_cameras,
    headings,
    in_view,
)

MAX_SHAPES = 2000
TRAIL_SEGMENTS = 60
TRAIL_SECONDS = 4.0
TRAIL_WIDTH = 0.008  # [m], of an aircraft with scale 1
TRAIL_OLD, TRAIL_NEW = np.array([0.35, 0.55, 0.80, 1.0]), np.array([1.0, 0.72, 0.30, 1.0])
GOAL_RADIUS = 0.08  # [m], of an aircraft with scale 1
SHADOW, SHADOW_OF_DISC = (0.0, 0.0, 0.0, 0.55), (0.0, 0.0, 0.0, 0.22)
THINNEST = 0.55  # [pixels], half of a line's width: a thinner one would break up
PAD_RGBA = (0.10, 0.13, 0.17, 1.0)
NOTHING, UPRIGHT = np.zeros(3), np.eye(3)
ANGLE = np.linspace(0, 2 * np.pi, 49)
CIRCLE = np.stack([np.cos(ANGLE), np.sin(ANGLE), np.zeros_like(ANGLE)], axis=-1)


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
            width: Of the pictures [pixels].
            height: Of the pictures [pixels].
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
        self._blades = [  # (blade, its hub, index of its rotor)
            (model.geom(f"rotor_{k + 1}_blade_{side}").id, model.geom(f"rotor_{k + 1}_hub").id, k)
            for k in range(model.nu)
            for side in "ab"
        ]
        self._painted = {model.geom(name).id for name in landmarks.meshes()}
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
        markers: Sequence[Marker] = (),
    ) -> NDArray[np.uint8]:
        """Draw one picture.

        Args:
            qpos: (7,) position [m] and attitude (w, x, y, z) of the aircraft, world frame.
            camera: One of `cameras`, or a camera of your own.
            rotor_angles: (R,) angle by which each rotor has turned about its axis [rad].
            goal: (3,) [m] where the aircraft should be; the cameras "follow" and "chase" keep it
                in view, and "follow" the spheres, rings, pads and paths of `markers` as well.
            trail: (n, 3) [m] where it has been, oldest first.
            markers: What else to draw, world frame.

        Returns:
            (height, width, 3) colours.

        Raises:
            QuadrlError: There is no such camera, or there is too much to draw.
        """
        model, data = self.model, self._data
        if isinstance(camera, str):
            choice("camera", camera, self.cameras)
        data.qpos[:7] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        if rotor_angles is not None:
            self._turn_blades(np.asarray(rotor_angles, dtype=float))
        position = data.qpos[:3].copy()
        target = position if goal is None else np.asarray(goal, dtype=float)
        if isinstance(camera, str) and camera in MOVING:
            chase = camera == CHASE
            heading = headings(data.qpos[None]) if chase else None
            shown = [in_view(target, () if chase else markers)]
            how = self.scale, heading, self.aspect
            camera = follow_cameras(position[None], shown, 0.0, *how)[0]
        self._renderer.update_scene(data, camera)
        for geom in self._renderer.scene.geoms[: model.ngeom]:
            if geom.objid in self._painted:
                geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # casts no shadow on itself
        if not self._fine:
            self._add_shadow()
        if trail is not None:
            self._add_trail(np.asarray(trail, dtype=float))
        if goal is not None:
            # It fades as the aircraft comes near, so as not to veil it.
            away = np.linalg.norm(target - position) / self.scale
            rgba = (*GOAL_RGBA[:3], GOAL_RGBA[3] * float(np.clip(away / 0.4, 0.1, 1.0)))
            self._add_marker(Marker("goal", tuple(target), GOAL_RADIUS * self.scale, rgba))
        for marker in markers:
            self._add_marker(marker)
        with gl.current_context_kept():
            return self._renderer.render()

    def close(self) -> None:
        """Give the graphics context back."""
        self._close()

    def __exit__(self, *_: object) -> None:
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
        self, shape: str, rgba: ArrayLike, size: ArrayLike, position: Array, axes: Array
    ) -> mujoco.MjvGeom:
        """Add a shape of MuJoCo's to the scene and return it."""
        scene = self._renderer.scene
        if scene.ngeom >= scene.maxgeom:
            allowed = f"at most {scene.maxgeom}: give fewer markers"
            raise QuadrlError(name="shapes to draw", value=scene.ngeom + 1, allowed=allowed)
        geom, kind = scene.geoms[scene.ngeom], getattr(mujoco.mjtGeom, f"mjGEOM_{shape}")
        scene.ngeom += 1
        colour, extent = np.array(rgba, dtype=np.float32), np.asarray(size, dtype=float)
        colour[:3] *= 0.6
        mujoco.mjv_initGeom(geom, kind, extent, position, axes.ravel(), colour)
        geom.emission = 1.0  # it glows instead of being lit
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # casts no shadow
        return geom

    def _add_chain(
        self, shape: str, points: ArrayLike, colours: ArrayLike, widths: ArrayLike
    ) -> None:
        """Connect points (n, 3); colours are (n, 4) and widths (n,), or one for all."""
        points = np.asarray(points, dtype=float)
        colours = np.broadcast_to(colours, (len(points), 4))
        widths = np.broadcast_to(widths, len(points))
        ways = np.diff(points, axis=0)
        length = np.linalg.norm(ways, axis=1)
        for k in np.flatnonzero(length > 1e-6):
            geom = self._add(shape, colours[k], NOTHING, points[k], UPRIGHT)
            kind, width = geom.type, max(float(widths[k]), self._thinnest(points[k], ways[k]))
            geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER if shape == "BOX" else kind
            mujoco.mjv_connector(geom, geom.type, width, points[k], points[k + 1])  # knows no box
            geom.type = kind
            if shape == "ARROW":
                geom.size = (width, width, 2 * geom.size[2])  # MuJoCo draws half of it

    def _thinnest(self, start: Array, way: Array) -> float:
        """Half of the least width [m] that a line can be seen with, where it is nearest."""
        eye = self._renderer.scene.camera[0].pos - start
        nearest = eye - way * np.clip(eye @ way / (way @ way), 0.0, 1.0)
        return THINNEST * self._pixel * math.sqrt(nearest @ nearest)

    def _add_shadow(self) -> None:
        """Lay the aircraft's shadow on the ground: hull, arms and rotors, flat."""
        model, data = self.model, self._data
        sun, lift = data.light("sun").xdir, 0.0015  # [m], above what is painted on the ground

        def cast(point: Array) -> Array:
            return np.append((point - sun * (point[2] / sun[2]))[:2], lift)

        hubs = [data.geom_xpos[hub].copy() for _, hub, _ in self._blades[::2]]
        centre = data.qpos[:3].copy()
        if min(point[2] for point in (centre, *hubs)) < 0:
            return
        below, flat = cast(centre), np.eye(3)
        self._add("CYLINDER", SHADOW, (0.055 * self.scale, 1e-4, 0), below, flat)
        for k, hub in enumerate(hubs):
            at, disc = cast(hub), model.geom(f"rotor_{k + 1}_disc").size[0]
            self._add("CYLINDER", SHADOW_OF_DISC, (disc, 1e-4, 0), at, flat)
            way = at - below
            length = float(np.linalg.norm(way))
            if length > 1e-6:
                along = way / length
                axes = np.stack([along, (-along[1], along[0], 0.0), (0.0, 0.0, 1.0)], axis=-1)
                size = (length / 2, 0.011 * self.scale, 1e-4)
                self._add("BOX", SHADOW, size, (at + below) / 2, axes)

    def _add_circle(
        self, centre: Array, axes: Array, radius: float, rgba: Sequence[float], every: int = 1
    ) -> None:
        edge = centre + radius * CIRCLE[::every] @ axes.T
        self._add_chain("BOX", edge, (*rgba[:3], 1.0), 0.02 * radius + 0.003)

    def _add_trail(self, points: Array) -> None:
        shown = np.unique(np.linspace(0, len(points) - 1, TRAIL_SEGMENTS + 1).astype(int))
        youth = np.linspace(0, 1, len(shown))
        colours = TRAIL_OLD + youth[:, None] * (TRAIL_NEW - TRAIL_OLD)
        # Boxes are the cheapest shape: a trail of capsules took 40 ms a frame.
        self._add_chain("BOX", points[shown], colours, self.scale * TRAIL_WIDTH * youth**0.7)

    def _add_marker(self, marker: Marker) -> None:
        kind, size, rgba = marker.kind, marker.size, marker.rgba
        position = np.asarray(marker.position, dtype=float)
        end = position if marker.end is None else np.asarray(marker.end, dtype=float)
        quaternion, axes = np.empty(4), np.empty(9)
        mujoco.mju_quatZ2Vec(quaternion, end - position)  # upright where there is no end
        mujoco.mju_quat2Mat(axes, quaternion)
        axes = axes.reshape(3, 3)
        if kind in ("goal", "sphere"):
            self._add("SPHERE", rgba, (size,) * 3, position, axes).label = marker.label
        if kind == "goal":
            foot = np.array([position[0], position[1], 0.004])  # [m], clear of the ground
            core = (*rgba[:3], min(1.0, 3.0 * rgba[3]))
            self._add("SPHERE", core, (0.22 * size,) * 3, position, axes)
            self._add_chain("CYLINDER", (foot, position), (*rgba[:3], 0.55), 0.05 * size)
            self._add_circle(foot, np.eye(3), 1.8 * size, rgba, every=2)
        elif kind == "ring":
            self._add_circle(position, axes, size, rgba)
        elif kind == "pad":
            if marker.end is None:
                position = position * (1.0, 1.0, 0.0)
            self._add("CYLINDER", PAD_RGBA, (size, 0.004, 0), position, axes)
            for share in (1.0, 0.62):
                self._add_circle(position, axes, share * size, rgba)
            # The letter H: where its two posts and its bar are, and half of their extents.
            for x, width, height in ((-0.17, 0.045, 0.29), (0.17, 0.045, 0.29), (0, 0.17, 0.04)):
                centre = position + axes @ (size * x, 0.0, 0.005)
                self._add("BOX", rgba, (size * width, size * height, 0.001), centre, axes)
        elif kind == "path":
            self._add_chain("BOX", marker.points, rgba, size)
        elif kind in ("line", "arrow"):
            self._add_chain("ARROW" if kind == "arrow" else "CYLINDER", (position, end), rgba, size)
        if marker.label and kind not in ("goal", "sphere"):
            first = marker.points[0] if kind == "path" and len(marker.points) else position
            self._add("LABEL", rgba, np.zeros(3), np.asarray(first), axes).label = marker.label
