"""Attitude: quaternions, rotation matrices and the sines and cosines of the Z-Y-X angles.

Arrays are (N, ..., k) of any namespace of the array API (NumPy, PyTorch). Quaternions are
(w, x, y, z), body to world; a rotation matrix takes body to world. Observations are built from
additions, products, quotients and square roots alone, which IEEE 754 rounds exactly: the same
numbers come out for any number of rows, and from the C kernel (`native/state.c`).
"""

from __future__ import annotations

from typing import Any, TypeAlias, cast

import numpy as np
from array_api_compat import array_namespace

Array: TypeAlias = Any
"""An array of any namespace of the array API: numpy.ndarray, torch.Tensor."""


def namespace(array: Array) -> Any:
    """The array API namespace of an array; for NumPy's, which is quicker, NumPy itself."""
    if isinstance(array, (np.ndarray, np.generic)):
        return np
    return array_namespace(array)


def filled(value: Array | float, like: Array) -> Array:
    """A value in the shape, the namespace and on the device of an array, traced ones among them."""
    return 0.0 * like + value


def zeros(like: Array) -> Array:
    """Zeros like an array, each of the sign of its number, as `filled` makes them."""
    return 0.0 * like


def stack(*parts: Array) -> Array:
    """Components (...) of vectors as one array (..., k)."""
    first: Any = parts[0]
    if not isinstance(first, np.ndarray):
        return namespace(first).stack(parts, axis=-1)
    shape = (len(parts), *cast(np.ndarray, first).shape)
    # Each component is contiguous, as in the state's tables: NumPy's loops then run over rows.
    whole = np.empty_like(first, np.result_type(*parts), shape=shape)
    for k, part in enumerate(parts):
        whole[k] = part
    return whole.transpose(*range(1, whole.ndim), 0)


def square_norm(vector: Array) -> Array:
    """Sum of squares over the last axis, (..., k) to (...), added from left to right."""
    square = vector * vector
    total = square[..., 0]
    for k in range(1, vector.shape[-1]):
        total = total + square[..., k]
    return total


def dot(first: Array, second: Array) -> Array:
    """Scalar products (...) of vectors (..., 3)."""
    product = first * second
    return product[..., 0] + product[..., 1] + product[..., 2]


def cross(first: Array, second: Array) -> Array:
    """Cross product over the last axis (..., 3)."""
    a, b, c = (first[..., k] for k in range(3))
    x, y, z = (second[..., k] for k in range(3))
    return stack(b * z - c * y, c * x - a * z, a * y - b * x)


def norm(vector: Array) -> Array:
    """Euclidean norm over the last axis, (..., k) to (...); its gradient at zero is zero."""
    square: Any = square_norm(vector)
    if isinstance(square, np.ndarray):
        return np.sqrt(cast(np.ndarray, square))
    xp = namespace(square)
    positive = square > 0
    # The gradient of the square root is infinite at zero, and infinity times zero is NaN.
    return xp.where(positive, xp.sqrt(xp.where(positive, square, xp.ones_like(square))), 0 * square)


def rotation_matrix(quaternion: Array) -> Array:
    """Rotation matrix (..., 3, 3), body to world, of a unit quaternion (..., 4)."""
    xp = namespace(quaternion)
    w, x, y, z = (quaternion[..., k] for k in range(4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def to_body(rotation: Array, vector: Array) -> Array:
    """World vector (..., 3) in the body frame: the transposed rotation times the vector."""
    parts = rotation * vector[..., None]
    return parts[..., 0, :] + parts[..., 1, :] + parts[..., 2, :]


def to_world(rotation: Array, vector: Array) -> Array:
    """Body vector (..., 3) in the world frame: the rotation times the vector."""
    parts = rotation * vector[..., None, :]
    return parts[..., 0] + parts[..., 1] + parts[..., 2]


def sin_cos_attitude(rotation: Array) -> tuple[Array, Array]:
    """Sines and cosines (..., 3) of roll, pitch and yaw (Z-Y-X) of a rotation matrix.

    Straight up or down, where roll and yaw are one rotation, both quotients are still bounded.
    """
    xp = namespace(rotation)
    r = rotation
    horizontal = norm(r[..., :2, 0])
    cos_pitch = xp.where(horizontal > 1e-9, horizontal, xp.full_like(horizontal, 1e-9))
    sines = (r[..., 2, 1] / cos_pitch, -r[..., 2, 0], r[..., 1, 0] / cos_pitch)
    cosines = (r[..., 2, 2] / cos_pitch, horizontal, r[..., 0, 0] / cos_pitch)
    return stack(*sines), stack(*cosines)


def roll_pitch_yaw(quaternion: np.ndarray) -> np.ndarray:
    """The Z-Y-X angles (..., 3) [rad] of unit quaternions (..., 4).

    Right wing down and nose up are positive, and yaw is counted from east to north.
    """
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    roll = np.arctan2(2 * (y * z + w * x), 1 - 2 * (x**2 + y**2))
    pitch = np.arcsin(np.clip(2 * (x * z - w * y), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    return np.stack([roll, pitch, yaw], axis=-1)


def quaternion_from_heading_and_tilt(heading: Array, tilt: Array, direction: Array) -> Array:
    """Unit quaternion (..., 4) of a heading, then a tilt about a level body axis.

    Args:
        heading: (...) [rad], counter-clockwise from east.
        tilt: (...) [rad], the angle between the body's z axis and the vertical.
        direction: (...) [rad], of the axis of the tilt in the body's x-y plane, from x.
    """
    xp = namespace(heading)
    # Hamilton's product of the turn (c, 0, 0, s) and the lean (w, x, y, 0).
    c, s = xp.cos(heading / 2), xp.sin(heading / 2)
    w, half = xp.cos(tilt / 2), xp.sin(tilt / 2)
    x, y = half * xp.cos(direction), half * xp.sin(direction)
    return stack(c * w, c * x - s * y, c * y + s * x, s * w)


def heading_of(rotation: Array) -> Array:
    """Unit vectors (N, 2), east and north, of where body x points; east if up or down."""
    ahead = rotation[:, :2, 0]
    length = norm(ahead)[:, None]
    return np.where(length > 1e-6, ahead / np.maximum(length, 1e-6), np.array([1.0, 0.0]))


def rotation_of_angles(sines: Array, cosines: Array) -> Array:
    """Rotations (N, 3, 3), body to world, of sines and cosines (N, 3) of roll, pitch, yaw."""
    (sr, sp, sy), (cr, cp, cy) = sines.T, cosines.T
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
