"""The state by name: the C kernel, its definition, the conventions of angles and frames."""

import dataclasses
import math

import helpers
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadrl.aircraft.presets import VEHICLES
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
