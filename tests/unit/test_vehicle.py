"""The aircraft: its numbers, what follows from them, and what no aircraft can be."""

import dataclasses
import math

import numpy as np
import pytest
from helpers import refused

from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.rotors import PAPER_ROTORS, ring
from quadrl.aircraft.specification import resolve
from quadrl.aircraft.vehicle import Vehicle

PAPER = Vehicle()


LEANING = (math.sin(math.radians(5)), 0.0, math.cos(math.radians(5)))


def rotors(**changed):
    """The paper's rotors with some numbers changed in all."""
    return tuple(dataclasses.replace(rotor, **changed) for rotor in PAPER_ROTORS)


def ringed(bearings, spins, radius=0.23):
    """Rotors of the paper's numbers at other places."""
    paper = dataclasses.asdict(PAPER_ROTORS[0])
    kept = {name: paper[name] for name in paper if name not in ("position", "spin", "axis")}
    return ring(bearings, spins, radius, **kept)


def placed(*positions):
    """The paper's rotors moved to other points (x, y) of the plane."""
    return tuple(
        dataclasses.replace(rotor, position=(*point, 0.0))
        for rotor, point in zip(PAPER_ROTORS, positions, strict=True)
    )


# -------------------------------------------------------------------------------- what follows


def test_the_default_is_the_aircraft_of_the_paper():
    # sqrt(0.65 * 9.81 / (4 * 3.13e-5)) = sqrt(50930.5) = 225.678, times sqrt(2) = 319.157.
    assert VEHICLES["paper"] == resolve(None) == resolve("paper") == PAPER
    np.testing.assert_allclose(PAPER.hover_speed, 225.678, atol=5e-4)
    np.testing.assert_allclose(PAPER.max_speed, 319.157, atol=5e-4)
    assert (PAPER.rotor_count, PAPER.substeps, PAPER.size, PAPER.scale) == (4, 5, 0.23, 1.0)
    positions = [(0.23, 0, 0), (0, 0.23, 0), (-0.23, 0, 0), (0, -0.23, 0)]
    assert [rotor.position for rotor in PAPER.rotors] == positions
    assert [rotor.spin for rotor in PAPER.rotors] == [1, -1, 1, -1]


def test_the_mixer_is_equation_7():
    # l k_T = 0.23 * 3.13e-5 = 7.199e-6.
    moments = [[0, 7.199e-6, 0, -7.199e-6], [-7.199e-6, 0, 7.199e-6, 0]]
    yaw = np.array([-1, 1, -1, 1]) * 7.5e-7
    np.testing.assert_allclose(PAPER.mixer, [[3.13e-5] * 4, *moments, yaw], rtol=1e-14, atol=0)


def test_the_layout_says_which_way_each_rotor_lifts_and_turns():
    # The signs of equation 7.
    signs = [[1, 1, 1, 1], [0, 1, 0, -1], [-1, 0, 1, 0], [-1, 1, -1, 1]]
    np.testing.assert_array_equal(PAPER.layout, signs)


@pytest.mark.parametrize("name", VEHICLES)
def test_every_preset_hovers_without_turning(name):
    vehicle = VEHICLES[name]
    wrench = vehicle.mixer @ vehicle.hover_speed**2
    scale = np.abs(vehicle.mixer) @ vehicle.hover_speed**2
    np.testing.assert_allclose(wrench / scale, [1, 0, 0, 0], atol=1e-12)
    assert wrench[0] == pytest.approx(vehicle.mass * 9.81, rel=1e-12)
    assert (vehicle.hover_speed + vehicle.action_scale * 0.5 < vehicle.max_speed).all()


@pytest.mark.parametrize(
    ("name", "places"),
    [
        # Crazyflie: 1 ahead on the right, counter-clockwise, and so on clockwise.
        ("crazyflie", [(1, -1, 1), (-1, -1, -1), (-1, 1, 1), (1, 1, -1)]),
        # Betaflight: 1 behind on the right, clockwise; 2 ahead of it; 3 and 4 on the left.
        ("racer", [(-1, -1, -1), (1, -1, 1), (-1, 1, 1), (1, 1, -1)]),
    ],
)
def test_motors_are_numbered_as_the_autopilot_does(name, places):
    rotors = VEHICLES[name].rotors
    assert [(*np.sign(rotor.position[:2]), rotor.spin) for rotor in rotors] == places


def test_what_the_physics_step_resolves():
    # 2 k_D v dt / m = 1 at 0.65 / (2 * 9e-3 * 0.01) = 3611.11 m/s; |omega| dt = 0.5 at 50 rad/s,
    # before 2 k_M omega dt / J = 1 at 7.5e-3 / (2 * 9e-4 * 0.01) = 416.7 rad/s.
    assert PAPER.resolved_speed == pytest.approx(3611.11, abs=0.01)
    assert PAPER.resolved_turn == pytest.approx(50.0)
    assert Vehicle(moment_coefficient=0.1, physics_timestep=0.005).resolved_turn == 7.5
    free = Vehicle(drag_coefficient=0.0, moment_coefficient=0.0)
    assert (free.resolved_turn, free.resolved_speed) == (50.0, 1e10)


def test_rotor_command_by_worked_numbers():
    hover = 225.678
    # 225.678 + 35 a; 35 * 0.2 = 7. Beyond +-1 the action is clipped.
    action = np.array([[0.0, 1.0, -1.0, 0.2], [2.0, -7.0, -0.2, 1e300]])
    expected = [[hover, hover + 35, hover - 35, hover + 7], [hover + 35, hover - 35, hover - 7]]
    expected[1].append(hover + 35)
    np.testing.assert_allclose(PAPER.rotor_command(action), expected, atol=5e-4)
    # 225.678 +- 300 is clipped to 0 and to 319.157; +- 90 to 315.678 and 135.678.
    strong = Vehicle(action_scale=300.0)
    command = strong.rotor_command(np.array([[-1.0, 1.0, 0.3, -0.3]]))
    np.testing.assert_allclose(command, [[0, 319.157, 315.678, 135.678]], atol=5e-4)
    assert command[0, 0] == 0.0 and command[0, 1] == strong.max_speed[1]


# ------------------------------------------------------------------------------ what is refused


NOT_NUMBERS = (0.0, -1.0, math.nan, math.inf, -math.inf, None, "1", True)


@pytest.mark.parametrize("field", ["mass", "action_scale", "physics_timestep", "control_timestep"])
@pytest.mark.parametrize("value", NOT_NUMBERS)
def test_a_parameter_that_no_aircraft_has_is_refused_by_name(field, value):
    with refused(field, value):
        Vehicle(**{field: value})


@pytest.mark.parametrize(
    "field",
    ["thrust_coefficient", "torque_coefficient", "lag_up", "lag_down", "max_speed", "radius"],
)
@pytest.mark.parametrize("value", NOT_NUMBERS)
def test_a_number_that_no_rotor_has_is_refused_by_name(field, value):
    with refused(f"rotor {field}", value):
        rotors(**{field: value})


@pytest.mark.parametrize("field", ["drag_coefficient", "moment_coefficient"])
def test_drag_may_be_zero_and_nothing_less(field):
    assert getattr(Vehicle(**{field: 0}), field) == 0.0
    for value in (-1e-9, math.nan, math.inf):
        with refused(field):
            Vehicle(**{field: value})


J = 7.5e-3
BAD = [  # parameters, name, value (... for any)
    # No body has one moment above the sum of the others; a flat plate has it equal.
    (dict(inertia=(J, J, 1.6e-2)), "inertia", (J, J, 1.6e-2)),
    (dict(inertia=(J, J)), "inertia", (J, J)),
    (dict(inertia=0.1), "inertia", 0.1),
    (dict(inertia=(0.0, J, J)), "inertia[0]", 0.0),
    (dict(dead_time=0.015), "dead_time", 0.015),
    (dict(dead_time=-0.01), "dead_time", -0.01),
    (dict(dead_time="late"), "dead_time", "late"),
    (dict(name=5), "name", 5),
    # 2 k_M |omega| dt / J = 1 at 7.5e-3 / (2 * 0.1 * 0.01) = 3.75 rad/s: not a turn a second.
    (dict(moment_coefficient=0.1), "physics_timestep", 0.01),
    # 2 k_D |v| dt / m = 1 at 0.65 / (2 * 200 * 0.01) = 0.1625 m/s; it falls at 0.179 m/s.
    (dict(drag_coefficient=200.0), "physics_timestep", 0.01),
    # Past 2.785 the Runge-Kutta method is unstable; at 2 it is off by 0.2 rad/s.
    (dict(rotors=rotors(lag_up=101.0)), "physics_timestep", 0.01),
    (dict(rotors=rotors(lag_down=101.0)), "physics_timestep", 0.01),
    (dict(control_timestep=0.055), "control_timestep", 0.055),
    (dict(control_timestep=0.005), "control_timestep", 0.005),
    (dict(physics_timestep=1e-6), "control_timestep", 0.05),  # 50,000 physics steps
    # Rotors.
    (dict(rotors=PAPER_ROTORS[:3]), "number of rotors", 3),
    (dict(rotors=ringed(range(0, 360, 40), [1, -1] * 4 + [1])), "number of rotors", 9),
    (dict(rotors=None), "rotors", None),
    (dict(rotors=[(0.23, 0, 0)] * 4), "rotors", [(0.23, 0, 0)] * 4),
    (dict(rotors=rotors(spin=1)), "rotor spins", [1.0] * 4),
    # All on the x axis: no roll. All behind the centre: no hover.
    (dict(rotors=placed((0.2, 0), (0.1, 0), (-0.1, 0), (-0.2, 0))), "rotor positions", ...),
    (dict(rotors=placed((-0.1, 0.2), (-0.3, 0.2), (-0.1, -0.2), (-0.3, -0.2))), ..., ...),
    # Spins 1, 1, -1, -1 around an X: yaw is a multiple of pitch, so one of them is not free; with
    # other spins at the same places it is.
    (dict(rotors=ringed((45, 315, 135, 225), (1, 1, -1, -1))), "rotor spins", [1.0, 1, -1, -1]),
    # A plus moved ahead by more than its arm would need a negative thrust to hover.
    (dict(rotors=placed((0.5, 0), (0.3, 0.2), (-0.01, 0), (0.3, -0.2))), "rotor positions", ...),
    # All lean ahead by 5 degrees: whoever hovers level flies off.
    (dict(rotors=rotors(axis=LEANING)), "rotor axes", [LEANING] * 4),
    (dict(rotors=placed((1e-6, 0), (0, 1e-6), (-1e-6, 0), (0, -1e-6))), ..., 1e-6),
    # Hover needs 225.678 rad/s of each.
    (dict(rotors=rotors(max_speed=225.0)), ..., 225.0),
    (dict(mass=1.31), ..., ...),  # more than twice the paper's
]


@pytest.mark.parametrize(("parameters", "name", "value"), BAD)
def test_an_aircraft_that_cannot_be_is_refused(parameters, name, value):
    with refused(None if name is ... else name, value) as caught:
        Vehicle(**parameters)
    assert name is not ... or "rotor" in caught.value.name
    assert caught.value.allowed in str(caught.value)


@pytest.mark.parametrize(
    ("changed", "name"),
    [
        (dict(spin=0), "rotor spin"),
        (dict(spin=2), "rotor spin"),
        (dict(axis=(0, 0, 2)), "rotor axis"),
        (dict(axis=(0, 1)), "rotor axis"),
        (dict(position=(1, 2)), "rotor position"),
        (dict(position=(math.inf, 0, 0)), "rotor position[0]"),
    ],
)
def test_a_rotor_that_cannot_be_is_refused(changed, name):
    with refused(name):
        rotors(**changed)


def test_what_is_just_allowed():
    assert Vehicle(dead_time=0.03).dead_time == 0.03 and Vehicle().dead_time == 0
    assert Vehicle(inertia=(0.1, 0.2, 0.1 + 0.2)).inertia[2] == pytest.approx(0.3)
    assert Vehicle(rotors=rotors(lag_up=100.0)).rotors[0].lag_up == 100.0
    assert Vehicle(rotors=ringed(range(0, 360, 45), [1, -1] * 4)).rotor_count == 8
    assert Vehicle(rotors=ringed(range(0, 360, 72), [1, -1, 1, -1, 1])).rotor_count == 5
    finer = Vehicle(rotors=rotors(lag_up=1000.0), physics_timestep=0.001)
    assert finer.substeps == 50
