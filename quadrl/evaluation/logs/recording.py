"""What a log of any format becomes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import Rotation

from quadrl.base.errors import QuadrlError

SMOOTHED = 50.0  # [rad/s], from which on a position counts as noise
SAME = 1e-7  # [s], between times that are one
LONGEST_BRIDGE = 0.1  # [s] between two samples of what is put on the gyro's times
FLIPPED = np.array([1.0, -1.0, -1.0])
"""From axes of which y is right or east and z is down to those of quadrl, and back."""
Parts = Mapping[str, tuple[Any, Any]]
"""Times (n,) [s] and values (n, k) by the names of fields of Recording and of MOTION; `angles` are
roll, pitch and yaw [rad] (Z-Y-X), in place of the quaternion."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """A flight as it was logged, T samples. World z up; body x forward, y left, z up.

    Between samples too far apart numbers are NaN.
    """

    name: str
    time: np.ndarray  # (T,) [s], rising
    motion: Mapping[str, np.ndarray]
    """Arrays (T, k) by the names of flight_log.MOTION: of the body rate at least."""
    pwm: np.ndarray | None = None  # (T, R) motor commands, 0 to 1
    rotor_speed: np.ndarray | None = None  # (T, R) as measured [rad/s]
    battery: np.ndarray | None = None  # (T, 1) [V]
    acceleration: np.ndarray | None = None  # (T, 3) specific force [m/s^2], body frame


def together(name: str, parts: Parts) -> Recording:
    """Put the parts of a log on the times of its gyro.

    Commands hold between their samples, the rest is interpolated. A velocity that is missing
    follows from the position, a position from the velocity.

    Raises:
        QuadrlError: There is no gyro, or neither commands nor rotor speeds; or a clock runs back.
    """
    found = {}
    for part, (time, values) in parts.items():
        time, values = np.asarray(time, float).ravel(), np.asarray(values, float)
        values = values.reshape(len(time), -1)
        there = np.isfinite(time) & np.isfinite(values).all(axis=1)
        time, values = time[there], values[there]
        if (back := np.flatnonzero(np.diff(time) <= 0)).size:
            raise QuadrlError(
                f"{name}: the time of {part} does not rise from {time[back[0]]:.9g} s to "
                f"{time[back[0] + 1]:.9g} s: cut the log there, or sort its samples"
            )
        if len(time) > 1:
            found[part] = time, values
    if "body_rate" not in found or not {"pwm", "rotor_speed"} & {*found}:
        lacks = "motor commands or rotor speeds" if "body_rate" in found else "gyro"
        raise QuadrlError(f"{name} has no {lacks}: it cannot be flown again")
    time, rate = found.pop("body_rate")
    if "angles" in found and "quaternion" not in found:
        own, angles = found.pop("angles")
        turned = Rotation.from_euler("ZYX", angles[:, ::-1]).as_quat(scalar_first=True)
        found["quaternion"] = own, turned
    if "quaternion" in found:  # the nearer one of two quaternions that are the same attitude
        own, turned = found["quaternion"]
        signs = np.cumprod(np.where((turned[1:] * turned[:-1]).sum(axis=1) < 0, -1.0, 1.0))
        found["quaternion"] = own, turned * np.concatenate([[1.0], signs])[:, None]
    even = {part: _at(time, *own, held=part == "pwm") for part, own in found.items()}
    if "quaternion" in even:
        even["quaternion"] /= np.linalg.norm(even["quaternion"], axis=1, keepdims=True)
    if "position" in found and "velocity" not in even:
        own, position = found["position"]
        smooth = make_smoothing_spline(own, position, lam=1 / (np.diff(own).mean() * SMOOTHED**4))
        even["velocity"] = smooth.derivative()(time) + 0 * even["position"]
    if "velocity" in even and "position" not in even:
        steps = np.diff(time, prepend=time[0])[:, None] * np.nan_to_num(even["velocity"])
        even["position"] = np.cumsum(steps, axis=0) + 0 * even["velocity"] + (0, 0, 10.0)
    others = ("pwm", "rotor_speed", "battery", "acceleration")
    motion = {part: x for part, x in even.items() if part not in others} | {"body_rate": rate}
    rest = {part: even[part] for part in others if part in even}
    return Recording(name, time, motion, **rest)


def _at(time: np.ndarray, own: np.ndarray, values: np.ndarray, held: bool) -> np.ndarray:
    """Values (n, k) of times (n,) at other times; NaN before, behind and in gaps."""
    last = np.clip(np.searchsorted(own, time + SAME, side="right") - 1, 0, len(own) - 2)
    if held:
        found = values[last + (time >= own[-1])]
    else:
        found = np.stack([np.interp(time, own, column) for column in values.T], axis=1)
    apart = (np.diff(own)[last] > LONGEST_BRIDGE) & (time != own[last])
    found[apart | (time < own[0]) | (time > own[-1] + LONGEST_BRIDGE * held)] = np.nan
    return found


def reordered(log: Recording, order: Sequence[int]) -> Recording:
    """The recording with its motors, which are numbered from 1 on, in another order."""
    columns = [k - 1 for k in order]
    for part in (log.pwm, log.rotor_speed):
        if part is not None and part.shape[1] != len(columns):
            allowed = f"the numbers of its {part.shape[1]} motors"
            raise QuadrlError(name=f"motors of {log.name}", value=list(order), allowed=allowed)
    parts = (None if x is None else x[:, columns] for x in (log.pwm, log.rotor_speed))
    pwm, speed = parts
    return dataclasses.replace(log, pwm=pwm, rotor_speed=speed)
