"""The equations of motion in the array API: the definition that the C of `native/` is held against.

Equations 3 to 10 of the paper for rows of aircraft, in NumPy or torch. `native/aero.h` has the same
forces; a force term is written there and here, under the same name.
"""

from __future__ import annotations

import dataclasses

from quadrl.parameters import Parameters
from quadrl.rotation import Array, namespace, norm, rotation_matrix, stack, to_body, to_world


@dataclasses.dataclass(frozen=True)
class Motion:
    """What moves, arrays (N, k); rates of change stand in the same fields."""

    position: Array  # (N, 3) [m], world frame
    quaternion: Array  # (N, 4) (w, x, y, z), body to world
    velocity: Array  # (N, 3) [m/s], world frame
    body_rate: Array  # (N, 3) [rad/s], body frame
    rotor_speed: Array  # (N, R) [rad/s]


def rotor_acceleration(p: Parameters, speed: Array, command: Array) -> Array:
    """Equation 10 (N, R) [rad/s^2]: the lag of the rotors, which may rise and fall differently.

    A command above a rotor's largest speed asks for that.
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
    return pull.sum(-2), moment.sum(-2)


def aero_wrench(p: Parameters, airspeed: Array, body_rate: Array) -> tuple[Array, Array]:
    """What acts beside thrust and reaction: equations 8 and 9.

    Args:
        p: Parameters.
        airspeed: (N, 3) [m/s], velocity less wind, body frame.
        body_rate: (N, 3) [rad/s].

    Returns:
        Force (N, 3) [N] and moment (N, 3) [N m], body frame.
    """
    force = -(p.drag_coefficient * norm(airspeed))[..., None] * airspeed
    moment = -(p.moment_coefficient * norm(body_rate))[..., None] * body_rate
    return force, moment


def derivative(
    p: Parameters, motion: Motion, command: Array, wind: Array, gravity: float
) -> Motion:
    """The rate of change of a motion, equations 3 to 6.

    Args:
        p: Parameters of the rows.
        motion: What is.
        command: (N, R) of the rotors [rad/s].
        wind: (N, 3) [m/s], world frame.
        gravity: Along z [m/s^2], negative.
    """
    rate, speed, q = motion.body_rate, motion.rotor_speed, motion.quaternion
    rotation = rotation_matrix(q / norm(q)[..., None])
    force, moment = thrust_wrench(p, speed)
    drag, damping = aero_wrench(p, to_body(rotation, motion.velocity - wind), rate)
    push = to_world(rotation, force + drag) / p.mass[..., None]
    spin = p.inertia * rate
    w, x, y, z = (q[..., k] for k in range(4))
    a, b, c = (rate[..., k] for k in range(3))
    turn = stack(-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c,
                 w * c + x * b - y * a)  # fmt: skip
    return Motion(
        position=motion.velocity,
        quaternion=turn / 2,
        velocity=stack(push[..., 0], push[..., 1], push[..., 2] + gravity),
        body_rate=(moment + damping - cross(rate, spin)) / p.inertia,
        rotor_speed=rotor_acceleration(p, speed, command),
    )


def cross(first: Array, second: Array) -> Array:
    """Cross product over the last axis (..., 3)."""
    a, b, c = (first[..., k] for k in range(3))
    x, y, z = (second[..., k] for k in range(3))
    return stack(b * z - c * y, c * x - a * z, a * y - b * x)
