"""The world of a task: its solids and where they are in each episode.

A task declares its solids (`Task.solids`) and places them at each reset (`Task.place`), each row
for itself. Aircraft collide with them in both engines; free flight hands an aircraft that comes
near one to MuJoCo. `Scene.world` measures clearances and hits.
"""

# pyright: reportUnnecessaryIsInstance=false
# What users give is checked, whatever its annotation promises.
from __future__ import annotations

import dataclasses
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from quadrl.aircraft.parameters import HELD, MARK
from quadrl.base.errors import QuadrlError
from quadrl.base.primitives import Primitive
from quadrl.conditions.solids import Pose, Solid, write_pose
from quadrl.conditions.world import FAR, World
from quadrl.engines.engine import Engine
from quadrl.engines.rays import Rays
from quadrl.engines.solids import KINDS, MOTION
from quadrl.engines.state import Start

FASTEST, WIDEST = 100.0, 0.5
"""The fastest that a solid may move [m/s], and how far it may turn in a physics step [rad]."""
HIDDEN = 3
"""Geom group that pictures do not show: they draw the solids where they are in the episode."""
BEAM, BEAM_RGBA = 0.004, (0.95, 0.45, 0.25, 0.35)
"""Half the width [m] and the colour of rays in pictures."""
UPRIGHT = 1.0, 0.0, 0.0, 0.0
ELSEWHERE = (1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5)
"""Pose with which the geoms are compiled: MuJoCo would assume that geoms at the origin, upright,
stay there."""


class Scene:
    """The solids of a task, in the order of their geoms."""

    def __init__(self, solids: Sequence[Solid], rays: Mapping[str, Rays | None] = {}) -> None:
        """Check the names.

        Args:
            solids: The solids.
            rays: Rays that are measured, by the names of their sensors; None where one has none.

        Raises:
            QuadrlError: Two solids have the same name, or something is not a solid.
        """
        given: list[Any] = [*solids] if isinstance(solids, Sequence) else [None]
        if not all(isinstance(solid, Solid) for solid in given):
            allowed = "a list of Sphere, Cylinder, Box and Gate of quadrl.conditions.solids"
            raise QuadrlError(name="solids", value=solids, allowed=allowed)
        self.solids, self.rays = tuple(solids), {k: own for k, own in rays.items() if own}
        self.names = tuple(solid.name for solid in self.solids)
        """Names of the solids, in order."""
        if len(set(self.names)) < len(self.names):
            raise QuadrlError(name="solids", value=self.names, allowed="a name of its own for each")
        ends = np.cumsum([0, *(solid.count or 1 for solid in self.solids)]).tolist()
        self._places: dict[str, int | slice] = {
            solid.name: slice(*ends[k : k + 2]) if solid.count else ends[k]
            for k, solid in enumerate(self.solids)
        }
        ends = np.cumsum([0, *(own.count for own in self.rays.values())]).tolist()
        self._beams = {k: slice(*pair) for k, *pair in zip(self.rays, ends, ends[1:], strict=False)}
        self._parts = [(s, part) for s in self.solids for part in (s.count or 1) * s.parts]
        """The geoms: the solid that each is of, and its part."""
        self._first = np.cumsum([0, *((s.count or 1) * len(s.parts) for s in self.solids)]).tolist()
        """Number of the first geom of each solid, and of all."""
        parts = [(solid.position, part.size, part.offset) for solid, part in self._parts]
        self._declared = np.array(parts, dtype=float).reshape(-1, 3, 3).swapaxes(0, 1)
        """Centres (K, 3) of the geoms' solids, task frame, and the geoms' sizes and offsets from
        them [m]."""

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the geoms to a world; each row has poses of its own."""
        position, quaternion = ELSEWHERE
        each = ((s, k) for s in self.solids for k in (range(s.count) if s.count else [None]))
        for index, (solid, number) in enumerate(each):
            name = solid.name if number is None else f"{solid.name}[{number}]"
            for k, part in enumerate(solid.parts):
                geom = spec.worldbody.add_geom(
                    name=f"{name}_{k}", type=part.kind, size=part.size, pos=position,
                    quat=quaternion, rgba=solid.rgba, contype=1, conaffinity=0, group=HIDDEN,
                )  # fmt: skip
                geom.userdata = [MARK, index, *part.offset, solid.grip, *np.zeros(12)]
        if self.solids:
            spec.nuser_geom = MOTION + 12

    def check(self, engine: Engine) -> None:
        """Refuse an engine whose world has other solids.

        Raises:
            QuadrlError: The message names the solids.
        """
        if len(engine.solids.geoms) != len(self._parts):
            allowed = f"made with the solids of the task: {', '.join(self.names) or 'none'}"
            raise QuadrlError(name="engine", value=engine, allowed=allowed)

    def poses(
        self,
        placed: Mapping[str, Pose],
        count: int,
        origin: np.ndarray,
        last: np.ndarray | None = None,
    ) -> np.ndarray:
        """Poses of the geoms in the world, as engines take them, (n, K, 7), with sizes (n, K, 13).

        Args:
            placed: Poses of solids by name.
            count: Number of rows, n.
            origin: Origin (3,) [m] of the task frame in the world frame.
            last: Poses of the other solids; by default the declared ones.

        Raises:
            QuadrlError: These are no poses, there is no such solid, or an array has the wrong shape
                or numbers that no pose has.
        """
        given: list[Any] = [*placed.values()] if isinstance(placed, Mapping) else [None]
        if not all(isinstance(pose, Pose) for pose in given):
            name = "move" if last is not None else "place (or move, at the start)"
            raise QuadrlError(name=name, value=placed, allowed="a dict of a Pose for each name")
        if unknown := set(placed) - set(self.names):
            raise QuadrlError(name="place", value=sorted(unknown), allowed=", ".join(self.names))
        if last is None:
            sized = any(pose.size is not None for pose in placed.values())
            centres, *own = self._declared
            turns = np.tile(UPRIGHT, (len(centres), 1))
            declared = [centres + origin + own[1], turns, *(own if sized else ())]
            made = np.tile(np.hstack(declared), (count, 1, 1))
        else:
            made = last.copy()
        for k, solid in enumerate(self.solids):
            if (pose := placed.get(solid.name)) is not None:
                own = made[:, self._first[k] : self._first[k + 1]]
                if last is not None:
                    own[..., 3:7] = UPRIGHT
                shape = count, solid.count or 1, len(solid.parts), made.shape[-1]
                write_pose(solid, pose, origin, own.reshape(shape))
        return made

    def check_move(self, last: np.ndarray, poses: np.ndarray, timestep: float) -> None:
        """Refuse solids that jump between poses (n, K, 7 or 13), a physics step [s] apart.

        Raises:
            QuadrlError: The message has the solid, its speed and its turn.
        """
        speed = np.linalg.norm(poses[..., :3] - last[..., :3], axis=-1) / timestep
        cosine = abs((poses[..., 3:7] * last[..., 3:7]).sum(axis=-1))
        turn = 2 * np.arccos(np.minimum(cosine, 1.0))
        if len(wrong := np.argwhere((speed > FASTEST) | (turn > WIDEST))):
            row, geom = map(int, wrong[0])
            solid = self._parts[geom][0].name
            raise QuadrlError(
                "else it would throw what it touches",
                name=f"speed [m/s] of {solid} in `move`, and turn [rad] in a physics step",
                value=[round(float(each[row, geom]), 3) for each in (speed, turn)],
                allowed=f"at most {FASTEST:g} and {WIDEST:g}",
            )

    def check_start(
        self,
        engine: Engine,
        rows: np.ndarray,
        start: Start,
        poses: np.ndarray | None,
    ) -> None:
        """Refuse aircraft that `Engine.place`, given the same, would put into a solid.

        With the middle of the hull or of a rotor: they may begin on their feet.

        Raises:
            QuadrlError: The message has the rows and where the first of them would be.
        """
        qpos = np.concatenate([start.position + engine.origin, start.quaternion], axis=-1)
        if len(inside := np.flatnonzero(engine.solids.is_inside(rows, poses, qpos))):
            reason = f"rows that begin in one: {reprlib.repr(rows[inside].tolist())}"
            value, allowed = start.position[inside[0]], f"outside of {', '.join(self.names)}"
            raise QuadrlError(reason, name="position at the start", value=value, allowed=allowed)

    def nothing_near(self, count: int) -> World:
        """The world of aircraft (n,) far from every solid, for use without an engine."""
        each = [(s.count or 1) * [s.position] for s in self.solids]
        declared = np.array([place for places in each for place in places], float).reshape(-1, 3)
        position = np.tile(declared, (count, 1, 1))
        touched = np.zeros(position.shape[:2], dtype=bool)
        far, never = np.full(count, FAR), np.zeros(count, dtype=bool)
        touch = np.zeros((count, HELD - 1))
        reaches = [np.full(own.count, own.reach) for own in self.rays.values()]
        rays = np.tile(np.concatenate([np.zeros(0), *reaches]), (count, 1))
        measured = position, far, touched, 0.0 * far, never, touch, never, rays
        return World(self._places, self._beams, *measured)

    def primitives(self, engine: Engine, row: int) -> tuple[Primitive, ...]:
        """The solids of a row as pictures show them, and the rays that meet something."""
        poses = engine.solids.poses[row].copy()
        sizes = engine.solids.table["size"][row].copy()
        shown = [
            Primitive(KINDS[part.kind], size, pose[:3], pose[3:7], solid.rgba, glow=0.0)
            for (solid, part), pose, size in zip(self._parts, poses, sizes, strict=True)
        ]
        for own in self.rays.values():
            (distance,), qpos = own.measured(engine, np.array([row])), engine.qpos[row]
            ends = own.ends(qpos[:3], qpos[3:], distance)
            for k in np.flatnonzero(distance < own.reach):
                shown.append(Primitive("line", BEAM, points=ends[k], rgba=BEAM_RGBA))
        return tuple(shown)

    def world(self, engine: Engine, rows: np.ndarray | None = None) -> World | None:
        """The present world about some aircraft (n,) of an engine, or of all.

        None where there is nothing to measure: neither solids nor rays.

        Its arrays are copies, except for the positions of all aircraft's solids: if no solid moves,
        these are live, since they then change only with an episode.
        """
        if not (self.solids or self.rays):
            return None
        chosen = slice(None) if rows is None else rows
        measured = [own.measured(engine, rows) for own in self.rays.values()]
        rays = np.concatenate([np.zeros((len(engine.hits[chosen]), 0)), *measured], axis=1)
        if not self.solids:
            return dataclasses.replace(self.nothing_near(len(rays)), rays=rays)
        which, speed = engine.hits[chosen].T
        touched = np.zeros((len(which), engine.solids.centres.shape[1]), dtype=bool)
        hitting = np.flatnonzero(which)
        touched[hitting, which[hitting].astype(int) - 1] = True
        clear, centres = engine.clearance(rows), engine.solids.centres[chosen]
        centres = centres.copy() if engine.solids.moves else centres
        feet = engine.feet[chosen].copy()
        landed, held = feet[:, 0] > 0, feet[:, HELD] > 0
        measured = centres, clear, touched, speed.copy(), landed, feet[:, 1:HELD], held, rays
        return World(self._places, self._beams, *measured)
