"""The aircraft: parameters, models and what an action asks of the rotors."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadrl.vehicle import VEHICLES, Vehicle, VehicleError

OTHER = Vehicle(
    name="other",
    mass=0.9,
    arm_length=0.05,
    inertia=(4e-3, 5e-3, 8e-3),
    thrust_coefficient=4e-5,
    torque_coefficient=1e-6,
    drag_coefficient=2e-2,
    moment_coefficient=3e-3,
    lag_rate=9.0,
    rotor_radius=0.02,
    max_thrust_ratio=2.25,
    action_scale=50.0,
    physics_step=0.002,
    control_step=0.02,
)


# ------------------------------------------------------------------------------------ parameters


def test_the_default_is_the_aircraft_of_the_paper():
    # MODEL.md: sqrt(0.65 * 9.81 / (4 * 3.13e-5)) = sqrt(50930.5) = 225.678, times sqrt(2).
    paper = VEHICLES["paper"]
    assert paper == Vehicle()
    assert paper.hover_speed == pytest.approx(225.678, abs=5e-4)
    assert paper.max_speed == pytest.approx(319.157, abs=5e-4)
    assert paper.substeps == 5
    assert (paper.mass, paper.arm_length, paper.inertia) == (0.65, 0.23, (7.5e-3, 7.5e-3, 1.3e-2))
    assert (paper.thrust_coefficient, paper.torque_coefficient) == (3.13e-5, 7.5e-7)
    assert (paper.drag_coefficient, paper.moment_coefficient) == (9e-3, 9e-4)
    assert paper.lag_rate == 1 / 0.18


@pytest.mark.parametrize(
    "field",
    [
        "mass",
        "arm_length",
        "thrust_coefficient",
        "torque_coefficient",
        "lag_rate",
        "rotor_radius",
        "max_thrust_ratio",
        "action_scale",
        "physics_step",
        "control_step",
    ],
)
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, -math.inf])
def test_a_parameter_that_no_aircraft_has_is_refused_by_name(field, value):
    with pytest.raises(VehicleError, match=f"^{field} = "):
        Vehicle(**{field: value})


@pytest.mark.parametrize("field", ["drag_coefficient", "moment_coefficient"])
def test_drag_may_be_zero_and_nothing_less(field):
    assert getattr(Vehicle(**{field: 0.0}), field) == 0.0
    for value in (-1e-9, math.nan, math.inf):
        with pytest.raises(VehicleError, match=f"^{field} = "):
            Vehicle(**{field: value})


@pytest.mark.parametrize(
    "inertia",
    [
        (7.5e-3, 7.5e-3, 1.6e-2),  # no body has one moment above the sum of the others
        (7.5e-3, 7.5e-3),
        (7.5e-3, 7.5e-3, 7.5e-3, 7.5e-3),
        (0.0, 7.5e-3, 7.5e-3),
        (-7.5e-3, 7.5e-3, 7.5e-3),
        (math.nan, 7.5e-3, 7.5e-3),
        (math.inf, 7.5e-3, 7.5e-3),
    ],
)
def test_an_inertia_that_no_body_has_is_refused(inertia):
    with pytest.raises(VehicleError, match="^inertia = "):
        Vehicle(inertia=inertia)


def test_a_flat_plate_is_a_body():
    assert Vehicle(inertia=(0.1, 0.2, 0.1 + 0.2)).inertia[2] == pytest.approx(0.3)


def test_an_aircraft_that_cannot_climb_is_refused():
    with pytest.raises(VehicleError, match="max_thrust_ratio = 1.0"):
        Vehicle(max_thrust_ratio=1.0)


@pytest.mark.parametrize(
    ("physics_step", "control_step"), [(0.01, 0.055), (0.01, 0.005), (0.03, 0.05), (0.01, 0.0501)]
)
def test_a_control_step_that_is_no_multiple_is_refused(physics_step, control_step):
    with pytest.raises(VehicleError, match=f"control_step = {control_step} s is no whole number"):
        Vehicle(physics_step=physics_step, control_step=control_step)


@pytest.mark.parametrize(
    ("physics_step", "control_step", "substeps"),
    [(0.01, 0.01, 1), (0.0025, 0.05, 20), (0.05, 0.15, 3), (1 / 240, 1 / 48, 5)],
)
def test_substeps(physics_step, control_step, substeps):
    assert Vehicle(physics_step=physics_step, control_step=control_step).substeps == substeps


# ---------------------------------------------------------------------------------------- actions


def test_rotor_command_by_worked_numbers():
    hover = 225.678
    # 225.678 + 35 a; 35 * 0.2 = 7. Beyond +-1 the action is clipped.
    action = np.array([[0.0, 1.0, -1.0, 0.2], [2.0, -7.0, -0.2, 1e300]])
    expected = [
        [hover, hover + 35, hover - 35, hover + 7],
        [hover + 35, hover - 35, hover - 7, hover + 35],
    ]
    np.testing.assert_allclose(Vehicle().rotor_command(action), expected, atol=5e-4)
    np.testing.assert_allclose(Vehicle().rotor_command(action[0]), expected[0], atol=5e-4)


def test_rotor_command_stays_within_what_the_rotors_can_do():
    # 225.678 +- 300 is clipped to 0 and to 319.157; +- 90 to 315.678 and 135.678.
    strong = Vehicle(action_scale=300.0)
    command = strong.rotor_command(np.array([-1.0, 1.0, 0.3, -0.3]))
    np.testing.assert_allclose(command, [0, 319.157, 315.678, 135.678], atol=5e-4)
    assert command[0] == 0.0
    assert command[1] == strong.max_speed


# ----------------------------------------------------------------------------------------- models


@pytest.mark.parametrize("lean", [False, True])
def test_the_parameters_stand_in_the_model(lean):
    model = OTHER.compile_lean() if lean else OTHER.compile()
    body = model.body("aircraft")
    assert body.mass == 0.9
    np.testing.assert_array_equal(body.inertia, [4e-3, 5e-3, 8e-3])
    np.testing.assert_array_equal(body.ipos, 0)
    np.testing.assert_array_equal(body.user[1:], [2e-2, 3e-3])
    assert (model.nq, model.nv, model.nu, model.na) == (7, 6, 4, 4)
    np.testing.assert_array_equal(model.actuator_dynprm[:, 0], 9.0)
    np.testing.assert_array_equal(model.actuator_gainprm[:, 0], 4e-5)
    # Reaction k_Q / k_T = 1e-6 / 4e-5 = 0.025.
    gear = [[0, 0, 1, 0, 0, sign * (1e-6 / 4e-5)] for sign in (-1, 1, -1, 1)]
    np.testing.assert_array_equal(model.actuator_gear, gear)
    arms = [[0.05, 0, 0], [0, 0.05, 0], [-0.05, 0, 0], [0, -0.05, 0]]
    np.testing.assert_array_equal(model.site_pos[model.actuator_trnid[:, 0]], arms)
    # sqrt(0.9 * 9.81 / 1.6e-4) = 234.907, times sqrt(2.25) = 352.361.
    np.testing.assert_allclose(model.actuator_ctrlrange, [[0, 352.361]] * 4, atol=1e-3)
    assert model.opt.timestep == 0.002
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    np.testing.assert_array_equal(model.opt.gravity, [0, 0, -9.81])
    assert model.opt.density == model.opt.viscosity == 0  # the drag is equation 8's, and only that


def fly(model, seed, start_height):
    """States of 200 physics steps with random commands, and how many contacts there were."""
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    data.qpos[:] = (0, 0, start_height, 1, 0.1, -0.05, 0.2)
    data.qpos[3:] /= np.linalg.norm(data.qpos[3:])
    data.qvel[:] = rng.uniform(-1, 1, 6)
    data.act[:] = 180.0
    states, contacts = [], 0
    for _ in range(200):
        data.ctrl[:] = rng.uniform(100, 240, 4)
        mujoco.mj_step(model, data)
        states.append(np.concatenate([data.qpos, data.qvel, data.act]))
        contacts += data.ncon
    assert all(warning.number == 0 for warning in data.warning)
    return np.array(states), contacts


@pytest.mark.parametrize("vehicle", [Vehicle(), OTHER])
@pytest.mark.parametrize("contact", [False, True])
def test_the_drawn_and_the_lean_model_fly_alike_bit_by_bit(vehicle, contact):
    drawn, lean = vehicle.compile(contact=contact), vehicle.compile_lean(contact=contact)
    assert drawn.ngeom > lean.ngeom + 40  # one is drawn, the other is not
    assert lean.nlight == lean.ncam == lean.ntex == lean.nmesh == lean.nmat == 0
    expected, touched = fly(drawn, 1, start_height=0.3)
    flown, touched_lean = fly(lean, 1, start_height=0.3)
    np.testing.assert_array_equal(flown, expected)
    assert touched == touched_lean
    assert (touched > 10) == contact
    if contact:
        assert expected[-1, 2] > 0
    else:
        assert expected[-1, 2] < -0.1  # through the ground, which nobody asked to be solid


def test_contact_rests_on_the_feet():
    # The feet are spheres of 8 mm, 62 mm below the centre: it stands at 0.070 m.
    model = Vehicle().compile_lean(contact=True)
    data = mujoco.MjData(model)
    data.qpos[2] = 0.12
    mujoco.mj_step(model, data, 300)
    assert data.qpos[2] == pytest.approx(0.070, abs=1e-3)
    assert data.ncon == 4
    assert np.abs(data.qvel).max() < 1e-3


def test_a_small_aircraft_compiles_drawn_and_in_proportion():
    small, paper = OTHER.compile(contact=True), Vehicle().compile(contact=True)
    scale = 0.05 / 0.23
    for name in ("motor_1", "disc_3", "shell", "leg_2", "strike_4", "foot_1"):
        np.testing.assert_allclose(
            small.geom(name).pos, paper.geom(name).pos * scale, atol=1e-9, err_msg=name
        )
    np.testing.assert_allclose(small.geom("motor_1").size, paper.geom("motor_1").size * scale)
    # The rotors have their own size: 0.02 m of radius instead of 0.06 m.
    assert small.geom("disc_1").size[0] == pytest.approx(0.02)
    assert small.geom("strike_1").size[0] == pytest.approx(0.02)

    def reach(model, mesh):
        first, count = model.mesh(mesh).vertadr[0], model.mesh(mesh).vertnum[0]
        return np.ptp(model.mesh_vert[first : first + count], axis=0).max()

    assert reach(small, "blade") == pytest.approx(reach(paper, "blade") / 3, rel=1e-4)
    assert reach(small, "arm") == pytest.approx(reach(paper, "arm") * scale, rel=1e-4)
    flown, _ = fly(small, 0, start_height=5.0)
    assert np.isfinite(flown).all()


def lowest(model, names, up):
    """How far geoms reach below the centre of mass (n,), by their support functions; up (n, 3)."""
    reaches = []
    for name in names:
        geom = model.geom(name)
        size, kind = geom.size, geom.type[0]
        if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            reach = np.linalg.norm(up * size, axis=-1)
        elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            reach = np.full(len(up), size[0])
        else:
            assert kind == mujoco.mjtGeom.mjGEOM_CYLINDER
            reach = np.linalg.norm(up[:, :2], axis=-1) * size[0] + np.abs(up[:, 2]) * size[1]
        reaches.append(reach - up @ geom.pos)
    return np.max(reaches, axis=0)


@pytest.mark.parametrize("vehicle", [Vehicle(), OTHER])
def test_the_depth_of_feet_and_rotors_is_that_of_what_collides(vehicle):
    model = vehicle.compile_lean(contact=True)
    rotation = Rotation.random(500, rng=np.random.default_rng(0)).as_matrix()
    up = rotation[:, 2]
    strikes = ["strike_hull", "strike_1", "strike_2", "strike_3", "strike_4"]
    # The discs are drawn 5 mm thick to either side, at the paper's scale.
    depth = vehicle.strike_depth(rotation)
    np.testing.assert_allclose(depth, lowest(model, strikes, up), atol=0.006)
    # The sphere of a foot, 8 mm, is taken for the point that is its lowest when level: within the
    # tilt of a landing, 15 degrees, that is right to 8 mm * (1 - cos 15) = 0.27 mm.
    upright = up[:, 2] > np.cos(np.radians(15))
    feet = lowest(model, [f"foot_{k}" for k in (1, 2, 3, 4)], up)
    assert upright.sum() > 5
    depth = vehicle.foot_depth(rotation)
    np.testing.assert_allclose(depth[upright], feet[upright], atol=2.8e-4)
    level = vehicle.foot_depth(np.eye(3))
    assert level == pytest.approx(0.070 * vehicle.arm_length / 0.23, rel=1e-12)
    assert vehicle.ground_clearance == pytest.approx(level, rel=1e-12)


def test_the_spec_can_be_added_to():
    spec = Vehicle().spec()
    spec.worldbody.add_geom(name="wall", size=[0.1, 2, 2], type=mujoco.mjtGeom.mjGEOM_BOX)
    assert spec.compile().geom("wall").size[1] == 2


def test_variants_leave_the_original_alone():
    paper = Vehicle()
    heavy = dataclasses.replace(paper, mass=1.3)
    # Twice the mass hovers at sqrt(2) of the speed: the paper's largest.
    assert heavy.hover_speed == pytest.approx(paper.max_speed, rel=1e-12)
    assert paper.mass == 0.65
    with pytest.raises(dataclasses.FrozenInstanceError):
        paper.mass = 1.0
