"""Checks of a log before anything is fitted: each says in a line what is wrong, and what to do."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NoReturn

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.evaluation.logs.recording import Recording
from quadrl.evaluation.open_loop import LONGEST_GAP

SPAN = 0.05  # [s] over which motion is differentiated
FULL = 0.995  # command from which on a motor is at its limit
MOST_FULL, ALL_FULL = 0.02, 0.5  # of the time at a limit: weakens a fit, makes it impossible
MOST_GAPS = 0.2  # of the time
LEAST_KNOWN = 0.5  # correlation from which on a comparison says something
MOST_ORDERED = 6  # motors, beyond which there are too many orders to try
NEARER = 0.15  # by which another order of motors must be better
G_ERROR = 0.03  # of the accelerometer
REST = 0.5  # [s] without a turn
STILL = 0.05  # [rad/s]
SHORT = {"roll": 1.0, "pitch": 1.0, "yaw": 0.3}  # [rad/s], least range of the rate
LEAST_PUSH = 0.03  # change of the thrust, over it


def check_log(log: Recording, vehicle: Vehicle) -> Iterator[str]:
    """Yield what weakens a fit.

    Raises:
        QuadrlError: What makes it impossible.
    """
    steps = np.diff(log.time)
    usual = float(np.median(steps))
    if usual >= 0.25:
        unit = "ms" if usual < 250 else "us"
        _refuse(log, f"{usual:g} s between samples: the time seems to be in {unit}; say t [{unit}]")
    gaps = steps[steps > LONGEST_GAP]
    if usual > LONGEST_GAP:
        _refuse(log, f"a sample each {1000 * usual:.0f} ms: log at 100 Hz or faster")
    if gaps.size and gaps.sum() > MOST_GAPS * (log.time[-1] - log.time[0]):
        share = gaps.sum() / (log.time[-1] - log.time[0])
        _refuse(log, f"{share:.0%} of the time is gaps: log less, or to a faster card")
    if gaps.size:
        yield f"{gaps.size} gaps, of up to {gaps.max():.2g} s: nothing is flown across them"
    for part in (log.pwm, log.rotor_speed):
        if part is not None and part.shape[1] != vehicle.rotor_count:
            count = f"{part.shape[1]} motors, and {vehicle.name} has {vehicle.rotor_count} rotors"
            _refuse(log, f"{count}: give the right --vehicle")
    yield from _limits(log)
    if len(hardly_moved(log)) == 4:
        _refuse(log, "nothing moves: fly steps of thrust, roll, pitch and yaw")
    _check_axes(log)
    yield from _gravity(log)
    yield from _motors(log, vehicle)


def _refuse(log: Recording, why: str) -> NoReturn:
    raise QuadrlError(f"{log.name}: {why}")


def _limits(log: Recording) -> Iterator[str]:
    if log.pwm is None:
        return
    if (most := np.nanmax(log.pwm)) > 1.001 or np.nanmin(log.pwm) < -0.001:
        _refuse(log, f"a motor command is {most:.3g} of the full one: is it [pwm] or [share]?")
    if most < 0.01:
        _refuse(log, f"no motor command is above {most:.2g}: [share] goes to 1, [pwm] to 65535")
    full = (log.pwm >= FULL).any(axis=1).mean()
    if full > ALL_FULL:
        _refuse(log, f"a motor is at its limit for {full:.0%} of the time: fly with a full battery")
    if full > MOST_FULL:
        yield f"a motor is at its limit for {full:.0%} of the time: its speed is less well known"


def _check_axes(log: Recording) -> None:
    """Compare the gyro with the turns of the attitude, and velocity with the position."""
    rate, motion = log.motion["body_rate"], log.motion
    if np.nanmax(np.abs(rate)) > 60:
        most = np.nanmax(np.abs(rate))
        _refuse(log, f"the gyro reads up to {most:.0f} rad/s: it seems to be in deg/s")
    ahead = max(1, round(SPAN / float(np.median(np.diff(log.time)))))
    span = log.time[ahead:] - log.time[:-ahead]
    if "quaternion" in motion:
        known = _known(motion["quaternion"])
        turned = np.where(known[:, None], motion["quaternion"], np.eye(1, 4))
        way = Rotation.from_quat(turned, scalar_first=True)
        turns = (way[:-ahead].inv() * way[ahead:]).as_rotvec() / span[:, None]
        mean = _mean(rate, ahead)
        sound = known[ahead:] & known[:-ahead] & (span < 1.5 * SPAN)
        said = _axes(turns[sound], mean[sound])
        if said == "57":
            _refuse(log, "the gyro turns 57 times as fast as the attitude: it is in deg/s")
        if said:
            _refuse(
                log,
                f"the gyro is not in the axes of the attitude: {said}; x is ahead, y left, z up",
            )
        _check_level(log)
    if {"velocity", "position"} <= {*motion}:
        moved = (motion["position"][ahead:] - motion["position"][:-ahead]) / span[:, None]
        mean = _mean(motion["velocity"], ahead)
        sound = _known(moved) & _known(mean) & (span < 1.5 * SPAN)
        if said := _axes(moved[sound], mean[sound], names="vx vy vz"):
            _refuse(log, f"the velocity is not that of the position: {said}; z is up in both")


def _check_level(log: Recording) -> None:
    """See whether the attitude tilts the way that the velocity changes."""
    if "velocity" not in log.motion:
        return
    ahead = max(1, round(SPAN / float(np.median(np.diff(log.time)))))
    velocity, turned = log.motion["velocity"], log.motion["quaternion"]
    sound = _known(velocity) & _known(turned)
    turned = np.where(sound[:, None], turned, np.eye(1, 4))
    up = Rotation.from_quat(turned, scalar_first=True).as_matrix()[:, :, 2]
    span = (log.time[ahead:] - log.time[:-ahead])[:, None]
    pulled = (velocity[ahead:] - velocity[:-ahead]) / span
    up, sound = _mean(up, ahead), sound[ahead:] & sound[:-ahead] & (span[:, 0] < 1.5 * SPAN)
    if not sound.any():
        return
    if (tilt := float(np.median(up[sound, 2]))) < 0:
        _refuse(log, f"the aircraft flies upside down (z of its axis {tilt:.2f}): turn z up")
    for axis, name in enumerate("xy"):
        like, other = (_correlation(pulled[sound, axis], up[sound, k]) for k in (axis, 1 - axis))
        if like < -LEAST_KNOWN or abs(other) > max(LEAST_KNOWN, abs(like) + NEARER):
            _refuse(
                log,
                f"the velocity along {name} does not change as the attitude tilts (correlation "
                f"{like:.2f}): give both in one world frame with z up",
            )


def _axes(true: np.ndarray, given: np.ndarray, names: str = "gyro_x gyro_y gyro_z") -> str:
    """What is wrong with the axes of a measurement, or "57"; nothing where it cannot be told."""
    if len(true) < 10:
        return ""
    labels, wrong = names.split(), list[str]()
    table = np.array([[_correlation(true[:, k], given[:, n]) for n in range(3)] for k in range(3)])
    for axis, row in enumerate(table):
        like = int(np.argmax(np.abs(row)))
        if abs(row[like]) < LEAST_KNOWN:
            continue
        if like != axis and abs(row[like]) > abs(row[axis]) + NEARER or row[like] < 0:
            sign = "-" if row[like] < 0 else ""
            wrong.append(f"{labels[axis]} is what is called {sign}{labels[like]}")
        else:
            slope = (true[:, axis] @ given[:, axis]) / (true[:, axis] @ true[:, axis])
            if slope > 10:
                return "57"
    return ", ".join(wrong)


def _gravity(log: Recording) -> Iterator[str]:
    """See what the accelerometer reads at rest, or in the mean where it never rests."""
    if log.acceleration is None:
        return
    turns = np.abs(log.motion["body_rate"]).max(axis=1) < STILL
    spins = log.pwm if log.pwm is not None else log.rotor_speed
    assert spins is not None
    still = turns & (np.nan_to_num(spins) < 0.05 * np.nanmax(spins)).all(axis=1)
    rests = still.sum() * float(np.median(np.diff(log.time))) > REST
    own = log.acceleration[still] if rests else log.acceleration
    mean = np.nanmedian(own, axis=0)
    size, allowed = float(np.linalg.norm(mean)), G_ERROR if rests else 5 * G_ERROR
    when = "at rest" if rests else "in the mean"
    if abs(size - 1) < 0.2:
        _refuse(log, f"the accelerometer reads {size:.2f} m/s^2 {when}: it is in g; say acc_x [g]")
    if mean[2] < 0 and abs(size - GRAVITY) < GRAVITY / 2:
        _refuse(log, f"the accelerometer reads {mean[2]:.2f} m/s^2 along z {when}: turn z up")
    if abs(size / GRAVITY - 1) > allowed:
        yield f"the accelerometer reads {size:.2f} m/s^2 {when}, not {GRAVITY}: calibrate it"


def _motors(log: Recording, vehicle: Vehicle) -> Iterator[str]:
    """Find the order of motors whose thrust turns the aircraft as it turned."""
    turned, forces, others = _turning(log, vehicle)
    if len(turned) < 50:
        return
    scores: dict[tuple[int, ...], float] = {}
    rest = [_without(turned[:, k], others) for k in range(2)]
    parts = _without(forces, others)
    count = vehicle.rotor_count
    orders = itertools.permutations(range(count)) if count <= MOST_ORDERED else [range(count)]
    for order in map(tuple, orders):
        wanted = parts[:, order] @ vehicle.mixer[1:3].T
        scores[order] = min(_correlation(rest[k], wanted[:, k]) for k in range(2))
    given, best = scores[tuple(range(count))], max(scores, key=scores.__getitem__)
    if scores[best] > LEAST_KNOWN and scores[best] > given + 2 * NEARER:
        numbers = ",".join(str(k + 1) for k in best)
        _refuse(
            log,
            f"the motors are in another order than those of {vehicle.name} (correlation with the "
            f"turning {given:.2f}, in the order {numbers} {scores[best]:.2f}): --motors {numbers}",
        )
    yaw = _correlation(_without(turned[:, 2], others), parts @ vehicle.mixer[3])
    if yaw < -LEAST_KNOWN:
        _refuse(
            log,
            f"it yaws against the spins of the rotors of {vehicle.name} (correlation {yaw:.2f}): "
            "do its propellers turn the other way? give an aircraft with these spins",
        )
    if given < LEAST_KNOWN:
        yield f"its turning hardly follows its motors (correlation {given:.2f}): fly faster steps"


def _turning(log: Recording, vehicle: Vehicle) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Changes of the body rate (n, 3), means of squares of rotor speeds (n, R), other causes."""
    ahead = max(1, round(SPAN / float(np.median(np.diff(log.time)))))
    speed = log.rotor_speed
    if speed is None:
        assert log.pwm is not None
        own, step = vehicle.rotors[0], float(np.median(np.diff(log.time)))
        late, keep = round(vehicle.dead_time / step), np.exp(-step * own.lag_up)
        sent = np.nan_to_num(np.roll(log.pwm, late, axis=0)) * vehicle.max_speed
        speed = lfilter([1 - keep], [1, -keep], sent, axis=0, zi=keep * sent[:1])[0]
    squares, rate = _mean(speed**2, ahead), log.motion["body_rate"]
    causes = [np.ones(len(squares)), *_mean(rate, ahead).T]
    if {"velocity", "quaternion"} <= {*log.motion}:
        turned = np.nan_to_num(log.motion["quaternion"]) + np.eye(1, 4) * 1e-9
        flows = Rotation.from_quat(turned, scalar_first=True).inv()
        causes += [*_mean(flows.apply(log.motion["velocity"])[:, :2], ahead).T]
    found = rate[ahead:] - rate[:-ahead], squares, np.stack(causes, axis=1)
    span = log.time[ahead:] - log.time[:-ahead]
    lifts = squares.mean(axis=1) > 0.16 * (vehicle.hover_speed**2).mean()
    sound = _known(np.concatenate(found, axis=1)) & (span < 1.5 * SPAN)
    if log.rotor_speed is not None:
        sound &= lifts
    rows = np.flatnonzero(sound)[:: max(1, ahead // 2)]
    parts = tuple(part[rows] for part in found)
    return parts[0], parts[1], parts[2]


def hardly_moved(log: Recording) -> set[str]:
    """What a flight hardly excites, of thrust, roll, pitch and yaw."""
    spins = log.rotor_speed if log.rotor_speed is not None else log.pwm
    assert spins is not None
    low, high = np.nanquantile(log.motion["body_rate"], (0.02, 0.98), axis=0)
    ranges = zip(SHORT.items(), (high - low).tolist(), strict=True)
    lift = np.nanmean(spins**2, axis=1)
    lift = lift[lift > 0.16 * np.nanmedian(lift)]
    lacking = {name for (name, least), wide in ranges if wide < least}
    return lacking | ({"thrust"} if lift.std() < LEAST_PUSH * lift.mean() else set())


def _known(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.isfinite(values).all(axis=1))


def _mean(values: np.ndarray, ahead: int) -> np.ndarray:
    """Means over `ahead` samples from each on."""
    sums = np.cumsum(np.concatenate([values[:1] * 0, values]), axis=0)
    return ((sums[ahead:] - sums[:-ahead]) / ahead)[:-1]


def _without(values: np.ndarray, causes: np.ndarray) -> np.ndarray:
    """What is left of values when causes (n, k) explain what they can."""
    return values - causes @ np.linalg.lstsq(causes, values, rcond=None)[0]


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    one, other = one - one.mean(), other - other.mean()
    sizes = np.linalg.norm(one) * np.linalg.norm(other)
    return float(one @ other / sizes) if sizes else 0.0
