"""Fly a policy in simulators that others wrote, beside quadrl, from the same starts.

Observation, delays, task and success stay quadrl's own: only the physics of a step is another's. So
what differs between two rows is physics, or a convention, and the conventions are checked first.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.validation import choice, number
from quadrl.core.environment import Environment
from quadrl.core.scenario import UNDISTURBED, Scenario
from quadrl.deploy import betaflight
from quadrl.deploy.betaflight import Betaflight
from quadrl.deploy.manoeuvres import ALONG, Advance, Check, checks, engine_of, flown, told
from quadrl.deploy.simulators import SIMULATORS, Simulator, environment_of
from quadrl.evaluation.in_flight import begun
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import EVALUATION_SEED, MAX_EPISODES, MAX_SEED, final_error

LATE = 0.02  # [s]
EPISODES = {"rotorpy": 20, "crazyflow": 100, betaflight.NAME: 20}
"""By default; rotorpy and Betaflight take seconds for each."""
OWN = {
    "crazyflie": {"rotorpy": "crazyflie", "crazyflow": "cf2x_L250"},
    "crazyflie_brushless": {"rotorpy": "crazyfliebrushless", "crazyflow": "cf21B_500"},
    "cf21B_500": {"rotorpy": "crazyfliebrushless", "crazyflow": "cf21B_500"},
}
"""A simulator's own aircraft of the kind of one of quadrl's."""
LACKS = {
    "rotorpy": ("ground_effect", "vortex_ring", "vortex_ring_noise", "rotor_inertia"),
    "crazyflow": ("ground_effect", "vortex_ring", "vortex_ring_noise", "flapping_moment"),
}
"""Effects on the rotors that a simulator does not have, fields of Aerodynamics."""
EFFECTS = (
    ("drag of the body", "drag_coefficient", "squared", "squared", "linear, as at 1 m/s"),
    ("drag of the rotors", "rotor_drag", "linear", "linear", "linear, as at hover"),
    ("thrust in climb, descent", "inflow", "blade theory", "linear", "linear"),
    ("flapping moment", "flapping_moment", "yes", "yes: passed negated", "none"),
    ("ground effect", "ground_effect", "yes", "none", "none"),
    ("vortex ring", "vortex_ring", "yes", "none", "none"),
    ("inertia of the rotors", "rotor_inertia", "yes", "none", "yes"),
    ("moment on the body", "moment_coefficient", "squared", "none", "none"),
    ("lag", "rotors", "up, down", "the mean", "up, down"),
    ("dead time", "dead_time", "yes", "quadrl's, if matched", "quadrl's, if matched"),
    ("integration", "name", "RK4", "RK45, adaptive", "Euler, float32"),
)
"""Physics, the field of an aircraft or its air that has it, and how it is in quadrl, rotorpy and
crazyflow."""


@dataclasses.dataclass(frozen=True)
class Row:
    """Flights of a policy."""

    flown_in: str
    """quadrl, or a simulator with its version."""
    aircraft: str
    """Whose numbers flew."""
    delay: float
    """Of the commands [s], beside the aircraft's own dead time."""
    episodes: int
    """How many."""
    success_rate: float
    """Share that succeeded."""
    position_error_m: float
    """Median of the mean errors over the last 2 s."""
    fall_rate: float
    """Share that failed before the end."""


@dataclasses.dataclass(frozen=True)
class Crosscheck:
    """What came of it."""

    checks: dict[str, list[Check]]
    """The manoeuvres, by the simulator, with the name of its own aircraft where that flew."""
    rows: list[Row]
    """The flights."""
    effects: list[tuple[str, ...]]
    """Physics, and how it is in quadrl and in each of SIMULATORS."""


def fitting(policy: Policy) -> list[str]:
    """The names of what can fly a policy; Betaflight does some that command body rates."""
    names, own = [*SIMULATORS], policy.scenario
    with contextlib.suppress(QuadrlError):
        betaflight.check_fits(own.aircraft, own.control_mode)
        names.append(betaflight.NAME)
    return names


def crosscheck(
    policy: Policy,
    *,
    simulators: Sequence[str] = (),
    episodes: int | None = None,
    seed: int = 0,
    said: Callable[[str], None] = lambda text: None,
) -> Crosscheck:
    """Fly a policy in simulators that others wrote, undisturbed, and beside them in quadrl.

    Args:
        policy: The policy; it flies four rotors, in a task without ground and solids.
        simulators: Names of SIMULATORS, or "betaflight", for its rate loops; they are installed at
            the first use. By default all that can fly the policy.
        episodes: How many of each kind; by default EPISODES.
        seed: Of the episodes, as in `quadrl.evaluate`.
        said: Told what is going on.

    Raises:
        QuadrlError: The policy cannot be flown so; a simulator cannot be installed, or means
            something else than quadrl; no policy has flown there then.
    """
    number("seed", seed, 0, MAX_SEED, whole=True)
    if episodes is not None:
        number("episodes", episodes, 1, MAX_EPISODES, whole=True)
    scenario = _scenario(policy)
    flies, air = scenario.vehicle, scenario.vehicle.aerodynamics
    names = simulators or fitting(policy)
    many = {choice("simulator", x, EPISODES): episodes or EPISODES[x] for x in names}
    if betaflight.NAME in many:
        betaflight.check_fits(flies, scenario.control_mode)
    pythons = {name: environment_of(name, said) for name in many if name in SIMULATORS}
    firmware = betaflight.firmware(said) if betaflight.NAME in many else None
    found = Crosscheck({}, [], _effects(flies))

    def both(
        where: str,
        aircraft: str,
        change: Any,
        count: int,
        advance: Advance | None,
        pilot: Betaflight | None = None,
    ) -> None:
        for delay in (0.0, LATE):
            said(f"flying in {where}: {aircraft}, {1000 * delay:g} ms late")
            drawn: Any = {"command_delay": (delay, delay)} if delay and not pilot else "none"
            flown = dataclasses.replace(scenario, randomization=drawn, **change)
            if pilot:
                each = fly_by(pilot, policy, flown, count, seed, delay)
            else:
                each = fly_in(policy, flown, count, seed, advance)
            error = float(np.median(each["position_error_m"]))
            success, fell = (float(each[name].mean()) for name in ("success", "failed"))
            found.rows.append(Row(where, aircraft, delay, count, success, error, fell))

    most = max(many.values(), default=EPISODES["crazyflow"])
    both("quadrl", flies.name, {}, most, None)
    for name, count in many.items():
        if firmware and name == betaflight.NAME:
            with contextlib.closing(Betaflight(firmware, flies)) as pilot:
                both(f"Betaflight {pilot.version}", flies.name, {}, count, None, pilot)
            continue
        own = OWN.get(flies.name, {}).get(name, "")
        for aircraft in dict.fromkeys(("", own)):
            given = {"own": aircraft, "vehicle": dataclasses.asdict(flies), "brakes": brakes(flies)}
            there = Simulator(name, pythons[name], given)
            with contextlib.closing(there):
                advance = scaled(there, flies) if aircraft else there.advance
                compared = f"{name} {aircraft}".strip(), checks(flies, advance)
                _refuse_wrong(*compared)
                found.checks.update([compared])
                change = {"vehicle": dataclasses.replace(flies, dead_time=0.0)} if aircraft else {}
                where = f"{name} {there.version}"
                both(where, aircraft or "matched", change, count, advance)
        usual = {x: type(air).__dataclass_fields__[x].default for x in LACKS[name]}
        like = dataclasses.replace(air, **usual)
        if like != air:
            both("quadrl", f"air of {name}", {"aerodynamics": like}, most, None)
    return found


def _scenario(policy: Policy) -> Scenario:
    """What is flown, undisturbed; or the refusal of what no simulator can fly."""
    given: Any = {**UNDISTURBED, "engine": "free_flight"}
    scenario = dataclasses.replace(policy.scenario, **given)
    task, vehicle = scenario.task, scenario.aircraft
    if task.contact or task.solids():
        allowed = "one without ground and solids, such as hover: a simulator has others"
        raise QuadrlError(name="task", value=task.name, allowed=allowed)
    if vehicle.rotor_count != 4 or any(rotor.axis != (0.0, 0.0, 1.0) for rotor in vehicle.rotors):
        allowed = "one with four level rotors: the simulators know no other"
        raise QuadrlError(name="vehicle", value=vehicle.name, allowed=allowed)
    return dataclasses.replace(scenario, vehicle=vehicle, aerodynamics=vehicle.aerodynamics)


def _effects(vehicle: Vehicle) -> list[tuple[str, ...]]:
    fields = vars(vehicle.aerodynamics) | vars(vehicle)
    return [(name, here if fields[x] else "off", *there) for name, x, here, *there in EFFECTS]


def _refuse_wrong(where: str, found: Iterable[Check]) -> None:
    for one in found:
        if one.wrong:
            numbers = f"{told(one.there)} in {where}, {told(one.here)} in quadrl"
            raise QuadrlError(f"{one.name}: {numbers}; {one.wrong}. No policy was flown there")


def brakes(vehicle: Vehicle) -> list[float]:
    """What brakes an aircraft along x, y and z, hovering but for 1 m/s [N s/m]."""
    before, after, seconds = flown(vehicle, engine_of(vehicle))
    change = (before - after)[ALONG, (7, 8, 9)]
    return (vehicle.mass * change / seconds).tolist()


def scaled(there: Simulator, vehicle: Vehicle) -> Advance:
    """A simulator's own aircraft, whose rotor speeds count in shares of those that carry it."""
    ratio = there.hover_speed / float(np.mean(vehicle.hover_speed))
    by = np.repeat([1.0, ratio], (13, 4))

    def advance(motion: np.ndarray, command: np.ndarray, seconds: float) -> np.ndarray:
        return there.advance(motion * by, command * ratio, seconds) / by

    return advance


def fly_by(
    pilot: Betaflight, policy: Policy, scenario: Scenario, episodes: int, seed: int, delay: float
) -> dict[str, np.ndarray]:
    """Fly the same episodes by Betaflight's rate loops, one after another, in quadrl's physics.

    What is late is the setpoint on its way to the firmware, not what the firmware tells its motors.

    Returns:
        As `fly_in`.
    """
    each: list[dict[str, np.ndarray]] = []
    for k in range(episodes):
        asked, advance = pilot.flying(delay)
        each.append(fly_in(policy, scenario, 1, seed + k, advance, asked))
    return {name: np.concatenate([one[name] for one in each]) for name in each[0]}


def fly_in(
    policy: Policy,
    scenario: Scenario,
    episodes: int,
    seed: int,
    advance: Advance | None = None,
    asked: Callable[[np.ndarray], None] = lambda setpoint: None,
) -> dict[str, np.ndarray]:
    """Fly episodes of a scenario, with physics steps by another simulator.

    `asked` is told the setpoint of each control step (N, n), in the units of the control mode.

    An aircraft whose motion it gives as NaN has touched something there: its flight has failed.

    Returns:
        Arrays (N,), a number a flight: success and failed, before the end (bool);
        position_error_m: mean error over the last 2 s [m]; length_s.
    """
    environment = Environment(scenario, num_envs=episodes, seed=EVALUATION_SEED + seed)
    controller, engine = begun(policy, environment), environment.engine
    observation = environment.flatten(environment.reset())
    alive, length = np.ones(episodes, bool), np.zeros(episodes, int)
    struck = np.zeros(episodes, bool)
    ends = {name: np.zeros(episodes, bool) for name in ("is_success", "terminated")}
    errors: list[np.ndarray] = []
    while alive.any():
        action = controller(observation)
        asked(environment.control_mode.values(action))
        environment.begin(action)
        for steps in environment.commands():
            if advance is None:
                engine.advance(steps)
                continue
            motion = np.concatenate([engine.qpos, engine.qvel, engine.act], axis=1)
            command = np.where((alive & ~struck)[:, None], engine.ctrl, np.nan)
            reached = advance(motion, command, steps * scenario.aircraft.physics_timestep)
            struck |= alive & np.isnan(reached).all(axis=1)
            motion[alive & ~struck] = reached[alive & ~struck]
            engine.qpos[:], engine.qvel[:], engine.act[:] = np.split(motion, [7, 13], axis=1)
        now = environment.finish()
        observation = environment.flatten(now.observation)
        errors.append(np.where(alive, now.error, 0.0))
        length += alive
        for name, flags in ends.items():
            flags |= alive & ~struck & getattr(now, name)
        ends["terminated"] |= struck
        alive &= ~(now.terminated | now.truncated | struck)
    timestep = scenario.aircraft.control_timestep
    return {
        "success": ends["is_success"],
        "failed": ends["terminated"] & ~ends["is_success"],
        "position_error_m": final_error(np.array(errors), length, timestep),
        "length_s": length * timestep,
    }
