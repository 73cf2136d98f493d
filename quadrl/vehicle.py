"""The aircraft: its parameters, its MuJoCo models, and what an action asks of its rotors."""

from __future__ import annotations

import dataclasses
import functools
import math
import reprlib
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from quadrl import native
from quadrl.errors import QuadrlError
from quadrl.rotation import Array, namespace

ASSETS = Path(__file__).parent / "assets"
GRAVITY = 9.81  # [m/s^2]
ROTORS = 4
# Rotors 1 to 4 sit ahead, left, behind and right; 1 and 3 turn so that their reaction yaws the
# aircraft to the right (negative z), 2 and 4 to the left (equation 7).
ROTOR_DIRECTIONS = ((1, 0), (0, 1), (-1, 0), (0, -1))
YAW_REACTION = (-1, 1, -1, 1)
DRAWN_ARM_LENGTH = 0.23  # [m], of the aircraft in assets/quadrotor.xml
DRAWN_ROTOR_RADIUS = 0.06  # [m]
# Of the drawn aircraft [m], body frame; they grow with the arms.
FEET = ((0.08, 0.08, -0.07), (-0.08, 0.08, -0.07), (-0.08, -0.08, -0.07), (0.08, -0.08, -0.07))
HULL = (0.075, 0.060, 0.045)  # semi-axes
ROTOR_HEIGHT = 0.030
# As in native/equations.h.
MARK = 1903518052.0
MARK_SLOT = 9


MIN, MAX = mujoco.mjMINVAL, mujoco.mjMAXVAL  # what MuJoCo takes for zero, and for unstable
LENGTHS = (1e-3, 1e3)  # [m]; the meshes of a smaller one have no volume to MuJoCo
MAX_SUBSTEPS = 10_000
# What a physics step resolves (tests/test_divergence.py): the angle turned in it [rad], and the
# rates of drag and aerodynamic moment times the step. An aircraft must be able to turn once a
# second and to fall as fast as it can.
TURN, DAMPING = 0.5, 1.0
SLOWEST_SPIN = 2 * math.pi  # [rad/s]


class VehicleError(QuadrlError, ValueError):
    """A parameter of an aircraft that no aircraft can have."""


@dataclasses.dataclass(frozen=True)
class Vehicle:
    """A plus-configuration quadrotor. The defaults are the paper's aircraft (gym-aero, 2018)."""

    name: str = "paper"
    """What it is called."""
    mass: float = 0.65
    """m [kg] (gym-aero)."""
    arm_length: float = 0.23
    """l [m], from the centre of mass to a rotor's axis (gym-aero)."""
    inertia: tuple[float, float, float] = (7.5e-3, 7.5e-3, 1.3e-2)
    """Principal moments J about x, y, z [kg m^2] (gym-aero)."""
    thrust_coefficient: float = 3.13e-5
    """k_T [N s^2]: thrust over the square of the rotor speed (gym-aero)."""
    torque_coefficient: float = 7.5e-7
    """k_Q [N m s^2]: rotor torque over the square of the rotor speed (gym-aero)."""
    drag_coefficient: float = 9e-3
    """k_D [N s^2/m^2]: quadratic drag (gym-aero)."""
    moment_coefficient: float = 9e-4
    """k_M [N m s^2]: quadratic aerodynamic moment (gym-aero)."""
    lag_rate: float = 1 / 0.18
    """k_c [1/s]: inverse time constant of the rotor speed (gym-aero)."""
    rotor_radius: float = 0.06
    """[m], drawn only."""
    max_thrust_ratio: float = 2.0
    """Largest thrust over weight (gym-aero: it hovers at half of its thrust)."""
    action_scale: float = 35.0
    """Change of the rotor speed command from hover at an action of 1 [rad/s] (gym-aero)."""
    physics_step: float = 0.01
    """Step of the RK4 integrator [s] (gym-aero)."""
    control_step: float = 0.05
    """Time between two actions [s] (gym-aero); a whole number of physics steps."""

    def __post_init__(self) -> None:
        """Refuse what cannot fly."""
        if not isinstance(self.name, str):
            raise VehicleError(f"name = {self.name!r}: a text is allowed")
        try:
            object.__setattr__(self, "inertia", tuple(self.inertia))
        except TypeError as error:
            raise VehicleError(f"inertia = {self.inertia!r}: three numbers are allowed") from error
        for field in dataclasses.fields(self)[1:]:
            value = getattr(self, field.name)
            if field.name == "inertia":
                checked: Any = tuple(_checked(field.name, moment) for moment in value)
            else:
                checked = _checked(field.name, value)
            object.__setattr__(self, field.name, checked)
        if len(self.inertia) != 3 or 2 * max(self.inertia) > sum(self.inertia) * (1 + 1e-9):
            raise VehicleError(
                f"inertia = {self.inertia}: three principal moments are allowed, "
                "each at most the sum of the other two"
            )
        if self.max_thrust_ratio <= 1:
            raise VehicleError(f"max_thrust_ratio = {self.max_thrust_ratio}: it must exceed 1")
        if self.max_speed > MAX:
            raise VehicleError(
                f"mass = {self.mass}, thrust_coefficient = {self.thrust_coefficient}, "
                f"max_thrust_ratio = {self.max_thrust_ratio}: the rotors would turn at "
                f"{self.max_speed:.3g} rad/s, and at most {MAX:g} is allowed"
            )
        if self.control_step > MAX_SUBSTEPS * self.physics_step:
            raise VehicleError(
                f"control_step = {self.control_step} s holds more than {MAX_SUBSTEPS} physics "
                f"steps of {self.physics_step} s"
            )
        # Runge and Kutta's method is unstable from 2.785 on, and inexact before.
        if self.lag_rate * self.physics_step > 1 + 1e-9:
            raise VehicleError(
                f"lag_rate = {self.lag_rate} with physics_step = {self.physics_step}: a product of "
                "at most 1 is allowed; shorten physics_step"
            )
        self._check_step("inertia", "moment_coefficient", self.resolved_spin, SLOWEST_SPIN, "rad/s")
        self._check_step(
            "mass", "drag_coefficient", self.resolved_speed, self._terminal_speed, "m/s"
        )
        if not math.isclose(self.substeps * self.physics_step, self.control_step, rel_tol=1e-9):
            raise VehicleError(
                f"control_step = {self.control_step} s is no whole number of physics steps "
                f"of {self.physics_step} s"
            )

    def _check_step(
        self, mass: str, coefficient: str, resolved: float, needed: float, unit: str
    ) -> None:
        """Refuse a physics step that does not resolve what the aircraft needs at least."""
        if resolved < needed:
            raise VehicleError(
                f"{mass} = {getattr(self, mass)} and {coefficient} = {getattr(self, coefficient)} "
                f"with physics_step = {self.physics_step}: no more than {resolved:.3g} {unit} is "
                f"resolved, and {needed:.3g} is needed; give it a {coefficient} of its own, or a "
                f"physics_step of at most {self.physics_step * resolved / needed:.2g} s"
            )

    @functools.cached_property
    def substeps(self) -> int:
        """Physics steps in a control step."""
        return max(1, round(self.control_step / self.physics_step))

    @functools.cached_property
    def hover_speed(self) -> float:
        """Omega_hover [rad/s]: the four rotors carry the weight."""
        return math.sqrt(self.mass * GRAVITY / (ROTORS * self.thrust_coefficient))

    @functools.cached_property
    def max_speed(self) -> float:
        """Omega_max [rad/s]."""
        return math.sqrt(self.max_thrust_ratio) * self.hover_speed

    @functools.cached_property
    def resolved_speed(self) -> float:
        """Fastest flight that a physics step resolves [m/s]: 2 k_D |v| dt / m is at most 1.

        Who flies faster is terminated and counted as diverged.
        """
        damping = 2 * self.drag_coefficient * self.physics_step / self.mass
        return min(DAMPING / damping, MAX) if damping else MAX

    @functools.cached_property
    def resolved_spin(self) -> float:
        """Fastest body rate that a physics step resolves [rad/s].

        |omega| dt is at most 0.5, and 2 k_M |omega| dt / J at most 1. Who turns faster is
        terminated and counted as diverged.
        """
        damping = 2 * self.moment_coefficient * self.physics_step / min(self.inertia)
        turning = min(TURN / self.physics_step, MAX)
        return min(turning, DAMPING / damping) if damping else turning

    @functools.cached_property
    def _terminal_speed(self) -> float:
        if self.drag_coefficient == 0:
            return 0.0  # it never stops falling faster
        return min(math.sqrt(self.mass * GRAVITY / self.drag_coefficient), MAX)

    @functools.cached_property
    def _scale(self) -> float:
        return self.arm_length / DRAWN_ARM_LENGTH

    @functools.cached_property
    def _always_within(self) -> bool:
        """Whether no action commands a speed below zero or past the largest."""
        return self.action_scale <= min(self.hover_speed, self.max_speed - self.hover_speed)

    @functools.cached_property
    def ground_clearance(self) -> float:
        """Height of the centre of mass above the ground when it stands on its feet [m]."""
        return -FEET[0][2] * self._scale

    def foot_depth(self, rotation: Array) -> Array:
        """How far the lowest foot reaches below the centre of mass, (...) [m].

        Args:
            rotation: (..., 3, 3) body to world.
        """
        up = rotation[..., 2, :]
        depths = [-_along(up, foot) * self._scale for foot in FEET]
        return functools.reduce(namespace(rotation).maximum, depths)

    def strike_depth(self, rotation: Array) -> Array:
        """How far the hull and the rotor discs, which must not touch, reach below, (...) [m]."""
        xp = namespace(rotation)
        up = rotation[..., 2, :]
        x, y, z = (up[..., k] * HULL[k] * self._scale for k in range(3))
        depth = xp.sqrt(x * x + y * y + z * z)
        edge = xp.sqrt(up[..., 0] * up[..., 0] + up[..., 1] * up[..., 1]) * self.rotor_radius
        for direction in ROTOR_DIRECTIONS:
            centre = (*(c * self.arm_length for c in direction), ROTOR_HEIGHT * self._scale)
            depth = xp.maximum(depth, edge - _along(up, centre))
        return depth

    def rotor_command(self, action: Array) -> Array:
        """Rotor speed commands Omega_c [rad/s] of actions, both (..., 4).

        Omega_c = clip(Omega_hover + action_scale * clip(action, -1, 1), 0, Omega_max).
        """
        if isinstance(action, np.ndarray) and action.ndim == 1:
            # For one aircraft Python's numbers, the same doubles, take half the time of NumPy's.
            within = np.array([-1.0 if x < -1.0 else min(x, 1.0) for x in action.tolist()])
        elif isinstance(action, np.ndarray):
            within = np.minimum(np.maximum(action, -1.0), 1.0)  # half the time of clip
        else:
            within = action.clip(-1.0, 1.0)
        command = self.hover_speed + self.action_scale * within
        if self._always_within:
            return command
        return command.clip(0.0, self.max_speed)

    def spec(self, *, contact: bool = False, drawn: bool = True) -> mujoco.MjSpec:
        """The aircraft over the ground as an MjSpec, to add to or to compile.

        Args:
            contact: Feet, hull, rotors and ground collide.
            drawn: Keep what is only seen (geoms, lights, cameras, textures).
        """
        spec = mujoco.MjSpec.from_file(str(ASSETS / "scene.xml"))
        self._write_parameters(spec)
        spec.nuser_body = 3
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
        spec.option.timestep = self.physics_step
        spec.option.gravity = (0, 0, -GRAVITY)
        _set_contact(spec, contact)
        if not drawn:
            _strip(spec)
        return spec

    def compile(self, *, contact: bool = False) -> mujoco.MjModel:
        """The complete model, with everything that is drawn; installs the rotor callbacks.

        Stepped in a process without the callbacks it fails at once instead of flying wrongly: its
        gravity compensation is not a number, which only the callbacks take out again.

        Raises:
            NativeError: The callbacks cannot be built or installed.
        """
        native.install()
        spec = self.spec(contact=contact)
        spec.body("aircraft").gravcomp = 1.0  # so that MuJoCo computes it at all
        model = spec.compile()
        model.body_gravcomp[model.body("aircraft").id] = math.nan
        return model

    def compile_lean(self, *, contact: bool = False) -> mujoco.MjModel:
        """The model that is simulated: nothing drawn, and no stage that has nothing to do.

        Same physics bit for bit. Whoever steps it checks the callbacks (`native.check_installed`).

        Raises:
            NativeError: The callbacks cannot be built or installed.
        """
        native.install()
        model = self.spec(contact=contact, drawn=False).compile()
        disable = mujoco.mjtDisableBit
        # No automatic reset: a simulation that diverges must not pass for a fresh one.
        unused = disable.mjDSBL_AUTORESET | disable.mjDSBL_SENSOR | disable.mjDSBL_CLAMPCTRL
        if not contact:
            unused |= disable.mjDSBL_CONSTRAINT | disable.mjDSBL_CONTACT
        model.opt.disableflags = int(unused)
        return model

    def _write_parameters(self, spec: mujoco.MjSpec) -> None:
        scale = self._scale
        rotor_scale = self.rotor_radius / DRAWN_ROTOR_RADIUS
        body = spec.body("aircraft")
        for geom in body.geoms:
            rotor = geom.name.startswith(("disc", "strike_1", "strike_2", "strike_3", "strike_4"))
            geom.size = np.asarray(geom.size) * (rotor_scale if rotor else scale)
            geom.pos = np.asarray(geom.pos) * scale
            if not math.isnan(geom.fromto[0]):
                geom.fromto = np.asarray(geom.fromto) * scale
        for mesh in spec.meshes:
            rotor = mesh.name in ("blade", "rotor_rim")
            mesh.scale = np.asarray(mesh.scale) * (rotor_scale if rotor else scale)
        for camera in body.cameras:
            camera.pos = np.asarray(camera.pos) * scale
        body.mass = self.mass
        body.ipos = (0, 0, 0)
        body.inertia = self.inertia
        body.userdata = (MARK, self.drag_coefficient, self.moment_coefficient)
        for k, (x, y) in enumerate(ROTOR_DIRECTIONS):
            name = f"rotor_{k + 1}"
            spec.site(name).pos = (x * self.arm_length, y * self.arm_length, 0)
            actuator = spec.actuator(name)
            ratio = self.torque_coefficient / self.thrust_coefficient
            actuator.gear = (0, 0, 1, 0, 0, YAW_REACTION[k] * ratio)
            actuator.ctrlrange = (0, self.max_speed)
            actuator.dynprm[0], actuator.dynprm[MARK_SLOT] = self.lag_rate, MARK
            actuator.gainprm[0] = self.thrust_coefficient


def resolve(vehicle: Vehicle | None) -> Vehicle:
    """A vehicle, or the paper's for None.

    Raises:
        VehicleError: It is something else.
    """
    if not isinstance(vehicle, (Vehicle, type(None))):
        raise VehicleError(
            f"vehicle = {vehicle!r}: a quadrl.vehicle.Vehicle is allowed, such as "
            f"quadrl.vehicle.VEHICLES[{vehicle if vehicle in tuple(VEHICLES) else 'paper'!r}]"
        )
    return vehicle or Vehicle()


def _checked(name: str, value: Any) -> float:
    """A parameter as a float."""
    low, high = LENGTHS if name in ("arm_length", "rotor_radius") else (MIN, MAX)
    kinds = (int, float, np.integer, np.floating)
    number = isinstance(value, kinds) and not isinstance(value, bool)
    zero = number and value == 0 and name in ("drag_coefficient", "moment_coefficient")
    if not (number and (zero or low <= value <= high)):
        raise VehicleError(
            f"{name} = {reprlib.repr(value)}: a number from {low:g} to {high:g} is allowed"
        )
    return float(value)


def _along(up: Array, point: tuple[float, ...]) -> Array:
    """Height of a body-fixed point (3,) over the centre of mass; up (..., 3) in the body frame."""
    return up[..., 0] * point[0] + up[..., 1] * point[1] + up[..., 2] * point[2]


def _set_contact(spec: mujoco.MjSpec, contact: bool) -> None:
    """Let the aircraft and the ground touch, or take away what could."""
    for geom in list(spec.geoms):
        if geom.name == "ground":
            geom.contype, geom.conaffinity = (1, 0) if contact else (0, 0)
        elif geom.classname.name == "collision":
            if contact:
                geom.contype, geom.conaffinity = 0, 1
            else:
                spec.delete(geom)


def _strip(spec: mujoco.MjSpec) -> None:
    """Delete what is only seen: a step of a model without it takes a sixth less."""
    for elements in (spec.geoms, spec.lights, spec.cameras):
        for element in list(elements):
            if getattr(element, "contype", 0) == getattr(element, "conaffinity", 0) == 0:
                spec.delete(element)
    for elements in (spec.materials, spec.textures):
        for element in list(elements):
            spec.delete(element)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    for geom in spec.geoms:
        geom.material = ""


CRAZYFLIE = Vehicle(
    name="crazyflie",
    mass=0.0293,  # Foerster 2015, "System Identification of the Crazyflie 2.0 Nano Quadrocopter"
    arm_length=0.046,  # ibid.
    inertia=(16.6e-6, 16.6e-6, 29.3e-6),  # ibid., principal part
    thrust_coefficient=2.3e-8,  # 14.5 g at 2500 rad/s (Bitcraze, propeller measurements of 2015)
    torque_coefficient=2.3e-8 * 5.965e-3,  # ratio of torque to thrust: Foerster 2015
    drag_coefficient=5e-3,  # chosen: 7.6 m/s of terminal speed
    moment_coefficient=1e-7,  # chosen: the paper's, over the fifth power of the arm length
    lag_rate=1 / 0.05,  # chosen: published values run from 0.005 to 0.15 s
    rotor_radius=0.0225,
    max_thrust_ratio=2.0,  # 2500 rad/s, ibid.
    action_scale=200.0,
    physics_step=0.005,
    control_step=0.02,
)
RACER = Vehicle(
    name="racer",
    mass=0.752,  # Foehn et al. 2022, "Agilicious", Science Robotics 7
    arm_length=0.125,  # ibid.: rotors at 0.075 and 0.1 m
    inertia=(2.5e-3, 2.1e-3, 4.3e-3),  # ibid.
    thrust_coefficient=1.562e-6,  # ibid.
    torque_coefficient=1.562e-6 * 0.022,  # ibid., ratio of torque to thrust
    drag_coefficient=2e-2,  # chosen: 19 m/s of terminal speed
    moment_coefficient=1e-4,  # chosen
    lag_rate=1 / 0.033,  # ibid.
    rotor_radius=0.0635,  # propellers of 5 inches
    max_thrust_ratio=4.5,  # 8.5 N a rotor, ibid.
    action_scale=150.0,
    physics_step=0.005,
    control_step=0.02,
)
VEHICLES = {vehicle.name: vehicle for vehicle in (Vehicle(), CRAZYFLIE, RACER)}
"""The aircraft that the command line knows by name."""
