"""Flights of a simulated aircraft that a controller moves by steps, logged with real noise."""

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from quadrl.engines.mujoco import BatchEngine
from quadrl.engines.state import Start

GRAVITY = 9.81
NOISE = {  # white, and slow with its time [s]
    "body_rate": (0.02, 0.0, 1.0),
    "acceleration": (0.3, 0.0, 1.0),
    "velocity": (0.005, 0.02, 0.5),
    "position": (0.001, 0.003, 0.5),
    "attitude": (0.001, 0.005, 1.0),
    "rotor_speed": (8.0, 0.0, 1.0),
    "battery": (0.005, 0.0, 1.0),
}


def fly(vehicle, command_map, count=4, seconds=20.0, seed=0, noise=1.0):
    """Logs, each a dict of arrays (T, k) in SI units by name, `pwm` from 0 to 1.

    Steps of the velocity that is asked for, up to 1.5 m/s, of the yaw rate, and short ones of the
    roll and pitch rates.
    """
    rng = np.random.default_rng(seed)
    step, mixer = vehicle.physics_timestep, vehicle.mixer
    steps, dead = round(seconds / step), round(vehicle.dead_time / step)
    engine = BatchEngine(vehicle, count, altitude=1000.0, engine="free_flight")
    still = np.zeros((count, 3))
    level = np.tile((1.0, 0, 0, 0), (count, 1))
    hover = np.tile(vehicle.hover_speed, (count, 1))
    engine.place(np.arange(count), Start(still, level, still, still, hover))
    inverse = np.linalg.pinv(mixer)
    often = round(0.9 / step)
    asked = rng.uniform(-1, 1, (steps // often + 2, count, 4)) * (1.5, 1.5, 0.8, 1.5)
    flick = rng.uniform(-1, 1, (steps // (often // 6) + 7, count, 2)) * 2.5
    time = step * np.arange(steps)
    battery = np.tile(4.1 - 0.5 * time[:, None, None] / 60 - 0.1 * rng.random(count)[:, None], 1)
    sent, found = [], []
    for k in range(steps):
        q, v = engine.qpos.copy(), engine.qvel.copy()
        turn = Rotation.from_quat(q[:, 3:], scalar_first=True)
        up = turn.as_matrix()[:, :, 2]
        wish = asked[k // often]
        push = 2.0 * (wish[:, :3] - v[:, :3]) + (0, 0, GRAVITY)
        push[:, :2] += -0.3 * (q[:, :2] - engine.origin[:2])
        push[:, 2] += -1.0 * (q[:, 2] - engine.origin[2])
        lift = vehicle.mass * np.clip((push * up).sum(1), 3.0, 18.0)
        tilt = turn.inv().apply(np.cross(up, push / np.linalg.norm(push, axis=1)[:, None]))
        rate = 6.0 * tilt
        rate[:, :2] += flick[k // (often // 6)]
        rate[:, 2] = wish[:, 3]
        gain = np.array((14.0, 14.0, 4.0))
        moment = np.array(vehicle.inertia) * gain * (rate - v[:, 3:])
        squares = np.concatenate([lift[:, None], moment], axis=1) @ inverse.T
        speed = np.sqrt(np.clip(squares, (0.3 * hover) ** 2, vehicle.max_speed**2))
        pwm = np.rint(65535 * np.clip(command_map.command(speed, battery[k]), 0, 1)) / 65535
        sent.append(pwm)
        old = max(k - dead, 0)
        engine.ctrl[:] = command_map.speed(sent[old], battery[old])
        found.append(np.concatenate([q, v, engine.act], axis=1))
        engine.advance(1)
    state = np.stack(found)
    spin = state[:, :, 13:]
    velocity = state[:, :, 7:10]
    logs = []
    for n in range(count):
        turn = Rotation.from_quat(state[:, n, 3:7], scalar_first=True)
        force = np.gradient(velocity[:, n], step, axis=0) + (0, 0, GRAVITY)
        clean = {
            "body_rate": state[:, n, 10:13],
            "acceleration": turn.inv().apply(force),
            "velocity": velocity[:, n],
            "position": state[:, n, :3] - engine.origin + (0, 0, 10),
            "rotor_speed": spin[:, n],
            "battery": battery[:, n],
        }
        own = {name: x + noise * _noise(rng, name, x.shape, step) for name, x in clean.items()}
        wrong = noise * _noise(rng, "attitude", (steps, 3), step)
        own["quaternion"] = (turn * Rotation.from_rotvec(wrong)).as_quat(scalar_first=True)
        own |= {"t": time, "pwm": np.stack(sent)[:, n]}
        logs.append(own)
    return logs


def _noise(rng, name, shape, step):
    white, slow, lasts = NOISE[name]
    keep = np.exp(-step / lasts)
    drift = lfilter([np.sqrt(1 - keep**2)], [1, -keep], rng.standard_normal(shape), axis=0)
    return white * rng.standard_normal(shape) + slow * drift


LABELS = {
    "t": ("t [s]",),
    "pwm": tuple(f"m{k} [share]" for k in range(1, 5)),
    "rotor_speed": tuple(f"m{k} [rad/s]" for k in range(1, 5)),
    "body_rate": tuple(f"gyro_{x} [rad/s]" for x in "xyz"),
    "acceleration": tuple(f"acc_{x} [m/s^2]" for x in "xyz"),
    "velocity": tuple(f"v{x} [m/s]" for x in "xyz"),
    "position": tuple(f"{x} [m]" for x in "xyz"),
    "quaternion": tuple(f"q{x}" for x in "wxyz"),
    "battery": ("battery [V]",),
}


def columns(log, *without):
    """Columns of a log by their labels."""
    found = {}
    for name, labels in LABELS.items():
        if name in log and name not in without:
            found |= zip(labels, log[name].reshape(len(log["t"]), -1).T, strict=True)
    return found


def write_csv(path, log, *without):
    """Write a log as a table; SI units."""
    own = columns(log, *without)
    head = ",".join(own)
    np.savetxt(path, np.stack(list(own.values()), 1), delimiter=",", header=head, comments="")
