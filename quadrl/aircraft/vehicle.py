"""The aircraft: its parameters with their units and sources, and quantities that follow from them.

Body frame: x forward, y left, z up, the origin at the centre of mass. `presets` has the aircraft
that are known by name, `parameters` makes the rows that the engines fly, and `quadrl.engines.mjcf`
the MuJoCo model.
"""

# pyright: reportUnnecessaryIsInstance=false
# What users give is checked, whatever its annotation promises.
from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from quadrl.aircraft.aerodynamics import Aerodynamics, check_air
from quadrl.aircraft.command_map import CommandMap
from quadrl.aircraft.rotors import (
    GRAVITY,
    LENGTHS,
    MAX,
    MIN,
    PAPER_ROTORS,
    SINGULAR,
    Rotor,
    Vector,
    check_layout,
    hover_squares,
    mixer,
)
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array
from quadrl.base.validation import number, numbers, whole_steps

MIN_ROTORS, MAX_ROTORS = 4, 8
DRAWN_SIZE = 0.23  # [m], distance of a rotor from the centre in the drawings of assets/
DRAWN_FOOT = (0.08, 0.08, -0.07)  # [m], lowest point of a foot there
DRAWN_HULL = (0.075, 0.060, 0.045)  # [m], semi-axes
DRAWN_ROTOR_HEIGHT = 0.030  # [m], of a rotor's disc over the point where its thrust acts

MAX_SUBSTEPS = 10_000
# The most that a physics step resolves (tests/unit/test_divergence.py): the angle turned in it
# [rad], and the rates of drag and aerodynamic moment times the step. An aircraft must be able to
# turn once a second and to fall at its terminal speed.
TURN, DAMPING = 0.5, 1.0
SLOWEST_TURN = 2 * math.pi  # [rad/s]


@dataclasses.dataclass(frozen=True)
class Vehicle:
    """An aircraft with 4 to 8 rotors. The defaults are the paper's (gym-aero, August 2018)."""

    name: str = "paper"
    """What it is called."""
    mass: float = 0.65
    """m [kg] (gym-aero)."""
    inertia: Vector = (7.5e-3, 7.5e-3, 1.3e-2)
    """Principal moments J about x, y, z [kg m^2] (gym-aero)."""
    rotors: tuple[Rotor, ...] = PAPER_ROTORS
    """The rotors, 4 to 8; their order is that of commands and observations."""
    drag_coefficient: float = 9e-3
    """k_D [N s^2/m^2]: quadratic drag (gym-aero)."""
    moment_coefficient: float = 9e-4
    """k_M [N m s^2]: quadratic aerodynamic moment (gym-aero)."""
    action_scale: float = 35.0
    """Change of the rotor speed command from hover at an action of 1 [rad/s] (gym-aero)."""
    physics_timestep: float = 0.01
    """Step of the RK4 integrator [s] (gym-aero)."""
    control_timestep: float = 0.05
    """Time between two actions [s] (gym-aero); a whole number of physics steps."""
    aerodynamics: Aerodynamics = Aerodynamics()
    """What the air does to the rotors beside equation 7; nothing by default."""
    dead_time: float = 0.0
    """Time from a command to the first motion of a rotor [s], in whole physics steps."""
    command_map: CommandMap | None = None
    """What its motor commands mean, for a board; simulation commands rotor speeds."""

    def __repr__(self) -> str:
        return f"Vehicle({self.name!r}, {self.mass:g} kg, {len(self.rotors)} rotors)"

    def __post_init__(self) -> None:
        """Validate the numbers, alone and together."""
        plain = isinstance(self.name, str) and f"_{self.name}".replace("-", "_").isidentifier()
        if not self.name or not plain:
            # Files are named after it, and a policy may bring it from elsewhere.
            allowed = "letters, digits, _ and -, such as 'my-aircraft'"
            raise QuadrlError(name="name", value=self.name, allowed=allowed)
        object.__setattr__(self, "inertia", numbers("inertia", self.inertia, 3, MIN, MAX))
        for field in ("mass", "action_scale", "physics_timestep", "control_timestep"):
            object.__setattr__(self, field, number(field, getattr(self, field), MIN, MAX))
        for field in ("drag_coefficient", "moment_coefficient", "dead_time"):
            object.__setattr__(self, field, number(field, getattr(self, field), 0, MAX))
        if max(self.inertia) > (sum(self.inertia) - max(self.inertia)) * (1 + 1e-9):
            allowed = "three moments, each at most the sum of the other two"
            raise QuadrlError(name="inertia", value=self.inertia, allowed=allowed)
        if not isinstance(self.command_map, CommandMap | None):
            allowed = "a CommandMap or None"
            raise QuadrlError(name="command_map", value=self.command_map, allowed=allowed)
        self._check_rotors()
        self._check_timesteps()
        mass, inertia, fastest = self.mass, self.inertia, self.max_speed
        check_air(self.aerodynamics, self.rotors, mass, inertia, fastest, self.physics_timestep)

    def _check_rotors(self) -> None:
        """Refuse rotors that cannot hold the aircraft in hover and turn it about every axis."""
        rotors = self.rotors
        if not isinstance(rotors, Sequence) or not all(isinstance(r, Rotor) for r in rotors):
            raise QuadrlError(name="rotors", value=rotors, allowed="a sequence of Rotor")
        object.__setattr__(self, "rotors", tuple(rotors))
        if not MIN_ROTORS <= (count := len(rotors)) <= MAX_ROTORS:
            allowed = f"between {MIN_ROTORS} and {MAX_ROTORS}"
            raise QuadrlError(name="number of rotors", value=count, allowed=allowed)
        number("distance of the farthest rotor [m]", self.size, *LENGTHS)
        check_layout(rotors, self.mixer, self.mass)

    def _check_timesteps(self) -> None:
        """Refuse steps that do not resolve the aircraft, or do not fit into each other."""
        step = self.physics_timestep
        if self.control_timestep > MAX_SUBSTEPS * step or not math.isclose(
            self.substeps * step, self.control_timestep, rel_tol=1e-9
        ):
            allowed = f"1 to {MAX_SUBSTEPS} times the physics step, {step:g} s"
            raise QuadrlError(name="control_timestep", value=self.control_timestep, allowed=allowed)
        whole_steps("dead_time", (self.dead_time,), step, "physics")
        # The Runge-Kutta method is unstable from 2.785 on, and inexact before.
        fastest = max(max(rotor.lag_up, rotor.lag_down) for rotor in self.rotors)
        if fastest * step > 1 + 1e-9:
            reason = f"a rotor's rate is {fastest:g} 1/s, and rate times step may be at most 1"
            allowed = f"at most {1 / fastest:.3g} s"
            raise QuadrlError(reason, name="physics_timestep", value=step, allowed=allowed)
        falls = 0.0  # [m/s]; without drag a fall never stops getting faster
        if self.drag_coefficient:
            falls = min(math.sqrt(self.mass * GRAVITY / self.drag_coefficient), MAX)
        for resolved, needed, unit, names in (
            (self.resolved_turn, SLOWEST_TURN, "rad/s", "moment_coefficient and inertia"),
            (self.resolved_speed, falls, "m/s", "drag_coefficient and mass"),
        ):
            if resolved < needed:
                raise QuadrlError(
                    f"with this {names} the step resolves up to {resolved:.3g} {unit}, and "
                    f"{needed:.3g} {unit} are needed",
                    name="physics_timestep",
                    value=step,
                    allowed=f"at most {step * resolved / needed:.2g} s",
                )

    @property
    def rotor_count(self) -> int:
        """Number of rotors, R."""
        return len(self.rotors)

    @functools.cached_property
    def substeps(self) -> int:
        """Physics steps in a control step."""
        return max(1, round(self.control_timestep / self.physics_timestep))

    @functools.cached_property
    def mixer(self) -> np.ndarray:
        """(4, R): squares of the rotor speeds to thrust along z [N] and moments [N m]."""
        names = (field.name for field in dataclasses.fields(Rotor))
        return mixer({name: np.array([getattr(r, name) for r in self.rotors]) for name in names})

    @functools.cached_property
    def hover_speed(self) -> np.ndarray:
        """(R,) Omega_hover [rad/s]: speeds that carry the weight without a moment."""
        return np.sqrt(hover_squares(self.mixer, self.mass * GRAVITY))

    @property
    def layout(self) -> np.ndarray:
        """(4, R) signs of each rotor's thrust along z and moments: 1, -1, or 0 for none."""
        rows = self.mixer / np.abs(self.mixer).max(axis=1, keepdims=True)
        return np.sign(np.where(np.abs(rows) < SINGULAR, 0.0, rows))

    @functools.cached_property
    def max_speed(self) -> np.ndarray:
        """(R,) Omega_max [rad/s]."""
        return np.array([rotor.max_speed for rotor in self.rotors])

    @functools.cached_property
    def resolved_speed(self) -> float:
        """Fastest flight that a physics step resolves [m/s]: 2 k_D |v| dt / m is at most 1.

        Faster flights are terminated and reported as diverged.
        """
        return float(resolved_speed(self.mass, self.drag_coefficient, self.physics_timestep))

    @functools.cached_property
    def resolved_turn(self) -> float:
        """Fastest body rate that a physics step resolves [rad/s].

        |omega| dt is at most 0.5, and 2 k_M |omega| dt / J at most 1. Faster turns are terminated
        and reported as diverged.
        """
        own = min(self.inertia), self.moment_coefficient, self.physics_timestep
        return float(resolved_turn(*own))

    @functools.cached_property
    def size(self) -> float:
        """Largest distance of a rotor from the centre of mass, seen from above [m]."""
        return max(math.hypot(*rotor.position[:2]) for rotor in self.rotors)

    @property
    def scale(self) -> float:
        """Size over that of the drawings in assets/."""
        return self.size / DRAWN_SIZE

    @property
    def foot(self) -> Vector:
        """Lowest point of the foot ahead on the left [m]; the others mirror it."""
        return self._scaled(DRAWN_FOOT)

    @property
    def hull(self) -> Vector:
        """Semi-axes of the ellipsoid that must not touch the ground [m]."""
        return self._scaled(DRAWN_HULL)

    def _scaled(self, drawn: Vector) -> Vector:
        x, y, z = drawn
        return x * self.scale, y * self.scale, z * self.scale

    @property
    def rotor_height(self) -> float:
        """Height of a drawn disc over the point where its thrust acts, along its axis [m]."""
        return DRAWN_ROTOR_HEIGHT * self.scale

    @property
    def ground_clearance(self) -> float:
        """Height of the centre of mass above the ground when it stands on its feet [m]."""
        return -self.foot[2]

    def rotor_command(self, action: Array) -> Array:
        """Rotor speed commands Omega_c (N, R) [rad/s] of actions (N, R).

        Omega_c = clip(Omega_hover + action_scale * clip(action, -1, 1), 0, Omega_max).
        """
        most = None if self._always_within else self.max_speed
        return commanded(action, self.hover_speed, self.action_scale, most)

    @functools.cached_property
    def _always_within(self) -> bool:
        """Whether no action commands a speed below zero or above the largest."""
        room = np.minimum(self.hover_speed, self.max_speed - self.hover_speed)
        return bool((self.action_scale <= room).all())


def commanded(action: Array, hover: Array, scale: Any, most: Array | None = None) -> Array:
    """Compute the rotor speed commands (N, R) [rad/s] of actions.

    Args:
        action: (N, R), clipped to [-1, 1].
        hover: Speeds at an action of 0, (R,) or (N, R) [rad/s].
        scale: Change of the speed at an action of 1 [rad/s].
        most: Largest speeds (R,) [rad/s]; commands are clipped to 0 and to these. None: no limits.
    """
    command = hover + scale * np.minimum(np.maximum(action, -1.0), 1.0)
    return command if most is None else np.minimum(np.maximum(command, 0.0), most)


def resolved_speed(mass: Array, drag_coefficient: Array, timestep: float) -> Array:
    """`Vehicle.resolved_speed` of rows [m/s]."""
    damping = 2 * np.asarray(drag_coefficient) * timestep / mass
    return np.minimum(DAMPING / np.maximum(damping, 1 / MAX), MAX)


def resolved_turn(inertia: Array, moment_coefficient: Array, timestep: float) -> Array:
    """`Vehicle.resolved_turn` of rows with a least moment of inertia [rad/s]."""
    damping = 2 * np.asarray(moment_coefficient) * timestep / inertia
    return np.minimum(DAMPING / np.maximum(damping, 1 / MAX), min(TURN / timestep, MAX))
