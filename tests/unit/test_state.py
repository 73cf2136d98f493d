"""The state by name: the C kernel, its definition, the conventions of angles and frames."""

import dataclasses
import math

import helpers
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base import rotation
from quadrl.engines.mujoco import BatchEngine
from quadrl.engines.state import Start, State

NAMES = [field.name for field in dataclasses.fields(State)]
ALTITUDE = 3.0
# Its step resolves every rate of `random_start`.
FINE = {n: dataclasses.replace(VEHICLES[n], physics_timestep=5e-5) for n in ("paper", "hexa")}
PAPER = FINE["paper"]


def random_start(seed, count, rotors=4):
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-3, 3, (count, 1))  # small and large numbers
    return Start(
        position=rng.normal(size=(count, 3)) * scale,
        quaternion=helpers.random_quaternions(rng, count),
        velocity=rng.normal(size=(count, 3)) * scale,
        body_rate=rng.normal(size=(count, 3)) * scale,
        rotor_speed=rng.uniform(0, 319, (count, rotors)),
    )


def fields(record):
    return {name: getattr(record, name) for name in type(record).__dataclass_fields__}


def defined(start):
    """The state of a start by the definition, rounded by the way through the world's frame."""
    origin = np.array([0, 0, ALTITUDE])
    position = (start.position + origin) - origin
    given = fields(start) | {"position": position}
    return State.of_coordinates(**given, origin_height=ALTITUDE)


def assert_same(state, expected, rows=slice(None)):
    for name in NAMES:
        got, wanted = np.asarray(getattr(state, name))[rows], np.asarray(getattr(expected, name))
        np.testing.assert_array_equal(got, wanted, err_msg=name)
        assert got.shape == wanted.shape, name


def batch(count, vehicle=PAPER):
    return BatchEngine(vehicle, count, altitude=ALTITUDE)


# ------------------------------------------------------------------- the kernel is the definition


@pytest.mark.parametrize("name", FINE)
def test_the_kernel_is_the_definition_bit_by_bit(name):
    vehicle = FINE[name]
    engine, start = batch(2000, vehicle), random_start(0, 2000, vehicle.rotor_count)
    placed = engine.place(np.arange(2000), start)
    assert_same(placed, defined(start))
    assert_same(engine.state, defined(start))
    assert engine.state.rotation.shape == (2000, 3, 3)
    assert engine.state.rotor_speed.shape == (2000, vehicle.rotor_count)
    # The height is over the ground; on its feet it is that of the centre.
    np.testing.assert_allclose(placed.height, placed.position[:, 2] + ALTITUDE, rtol=1e-12)


def test_the_kernel_straight_up_is_the_definition_bit_by_bit():
    # Nose straight up or down: the x axis has no level part at all, 0 in every digit.
    vertical = np.array([[0.5, 0.5, 0.5, -0.5], [0.5, -0.5, -0.5, -0.5]])
    # And so nearly that the least level part of 1e-9 is above theirs, and below.
    near = [(0.3, math.pi / 2 - off, 0.2) for off in (3e-10, 3e-9)]
    near = Rotation.from_euler("ZYX", near).as_quat(scalar_first=True)
    start = dataclasses.replace(random_start(12, 4), quaternion=np.concatenate([vertical, near]))
    placed = batch(4).place(np.arange(4), start)
    assert_same(placed, defined(start))
    np.testing.assert_array_equal(placed.sin_attitude[:2], [[0, 1, 0], [0, -1, 0]])
    np.testing.assert_array_equal(placed.cos_attitude[:2], 0)


@pytest.mark.parametrize("rows", [[0], [6], [1, 4, 5], list(range(7)), []])
def test_placing_some_rows_leaves_the_others(rows):
    engine, everyone = batch(7), random_start(2, 7)
    engine.place(np.arange(7), everyone)
    rows, some = np.array(rows, dtype=np.int64), random_start(3, len(rows))
    assert_same(engine.place(rows, some), defined(some))
    assert_same(engine.state, defined(some), rows)
    others = np.setdiff1d(np.arange(7), rows)
    rest = Start(**{name: value[others] for name, value in fields(everyone).items()})
    assert_same(engine.state, defined(rest), others)
    np.testing.assert_array_equal(engine.qpos[rows, :3], some.position + [0, 0, ALTITUDE])
    np.testing.assert_array_equal(engine.qpos[others, 3:], everyone.quaternion[others])


def test_the_state_after_a_step_is_that_of_the_coordinates_and_the_last_one_stays_whole():
    engine = batch(9)
    engine.place(np.arange(9), random_start(4, 9))
    for _ in range(2):  # two tables take turns
        before = engine.state
        kept = {name: np.array(getattr(before, name)) for name in NAMES}
        engine.ctrl[:] = 220.0
        engine.advance(5)
        assert engine.read() is None
        now = Start(
            position=engine.qpos[:, :3] - [0, 0, ALTITUDE],
            quaternion=engine.qpos[:, 3:],
            velocity=engine.qvel[:, :3],
            body_rate=engine.qvel[:, 3:],
            rotor_speed=engine.act,
        )
        assert_same(engine.state, State.of_coordinates(**fields(now), origin_height=ALTITUDE))
        for name in NAMES:
            np.testing.assert_array_equal(getattr(before, name), kept[name], err_msg=name)
        assert not np.array_equal(engine.state.position, kept["position"])


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_tensors_give_the_same_numbers_and_keep_their_precision(precision):
    import torch

    dtype = getattr(torch, precision)
    start = random_start(10, 30)
    expected = State.of_coordinates(**fields(start), origin_height=ALTITUDE)
    tensors = {name: torch.tensor(value, dtype=dtype) for name, value in fields(start).items()}
    state = State.of_coordinates(**tensors, origin_height=ALTITUDE)
    tolerance = 1e-12 if dtype == torch.float64 else 1e-3
    for name in NAMES:
        got, wanted = getattr(state, name), getattr(expected, name)
        assert got.dtype == dtype, name
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(got, wanted, rtol=0, atol=tolerance * scale, err_msg=name)


def test_the_errors_of_the_attitude_by_hand():
    # Roll 90 degrees: |sin| + |cos - 1| of (roll, pitch) = |(1, 0)| + |(-1, 0)| = 2. Yaw 180
    # degrees: level, but against east |(0, 0, 0)| + |(0, 0, -2)| = 2.
    half = math.sqrt(0.5)
    level = helpers.level(3)
    start = dataclasses.replace(
        level, quaternion=np.array([[1.0, 0, 0, 0], [half, half, 0, 0], [0, 0, 0, 1.0]])
    )
    placed = batch(3).place(np.arange(3), start)
    np.testing.assert_allclose(placed.level_error, [0, 2, 0], atol=1e-7)
    np.testing.assert_allclose(placed.east_error, [0, 2, 2], atol=1e-7)
    np.testing.assert_allclose(placed.cos_tilt, [1, 0, 1], atol=1e-15)
    np.testing.assert_array_equal(placed.at_rest, True)


# -------------------------------------------------------------------------------- what is refused


def test_a_start_that_the_step_does_not_resolve_is_refused():
    engine = BatchEngine(Vehicle(), 2, altitude=ALTITUDE)
    rows, level = np.array([1]), helpers.level(1)
    fast = dataclasses.replace(level, body_rate=np.array([[0, 0, 50.0]]))
    engine.place(rows, fast)
    assert engine.state.angular_speed[1] == 50.0
    # |omega| dt is at most 0.5; 2 k_D |v| dt / m at most 1: 3611 m/s.
    for name, value, limit in (
        ("body_rate", [0, 0, 51.0], "50"),
        ("velocity", [3700.0, 0, 0], "3611"),
        ("rotor_speed", [1e10] * 4, "1e+10"),  # though it comes after the others
        ("quaternion", [np.nan, 0, 0, 1], "finite"),
        ("position", [0, 0, np.inf], "finite"),
    ):
        start = dataclasses.replace(fast, **{name: np.array([value], dtype=float)})
        with helpers.refused(lists=limit, match=f"^{name}") as caught:
            engine.place(rows, start)
        np.testing.assert_array_equal(caught.value.value, [value])


# ------------------------------------------------------------------------------------- attitude


def test_sines_and_cosines_are_those_of_the_z_y_x_angles():
    quaternion = helpers.random_quaternions(np.random.default_rng(6), 5000)
    sines, cosines = rotation.sin_cos_attitude(rotation.rotation_matrix(quaternion))
    angles = Rotation.from_quat(quaternion, scalar_first=True).as_euler("ZYX")[:, ::-1]
    # Near straight up or down roll and yaw are ill-conditioned, for SciPy and for everybody.
    level = np.abs(angles[:, 1]) < 1.5
    assert level.sum() > 4900
    np.testing.assert_allclose(sines[level], np.sin(angles[level]), atol=1e-12)
    np.testing.assert_allclose(cosines[level], np.cos(angles[level]), atol=1e-12)


def test_rotations_are_scipys_and_inverse_to_each_other():
    rng = np.random.default_rng(8)
    first = helpers.random_quaternions(rng, 24)
    vector = rng.normal(size=(24, 3))
    matrix = rotation.rotation_matrix(first)
    turned = Rotation.from_quat(first, scalar_first=True)
    np.testing.assert_allclose(matrix, turned.as_matrix(), atol=1e-14)
    world = rotation.to_world(matrix, vector)
    np.testing.assert_allclose(world, turned.apply(vector), atol=1e-14)
    np.testing.assert_allclose(rotation.to_body(matrix, world), vector, atol=1e-14)
    # 2^2 + 3^2 + 6^2 = 49
    vectors = np.array([[2.0, 3.0, 6.0], [0.0, -3.0, 4.0]])
    np.testing.assert_array_equal(rotation.square_norm(vectors), [49, 25])
    np.testing.assert_array_equal(rotation.norm(vectors), [7, 5])


def test_tensors_of_length_zero_have_a_gradient():
    import torch

    # Of (3, 4): (3, 4) / 5; of (0, 0): zero, where the root's own would be 0 * inf.
    vectors = torch.tensor([[3.0, 4.0], [0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    rotation.norm(vectors).sum().backward()
    np.testing.assert_allclose(vectors.grad, [[0.6, 0.8], [0, 0]])


def test_heading_and_tilt():
    # Heading 0.7, then 0.2 rad about the body's y axis (pi/2 from x): yaw 0.7, pitch 0.2, roll 0.
    given = (np.array([x]) for x in (0.7, 0.2, math.pi / 2))
    quaternion = rotation.quaternion_from_heading_and_tilt(*given)
    angles = Rotation.from_quat(quaternion, scalar_first=True).as_euler("ZYX")
    np.testing.assert_allclose(angles, [[0.7, 0.2, 0.0]], atol=1e-14)
    # Whatever the axis, the angle to the vertical is the tilt.
    direction = np.linspace(0, 6, 7)
    many = rotation.quaternion_from_heading_and_tilt(np.full(7, 2.0), np.full(7, 0.2), direction)
    upright = rotation.rotation_matrix(many)[:, 2, 2]
    np.testing.assert_allclose(upright, math.cos(0.2), atol=1e-14)
