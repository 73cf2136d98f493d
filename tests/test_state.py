"""The state by name: the C kernel, the definition in NumPy, other arrays, and the conventions."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadrl import rotation
from quadrl.simulation import BatchSimulation, SingleSimulation
from quadrl.state import Start, State
from quadrl.vehicle import Vehicle

NAMES = [field.name for field in dataclasses.fields(State)]
ALTITUDE = 3.0
# Its step resolves every rate of `random_start`.
VEHICLE = Vehicle(physics_step=5e-5)


def random_quaternions(rng, shape):
    quaternion = rng.normal(size=(*shape, 4))
    return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)


def random_start(seed, shape):
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-3, 3, (*shape, 1))  # small and large numbers
    return Start(
        position=rng.normal(size=(*shape, 3)) * scale,
        quaternion=random_quaternions(rng, shape),
        velocity=rng.normal(size=(*shape, 3)) * scale,
        body_rate=rng.normal(size=(*shape, 3)) * scale,
        rotor_speed=rng.uniform(0, 319, (*shape, 4)),
    )


def defined(start, altitude=ALTITUDE):
    """The state of a start by the definition, rounded by the way through the world's frame."""
    origin = np.array([0, 0, altitude])
    position = (start.position + origin) - origin
    time = np.zeros(start.position.shape[:-1])
    return State.of_coordinates(**{**vars(start), "position": position}, time=time)


def assert_same(state, expected, rows=...):
    for name in NAMES:
        got, wanted = np.asarray(getattr(state, name)), np.asarray(getattr(expected, name))
        np.testing.assert_array_equal(got[rows], wanted, err_msg=name)
        assert got[rows].shape == wanted.shape, name


def single_simulation():
    model = VEHICLE.compile_lean()
    return SingleSimulation(VEHICLE, model, mujoco.MjData(model), altitude=ALTITUDE)


# ------------------------------------------------------------------- the kernel is the definition


def test_kernel_of_a_batch_is_the_definition_bit_by_bit():
    simulation = BatchSimulation(VEHICLE, 2000, altitude=ALTITUDE)
    start = random_start(0, (2000,))
    placed = simulation.place(np.arange(2000), start)
    assert_same(placed, defined(start))
    assert_same(simulation.state, defined(start))
    assert simulation.state.rotation.shape == (2000, 3, 3)
    assert simulation.state.time.shape == (2000,)


def test_kernel_of_one_aircraft_is_the_definition_bit_by_bit():
    simulation = single_simulation()
    for seed in range(200):
        start = random_start(seed, ())
        simulation.place(None, start)
        assert_same(simulation.state, defined(start))
    assert simulation.state.rotation.shape == (3, 3)
    assert simulation.state.time.shape == ()


def test_kernel_straight_up_is_the_definition_bit_by_bit():
    # Nose straight up or down: the x axis has no level part at all, 0 in every digit.
    simulation = BatchSimulation(VEHICLE, 2, altitude=ALTITUDE)
    vertical = np.array([[0.5, 0.5, 0.5, -0.5], [0.5, -0.5, -0.5, -0.5]])
    start = dataclasses.replace(random_start(12, (2,)), quaternion=vertical)
    placed = simulation.place(np.arange(2), start)
    assert_same(placed, defined(start))
    np.testing.assert_array_equal(placed.sin_attitude, [[0, 1, 0], [0, -1, 0]])
    np.testing.assert_array_equal(placed.cos_attitude, 0)


def test_definition_of_a_batch_is_that_of_its_rows_bit_by_bit():
    start = random_start(1, (50,))
    batch = defined(start)
    for i in range(50):
        row = Start(**{name: value[i] for name, value in vars(start).items()})
        assert_same(batch, defined(row), i)


@pytest.mark.parametrize("rows", [[0], [6], [1, 4, 5], list(range(7))])
def test_placing_some_rows_leaves_the_others(rows):
    simulation = BatchSimulation(VEHICLE, 7, altitude=ALTITUDE)
    everyone, some = random_start(2, (7,)), random_start(3, (len(rows),))
    simulation.place(np.arange(7), everyone)
    rows = np.array(rows)
    placed = simulation.place(rows, some)
    assert_same(placed, defined(some))
    assert_same(simulation.state, defined(some), rows)
    others = np.setdiff1d(np.arange(7), rows)
    rest = Start(**{name: value[others] for name, value in vars(everyone).items()})
    assert_same(simulation.state, defined(rest), others)
    np.testing.assert_array_equal(simulation.qpos[rows, :3], some.position + [0, 0, ALTITUDE])
    np.testing.assert_array_equal(simulation.qpos[others, 3:], everyone.quaternion[others])


def test_the_state_after_a_step_is_the_definition_of_mujoco_s_coordinates():
    simulation = BatchSimulation(VEHICLE, 9, altitude=ALTITUDE)
    simulation.place(np.arange(9), random_start(4, (9,)))
    for _ in range(2):  # two tables take turns
        simulation.ctrl[:] = 220.0
        simulation.advance()
        assert simulation.read() is None
        now = Start(
            position=simulation.qpos[:, :3] - [0, 0, ALTITUDE],
            quaternion=simulation.qpos[:, 3:],
            velocity=simulation.qvel[:, :3],
            body_rate=simulation.qvel[:, 3:],
            rotor_speed=simulation.act,
        )
        time = simulation.state.time
        assert_same(simulation.state, State.of_coordinates(**vars(now), time=time))


def test_the_last_state_stays_whole_while_the_next_is_read():
    simulation = BatchSimulation(VEHICLE, 3, altitude=ALTITUDE)
    simulation.place(np.arange(3), random_start(5, (3,)))
    before = simulation.state
    kept = {name: np.array(getattr(before, name)) for name in NAMES}
    simulation.advance()
    simulation.read()
    for name in NAMES:
        np.testing.assert_array_equal(getattr(before, name), kept[name], err_msg=name)
    assert not np.array_equal(simulation.state.position, kept["position"])


# ------------------------------------------------------------------------------------- attitude


def test_sines_and_cosines_are_those_of_the_z_y_x_angles():
    quaternion = random_quaternions(np.random.default_rng(6), (5000,))
    sines, cosines = rotation.sin_cos_attitude(rotation.rotation_matrix(quaternion))
    angles = Rotation.from_quat(quaternion, scalar_first=True).as_euler("ZYX")[:, ::-1]
    # Near straight up or down roll and yaw are ill-conditioned, for SciPy and for everybody.
    level = np.abs(angles[:, 1]) < 1.5
    assert level.sum() > 4900
    np.testing.assert_allclose(sines[level], np.sin(angles[level]), atol=1e-12)
    np.testing.assert_allclose(cosines[level], np.cos(angles[level]), atol=1e-12)


def test_rotation_matrix_is_scipy_s():
    quaternion = random_quaternions(np.random.default_rng(7), (100,))
    expected = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation.rotation_matrix(quaternion), expected, atol=1e-14)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
@pytest.mark.parametrize("roll", [0.0, 0.3, -2.0])
@pytest.mark.parametrize("yaw", [0.0, 1.0, -3.0])
def test_straight_up_and_down_the_attitude_stays_bounded(pitch, roll, yaw):
    quaternion = Rotation.from_euler("ZYX", (yaw, pitch, roll)).as_quat(scalar_first=True)
    sines, cosines = rotation.sin_cos_attitude(rotation.rotation_matrix(quaternion))
    assert sines[1] == pytest.approx(math.copysign(1, pitch))
    assert cosines[1] == pytest.approx(0, abs=1e-7)
    assert (np.abs([sines, cosines]) <= 1 + 1e-9).all()


def test_to_body_and_to_world_are_inverse_and_turn_as_scipy_does():
    rng = np.random.default_rng(8)
    quaternion, vector = random_quaternions(rng, (4, 6)), rng.normal(size=(4, 6, 3))
    matrix = rotation.rotation_matrix(quaternion)
    world = rotation.to_world(matrix, vector)
    np.testing.assert_allclose(rotation.to_body(matrix, world), vector, atol=1e-14)
    turned = Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True)
    expected = turned.apply(vector.reshape(-1, 3)).reshape(4, 6, 3)
    np.testing.assert_allclose(world, expected, atol=1e-14)


def test_a_quarter_turn_to_the_left_looks_north():
    # Heading 90 degrees counter-clockwise from east: the nose (body x) points north (world y), the
    # left side west, and a wind to the north is felt from behind: along body x.
    half = math.pi / 4
    matrix = rotation.rotation_matrix(np.array([math.cos(half), 0, 0, math.sin(half)]))
    np.testing.assert_allclose(
        rotation.to_world(matrix, np.array([1.0, 0, 0])), [0, 1, 0], atol=1e-15
    )
    np.testing.assert_allclose(
        rotation.to_world(matrix, np.array([0, 1.0, 0])), [-1, 0, 0], atol=1e-15
    )
    np.testing.assert_allclose(
        rotation.to_body(matrix, np.array([0, 1.0, 0])), [1, 0, 0], atol=1e-15
    )
    sines, cosines = rotation.sin_cos_attitude(matrix)
    np.testing.assert_allclose(sines, [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(cosines, [1, 1, 0], atol=1e-15)


@pytest.mark.parametrize(
    ("command", "angle", "direction"),
    [
        # Quick left rotor: positive roll, right side down, thrust to the right: south at yaw 0.
        ((225, 235, 225, 215), 0, (0, -1)),
        # Quick rear rotor: positive pitch, nose down, thrust ahead: east.
        ((215, 225, 235, 225), 1, (1, 0)),
        # Quick 2 and 4: positive yaw, nose to the left.
        ((215, 235, 215, 235), 2, (0, 0)),
    ],
)
def test_angles_have_the_sign_of_the_flight(command, angle, direction):
    simulation = single_simulation()
    level = Start(
        position=np.zeros(3),
        quaternion=np.array([1.0, 0, 0, 0]),
        velocity=np.zeros(3),
        body_rate=np.zeros(3),
        rotor_speed=np.full(4, 225.0),
    )
    simulation.place(None, level)
    simulation.ctrl[:] = command
    for _ in range(4):
        simulation.advance()
    simulation.read()
    state = simulation.state
    assert state.sin_attitude[angle] > 0.005
    assert np.argmax(np.abs(state.sin_attitude)) == angle
    moved = state.velocity[:2]
    if direction != (0, 0):
        assert moved @ direction > 0.02
        assert np.abs(moved @ (direction[1], -direction[0])) < 0.01 * (moved @ direction)


def test_body_velocity_is_what_the_aircraft_itself_feels():
    # Flying east at 3 m/s, heading north: the motion is to its right, -y of the body.
    simulation = single_simulation()
    simulation.place(
        None,
        Start(
            position=np.zeros(3),
            quaternion=np.array([math.sqrt(0.5), 0, 0, math.sqrt(0.5)]),
            velocity=np.array([3.0, 0, 0]),
            body_rate=np.array([0.1, 0.2, 0.3]),
            rotor_speed=np.full(4, 200.0),
        ),
    )
    np.testing.assert_allclose(simulation.state.body_velocity, [0, -3, 0], atol=1e-14)
    np.testing.assert_array_equal(simulation.state.body_rate, [0.1, 0.2, 0.3])  # body frame already


def test_heading_and_tilt():
    # Heading 0.7, then 0.2 rad about the body's y axis (pi/2 from x): yaw 0.7, pitch 0.2, roll 0.
    args = (np.array(0.7), np.array(0.2), np.array(math.pi / 2))
    quaternion = rotation.quaternion_from_heading_and_tilt(*args)
    angles = Rotation.from_quat(quaternion, scalar_first=True).as_euler("ZYX")
    np.testing.assert_allclose(angles, [0.7, 0.2, 0.0], atol=1e-14)
    # Whatever the axis, the angle to the vertical is the tilt.
    direction = np.linspace(0, 6, 7)
    many = rotation.quaternion_from_heading_and_tilt(np.full(7, 2.0), np.full(7, 0.2), direction)
    upright = rotation.rotation_matrix(many)[:, 2, 2]
    np.testing.assert_allclose(upright, math.cos(0.2), atol=1e-14)


def test_quaternion_product_applies_the_second_first():
    rng = np.random.default_rng(9)
    first, second = random_quaternions(rng, (20,)), random_quaternions(rng, (20,))
    product = rotation.rotation_matrix(rotation.quaternion_product(first, second))
    expected = rotation.rotation_matrix(first) @ rotation.rotation_matrix(second)
    np.testing.assert_allclose(product, expected, atol=1e-14)


def test_norms():
    # 2^2 + 3^2 + 6^2 = 49
    vectors = np.array([[2.0, 3.0, 6.0], [0.0, -3.0, 4.0]])
    np.testing.assert_array_equal(rotation.square_norm(vectors), [49, 25])
    np.testing.assert_array_equal(rotation.norm(vectors), [7, 5])


# ------------------------------------------------------------------------------- other namespaces


@pytest.mark.parametrize("shape", [(), (30,), (2, 3)])
def test_torch_tensors_give_the_same_numbers(shape):
    import torch

    start = random_start(10, shape)
    expected = State.of_coordinates(**vars(start), time=np.zeros(shape))
    tensors = {name: torch.tensor(value) for name, value in vars(start).items()}
    state = State.of_coordinates(**tensors, time=torch.zeros(shape, dtype=torch.float64))
    for name in NAMES:
        got, wanted = getattr(state, name), getattr(expected, name)
        assert isinstance(got, torch.Tensor), name
        assert got.dtype == torch.float64, name
        np.testing.assert_allclose(got.numpy(), wanted, rtol=1e-12, atol=1e-12, err_msg=name)
