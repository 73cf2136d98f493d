"""Export an aircraft to MuJoCo without quadrl: one file, with no callbacks.

The control is a rotor's thrust over its largest thrust, which is the square of its speed over its
largest speed. MuJoCo has no thrust that grows with the square of a state, so here the square lags.
Its first-order filter has one time constant; rotors that slow down at another rate than they speed
up get MuJoCo's muscle dynamics, which have two.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from quadrl.aircraft.vehicle import Vehicle
from quadrl.engines import mjcf

HEIGHT = 1.0  # [m], of the hover
DRAG_RADIUS = 0.05  # over the size of the aircraft: of a sphere that carries next to no air along
THINNEST = 1e-6  # [kg/m^3]
HEAD = """<!--
  The aircraft {name} for MuJoCo alone, written by quadrl {version}.
  Body frame: x forward, y left, z up, the origin at the centre of mass. It begins on the ground;
  the key frame "hover" holds it at {height:g} m with ctrl = act = (hover_speed / max_speed)^2.
  ctrl, one number a rotor, 0 to 1: the thrust that is asked for, as a share of the rotor's largest
  thrust, which is (speed / max_speed)^2; act: the share that it gives now.
  An action a of a policy of quadrl is, for a control_timestep (custom/numeric, SI units),
  ctrl = (clip(hover_speed + action_scale * a, least_command, most_command) / max_speed)^2.
  rotor_position and rotor_axis are x, y, z of one rotor after the other, in the body frame;
  rotor_spin is 1 where a rotor turns counter-clockwise about its axis, -1 where clockwise.
  Left out: the lag is of the square of the speed, not of the speed; what the air does to rotors
  (inflow, rotor drag, flapping, ground effect, vortex ring), their gyroscopic moments, turbulence,
  the dead time (custom/numeric dead_time [s], to delay ctrl by), delays, noise, randomization.
  Drag and moment that go with the square of airspeed and body rate act on the sphere "drag", in the
  wind of option/wind. mujoco.mjx with JAX knows no such sphere:
  there the drag is a box's, right in the mean over its axes, and the moment is smaller.
-->
"""


def content(vehicle: Vehicle, version: str) -> bytes:
    """The file, which needs no other."""
    name = vehicle.name.replace("--", "- -")  # which no comment of XML may hold
    head = HEAD.format(name=name, version=version, height=HEIGHT)
    return (head + spec(vehicle).to_xml()).encode()


def spec(vehicle: Vehicle) -> mujoco.MjSpec:
    """The aircraft on the ground, with the key frame "hover"."""
    whole = mjcf.spec(vehicle, contact=True)
    body = whole.body("aircraft")
    whole.modelname, whole.nuserdata, whole.nuser_body, body.userdata = vehicle.name, 0, 0, []
    body.pos, whole.stat.center = (0, 0, vehicle.ground_clearance), (0, 0, HEIGHT / 2)
    _draw_without_meshes(whole, vehicle)
    _add_drag(whole, vehicle)
    share = (vehicle.hover_speed / vehicle.max_speed) ** 2
    for rotor, actuator, hover in zip(vehicle.rotors, whole.actuators, share, strict=True):
        up, down = 1 / rotor.lag_up, 1 / rotor.lag_down  # [s]
        actuator.dyntype, constants = mujoco.mjtDyn.mjDYN_FILTER, [up, 0.0]
        if up != down:
            # Its time constants go with 0.5 + 1.5 act up and with one over that down.
            factor = 0.5 + 1.5 * hover
            actuator.dyntype = mujoco.mjtDyn.mjDYN_MUSCLE
            constants = [up / factor, down * factor]
        actuator.dynprm = np.array([*constants, *[0.0] * 8])
        actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        actuator.gainprm[0] = rotor.thrust_coefficient * rotor.max_speed**2  # [N]
        actuator.ctrlrange = (0, 1)
    names = "hover_speed", "max_speed", "action_scale", "control_timestep", "dead_time"
    numbers = {name: getattr(vehicle, name) for name in names}
    ends = vehicle.rotor_command(np.outer([-1.0, 1.0], np.ones(vehicle.rotor_count)))
    numbers |= dict(zip(("least_command", "most_command"), ends, strict=True))
    for name in ("position", "axis", "spin"):
        numbers[f"rotor_{name}"] = np.ravel([getattr(rotor, name) for rotor in vehicle.rotors])
    for name, data in numbers.items():
        whole.add_numeric(name=name, data=np.atleast_1d(data))
    whole.add_key(name="hover", qpos=(0, 0, HEIGHT, 1, 0, 0, 0), act=share, ctrl=share)
    return whole


def _add_drag(whole: mujoco.MjSpec, vehicle: Vehicle) -> None:
    """Equations 8 and 9 by MuJoCo's model of ellipsoids in a fluid, here of a sphere.

    Its force is density blunt pi r^2 |v| v, its moment density angular 8/15 pi r^5 |w| w. The
    density is the one at which MuJoCo's other model, the box of the body's inertia, has that force
    in the mean over its axes: mujoco.mjx has only that one.
    """
    radius, inertia = DRAG_RADIUS * vehicle.size, np.array(vehicle.inertia)
    box = np.sqrt(np.maximum(6 * (inertia.sum() - 2 * inertia) / vehicle.mass, 0.0))
    density = max(2 * vehicle.drag_coefficient / np.mean(box * np.roll(box, 1)), THINNEST)
    blunt = vehicle.drag_coefficient / (density * math.pi * radius**2)
    angular = vehicle.moment_coefficient / (density * 8 / 15 * math.pi * radius**5)
    whole.option.density = density
    whole.body("aircraft").add_geom(
        name="drag", size=(radius, 0, 0), contype=0, conaffinity=0, group=4, mass=0,
        fluid_ellipsoid=1, fluid_coefs=(blunt, 0, angular, 0, 0),
    )  # fmt: skip


def _draw_without_meshes(whole: mujoco.MjSpec, vehicle: Vehicle) -> None:
    """Draw hull and arms as ellipsoids and capsules, and no blades, rims and landmarks.

    With those the file would be twenty times as long.
    """
    body, shape = whole.body("aircraft"), mujoco.mjtGeom
    for geom in (*whole.worldbody.geoms, *body.geoms):
        if geom.name in ("shell", "canopy"):
            geom.size, geom.meshname = whole.mesh(geom.meshname).scale, ""
            geom.type = shape.mjGEOM_ELLIPSOID
        elif geom.type == shape.mjGEOM_MESH or geom.name.startswith("ground_"):
            whole.delete(geom)
    for k, rotor in enumerate(vehicle.rotors, 1):
        arm = dict(fromto=(0, 0, 0, *rotor.position), size=(mjcf.ARM_RADIUS * vehicle.scale, 0, 0))
        tube = whole.find_default("leg")
        body.add_geom(tube, name=f"arm_{k}", material="carbon", **arm)
    used = {geom.material for geom in (*whole.worldbody.geoms, *body.geoms)}
    unused = [material for material in whole.materials if material.name not in used]
    unused += [texture for texture in whole.textures if texture.name.startswith("ground_")]
    for element in (*whole.meshes, *unused, whole.camera("fixed")):
        whole.delete(element)
