"""Effects of the air on the rotors beyond equation 7, and which of them act on an aircraft.

Without any, the paper's equations are left. `engines/native/aero.h` and `engines/dynamics.py` have
the forces, docs/lab/air.md the equations with their sources.
"""

# pyright: reportUnnecessaryIsInstance=false
# What users give is checked, whatever its annotation promises.
from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from quadrl.aircraft.rotors import GRAVITY, MAX, MIN, Rotor, Vector
from quadrl.base.errors import QuadrlError
from quadrl.base.validation import number

DENSITIES = (1e-3, 100.0)  # [kg/m^3]
MAX_BODY_LIFT = 2.0
MAX_PITCH = 10.0
MOST_OFFSET = 0.2
"""Largest distance of the centre of lift from the hub by `flapping_moment`, in radii (chosen)."""
MOST_TAKEN = 0.36
"""Largest share of the flow through a disc that the ground takes: lift over 0.64."""
WINDMILL = 0.9
"""By how much thrust grows for each m/s of descent beyond 2 w0, on the way to the windmill state,
over 2 rho A w0: near what Johnson's model gives for each preset (NASA/TP-2005-213477)."""
STILL_AIR, ROTOR_EFFECTS, GROUND_EFFECT = range(3)
"""Values of `Aerodynamics.effects`: none, effects on the rotors, and also that of the ground."""


@dataclasses.dataclass(frozen=True)
class Aerodynamics:
    """Effects of the air on the rotors of an aircraft. Every number is part of its row.

    An effect is off where its flag is False or its number 0. The other numbers say how strong an
    effect is that is on. None is another aircraft's unasked: what blades do has to be given.
    """

    inflow: bool = False
    """Thrust that answers climb, descent and flight across the wind (blade element and momentum
    theory)."""
    ground_effect: bool = False
    """Thrust that grows near the ground, at z = 0 of the world."""
    rotor_drag: float = 0.0
    """k_H [N s^2/(m rad)]: drag of a rotor in its plane over rotor speed and airspeed."""
    flapping_moment: float = 0.0
    """k_flap [N s^2/rad]: moment on the hub over rotor speed and airspeed; nose up in forward
    flight, and never above MOST_OFFSET radii times the thrust."""
    flapping_pitch: float = 1.0
    """Share of `flapping_moment` that acts in pitch, by the airspeed along x; all of it in roll."""
    vortex_ring: float = 0.0
    """D, 0 to 1: loss of thrust in fast descent, as a share of the answer to inflow."""
    vortex_ring_noise: float = 0.0
    """sigma_T, 0 to 1: standard deviation of the thrust in the middle of the vortex ring state, as
    a share of it."""
    rotor_inertia: float = 0.0
    """J_r [kg m^2] of a rotor and its drive about its axis: reaction to its acceleration, and
    gyroscopic moment."""
    blade_lift: float = 0.0
    """s: solidity of the disc times lift slope of the blades [1/rad]. Acts with `inflow`, which
    needs it."""
    translational_lift: float = 0.0
    """Lift by the airspeed in the plane of a rotor, over its square and over the density and area
    of the disc. Acts with `inflow`."""
    body_lift: float = 2.0
    """K_b, 0 to 2: lift of the air that rises between the rotors. Acts with `ground_effect`."""
    air_density: float = 1.225
    """rho [kg/m^3] of the air in which the coefficients of the aircraft and its rotors hold; in
    thinner air these are others too (`presets.at_air_density`)."""

    def __post_init__(self) -> None:
        """Validate the numbers."""
        for name in ("inflow", "ground_effect"):
            if not isinstance(getattr(self, name), bool):
                raise QuadrlError(name=name, value=getattr(self, name), allowed="True or False")
        ranges = dict.fromkeys(
            ("rotor_drag", "flapping_moment", "rotor_inertia", "translational_lift"), (0.0, MAX)
        ) | dict.fromkeys(("vortex_ring", "vortex_ring_noise"), (0.0, 1.0))
        ranges |= {"blade_lift": (0.0, MAX), "body_lift": (0.0, MAX_BODY_LIFT)}
        ranges |= {"flapping_pitch": (0.0, MAX_PITCH)}
        for name, (low, high) in (ranges | {"air_density": DENSITIES}).items():
            object.__setattr__(self, name, number(name, getattr(self, name), low, high))
        if self.inflow and self.blade_lift < MIN:
            reason = "thrust answers the flow by the lift of the aircraft's own blades"
            allowed = "above 0 with inflow: solidity of the disc times lift slope of the blades"
            raise QuadrlError(reason, name="blade_lift", value=self.blade_lift, allowed=allowed)
        if (self.vortex_ring or self.vortex_ring_noise) and not self.inflow:
            name = "vortex_ring" if self.vortex_ring else "vortex_ring_noise"
            reason = "the vortex ring state takes away from the thrust that inflow gives"
            raise QuadrlError(reason, name=name, value=getattr(self, name), allowed="inflow=True")

    @classmethod
    def full(cls) -> Aerodynamics:
        """Every effect, with the numbers of the paper's aircraft; `presets` has those of others."""
        return cls(
            inflow=True,
            ground_effect=True,
            vortex_ring=0.44,
            vortex_ring_noise=0.1,
            # Blade theory of the OS4, with stiff plastic blades: the physics page says how.
            blade_lift=0.953,
            translational_lift=0.0566,  # k_h = 4.9e-3 N s^2/m^2
            rotor_drag=1.25e-4,
            rotor_inertia=6e-5,  # OS4, with its gear
        )

    def at(self, air_density: float) -> Aerodynamics:
        """The same in air of another density [kg/m^3], to which forces are proportional."""
        ratio = number("air_density", air_density, *DENSITIES) / self.air_density
        forces = {name: getattr(self, name) * ratio for name in ("rotor_drag", "flapping_moment")}
        return dataclasses.replace(self, air_density=air_density, **forces)

    @property
    def uses_discs(self) -> bool:
        """Whether an effect depends on the radius of the discs."""
        return self.inflow or self.ground_effect

    @property
    def effects(self) -> int:
        """The variant of the kernels that an aircraft needs."""
        if self.ground_effect:
            return GROUND_EFFECT
        return ROTOR_EFFECTS if any(getattr(self, name) for name in SWITCHES) else STILL_AIR


SWITCHES = (
    *("inflow", "ground_effect", "rotor_drag", "flapping_moment"),
    *("vortex_ring", "vortex_ring_noise", "rotor_inertia"),
)
"""Fields that switch an effect off by False or 0."""
EFFECTS = {
    "inflow": ("inflow",),
    "rotor_drag": ("rotor_drag", "flapping_moment"),
    "ground_effect": ("ground_effect",),
    "vortex_ring": ("inflow", "vortex_ring", "vortex_ring_noise"),
    "rotor_inertia": ("rotor_inertia",),
}
"""Effects that can be asked for by name, and the fields that each takes from the full set."""
NONE, FULL = "none", "full"


def check_air(
    air: Aerodynamics,
    rotors: Sequence[Rotor],
    mass: float,
    inertia: Vector,
    max_speed: np.ndarray,
    timestep: float,
) -> None:
    """Refuse discs that make power from nothing, and effects that are too fast for the step.

    Args:
        air: Effects of the air on the rotors of an aircraft.
        rotors: Its rotors.
        mass: Its mass [kg].
        inertia: Its principal moments [kg m^2].
        max_speed: Largest speeds of the rotors (R,) [rad/s].
        timestep: Physics timestep [s].

    Raises:
        QuadrlError: The message says what would be allowed.
    """
    if not isinstance(air, Aerodynamics):
        raise QuadrlError(name="aerodynamics", value=air, allowed="an Aerodynamics")
    for k, rotor in enumerate(rotors):
        merit = rotor.figure_of_merit(air.air_density)
        if air.uses_discs and merit > 1:
            raise QuadrlError(
                f"with its thrust and torque it would hover on {1 / merit:.2g} of the power that "
                "momentum theory asks for",
                name=f"disc_radius of rotor {k + 1}",
                value=rotor.disc,
                allowed=f"at least {rotor.disc * merit:.3g} m",
            )
    if len(rotors) * air.rotor_inertia > inertia[2]:
        allowed = f"at most {inertia[2] / len(rotors):.3g} kg m^2, a rotor's share"
        raise QuadrlError(name="rotor_inertia", value=air.rotor_inertia, allowed=allowed)
    rates = _rates(air, rotors, mass, np.array(inertia), max_speed)
    what, rate = max(rates.items(), key=lambda item: item[1])
    if rate * timestep > 1:
        reason = f"{what} changes the flight at up to {rate:.3g} 1/s, and rate times step may be 1"
        allowed = f"at most {1 / rate:.3g} s"
        raise QuadrlError(reason, name="physics_timestep", value=timestep, allowed=allowed)


def _rates(
    air: Aerodynamics,
    rotors: Sequence[Rotor],
    mass: float,
    inertia: np.ndarray,
    fastest: np.ndarray,
) -> dict[str, float]:
    """Upper bounds of the rates [1/s] at which each effect damps or turns the aircraft."""
    arms = np.array([math.hypot(*rotor.position) for rotor in rotors])
    # Lift over climb speed: in fast descent the flow through the disc changes as much as the climb.
    thrust = np.array([rotor.thrust_coefficient for rotor in rotors]) * fastest
    disc = np.array([rotor.disc for rotor in rotors])
    slope = air.inflow * air.blade_lift * air.air_density * math.pi * disc**3 * fastest / 4
    drag, spin = air.rotor_drag * fastest, air.rotor_inertia * fastest.sum()
    flap = air.flapping_moment * max(1.0, air.flapping_pitch) * fastest.sum() / inertia.min()
    steep = thrust * fastest / (disc / 2)  # no rotor gains more over half a radius
    rates = {
        "inflow": max(slope.sum() / mass, (slope * arms**2).sum() / inertia.min()),
        "rotor_drag": max(drag.sum() / mass, (drag * arms**2).sum() / inertia.min()),
        "flapping_moment": (flap * GRAVITY) ** (1 / 3),  # it falls to the side that it turns to
        "rotor_inertia": spin / inertia.min(),
        "ground_effect": air.ground_effect * math.sqrt(steep.sum() / mass),
    }
    return {name: float(rate) for name, rate in rates.items()}
