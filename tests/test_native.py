"""The compiled callbacks: harmless to others, never silently absent, built for this mujoco."""

import multiprocessing
import os
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mujoco import rollout

import quadrl
from quadrl import native
from quadrl.environment import Environment
from quadrl.vehicle import Vehicle

REPOSITORY = Path(quadrl.__file__).parents[1]
INCLUDE = Path(mujoco.__file__).parent / "include"


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


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of compiled libraries."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("QUADRL_CACHE", str(folder))
    return folder


# --------------------------------------------------------------------------- other people's models

SOMEBODY_ELSES = """
<mujoco>
  <option timestep="0.005" integrator="{integrator}" wind="1 2 3" density="1.2" viscosity="0.01"/>
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
  </actuator>
</mujoco>
"""


def fly_somebody_elses(user, integrator):
    """Everything that a callback could touch, over 100 steps of a model that uses them all."""
    xml = SOMEBODY_ELSES.format(user=user, integrator=integrator)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    data.act[:], data.qvel[:] = rng.uniform(-1, 1, model.na), rng.uniform(-1, 1, model.nv)
    steps = []
    for _ in range(100):
        data.ctrl[:] = rng.uniform(-1, 1, model.nu)
        data.act_dot[:] = 7.0  # what is left there must not be taken for an answer
        mujoco.mj_step(model, data)
        forces = data.qfrc_passive, data.qfrc_actuator, data.actuator_force, data.act_dot
        steps.append(np.concatenate([data.qpos, data.qvel, data.act, *forces]))
    return np.array(steps), model.nuser_body


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
@pytest.mark.parametrize(
    ("user", "nuser_body"),
    [
        ("", 0),
        ('user="5 6"', 2),
        ('user="0 0.5 9"', 3),
        ('user="1903518052 9"', 2),
        ('user="1 2 3 4"', 4),
    ],
)
def test_another_model_moves_as_if_there_were_no_callbacks(user, nuser_body, integrator):
    remove_callbacks()
    without, _ = fly_somebody_elses(user, integrator)
    native.install()
    with_ours, nuser = fly_somebody_elses(user, integrator)
    assert nuser == nuser_body
    assert np.ptp(without, axis=0)[:8].min() > 1e-3  # it does move
    np.testing.assert_array_equal(with_ours, without)


def test_somebody_elses_parts_in_our_model_are_left_alone():
    def fly(spec):
        model = spec.compile()
        data = mujoco.MjData(model)
        data.act[:4], data.ctrl[:4] = 200.0, (210, 190, 220, 180)
        if model.nu > 4:
            data.ctrl[4], data.qpos[7] = 0.3, 0.5
        mujoco.mj_step(model, data, 50)
        return model, data

    alone, flown = fly(Vehicle().spec(drawn=False))
    spec = Vehicle().spec(drawn=False)
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


# ------------------------------------------------------------------------- who owns the callbacks


def test_install_does_not_take_over_a_foreign_callback():
    def gain(model, data, actuator):
        return 3.0

    mujoco.set_mjcb_act_gain(gain)
    with pytest.raises(native.NativeError, match=r"mjcb_act_gain.*replace=True"):
        native.install()
    assert mujoco.get_mjcb_act_gain() is gain
    with pytest.raises(native.NativeError, match="mjcb_act_gain"):
        Vehicle().compile()
    with pytest.warns(UserWarning, match="mjcb_act_gain"):
        native.install(replace=True)
    native.check_installed()


def test_install_names_every_foreign_callback():
    mujoco.set_mjcb_passive(lambda model, data: None)
    mujoco.set_mjcb_act_dyn(lambda model, data, actuator: 0.0)
    with pytest.raises(native.NativeError, match="mjcb_act_dyn, mjcb_passive"):
        native.install()


def test_install_leaves_callbacks_of_other_kinds():
    def control(model, data):
        pass

    mujoco.set_mjcb_control(control)
    try:
        native.install()
        assert mujoco.get_mjcb_control() is control
    finally:
        mujoco.set_mjcb_control(None)


def test_installing_twice_changes_nothing():
    before = [getattr(mujoco, f"get_mjcb_{name}")() for name in native.CALLBACKS]
    native.install()
    assert [getattr(mujoco, f"get_mjcb_{name}")() for name in native.CALLBACKS] == before
    native.check_installed()


@pytest.mark.parametrize("name", native.CALLBACKS)
def test_check_installed_names_what_is_missing(name):
    remove_callbacks([name])
    with pytest.raises(native.NativeError, match=rf"mjcb_{name} was removed.*install\(\)"):
        native.check_installed()


def test_check_installed_refuses_a_foreign_callback():
    mujoco.set_mjcb_passive(lambda model, data: None)
    with pytest.raises(native.NativeError, match="mjcb_passive"):
        native.check_installed()


# --------------------------------------------------------------- our models without the callbacks


def test_a_model_of_ours_without_callbacks_does_not_fly_silently():
    model = Vehicle().compile()
    remove_callbacks()
    data = mujoco.MjData(model)
    data.qpos[2] = 5.0
    data.act[:] = data.ctrl[:] = 225.678
    for _ in range(10):
        mujoco.mj_step(model, data)
        # MuJoCo meets an acceleration that is not a number, says so, starts over (its counters
        # too) and meets it again. What it leaves passes for no flight.
        assert data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number == 1
        assert np.isnan(data.qpos[2])
    native.install()
    mujoco.mj_resetData(model, data)
    data.qpos[2] = 5.0
    data.act[:] = data.ctrl[:] = 225.678
    mujoco.mj_step(model, data, 10)
    assert sum(warning.number for warning in data.warning) == 0
    assert data.qpos[2] == pytest.approx(5.0, abs=1e-6)


@pytest.mark.parametrize("name", native.CALLBACKS)
@pytest.mark.parametrize("num_envs", [None, 2])
def test_an_environment_without_one_of_the_callbacks_refuses_to_step(name, num_envs):
    environment = Environment("hover", num_envs=num_envs, seed=0)
    environment.reset()
    before = environment.simulation.qpos.copy()
    remove_callbacks([name])
    with pytest.raises(native.NativeError, match=f"mjcb_{name}"):
        environment.step(np.zeros((*environment.shape, 4)))
    np.testing.assert_array_equal(environment.simulation.qpos, before)


def test_dm_control_without_callbacks_refuses_to_step():
    environment = quadrl.load("hover", {"random": 0})
    environment.reset()
    remove_callbacks()
    with pytest.raises(native.NativeError, match="was removed"):
        environment.step(np.zeros(4))


def test_rollout_runs_the_callbacks_without_python():
    # mujoco.rollout refuses nothing, but would be wrong with other numbers than mj_step.
    model = Vehicle().compile_lean()
    datas = [mujoco.MjData(model) for _ in range(2)]
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    initial = np.zeros((3, size))
    data = mujoco.MjData(model)
    data.qpos[2] = 5.0
    data.act[:] = 220.0
    mujoco.mj_getState(model, data, initial[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    initial[:] = initial[0]
    control = np.random.default_rng(0).uniform(150, 300, (3, 40, 4))
    states, _ = rollout.rollout(model, datas, initial, control)
    for command in control[2]:
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
    final = np.zeros(size)
    mujoco.mj_getState(model, data, final, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    np.testing.assert_array_equal(states[2, -1], final)


# -------------------------------------------------------------------------------------- the build


def test_a_library_for_another_mujoco_is_refused(tmp_path, cache):
    shutil.copytree(INCLUDE, tmp_path / "include")
    header = tmp_path / "include" / "mujoco" / "mujoco.h"
    running = mujoco.mj_version()
    text = header.read_text()
    assert f"#define mjVERSION_HEADER {running}" in text
    header.write_text(
        text.replace(f"mjVERSION_HEADER {running}", f"mjVERSION_HEADER {running + 1000}")
    )
    path = native.build(include=tmp_path / "include")
    with pytest.raises(native.NativeError, match=rf"mujoco {running + 1000}.*{running} is running"):
        native.load(path)
    # The one for this mujoco stands beside it under another name.
    right = native.build()
    assert right != path
    assert native.load(right).quadrl_mujoco_version() == running


def test_without_a_compiler_the_error_says_what_to_install(cache, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(native.NativeError, match=r"no C compiler.*apt-get install build-essential"):
        native.build()
    assert list(cache.iterdir()) == []  # nothing half-made


def test_cc_names_the_compiler(monkeypatch, tmp_path):
    chosen = tmp_path / "my-cc"
    chosen.write_text("#!/bin/sh\n")
    chosen.chmod(0o755)
    monkeypatch.setenv("CC", str(chosen))
    assert native.compiler() == str(chosen)


def test_a_compiler_that_fails_is_quoted(cache, monkeypatch, tmp_path):
    broken = tmp_path / "broken-cc"
    broken.write_text("#!/bin/sh\necho 'no such target: toaster' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    with pytest.raises(native.NativeError, match="no such target: toaster"):
        native.build()
    assert list(cache.iterdir()) == []


def test_the_cache_is_used(cache, monkeypatch, tmp_path):
    path = native.build()
    assert list(cache.iterdir()) == [path]
    built = path.stat().st_mtime_ns
    monkeypatch.setenv("PATH", str(tmp_path))  # no compiler any more
    monkeypatch.delenv("CC", raising=False)
    assert native.build() == path
    assert path.stat().st_mtime_ns == built


@pytest.mark.parametrize("kind", ["read-only", "unreadable"])
def test_a_cache_that_cannot_be_written_is_done_without(tmp_path, monkeypatch, kind):
    # Root may write everywhere, so both stand in: a folder under a file cannot be made, and a
    # name past the file system's limit cannot even be asked for.
    impossible = tmp_path / "file" / "quadrl" if kind == "read-only" else tmp_path / ("x" * 300)
    (tmp_path / "file").write_text("")
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    monkeypatch.setenv("QUADRL_CACHE", str(impossible))
    path = native.build()
    assert path.is_relative_to(tmp_path / "tmp")
    assert native.load(path).quadrl_mujoco_version() == mujoco.mj_version()


def test_processes_that_build_at_once_do_not_disturb_each_other(cache):
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    code = "from quadrl import native; print(native.build()); native.load(native.build())"
    running = [
        subprocess.Popen(
            [sys.executable, "-c", code],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for _ in range(4)
    ]
    outcomes = [process.communicate(timeout=120) for process in running]
    assert [process.returncode for process in running] == [0] * 4, outcomes
    (path,) = {out.strip() for out, _ in outcomes}
    assert os.listdir(cache) == [Path(path).name]  # and no scratch left


# ------------------------------------------------------------------------------- other processes


def fly_hover(seed):
    environment = Environment("hover", num_envs=2, seed=seed)
    environment.reset()
    for k in range(20):
        environment.step(np.full((2, 4), 0.05 * (k % 5)))
    return np.array(environment.simulation.qpos)


def test_a_spawned_process_flies_the_same():
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        elsewhere = pool.apply(fly_hover, (3,))
    here = fly_hover(3)
    assert (here[:, 2] > 2.0).all()  # without callbacks it would be on the ground by now
    np.testing.assert_array_equal(elsewhere, here)


# ------------------------------------------------------------------------------ the stage clock


def run_alone(script: str) -> str:
    """What a script prints in a process of its own: the clock is stopped once in a process."""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


FLY = """
import quadrl, mujoco
from quadrl.vehicle import Vehicle
{before}
model = Vehicle().compile_lean()
data = mujoco.MjData(model)
{after}
mujoco.mj_step(model, data)
timer = data.timer[mujoco.mjtTimer.mjTIMER_STEP]
print(timer.number, timer.duration > 0)
"""


def test_the_clock_stands_still_and_can_be_brought_back():
    assert run_alone(FLY.format(before="", after="")) == "1 False\n"
    brought_back = "mujoco.set_mjcb_time(None); Vehicle().compile_lean()"
    assert run_alone(FLY.format(before="", after=brought_back)) == "1 True\n"


def test_a_clock_of_somebody_else_is_left_alone():
    ticks = (
        "import itertools; clock = itertools.count(1.0); mujoco.set_mjcb_time(lambda: next(clock))"
    )
    assert run_alone(FLY.format(before=ticks, after="")) == "1 True\n"
