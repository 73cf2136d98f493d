"""Primitives as meshes: of a model for a browser (GLB), and one of each shape to be copied."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array
from quadrl.rendering import drawing

SHARPEST = 0.7  # [rad], an edge that is shaded round
SHAFT, HEAD = 0.5, 0.25  # of an arrow: width against its head's, and length of the head


class Meshes(NamedTuple):
    """A drawn model whose aircraft flies and whose blades turn; GLB, body frame."""

    solid: bytes  # of the aircraft, but for its blades
    clear: list[tuple[Any, Array]]  # a mesh for each transparent colour (4,), 0 to 1
    blades: list[bytes]  # of each rotor, in the frame of its hub
    hubs: list[tuple[Array, Rotation]]  # position (3,) [m] and attitude of each rotor's
    world: bytes | None  # what stands in the world, world frame


def of_model(model: mujoco.MjModel) -> Meshes:
    """Make the meshes of all that is drawn but the ground, for which the page has a grid."""
    blades: list[list[Primitive]] = [[] for _ in range(model.nu)]
    hubs, solid = np.tile(np.eye(4), (model.nu, 1, 1)), []
    clear: dict[tuple[float, ...], list[trimesh.Trimesh]] = {}
    for one in drawing.parts(model, model.body("aircraft").id):
        _, rotor, part, *_ = [*one.name.split("_"), "", ""]  # rotor_1_blade_a
        if part == "hub":
            hubs[int(rotor) - 1] = _pose(one)
        if part == "blade":
            blades[int(rotor) - 1].append(one)
        elif one.rgba[3] < 1.0:
            clear.setdefault(tuple(one.rgba), []).append(_mesh(one))
        else:
            solid.append(one)
    world = drawing.world(model)
    return Meshes(
        _glb(solid),
        [(trimesh.util.concatenate(same), np.array(rgba)) for rgba, same in clear.items()],
        [_glb(parts, np.linalg.inv(hub)) for parts, hub in zip(blades, hubs, strict=True)],
        [(hub[:3, 3], Rotation.from_matrix(hub[:3, :3])) for hub in hubs],
        _glb(world) if world else None,
    )


@functools.cache
def _units(fine: bool) -> dict[str, Any]:
    """Shapes of size 1, which scaling gives any size."""
    make = trimesh.creation
    ball = make.icosphere(2 + fine, 1.0)
    shaft = make.cylinder(SHAFT, segment=((0, 0, 0), (0, 0, 1.0 - HEAD)), sections=24)
    head = make.cone(1.0, HEAD, sections=24).apply_translation((0, 0, 1.0 - HEAD))
    return {
        "sphere": ball,
        "ellipsoid": ball,
        "box": make.box((2.0, 2.0, 2.0)),
        "cylinder": make.cylinder(1.0, 2.0, sections=64 if fine else 32),
        "arrow": trimesh.util.concatenate([shaft, head]),
    }


def unit(one: Primitive, fine: bool = True) -> trimesh.Trimesh:
    """The mesh that shows a primitive where it is scaled and placed as `placed` says."""
    mesh = _units(fine).get(one.shape)
    if mesh is not None:
        return mesh
    if one.mesh is not None:
        return trimesh.Trimesh(one.mesh.vertices, one.mesh.faces)
    radius, half = np.asarray(one.size, dtype=float)[:2]
    return trimesh.creation.capsule(2 * half, radius)


def unit_name(one: Primitive) -> str:
    """A name that primitives share if they have the same `unit` and are lit alike."""
    lit = "lit" if one.glow < 1.0 else "glowing"
    own = one.mesh.name if one.mesh else "_".join(f"{x:g}" for x in np.atleast_1d(one.size))
    return f"{lit}_{one.shape}" + ("" if one.shape in _units(True) else f"_{own}")


def placed(one: Primitive) -> tuple[Array, Array, Array]:
    """Position (3,) [m], attitude (4,) and scale (3,) of the `unit` that shows a primitive."""
    place, attitude = np.asarray(one.position, dtype=float), np.asarray(one.quaternion, dtype=float)
    size = np.broadcast_to(np.asarray(one.size, dtype=float), 3)
    scale = np.ones(3)
    if one.shape == "arrow":
        place, end = np.asarray(one.points, dtype=float)
        attitude = np.empty(4)
        mujoco.mju_quatZ2Vec(attitude, end - place)
        scale = np.array([2 * size[0], 2 * size[0], float(np.linalg.norm(end - place))])
    elif one.shape in _units(True):
        order = {"sphere": [0, 0, 0], "cylinder": [0, 0, 1]}.get(one.shape, [0, 1, 2])
        scale = size[order]
    return place, attitude, scale


def _pose(one: Primitive) -> Array:
    """Pose (4, 4)."""
    pose = np.eye(4)
    pose[:3, 3] = one.position
    pose[:3, :3] = Rotation.from_quat(np.asarray(one.quaternion), scalar_first=True).as_matrix()
    return pose


def _mesh(one: Primitive) -> trimesh.Trimesh:
    """The mesh of a primitive at its place, shaded smoothly but for sharp edges."""
    shape = unit(one, fine=False).copy().apply_transform(np.diag([*placed(one)[2], 1.0]))
    return trimesh.graph.smooth_shade(shape, angle=SHARPEST, facet_minarea=None).apply_transform(
        _pose(one)
    )


def _glb(parts: Sequence[Primitive], frame: Array | None = None) -> bytes:
    """Primitives as one mesh with a colour at each vertex, moved into a frame (4, 4)."""
    meshes = [_mesh(one) for one in parts]
    whole: Any = trimesh.util.concatenate(meshes)
    if frame is not None:
        whole.apply_transform(frame)
    colours = np.array([one.rgba for one in parts], dtype=float)
    colours[:, :3] **= 2.2  # those of GLB are linear, those of MuJoCo are the screen's
    colours = np.repeat(255 * colours, [len(mesh.vertices) for mesh in meshes], axis=0)
    whole.visual = TextureVisuals(material=PBRMaterial(roughnessFactor=0.5, metallicFactor=0.1))
    whole.visual.vertex_attributes["color"] = np.round(colours)
    return export_glb(trimesh.Scene(whole), include_normals=True)
