"""Parts of a drawn MuJoCo model as meshes for a browser (GLB)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from quadrl.base.rotation import Array
from quadrl.engines import landmarks
from quadrl.rendering.live.shapes import blade_ids

SHARPEST = 0.7  # [rad], an edge that is shaded round
DRAWN_GROUPS = 3  # MuJoCo shows the groups 0 to 2


def airframe(model: mujoco.MjModel) -> tuple[bytes, list[tuple[Any, Array]]]:
    """All that is drawn of the aircraft but its blades, body frame.

    Returns:
        What is solid, as GLB; and what is transparent: a mesh for each colour (4,), 0 to 1.
    """
    body = model.body("aircraft").id
    blades = {geom for rotor in range(model.nu) for geom in blade_ids(model, rotor)}
    clear: dict[tuple[float, ...], list[trimesh.Trimesh]] = {}
    solid = []
    for geom in _drawn(model, body):
        rgba = _rgba(model, geom)
        if rgba[3] < 1.0:
            clear.setdefault(tuple(rgba), []).append(_mesh(model, geom))
        elif geom not in blades:
            solid.append(geom)
    parts = [(trimesh.util.concatenate(same), np.array(rgba)) for rgba, same in clear.items()]
    return _glb(model, solid), parts


def blades(model: mujoco.MjModel, rotor: int) -> tuple[bytes, np.ndarray]:
    """The blades of a rotor as GLB, and their frame (4, 4), which they turn about, body frame."""
    hub = model.geom(f"rotor_{rotor + 1}_hub").id
    frame = _pose(model, hub)
    return _glb(model, blade_ids(model, rotor), np.linalg.inv(frame)), frame


def world(model: mujoco.MjModel) -> bytes | None:
    """What stands in the world, as GLB; None where there is nothing beside the ground.

    What is painted on the ground is left out: the page has a grid, and each aircraft its place.
    """
    painted = landmarks.meshes().keys()
    solid = [
        geom
        for geom in _drawn(model, 0)
        if model.geom_type[geom] in _PRIMITIVES and model.geom(geom).name not in painted
    ]
    return _glb(model, solid) if solid else None


def _drawn(model: mujoco.MjModel, body: int) -> list[int]:
    """The geoms of a body that are shown."""
    shown = (model.geom_bodyid == body) & (model.geom_group < DRAWN_GROUPS)
    return np.flatnonzero(shown).tolist()


def _pose(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Pose (4, 4) of a geom in its body's frame."""
    pose, axes = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(axes, model.geom_quat[geom])
    pose[:3, :3], pose[:3, 3] = axes.reshape(3, 3), model.geom_pos[geom]
    return pose


_PRIMITIVES: dict[int, Any] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): lambda s: trimesh.creation.icosphere(2, s[0]),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): lambda s: trimesh.creation.icosphere(2).apply_scale(s),
    int(mujoco.mjtGeom.mjGEOM_BOX): lambda s: trimesh.creation.box(2 * s),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): lambda s: trimesh.creation.cylinder(s[0], 2 * s[1]),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): lambda s: trimesh.creation.capsule(2 * s[1], s[0]),
    int(mujoco.mjtGeom.mjGEOM_MESH): None,
}
"""Of a size as MuJoCo gives it."""


def _mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """A geom in its body's frame, round where its edges are blunt."""
    make = _PRIMITIVES[int(model.geom_type[geom])]
    if make is not None:
        shape = make(model.geom_size[geom])
    else:
        mesh = model.mesh(model.geom_dataid[geom])
        vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
        shape = trimesh.Trimesh(vertices, model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]])
    shape = trimesh.graph.smooth_shade(shape, angle=SHARPEST, facet_minarea=None)
    return shape.apply_transform(_pose(model, geom))


def _rgba(model: mujoco.MjModel, geom: int) -> Array:
    material = int(model.geom_matid[geom])
    return model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]


def _glb(model: mujoco.MjModel, geoms: Sequence[int], frame: Array | None = None) -> bytes:
    """Geoms of one body as one mesh with a colour at each vertex, moved into a frame (4, 4)."""
    meshes = [_mesh(model, geom) for geom in geoms]
    whole: Any = trimesh.util.concatenate(meshes)
    if frame is not None:
        whole.apply_transform(frame)
    colours = np.array([_rgba(model, geom) for geom in geoms], dtype=float)
    colours[:, :3] **= 2.2  # those of GLB are linear, those of MuJoCo are the screen's
    colours = np.repeat(255 * colours, [len(mesh.vertices) for mesh in meshes], axis=0)
    whole.visual = TextureVisuals(material=PBRMaterial(roughnessFactor=0.5, metallicFactor=0.1))
    whole.visual.vertex_attributes["color"] = np.round(colours)
    return export_glb(trimesh.Scene(whole), include_normals=True)
