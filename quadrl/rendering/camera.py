"""The cameras that move with the aircraft: they keep the goal in view, and never roll."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from quadrl.aircraft.vehicle import DRAWN_SIZE
from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array
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
    """What a camera should keep in view, (n, 3) [m]: the goal, spheres, rings, pads and paths.

    Of a primitive, which does not say what it is for, nothing has to be in view.

    "chase" stays nearer, and keeps the goal alone in view.
    """
    return np.vstack([np.asarray(goal, dtype=float)[None], *map(_extent, markers)])


def _extent(marker: Marker | Primitive) -> Array:
    """Points (n, 3) [m] that are in view where the marker is."""
    if isinstance(marker, Primitive):
        return np.empty((0, 3))
    centre = np.asarray(marker.position, dtype=float)
    if marker.kind == "path":
        return np.asarray(marker.points, dtype=float).reshape(-1, 3)
    if marker.kind == "sphere":
        return centre[None]
    if marker.kind not in ("ring", "pad"):
        return np.empty((0, 3))
    axis = np.array([0.0, 0.0, 1.0])
    if marker.end is not None:
        way = np.asarray(marker.end, dtype=float) - centre
        axis = way / max(float(np.linalg.norm(way)), 1e-9)
    elif marker.kind == "pad":
        centre = centre * (1.0, 1.0, 0.0)
    half = marker.size * np.sqrt(np.clip(1 - axis**2, 0.0, 1.0))  # of the box around a circle
    return np.stack([centre - half, centre + half])


def headings(qpos: Array) -> Array:
    """Bearing (T,) [rad] of the nose, from east to north, of poses (T, 7); it does not jump."""
    w, x, y, z = np.moveaxis(qpos[..., 3:7], -1, 0)
    return np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)))


def moving_views(
    position: Array,
    shown: Sequence[Array],
    scale: float = 1.0,
    heading: Array | None = None,
    aspect: float = WIDE,
) -> Array:
    """Where cameras look that step back to keep some points in view.

    Args:
        position: (T, 3) [m], of the aircraft, world frame.
        shown: T arrays (n, 3) [m], world frame, n at least 1; those after the first, which is the
            goal, count up to a distance that suits the aircraft's size.
        scale: Of the aircraft, see `aircraft_scale`.
        heading: (T,) [rad], along which they look; None for the bearing of "follow".
        aspect: Of the pictures, width over height.

    Returns:
        (T, 6): the point that they look at and the distance from it [m], azimuth and elevation
        [deg].
    """
    nearest, farthest = DISTANCE
    # Else a small aircraft would be a dot before a long path. Of the goal no part is left out.
    reach = farthest / 2 * math.sqrt(scale)
    near = [_drawn_near(at, points, reach) for at, points in zip(position, shown, strict=True)]
    boxes = [np.vstack([at, points]) for at, points in zip(position, near, strict=True)]
    half = np.array([(box.max(0) - box.min(0)) / 2 for box in boxes])
    aside = np.array([box.min(0) for box in boxes]) + half - position
    radius = np.linalg.norm(half, axis=-1, keepdims=True)
    # Pictures are wider than high, and depth takes little of either.
    level = max(1.0, WIDE / aspect)
    room = np.linalg.norm(half * ROOM * (level, level, 1.0), axis=-1, keepdims=True)
    distance = np.clip(0.75 * scale + room, nearest * scale, farthest)
    # The aircraft itself stays in view, however far away the rest is.
    aside = aside * np.minimum(1.0, farthest / 4 / np.maximum(radius, 1e-9))
    azimuth, elevation = np.full(len(position), AZIMUTH), ELEVATION
    if heading is not None:
        azimuth, elevation = np.degrees(heading), CHASE_ELEVATION
    angles = np.stack([azimuth, np.full(len(position), elevation)], axis=-1)
    return np.concatenate([position + aside, distance, angles], axis=1)


def _drawn_near(position: Array, points: Array, reach: float) -> Array:
    """Points (n, 3) [m], all but the first no farther away than `reach`."""
    ways = points[1:] - position
    away = np.linalg.norm(ways, axis=1, keepdims=True)
    pulled = position + ways * np.minimum(1.0, reach / np.maximum(away, 1e-9))
    return np.vstack([points[:1], pulled])


def follow_cameras(
    position: Array,
    shown: Sequence[Array],
    smoothing: float = 0.0,
    scale: float = 1.0,
    heading: Array | None = None,
    aspect: float = WIDE,
) -> list[mujoco.MjvCamera]:
    """T cameras that follow a flight smoothly.

    Of the arguments, `smoothing` is the standard deviation of the low pass [states], which looks
    both ways: nothing lags. The others are those of `moving_views`.
    """
    from scipy.ndimage import gaussian_filter1d

    views = moving_views(position, shown, scale, heading, aspect)
    if smoothing > 0:
        views = np.asarray(gaussian_filter1d(views, smoothing, axis=0, mode="nearest"))
    return [moving_camera(view) for view in views]


def moving_camera(view: Array) -> mujoco.MjvCamera:
    """The camera of a view (6,)."""
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat, camera.distance, camera.azimuth, camera.elevation = view[:3], *view[3:]
    return camera


def eased(view: Array, last: Array, seconds: float) -> Array:
    """The view (6,) of a flight in progress, which lags: the last one, and some seconds later."""
    turn = (view[4] - last[4] + 180.0) % 360.0 - 180.0  # the short way round
    way = np.array([*(view[:4] - last[:4]), turn, view[5] - last[5]])
    return last + (1 - math.exp(-seconds / LAG)) * way
