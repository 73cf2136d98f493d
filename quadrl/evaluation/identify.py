"""An aircraft's numbers from logs of its flights: what they excite, judged on pieces held out."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.aircraft.aerodynamics import Aerodynamics
from quadrl.aircraft.presets import REAL_AIR, in_real_air
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.rotation import norm
from quadrl.engines.mujoco import BatchEngine
from quadrl.engines.state import Start
from quadrl.evaluation.flight_log import FlightLog, flown
from quadrl.evaluation.identification import (
    AIR,
    BOUNDS,
    TIME,
    TRIMS,
    VAGUE,
    at_bounds,
    changed,
    fit,
)
from quadrl.evaluation.log_checks import check_log, hardly_moved
from quadrl.evaluation.logs.recording import Recording
from quadrl.evaluation.open_loop import (
    ALTITUDE,
    LAGS,
    Window,
    errors,
    fly,
    halves,
    hold,
    judged,
    least_speed,
    measured,
    windows,
)
from quadrl.evaluation.rotor_response import LONGEST_DEAD, fit_response, lowest
from quadrl.evaluation.stand import stand_map, torque_ratio

PIECE = 5.0  # [s], judged and fitted in turn
MOST_WINDOWS = 600  # of a fit
FEWEST = 20  # windows that judge, and windows of a fit
CARRIED, TURNED = "velocity", "body_rate"
PUSHED = ("thrust", "rotor_drag")  # what the velocity tells
TILTED = ("flapping_moment", "flapping_pitch")  # what the body rate tells with the velocity
STEP, LEAST_ANSWER = 0.05, 0.5  # of a rotor's speed; of what physics gives
# Where an aircraft has none, a fit begins with what a Crazyflie has for its size: the flapping
# moment over k_T; linear drag [1/s]; inertia of a rotor over that about z.
USUAL_FLAPPING, USUAL_DRAG, USUAL_ROTOR = 2.77, 0.4, 1.2e-3


@dataclasses.dataclass(frozen=True)
class Identified:
    """An aircraft as its flights tell it."""

    vehicle: Vehicle
    factors: dict[str, float]
    """Of identified numbers on those of the aircraft that the fit began with."""
    standard_errors: dict[str, float]
    """Of the factors, over them; the least that they can be."""
    not_identified: dict[str, str]
    """Names of numbers that stayed as they were, and why."""
    answer: float
    """Body rate after a step of one rotor, over what k_T, arm and inertia give; the least."""
    table: list[dict[str, Any]]
    """Errors of each model on the windows that judge, at open_loop.HORIZONS."""
    held_out: list[Window]
    """Those windows."""
    models: dict[str, Vehicle]
    """What flies in the table, by name."""


def identify(
    recordings: Sequence[Recording], vehicle: Vehicle, name: str, stand: Path | None = None
) -> Identified:
    """Fit an aircraft to logs, as far as they tell.

    Args:
        recordings: The logs.
        vehicle: The aircraft to begin with; its mass is taken as true.
        name: Name of the fitted one.
        stand: Table of a thrust stand: what commands mean where no rotor speeds were logged, and
            the ratio of torque to thrust, where it has torque.

    Raises:
        QuadrlError: A log cannot be what it says, the logs are too short, or the fit is no
            aircraft's; the message has the number.
    """
    for one in recordings:
        for line in check_log(one, vehicle):
            warnings.warn(f"{one.name}: {line}", QuadrlWarning, stacklevel=2)
    if lacking := set.intersection(*map(hardly_moved, recordings)):
        text = f"hardly any steps in {', '.join(sorted(lacking))}: what they tell stays unknown"
        warnings.warn(text, QuadrlWarning, stacklevel=2)
    begun, spread = _with_commands(recordings, begin(vehicle), stand)
    logs = [flown(one, begun.command_map) for one in recordings]
    held_out, learnt = divided(logs, begun)
    begun, lost, factors = _faster(begun, logs), dict[str, str](), dict[str, float]()
    ratio = stand is not None and torque_ratio(stand) is not None
    turning = ["inertia_x", "inertia_y", "inertia_z" if ratio else "torque", "rotor_inertia"]
    turning += TRIMS
    if driven := all(log.rotor_speed is not None for log in logs):
        lost |= {k: "no log has commands and speeds" for k in LAGS if k not in spread}
    elif any(one.pwm is None for one in recordings):
        raise QuadrlError(
            "some logs have commands, others rotor speeds alone: fit one kind at once"
        )
    else:
        turning += LAGS
    if all("velocity" in log.motion for log in logs):
        factors, vague = _fitted(begun, learnt, PUSHED, (CARRIED,), lost)
        spread, aim, turning = spread | vague, (CARRIED, TURNED), [*turning, *TILTED]
    else:
        aim, lost = (TURNED,), lost | dict.fromkeys((*PUSHED, *TILTED), "no velocity is known")
        text = "no velocity is known: its moment is missing, and what it does may pass for inertia"
        warnings.warn(text, QuadrlWarning, stacklevel=2)
    free = [*factors, *turning]
    late = begun if driven else _late(begun, learnt, free, aim)
    found, vague = _fitted(late, learnt, free, aim, whole := dict(lost))
    if late.dead_time != begun.dead_time and not {*LAGS} <= {*found}:
        late = begun  # these flights do not tell dead time from lag
        found, vague = _fitted(late, learnt, free, aim, whole := dict(lost))
    truth, held = measured(held_out), hold(held_out)
    away = errors(fly(changed(late, found), held_out), truth)[TURNED][1]
    if away < (least := errors(held, truth)[TURNED][1]):
        begun, factors, spread, lost = late, found, spread | vague, whole
    else:
        why = f"held out, {away:.2g} rad/s after {TIME:g} s where holding the rate has {least:.2g}"
        lost |= dict.fromkeys(turning, why)
    if not factors:
        raise QuadrlError(f"these flights identify nothing: {next(iter(lost.values()))}")
    spread = {k: x for k, x in spread.items() if k not in lost}
    made = dataclasses.replace(changed(begun, factors), name=name)
    given = in_real_air(vehicle) if vehicle.name in REAL_AIR else vehicle
    unknown = {k: x for k in AIR if k in lost and not (x := getattr(given.aerodynamics, k))}
    air = dataclasses.replace(made.aerodynamics, **unknown)
    made = dataclasses.replace(made, aerodynamics=air)
    if (answer := answers(made, vehicle)) < LEAST_ANSWER:
        raise QuadrlError(
            f"refused: one rotor {STEP:.0%} faster turns the fitted aircraft {answer:.2f} times as "
            f"fast as its thrust, arm and the inertia of {vehicle.name} do, and less than "
            f"{LEAST_ANSWER:g} is a model that ignores its commands"
        )
    models = {"as given": vehicle, "in real air": given, "fitted": made}
    models = {k: _faster(x, logs) for k, x in models.items() if k != "in real air" or x != vehicle}
    table = judged(held_out, models)
    return Identified(made, factors, spread, lost, answer, table, held_out, models)


def _with_commands(
    recordings: Sequence[Recording], vehicle: Vehicle, stand: Path | None
) -> tuple[Vehicle, dict[str, float]]:
    """The aircraft with what its commands mean and its torque, and standard errors of its lags."""
    spread: dict[str, float] = {}
    if stand is not None and (ratio := torque_ratio(stand)) is not None:
        rotors = (
            dataclasses.replace(rotor, torque_coefficient=ratio * rotor.thrust_coefficient)
            for rotor in vehicle.rotors
        )
        vehicle = dataclasses.replace(vehicle, rotors=tuple(rotors))
    commanded = [one for one in recordings if one.pwm is not None]
    if both := [one for one in commanded if one.rotor_speed is not None]:
        response = fit_response(both, vehicle)
        vehicle, spread = response.of(vehicle), response.standard_errors
    elif stand is not None and commanded:
        own = stand_map(stand, all(one.battery is not None for one in commanded))
        vehicle = dataclasses.replace(vehicle, command_map=own)
    return vehicle, dict(spread)


def begin(vehicle: Vehicle) -> Vehicle:
    """An aircraft with every effect that a fit can scale, with the usual one where it has none."""
    if not vehicle.aerodynamics.effects and vehicle.name in REAL_AIR:
        vehicle = in_real_air(vehicle)
    lift = float(np.mean([rotor.thrust_coefficient for rotor in vehicle.rotors]))
    usual = {
        "rotor_drag": USUAL_DRAG * vehicle.mass / vehicle.hover_speed.sum(),
        "flapping_moment": USUAL_FLAPPING * lift,
        "rotor_inertia": USUAL_ROTOR * vehicle.inertia[2],
    }
    air: Aerodynamics = vehicle.aerodynamics
    own = {k: x for k, x in usual.items() if not getattr(air, k)}
    return dataclasses.replace(vehicle, aerodynamics=dataclasses.replace(air, **own))


def divided(logs: Sequence[FlightLog], vehicle: Vehicle) -> tuple[list[Window], list[Window]]:
    """Windows that judge, and windows of the fit.

    Raises:
        QuadrlError: There are too few.
    """
    seconds = sum(log.time[-1] - log.time[0] for log in logs)
    every = max(TIME, seconds / 2 / MOST_WINDOWS)
    parts = zip(
        *(halves(windows(log, every, least_speed(vehicle)), PIECE) for log in logs), strict=True
    )
    held_out, learnt = ([own for own in part if len(own[1])] for part in parts)
    if (fewest := min(sum(len(t) for _, t in part) for part in (held_out, learnt))) < FEWEST:
        raise QuadrlError(
            f"only {fewest} stretches of 1.1 s in flight without a gap, of {FEWEST} that a fit and "
            "its judgement need each: fly 20 s or more, and log at 100 Hz or faster"
        )
    return held_out, learnt


def answers(vehicle: Vehicle, given: Vehicle) -> float:
    """Body rate TIME after one rotor is STEP faster, over that by k_T, arm and inertia alone.

    Those are the thrust, lags and dead time of the vehicle, and arms and inertia of the given one.
    The least of all rotors.
    """
    pure = dataclasses.replace(
        vehicle,
        inertia=given.inertia,
        aerodynamics=Aerodynamics(),
        drag_coefficient=given.drag_coefficient,
        moment_coefficient=given.moment_coefficient,
    )
    rates = [_stepped(one) for one in (vehicle, pure)]
    wanted = rates[1] / norm(rates[1])[:, None]
    return float(((rates[0] * wanted).sum(axis=1) / norm(rates[1])).min())


def _stepped(vehicle: Vehicle) -> np.ndarray:
    """Roll and pitch rates (R, 2) after a step of each rotor out of hover, in the plane."""
    count, step = vehicle.rotor_count, vehicle.physics_timestep
    engine = BatchEngine(vehicle, count, altitude=ALTITUDE, engine="free_flight")
    still, hover = np.zeros((count, 3)), np.tile(vehicle.hover_speed, (count, 1))
    engine.place(np.arange(count), Start(still, np.eye(1, 4).repeat(count, 0), still, still, hover))
    engine.command(hover * (1 + STEP * np.eye(count)))
    engine.advance(round(TIME / step))
    return engine.qvel[:, 3:5].copy()


def _fitted(
    vehicle: Vehicle,
    where: Sequence[Window],
    free: Sequence[str],
    aim: Sequence[str],
    lost: dict[str, str],
) -> tuple[dict[str, float], dict[str, float]]:
    """Factors and their standard errors, again without those that are vague or at a bound."""
    names, factors, vague = list(free), dict[str, float](), dict[str, float]()
    while names:
        factors, vague = fit(vehicle, where, names, *aim)
        limits = {k: f"at its bound, {factors[k]:.2f} times" for k in at_bounds(factors)}
        _check_thrust({k: factors[k] for k in limits})
        wrong = {k: f"standard error {x:.0%}" for k, x in vague.items() if x > VAGUE} | limits
        if not wrong:
            break
        lost |= wrong
        names = [k for k in names if k not in wrong]
    return (factors, vague) if names else ({}, {})


def _late(
    vehicle: Vehicle, where: Sequence[Window], free: Sequence[str], aim: Sequence[str]
) -> Vehicle:
    """The aircraft with the dead time, in whole physics steps, that predicts its turning best."""
    where = [(log, start[::3]) for log, start in where]  # a step shows in a part of them
    step, truth = vehicle.physics_timestep, measured(where, (TIME,))

    def cost(late: int) -> float:
        own = dataclasses.replace(vehicle, dead_time=late * step)
        own = changed(own, fit(own, where, free, *aim)[0])
        return float(errors(fly(own, where, (TIME,)), truth)[TURNED][0])

    late = lowest(cost, round(vehicle.dead_time / step), round(LONGEST_DEAD / step))
    return dataclasses.replace(vehicle, dead_time=late * step)


def _faster(vehicle: Vehicle, logs: Sequence[FlightLog]) -> Vehicle:
    """An aircraft whose rotors reach what was logged."""
    most = max(float(np.nanmax(log.command)) for log in logs)
    rotors = (dataclasses.replace(r, max_speed=max(most, r.max_speed)) for r in vehicle.rotors)
    return dataclasses.replace(vehicle, rotors=tuple(rotors))


def _check_thrust(factors: dict[str, float]) -> None:
    """Refuse thrust and trims that only their bounds keep within physics."""
    for name in at_bounds(factors):
        if name in ("thrust", *TRIMS):
            low, high = BOUNDS[name]
            raise QuadrlError(
                f"refused: {name.replace('_', ' ')} runs to {factors[name]:.2f} times that of the "
                f"aircraft, the bound of physics ({low:g} to {high:g}): check its mass, the order "
                "of the motors, and what the commands mean"
            )
