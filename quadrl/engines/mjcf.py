"""MuJoCo models of a vehicle: a lean one for simulation and one for pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import DRAWN_SIZE, Vehicle
from quadrl.engines import native

ASSETS = Path(__file__).parents[1] / "assets"
DRAWN_RADIUS = 0.06  # [m], of the rotor in assets/rotor.xml
FOOT_RADIUS = ARM_RADIUS = 0.008  # [m], of an aircraft with `scale` 1
CONTACT_STEPS = 4
"""Steps of MuJoCo in a physics step of an aircraft that can touch something, which is also the
hardness of contacts: a fall of 30 cm sinks 29 g in by less than 3 mm, and no preset passes a wall
of 2 cm at 24 m/s. In one step they travel farther than they are thick."""
GRIP_REACH = 0.5
"""How far over its surface a solid still grips a foot that it held, in radii of the foot (chosen:
the depth of hooks); without it an aircraft would come off when its other feet strike."""
HARD = 1e6
"""Weight of the aircraft in the hardness of a contact, over that of what it touches."""
STRIKE_HEIGHT = 0.005  # [m], half the height of what collides of the rotor in assets/rotor.xml
# Colours of the rotors ahead, aside and behind; a rotor is ahead if the cosine of its bearing is
# above AHEAD.
FRONT, SIDE, BACK = (1.00, 0.42, 0.10), (0.74, 0.77, 0.81), (0.18, 0.50, 0.92)
AHEAD = 0.2
Scene = Callable[[mujoco.MjSpec], None]


def spec(
    vehicle: Vehicle, *, contact: bool = False, drawn: bool = True, scene: Scene | None = None
) -> mujoco.MjSpec:
    """The vehicle over the ground as an MjSpec, to be extended or compiled.

    Args:
        vehicle: The aircraft.
        contact: Let feet, hull and rotors collide with the ground and with the geoms of `scene`.
        drawn: Include all that is only seen (geoms, lights, cameras, textures).
        scene: Adds geoms to the world; those that the aircraft can hit have contype 1.
    """
    whole = mujoco.MjSpec.from_file(str(ASSETS / "scene.xml"))
    whole.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    whole.option.timestep = vehicle.physics_timestep
    whole.option.gravity = (0, 0, -GRAVITY)
    whole.nuserdata = parameters.AIR
    if drawn:
        _draw(whole, vehicle)
    _add_physics(whole, vehicle)
    if scene is not None:
        scene(whole)
    if contact or _has_solids(whole):
        whole.option.timestep /= CONTACT_STEPS
        whole.geom("ground").contype = 1
        _add_collision(whole.body("aircraft"), vehicle, 2 * whole.option.timestep)
    if _has_solids(whole):
        for k in range(4):  # contacts exist, without a force, as far as a solid may grip
            foot = whole.geom(f"foot_{k + 1}")
            foot.gap = GRIP_REACH * foot.size[0]
        whole.nuserdata += parameters.HIT + parameters.FEET
        # The midphase would look for them where they were compiled.
        whole.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    if not drawn:  # a step without what is only seen takes a sixth less time
        whole.compiler.discardvisual = True
        for element in (*whole.lights, *whole.cameras):
            whole.delete(element)
    return whole


def compile_model(
    vehicle: Vehicle, *, contact: bool = False, drawn: bool = True, scene: Scene | None = None
) -> mujoco.MjModel:
    """The model of a vehicle; arguments as for `spec`. Installs the rotor callbacks.

    The lean model (`drawn=False`) has the same physics bit for bit and skips the stages of a step
    that do nothing; call `native.check_installed` before stepping it. The drawn one fails at its
    first step in a process without the callbacks: its gravity compensation is NaN, which the
    passive callback overwrites.

    Raises:
        NativeError: The callbacks cannot be built or installed, or one of other code fails here.
    """
    native.install()
    whole = spec(vehicle, contact=contact, drawn=drawn, scene=scene)
    if drawn:
        whole.body("aircraft").gravcomp = 1.0  # else MuJoCo does not compute it
        model = _compiled(whole)
        model.body_gravcomp[model.body("aircraft").id] = math.nan
        return model
    model = _compiled(whole)
    disable = mujoco.mjtDisableBit
    contact |= _has_solids(whole)
    # No automatic reset: a simulation that diverged must not look like a fresh one.
    unused = disable.mjDSBL_AUTORESET | disable.mjDSBL_SENSOR | disable.mjDSBL_CLAMPCTRL
    if not contact:
        unused |= disable.mjDSBL_CONSTRAINT | disable.mjDSBL_CONTACT
    model.opt.disableflags |= int(unused)
    return model


def _compiled(whole: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return whole.compile()
    except ValueError:
        native.check_installed()  # Python's callbacks of other code fail while a model is compiled
        raise


def _has_solids(whole: mujoco.MjSpec) -> bool:
    return any(parameters.MARK in geom.userdata for geom in whole.worldbody.geoms)


def _add_physics(whole: mujoco.MjSpec, vehicle: Vehicle) -> None:
    """Add mass, rotors and the row of parameters that the callbacks read."""
    body = whole.body("aircraft")
    body.explicitinertial = True
    body.mass, body.inertia, body.ipos = vehicle.mass, vehicle.inertia, (0, 0, 0)
    row = parameters.rows(vehicle).view(np.float64).reshape(-1)
    body.userdata, whole.nuser_body = row, len(row)
    for k, rotor in enumerate(vehicle.rotors):
        name = f"rotor_{k + 1}"
        body.add_site(name=name, pos=rotor.position, quat=_upright(rotor.axis), group=4)
        ratio = rotor.torque_coefficient / rotor.thrust_coefficient
        actuator = whole.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_SITE,
            gear=(0, 0, 1, 0, 0, -rotor.spin * ratio),
            dyntype=mujoco.mjtDyn.mjDYN_USER,
            actdim=1,
            gaintype=mujoco.mjtGain.mjGAIN_USER,
            biastype=mujoco.mjtBias.mjBIAS_NONE,
            ctrllimited=True,
            ctrlrange=(0, rotor.max_speed),
        )
        actuator.dynprm[0], actuator.dynprm[native.MARK_SLOT] = k, parameters.MARK


def _add_collision(body: mujoco.MjsBody, vehicle: Vehicle, hardness: float) -> None:
    """Add hull, arms, discs and feet, which collide with the world, not with each other.

    Args:
        body: The aircraft's.
        vehicle: The aircraft.
        hardness: Time in which contacts push it out [s], which MuJoCo asks to be two steps.
    """
    shape = mujoco.mjtGeom
    common: dict[str, Any] = dict(contype=0, conaffinity=1, mass=0.0, group=3)
    common |= dict(rgba=(0.9, 0.2, 0.5, 0.4), solref=(hardness, 1.0), solmix=HARD)
    body.add_geom(name="strike_hull", type=shape.mjGEOM_ELLIPSOID, size=vehicle.hull, **common)
    for k, rotor in enumerate(vehicle.rotors):
        body.add_geom(
            name=f"strike_{k + 1}",
            type=shape.mjGEOM_CYLINDER,
            size=(rotor.radius, STRIKE_HEIGHT * (rotor.radius / DRAWN_RADIUS), 0),
            pos=np.asarray(rotor.position) + vehicle.rotor_height * np.asarray(rotor.axis),
            quat=_upright(rotor.axis),
            **common,
        )
        if math.hypot(*rotor.position) > (radius := ARM_RADIUS * vehicle.scale):
            body.add_geom(
                name=f"strike_arm_{k + 1}", type=shape.mjGEOM_CAPSULE, size=(radius, 0, 0),
                fromto=(0, 0, 0, *rotor.position), **common,
            )  # fmt: skip
    x, y, z = vehicle.foot
    radius = FOOT_RADIUS * vehicle.scale
    for k, (ahead, left) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        at = (ahead * x, left * y, round(z + radius, 15))  # -0.062 m exactly for the paper's
        body.add_geom(
            name=f"foot_{k + 1}", type=shape.mjGEOM_SPHERE, size=(radius, 0, 0), pos=at, **common
        )


def rotor_colour(position: Sequence[float]) -> tuple[float, float, float]:
    """Red, green and blue (0 to 1) of a rotor at a position (3,) [m] in the body frame."""
    cosine = position[0] / max(math.hypot(*position[:2]), 1e-9)
    return FRONT if cosine > AHEAD else BACK if cosine < -AHEAD else SIDE


def _draw(whole: mujoco.MjSpec, vehicle: Vehicle) -> None:
    """Scale the airframe, attach the rotors and paint the ground; adds no body."""
    body, scale = whole.body("aircraft"), vehicle.scale
    whole.visual.map.shadowclip *= scale  # a shadow map as sharp as the aircraft is small
    for element in (*body.geoms, *body.cameras):
        element.pos = np.asarray(element.pos) * scale
    for geom in body.geoms:
        geom.size, geom.fromto = np.asarray(geom.size) * scale, np.asarray(geom.fromto) * scale
    for mesh in whole.meshes:
        mesh.scale = np.asarray(mesh.scale) * scale
    # Attached after the scaling, since a metre on the ground is one for every aircraft.
    ground = mujoco.MjSpec.from_file(str(ASSETS / "landmarks.xml"))
    whole.attach(ground, prefix="ground_", frame=whole.worldbody.add_frame())
    for k, rotor in enumerate(vehicle.rotors):
        part = mujoco.MjSpec.from_file(str(ASSETS / "rotor.xml"))
        x, y, z = rotor.position
        bearing, slope = math.atan2(y, x), math.atan2(z, math.hypot(x, y))
        level = _turn(bearing, (0, 0, 1))
        turn = _product(_upright(rotor.axis), level)
        # The arm points at the centre of mass, however the rotor leans.
        along = _product(level, _turn(-slope, (0, 1, 0)))
        arm = max(math.hypot(x, y, z), rotor.radius / 2) / DRAWN_SIZE
        # Turning parts scale with the rotor's radius, the motor with the mean of that and the size.
        disc = rotor.radius / DRAWN_RADIUS
        motor = math.sqrt(disc * scale)
        for geom in part.geoms:
            wide = disc if geom.name.startswith(("blade", "disc", "rim")) else motor
            upright = geom.type == mujoco.mjtGeom.mjGEOM_CYLINDER  # its size is (radius, height)
            factor = (wide, scale, 1) if upright else (wide, wide, scale)
            geom.size, geom.pos = np.asarray(geom.size) * factor, np.asarray(geom.pos) * scale
            if geom.meshname in ("arm", "sleeve"):
                geom.quat = _product(turn * (1, -1, -1, -1), along)
        for mesh in part.meshes:
            factor = (disc, disc * rotor.spin, scale)
            factor = (arm, scale, scale) if mesh.name in ("arm", "sleeve") else factor
            mesh.scale = np.asarray(mesh.scale) * factor
        for material, opacity in (("paint", 1.0), ("led", 1.0), ("glow", 0.26)):
            part.material(material).rgba = (*rotor_colour(rotor.position), opacity)
        prefix = f"rotor_{k + 1}_"
        whole.attach(part, prefix=prefix, frame=body.add_frame(pos=rotor.position, quat=turn))
        for geom in body.geoms:  # the airframe's own materials are shared
            name = geom.material.removeprefix(prefix)
            geom.material = name if whole.material(name) is not None else geom.material


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Quaternion (4,) of the rotation `second` followed by `first`."""
    quaternion = np.empty(4)
    mujoco.mju_mulQuat(quaternion, first, second)
    return quaternion


def _turn(angle: float, axis: Sequence[float]) -> np.ndarray:
    """Quaternion (4,) of a turn by an angle [rad] about an axis."""
    quaternion = np.empty(4)
    mujoco.mju_axisAngle2Quat(quaternion, np.asarray(axis, dtype=float), angle)
    return quaternion


def _upright(axis: tuple[float, float, float]) -> np.ndarray:
    """Quaternion (4,) that turns z onto a unit axis; exactly the identity for z itself."""
    quaternion = np.empty(4)
    mujoco.mju_quatZ2Vec(quaternion, np.asarray(axis, dtype=float))
    return quaternion
