"""The camera of videos: it moves with the aircraft, keeps the goal in view, and never rolls."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from quadrl.markers import Marker
from quadrl.rotation import Array
from quadrl.vehicle import DRAWN_SIZE

FOLLOW = "follow"
AZIMUTH, ELEVATION = 30.0, -21.0  # [deg]
DISTANCE = (1.35, 7.0)  # [m]; the nearer one holds for an aircraft with scale 1
ROOM = np.array([2.0, 2.0, 3.0])  # [m] back for each metre of the box east, north and up
SMOOTHING = 0.4  # [s], standard deviation of the low pass


def aircraft_scale(model: mujoco.MjModel) -> float:
    """Size of a model's aircraft, as a multiple of the drawings in assets/."""
    sites = [model.site(f"rotor_{k + 1}").pos for k in range(model.nu)]
    return float(np.linalg.norm(np.array(sites)[:, :2], axis=1).max()) / DRAWN_SIZE


def in_view(goal: Array, markers: Sequence[Marker]) -> Array:
    """What a camera should keep in view, (n, 3) [m]: the goal, and spheres (goals to come)."""
    return np.array([goal, *(m.position for m in markers if m.kind == "sphere")])


def follow_cameras(
    position: Array, shown: Sequence[Array], smoothing: float = 0.0, scale: float = 1.0
) -> list[mujoco.MjvCamera]:
    """Cameras that follow a flight smoothly and step back to keep some points in view.

    Args:
        position: (T, 3) [m], of the aircraft, world frame.
        shown: T arrays (n, 3) [m], world frame, n at least 1.
        smoothing: Standard deviation of the low pass [states]; it looks both ways: nothing lags.
        scale: Of the aircraft, see `aircraft_scale`.

    Returns:
        T cameras.
    """
    from scipy.ndimage import gaussian_filter1d

    boxes = [np.vstack([at, points]) for at, points in zip(position, shown, strict=True)]
    half = np.array([(box.max(0) - box.min(0)) / 2 for box in boxes])
    aside = np.array([box.min(0) for box in boxes]) + half - position
    nearest, farthest = DISTANCE
    radius = np.linalg.norm(half, axis=-1, keepdims=True)
    # Pictures are wider than high, and depth takes little of either.
    room = np.linalg.norm(half * ROOM, axis=-1, keepdims=True)
    distance = np.clip(0.75 * scale + room, nearest * scale, farthest)
    # The aircraft itself stays in view, however far away the rest is.
    aside = aside * np.minimum(1.0, farthest / 4 / np.maximum(radius, 1e-9))
    path = np.concatenate([position + aside, distance], axis=1)
    if smoothing > 0:
        path = np.asarray(gaussian_filter1d(path, smoothing, axis=0, mode="nearest"))
    cameras = [mujoco.MjvCamera() for _ in path]
    for camera, row in zip(cameras, path, strict=True):
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat, camera.distance = row[:3], row[3]
        camera.azimuth, camera.elevation = AZIMUTH, ELEVATION
    return cameras
