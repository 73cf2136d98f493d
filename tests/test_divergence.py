"""Extreme aircraft, actions and contacts: what is flown is right, or terminated and counted.

How far a flight can be trusted is told by four numbers of the aircraft and its flight, each a rate
times the physics step: see LIMITS, and the tables of docs/endurance.md. Who is faster than the step
resolves (`Vehicle.resolved_speed`, `resolved_spin`) has diverged.
"""

import contextlib
import dataclasses

import numpy as np
import pytest
import reference
from scipy.stats import qmc

from quadrl.environment import Environment
from quadrl.simulation import ENGINES, BatchSimulation
from quadrl.state import Start
from quadrl.task import TaskError
from quadrl.vehicle import Vehicle, VehicleError

STEP = 0.01
RIGHT, RESOLVED = 1e-3, 5e-2
"""Largest errors of position [m] and attitude [rad], and of velocity, body rate and rotor speed
as a share of the fastest of the flight (1 m/s and 1 rad/s at least) and of hover: of a flight
within LIMITS, and of any that has not diverged."""
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
    """Aircraft all over RANGES; an action commands every rotor from rest to its fastest.

    Those that the step is too long for are refused, and left out.
    """
    sampled = qmc.LatinHypercube(len(RANGES), rng=np.random.default_rng(0)).random(2 * count)
    low, high = np.array(list(RANGES.values())).T
    vehicles = []
    for row in low * (high / low) ** sampled:
        p = dict(zip(RANGES, row.tolist(), strict=True))
        across = p["inertia"] * p["mass"] * p["arm_length"] ** 2
        weight = 9.81 * p["mass"]
        with contextlib.suppress(VehicleError):
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
    assert len(vehicles) >= count
    return vehicles[:count]


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
    """States (count, 17) of `reference`: any attitude, to the fastest that a step resolves."""
    rng = np.random.default_rng(2)
    attitude, velocity, spin = rng.normal(size=(3, count, 4))
    attitude /= np.linalg.norm(attitude, axis=-1, keepdims=True)
    fastest = min(20.0, 0.99 * vehicle.resolved_speed)
    moving = []
    for direction, most in ((velocity, fastest), (spin, 0.99 * vehicle.resolved_spin)):
        size = most * np.geomspace(1e-3, 1.0, count)[:, None]
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
def test_extreme_flights_are_right_or_ended(engine):
    count, trusted, ended, worst, worst_trusted = 0, 0, 0, 0.0, 0.0
    for vehicle in extreme_vehicles(12):
        commands = vehicle.rotor_command(extreme_actions(CONTROL_STEPS))
        start = extreme_starts(vehicle, 8)
        simulation = BatchSimulation(vehicle, 8, altitude=3.0, engine=engine)
        simulation.qpos[:], simulation.qvel[:], simulation.act[:] = reference.to_mujoco(start)
        within, whole = np.ones((2, 8), dtype=bool)
        fast = np.ones((8, 2))
        flown = []
        for command in commands:
            simulation.ctrl[:] = command
            for _ in range(vehicle.substeps):
                for name, rate in rates(vehicle, simulation.qvel).items():
                    within &= rate <= LIMITS[engine][name]
                simulation.advance(1)
                for k, part in enumerate((simulation.qvel[:, :3], simulation.qvel[:, 3:])):
                    fast[:, k] = np.fmax(fast[:, k], np.linalg.norm(part, axis=-1))
            state = [x.copy() for x in (simulation.qpos, simulation.qvel, simulation.act)]
            if (diverged := simulation.read()) is not None:
                whole &= ~diverged
                within &= whole
            flown.append((state, whole.copy()))
        count, trusted, ended = count + 8, trusted + within.sum(), ended + (~whole).sum()
        some = flown[0][1]  # what ended before the first state has no state to judge
        exact, calm = start[some], np.zeros((some.sum(), 3))
        scale = np.ones((some.sum(), 5))
        scale[:, 2:4], scale[:, 4] = fast[some], vehicle.hover_speed
        for command, (state, whole) in zip(commands, flown, strict=True):
            if not whole.any():
                break
            exact = reference.fly(vehicle, exact, command[some], vehicle.control_step, calm)
            apart = reference.deviation(*(part[some] for part in state), exact) / scale
            worst = max(worst, apart[whole[some]].max())
            worst_trusted = max(worst_trusted, apart[within[some]].max(initial=0.0))
    assert worst_trusted < RIGHT, worst_trusted
    assert worst < RESOLVED, worst
    # All three kinds are there.
    assert 0.05 * count < trusted < 0.9 * (count - ended) and ended > 0.05 * count, (trusted, ended)


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


def test_an_aircraft_that_the_step_is_too_long_for_is_refused():
    # 2 k_M |omega| dt / J = 1 at 7.5e-3 / (2 * 0.1 * 0.01) = 3.75 rad/s: not a turn a second.
    with pytest.raises(VehicleError, match=r"no more than 3.75 rad/s.*at most 0.006 s"):
        Vehicle(moment_coefficient=0.1)
    assert Vehicle(moment_coefficient=0.1, physics_step=0.005).resolved_spin == 7.5
    # 2 k_D |v| dt / m = 1 at 0.65 / (2 * 200 * 0.01) = 0.1625 m/s; it falls at 0.179 m/s.
    with pytest.raises(
        VehicleError, match=r"0.163 m/s is resolved, and 0.179 is needed.* at most 0.0091 s"
    ):
        Vehicle(drag_coefficient=200.0)
    # Without drag and moment only the turning counts: half a radian in a step.
    free = Vehicle(drag_coefficient=0.0, moment_coefficient=0.0)
    assert (free.resolved_spin, free.resolved_speed) == (50.0, 1e10)


@pytest.mark.parametrize("task", ["static_waypoint", "straight_and_level"])
def test_whoever_turns_faster_than_the_step_resolves_has_diverged(task):
    """In tasks that do not end by the tilt."""
    environment = Environment(task, num_envs=3, seed=0)
    environment.reset()
    simulation = environment.simulation
    simulation.qvel[:, 3:] = [[0, 0, 49.0], [0, 0, 60.0], [0, 0, 80.0]]
    now = environment.step(np.zeros((3, 4)))
    # The moment slows it: omega / (1 + omega k_M t / J_z), after 0.05 s 49.7 and 62.7 rad/s.
    assert now.diverged.tolist() == now.terminated.tolist() == [False, False, True]
    assert not now.is_success.any() and not now.truncated.any()


def test_whoever_flies_faster_than_the_step_resolves_has_diverged():
    environment = Environment(
        "static_waypoint", num_envs=2, seed=0, vehicle=Vehicle(control_step=STEP)
    )
    environment.reset()
    environment.simulation.qvel[:, 0] = [3000.0, 20000.0]
    # The drag slows it: v / (1 + v k_D t / m), to 2120 and 5306 m/s, of 3611 resolved.
    now = environment.step(np.zeros((2, 4)))
    assert now.diverged.tolist() == [False, True]
    assert 2000 < environment.simulation.state.speed[0] < 2200
    assert environment.simulation.state.speed[1] < 1  # where it was


def test_a_start_that_the_step_does_not_resolve_is_refused():
    simulation = BatchSimulation(Vehicle(), 2, altitude=3.0)
    state = simulation.state
    turning = Start(
        position=np.zeros((1, 3)),
        quaternion=np.array([[1.0, 0, 0, 0]]),
        velocity=np.zeros((1, 3)),
        body_rate=np.array([[0, 0, 51.0]]),
        rotor_speed=np.zeros((1, 4)),
    )
    with pytest.raises(TaskError, match=r"body_rate.*larger than 50; .*shorter physics_step"):
        simulation.place(np.array([1]), turning)
    fast = dataclasses.replace(turning, body_rate=np.array([[0, 0, 50.0]]))
    simulation.place(np.array([1]), fast)
    assert state.spin[1] == 50.0
    # What is at fault is named, though it comes after the others, and is no speed of flight.
    spun = dataclasses.replace(fast, rotor_speed=np.full((1, 4), 1e10))
    with pytest.raises(TaskError, match=r"rotor_speed that is not finite, or larger than 1e\+10$"):
        simulation.place(np.array([1]), spun)
