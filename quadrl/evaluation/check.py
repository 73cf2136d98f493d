"""Check an aircraft before anything is trained: what its numbers leave to a policy."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import Array
from quadrl.conditions.sampler import AircraftSampler
from quadrl.control import modes
from quadrl.control.allocation import Allocation
from quadrl.control.feasibility import (
    MARGIN,
    SURE,
    Reach,
    cannot_land,
    held_command,
    held_wind,
    lift_on_feet,
    samples,
    unreached,
)
from quadrl.core.scenario import Scenario
from quadrl.core.task import Task
from quadrl.evaluation.evaluate import html_table

OK = "ok"
DRIFT = 0.5  # [m], chosen: how far a tilted aircraft may go until it is level
TILT = 0.2  # [rad], with which hover starts
SLOWEST = math.sqrt(GRAVITY * TILT / DRIFT)
"""Bandwidth w of the attitude [rad/s] below which it goes farther: about g tilt / w^2."""

PHASE_MARGIN = math.pi / 4  # [rad]
FASTEST_TIP = 250.0  # [m/s]
"""Tips of blades are slower in hover: near the speed of sound, 340 m/s, they lose thrust."""
TURNING = 0.2308
"""How deep one weight of thrust pushes an aircraft that turns over, over g T^2: twice the integral
of (1 / 2 - x) cos(2 pi x^2) from 0 to 1 / 2."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One quantity of an aircraft."""

    quantity: str
    value: float
    unit: str
    verdict: str = OK
    """What is wrong, and what to do about it."""


@dataclasses.dataclass(frozen=True, repr=False)
class Check:
    """The result of checking an aircraft; a table in a notebook."""

    vehicle: Vehicle
    rows: tuple[Row, ...]

    def __repr__(self) -> str:
        wrong = [row.quantity for row in self.rows if row.verdict != OK]
        return f"{self.vehicle!r}: {'; '.join(wrong) or 'every row is ok'}"

    def _repr_html_(self) -> str:
        return html_table(self.table)

    @property
    def table(self) -> list[tuple[str, ...]]:
        """The rows as text; the first one is the head."""
        lines = ((r.quantity, f"{r.value:.4g} {r.unit}".strip(), r.verdict) for r in self.rows)
        return [("quantity", "value", "verdict"), *lines]


def check(
    vehicle: Vehicle | str | Mapping[str, Any] | None = None,
    *,
    task: str | Task | Scenario = "hover",
    **conditions: Any,
) -> Check:
    """Check whether an aircraft's thrust, moments, steps and delays let a policy fly it.

    Args:
        vehicle: The aircraft or its name; None for the paper's.
        task: A task or its name; some ask for a turn of the heading within their time.
        **conditions: As `quadrl.core.scenario.Conditions` has them, and options of the task. Of a
            `randomization` the worst aircraft are checked as well; every `control_mode` but
            "rotor" answers at every physics step.

    Raises:
        QuadrlError: Something is unknown, out of range, or does not fit together.
    """
    scenario = Scenario.of(task, vehicle=vehicle, **conditions)
    vehicle, task = scenario.aircraft, scenario.task
    sampler = AircraftSampler(scenario.randomization, vehicle)
    steps = _steps(vehicle, sampler, scenario.control_mode)
    thrust = _thrust(vehicle, sampler, scenario)
    return Check(vehicle, (*thrust, *_moments(vehicle, task), *steps))


def _thrust(vehicle: Vehicle, sampler: AircraftSampler, flown: Scenario) -> Iterator[Row]:
    """Thrust, and the action scale that follows."""
    reach, scale = Reach(vehicle), vehicle.action_scale
    drawn = Reach(vehicle, np.concatenate(samples(sampler)))
    needed, room = drawn.scale(), reach.room
    hover = vehicle.hover_speed / vehicle.max_speed
    yield Row("hover speed", float(vehicle.hover_speed.max()), "rad/s")
    tip = max(w * rotor.disc for w, rotor in zip(vehicle.hover_speed, vehicle.rotors, strict=True))
    unit = f"over {FASTEST_TIP:g}: coefficients are per square of rad/s, not of rpm; radii in m"
    yield Row("tip speed in hover", float(tip), "m/s", OK if tip <= FASTEST_TIP else unit)
    yield Row("hover over largest speed", 100 * float(hover.max()), "%")
    commanded = 100 * float((hover + scale / vehicle.max_speed).max())
    beyond = f"actions over {room / scale:.2g} are cut to the largest speed"
    yield Row("action 1 over largest speed", commanded, "%", OK if scale <= room else beyond)
    load, limit = (float(reach.loads(most)[1][0]) for most in (scale, reach.most))
    weak = f"under {MARGIN:g}: it needs less weight or stronger rotors"
    short = f"under {MARGIN:g}: action_scale={needed:.3g}" if scale < needed else weak
    yield Row("thrust over weight, action 1", load, "", OK if load >= MARGIN else short)
    yield Row("thrust over weight, limits", limit, "", OK if limit >= MARGIN else weak)
    if sampler.randomization.per_row:
        worst = float(drawn.loads(scale)[1].min())
        less = f"{short}, or draw less"
        yield Row("thrust over weight, worst drawn", worst, "", OK if worst >= MARGIN else less)
        share, lack, _ = unreached(vehicle, sampler)
        yield Row("drawn that cannot hover", 100 * share, "%", lack if share else OK)
    for end, ends in (("action 1", scale), ("limits", reach.most)):
        held, mean = held_wind(vehicle, ends), flown.mean_wind
        strong = f"the mean wind is {mean:.3g} m/s"
        yield Row(f"steady wind held, {end}", held, "m/s", OK if held >= mean else strong)
    if flown.lands:
        lift = lift_on_feet(vehicle, scale)
        yield Row("lift on the ground, action -1", lift, "", cannot_land(vehicle) or OK)
    wanted = max(needed, min(scale, room))
    carried = float(drawn.loads(wanted)[1].min())
    reason = f"then the worst has {carried:.2f} times its weight"
    reason += ", and no command is cut" if wanted <= room else ""
    yield Row("suggested action_scale", wanted, "rad/s", OK if wanted == scale else reason)


def _moments(vehicle: Vehicle, task: Task) -> Iterator[Row]:
    """What turns it; from rest half round takes 2 sqrt(pi / acceleration)."""
    ends = {"action 1": vehicle.action_scale, "limits": Reach(vehicle).most}
    for end, scale in ends.items():
        for axis, most in zip("xyz", angular_acceleration(vehicle, scale), strict=True):
            verdict = OK
            time, turn = task.time_limit - task.settle_time, 2 * math.sqrt(math.pi / most)
            if axis == "z" and task.heading_matters and turn > time:
                verdict = f"half a turn takes {turn:.2g} s, and {task.name} leaves {time:.2g} s"
            name = {"x": "roll", "y": "pitch", "z": "yaw"}[axis]
            yield Row(f"{name} acceleration, {end}", float(most), "rad/s^2", verdict)
    for end, scale in ends.items():
        yield Row(f"height to turn over, {end}", height_to_turn_over(vehicle, scale), "m")


def _steps(vehicle: Vehicle, sampler: AircraftSampler, control_mode: str) -> Iterator[Row]:
    """What the steps resolve, and how soon the aircraft answers; what does not is refused."""
    table = np.concatenate(samples(sampler))
    rotor = table["rotor"][:, : vehicle.rotor_count]
    rates = np.stack([rotor["lag_up"], rotor["lag_down"]])
    step, control = vehicle.physics_timestep, vehicle.control_timestep
    yield Row("fastest rotor rate times step", float(rates.max() * step), "")
    yield Row("resolved speed", float(table["resolved_speed"].min()), "m/s")
    yield Row("resolved body rate", float(table["resolved_turn"].min()), "rad/s")
    # The loops of the other modes see the true state at every physics step.
    looped = modes.kind(control_mode).has_loops
    given = sampler.randomization
    seen = 0.0 if looped else max(given.observation_delay[1], given.rate_delay[1])
    late = vehicle.dead_time + given.command_delay[1] + seen
    late += control * (given.command_jitter[1] > 0)
    held = held_command(vehicle, control_mode)
    lag = float(1 / rates.min())
    slow = f"over the lag of the rotors: control_timestep={lag:.2g} or less"
    yield Row("slowest rotor lag", 1000 * lag, "ms")
    yield Row("time between two commands", 1000 * held, "ms", OK if held <= lag else slow)
    under_way = math.ceil(round(late / control, 6))  # actions
    verdict = f"a policy must know what is under way: --observe action_history={under_way}"
    yield Row("longest delay", 1000 * late, "ms", verdict if under_way and not looped else OK)
    bandwidth = attitude_bandwidth(lag, late + held / 2)
    drift = GRAVITY * TILT / bandwidth**2
    slow = f"under {SLOWEST:.2g}: tilted by {TILT:g} rad it goes {drift:.2g} m until it is level"
    verdict = OK if bandwidth >= SLOWEST else slow
    yield Row("attitude bandwidth", bandwidth, "rad/s", verdict)


def angular_acceleration(vehicle: Vehicle, scale: float) -> Array:
    """Largest about x, y and z (3,) [rad/s^2], each alone, with a thrust that suits it."""
    low, high = Reach(vehicle).speeds(scale)
    squares = Allocation(np.linalg.pinv(vehicle.mixer), low[0] ** 2, high[0] ** 2)
    return squares.moment / np.array(vehicle.inertia)


def height_to_turn_over(vehicle: Vehicle, scale: float) -> float:
    """Height [m] that it takes to turn from rest upside down to level, and to stop; inf if never.

    With the largest moment, one way and then the other, at the middle thrust c (of the weight) that
    leaves it, half round takes T = 2 sqrt(pi / acceleration). Thrust down in the first half and
    up in the second cancel: the aircraft then sinks at g T, and is (1 / 2 + c TURNING) g T^2 lower.
    The largest thrust, L weights, takes g T^2 / (2 (L - 1)) to stop it. Rotors without lag.
    """
    least, most = (float(load[0]) for load in Reach(vehicle).loads(scale))
    if most <= 1 + SURE:
        return math.inf
    turning = float(angular_acceleration(vehicle, scale)[:2].max())
    time = 2 * math.sqrt(math.pi / turning)  # [s]
    sunk = 1 / 2 + TURNING * (least + most) / 2
    return GRAVITY * time**2 * (sunk + 1 / (2 * (most - 1)))


def attitude_bandwidth(lag: float, late: float) -> float:
    """Bandwidth of the attitude [rad/s] that is left by a rotor lag and by delays [s].

    From moment to attitude there are two integrators, 180 degrees of phase lag, of which feedback
    of the body rate makes up for 90 at most. At a rate w a delay T takes w T, and a lag T at most
    as much. For a phase margin of 45 degrees, in the middle of the usual 30 to 60 (Astrom and
    Murray, "Feedback Systems", chapter 10), both together may take pi / 4.
    """
    return PHASE_MARGIN / (lag + late)
