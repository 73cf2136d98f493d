"""Real flights flown again, open loop: from a measured state with the logged commands.

No controller takes an error away, so the difference between prediction and measurement is the
model's. Rotors begin with the speeds to which the commands before have brought them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import norm
from quadrl.engines.mujoco import BatchEngine
from quadrl.engines.state import Start
from quadrl.evaluation.flight_log import MOTION, FlightLog

HORIZONS = (0.01, 0.1, 0.5)
"""Times [s] after the start of a window at which predictions are judged."""
HISTORY = 0.6
"""Time [s] before a window in which commands spin the rotors up."""
LEAST_COMMAND, LEAST_HEIGHT = 700.0, 0.2  # [rad/s], [m]; below it may stand, or feel the ground
LEAST_SHARE = 0.4  # of hover, likewise
LONGEST_GAP = 0.015  # [s] between two samples
LAGS = ("lag_up", "lag_down")
ALTITUDE = 1e3  # [m], of the origin: nothing is touched
AT_REST = {"position": np.zeros((1, 3)), "quaternion": np.eye(1, 4), "velocity": np.zeros((1, 3))}

UNITS = {"body_rate": "rad/s", "attitude": "rad", "velocity": "m/s", "position": "m"}
"""Of what is judged."""

Window = tuple[FlightLog, np.ndarray]
"""A log, and the times (n,) [s] at which predictions of it begin."""
Motion = Mapping[str, np.ndarray]
"""Arrays (m, n, k) of n windows at m times, by the names of flight_log.MOTION."""


def least_speed(vehicle: Vehicle) -> float:
    """Mean rotor speed [rad/s] below which an aircraft may stand."""
    return LEAST_SHARE * float(vehicle.hover_speed.mean())


def windows(log: FlightLog, every: float = 0.25, least: float = LEAST_COMMAND) -> Window:
    """Find where predictions begin, every so many seconds: in flight, and without a gap near.

    In a short log, or in a slow one, there may be none.

    Args:
        log: The flight.
        every: Time between two of them [s].
        least: Mean rotor speed below which the aircraft may stand [rad/s].
    """
    sound = log.command.mean(axis=1) > least
    sound &= log.motion.get("position", np.full((1, 3), np.inf))[:, 2] > LEAST_HEIGHT
    for known in (log.rotor_speed, *log.motion.values()):
        sound &= True if known is None else np.isfinite(known).all(axis=1)
    sound[1:] &= np.diff(log.time) < LONGEST_GAP
    start = np.arange(log.time[0] + HISTORY, log.time[-2] - HORIZONS[-1], every)
    start = log.time[np.searchsorted(log.time, start)]
    first, last = (_nearest(log, start + x) for x in (-HISTORY, HORIZONS[-1]))
    unsound = np.cumsum(~sound)
    return log, start[unsound[last] == unsound[first]]


def stretch(log: FlightLog, first: float, last: float, least: float = LEAST_COMMAND) -> Window:
    """Windows after each other that cover a stretch of a log [s], as far as it flies.

    Raises:
        QuadrlError: There are none.
    """
    _, start = windows(log, HORIZONS[-1], least)
    start = start[(start >= first) & (start < last)]
    if not len(start):
        raise QuadrlError(
            f"{log.name} has no 1.1 s in flight without a gap from {first:g} s to {last:g} s, "
            f"where it lasts from {log.time[0]:g} s to {log.time[-1]:g} s"
        )
    return log, start


def halves(where: Window, piece: float) -> tuple[Window, Window]:
    """Divide windows by pieces of a log [s], in turn; none of one half reaches into the other."""
    log, start = where
    first, last = ((start + x) // piece for x in (-HISTORY, HORIZONS[-1]))
    parts = (start[(first == last) & (first % 2 == k)] for k in range(2))
    judged, learnt = ((log, part) for part in parts)
    return judged, learnt


def measured(where: Sequence[Window], times: Sequence[float] = HORIZONS) -> Motion:
    """What all logs measured at times (m,) [s] after the windows began."""
    rows = [_nearest(log, start + np.array(times)[:, None]) for log, start in where]
    return {
        name: np.concatenate([x.motion[name][k] for (x, _), k in zip(where, rows, strict=True)], 1)
        for name in MOTION
        if all(name in log.motion for log, _ in where)
    }


def hold(where: Sequence[Window], times: Sequence[float] = HORIZONS) -> Motion:
    """What comes if velocity and body rate stay as they are; arguments as for `measured`."""
    now = {name: part[0] for name, part in measured(where, (0.0,)).items()}
    held = {name: np.stack([part] * len(times)) for name, part in now.items()}
    if "velocity" in now:
        held["position"] = now["position"] + np.array(times)[:, None, None] * now["velocity"]
        turns = [Rotation.from_rotvec(t * now["body_rate"]) for t in times]
        ways = [_rotation(now["quaternion"]) * turn for turn in turns]
        held["quaternion"] = np.stack([way.as_quat(scalar_first=True) for way in ways])
    return held


def fly(vehicle: Vehicle, where: Sequence[Window], times: Sequence[float] = HORIZONS) -> Motion:
    """Predict windows by the engine `free_flight`, in calm air.

    Where a log has no pose the aircraft begins level and at rest, and only the body rate counts.
    Where all logs have measured rotor speeds, the rotors have these, whatever was commanded.

    Args:
        vehicle: The aircraft; its dead time counts.
        where: The windows.
        times: (m,) [s] after they began, rising, in whole physics steps.

    Raises:
        QuadrlError: A motion at the start is faster than the physics step resolves.
    """
    step = vehicle.physics_timestep
    driven = all(log.rotor_speed is not None for log, _ in where)
    before = 0 if driven else int((HISTORY - vehicle.dead_time) / step)
    ends = [round(t / step) for t in times]
    if driven:
        moments = np.arange(ends[-1] + 1) * step
        wanted = np.concatenate([_speeds(log, t[:, None] + moments) for log, t in where])
    else:
        moments = (np.arange(-before, ends[-1]) + 0.5) * step - vehicle.dead_time
        found = [np.searchsorted(log.time, t[:, None] + moments, side="right") for log, t in where]
        rows = zip(where, found, strict=True)
        wanted = np.concatenate([log.command[k - 1] for (log, _), k in rows])
    now = AT_REST | {name: part[0] for name, part in measured(where, (0.0,)).items()}
    motion = {name: np.broadcast_to(x, (len(wanted), x.shape[1])) for name, x in now.items()}
    engine = BatchEngine(vehicle, len(wanted), altitude=ALTITUDE, engine="free_flight")
    # Of the way to a command that a rotor goes within a step.
    up, down = (1 - np.exp([-step * getattr(r, k) for r in vehicle.rotors]) for k in LAGS)
    rotor_speed, most = wanted[:, 0], vehicle.max_speed
    for goal in np.minimum(np.moveaxis(wanted, 1, 0)[:before], most):
        way = np.where(goal > rotor_speed, up, down)
        rotor_speed = rotor_speed + way * (goal - rotor_speed)
    engine.place(np.arange(len(wanted)), Start(**motion, rotor_speed=rotor_speed))
    reached: list[np.ndarray] = []
    for k in range(before, before + ends[-1]):
        command = wanted[:, k]
        if driven:  # what brings the rotors from a measured speed to the next
            engine.act[:], change = command, wanted[:, k + 1] - command
            command = command + change / np.where(change > 0, up, down)
        engine.command(command)
        engine.advance(1)
        if k + 1 - before in ends:
            reached.append(np.concatenate([engine.qpos, engine.qvel], axis=1))
    parts = np.split(np.stack(reached), (3, 7, 10), axis=-1)
    return dict(zip(MOTION, (parts[0] - engine.origin, *parts[1:]), strict=True))


def differences(predicted: Motion, truth: Motion) -> dict[str, np.ndarray]:
    """Prediction less measurement (m, n, 3) in position, velocity and body rate, each in its frame.

    For the quaternion it is the attitude [rad], the turn from the measured one, in the body frame.
    """
    away = {name: predicted[name] - part for name, part in truth.items()}
    if (quaternion := away.pop("quaternion", None)) is not None:
        turn = _rotation(truth["quaternion"]).inv() * _rotation(predicted["quaternion"])
        away["attitude"] = turn.as_rotvec().reshape(*quaternion.shape[:2], 3)
    return away


def errors(predicted: Motion, truth: Motion) -> dict[str, np.ndarray]:
    """Mean sizes (m,) of the `differences` at each time."""
    return {name: norm(x).mean(axis=1) for name, x in differences(predicted, truth).items()}


def judged(where: Sequence[Window], models: Mapping[str, Vehicle]) -> list[dict[str, Any]]:
    """The errors of holding the state and of each model, lists at HORIZONS by quantity."""
    truth = measured(where)
    found = {"hold": hold(where)} | {name: fly(vehicle, where) for name, vehicle in models.items()}
    away = {name: errors(motion, truth) for name, motion in found.items()}
    count = {"windows": truth["body_rate"].shape[1]}
    return [
        {"model": name} | count | {q: [float(e) for e in x.get(q, ())] for q in UNITS}
        for name, x in away.items()
    ]


def _speeds(log: FlightLog, time: np.ndarray) -> np.ndarray:
    """Measured rotor speeds (n, m, R) at times (n, m)."""
    columns = np.asarray(log.rotor_speed).T
    return np.stack([np.interp(time, log.time, column) for column in columns], axis=-1)


def _nearest(log: FlightLog, time: np.ndarray) -> np.ndarray:
    return np.rint(np.interp(time, log.time, np.arange(len(log.time)))).astype(int)


def _rotation(quaternion: np.ndarray) -> Rotation:
    return Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True)
