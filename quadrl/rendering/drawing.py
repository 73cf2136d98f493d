"""Everything that is drawn, as one list of primitives: parts of a model, markers, trails, wind.

MuJoCo (`scene.py`), the live viewer (`live/scene.py`) and the page in the browser (docs/fly) read
it; none of them knows what a goal, a pad or a rotor looks like.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import mujoco
import numpy as np

from quadrl.base.primitives import Mesh, Primitive, Shape
from quadrl.base.rotation import Array
from quadrl.core.markers import GOAL_RGBA, Marker

PAINTED = ("ground_marks", "ground_north")
"""The geoms of assets/landmarks.xml in a model."""
SHOWN_GROUPS = 3  # MuJoCo shows the groups 0 to 2
SHAPES: dict[int, Shape] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_MESH): "mesh",
}

GOAL_RADIUS = 0.08  # [m], of an aircraft with scale 1
PAD_RGBA = (0.10, 0.13, 0.17, 1.0)
LIFT = 0.01  # [m], of lines over the ground or a pad, which would flicker from afar
ANGLE = np.linspace(0, 2 * np.pi, 49)
CIRCLE = np.stack([np.cos(ANGLE), np.sin(ANGLE), np.zeros_like(ANGLE)], axis=-1)
LETTER = ((-0.17, 0.045, 0.29), (0.17, 0.045, 0.29), (0.0, 0.17, 0.04))
"""The letter H on a pad of radius 1: where its posts and its bar are, and half of their extents."""

TRAIL_SECONDS = 4.0
TRAIL_PIECES = 60
TRAIL_WIDTH = 0.008  # [m], of an aircraft with scale 1
SPEED_PIECES = 240  # of a trail of a whole flight
SLOW, FAST = np.array([0.15, 0.35, 0.95, 1.0]), np.array([1.0, 0.85, 0.10, 1.0])
TRAIL_OLD, TRAIL_NEW = np.array([0.35, 0.55, 0.80, 1.0]), np.array([1.0, 0.72, 0.30, 1.0])

STREAKS = 60
STREAK_BOX = np.array([2.3, 2.3, 1.7])  # [m], around an aircraft with scale 1, that they fill
STREAK_SECONDS = 0.05  # [s], for which the wind blows from one end of a streak to the other
STREAK_LONGEST = 0.8  # [m]
STREAK_WIDTH = 0.0017  # [m]
STREAK_RGBA = np.array([0.92, 0.97, 1.0, 0.8])
STREAK_TAIL = np.array([0.25, 0.55, 1.0, 1.0])  # opacity from the tail to the head, which leads
STILL = 0.1  # [m/s], under which nothing is shown
# Spread evenly over the unit cube: multiples of powers of the root of x^4 = x + 1 (Roberts 2018).
PLACES = np.arange(1, STREAKS + 1)[:, None] * 1.2207440846057596 ** -np.arange(1.0, 4.0) % 1.0


def parts(model: mujoco.MjModel, body: int) -> list[Primitive]:
    """The geoms of a body that are shown, in its frame, with their names; no plane is among them.

    Args:
        model: A drawn model.
        body: Number of the body: 0 for what stands in the world, 1 for the aircraft.
    """
    found = []
    for k in np.flatnonzero((model.geom_bodyid == body) & (model.geom_group < SHOWN_GROUPS)):
        shape, material = SHAPES.get(int(model.geom_type[k])), int(model.geom_matid[k])
        if shape is None:
            continue
        painted = material >= 0
        found.append(
            Primitive(
                shape,
                model.geom_size[k],
                model.geom_pos[k],
                model.geom_quat[k],
                model.mat_rgba[material] if painted else model.geom_rgba[k],
                glow=float(model.mat_emission[material]) if painted else 0.0,
                shine=float(model.mat_shininess[material]) if painted else 0.5,
                mesh=_mesh(model, int(model.geom_dataid[k])) if shape == "mesh" else None,
                name=model.geom(k).name,
            )
        )
    return found


def world(model: mujoco.MjModel) -> list[Primitive]:
    """What stands in the world, without the ground and what is painted on it."""
    return [one for one in parts(model, body=0) if one.name not in PAINTED]


def _mesh(model: mujoco.MjModel, number: int) -> Mesh:
    mesh = model.mesh(number)
    vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
    return Mesh(mesh.name, vertices, model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]])


def markers(shown: Iterable[Marker | Primitive]) -> Iterator[Primitive]:
    """Split markers into primitives, world frame; a primitive stays as it is."""
    for one in shown:
        if isinstance(one, Primitive):
            yield one
        else:
            yield from _marker(one)


def _marker(marker: Marker) -> Iterator[Primitive]:
    kind, size, rgba = marker.kind, marker.size, marker.rgba
    place = np.asarray(marker.position, dtype=float)
    end = place if marker.end is None else np.asarray(marker.end, dtype=float)
    facing, axes = np.empty(4), np.empty(9)
    mujoco.mju_quatZ2Vec(facing, end - place)  # upright where there is no end
    mujoco.mju_quat2Mat(axes, facing)
    axes = axes.reshape(3, 3)

    def circle(centre: Array, radius: float, every: int = 1) -> Primitive:
        edge = centre + radius * CIRCLE[::every] @ axes.T
        width = 0.02 * radius + 0.003
        return Primitive("line", width, rgba=(*rgba[:3], 1.0), points=edge)

    if kind in ("goal", "sphere"):
        yield Primitive("sphere", (size,) * 3, place, rgba=rgba)
    if kind == "goal":
        core = (*rgba[:3], min(1.0, 3.0 * rgba[3]))
        yield Primitive("sphere", (0.22 * size,) * 3, place, rgba=core)
        foot = np.array([place[0], place[1], LIFT])
        line = np.stack([foot, place])
        yield Primitive("line", 0.05 * size, rgba=(*rgba[:3], 0.55), points=line)
        yield circle(foot, 1.8 * size, every=2)
    elif kind == "ring":
        yield circle(place, size)
    elif kind == "pad":
        place = place * (1.0, 1.0, 0.0) if marker.end is None else place
        yield Primitive("cylinder", (size, 0.004, 0.0), place, facing, PAD_RGBA)
        for share in (1.0, 0.62):
            yield circle(place + axes @ (0.0, 0.0, LIFT), share * size)
        for x, width, height in LETTER:
            centre = place + axes @ (size * x, 0.0, 0.5 * LIFT)
            extents = (size * width, size * height, 0.4 * LIFT)
            yield Primitive("box", extents, centre, facing, rgba)
    elif kind == "path":
        place = np.asarray(marker.points, dtype=float).reshape(-1, 3)
        yield Primitive("line", size, rgba=rgba, points=place)
        place = place[0] if len(place) else np.zeros(3)
    elif kind in ("line", "arrow"):
        yield Primitive(kind, size, rgba=rgba, points=np.stack([place, end]))
    if marker.label:
        yield Primitive("label", size, place, rgba=rgba, name=marker.label)


def goal(place: Array, position: Array, scale: float) -> Marker:
    """The marker of a goal (3,) [m], clearer where the aircraft, at (3,) [m], would be hidden."""
    away = float(np.linalg.norm(place - position)) / scale
    opacity = GOAL_RGBA[3] * min(max(away / 0.4, 0.1), 1.0)
    return Marker("goal", tuple(place), GOAL_RADIUS * scale, (*GOAL_RGBA[:3], opacity))


def trail_colours(count: int) -> Array:
    """Colours (count, 4) of the points of a trail, oldest first."""
    return TRAIL_OLD + np.linspace(0, 1, count)[:, None] * (TRAIL_NEW - TRAIL_OLD)


def trail(points: Array, scale: float) -> Primitive:
    """The line through the last positions of an aircraft, (n, 3) [m], oldest first."""
    kept = np.unique(np.linspace(0, len(points) - 1, TRAIL_PIECES + 1).astype(int))
    width = scale * TRAIL_WIDTH * np.linspace(0, 1, len(kept)) ** 0.7
    return Primitive("line", width, rgba=trail_colours(len(kept)), points=points[kept])


def speed_trail(points: Array, speed: Array, fastest: float, scale: float) -> Primitive:
    """The line through positions (n, 3) [m], in the colours of the speeds there, (n,) [m/s]."""
    kept = np.unique(np.linspace(0, len(points) - 1, SPEED_PIECES + 1).astype(int))
    share = (speed[kept] / max(fastest, STILL))[:, None]
    colours = SLOW + share * (FAST - SLOW)
    return Primitive("line", 2 * scale * TRAIL_WIDTH, rgba=colours, glow=1.0, points=points[kept])


def streaks(position: Array, wind: Array, drift: Array, scale: float) -> tuple[Primitive, ...]:
    """Draw lines around an aircraft that drift with the air.

    Args:
        position: (3,) [m], of the aircraft, world frame.
        wind: (3,) [m/s], world frame.
        drift: (3,) [m], how far the air has moved since the flight began.
        scale: Scale of the aircraft, see `quadrl.rendering.camera.aircraft_scale`.
    """
    speed = float(np.linalg.norm(wind))
    if speed < STILL:
        return ()
    box = STREAK_BOX * math.sqrt(scale)
    # A streak that leaves the box comes in again on its other side; it fades towards the sides.
    place = (PLACES * box + drift - position) % box - box / 2
    fading = np.clip(3.0 * (1.0 - np.abs(2 * place / box)), 0.0, 1.0).prod(axis=1)
    way = wind * min(STREAK_SECONDS, STREAK_LONGEST / speed) * math.sqrt(scale)
    heads = position + place
    shown = (fading > 0.02) & (np.minimum(heads[:, 2], (heads - way)[:, 2]) > 0.0)
    behind = np.linspace(1.0, 0.0, len(STREAK_TAIL))[:, None] * way
    lines = []
    for head, fade in zip(heads[shown], fading[shown], strict=True):
        colours = np.tile(STREAK_RGBA, (len(STREAK_TAIL), 1))
        colours[:, 3] *= fade * STREAK_TAIL
        lines.append(Primitive("line", STREAK_WIDTH * scale, rgba=colours, points=head - behind))
    return tuple(lines)
