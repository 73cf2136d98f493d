"""Solids in the world of N aircraft: their poses in each row, clearances and touches.

A solid is one or more geoms of the world that MuJoCo lets aircraft collide with. Their sizes are
the model's; where they stand is a row's own, and a new one at each reset. `native/solids.h` knows
how far a point is from one, so that free flight hands over whoever comes near.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from quadrl.aircraft.parameters import MARK
from quadrl.base.primitives import Shape
from quadrl.base.rotation import rotation_matrix
from quadrl.engines import native

KINDS: dict[mujoco.mjtGeom, Shape] = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
}
"""What a solid can be made of."""
SOLID = np.dtype([("kind", "f8"), ("size", "f8", 3), ("position", "f8", 3), ("turn", "f8", 9)])
"""`Solid` in native/solids.h."""


def geoms_of_solids(model: mujoco.MjModel) -> np.ndarray:
    """Numbers (K,) of the geoms that make up solids: those whose user data names one."""
    if model.nuser_geom < 2:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(model.geom_user[:, 0] == MARK)


class Solids:
    """K geoms that stand somewhere else in each of N rows."""

    def __init__(self, model: mujoco.MjModel, count: int) -> None:
        """Take kinds and sizes from the model; all stand at the origin until they are placed.

        Args:
            model: With the geoms.
            count: Number of aircraft, N.
        """
        self.geoms = geoms_of_solids(model)
        _, which, *offset = model.geom_user[self.geoms].T[:5] if len(self.geoms) else [[]] * 5
        self._first = np.unique(which, return_index=True)[1]  # geom of each solid
        self._offsets = np.transpose(offset)[self._first]
        self.centres = np.zeros((count, len(self._first), 3))
        """Of the S solids, (N, S, 3) [m], task frame, live."""
        self.table = np.zeros((count, len(self.geoms)), dtype=SOLID)
        self.table["kind"] = model.geom_type[self.geoms]
        self.table["size"] = model.geom_size[self.geoms]
        self.table["turn"] = np.eye(3).reshape(-1)

    def place(
        self,
        rows: np.ndarray,
        poses: np.ndarray,
        origin: np.ndarray,
        field: Callable[[str], np.ndarray],
    ) -> None:
        """Put the solids of some rows (n,) somewhere.

        Args:
            rows: Which.
            poses: (n, K, 7) position [m], world frame, and quaternion (w, x, y, z).
            origin: (3,) of the task frame [m], world frame.
            field: Gives a field of the model with a leading axis N, live.
        """
        position, quaternion = poses[..., :3], poses[..., 3:]
        turn = rotation_matrix(quaternion)
        self.table["position"][rows] = position
        self.table["turn"][rows] = turn.reshape(*turn.shape[:-2], 9)
        offset = turn[:, self._first] @ self._offsets[..., None]
        self.centres[rows] = position[:, self._first] - offset[..., 0] - origin
        field("geom_pos")[np.ix_(rows, self.geoms)] = position
        field("geom_quat")[np.ix_(rows, self.geoms)] = quaternion

    def poses(self, field: Callable[[str], np.ndarray]) -> np.ndarray:
        """Where they stand now, (N, K, 7), as `place` takes it."""
        parts = (field(name)[:, self.geoms] for name in ("geom_pos", "geom_quat"))
        return np.ascontiguousarray(np.concatenate(list(parts), axis=-1))

    def clearance(
        self, qpos: np.ndarray, parameters: np.ndarray, rotors: int, rows: np.ndarray | None = None
    ) -> np.ndarray:
        """Lower bound of each aircraft's distance to the nearest solid, (n,) [m].

        Args:
            qpos: (N, 7), live.
            parameters: Rows (N,), or (1,) for all.
            rotors: How many each has.
            rows: Of which aircraft; by default of all.
        """
        table = self.table
        if rows is not None:
            qpos, table = qpos[rows], table[rows]
            parameters = parameters[rows] if len(parameters) > 1 else parameters
        out = np.full(len(qpos), np.inf)
        if len(self.geoms):
            row = parameters.strides[0] // 8 if len(parameters) > 1 else 0
            arrays = (qpos, parameters, table)
            # As `Rows` in native/solids.c.
            where = np.array(
                [*(array.ctypes.data for array in arrays), qpos.strides[0] // 8, row,
                 len(self.geoms), rotors]
            )  # fmt: skip
            native.library().quadrl_clearance(where.ctypes.data, len(qpos), out.ctypes.data)
        return out
