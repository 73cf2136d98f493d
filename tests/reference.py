"""Equations 3 to 10 of the paper, integrated exactly, with nothing of the package but parameters.

In the paper's own terms: v and omega in the body frame, and q the rotation from the inertial frame
to the body, the inverse of MuJoCo's. Products of quaternions are written out as the paper has them.
Beyond the paper: any number of rotors anywhere, another lag while a rotor slows down, and what the
air does to the rotors, with the flow through each disc from a bracketed root.
"""

import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2], inertial frame


def hamilton(a, b):
    """Product of quaternions (w, x, y, z), (..., 4)."""
    w, u, s, v = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    real = w * s - (u * v).sum(axis=-1, keepdims=True)
    return np.concatenate([real, w * v + s * u + np.cross(u, v)], axis=-1)


def inverse(q):
    """Of quaternions (..., 4) of any length."""
    return np.concatenate([q[..., :1], -q[..., 1:]], axis=-1) / (q * q).sum(-1, keepdims=True)


def pure(vector):
    """The quaternions (0, vector), (..., 4)."""
    return np.concatenate([np.zeros_like(vector[..., :1]), vector], axis=-1)


def turned(q, vector):
    """The vector part (..., 3) of q (0, vector) q^-1."""
    return hamilton(hamilton(q, pure(vector)), inverse(q))[..., 1:]


def length(vector):
    """(..., 1)."""
    return np.linalg.norm(vector, axis=-1, keepdims=True)


def flow_through(w0, kappa, climb, across):
    """The flow through a disc [m/s]: blade elements and momentum theory give the same thrust.

    Args:
        w0: What it is at rest, at this rotor speed.
        kappa: How strongly the thrust answers.
        climb: Airspeed along the axis, -2 to 3 w0.
        across: Airspeed in the plane.
    """
    if w0 == 0:
        return 0.0

    def lacking(w):
        blades = w0 * w0 + kappa * w0 * (w0 - w)
        return blades - (w - climb) * math.hypot(w, across)

    return brentq(lacking, min(climb, 0.0), abs(climb) + 9 * (1 + kappa) * w0, xtol=1e-14)


def lift(rotor, air, speed, climb, across, noise=0.0):
    """Thrust of a rotor far from the ground [N]; numbers."""
    rest = rotor.thrust_coefficient * speed * speed
    if not air.inflow:
        return rest
    area = math.pi * rotor.disc**2
    per_speed = math.sqrt(rotor.thrust_coefficient / (2 * air.air_density * area))
    w0 = per_speed * speed
    kappa = air.air_density * area * rotor.disc * air.blade_lift * per_speed
    kappa /= 4 * rotor.thrust_coefficient
    momentum = 2 * air.air_density * area * w0 * w0
    w = flow_through(w0, kappa, min(max(climb, -2 * w0), 3 * w0), across)
    total = rest + (momentum * kappa * (1 - w / w0) if w0 else 0.0)
    # Towards the windmill state.
    total += 2 * air.air_density * area * w0 * 0.9 * max(-2 * w0 - climb, 0.0)
    total += air.translational_lift * air.air_density * area * across * across
    deep = 1 - ((climb / (w0 + 1e-6) + 1.4) / 1.2) ** 2
    slow = 1 - (across / (0.95 * (w0 + 1e-6))) ** 2
    if deep > 0 and slow > 0:
        ring = deep**3 * slow
        total += (air.vortex_ring_noise * noise * rest - momentum * kappa * air.vortex_ring) * ring
    return min(max(total, 0.0), 1.6 * rest)


def ground_factor(vehicle, k, z, tilt, speed, across):
    """Of the lift of rotor k, z [m] over the ground; `tilt` is the cosine of its axis."""
    rotors, air = vehicle.rotors, vehicle.aerodynamics
    radius, z = rotors[k].disc, max(z, rotors[k].disc / 2)
    if not air.ground_effect or tilt <= 0 or z >= 8 * radius:
        return 1.0
    place = np.array(rotors[k].position[:2])
    share = 0.0
    for other in rotors:
        d = np.linalg.norm(np.array(other.position[:2]) - place)
        share += other.disc**2 * z / 2 / (d * d + 4 * z * z) ** 1.5
    b = 2 * np.linalg.norm(place)
    share += 2 * air.body_lift * radius**2 * z / (b * b + 4 * z * z) ** 1.5
    if z > 6 * radius:
        x = (8 * radius - z) / (2 * radius)
        share *= 3 * x**2 - 2 * x**3
    area = math.pi * radius**2
    square = rotors[k].thrust_coefficient * speed**2 / (2 * air.air_density * area)
    share *= tilt**2 * square / (square + across**2 + 1e-12)
    return 1 / (1 - min(share, 0.36))


def rotor_effects(x, vehicle, lag, air_velocity):
    """Force and moment (..., 3) of the air and of inertia on the rotors beside (7), body frame."""
    q, omega, speed, air = x[..., 3:7], x[..., 10:13], x[..., 13:], vehicle.aerodynamics
    force, moment = np.zeros_like(omega), np.zeros_like(omega)
    up = turned(q, np.broadcast_to((0.0, 0.0, 1.0), omega.shape))
    for k, rotor in enumerate(vehicle.rotors):
        r, axis = np.array(rotor.position), np.array(rotor.axis)
        hub = air_velocity + np.cross(omega, r)
        climb = hub @ axis
        across = hub - climb[..., None] * axis
        z, tilt = x[..., 2] + up @ r, up @ axis
        more = np.empty_like(climb)
        for n in np.ndindex(climb.shape):
            turning, sideways = speed[n][k], np.linalg.norm(across[n])
            more[n] = lift(rotor, air, turning, climb[n], sideways)
            more[n] *= ground_factor(vehicle, k, z[n], tilt[n], turning, sideways)
            more[n] -= rotor.thrust_coefficient * turning**2
        omega_k = speed[..., k, None]
        push = more[..., None] * axis - air.rotor_drag * omega_k * across
        momentum = rotor.spin * air.rotor_inertia * omega_k * axis
        force += push
        flapping = air.flapping_moment * omega_k * np.cross(across, axis)
        sideways = np.linalg.norm(across, axis=-1, keepdims=True)
        most = 0.2 * rotor.disc * rotor.thrust_coefficient * omega_k**2
        size = np.hypot(most, air.flapping_moment * omega_k * sideways)
        flapping[..., 1] *= air.flapping_pitch
        moment += np.cross(r, push) + flapping * most / np.maximum(size, 1e-300)
        moment -= rotor.spin * air.rotor_inertia * lag[..., k, None] * axis
        moment -= np.cross(omega, momentum)
    return force, moment


def derivative(x, vehicle, command, wind):
    """Of x (..., 13 + R): position (3), q (4), v (3), omega (3), rotor speed (R)."""
    q, v, omega, speed = x[..., 3:7], x[..., 7:10], x[..., 10:13], x[..., 13:]
    force, moment = np.zeros_like(v), np.zeros_like(v)
    lag = np.empty_like(speed)
    for k, rotor in enumerate(vehicle.rotors):  # (7)
        square, axis = speed[..., k, None] ** 2, np.array(rotor.axis)
        thrust = rotor.thrust_coefficient * square * axis
        force += thrust
        moment += np.cross(rotor.position, thrust)
        moment -= rotor.spin * rotor.torque_coefficient * square * axis  # the reaction
        rising = command[..., k] > speed[..., k]
        rate = np.where(rising, rotor.lag_up, rotor.lag_down)
        lag[..., k] = -rate * (speed[..., k] - command[..., k])  # (10)
    air = v - turned(q, wind)
    force = force - vehicle.drag_coefficient * length(air) * air  # (8)
    moment = moment - vehicle.moment_coefficient * length(omega) * omega  # (9)
    if vehicle.aerodynamics.effects:
        more, twist = rotor_effects(x, vehicle, lag, air)
        force, moment = force + more, moment + twist
    inertia = np.array(vehicle.inertia)
    rates = [
        turned(inverse(q), v),  # (5)
        -0.5 * hamilton(pure(omega), q),  # (6)
        force / vehicle.mass + turned(q, np.broadcast_to(GRAVITY, v.shape)) - np.cross(omega, v),
        (moment - np.cross(omega, inertia * omega)) / inertia,  # (3) above, (4)
        lag,
    ]
    return np.concatenate(rates, axis=-1)


def fly(vehicle, start, command, seconds, wind, tolerance=1e-12):
    """States x (n, 13 + R) after some seconds at constant commands (n, R); see `derivative`."""
    solution = solve_ivp(
        lambda _, x: derivative(x.reshape(start.shape), vehicle, command, wind).ravel(),
        (0.0, seconds),
        start.ravel(),
        method="DOP853",
        rtol=tolerance,
        atol=tolerance,
    )
    assert solution.success, solution.message
    return solution.y[:, -1].reshape(start.shape)


def to_mujoco(x):
    """qpos (n, 7), qvel (n, 6) and rotor speeds (n, R) of states x (n, 13 + R)."""
    q = inverse(x[:, 3:7])
    return (
        np.concatenate([x[:, :3], q], axis=-1),
        np.concatenate([turned(q, x[:, 7:10]), x[:, 10:13]], axis=-1),
        x[:, 13:],
    )


QUANTITIES = ("position", "attitude", "velocity", "body_velocity", "body_rate", "rotor_speed")


def deviation(qpos, qvel, speed, x):
    """How far aircraft are from exact states x (n, 13 + R).

    Returns:
        (n, 6), as QUANTITIES names them: position [m], attitude [rad], velocity in the world and in
        the body frame [m/s], body rate and rotor speed [rad/s].
    """
    exact_qpos, exact_qvel, exact_speed = to_mujoco(x)
    between = hamilton(inverse(exact_qpos[:, 3:]), qpos[:, 3:])
    angle = 2 * np.arctan2(length(between[:, 1:]), np.abs(between[:, :1]))
    apart = (
        length(qpos[:, :3] - exact_qpos[:, :3]),
        angle,
        length(qvel[:, :3] - exact_qvel[:, :3]),
        length(turned(inverse(qpos[:, 3:]), qvel[:, :3]) - x[:, 7:10]),
        length(qvel[:, 3:] - exact_qvel[:, 3:]),
        np.abs(speed - exact_speed).max(axis=-1, keepdims=True),
    )
    return np.concatenate(apart, axis=-1)
