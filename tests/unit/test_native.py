"""The compiled callbacks: harmless to others, never silently absent."""

import os
from pathlib import Path

import helpers
import mujoco
import numpy as np
import pytest
from mujoco import rollout
from processes import python

import quadrl
from quadrl.aircraft.vehicle import Vehicle
from quadrl.engines import mjcf, native

HOVER = Vehicle().hover_speed


def remove_callbacks(names=native.CALLBACKS):
    for name in names:
        getattr(mujoco, f"set_mjcb_{name}")(None)


@pytest.fixture(autouse=True)
def callbacks():
    """Each test begins and ends with ours."""
    remove_callbacks()
    native.install()
    yield
    remove_callbacks()
    native.install()


# --------------------------------------------------------------------------- other people's models

SOMEBODY_ELSES = """
<mujoco>
  <option timestep="0.005" integrator="{integrator}" wind="1 2 3" density="1.2" viscosity="0.01"/>
  <size nuserdata="5"/>
  <worldbody>
    <body name="pendulum" {user} pos="0 0 1" gravcomp="0.5">
      <joint name="hinge" axis="0 1 0" damping="0.1" stiffness="2"/>
      <geom size="0.1" pos="0.3 0 0"/>
    </body>
    <body name="brick" {user} pos="2 0 1" gravcomp="1">
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.3"/>
      <site name="corner" pos="0.1 0 0"/>
    </body>
  </worldbody>
  <actuator>
    <general joint="hinge" dyntype="user" gaintype="user" actdim="1" dynprm="1 2 3 4 5 6 7 8 9 10"/>
    <general joint="hinge" dyntype="user" gaintype="user" actdim="3" dynprm="1 2 3"/>
    <general site="corner" dyntype="filter" gaintype="user" dynprm="0.2" gear="0 0 1 0 0 0.1"/>
    <general joint="hinge" dyntype="none" gaintype="user" biastype="user"/>
    <general site="corner" dyntype="user" gaintype="user" actdim="1"
      dynprm="0 0 0 0 0 0 0 0 0 1903518052"/>
  </actuator>
</mujoco>
"""
# Short and long, with our mark and without, and one of our length with the mark but another size.
USERS = ["", "5 6", "0 0.5 9", "1903518052 9", "1 2 3 4", "0 " * 200, "1903518052 9 " + "1 " * 200]


def fly_somebody_elses(user, integrator):
    """Everything that a callback could touch, over 50 steps of a model that uses them all."""
    user = f'user="{user}"' if user else ""
    xml = SOMEBODY_ELSES.format(user=user, integrator=integrator)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    data.act[:], data.qvel[:] = rng.uniform(-1, 1, model.na), rng.uniform(-1, 1, model.nv)
    steps = []
    for _ in range(50):
        data.ctrl[:] = rng.uniform(-1, 1, model.nu)
        data.act_dot[:] = 7.0  # what is left there must not be taken for an answer
        mujoco.mj_step(model, data)
        forces = data.qfrc_passive, data.qfrc_actuator, data.actuator_force, data.act_dot
        steps.append(np.concatenate([data.qpos, data.qvel, data.act, *forces]))
    return np.array(steps)


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
@pytest.mark.parametrize("user", USERS)
def test_another_model_moves_as_if_there_were_no_callbacks(user, integrator):
    remove_callbacks()
    without = fly_somebody_elses(user, integrator)
    native.install()
    assert np.ptp(without, axis=0)[:8].min() > 1e-3  # it does move
    np.testing.assert_array_equal(fly_somebody_elses(user, integrator), without)


def test_somebody_elses_parts_in_our_model_are_left_alone():
    def fly(spec):
        model = spec.compile()
        data = mujoco.MjData(model)
        data.act[:4], data.ctrl[:4] = 200.0, (210, 190, 220, 180)
        if model.nu > 4:
            data.ctrl[4], data.qpos[7] = 0.3, 0.5
        mujoco.mj_step(model, data, 50)
        return model, data

    alone, flown = fly(mjcf.spec(Vehicle(), drawn=False))
    spec = mjcf.spec(Vehicle(), drawn=False)
    pendulum = spec.worldbody.add_body(
        name="pendulum", mass=0.1, ipos=[0.3, 0, 0], inertia=[1e-3] * 3, explicitinertial=True
    )
    pendulum.add_joint(name="hinge", axis=[0, 1, 0])
    actuator = spec.add_actuator(
        name="motor", target="hinge", trntype=mujoco.mjtTrn.mjTRN_JOINT, actdim=1
    )
    actuator.dyntype = mujoco.mjtDyn.mjDYN_USER
    actuator.gaintype = mujoco.mjtGain.mjGAIN_USER
    model, data = fly(spec)
    assert model.nu == alone.nu + 1
    np.testing.assert_allclose(data.qpos[:7], flown.qpos, atol=1e-12)
    np.testing.assert_array_equal(data.act[:4], flown.act)
    # MuJoCo without callbacks: no activation rate, gain one, so no torque at all from the motor.
    assert data.act[4] == data.actuator_force[4] == 0
    assert data.qfrc_passive[6] == 0


def test_two_aircraft_in_a_model_fly_as_if_alone():
    vehicle = helpers.IN_AIR["paper in air"]

    def fly(two):
        spec = mjcf.spec(vehicle, drawn=False)
        if two:
            frame = spec.worldbody.add_frame(pos=[0, 9, 0])
            spec.attach(mjcf.spec(vehicle, drawn=False), prefix="other ", frame=frame)
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qpos[2::7], data.userdata[:3] = 1.0, (2, 1, 0.5)  # near the ground, in wind
        data.act[:4], data.ctrl[:4] = 200.0, (210, 190, 220, 180)
        data.act[4:], data.ctrl[4:] = 150.0, 240.0
        mujoco.mj_step(model, data, 30)
        return data

    np.testing.assert_allclose(fly(two=True).qpos[:7], fly(two=False).qpos, atol=1e-12)


def test_a_model_without_room_for_wind_flies_in_calm_air():
    # `nuserdata` of a model that somebody strips. Past its end stand the sensors, here a height of
    # 5 m, which must not be taken for a wind.
    spec = mjcf.spec(Vehicle(), drawn=False)
    spec.nuserdata = 0
    body, position = mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtSensor.mjSENS_FRAMEPOS
    spec.add_sensor(name="height", type=position, objtype=body, objname="aircraft")
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[2], data.act[:], data.ctrl[:] = 5.0, HOVER, HOVER
    mujoco.mj_step(model, data, 10)
    assert data.qpos[2] == pytest.approx(5.0, abs=1e-6)


# ------------------------------------------------------------------------- who owns the callbacks


def somebody_elses(*given):
    return 3.0


def test_foreign_callbacks_are_named_and_left_until_they_are_to_be_replaced():
    before = [getattr(mujoco, f"get_mjcb_{name}")() for name in native.CALLBACKS]
    native.install()  # again: nothing changes
    assert [getattr(mujoco, f"get_mjcb_{name}")() for name in native.CALLBACKS] == before
    for name in ("act_dyn", "passive", "control"):
        getattr(mujoco, f"set_mjcb_{name}")(somebody_elses)
    try:
        for make in (native.install, native.check_installed, lambda: mjcf.compile_model(Vehicle())):
            with pytest.raises(native.NativeError, match="mjcb_act_dyn, mjcb_passive"):
                make()
        assert mujoco.get_mjcb_act_dyn() is somebody_elses
        with pytest.warns(UserWarning, match="mjcb_act_dyn"):
            native.install(replace=True)
        assert mujoco.get_mjcb_control() is somebody_elses  # of another kind
    finally:
        mujoco.set_mjcb_control(None)
    native.check_installed()


@pytest.mark.parametrize("name", native.CALLBACKS)
def test_without_one_of_the_callbacks_nothing_steps(name):
    environment = helpers.begun(num_envs=2)
    before = environment.engine.qpos.copy()
    remove_callbacks([name])
    for step in (native.check_installed, lambda: helpers.idle(environment)):
        with pytest.raises(native.NativeError, match=f"mjcb_{name}"):
            step()
    np.testing.assert_array_equal(environment.engine.qpos, before)


@pytest.mark.parametrize("name", native.CALLBACKS)
def test_without_one_of_the_callbacks_dm_control_does_not_step(name):
    helpers.needs_dm_control()
    environment = quadrl.load("hover", {"random": 0})
    environment.reset()
    remove_callbacks([name])
    with pytest.raises(native.NativeError, match=f"mjcb_{name}"):
        environment.step(np.zeros(4))


def meddle(*given):
    """A callback that changes the state where it is given one."""
    for data in given[1:2]:
        if isinstance(data, mujoco.MjData):
            data.qpos[2] += 0.01
            data.ctrl[:] = 0.0
    return 0


def flown(environment):
    """The pose after five control steps of the first episode."""
    environment.reset(seed=0)
    for _ in range(5):
        helpers.idle(environment)
    return environment.engine.qpos[0].copy()


def flown_in_dm_control(environment):
    """The same of dm_control's environment, in its next episode."""
    environment.reset()
    for _ in range(5):
        environment.step(np.zeros(4))
    return environment.physics.data.qpos.copy()


def is_refused(name, fly, begin):
    """Whether nothing steps with a callback of other code; else it changes no flight."""
    before, clock, environment = fly(begin()), mujoco.get_mjcb_time(), begin()
    getattr(mujoco, f"set_mjcb_{name}")(meddle)
    try:
        assert (fly(environment) == before).all()
        return False
    except native.NativeError as error:
        return f"mujoco.set_mjcb_{name}(None)" in str(error)
    finally:
        getattr(mujoco, f"set_mjcb_{name}")(clock if name == "time" else None)


every_kind = pytest.mark.parametrize("name", [*native.INTERFERING, "act_bias", "sensor", "time"])


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@every_kind
def test_no_callback_of_other_code_changes_a_flight(name, engine):
    refused = is_refused(name, flown, lambda: helpers.begun("landing", engine=engine))
    assert refused == (name in native.INTERFERING and engine == "mujoco")  # the other calls none


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@every_kind
def test_nor_does_one_that_stands_before_the_environment_is_made(name, engine):
    def fly_anew(begin):
        return flown(begin())

    refused = is_refused(name, fly_anew, lambda: lambda: helpers.begun("landing", engine=engine))
    assert refused == (name == "control" or (name == "contactfilter" and engine == "mujoco"))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@every_kind
def test_no_callback_of_other_code_changes_a_flight_in_dm_control(name, engine):
    helpers.needs_dm_control()
    settings = {"random": 0, "engine": engine}
    refused = is_refused(name, flown_in_dm_control, lambda: quadrl.load("landing", settings))
    assert refused == (name in native.INTERFERING)


# -------------------------------------------------------------------------------- MuJoCo's warnings

DIVERGE = """
import mujoco, numpy as np
from pathlib import Path
from quadrl.engines import native
from quadrl.engines.mujoco import BatchEngine
from quadrl.aircraft.vehicle import Vehicle
{before}
engine = BatchEngine(Vehicle(), 64, altitude=3.0, num_threads=4)
def diverge():
    engine.clear(np.arange(64))
    engine.qvel[:] = np.nan
    engine.advance(1)
{body}
"""
INTO_A_FILE = """
path = Path("warnings.txt")
with native.warnings_in(path):
    engine.advance(1)
assert not path.exists()
with native.warnings_in(path):
    diverge()
with native.warnings_in(path):
    for _ in range(10):
        diverge()
"""


def diverged(body, before=""):
    """What a process wrote to stderr, standing in this folder."""
    return python("-c", DIVERGE.format(before=before, body=body)).stderr.splitlines()


def test_a_few_warnings_of_mujoco_are_told_and_none_written_where_one_stands():
    lines = diverged("diverge(), diverge()")
    assert len(lines) == 10
    assert all(line.startswith("quadrl: warning: MuJoCo: ") for line in lines)
    assert all("huge value in Q" in line for line in lines[:-1])
    assert "there were more warnings" in lines[-1]
    assert os.listdir() == []


def test_warnings_of_many_threads_go_to_a_file_that_does_not_grow_without_end():
    assert diverged(INTO_A_FILE) == []
    assert os.listdir() == ["warnings.txt"]
    *lines, last = Path("warnings.txt").read_text().splitlines()
    assert len(lines) == native.MAX_WARNINGS - 1
    assert all("The simulation is unstable" in line for line in lines)
    assert "there were more warnings" in last
    assert Path("warnings.txt").stat().st_size < 64_000


def test_somebody_elses_handler_of_warnings_is_left_alone():
    before = "seen = []; mujoco.set_mju_user_warning(seen.append)"
    assert diverged(INTO_A_FILE + "assert len(seen) >= 11 * 64", before) == []
    assert os.listdir() == []


# --------------------------------------------------------------- our models without the callbacks


def test_a_model_of_ours_without_callbacks_does_not_fly_silently():
    model = mjcf.compile_model(Vehicle())
    remove_callbacks()
    data = mujoco.MjData(model)
    data.qpos[2], data.act[:], data.ctrl[:] = 5.0, HOVER, HOVER
    for _ in range(10):
        mujoco.mj_step(model, data)
        # MuJoCo meets an acceleration that is not a number, says so, starts over (its counters
        # too) and meets it again. What it leaves passes for no flight.
        assert data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number == 1
        assert np.isnan(data.qpos[2])
    native.install()
    mujoco.mj_resetData(model, data)
    data.qpos[2], data.act[:], data.ctrl[:] = 5.0, HOVER, HOVER
    mujoco.mj_step(model, data, 10)
    assert sum(warning.number for warning in data.warning) == 0
    assert data.qpos[2] == pytest.approx(5.0, abs=1e-6)


def test_rollout_runs_the_callbacks_without_python():
    # mujoco.rollout refuses nothing, but would be wrong with other numbers than mj_step.
    model = mjcf.compile_model(Vehicle(), drawn=False)
    datas = [mujoco.MjData(model) for _ in range(2)]
    state = mujoco.mjtState.mjSTATE_FULLPHYSICS
    initial = np.zeros((3, mujoco.mj_stateSize(model, state)))
    data = mujoco.MjData(model)
    data.qpos[2], data.act[:] = 5.0, 220.0
    mujoco.mj_getState(model, data, initial[0], state)
    initial[:] = initial[0]
    commands = np.random.default_rng(0).uniform(150, 300, (3, 40, 4))
    states, _ = rollout.rollout(model, datas, initial, commands)
    for command in commands[2]:
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
    mujoco.mj_getState(model, data, initial[0], state)
    np.testing.assert_array_equal(states[2, -1], initial[0])
