"""Equations 3 to 10 of the paper, integrated exactly, with nothing of the package but parameters.

In the paper's own terms: v and omega in the body frame, and q the rotation from the inertial frame
to the body, the inverse of MuJoCo's. Products of quaternions are written out as the paper has them.
Beyond the paper: any number of rotors anywhere, and another lag while a rotor slows down.
"""

import numpy as np
from scipy.integrate import solve_ivp

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
        lag[..., k] = np.where(rising, rotor.lag_up, rotor.lag_down)
    air = v - turned(q, wind)
    force = force - vehicle.drag_coefficient * length(air) * air  # (8)
    moment = moment - vehicle.moment_coefficient * length(omega) * omega  # (9)
    inertia = np.array(vehicle.inertia)
    rates = [
        turned(inverse(q), v),  # (5)
        -0.5 * hamilton(pure(omega), q),  # (6)
        force / vehicle.mass + turned(q, np.broadcast_to(GRAVITY, v.shape)) - np.cross(omega, v),
        (moment - np.cross(omega, inertia * omega)) / inertia,  # (3) above, (4)
        -lag * (speed - command),  # (10)
    ]
    return np.concatenate(rates, axis=-1)


def fly(vehicle, start, command, seconds, wind):
    """States x (n, 13 + R) after some seconds at constant commands (n, R); see `derivative`."""
    solution = solve_ivp(
        lambda _, x: derivative(x.reshape(start.shape), vehicle, command, wind).ravel(),
        (0.0, seconds),
        start.ravel(),
        method="DOP853",
        rtol=1e-12,
        atol=1e-12,
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
