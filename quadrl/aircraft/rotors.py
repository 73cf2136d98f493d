"""Rotors: their parameters, common layouts, and their combined thrust and moments."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import mujoco
import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array
from quadrl.base.validation import number, numbers

GRAVITY = 9.81  # [m/s^2]
MIN, MAX = mujoco.mjMINVAL, mujoco.mjMAXVAL  # what MuJoCo takes for zero, and for unstable
LENGTHS = (1e-3, 1e3)  # [m]; the meshes of a smaller one have no volume to MuJoCo
LEAN = 0.01  # largest sideways force in hover over the weight; it costs controllers about 3 cm
SINGULAR = 1e-9
"""Smallest singular value of a mixer over its largest, after scaling each row by its largest
entry."""

Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Rotor:
    """One rotor. Every number is part of the aircraft's row of parameters."""

    position: Vector
    """Where its thrust acts [m]."""
    thrust_coefficient: float
    """k_T [N s^2]: thrust over the square of the rotor speed."""
    torque_coefficient: float
    """k_Q [N m s^2]: torque over the square of the rotor speed."""
    lag_up: float
    """k_c [1/s]: inverse time constant of the rotor speed while it rises."""
    lag_down: float
    """Inverse time constant of the rotor speed while it falls [1/s]."""
    max_speed: float
    """Largest speed that can be commanded [rad/s]."""
    spin: float = 1.0
    """1 if it turns counter-clockwise about its axis, -1 if clockwise; the aircraft feels the
    opposite torque."""
    axis: Vector = (0.0, 0.0, 1.0)
    """Unit vector along the thrust."""
    radius: float = 0.06
    """Radius of the disc [m], drawn and used for contact with the ground."""
    disc_radius: float = 0.0
    """Radius of the aerodynamic disc [m]; 0 means `radius`."""

    def __post_init__(self) -> None:
        """Validate the numbers."""
        for name in ("position", "axis"):
            object.__setattr__(self, name, numbers(f"rotor {name}", getattr(self, name), 3))
        for name in ("thrust_coefficient", "torque_coefficient", "lag_up", "lag_down", "max_speed"):
            object.__setattr__(self, name, number(f"rotor {name}", getattr(self, name), MIN, MAX))
        object.__setattr__(self, "radius", number("rotor radius", self.radius, *LENGTHS))
        if number("rotor disc_radius", self.disc_radius) != 0:
            number("rotor disc_radius", self.disc_radius, *LENGTHS)
        object.__setattr__(self, "disc_radius", float(self.disc_radius))
        if abs(number("rotor spin", self.spin)) != 1:
            raise QuadrlError(name="rotor spin", value=self.spin, allowed="1 or -1")
        if abs(math.hypot(*self.axis) - 1) > 1e-9:
            raise QuadrlError(name="rotor axis", value=self.axis, allowed="a unit vector")
        object.__setattr__(self, "spin", float(self.spin))

    @property
    def disc(self) -> float:
        """Radius of the disc that moves the air [m]."""
        return self.disc_radius or self.radius

    def figure_of_merit(self, air_density: float) -> float:
        """Least power that can give the thrust at rest, by momentum theory, over the shaft's."""
        flow = 2 * air_density * math.pi * self.disc**2  # [kg/m]
        return self.thrust_coefficient**1.5 / (math.sqrt(flow) * self.torque_coefficient)


def ring(
    bearings: Sequence[float], spins: Sequence[float], arm_length: float, **rotor: Any
) -> tuple[Rotor, ...]:
    """Level rotors on a circle around the centre of mass.

    Args:
        bearings: Bearings of each rotor [deg], counter-clockwise from ahead.
        spins: Spins of each rotor, 1 or -1.
        arm_length: Radius of the circle [m].
        **rotor: The other parameters of `Rotor`, the same for all.
    """
    number("arm_length", arm_length, *LENGTHS)
    numbers("spins", spins, len(bearings))
    rotors: list[Rotor] = []
    for bearing, spin in zip(bearings, spins, strict=True):
        # Rounded, so that a rotor straight ahead stands at y = 0 exactly.
        cosine, sine = (round(f(math.radians(bearing)), 15) + 0.0 for f in (math.cos, math.sin))
        rotors.append(Rotor((cosine * arm_length, sine * arm_length, 0.0), spin=spin, **rotor))
    return tuple(rotors)


def plus(arm_length: float, **rotor: Any) -> tuple[Rotor, ...]:
    """Four rotors ahead, left, behind and right; those ahead and behind turn counter-clockwise."""
    return ring((0, 90, 180, 270), (1, -1, 1, -1), arm_length, **rotor)


def mixer(rotor: Mapping[str, np.ndarray] | np.ndarray) -> np.ndarray:
    """Squares of the rotor speeds to thrust along z and moments: equation 7 for any layout.

    moment = k_T position x axis - spin k_Q axis.

    Args:
        rotor: Arrays (..., R) or (..., R, 3) by the names of the fields of `Rotor`.

    Returns:
        (..., 4, R).
    """
    axis, thrust = rotor["axis"], rotor["thrust_coefficient"]
    reaction = (rotor["spin"] * rotor["torque_coefficient"])[..., None] * axis
    moment = thrust[..., None] * np.cross(rotor["position"], axis) - reaction
    lift = (thrust * axis[..., 2])[..., None]
    return np.swapaxes(np.concatenate([lift, moment], axis=-1), -1, -2) + 0.0


def hover_squares(mixer: np.ndarray, thrust: Array, moment: Array = 0.0) -> np.ndarray:
    """Smallest squares of the rotor speeds (..., R) that give a thrust (...) [N].

    They also balance a moment (..., 3) [N m] that acts on the aircraft.
    """
    # Each row over its largest entry, since they differ by orders of magnitude.
    scale: np.ndarray = np.abs(mixer).max(axis=-1, keepdims=True)
    rows = mixer / scale
    wrench = np.zeros((*rows.shape[:-1], 1))
    wrench[..., 0, 0] = thrust / scale[..., 0, 0]
    wrench[..., 1:, 0] = (0.0 - np.asarray(moment)) / scale[..., 1:, 0]
    across = np.swapaxes(rows, -1, -2)
    return (across @ np.linalg.solve(rows @ across, wrench))[..., 0]


def check_layout(rotors: Sequence[Rotor], mixer: np.ndarray, mass: float) -> None:
    """Refuse rotors that cannot hold an aircraft in hover and turn it about every axis.

    Args:
        rotors: The rotors, R.
        mixer: Their mixer (4, R).
        mass: Mass of the aircraft [kg].

    Raises:
        QuadrlError: The message has the numbers of the rotors and what they would have to be.
    """

    def refuse(field: str, allowed: str, reason: str = "") -> NoReturn:
        values = [getattr(rotor, field) for rotor in rotors]
        name = {"axis": "rotor axes"}.get(field, f"rotor {field}s")
        raise QuadrlError(reason, name=name, value=values, allowed=allowed)

    if len({rotor.spin * math.copysign(1, rotor.axis[2]) for rotor in rotors}) < 2:
        reason = "yaw cannot be controlled if all rotors turn the same way"
        refuse("spin", "of both signs", reason)
    for axis, moment in zip("xyz", mixer[1:], strict=True):
        if not (moment > 0).any() or not (moment < 0).any():
            reason = f"they turn the aircraft about its {axis} axis in one direction only"
            refuse("position", "on different sides of every axis", reason)
    rows = mixer / np.abs(mixer).max(axis=1, keepdims=True)
    values, level = (np.linalg.svd(part, compute_uv=False) for part in (rows, rows[:3]))
    if values[-1] < SINGULAR * values[0]:
        reason = "they cannot set thrust, roll, pitch and yaw independently (singular mixer)"
        if level[-1] < SINGULAR * level[0]:
            refuse("position", "a layout with an allocation that can be inverted", reason)
        refuse("spin", "others, such as 1, -1, 1, -1 around the aircraft", reason)
    squares = hover_squares(mixer, mass * GRAVITY)
    if not (squares > 0).all():
        reason = "hovering without turning would need a negative thrust of one of them"
        refuse("position", "around the centre of mass", reason)
    thrust = squares * [rotor.thrust_coefficient for rotor in rotors]
    if np.hypot(*(thrust @ [rotor.axis[:2] for rotor in rotors])) > LEAN * mass * GRAVITY:
        refuse("axis", "balanced: no sideways force in hover")
    hover, largest = np.sqrt(squares), np.array([rotor.max_speed for rotor in rotors])
    if not (hover < largest).all():
        worst = int(np.argmax(hover / largest))
        raise QuadrlError(
            f"the rotors must carry {mass:g} kg with thrust to spare",
            name=f"max_speed of rotor {worst + 1}",
            value=rotors[worst].max_speed,
            allowed=f"above its hover speed, {hover[worst]:.4g} rad/s",
        )


PAPER_ROTORS = plus(
    0.23,  # gym-aero
    thrust_coefficient=3.13e-5,  # gym-aero
    torque_coefficient=7.5e-7,  # gym-aero
    lag_up=1 / 0.18,  # gym-aero
    lag_down=1 / 0.18,  # gym-aero, which has one constant for both
    max_speed=math.sqrt(2.0) * math.sqrt(0.65 * GRAVITY / (4 * 3.13e-5)),  # twice the weight
    radius=0.06,  # chosen
    disc_radius=0.15,  # the OS4: the physics page says why
)
"""The paper's rotors, in a cross."""
