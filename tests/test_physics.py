"""The flight itself: against an exact integrator, and statements that anyone can check by hand."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
import reference
from scipy.spatial.transform import Rotation

from quadrl.vehicle import Vehicle

PAPER = Vehicle()
VACUUM = Vehicle(drag_coefficient=0.0, moment_coefficient=0.0)
HOVER = math.sqrt(0.65 * 9.81 / (4 * 3.13e-5))  # = 225.678 rad/s


def aircraft(vehicle=PAPER):
    """Its lean model and data, 100 m up, everything at rest."""
    model = vehicle.compile_lean()
    data = mujoco.MjData(model)
    data.qpos[2] = 100.0
    return model, data


def accelerations(vehicle=PAPER, *, rotor_speed=0.0, velocity=(0, 0, 0), rate=(0, 0, 0), wind=None):
    """World linear (3,) and body angular (3,) acceleration of a level aircraft."""
    model, data = aircraft(vehicle)
    data.act[:] = rotor_speed
    data.qvel[:] = (*velocity, *rate)
    if wind is not None:
        model.opt.wind[:] = wind
    mujoco.mj_forward(model, data)
    return data.qacc[:3].copy(), data.qacc[3:].copy()


# ------------------------------------------------------------------------ against the equations


def random_flights(count, wind, seed):
    """Starts x (n, 17) in the paper's terms, commands (n, 4) and winds (n, 3)."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    position = rng.uniform(-1, 1, (count, 3))
    v, omega = rng.uniform(-2, 2, (2, count, 3))
    speed, command = rng.uniform(150, 300, (2, count, 4))
    start = np.concatenate([position, q, v, omega, speed], axis=-1)
    return start, command, rng.uniform(-wind, wind, (count, 3))


def fly(vehicle, start, command, seconds, wind):
    """The same starts through MuJoCo: position, attitude, world velocity, spin, rotor speed."""
    model = vehicle.compile_lean()
    data = mujoco.MjData(model)
    flown = []
    for x, asked, blowing in zip(start, command, wind, strict=True):
        mujoco.mj_resetData(model, data)
        model.opt.wind[:] = blowing
        attitude = Rotation.from_quat(x[3:7], scalar_first=True).inv()  # the paper's is the inverse
        data.qpos[:3], data.qpos[3:] = x[:3], attitude.as_quat(scalar_first=True)
        data.qvel[:3], data.qvel[3:] = attitude.apply(x[7:10]), x[10:13]
        data.act[:], data.ctrl[:] = x[13:], asked
        mujoco.mj_step(model, data, round(seconds / vehicle.physics_step))
        flown.append(np.concatenate([data.qpos, data.qvel, data.act]))
    return np.array(flown)


def errors(flown, exact):
    """Worst deviation of each of n flights, (n,) by name; attitude as the angle between the two."""
    true_attitude = Rotation.from_quat(exact[:, 3:7], scalar_first=True).inv()
    attitude = Rotation.from_quat(flown[:, 3:7], scalar_first=True)
    deviations = {
        "position": flown[:, :3] - exact[:, :3],
        "attitude": (attitude.inv() * true_attitude).magnitude()[:, None],
        "velocity": flown[:, 7:10] - true_attitude.apply(exact[:, 7:10]),
        "body velocity": attitude.inv().apply(flown[:, 7:10]) - exact[:, 7:10],
        "spin": flown[:, 10:13] - exact[:, 10:13],
        "rotor speed": flown[:, 13:] - exact[:, 13:],
    }
    return {name: np.abs(deviation).max(axis=1) for name, deviation in deviations.items()}


SEEDS = range(10)  # of a hundred flights each, named before any was flown
LIMITS = {0.01: 2e-3, 0.0025: 1e-4}  # physics step [s]: largest error of a flight of 1 s
BODY_LIMITS = {0.01: 5e-3, 0.0025: 3.2e-4}


@pytest.mark.parametrize("wind", [0.0, 3.0])
def test_flights_converge_to_the_exact_solution_of_the_equations(wind):
    """A thousand flights, with and without wind of up to 3 m/s per axis.

    With the velocity in the world frame, as MuJoCo's free joint has it, all of them keep the limit
    at 0.01 s (the worst has 1.9e-3, in velocity), and 999 of them that at 0.0025 s (the worst has
    1.2e-4). In the body frame, as the paper has it, the error of the attitude times the speed,
    which reaches 19 m/s, comes on top: 91 % and 83 % of the flights keep the limits in still air,
    the worst has 4.8e-3 and 3.0e-4. Hence limits of its own. Wind changes none of this.
    """
    flights = [random_flights(100, wind, seed) for seed in SEEDS]
    start, command, blowing = (np.concatenate(part) for part in zip(*flights, strict=True))
    exact = reference.fly(PAPER, start, command, 1.0, blowing)
    worst = {}
    for step, limit in LIMITS.items():
        vehicle = dataclasses.replace(PAPER, physics_step=step)
        error = errors(fly(vehicle, start, command, 1.0, blowing), exact)
        in_body = error.pop("body velocity")
        of_flights = np.max(list(error.values()), axis=0)
        assert (of_flights < limit).mean() >= 0.999
        assert of_flights.max() < 1.2 * limit
        assert (in_body < limit).mean() > 0.8
        assert in_body.max() < BODY_LIMITS[step]
        worst[step] = {name: value.max() for name, value in error.items()}
    coarse, fine = worst.values()
    # MuJoCo's RK4 is of second order in the attitude, and what follows from it: a quarter of the
    # step leaves 1/16 of the error. A wrong coefficient would leave an error that stays.
    for name in ("position", "attitude", "velocity"):
        assert coarse[name] / fine[name] == pytest.approx(16, rel=0.1), name
    # Spin and rotor speed know no attitude: fourth order, 1/256.
    assert max(fine["spin"], fine["rotor speed"]) < 1e-8


def test_another_aircraft_obeys_the_same_equations():
    other = Vehicle(
        mass=1.1,
        arm_length=0.15,
        inertia=(6e-3, 9e-3, 1.2e-2),
        thrust_coefficient=5e-5,
        torque_coefficient=2e-6,
        drag_coefficient=3e-2,
        moment_coefficient=4e-3,
        lag_rate=12.0,
        physics_step=0.0025,
    )
    start, command, blowing = random_flights(20, 2.0, seed=5)
    exact = reference.fly(other, start, command, 0.5, blowing)
    for name, error in errors(fly(other, start, command, 0.5, blowing), exact).items():
        assert error.max() < 1e-4, name


# ------------------------------------------------------------------------------- by hand: forces


def test_free_fall_without_drag_is_minus_g():
    model, data = aircraft(VACUUM)
    mujoco.mj_step(model, data, 100)  # 1 s
    np.testing.assert_allclose(data.qvel, [0, 0, -9.81, 0, 0, 0], atol=1e-12)
    # 100 m - 9.81/2 m
    np.testing.assert_allclose(data.qpos[:3], [0, 0, 95.095], atol=1e-10)


def test_four_rotors_at_hover_speed_carry_the_weight():
    model, data = aircraft()
    data.act[:] = data.ctrl[:] = HOVER
    mujoco.mj_step(model, data, 1000)  # 10 s
    np.testing.assert_allclose(data.qpos, [0, 0, 100, 1, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(data.qvel, 0, atol=1e-10)


def test_thrust_is_up_in_the_body_frame():
    # Nose down by 30 deg about +y at hover speed: 9.81 sin 30 = 4.905 ahead (east), and
    # 9.81 (cos 30 - 1) = -1.3143 of what is left against gravity.
    model, data = aircraft()
    data.qpos[3:] = (math.cos(math.pi / 12), 0, math.sin(math.pi / 12), 0)
    data.act[:] = HOVER
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc[:3], [4.905, 0, -1.31429], atol=1e-5)


def test_terminal_speed_of_a_fall():
    # m g = k_D v^2: v = sqrt(0.65 * 9.81 / 9e-3) = sqrt(708.5) = 26.61767 m/s.
    model, data = aircraft()
    data.qpos[2] = 1000.0
    mujoco.mj_step(model, data, 3000)
    # v = v_t tanh(g t / v_t): after 30 s tanh(11.06) lacks 5e-10 of one.
    assert data.qvel[2] == pytest.approx(-26.61767, abs=1e-5)
    assert data.qvel[2] == pytest.approx(-math.sqrt(0.65 * 9.81 / 9e-3), abs=1e-6)


def test_speed_of_a_fall_on_the_way_to_the_terminal_one():
    # v(2 s) = 26.61767 tanh(9.81 * 2 / 26.61767) = 26.61767 tanh(0.737105) = 16.6954
    model, data = aircraft()
    mujoco.mj_step(model, data, 200)
    assert data.qvel[2] == pytest.approx(-26.61767 * math.tanh(19.62 / 26.61767), abs=1e-5)


def test_drag_opposes_the_motion_and_grows_with_its_square():
    # |v| = 5: F = -9e-3 * 5 * (3, 4, 0) = (-0.135, -0.18, 0); over 0.65 kg.
    linear, angular = accelerations(velocity=(3, 4, 0))
    np.testing.assert_allclose(linear, [-0.135 / 0.65, -0.18 / 0.65, -9.81], rtol=1e-12)
    np.testing.assert_array_equal(angular, 0)


def test_drag_is_of_the_motion_through_the_air():
    drifting, _ = accelerations(velocity=(3, 4, 0), wind=(3, 4, 0))
    np.testing.assert_allclose(drifting, [0, 0, -9.81], atol=1e-14)
    # At rest in a west wind of 5 m/s: 9e-3 * 25 / 0.65 = 0.346154 to the east.
    pushed, angular = accelerations(wind=(5, 0, 0))
    np.testing.assert_allclose(pushed, [0.225 / 0.65, 0, -9.81], rtol=1e-12)
    np.testing.assert_array_equal(angular, 0)


def test_aerodynamic_moment_opposes_the_spin_and_grows_with_its_square():
    # |omega| = 5, about x and y, where J is equal, so that omega x J omega has only a z part, 0.
    # M = -9e-4 * 5 * (3, 4, 0) = (-0.0135, -0.018, 0); over 7.5e-3: (-1.8, -2.4, 0).
    _, angular = accelerations(rate=(3, 4, 0))
    np.testing.assert_allclose(angular, [-1.8, -2.4, 0], atol=1e-12)


# ------------------------------------------------------------------------------ by hand: torques


@pytest.mark.parametrize(
    ("speeds", "expected"),
    [
        # Roll and pitch: l k_T (210^2 - 190^2) = 0.23 * 3.13e-5 * 8000 = 0.057592 N m; over
        # 7.5e-3: 7.678933. The pair together has 210^2 + 190^2 - 2 * 200^2 = 200 more than the
        # other: a yaw of 7.5e-7 * 200 = 1.5e-4 N m; over 1.3e-2: 0.011538.
        ((200, 210, 200, 190), (7.678933, 0, 0.011538)),  # more on the left: to the right, +x
        ((200, 190, 200, 210), (-7.678933, 0, 0.011538)),
        ((190, 200, 210, 200), (0, 7.678933, -0.011538)),  # more behind: nose down, +y
        ((210, 200, 190, 200), (0, -7.678933, -0.011538)),
        # Yaw: k_Q 2 (210^2 - 190^2) = 7.5e-7 * 16000 = 0.012 N m; over 1.3e-2: 0.923077.
        ((190, 210, 190, 210), (0, 0, 0.923077)),  # 2 and 4 yaw to the left, +z
        ((210, 190, 210, 190), (0, 0, -0.923077)),
    ],
)
def test_sign_and_size_of_each_torque(speeds, expected):
    _, angular = accelerations(rotor_speed=speeds)
    np.testing.assert_allclose(angular, expected, atol=1e-6)


def test_one_rotor_alone():
    # Rotor 1 (ahead) at 200 rad/s: 3.13e-5 * 4e4 = 1.252 N at x = 0.23 m.
    # tau = (0, -0.23 * 1.252, -7.5e-7 * 4e4) = (0, -0.28796, -0.03) N m.
    linear, angular = accelerations(rotor_speed=(200, 0, 0, 0))
    np.testing.assert_allclose(linear, [0, 0, 1.252 / 0.65 - 9.81], rtol=1e-12)
    np.testing.assert_allclose(angular, [0, -0.28796 / 7.5e-3, -0.03 / 1.3e-2], rtol=1e-12)


def test_yaw_reaction_is_not_rounded():
    # The torque of a rotor over its thrust is k_Q / k_T = 7.5e-7 / 3.13e-5 to the last digit.
    model = PAPER.compile_lean()
    reaction = model.actuator_gear[:, 5]
    np.testing.assert_array_equal(reaction, np.array([-1, 1, -1, 1]) * (7.5e-7 / 3.13e-5))


def test_gyroscopic_coupling_has_the_sign_of_euler():
    # J domega = -omega x J omega, omega = (1, 0, 2), J = (7.5, 7.5, 13)e-3:
    # omega x J omega = (0, 2 * 7.5e-3 - 1 * 26e-3, 0) = (0, -11e-3, 0), so domega_y = +11/7.5.
    _, angular = accelerations(VACUUM, rate=(1, 0, 2))
    np.testing.assert_allclose(angular, [0, 11 / 7.5, 0], atol=1e-12)


# ------------------------------------------------------------------------------- the rotors' lag


def test_rotors_follow_their_command_with_a_time_constant_of_0_18_s():
    model, data = aircraft(Vehicle(physics_step=0.01, control_step=0.18))
    data.act[:] = 150.0
    data.ctrl[:] = (300.0, 150.0, 0.0, 200.0)
    mujoco.mj_step(model, data, 18)  # one time constant: 1 - 1/e of the way
    way = 1 - 1 / math.e
    np.testing.assert_allclose(
        data.act, [150 + 150 * way, 150, 150 - 150 * way, 150 + 50 * way], atol=1e-5
    )


# -------------------------------------------------------------------------- energy and momentum


def energies(model, data):
    """Kinetic of the flight, potential, and kinetic of the spin [J]."""
    inertia = np.array([7.5e-3, 7.5e-3, 1.3e-2])
    flight = 0.5 * 0.65 * (data.qvel[:3] @ data.qvel[:3])
    return flight, 0.65 * 9.81 * data.qpos[2], 0.5 * (inertia @ data.qvel[3:] ** 2)


def test_energy_is_conserved_without_thrust_and_drag():
    model, data = aircraft(VACUUM)
    data.qvel[:] = (3, -2, 8, 1, -2, 1.5)
    flight, height, spin = energies(model, data)
    for _ in range(200):
        mujoco.mj_step(model, data)
        flight_now, height_now, spin_now = energies(model, data)
        assert flight_now + height_now == pytest.approx(flight + height, rel=1e-12)
        assert spin_now == pytest.approx(spin, rel=1e-9)
    assert abs(flight_now - flight) > 10  # there was something to exchange


def test_angular_momentum_is_conserved_in_torque_free_tumbling():
    model, data = aircraft(dataclasses.replace(VACUUM, physics_step=0.001))
    inertia = np.array([7.5e-3, 7.5e-3, 1.3e-2])
    data.qvel[3:] = (1, -2, 1.5)
    before = inertia * data.qvel[3:]  # level: the body frame is the world's
    mujoco.mj_step(model, data, 2000)
    attitude = Rotation.from_quat(data.qpos[3:], scalar_first=True)
    assert attitude.magnitude() > 0.5
    np.testing.assert_allclose(attitude.apply(inertia * data.qvel[3:]), before, atol=2e-8)


def test_drag_takes_as_much_energy_as_its_work():
    model, data = aircraft(dataclasses.replace(PAPER, physics_step=0.001))
    data.qvel[:] = (6, -3, 8, 2, -1, 3)
    energy, power = [sum(energies(model, data))], []

    def dissipation():
        speed, spin = np.linalg.norm(data.qvel[:3]), np.linalg.norm(data.qvel[3:])
        return 9e-3 * speed**3 + 9e-4 * spin**3  # [W]

    power.append(dissipation())
    for _ in range(2000):
        mujoco.mj_step(model, data)
        energy.append(sum(energies(model, data)))
        power.append(dissipation())
    assert (np.diff(energy) < 0).all()
    work = np.trapezoid(power, dx=0.001)
    assert energy[0] - energy[-1] == pytest.approx(work, rel=1e-6)
    assert work > 1.0


def test_thrust_adds_as_much_energy_as_its_work():
    # Climbing straight up at a constant rotor speed of 300, drag off: the net force is
    # 4 * 3.13e-5 * 9e4 - 0.65 * 9.81 = 11.268 - 6.3765 = 4.8915 N, 7.525385 m/s^2.
    model, data = aircraft(VACUUM)
    data.act[:] = data.ctrl[:] = 300.0
    mujoco.mj_step(model, data, 100)
    assert data.qvel[2] == pytest.approx(7.525385, abs=1e-5)
    assert data.qpos[2] == pytest.approx(100 + 7.525385 / 2, abs=1e-5)
    np.testing.assert_allclose(data.qvel[[0, 1, 3, 4, 5]], 0, atol=1e-12)
