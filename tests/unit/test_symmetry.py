"""Symmetries of the physics: they hold for every force that there is and that may come.

A layout is unchanged by some turns and mirror images of the body (their group is searched for, not
listed). Apply one of them to a motion, and any turn about the vertical, shift and drift with the
air to the world: what flies then is the image of what flew before. Forces that break a symmetry
(the ground) do not act where these motions are flown, 100 m up.
"""

import dataclasses
import itertools

import helpers
import numpy as np
import pytest

from quadrl.aircraft.presets import VEHICLES

ENGINES = ("mujoco", "free_flight")
EVERY = VEHICLES | helpers.IN_AIR
COUNT, STEPS = 8, 100
TOLERANCE = 5e-13  # of positions, speeds and rates, as a share of the largest of the motion


@dataclasses.dataclass(frozen=True)
class Image:
    """What is done to a motion: rotation R becomes world R body^T."""

    world: np.ndarray  # (3, 3), leaves the vertical alone
    body: np.ndarray  # (3, 3), maps the rotors onto each other
    order: np.ndarray  # (R,): rotor k of the image is rotor order[k] of the original

    def vectors(self, v):
        """(n, 3) in the world: positions, velocities, winds."""
        return v @ self.world.T

    def rates(self, omega):
        """(n, 3), axial, in the body frame: a mirror image turns the other way."""
        return np.linalg.det(self.body) * omega @ self.body.T

    def quaternions(self, q):
        """(n, 4)."""
        return helpers.quaternions(self.world @ helpers.matrices(q) @ self.body.T)


def turn(angle):
    """About the vertical."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


MIRROR = np.diag([1.0, -1.0, 1.0])


def order_of(vehicle, body):
    """How a turn or mirror image of the body permutes the rotors; None if it is no symmetry."""
    rotors = vehicle.rotors
    order = []
    for image in rotors:  # which rotor comes to stand here?
        for k, rotor in enumerate(rotors):
            there = [body @ np.array(x) for x in (rotor.position, rotor.axis)]
            if not np.allclose(there, (image.position, image.axis), rtol=0, atol=1e-9):
                continue
            moved = dataclasses.replace(
                rotor,
                position=image.position,
                axis=image.axis,
                spin=rotor.spin * helpers.sign(body),
            )
            if moved == image:
                order.append(k)
                break
        else:
            return None
    inertia = np.diag(vehicle.inertia)
    if not np.allclose(body @ inertia @ body.T, inertia, rtol=1e-9):
        return None
    return np.array(order)


def symmetries(vehicle):
    """Every turn and mirror image (body, order) of a layout but the identity."""
    turns = [turn(k * np.pi / 12) for k in range(24)]
    found = {}
    for k, (rotation, mirror) in enumerate(itertools.product(turns, (np.eye(3), MIRROR))):
        body = np.round(rotation @ mirror, 15)
        if k and (order := order_of(vehicle, body)) is not None:
            name = f"{'mirror' if k % 2 else 'turn'} {k // 2 * 15}"
            found[name] = body, order
    return found


def motion(vehicle, seed=0):
    """Vigorous random flights with a command for each half, in wind."""
    return helpers.random_motion(vehicle, COUNT, seed, speed=4.0, turn=6.0, wind=5.0)


def assert_image(vehicle, engine, image, *, shift=(0, 0, 0), drift=(0, 0, 0)):
    """Fly a motion and its image, which starts elsewhere and is carried along by all the air."""
    original = motion(vehicle)
    moved = helpers.Motion(
        position=image.vectors(original.position) + shift,
        quaternion=image.quaternions(original.quaternion),
        velocity=image.vectors(original.velocity) + drift,
        body_rate=image.rates(original.body_rate),
        rotor_speed=original.rotor_speed[:, image.order],
        wind=image.vectors(original.wind) + drift,
    )
    commands = helpers.random_commands(vehicle, COUNT, 2)
    flown = helpers.flown(vehicle, engine, original, commands, STEPS // 2)
    other = helpers.flown(vehicle, engine, moved, commands[:, :, image.order], STEPS // 2)
    seconds = STEPS * vehicle.physics_timestep
    expected = {
        "position": image.vectors(flown.position) + shift + np.multiply(drift, seconds),
        "attitude": image.world @ helpers.matrices(flown.quaternion) @ image.body.T,
        "velocity": image.vectors(flown.velocity) + drift,
        "body_rate": image.rates(flown.body_rate),
        "rotor_speed": flown.rotor_speed[:, image.order],
    }
    got = vars(other) | {"attitude": helpers.matrices(other.quaternion)}
    for name, value in expected.items():
        atol = TOLERANCE * max(1.0, np.abs(value).max())
        np.testing.assert_allclose(got[name], value, rtol=0, atol=atol, err_msg=name)
    # They have moved and turned, by more than any tolerance.
    assert np.abs(flown.position - original.position).max() > 1
    assert np.abs(flown.body_rate - original.body_rate).max() > 1


def identity(vehicle, world=None):
    return Image(np.eye(3) if world is None else world, np.eye(3), np.arange(vehicle.rotor_count))


every = pytest.mark.parametrize(
    ("engine", "name"), [(engine, name) for engine in ENGINES for name in EVERY]
)


@every
@pytest.mark.parametrize("angle", [0.7, -1.9])
def test_a_turn_about_the_vertical_turns_the_flight(engine, name, angle):
    vehicle = EVERY[name]
    assert_image(vehicle, engine, identity(vehicle, turn(angle)))


@every
def test_a_flight_elsewhere_is_the_same_flight(engine, name):
    vehicle = EVERY[name]
    assert_image(vehicle, engine, identity(vehicle), shift=(12.0, -7.0, 0.0))
    assert_image(vehicle, engine, identity(vehicle), shift=(0.0, 0.0, 9.0))


@every
def test_a_flight_in_air_that_drifts_drifts_with_it(engine, name):
    vehicle = EVERY[name]
    assert_image(vehicle, engine, identity(vehicle), drift=(1.5, -2.0, 0.8))


CASES = [
    (engine, name, symmetry)
    for engine, name in itertools.product(ENGINES, EVERY)
    for symmetry in symmetries(EVERY[name])
]


@pytest.mark.parametrize(("engine", "name", "symmetry"), CASES)
def test_a_symmetry_of_the_layout_is_one_of_its_flights(engine, name, symmetry):
    """And the image may head anywhere: the world is turned on."""
    vehicle = EVERY[name]
    body, order = symmetries(vehicle)[symmetry]
    assert_image(vehicle, engine, Image(turn(0.4) @ body, body, order))


def test_the_layouts_have_the_symmetries_that_one_sees():
    # Plus, spins + - + -: half a turn, and mirrors between the arms (45 and 135 degrees from x),
    # where they map + arms onto - arms. (`mirror a` is that in the line at a / 2.)
    assert symmetries(VEHICLES["paper"]).keys() == {"turn 180", "mirror 90", "mirror 270"}
    # X: half a turn, and mirrors in x and y.
    four = {"turn 180", "mirror 0", "mirror 180"}
    assert symmetries(VEHICLES["crazyflie"]).keys() == four
    assert symmetries(VEHICLES["racer"]).keys() == four
    # Six rotors, at 30, 90, ... degrees, + - + - + -: half a turn maps + onto -. The mirror in x
    # maps 30 (+) onto 330 (-). A third of a turn would do, but for J_x, which is not J_y.
    assert symmetries(VEHICLES["hexa"]).keys() == {"mirror 0"}
    round_one = dataclasses.replace(VEHICLES["hexa"], inertia=(0.04, 0.04, 0.07))
    thirds = {f"turn {a}" for a in (120, 240)} | {f"mirror {a}" for a in (0, 120, 240)}
    assert symmetries(round_one).keys() == thirds


@pytest.mark.parametrize("engine", ENGINES)
def test_an_aircraft_of_six_that_is_round_has_thirds(engine):
    vehicle = dataclasses.replace(VEHICLES["hexa"], inertia=(0.04, 0.04, 0.07))
    for body, order in symmetries(vehicle).values():
        assert_image(vehicle, engine, Image(body, body, order))
