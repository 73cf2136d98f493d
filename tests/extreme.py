"""Aircraft, starts and actions at the edge of what a physics step resolves."""

import contextlib

import numpy as np
import reference
from scipy.stats import qmc

from quadrl.aircraft.rotors import ring
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.engines.mujoco import BatchEngine

STEP = 0.01  # [s]
CONTROL_STEPS = 10
ROWS = 8
LAYOUTS = (  # bearings [deg] and spins: a plus, an X and a ring of six
    (range(0, 360, 90), (1, -1, 1, -1)),
    ((45, 135, 225, 315), (1, -1, 1, -1)),
    (range(30, 390, 60), (1, -1) * 3),
)
RANGES = {  # logarithmic
    "mass": (0.03, 3.0),  # [kg]
    "arm_length": (0.04, 0.4),  # [m]
    "inertia": (0.05, 0.4),  # of mass * arm^2
    "flatness": (1.0, 1.9),  # of the moment about z over the others
    "hover_speed": (150.0, 2500.0),  # [rad/s]
    "torque": (0.005, 0.05),  # k_Q over k_T [m]
    "terminal": (2.0, 40.0),  # speed at which the drag is the weight [m/s]
    "moment_coefficient": (1e-9, 1e-3),
    "lag_up": (0.005, 0.2),  # of the lag times the step
    "lag_down": (0.005, 0.2),
    "ratio": (1.2, 6.0),  # of thrust over weight
}

RIGHT, RESOLVED = 1e-3, 5e-2
"""Largest errors of position [m] and attitude [rad], and of velocity, body rate and rotor speed
as a share of the fastest of the flight (1 m/s and 1 rad/s at least) and of hover: of a flight
within LIMITS, and of any that has not diverged."""
# Greatest rates times the step at which half a second of flight is RIGHT: of the rotor lag, of the
# turning, and of the aerodynamic moment (2 k_M |omega| / J) and drag (2 k_D |v| / m).
LIMITS = {
    "mujoco": {"lag": 0.2, "turn": 0.1, "moment": 0.5, "drag": 0.5},
    "free_flight": {"lag": 0.2, "turn": 0.3, "moment": 0.5, "drag": 0.5},
}


def vehicles(count):
    """Aircraft all over RANGES; an action commands every rotor from rest to its fastest.

    Those that the step is too long for are refused, and left out.
    """
    sampled = qmc.LatinHypercube(len(RANGES), rng=np.random.default_rng(0)).random(2 * count)
    low, high = np.array(list(RANGES.values())).T
    made = []
    for k, row in enumerate(low * (high / low) ** sampled):
        p = dict(zip(RANGES, row.tolist(), strict=True))
        bearings, spins = LAYOUTS[k % len(LAYOUTS)]
        across, weight = p["inertia"] * p["mass"] * p["arm_length"] ** 2, 9.81 * p["mass"]
        thrust = weight / (len(spins) * p["hover_speed"] ** 2)
        with contextlib.suppress(QuadrlError):
            made.append(
                Vehicle(
                    mass=p["mass"],
                    inertia=(across, across, p["flatness"] * across),
                    rotors=ring(
                        bearings,
                        spins,
                        p["arm_length"],
                        thrust_coefficient=thrust,
                        torque_coefficient=p["torque"] * thrust,
                        lag_up=p["lag_up"] / STEP,
                        lag_down=p["lag_down"] / STEP,
                        max_speed=p["ratio"] ** 0.5 * p["hover_speed"],
                    ),
                    drag_coefficient=weight / p["terminal"] ** 2,
                    moment_coefficient=p["moment_coefficient"],
                    action_scale=2.5 * p["hover_speed"],
                    physics_timestep=STEP,
                )
            )
    assert len(made) >= count
    return made[:count]


def actions(vehicle, steps):
    """Actions (steps, 8, R): bang-bang, all at rest, all at their fastest, one pair, random."""
    rotors = vehicle.rotor_count
    rng = np.random.default_rng(1)
    given = rng.uniform(-0.2, 0.2, (steps, ROWS, rotors))
    given[:, 0] = rng.choice([-1.0, 1.0], (steps, rotors))
    given[:, 1] = np.where(np.arange(steps)[:, None] % 2, 1.0, -1.0)
    given[:, 2], given[:, 3] = -1.0, 1.0
    given[:, 4] = np.resize((1.0, -1.0), rotors)
    given[:, 5] = np.resize((1.0, 0.0, -1.0, 0.0), rotors)
    return given


def starts(vehicle):
    """States (8, 13 + R) of `reference`: any attitude, to the fastest that a step resolves."""
    rng = np.random.default_rng(2)
    attitude, velocity, rate = rng.normal(size=(3, ROWS, 4))
    attitude /= np.linalg.norm(attitude, axis=-1, keepdims=True)
    fastest = min(20.0, 0.99 * vehicle.resolved_speed)
    moving = []
    for direction, most in ((velocity, fastest), (rate, 0.99 * vehicle.resolved_turn)):
        size = most * np.geomspace(1e-3, 1.0, ROWS)[:, None]
        moving.append(size * direction[:, :3] / np.linalg.norm(direction[:, :3], axis=-1)[:, None])
    rotors = rng.uniform(0.0, 1.0, (ROWS, vehicle.rotor_count)) * vehicle.max_speed
    return np.concatenate([np.zeros((ROWS, 3)), attitude, *moving, rotors], axis=-1)


def rates(vehicle, qvel):
    """By their names in LIMITS, (n,): those of aircraft with qvel (n, 6)."""
    speed, turn = (np.linalg.norm(part, axis=-1) for part in (qvel[:, :3], qvel[:, 3:]))
    lag = max(max(rotor.lag_up, rotor.lag_down) for rotor in vehicle.rotors)
    fastest = {
        "lag": np.full(len(qvel), lag),
        "turn": turn,
        "moment": 2 * vehicle.moment_coefficient * turn / min(vehicle.inertia),
        "drag": 2 * vehicle.drag_coefficient * speed / vehicle.mass,
    }
    return {name: rate * vehicle.physics_timestep for name, rate in fastest.items()}


def flown(vehicle, engine, states):
    """The errors (8,) of the extreme flights of an aircraft against exact states (steps, 8, k).

    Returns:
        The largest error of each flight while it had not diverged; the largest within LIMITS; which
        were within them to the end; and which diverged.
    """
    batch = BatchEngine(vehicle, ROWS, altitude=3.0, engine=engine)
    start = reference.to_mujoco(starts(vehicle))
    batch.qpos[:], batch.qvel[:], batch.act[:] = start
    within, whole = np.ones((2, ROWS), dtype=bool)
    worst, trusted = np.zeros((2, ROWS))
    scale = np.ones((ROWS, 6))
    scale[:, 5] = vehicle.hover_speed.max()
    for action, exact in zip(actions(vehicle, len(states)), states, strict=True):
        batch.ctrl[:] = vehicle.rotor_command(action)
        for _ in range(vehicle.substeps):
            for name, rate in rates(vehicle, batch.qvel).items():
                within &= rate <= LIMITS[engine][name]
            batch.advance(1)
            for part, columns in (
                (batch.qvel[:, :3], slice(2, 4)),
                (batch.qvel[:, 3:], slice(4, 5)),
            ):
                fastest = np.linalg.norm(part, axis=-1)[:, None]
                scale[:, columns] = np.fmax(scale[:, columns], fastest)
        apart = reference.deviation(batch.qpos, batch.qvel, batch.act, exact) / scale
        apart = np.delete(apart, reference.QUANTITIES.index("body_velocity"), axis=1).max(axis=1)
        if (diverged := batch.read()) is not None:
            whole &= ~diverged
        within &= whole
        worst[whole] = np.fmax(worst, apart)[whole]
        trusted[within] = np.fmax(trusted, apart)[within]
    return worst, trusted, within, ~whole
