"""Preset aircraft and their effects of the air, with the source of every number."""

# pyright: reportUnnecessaryIsInstance=false
# What users give is checked, whatever its annotation promises.
from __future__ import annotations

import dataclasses
import math
from typing import Any

from quadrl.aircraft.aerodynamics import EFFECTS, FULL, NONE, SWITCHES, Aerodynamics
from quadrl.aircraft.rotors import Rotor, ring
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.validation import choice

_ALL = Aerodynamics.full()
BRUSHLESS_AIR = dataclasses.replace(
    _ALL,
    rotor_drag=2.5e-6,  # fitted to IMRCLab flights
    flapping_moment=1.02e-7,  # IMRCLab flights: 6.4e-4 N m per m/s sideways
    flapping_pitch=0.46,  # the same flights: 2.9e-4 N m per m/s ahead
    rotor_inertia=6e-8,  # IMRCLab flights
    blade_lift=0.343,  # gives the heave damping of the IMRCLab flights, 0.47 1/s
    vortex_ring=0.59,  # as the brushed one's
    translational_lift=0.0,  # unknown
)
CRAZYFLIE = Vehicle(
    name="crazyflie",  # Crazyflie 2.1, brushed; motors 1 to 4, clockwise from ahead on the right
    mass=0.0293,  # Foerster 2015, "System Identification of the Crazyflie 2.0 Nano Quadrocopter"
    inertia=(16.6e-6, 16.6e-6, 29.3e-6),  # Foerster 2015, principal part
    rotors=ring(
        (315, 225, 135, 45),
        (1, -1, 1, -1),
        0.046,  # Foerster 2015
        thrust_coefficient=2.02e-8,  # thrust stand, stock propellers (IMRCLab, crazyflie-system-id)
        torque_coefficient=2.02e-8 * 5.965e-3,  # ratio of torque to thrust: Foerster 2015
        lag_up=1 / 0.049,  # brushed, from measured rotor speeds (IMRCLab flights)
        lag_down=1 / 0.087,  # the same flights
        max_speed=2426.0,  # the stand's largest, at a battery of 2.97 V
        radius=0.0225,  # propellers of 45 mm
    ),
    drag_coefficient=5e-3,  # chosen: 7.6 m/s of terminal speed
    moment_coefficient=1e-7,  # chosen: the paper's, over the fifth power of the arm length
    action_scale=480.0,  # chosen: the weakest aircraft of the randomization `full` hovers
    physics_timestep=0.005,  # chosen
    control_timestep=0.02,  # chosen
    dead_time=0.01,  # 7 to 10 ms in addition to the lag (IMRCLab flights), in whole physics steps
)
CRAZYFLIE_BRUSHLESS = Vehicle(
    name="crazyflie_brushless",  # Crazyflie 2.1 Brushless, without the guards of its propellers
    mass=0.037,  # weighed (IMRCLab flights)
    inertia=(25e-6, 28e-6, 49e-6),  # drone-models; about x also from IMRCLab flights
    rotors=ring(
        (315, 225, 135, 45),
        (1, -1, 1, -1),
        0.05,  # drone-models
        thrust_coefficient=3.7e-8,  # IMRCLab flights
        torque_coefficient=3.7e-8 * 5.939e-3,  # ratio of torque to thrust: drone-models
        lag_up=1 / 0.042,  # from measured rotor speeds (IMRCLab flights)
        lag_down=1 / 0.037,  # the same flights
        max_speed=math.sqrt(0.18 / 3.7e-8),  # 0.18 N per rotor: drone-models
        radius=0.0275,  # drone-models
    ),
    drag_coefficient=1e-3,  # estimated: what is not drag of the rotors
    moment_coefficient=1e-7,  # chosen: as the brushed one's
    aerodynamics=BRUSHLESS_AIR,  # by default: identified in IMRCLab flights
    action_scale=400.0,  # chosen: the weakest aircraft of the randomization `full` hovers
    physics_timestep=0.0025,  # chosen: it turns faster than the brushed one
    control_timestep=0.02,  # chosen
    dead_time=0.005,  # in addition to the lag (IMRCLab flights)
)
CF21B_500 = Vehicle(
    name="cf21B_500",  # Crazyflie 2.1 Brushless with propeller guards, as drone-models 0.1.0 has it
    mass=0.04338,
    inertia=(25e-6, 28e-6, 49e-6),
    rotors=ring(
        (315, 225, 135, 45),
        (1, -1, 1, -1),
        0.05,
        # Thrust at hover, at 15,896 rpm; it is a parabola with a linear part, 1.3 % more at most.
        thrust_coefficient=3.839e-8,
        torque_coefficient=3.839e-8 * 6.113e-3,  # ratio of torque to thrust at hover
        lag_up=1 / 0.0571,  # at hover: it falls with the speed
        lag_down=1 / 0.0621,  # at hover: it falls with the speed
        max_speed=math.sqrt(0.2 / 3.839e-8),  # 0.2 N per rotor
        radius=0.0275,
    ),
    drag_coefficient=5e-3,  # chosen: 9.2 m/s of terminal speed; with `full` it is linear
    moment_coefficient=1e-7,  # chosen: as the brushed one's
    action_scale=400.0,  # chosen: as the other brushless one's
    physics_timestep=0.0025,  # chosen: as the other brushless one's
    control_timestep=0.02,  # chosen
)
RACER = Vehicle(
    name="racer",  # Foehn et al. 2022, "Agilicious", Science Robotics 7: the Kingfisher
    mass=0.752,
    inertia=(2.5e-3, 2.1e-3, 4.3e-3),
    rotors=tuple(
        Rotor(
            (x, y, 0.0),
            spin=spin,  # chosen: Betaflight's motors 1 to 4 and their directions
            thrust_coefficient=1.562e-6,
            torque_coefficient=1.562e-6 * 0.022,
            lag_up=1 / 0.033,
            lag_down=1 / 0.033,
            max_speed=math.sqrt(8.5 / 1.562e-6),  # 8.5 N per rotor
            radius=0.0635,  # propellers of 5 inches
        )
        for x, y, spin in (
            (-0.075, -0.1, -1.0),
            (0.075, -0.1, 1.0),
            (-0.075, 0.1, 1.0),
            (0.075, 0.1, -1.0),
        )
    ),
    drag_coefficient=2e-2,  # chosen: 19 m/s of terminal speed
    moment_coefficient=1e-4,  # chosen
    action_scale=230.0,  # chosen: the weakest aircraft of the randomization `full` hovers
    physics_timestep=0.005,  # chosen
    control_timestep=0.02,  # chosen
)
HEXA = Vehicle(
    name="hexa",  # AscTec Firefly, in the numbers of RotorS (Furrer et al. 2016), rotors included
    mass=1.53,
    # RotorS gives 0.0977 about z, more than the sum of the other two, which no rigid body has.
    inertia=(0.0347563, 0.0458929, 0.08),
    rotors=ring(
        (30, 90, 150, 210, 270, 330),
        (1, -1, 1, -1, 1, -1),
        0.215,
        thrust_coefficient=8.54858e-6,
        torque_coefficient=8.54858e-6 * 0.016,
        lag_up=1 / 0.0125,
        lag_down=1 / 0.025,
        max_speed=838.0,
        radius=0.1,
    ),
    drag_coefficient=3e-2,  # chosen: 22 m/s of terminal speed
    moment_coefficient=2e-3,  # chosen
    action_scale=110.0,  # chosen: a fifth of the hover speed, since its yaw is weak
    physics_timestep=0.0025,  # chosen: a fifth of the lag
    control_timestep=0.02,  # chosen
)
REAL_AIR = {
    "paper": (_ALL, 1.0),  # equation 8 is its drag beside the rotors' already
    "crazyflie": (
        dataclasses.replace(
            _ALL,
            rotor_drag=1.85e-6,  # drone-models
            # That of the brushless one times the weight, over the rotor speed: the same offset of
            # the centre of lift, in radii, at the same airspeed over that of the tips.
            flapping_moment=5.6e-8,
            rotor_inertia=6.4e-8,  # 2.2e-3 of the inertia about z (flights of a brushed one: ARPL)
            blade_lift=0.384,  # gives the heave damping of drone-models, 0.0128 N s/m
            vortex_ring=0.59,  # leaves 0.92 of the thrust at 1.45 w0: 0.91 by Johnson's model
            translational_lift=0.0,  # unknown; k_h is that share of rho A
        ),
        0.2,  # estimated from its frontal area
    ),
    "crazyflie_brushless": (BRUSHLESS_AIR, 0.2),  # share estimated, as the brushed one's
    "cf21B_500": (  # drone-models has linear drag and the inertia of rotors, and nothing else
        Aerodynamics(
            rotor_drag=3.228e-6,  # 0.0215 N s/m at hover; theirs along the axes is 0.0236 N s/m
            rotor_inertia=3.893e-8,
        ),
        0.0,
    ),
    "racer": (
        dataclasses.replace(
            _ALL,
            rotor_drag=6.2e-5,  # estimated
            rotor_inertia=5.64e-6,  # UZH's simulator of an aircraft with these motors
            blade_lift=0.9,  # estimated, for three blades
            vortex_ring=0.48,  # leaves 0.88 of the thrust at 1.45 w0: 0.86 by Johnson's model
            translational_lift=0.0,  # unknown
        ),
        0.3,  # estimated from its frontal area
    ),
    "hexa": (
        dataclasses.replace(
            _ALL,
            rotor_drag=8.06e-5,  # RotorS
            rotor_inertia=4.3e-6,  # RotorS: a box of 5 g, 0.1 m by 0.015 m
            blade_lift=0.8,  # estimated, for two blades
            vortex_ring=0.49,  # leaves 0.88 of the thrust at 1.45 w0: 0.87 by Johnson's model
            translational_lift=0.0,  # unknown
        ),
        0.3,  # estimated, as the racer's
    ),
}
"""By aircraft: its full set, and the share of its quadratic drag that is not the rotors' own."""


VEHICLES = {
    vehicle.name: vehicle
    for vehicle in (Vehicle(), CRAZYFLIE, CRAZYFLIE_BRUSHLESS, CF21B_500, RACER, HEXA)
}
"""The aircraft that are known by name."""


def in_real_air(vehicle: Vehicle) -> Vehicle:
    """A vehicle with every effect of the air: its own set, or that of the preset of its name.

    Where `drag_coefficient` also stands for the drag of the rotors, as in most presets, only a
    share of it is kept once rotor drag acts.

    Raises:
        QuadrlError: The vehicle has no set of its own, and its name is not one of `REAL_AIR`.
    """
    return with_effects(vehicle, FULL)


def with_effects(vehicle: Vehicle, aerodynamics: str | Aerodynamics | None) -> Vehicle:
    """A vehicle with the effects of the air that are asked for.

    Args:
        vehicle: The aircraft.
        aerodynamics: "none", "full", names of EFFECTS separated by commas (each with the numbers
            of the full set), or an Aerodynamics; None for those that the vehicle has.

    Raises:
        QuadrlError: A name is unknown, or there is no full set for the vehicle.
    """
    if aerodynamics is None:
        return vehicle
    if isinstance(aerodynamics, Aerodynamics):
        return dataclasses.replace(vehicle, aerodynamics=aerodynamics)
    if not isinstance(aerodynamics, str):
        allowed = f"an Aerodynamics, {NONE}, {FULL}, or names of {', '.join(EFFECTS)}"
        raise QuadrlError(name="aerodynamics", value=aerodynamics, allowed=allowed)
    own, share, drag = _full_set(vehicle)
    if aerodynamics == NONE:
        none = Aerodynamics(air_density=vehicle.aerodynamics.air_density)
        return dataclasses.replace(vehicle, aerodynamics=none, drag_coefficient=drag)
    if own is None:
        reason = f"quadrl knows the full set of {', '.join(REAL_AIR)}; give this one its own"
        allowed = "an aircraft with aerodynamics=Aerodynamics(...)"
        raise QuadrlError(reason, name="vehicle", value=vehicle.name, allowed=allowed)
    kept = set(SWITCHES)
    if aerodynamics != FULL:
        names = [name.strip() for name in aerodynamics.split(",")]
        choices = [*EFFECTS, *([NONE, FULL] if len(names) == 1 else [])]
        kept = {f for name in names for f in EFFECTS[choice("aerodynamics", name, choices)]}
    off = {name: Aerodynamics.__dataclass_fields__[name].default for name in SWITCHES}
    chosen = dataclasses.replace(own, **{n: off[n] for n in SWITCHES if n not in kept})
    drag *= share if chosen.rotor_drag else 1.0
    return dataclasses.replace(vehicle, aerodynamics=chosen, drag_coefficient=drag)


def at_air_density(vehicle: Vehicle, air_density: float) -> Vehicle:
    """A vehicle in thinner or denser air, to which thrust, torque and drag are proportional.

    Args:
        vehicle: The aircraft, with coefficients for the density of its aerodynamics.
        air_density: rho [kg/m^3]: 1.225 at sea level, 1.007 at 2,000 m (standard atmosphere).

    Raises:
        QuadrlError: The density is impossible, or the rotors do not carry the aircraft in it.
    """
    air = vehicle.aerodynamics.at(air_density)
    ratio = air.air_density / vehicle.aerodynamics.air_density

    def scaled(part: Any, *names: str, **changes: Any) -> Any:
        return dataclasses.replace(part, **{n: getattr(part, n) * ratio for n in names}, **changes)

    rotors = [scaled(r, "thrust_coefficient", "torque_coefficient") for r in vehicle.rotors]
    own = {"rotors": tuple(rotors), "aerodynamics": air}
    return scaled(vehicle, "drag_coefficient", "moment_coefficient", **own)


def _full_set(vehicle: Vehicle) -> tuple[Aerodynamics | None, float, float]:
    """Every effect of a vehicle, the share of its drag that is not its rotors', and all of it.

    The drag [N s^2/m^2] is the quadratic one that stands for both where rotor drag does not act.
    """
    own, drag = vehicle.aerodynamics, vehicle.drag_coefficient
    known, share = REAL_AIR.get(vehicle.name, (None, 1.0))
    known = known and known.at(own.air_density)
    if own == known:
        return own, share, drag / share if own.rotor_drag and share else drag
    return (own, 1.0, drag) if own.effects else (known, share, drag)  # its drag is what it says
