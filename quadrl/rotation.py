"""Attitude: quaternions, rotation matrices and the sines and cosines of the Z-Y-X angles.

Arrays are (..., k) of any namespace of the array API (NumPy, PyTorch). Quaternions are
(w, x, y, z), body to world; a rotation matrix takes body to world. Observations are built from
additions, products, quotients and square roots alone, which IEEE 754 rounds exactly: the same
numbers come out for one aircraft, for a batch, and from the C kernel (`native/state.c`).
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
from array_api_compat import array_namespace

Array: TypeAlias = Any
"""An array of any namespace of the array API: numpy.ndarray, torch.Tensor."""


def namespace(array: Array) -> Any:
    """The array API namespace of an array: NumPy itself for NumPy's (the short way)."""
    if isinstance(array, (np.ndarray, np.generic)):
        return np
    return array_namespace(array)


def stack(*parts: Array) -> Array:
    """Components (...) of vectors as one array (..., k)."""
    first = parts[0]
    if isinstance(first, np.ndarray) and first.ndim:
        whole = np.empty((*first.shape, len(parts)), np.result_type(*parts))
        for k, part in enumerate(parts):
            whole[..., k] = part
        return whole
    if isinstance(first, (np.ndarray, np.generic)):
        return np.array(parts)
    return namespace(first).stack(parts, axis=-1)


def held(values: Array) -> Array:
    """A copy (...) of live values; of one aircraft a scalar, with which NumPy counts faster."""
    return values[()] if values.ndim == 0 else values + 0.0


def square_norm(vector: Array) -> Array:
    """Sum of squares over the last axis, (..., k) to (...), added from left to right."""
    if _is_single(vector):
        return np.float64(_sum_of_squares(vector.tolist()))
    return _sum_of_squares([vector[..., k] for k in range(vector.shape[-1])])


def norm(vector: Array) -> Array:
    """Euclidean norm over the last axis, (..., k) to (...)."""
    if _is_single(vector):
        # Python's numbers are the same doubles, and ten times faster than arrays without axes.
        return np.float64(math.sqrt(_sum_of_squares(vector.tolist())))
    return namespace(vector).sqrt(square_norm(vector))


def _is_single(vector: Array) -> bool:
    """Whether it is one NumPy vector of doubles."""
    return isinstance(vector, np.ndarray) and vector.ndim == 1 and vector.dtype.char == "d"


def _sum_of_squares(parts: list[Array]) -> Array:
    total = parts[0] * parts[0]
    for part in parts[1:]:
        total = total + part * part
    return total


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
    if _is_single(vector):
        # As in `norm`: the same doubles in the same order.
        (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
        x, y, z = vector.tolist()
        return np.array((a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z))
    rows = [rotation[..., k, :] * vector[..., k, None] for k in range(3)]
    return rows[0] + rows[1] + rows[2]


def to_world(rotation: Array, vector: Array) -> Array:
    """Body vector (..., 3) in the world frame: the rotation times the vector."""
    return (rotation * vector[..., None, :]).sum(-1)


def sin_cos_attitude(rotation: Array) -> tuple[Array, Array]:
    """Sines and cosines (..., 3) of roll, pitch and yaw (Z-Y-X) of a rotation matrix.

    Straight up or down, where roll and yaw are one rotation, both quotients are still bounded.
    """
    xp = namespace(rotation)
    r = rotation
    horizontal = xp.sqrt(r[..., 0, 0] * r[..., 0, 0] + r[..., 1, 0] * r[..., 1, 0])
    cos_pitch = xp.where(horizontal > 1e-9, horizontal, xp.full_like(horizontal, 1e-9))
    sines = (r[..., 2, 1] / cos_pitch, -r[..., 2, 0], r[..., 1, 0] / cos_pitch)
    cosines = (r[..., 2, 2] / cos_pitch, horizontal, r[..., 0, 0] / cos_pitch)
    return stack(*sines), stack(*cosines)


def quaternion_product(first: Array, second: Array) -> Array:
    """Hamilton product (..., 4): the rotation `second` followed by `first`."""
    a, b, c, d = (first[..., k] for k in range(4))
    w, x, y, z = (second[..., k] for k in range(4))
    return stack(
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def quaternion_from_heading_and_tilt(heading: Array, tilt: Array, direction: Array) -> Array:
    """Unit quaternion (..., 4) of a heading, then a tilt about a level body axis.

    Args:
        heading: (...) [rad], counter-clockwise from east.
        tilt: (...) [rad], the angle between the body's z axis and the vertical.
        direction: (...) [rad], of the axis of the tilt in the body's x-y plane, from x.
    """
    xp = namespace(heading)
    zero = xp.zeros_like(heading)
    turn = stack(xp.cos(heading / 2), zero, zero, xp.sin(heading / 2))
    half = xp.sin(tilt / 2)
    lean = stack(xp.cos(tilt / 2), half * xp.cos(direction), half * xp.sin(direction), zero)
    return quaternion_product(turn, lean)
