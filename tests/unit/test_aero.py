"""Each function of native/aero.h, called from C by itself, against the same one in dynamics.py.

Rotors are tilted any way, and every aircraft of a group of lanes has numbers of its own.
"""

import ctypes
import subprocess
from pathlib import Path

import helpers
import numpy as np
import pytest

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.engines import dynamics, native
from quadrl.engines.native import compiling

LANES = 8
SHIM = """
#define LANES 8
#include "aero.h"
// rows: LANES aircraft, a row each; speed, command: (LANES, 8); air, rate: (LANES, 3).
__attribute__((visibility("default"))) void shim(const double* rows, const double* speed,
    const double* command, const double* air, const double* rate, double* thrust, double* aero,
    double* lag, double* bound) {
  static Aircraft a;
  for (int i = 0; i < LANES; ++i)
    for (int k = 0; k < ROW_SIZE; ++k) ((double*)&a)[k * LANES + i] = rows[i * ROW_SIZE + k];
  for (int i = 0; i < LANES; ++i) {
    const double* w = air + 3 * i;
    for (int k = 0; k < (int)a.rotor_count[i]; ++k) {
      const double omega = speed[MAX_ROTORS * i + k];
      double lever[6];
      aero_rotor_lever(a.rotor + k, lever, i);
      for (int n = 0; n < 6; ++n)
        thrust[6 * i + n] += lever[n] * aero_rotor_gain(a.rotor + k, omega, i) * omega;
      lag[MAX_ROTORS * i + k] =
          aero_rotor_acceleration(a.rotor + k, omega, command[MAX_ROTORS * i + k], i);
    }
    aero_wrench(&a, w, rate + 3 * i, aero + 6 * i, aero + 6 * i + 3, i);
    bound[i] = aero_largest_drag(&a, w[0] * w[0] + w[1] * w[1] + w[2] * w[2], i);
  }
}
"""


@pytest.fixture(scope="module")
def shim(tmp_path_factory):
    folder = tmp_path_factory.mktemp("aero")
    (folder / "layout.h").write_text(parameters.c_structs())
    (folder / "shim.c").write_text(SHIM)
    include = f"-I{Path(native.__file__).parent}"
    command = [
        compiling.compiler(),
        *compiling.FLAGS,
        "-O1",
        include,
        f"-I{folder}",
        "-o",
        "shim.so",
    ]
    subprocess.run([*command, "shim.c", "-lm"], check=True, cwd=folder)
    return ctypes.CDLL(str(folder / "shim.so")).shim


def tilted(vehicle):
    """Rows of aircraft whose rotors point anywhere, each at a place of its own."""
    table, rng = helpers.parameter_rows(vehicle, LANES), np.random.default_rng(3)
    rotor = table["rotor"][:, : vehicle.rotor_count]
    axis = rng.normal(size=rotor["axis"].shape)
    rotor["axis"] = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    rotor["position"] += rng.uniform(-0.1, 0.1, rotor["position"].shape)
    return table


@pytest.mark.parametrize("name", helpers.LAYOUTS)
def test_every_function_of_the_header_is_that_of_the_equations(shim, name):
    vehicle, rng = helpers.LAYOUTS[name], np.random.default_rng(4)
    table, rotors = tilted(vehicle), vehicle.rotor_count
    speed, command = (np.zeros((LANES, parameters.MAX_ROTORS)) for _ in range(2))
    speed[:, :rotors], command[:, :rotors] = rng.uniform(50, 900, (2, LANES, rotors))
    air, rate = rng.uniform(-9, 9, (2, LANES, 3))
    thrust, aero, lag, bound = (np.zeros((LANES, n)) for n in (6, 6, parameters.MAX_ROTORS, 1))
    given = (table, speed, command, air, rate, thrust, aero, lag, bound)
    shim(*(ctypes.c_void_p(array.ctypes.data) for array in given))
    p = Parameters.of(table)
    own = speed[:, :rotors], command[:, :rotors]
    force, moment = dynamics.thrust_wrench(p, own[0])
    drag, damping = dynamics.aero_wrench(p, air, rate)
    for got, expected in (
        (thrust, np.concatenate([force, moment], axis=-1)),
        (aero, np.concatenate([drag, damping], axis=-1)),
        (lag[:, :rotors], dynamics.rotor_acceleration(p, *own)),
        # The bound is what it bounds: the drag of that airspeed, over the mass.
        (bound[:, 0], np.linalg.norm(drag, axis=-1) / p.mass),
    ):
        scale = np.abs(expected).max(axis=-1, keepdims=True)
        np.testing.assert_allclose(got / scale, expected / scale, rtol=0, atol=1e-14)
    rising = own[1] > own[0]
    assert rising.any() and not rising.all() and not lag[:, rotors:].any()


def test_a_tilted_rotor_by_hand():
    # Axis (0.6, 0, 0.8) at (0, 0.5, 0), k_T = 1e-5, k_Q = 2e-7, 300 rad/s, turning clockwise:
    # thrust 0.9 N: (0.54, 0, 0.72) N. Its moment: (0.5 * 0.72, 0, -0.5 * 0.54) = (0.36, 0, -0.27).
    # The reaction is counter-clockwise: +0.018 N m along the axis: (0.0108, 0, 0.0144).
    table = np.zeros(1, dtype=parameters.AIRCRAFT)
    table["rotor_count"], rotor = 1, table["rotor"][:, 0]
    rotor["axis"], rotor["position"], rotor["spin"] = (0.6, 0, 0.8), (0, 0.5, 0), -1
    rotor["thrust_coefficient"], rotor["torque_coefficient"] = 1e-5, 2e-7
    force, moment = dynamics.thrust_wrench(Parameters.of(table), np.array([[300.0]]))
    np.testing.assert_allclose(force, [[0.54, 0, 0.72]], rtol=1e-12)
    np.testing.assert_allclose(moment, [[0.3708, 0, -0.2556]], rtol=1e-12)
