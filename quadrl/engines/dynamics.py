"""The equations of motion in the array API: the definition that the C of `native/` is held against.

Equations 3 to 10 of the paper for rows of aircraft, in NumPy or torch, and further effects of the
air on rotors (`quadrl.aircraft.aerodynamics`). `native/aero.h` has the same forces: a force is
written there and here, under the same name. Its derivatives are generated from this file
(`quadrl.engines.adjoint`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from typing import Any

from quadrl.aircraft.aerodynamics import (
    GROUND_EFFECT,
    MOST_OFFSET,
    MOST_TAKEN,
    STILL_AIR,
    WINDMILL,
)
from quadrl.aircraft.parameters import WIND, Parameters
from quadrl.base.rotation import (
    Array,
    cross,
    namespace,
    norm,
    rotation_matrix,
    stack,
    to_body,
    to_world,
)


@dataclasses.dataclass(frozen=True)
class Motion:
    """Position, velocity and rotor speeds, arrays (N, k), or their rates of change."""

    position: Array  # (N, 3) [m], world frame
    quaternion: Array  # (N, 4) (w, x, y, z), body to world
    velocity: Array  # (N, 3) [m/s], world frame
    body_rate: Array  # (N, 3) [rad/s], body frame
    rotor_speed: Array  # (N, R) [rad/s]


def rotor_acceleration(p: Parameters, speed: Array, command: Array) -> Array:
    """Equation 10 (N, R) [rad/s^2]: the lag of the rotors, which may rise and fall differently.

    A command above a rotor's largest speed counts as that speed.
    """
    xp = namespace(speed)
    goal = xp.where(command < p.rotor.max_speed, command, p.rotor.max_speed)
    rate = xp.where(goal > speed, p.rotor.lag_up, p.rotor.lag_down)
    return -rate * (speed - goal)


def thrust_wrench(p: Parameters, speed: Array) -> tuple[Array, Array]:
    """Equation 7: force (N, 3) [N] and moment (N, 3) [N m] of the rotors, body frame."""
    rotor = p.rotor
    thrust = rotor.thrust_coefficient * speed * speed  # (N, R)
    pull = rotor.axis * thrust[..., None]
    torque = -rotor.spin * rotor.torque_coefficient * speed * speed
    moment = cross(rotor.position, pull) + rotor.axis * torque[..., None]
    return total(pull, -2), total(moment, -2)


def aero_wrench(p: Parameters, airspeed: Array, body_rate: Array) -> tuple[Array, Array]:
    """Drag and aerodynamic moment, equations 8 and 9, and the steady moment of an episode.

    Args:
        p: Parameters.
        airspeed: (N, 3) [m/s], velocity less wind, body frame.
        body_rate: (N, 3) [rad/s].

    Returns:
        Force (N, 3) [N] and moment (N, 3) [N m], body frame.
    """
    force = -(p.drag_coefficient * norm(airspeed))[..., None] * airspeed
    damping = (p.moment_coefficient * norm(body_rate))[..., None] * body_rate
    moment = p.steady_moment - damping
    return force, moment


def lift_change(
    p: Parameters, speed: Array, climb: Array, p_square: Array, noise: Array | float
) -> Array:
    """Thrust (N, R) [N] less that of equation 7: inflow and vortex ring state.

    Args:
        p: Parameters.
        speed: (N, R) of the rotors [rad/s].
        climb: (N, R) airspeed of each hub along the rotor's axis [m/s].
        p_square: (N, R) of its airspeed in the rotor's plane [m^2/s^2].
        noise: (N, R) of each rotor's thrust, of unit variance.
    """
    xp, rotor = namespace(speed), p.rotor
    inflow, rest = p.inflow[..., None], rotor.thrust_coefficient * speed * speed
    flow, induced = _disc(p)
    response = inflow * p.blade_lift[..., None] * flow * rotor.disc_radius * induced
    w0 = induced * speed
    k = response / (8 * rotor.thrust_coefficient) * w0
    v = clip(climb, -2 * w0, 3 * w0)  # beyond, the steps would diverge
    w = 0.5 * (v - k + xp.sqrt((v - k) ** 2 + 4 * w0 * (w0 + k)))  # exact where p_square is 0
    for _ in range(2):  # Newton's
        through = xp.sqrt(w * w + p_square)
        lacking = (w0 + k) * w0 - k * w - (w - v) * through
        w = w + through * lacking / ((k + through) * through + (w - v) * w + 1e-12)
    over = 1 / (w0 + 1e-6)
    off = (climb * over + 1.4) / 1.2
    steep = clip(1 - off * off, low=0.0)
    ring = steep * steep * steep * clip(1 - p_square * over * over / 0.95**2, low=0.0)
    change = (
        flow * k * (w0 - w - p.vortex_ring[..., None] * w0 * ring)
        + flow * inflow * WINDMILL * w0 * clip(-2 * w0 - climb, low=0.0)
        + inflow * p.translational_lift[..., None] * flow / 2 * p_square
        + p.vortex_ring_noise[..., None] * rest * noise * ring
    )
    return clip(change, -rest, 0.6 * rest)  # above, the blades stall


def ground_share(p: Parameters, up: Array, height: Array) -> Array:
    """Share (N, R) of its flow that the ground takes from a rotor's disc in hover.

    Args:
        p: Parameters.
        up: (N, 3), the world's vertical in the body frame.
        height: (N,) of the centre of mass over the ground [m].
    """
    xp, position, radius = namespace(height), p.rotor.position, p.rotor.disc_radius
    over = height[..., None] + (position * up[..., None, :]).sum(-1)
    z = clip(over, low=radius / 2)

    def image(radius: Array, distance_square: Array, z: Array) -> Array:
        square = distance_square + 4 * z * z
        return 0.5 * radius * radius * z / (square * xp.sqrt(square))

    aside = position[..., None, :, :2] - position[..., :, None, :2]  # (N, R, R, 2)
    share = total(image(radius[..., None, :], (aside**2).sum(-1), z[..., :, None]))
    centre = 4 * (position[..., :2] ** 2).sum(-1)
    share = share + 4 * p.body_lift[..., None] * image(radius, centre, z)
    near = clip((8 * radius - z) / (2 * radius), 0.0, 1.0)
    cosine = clip((p.rotor.axis * up[..., None, :]).sum(-1), low=0.0)
    return p.ground_effect[..., None] * share * cosine**2 * near**2 * (3 - 2 * near)


def rotor_wrench(
    p: Parameters,
    speed: Array,
    command: Array,
    airspeed: Array,
    body_rate: Array,
    up: Array,
    height: Array,
    noise: Array | float = 0.0,
    effects: int = GROUND_EFFECT,
) -> tuple[Array, Array]:
    """Force and moment of the air on the rotors beyond equation 7, and of their inertia.

    Args:
        p: Parameters.
        speed: (N, R) of the rotors [rad/s].
        command: (N, R) [rad/s].
        airspeed: (N, 3) [m/s], body frame.
        body_rate: (N, 3) [rad/s].
        up: (N, 3), the world's vertical in the body frame.
        height: (N,) of the centre of mass over the ground [m].
        noise: (N, R) of each rotor's thrust, of unit variance.
        effects: `Aerodynamics.effects`, of all rows.

    Returns:
        Force (N, 3) [N] and moment (N, 3) [N m], body frame.
    """
    rotor = p.rotor
    turn = body_rate[..., None, :]  # (N, 1, 3)
    hub = airspeed[..., None, :] + cross(turn, rotor.position)
    climb = (hub * rotor.axis).sum(-1)
    across = hub - climb[..., None] * rotor.axis
    p_square = (across * across).sum(-1)
    change = lift_change(p, speed, climb, p_square, noise)
    if effects == GROUND_EFFECT:
        rest = rotor.thrust_coefficient * speed * speed
        hover = (_disc(p)[1] * speed) ** 2
        taken = ground_share(p, up, height) * hover / (hover + p_square + 1e-12)
        most = clip(taken, high=MOST_TAKEN)
        change = change + (rest + change) * (most / (1 - most))  # lift / (1 - most)
    drag = (p.rotor_drag[..., None] * speed)[..., None] * across
    push = change[..., None] * rotor.axis - drag
    # Smoothly, the moment cannot move the centre of lift farther than that. What is added is the
    # smallest number for a rotor at rest that single precision has, too.
    most = MOST_OFFSET * rotor.disc_radius * rotor.thrust_coefficient * speed
    slope = p.flapping_moment[..., None]
    share = most / namespace(speed).sqrt(most * most + slope * slope * p_square + 1e-37)
    flap = (slope * speed * share)[..., None] * cross(across, rotor.axis)
    flap = stack(flap[..., 0], p.flapping_pitch[..., None] * flap[..., 1], flap[..., 2])
    inertia = rotor.spin * p.rotor_inertia[..., None]
    momentum = (inertia * speed)[..., None] * rotor.axis
    faster = (inertia * rotor_acceleration(p, speed, command))[..., None] * rotor.axis
    moment = cross(rotor.position, push) + flap - cross(turn, momentum) - faster
    return total(push, -2), total(moment, -2)


def _disc(p: Parameters) -> tuple[Array, Array]:
    """2 rho A (N, R) [kg/m], and nu [m/rad]: induced velocity in hover over rotor speed."""
    flow = 2 * math.pi * p.air_density[..., None] * p.rotor.disc_radius**2
    return flow, namespace(flow).sqrt(p.rotor.thrust_coefficient / flow)


def derivative(
    p: Parameters,
    motion: Motion,
    command: Array,
    air: Array,
    gravity: float,
    effects: int = GROUND_EFFECT,
) -> Motion:
    """The rate of change of a motion, equations 3 to 6.

    Args:
        p: Parameters of the rows.
        motion: The present motion.
        command: (N, R) of the rotors [rad/s].
        air: (N, AIR) as `parameters.AIR` has it, or the wind alone (N, 3) [m/s, world frame].
        gravity: Along z [m/s^2], negative.
        effects: Largest `Aerodynamics.effects` of the rows; other effects are left out.
    """
    rate, speed, q = motion.body_rate, motion.rotor_speed, motion.quaternion
    rotation = rotation_matrix(q / norm(q)[..., None])
    force, moment = thrust_wrench(p, speed)
    airspeed = to_body(rotation, motion.velocity - air[..., :WIND])
    drag, damping = aero_wrench(p, airspeed, rate)
    force, moment = force + drag, moment + damping
    if effects != STILL_AIR:
        noise = air[..., WIND : WIND + speed.shape[-1]] if air.shape[-1] > WIND else 0.0
        around = airspeed, rate, rotation[..., 2, :], motion.position[..., 2]
        more, twist = rotor_wrench(p, speed, command, *around, noise, effects)
        force, moment = force + more, moment + twist
    push = (to_world(rotation, force) + p.steady_force) / p.mass[..., None]
    spin = p.inertia * rate
    w, x, y, z = (q[..., k] for k in range(4))
    a, b, c = (rate[..., k] for k in range(3))
    turn = stack(-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c,
                 w * c + x * b - y * a)  # fmt: skip
    return Motion(
        position=motion.velocity,
        quaternion=turn / 2,
        velocity=stack(push[..., 0], push[..., 1], push[..., 2] + gravity),
        body_rate=(moment - cross(rate, spin)) / p.inertia,
        rotor_speed=rotor_acceleration(p, speed, command),
    )


def total(array: Array, axis: int = -1) -> Array:
    """Sum over an axis, added from the first to the last for any number of rotors."""
    return functools.reduce(operator.add, namespace(array).moveaxis(array, axis, 0))


def clip(x: Array, low: Any = None, high: Any = None) -> Array:
    """Numbers no smaller than `low` and no larger than `high`, where these are given."""
    xp = namespace(x)
    if low is not None:
        x = xp.where(x < low, low, x)
    return x if high is None else xp.where(x > high, high, x)
