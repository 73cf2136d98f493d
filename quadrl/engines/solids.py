"""Solids in the world of N aircraft: their poses in each row, and clearances.

A solid is one or more geoms of the world with which MuJoCo lets aircraft collide. Each row has
poses of its own, which change at a reset or, if they move, at each physics step; the sizes are the
model's, or a row's own, too. `native/solids.h` computes the distance of a point from a solid, so
that free flight can hand an aircraft that comes near one to MuJoCo.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import mujoco
import numpy as np

from quadrl.aircraft.parameters import MARK
from quadrl.base.primitives import Shape
from quadrl.base.rotation import cross, rotation_matrix
from quadrl.engines import native
from quadrl.engines.threads import Threads

KINDS: dict[mujoco.mjtGeom, Shape] = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
}
"""Geoms that a solid can be made of, and their names in pictures."""
MOTION = 6
"""Index in a geom's user data of its velocity and angular velocity, and of their derivatives."""
SOLID = np.dtype([("kind", "f8"), ("size", "f8", 3), ("position", "f8", 3), ("turn", "f8", 9)])
"""`Solid` in native/solids.h."""
NEARBY = np.dtype([("place", "f8", 3), ("leap", "f8"), ("distance", "f8", 9), ("solid", SOLID, 8)])
"""`Nearby` there."""
MARGIN = 0.05
"""Clearance at which MuJoCo takes over from free flight [m]; larger than the margin of a
contact."""


def geoms_of_solids(model: mujoco.MjModel) -> np.ndarray:
    """Numbers (K,) of the geoms that make up solids, which their user data marks."""
    if model.nuser_geom < 2:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(model.geom_user[:, 0] == MARK)


class Solids:
    """K geoms with poses of their own in each of N rows."""

    def __init__(
        self,
        model: mujoco.MjModel,
        count: int,
        origin: np.ndarray,
        field: Callable[[str], np.ndarray],
        threads: Threads,
    ) -> None:
        """Take kinds and sizes from the model; all are at the origin until they are placed.

        Args:
            model: The model with the geoms.
            count: Number of aircraft, N.
            origin: Origin (3,) of the task frame [m], world frame.
            field: Returns a field of the model with a leading axis N, live.
            threads: Threads for the measurement of clearances.
        """
        self.geoms, self._origin, self._field = geoms_of_solids(model), origin, field
        self.threads, self._kernel = threads, native.library().quadrl_clearance
        self.outline, self._middles = _outline(model), _middles(model)
        _, which, *offset = model.geom_user[self.geoms].T[:5] if len(self.geoms) else [[]] * 5
        self._first = np.unique(which, return_index=True)[1]  # geom of each solid, (S,)
        self._declared = np.hstack([model.geom_size[self.geoms], np.transpose(offset)])  # (K, 6)
        self.centres = np.zeros((count, len(self._first), 3))
        """Centres of the S solids, (N, S, 3) [m], task frame, live."""
        self.table = np.zeros((count, len(self.geoms)), dtype=SOLID)
        self.table["kind"] = model.geom_type[self.geoms]
        self.table["size"] = model.geom_size[self.geoms]
        self.table["turn"] = np.eye(3).reshape(-1)
        self.nearby = np.zeros(count if len(self.geoms) else 0, dtype=NEARBY)
        """Lists of the solids nearest to each aircraft; unknown where the place is NaN."""
        self.nearby["place"] = np.nan
        self.poses = np.zeros((count, len(self.geoms), 7))
        """Present poses (N, K, 7 or 13), as `place` takes them."""
        self.motion = np.zeros((count, len(self.geoms), 6))
        """Velocity [m/s] and angular velocity [rad/s] of the last move (N, K, 6), world frame."""
        self._last = self.poses.copy()  # those at the beginning of the physics step
        self.moves = False
        """Whether any has moved since it was placed."""

    def place(self, rows: np.ndarray, poses: np.ndarray) -> None:
        """Give the solids of some rows (n,) new poses.

        Args:
            rows: Which rows.
            poses: Position [m], world frame, and quaternion (w, x, y, z), (n, K, 7); where sizes
                differ by row (n, K, 13), with the size, as MuJoCo has it, and the offset of the
                geom from its solid's centre, solid's frame [m].
        """
        if poses.shape[-1] != self.poses.shape[-1]:
            self.poses, poses = self._with_sizes(self.poses), self._with_sizes(poses)
            self._last = self.poses.copy()
        if self.moves:
            self.poses[rows], self._last[rows], self.motion[rows] = poses, poses, 0.0
            self.nearby["leap"][rows] = 0.0
        self._stand(rows, poses, None if self.moves else self.poses)  # most stand where they stood

    def _with_sizes(self, poses: np.ndarray) -> np.ndarray:
        """The poses with the declared sizes and offsets where they have none, (n, K, 13)."""
        own = np.broadcast_to(self._declared, (len(poses), *self._declared.shape))
        return poses if poses.shape[-1] > 7 else np.concatenate([poses, own], axis=-1)

    def _stand(self, rows: np.ndarray, poses: np.ndarray, own: np.ndarray | None = None) -> None:
        """Write poses of the geoms of some rows for both engines.

        With those of all rows that stand written, `own`, only what differs, there, too.
        """
        if not len(self.geoms):
            return
        poses = np.ascontiguousarray(poses)
        names = "geom_pos", "geom_quat", *(("geom_size", "geom_rbound")[: poses.shape[-1] - 7])
        fields = [self._field(name) for name in names]
        sizes = poses.shape[-1], len(self.geoms), len(self._first), fields[0].shape[1]
        arrays = poses, self._declared, self._origin, rows, self.geoms, self._first, own
        where = *fields, *[None] * (4 - len(fields)), self.centres, self.table, self.nearby
        # As `Placing` in native/solids.c.
        given = native.struct(*arrays, *where, *sizes)
        native.library().quadrl_stand(given.ctypes.data, len(rows))

    def move(self, poses: np.ndarray, timestep: float) -> None:
        """Move the solids of all rows to poses, as `place` takes them, within a physics step [s].

        Contacts take into account the mean velocity and the acceleration since the step before,
        which MuJoCo does not know.
        """
        last, self.moves, poses = self._last, True, poses.copy()
        last[:] = self.poses
        # Of the two quaternions of an attitude the one nearer to the last.
        turns = (poses[..., 3:7] * last[..., 3:7]).sum(axis=-1, keepdims=True)
        poses[..., 3:7] *= np.where(turns < 0, -1.0, 1.0)
        self.poses[:] = poses
        self.stand(np.arange(len(poses)), 0.5)
        velocity = (poses[..., :3] - last[..., :3]) / timestep
        motion = np.concatenate([velocity, _turn_rate(last, poses, timestep)], axis=-1)
        # Before the first step after a start no velocity is known.
        known = self.motion.any(axis=-1, keepdims=True)
        faster = np.where(known, (motion - self.motion) / timestep, 0.0)
        self._field("geom_user")[:, self.geoms, MOTION:] = np.concatenate([motion, faster], axis=-1)
        self.motion[:] = motion
        if len(self.nearby):
            # No part of the aircraft is farther from a solid that it may touch than this.
            reach = self.outline[:1, 4] + np.linalg.norm(self.table["size"], axis=-1)
            speed, turn = (np.linalg.norm(motion[..., part], axis=-1) for part in np.s_[:3, 3:])
            leap = timestep * (speed + turn * reach).max(axis=1)
            self.nearby["leap"] = np.maximum(leap - MARGIN, 0.0)

    def stand(self, rows: np.ndarray, share: float) -> None:
        """Put the solids of some rows (n,) where they are after a share of the physics step."""
        between = (1 - share) * self._last[rows] + share * self.poses[rows]
        between[..., 3:7] /= np.linalg.norm(between[..., 3:7], axis=-1, keepdims=True)
        self._stand(rows, between)

    def arrive(self) -> None:
        """Write the poses at the end of the last step, if they moved."""
        if self.moves:
            self._stand(np.arange(len(self.poses)), self.poses)

    def save(self) -> np.ndarray:
        """Poses and velocities, (N, K, 13 or 19)."""
        return np.concatenate([self.poses, self.motion], axis=-1)

    def restore(self, saved: np.ndarray) -> None:
        """Restore what `save` returned."""
        poses, motion = np.split(saved, [-6], axis=-1)
        self.place(np.arange(len(poses)), poses)
        self.motion[:], self.moves = motion, self.moves or bool(motion.any())

    def clearance(
        self, qpos: np.ndarray, rows: np.ndarray | None = None, balls: np.ndarray | None = None
    ) -> np.ndarray:
        """Lower bound of each aircraft's distance to the nearest solid, (n,) [m].

        Args:
            qpos: (N, 7), live.
            rows: Which aircraft (n,); None for all.
            balls: From which balls, as `_outline` gives them; None for those.
        """
        out = np.full(len(qpos) if rows is None else len(rows), np.inf)
        balls = self.outline if balls is None else balls
        if len(self.geoms) and len(balls):
            arrays = (qpos, balls, self.table, self.nearby)
            # As `Rows` in native/solids.c.
            where = native.struct(*arrays, qpos.strides[0] // 8, len(self.geoms), len(balls))
            measure, about, into = self._kernel, where.ctypes.data, out.ctypes.data
            if rows is None:
                self.threads.call(lambda first, end: measure(about, first, end, None, into))
            else:
                measure(about, 0, len(rows), rows.ctypes.data, into)
        return out

    def is_inside(self, rows: np.ndarray, poses: np.ndarray | None, qpos: np.ndarray) -> np.ndarray:
        """Whether the middle of the hull or of a rotor would be in a solid, (n,) bool.

        Args:
            rows: Which aircraft, (n,).
            poses: Where solids would be, as `place` takes them; None for where they are.
            qpos: Where aircraft would be, (n, 7).
        """
        poses = self.poses[rows] if poses is None else poses
        # Few solids are so near that a ball about them reaches an aircraft, and are looked at.
        squares = np.zeros(poses.shape[:2])
        for j in range(3):
            offset = poses[..., j] - qpos[:, j, None]
            squares += np.square(offset, out=offset)
        sizes = poses[..., 7:10] if poses.shape[-1] > 7 else self._declared[:, :3]
        reach = self._middles[:, 4].max(initial=0.0) + sizes.sum(axis=-1)
        row, k = np.nonzero(squares <= reach**2)
        then, near = copy.copy(self), poses[row, k][:, None]
        then.geoms, then.table = self.geoms[:1], self.table[rows[row], k][:, None]
        then.nearby = np.zeros(len(row), NEARBY)
        then.nearby["place"] = np.nan
        then.table["position"] = near[..., :3]
        then.table["size"] = np.broadcast_to(sizes, (*squares.shape, 3))[row, k][:, None]
        then.table["turn"] = rotation_matrix(near[..., 3:7]).reshape(-1, 1, 9)
        places, inside = np.ascontiguousarray(qpos[row]), np.zeros(len(rows), dtype=bool)
        free = then.clearance(places, np.arange(len(row)), self._middles)
        inside[row[free < 0]] = True
        return inside


def _touching(model: mujoco.MjModel) -> np.ndarray:
    """Numbers of the geoms of an aircraft that can touch."""
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return np.flatnonzero(collides & (model.geom_bodyid == 1))


def _balls(balls: list[tuple[np.ndarray, float]]) -> np.ndarray:
    """Centres (3), radii and reaches (S, 5) [m] of balls, as `Ball` in native/solids.c."""
    made = np.array([(*c, radius, np.linalg.norm(c) + radius) for c, radius in balls])
    return made[np.argsort(-made[:, 4], kind="stable")] if balls else np.zeros((0, 5))


def _outline(model: mujoco.MjModel) -> np.ndarray:
    """Balls (S, 5) [m] that enclose what can touch of an aircraft, body frame; three for an arm."""
    balls: list[tuple[np.ndarray, float]] = []
    for k in _touching(model):
        centre, radius = model.geom_pos[k], float(model.geom_rbound[k])
        if model.geom_type[k] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            off = model.geom_size[k, 1] / 1.5  # of the outer thirds' middles
            third = off * rotation_matrix(model.geom_quat[k])[:, 2]
            radius -= off
            balls += [(centre - third, radius), (centre + third, radius)]
        balls.append((centre, radius))
    return _balls(balls)


def _middles(model: mujoco.MjModel) -> np.ndarray:
    """The inner half of the hull and the hubs of the rotors, as balls (S, 5) [m]."""
    within = {mujoco.mjtGeom.mjGEOM_ELLIPSOID: 0.5, mujoco.mjtGeom.mjGEOM_CYLINDER: 0.0}
    shares = [(k, within.get(mujoco.mjtGeom(model.geom_type[k]))) for k in _touching(model)]
    middles = [
        (model.geom_pos[k], s * model.geom_size[k].min()) for k, s in shares if s is not None
    ]
    return _balls(middles)


def _turn_rate(last: np.ndarray, poses: np.ndarray, timestep: float) -> np.ndarray:
    """Angular velocity (N, K, 3) [rad/s], world frame, between poses (N, K, 7 or 13)."""
    was, now = last[..., 3:7], poses[..., 3:7]
    half = was[..., :1] * now[..., 1:] - now[..., :1] * was[..., 1:]
    half = half + cross(was[..., 1:], now[..., 1:])
    return 2 * half / timestep
