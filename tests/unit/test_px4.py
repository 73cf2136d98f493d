"""What a module of PX4 needs of a policy: its frames, motors and parameters."""

import ctypes
import subprocess

import helpers
import numpy as np
import pytest
from flown_in_c import FLAGS
from scipy.spatial.transform import Rotation

import quadrl
from quadrl.deploy.export import export
from quadrl.engines.native.compiling import compiler

NAME = "hover_robust_crazyflie_brushless"
SOURCE = """#include "px4.h"
void from(const float* p, const float* v, const float* q, const float* r, const float* goal,
          float* out) {
  const hover_robust_motion now = hover_robust_from_px4(p, v, q, r, goal);
  memcpy(out, &now, sizeof now);
}
void to(const float* speed, float* control) { hover_robust_to_px4(speed, 4.0f, control); }
int test(void) { return hover_robust_test(); }
int unused(hover_robust_memory* m, hover_robust_motion* n, float* a, float* c) {
  return hover_robust_begin(m, n, 0) + hover_robust_step(m, n, a, c);
}
"""
# From north, west, up to north, east, down, and from ahead, left, up to ahead, right, down.
TURNED = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return export(NAME, "px4", tmp_path_factory.mktemp("px4") / "px4")


@pytest.fixture(scope="module")
def library(folder):
    source, made = folder / "x.c", folder / "x.so"
    source.write_text(SOURCE)
    command = [compiler(), *FLAGS, "-O1", "-shared", "-fPIC", source, "-o", made, "-lm"]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return ctypes.CDLL(str(made))


def call(function, *arrays):
    given = [np.ascontiguousarray(a, np.float32) for a in arrays]
    function(*(a.ctypes.data_as(ctypes.c_void_p) for a in given))
    return given[-1]


def test_a_motion_of_px4_is_that_of_the_policy(library):
    rng = np.random.default_rng(3)
    for _ in range(20):
        way = Rotation.random(rng=rng)
        place, goal, velocity, rate = rng.normal(size=(4, 3))
        # As an autopilot has it: north, east, down of the same vectors, and its own two frames.
        own = TURNED * way * TURNED.inv()
        given = [TURNED.apply(x) for x in (place, velocity)]
        quaternion = own.as_quat(scalar_first=True)
        parts = *given, quaternion, TURNED.apply(rate), TURNED.apply(goal)
        found = call(library.__getattr__("from"), *parts, np.zeros(17))
        np.testing.assert_allclose(found[:3], place - goal, atol=1e-6)
        back = Rotation.from_quat(found[3:7], scalar_first=True)
        assert (back.inv() * way).magnitude() < 1e-5
        np.testing.assert_allclose(found[7:13], [*velocity, *rate], atol=1e-6)
        np.testing.assert_allclose(found[13:], quadrl.VEHICLES["crazyflie_brushless"].hover_speed)
    assert library.test() == 0


def test_controls_stay_where_motors_have_them(library):
    most = quadrl.VEHICLES["crazyflie_brushless"].rotors[0].max_speed
    found = call(library.to, most * np.array([0.5, 1.0, 1.2, -0.1]), np.zeros(4))
    np.testing.assert_allclose(found, [0.5, 1, 1, 0], atol=1e-6)


def test_parameters_turn_the_aircraft_as_its_rotors_do(folder):
    """PX4's effectiveness: torque of a thrust along -z at its place, and its own moment."""
    lines = (line.split() for line in (folder / "parameters.txt").read_text().splitlines())
    found = {name: float(value) for *_, name, value in lines}
    vehicle, page = quadrl.VEHICLES["crazyflie_brushless"], (folder / "README.md").read_text()
    assert found["CA_ROTOR_COUNT"] == 4 and found["CA_AIRFRAME"] == 0
    for k, rotor in enumerate(vehicle.rotors):
        own = {name: found[f"CA_ROTOR{k}_{name}"] for name in ("PX", "PY", "PZ", "CT", "KM")}
        way = "counter-clockwise" if own["KM"] > 0 else "clockwise"
        assert f"| {k + 1} | {own['PX']:.4g} | {own['PY']:.4g} | {way} |" in page
        place, thrust = np.array([own["PX"], own["PY"], own["PZ"]]), np.array([0, 0, -own["CT"]])
        moment = np.cross(place, thrust) - own["KM"] * thrust
        lift = rotor.thrust_coefficient * rotor.max_speed**2
        up, turn = np.array([0, 0, lift]), rotor.torque_coefficient * rotor.max_speed**2
        expected = np.cross(rotor.position, up) - np.array([0, 0, rotor.spin * turn])
        np.testing.assert_allclose(moment, TURNED.apply(expected), rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize(("what", "name"), [("race", "task"), ("hover", "rotor_speed")])
def test_what_px4_does_not_know_is_refused(what, name, tmp_path):
    with helpers.refused(name):
        export(what, "px4", tmp_path / "px4")
    assert not (tmp_path / "px4").exists()
