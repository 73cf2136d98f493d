"""The cameras that move with the aircraft: they keep the goal in view, and never roll."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from quadrl.aircraft.vehicle import DRAWN_SIZE
from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array, roll_pitch_yaw
from quadrl.core.markers import Marker

FOLLOW, CHASE = "follow", "chase"
MOVING = (FOLLOW, CHASE)
"""The names of these cameras: one looks east-north-east, the other from behind the aircraft."""
AZIMUTH, ELEVATION = 30.0, -21.0  # [deg], of "follow"
CHASE_ELEVATION = -17.0  # [deg]
DISTANCE = (1.35, 7.0)  # [m]; the nearer one holds for an aircraft with scale 1
ROOM = np.array([2.0, 2.0, 3.0])  # [m] back for each metre of the box east, north and up
WIDE = 4 / 3  # width over height of a picture from which this is room enough
SMOOTHING = 0.4  # [s], standard deviation of the low pass of a recorded flight
LAG = 0.3  # [s], time constant of the low pass of a flight in progress


def aircraft_scale(model: mujoco.MjModel) -> float:
    """Size of a model's aircraft, as a multiple of the drawings in assets/."""
    sites = [model.site(f"rotor_{k + 1}").pos for k in range(model.nu)]
    return float(np.linalg.norm(np.array(sites)[:, :2], axis=1).max()) / DRAWN_SIZE


def in_view(goal: Array, markers: Sequence[Marker | Primitive] = ()) -> Array:
    """Points (n, 3) [m] to keep in view: of the goal, and of spheres, rings, pads and paths.

    A primitive adds none, since it does not say what it is for.
    """
    return np.vstack([np.asarray(goal, dtype=float)[None], *map(_extent, markers)])


def _extent(marker: Marker | Primitive) -> Array:
    """Points (n, 3) [m] of a marker to keep in view."""
    if isinstance(marker, Primitive) or marker.kind in ("goal", "line", "arrow"):
        return np.empty((0, 3))
    centre = np.asarray(marker.position, dtype=float)
    if marker.kind == "path":
        return np.asarray(marker.points, dtype=float).reshape(-1, 3)
    if marker.kind == "sphere":
        return centre[None]
    axis = np.array([0.0, 0.0, 1.0])
    if marker.end is not None:
        way = np.asarray(marker.end, dtype=float) - centre
        axis = way / max(float(np.linalg.norm(way)), 1e-9)
    elif marker.kind == "pad":
        centre = centre * (1.0, 1.0, 0.0)
    half = marker.size * np.sqrt(np.clip(1 - axis**2, 0.0, 1.0))  # of the box around a circle
    return np.stack([centre - half, centre + half])


def moving_views(
    camera: str,
    qpos: Array,
    goals: Array,
    markers: Sequence[Sequence[Marker | Primitive]],
    scale: float = 1.0,
    aspect: float = WIDE,
) -> Array:
    """Compute the views of a moving camera, which steps back to keep goal and markers in view.

    A marker far away, for the size of the aircraft, counts as if it stood nearer.

    Args:
        camera: One of MOVING; "chase" stays nearer, and keeps the goal alone in view.
        qpos: (T, 7) position [m] and attitude (w, x, y, z) of the aircraft, world frame.
        goals: (T, 3) [m], world frame.
        markers: What else is drawn in each of the T pictures, world frame.
        scale: Scale of the aircraft, see `aircraft_scale`.
        aspect: Aspect of the pictures, width over height.

    Returns:
        (T, 6): the point that it looks at and the distance from it [m], azimuth and elevation
        [deg].
    """
    position, (nearest, farthest) = qpos[:, :3], DISTANCE
    chase = camera == CHASE
    # Otherwise a small aircraft would be a dot beside a long path. The goal is always in view.
    reach = farthest / 2 * math.sqrt(scale)
    boxes = []
    for at, goal, also in zip(position, goals, markers, strict=True):
        near = _drawn_near(at, in_view(goal, () if chase else also), reach)
        boxes.append(np.vstack([at, near]))
    half = np.array([(box.max(0) - box.min(0)) / 2 for box in boxes])
    aside = np.array([box.min(0) for box in boxes]) + half - position
    radius = np.linalg.norm(half, axis=-1, keepdims=True)
    distance = np.clip(_back(half, scale, aspect), nearest * scale, farthest)
    # The aircraft itself stays in view, however far away the rest is.
    aside = aside * np.minimum(1.0, farthest / 4 / np.maximum(radius, 1e-9))
    angles = np.empty((len(position), 2))
    angles[:] = AZIMUTH, ELEVATION
    if chase:
        yaw = np.unwrap(roll_pitch_yaw(qpos[..., 3:7])[..., 2])  # it does not jump
        angles[:] = np.stack([np.degrees(yaw), np.full(len(qpos), CHASE_ELEVATION)], axis=-1)
    return np.concatenate([position + aside, distance, angles], axis=1)


def keeping(views: Array, position: Array, scale: float, aspect: float) -> Array:
    """Step back the views (T, 6) that the aircraft, at (T, 3) [m], flew out of."""
    back = _back(np.abs(position - views[:, :3]), scale, aspect)[:, 0]
    return np.column_stack([views[:, :3], np.maximum(views[:, 3], back), views[:, 4:]])


def _back(half: Array, scale: float, aspect: float) -> Array:
    """Distance (T, 1) [m] from which a box, half as long as (T, 3) [m], and an aircraft fit."""
    # Pictures are wider than high, and depth takes little of either.
    level = max(1.0, WIDE / aspect)
    return 0.75 * scale + np.linalg.norm(half * ROOM * (level, level, 1.0), axis=-1, keepdims=True)


def _drawn_near(position: Array, points: Array, reach: float) -> Array:
    """Pull points (n, 3) [m], all but the first, to within `reach` [m] of a position (3,)."""
    ways = points[1:] - position
    away = np.linalg.norm(ways, axis=1, keepdims=True)
    pulled = position + ways * np.minimum(1.0, reach / np.maximum(away, 1e-9))
    return np.vstack([points[:1], pulled])


def smoothed(views: Array, deviation: float) -> Array:
    """Smooth the views (T, 6) of a whole flight with a Gaussian, which adds no lag.

    Its standard deviation is a number of views.
    """
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(views, deviation, axis=0, mode="nearest"))


def moving_camera(view: Array) -> mujoco.MjvCamera:
    """The camera of a view (6,)."""
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat, camera.distance, camera.azimuth, camera.elevation = view[:3], *view[3:]
    return camera


def eased(view: Array, last: Array, seconds: float) -> Array:
    """Follow a view (6,) of a flight in progress with a lag, some seconds after the last view."""
    turn = (view[4] - last[4] + 180.0) % 360.0 - 180.0  # the short way round
    way = np.array([*(view[:4] - last[:4]), turn, view[5] - last[5]])
    return last + (1 - math.exp(-seconds / LAG)) * way
