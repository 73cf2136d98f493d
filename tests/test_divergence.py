"""Extreme aircraft, actions and contacts: what is flown is right, or terminated and counted.

How far a flight can be trusted is told by four numbers of the aircraft and its flight, each a rate
times the physics step: see LIMITS, and the tables of docs/endurance.md.
"""

import dataclasses

import numpy as np
import pytest
import reference
from scipy.stats import qmc

from quadrl.environment import Environment
from quadrl.simulation import ENGINES, BatchSimulation
from quadrl.vehicle import Vehicle, VehicleError

STEP = 0.01
RIGHT = 1e-3
"""Largest error of position [m] and attitude [rad], and of velocity, body rate and rotor speed
as a share of the fastest of the flight (1 m/s and 1 rad/s at least) and of hover."""
# Greatest rates times the step at which half a second of flight is RIGHT: of the rotor lag, of the
# turning, and of the aerodynamic moment (2 k_M |omega| / J) and drag (2 k_D |v| / m).
LIMITS = {
    "mujoco": {"lag": 0.2, "turn": 0.1, "moment": 0.5, "drag": 0.5},
    "flight": {"lag": 0.2, "turn": 0.3, "moment": 0.5, "drag": 0.5},
}
CONTROL_STEPS = 10
RANGES = {  # logarithmic
    "mass": (0.03, 3.0),  # [kg]
    "arm_length": (0.04, 0.4),  # [m]
    "inertia": (0.05, 0.4),  # of mass * arm^2
    "flatness": (1.0, 1.9),  # of the moment about z over the others
    "hover_speed": (150.0, 2500.0),  # [rad/s]
    "torque": (0.005, 0.05),  # k_Q over k_T [m]
    "terminal": (2.0, 40.0),  # speed at which the drag is the weight [m/s]
    "moment_coefficient": (1e-9, 1e-3),
    "lag": (0.005, 0.2),  # of k_c times the step
    "ratio": (1.2, 6.0),  # of thrust over weight
}


def extreme_vehicles(count):
    """Aircraft all over RANGES; an action commands every rotor from rest to its fastest."""
    sampled = qmc.LatinHypercube(len(RANGES), rng=np.random.default_rng(0)).random(count)
    low, high = np.array(list(RANGES.values())).T
    vehicles = []
    for row in low * (high / low) ** sampled:
        p = dict(zip(RANGES, row.tolist(), strict=True))
        across = p["inertia"] * p["mass"] * p["arm_length"] ** 2
        weight = 9.81 * p["mass"]
        vehicles.append(
            Vehicle(
                mass=p["mass"],
                arm_length=p["arm_length"],
                inertia=(across, across, p["flatness"] * across),
                thrust_coefficient=weight / (4 * p["hover_speed"] ** 2),
                torque_coefficient=p["torque"] * weight / (4 * p["hover_speed"] ** 2),
                drag_coefficient=weight / p["terminal"] ** 2,
                moment_coefficient=p["moment_coefficient"],
                lag_rate=p["lag"] / STEP,
                max_thrust_ratio=p["ratio"],
                action_scale=2.5 * p["hover_speed"],
                physics_step=STEP,
            )
        )
    return vehicles


def extreme_actions(steps):
    """Actions (steps, 8, 4): bang-bang, all at rest, all at their fastest, one pair, random."""
    rng = np.random.default_rng(1)
    actions = rng.uniform(-0.2, 0.2, (steps, 8, 4))
    actions[:, 0] = rng.choice([-1.0, 1.0], (steps, 4))
    actions[:, 1] = np.where(np.arange(steps)[:, None] % 2, 1.0, -1.0)
    actions[:, 2], actions[:, 3] = -1.0, 1.0
    actions[:, 4] = (1.0, -1.0, 1.0, -1.0)
    actions[:, 5] = (1.0, 0.0, -1.0, 0.0)
    return actions


def extreme_starts(vehicle, count):
    """States (count, 17) of `reference`: any attitude, to 10 m/s, turning to 0.1 of a step."""
    rng = np.random.default_rng(2)
    attitude, velocity, spin = rng.normal(size=(3, count, 4))
    attitude /= np.linalg.norm(attitude, axis=-1, keepdims=True)
    moving = []
    for direction, most in ((velocity, 10.0), (spin, 0.1 / STEP)):
        size = most * np.geomspace(0.01, 1.0, count)[:, None]
        moving.append(size * direction[:, :3] / np.linalg.norm(direction[:, :3], axis=-1)[:, None])
    rotors = rng.uniform(0.0, vehicle.max_speed, (count, 4))
    return np.concatenate([np.zeros((count, 3)), attitude, *moving, rotors], axis=-1)


def rates(vehicle, qvel):
    """By their names in LIMITS, (n,): those of aircraft with qvel (n, 6)."""
    speed, spin = (np.linalg.norm(part, axis=-1) for part in (qvel[:, :3], qvel[:, 3:]))
    fastest = {
        "lag": np.full(len(qvel), vehicle.lag_rate),
        "turn": spin,
        "moment": 2 * vehicle.moment_coefficient * spin / min(vehicle.inertia),
        "drag": 2 * vehicle.drag_coefficient * speed / vehicle.mass,
    }
    return {name: rate * vehicle.physics_step for name, rate in fastest.items()}


@pytest.mark.parametrize("engine", ENGINES)
def test_extreme_flights_are_right_where_their_rates_say_so(engine):
    judged, trusted, worst = 0, 0, 0.0
    for vehicle in extreme_vehicles(24):
        commands = vehicle.rotor_command(extreme_actions(CONTROL_STEPS))
        start = extreme_starts(vehicle, 8)
        simulation = BatchSimulation(vehicle, 8, altitude=3.0, engine=engine)
        simulation.qpos[:], simulation.qvel[:], simulation.act[:] = reference.to_mujoco(start)
        within, fast = np.ones(8, dtype=bool), np.ones((8, 2))
        flown = []
        for command in commands:
            simulation.ctrl[:] = command
            for _ in range(vehicle.substeps):
                for name, rate in rates(vehicle, simulation.qvel).items():
                    within &= rate <= LIMITS[engine][name]
                simulation.advance(1)
                for k, part in enumerate((simulation.qvel[:, :3], simulation.qvel[:, 3:])):
                    fast[:, k] = np.fmax(fast[:, k], np.linalg.norm(part, axis=-1))
            flown.append([x.copy() for x in (simulation.qpos, simulation.qvel, simulation.act)])
        judged, trusted = judged + 8, trusted + within.sum()
        exact, calm = start[within], np.zeros((within.sum(), 3))
        scale = np.ones((within.sum(), 5))
        scale[:, 2:4], scale[:, 4] = fast[within], vehicle.hover_speed
        for command, state in zip(commands, flown, strict=True):
            if not within.any():
                break
            exact = reference.fly(vehicle, exact, command[within], vehicle.control_step, calm)
            apart = reference.deviation(*(part[within] for part in state), exact) / scale
            worst = max(worst, apart.max())
    assert worst < RIGHT, worst
    # Both kinds are there: flights that are judged, and flights beyond the limits.
    assert 0.1 * judged < trusted < 0.9 * judged, trusted


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("task", ["hover", "landing"])
def test_every_row_is_finite_and_moves_or_is_counted_and_neighbours_fly_on(task, engine):
    """Rows 0 to 7 are wild, the others are not; nobody is reset."""
    ended = 0
    for vehicle in extreme_vehicles(16):
        environment, undisturbed = (
            Environment(task, num_envs=16, seed=3, vehicle=vehicle, engine=engine) for _ in range(2)
        )
        environment.reset(), undisturbed.reset()
        start = extreme_starts(vehicle, 8)
        start[:, 10:13] *= np.geomspace(1.0, 1e9, 8)[:, None]  # what no flight comes back from
        simulation = environment.simulation
        _, simulation.qvel[:8], simulation.act[:8] = reference.to_mujoco(start)
        for wild in extreme_actions(20):
            # Not quite hovering: an aircraft that hovers from rest does not move, and is no worse.
            action = np.concatenate([wild, np.full((8, 4), 0.05)])
            before = np.concatenate([simulation.qpos, simulation.qvel], axis=-1)
            now, calm = environment.step(action), undisturbed.step(action)
            after = np.concatenate([simulation.qpos, simulation.qvel], axis=-1)
            observation = environment.flatten(now.observation, np.empty((16, environment.size)))
            assert np.isfinite(observation).all() and np.isfinite(now.reward).all()
            assert np.isfinite(after).all() and np.isfinite(simulation.act).all()
            assert ((after != before).any(axis=-1) | now.diverged).all()
            assert (now.terminated >= now.diverged).all()
            assert not (now.is_success & now.diverged).any()
            np.testing.assert_array_equal(now.reward[8:], calm.reward[8:])
            np.testing.assert_array_equal(after[8:], _moving(undisturbed)[8:])
            ended += now.diverged.sum()
        environment.reset(np.arange(8))  # and the wild ones begin anew
        assert not environment.step(np.zeros((16, 4))).diverged[:8].any()
    assert ended > 0


def _moving(environment):
    simulation = environment.simulation
    return np.concatenate([simulation.qpos, simulation.qvel], axis=-1)


@pytest.mark.parametrize("engine", ENGINES)
def test_whoever_hits_the_ground_at_speed_has_crashed_and_is_not_under_it(engine):
    for vehicle in extreme_vehicles(12):
        environment = Environment("landing", num_envs=16, seed=0, vehicle=vehicle, engine=engine)
        environment.reset()
        simulation = environment.simulation
        simulation.qpos[:, :3] = 0.0, 0.0, 3.0
        sinking = np.geomspace(2.5, 200.0, 16)  # [m/s]
        simulation.qpos[:, 2] += 2 * sinking * vehicle.control_step - 2.9
        simulation.qvel[:] = 0.0
        simulation.qvel[:, 2] = -sinking
        over = np.zeros(16, dtype=bool)
        for _ in range(25):  # they hit it in the second step
            now = environment.step(np.full((16, 4), -1.0))
            assert not (now.is_success & ~over).any()  # what comes after the end does not count
            over |= now.terminated
            assert np.isfinite(_moving(environment)).all() and np.isfinite(now.reward).all()
        assert over.all()
        # Nothing fell through the ground: the origin is where it stands on its feet.
        lowest = simulation.state.position[:, 2] + vehicle.ground_clearance
        assert (lowest > -vehicle.ground_clearance).all(), lowest.min()


def test_rotors_faster_than_the_step_are_refused():
    # Past 2.785 the Runge-Kutta method is unstable, whatever flies; at 2 it is off by 0.2 rad/s.
    assert Vehicle(lag_rate=100.0).lag_rate == 100.0
    with pytest.raises(VehicleError, match=r"lag_rate = 101.0 with physics_step = 0.01: .*at most"):
        Vehicle(lag_rate=101.0)
    finer = dataclasses.replace(Vehicle(), lag_rate=1000.0, physics_step=0.001)
    assert finer.substeps == 50
