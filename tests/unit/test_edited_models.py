"""The C part trusts no number of a model: what is not sound fails at once, and touches nothing."""

import contextlib

import helpers
import mujoco
import numpy as np
import pytest

from quadrl.aircraft import parameters
from quadrl.aircraft.presets import in_real_air
from quadrl.aircraft.vehicle import MAX_ROTORS, Vehicle
from quadrl.engines import mjcf, native
from quadrl.engines.mujoco import BatchEngine, DataEngine
from quadrl.engines.threads import LANES

CALM, IN_AIR = Vehicle(), in_real_air(Vehicle())
VEHICLES = {"calm": CALM, "in air": IN_AIR}
KINDS = ("drawn", "lean")
NUMBERS = (
    *(-np.inf, -1e300, -(2.0**63), -(2.0**31), -2.0, -1.0, -0.5, -5e-324, -0.0, 0.0, 5e-324),
    *(0.5, 1.0, 2.0, 2.5, 3.0, 4.0, 7.0, 8.0, 9.0, 64.0, 1e8, 2.0**31, 2.0**63, 1e300),
    *(np.inf, np.nan),
)
"""What is written where a small whole number belongs."""


@pytest.fixture(scope="module", params=[f"{air}, {kind}" for air in VEHICLES for kind in KINDS])
def model(request):
    air, kind = request.param.split(", ")
    return mjcf.compile_model(VEHICLES[air], drawn=kind == "drawn")


def flown(model, steps=3):
    """The coordinates after some steps from 5 m, at the speed of hover, and MuJoCo's warnings."""
    data = mujoco.MjData(model)
    if model.nq >= 7:
        data.qpos[2] = 5.0
    data.act[:] = CALM.hover_speed
    data.ctrl[:] = 1.1 * CALM.hover_speed
    data.userdata[:3] = 1.0, 2.0, 3.0
    mujoco.mj_step(model, data, steps)
    return np.concatenate([data.qpos, data.qvel, data.act]), data.warning.number


def assert_fails(model):
    """At its first step, so that it passes for no flight: as a model without callbacks does."""
    motion, warnings = flown(model, steps=1)
    assert np.isnan(motion).any()
    assert warnings[mujoco.mjtWarning.mjWARN_BADQACC]


def row_of(model):
    """The parameters of the aircraft, live."""
    body = model.body("aircraft").id
    return model.body_user[body].view(parameters.AIRCRAFT)[0]


def is_whole(number, below):
    return 0 <= number < below and number == np.floor(number)


@pytest.mark.parametrize("number", NUMBERS)
def test_numbers_of_rotors_and_of_effects(model, number):
    sound, _ = flown(model)
    for place in ("rotor", "rotor_count", "effects"):
        edited = model.__copy__()
        row, count = row_of(edited), 4.0
        if place == "rotor":
            edited.actuator_dynprm[2, 0] = number
            fails = not is_whole(number, count)
        else:
            row[place] = number
            # With fewer rotors there are actuators of none.
            fails = place == "effects" and not is_whole(number, 3)
            fails |= place == "rotor_count" and not (
                is_whole(number, MAX_ROTORS + 1) and number >= count
            )
        if fails:
            assert_fails(edited)
        elif number == model.actuator_dynprm[2, 0] and place == "rotor":
            np.testing.assert_array_equal(flown(edited)[0], sound)
        else:
            flown(edited)


def test_actuators_of_ours_that_are_nobodys_rotor(model):
    def no_activation(edited):
        edited.actuator_actadr[1] = -1
        edited.actuator_actnum[1] = 0

    def on_the_joint(edited):
        edited.actuator_trntype[1] = mujoco.mjtTrn.mjTRN_JOINT
        edited.actuator_trnid[1] = (0, -1)

    for edit in (no_activation, on_the_joint):
        edited = model.__copy__()
        edit(edited)
        assert_fails(edited)
    # On the world it pushes nothing that moves: MuJoCo sees no acceleration of it.
    edited = model.__copy__()
    edited.site_bodyid[edited.actuator_trnid[1, 0]] = 0
    assert np.isnan(flown(edited, steps=1)[0][-3])  # its speed


JOINTS = {
    "hinge": ["hinge"],
    "ball": ["ball"],
    "slide": ["slide"],
    "six that are no free joint": ["slide"] * 3 + ["hinge"] * 3,
    "hinge behind another body": ["hinge"],
}


@pytest.mark.parametrize("vehicle", VEHICLES.values(), ids=VEHICLES)
@pytest.mark.parametrize("kind", [*JOINTS, "none", "none behind another body"])
def test_an_aircraft_that_is_not_on_a_free_joint(kind, vehicle):
    native.install()
    spec = mjcf.spec(vehicle, drawn=False)
    body = spec.body("aircraft")
    spec.delete(body.joints[0])
    for k, name in enumerate(JOINTS.get(kind, [])):
        joint = getattr(mujoco.mjtJoint, f"mjJNT_{name.upper()}")
        body.add_joint(type=joint, axis=np.eye(3)[k % 3])
    if "behind another" in kind:
        other = spec.worldbody.add_body(name="other", mass=1.0, inertia=[0.1] * 3, pos=[0, 0, 9])
        other.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE)
        arm = spec.worldbody.add_body(name="arm", pos=[9, 0, 9])
        arm.add_freejoint()
        arm.mass, arm.inertia, arm.explicitinertial = 1.0, [0.1] * 3, True
        other.explicitinertial = True
    model = spec.compile()
    if model.nv:
        assert_fails(model)
    else:  # nothing there can move
        flown(model)


def test_any_numbers_anywhere_disturb_no_memory():
    """Fields at random, several at a time; what MuJoCo itself takes for an address stays one."""
    rng = np.random.default_rng(0)
    models = [
        mjcf.compile_model(v, drawn=False, contact=c) for v in VEHICLES.values() for c in (0, 1)
    ]
    failed = 0
    for _ in range(400):
        edited = models[rng.integers(len(models))].__copy__()
        numbers = edited.body_user[edited.body("aircraft").id]
        for _ in range(rng.integers(1, 4)):
            number, actuator = rng.choice(NUMBERS), rng.integers(edited.nactuator)
            match rng.integers(6):
                case 0:
                    edited.actuator_dynprm[actuator, rng.integers(10)] = number
                case 1:
                    numbers[rng.integers(len(numbers))] = number
                case 2:
                    row_of(edited)[rng.choice(["mark", "size", "rotor_count", "effects"])] = number
                case 3:
                    edited.actuator_actadr[actuator] = rng.integers(-1, edited.na)
                case 4:
                    edited.actuator_trntype[actuator] = rng.integers(2)  # on the joint
                    edited.actuator_trnid[actuator] = (0, -1)
                case 5:
                    site = edited.actuator_trnid[actuator, 0]
                    edited.site_bodyid[site] = rng.integers(edited.nbody)
        motion, _ = flown(edited, steps=2)
        failed += not np.isfinite(motion).all()
    assert 100 < failed < 400  # both kinds


# -------------------------------------------------------------------------------------- free flight


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize(("place", "sound"), [("rotor_count", (4,)), ("effects", (0, 1, 2))])
def test_free_flight_beside_a_row_that_is_not_sound(place, sound, number):
    count, faulty = LANES + 3, LANES + 1  # in the last block, which is not full
    engines = []
    for bad in (False, True):
        engine = BatchEngine(IN_AIR, count, altitude=9.0, engine="free_flight", per_row=True)
        helpers.put(engine, helpers.random_motion(IN_AIR, count, wind=3.0))
        engine.ctrl[:] = 300.0
        if bad:
            row = parameters.rows(IN_AIR)
            row[place] = number
            engine.write_parameters(np.array([faulty]), row)
        leg = engine.leg(3)
        engine.advance(3)
        said = contextlib.nullcontext()
        if bad and not np.isfinite(number):
            said = helpers.refused(match=f"parameters.*{place}")
        broken = np.arange(count) == faulty
        with said:
            broken = engine.read()
        engines.append(
            (broken, engine.qpos.copy(), leg.fly(), leg.vector_jacobian_product(leg.start))
        )
    (_, expected, *whole), (broken, flown, *edited) = engines
    others = np.arange(count) != faulty
    np.testing.assert_array_equal(expected[others], flown[others])
    np.testing.assert_array_equal(broken is not None and broken, (number not in sound) & ~others)
    for expected, got in zip((whole[0], *whole[1]), (edited[0], *edited[1]), strict=True):
        np.testing.assert_array_equal(expected[others], got[others])
        assert np.isnan(got[faulty]).any() == (number not in sound)


def test_a_model_whose_row_has_other_rotors_is_refused_to_fly():
    model = mjcf.compile_model(CALM)
    row_of(model)["rotor_count"] = 5
    with helpers.refused(match="the parameters of an aircraft"):
        DataEngine(CALM, model, mujoco.MjData(model), altitude=3.0)
