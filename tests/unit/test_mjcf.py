"""The models: what is drawn and what can touch; that the lean one flies alike is the contract's."""

import math

import helpers
import mujoco
import numpy as np
import pytest

from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.vehicle import DRAWN_ROTOR_HEIGHT
from quadrl.engines import mjcf
from quadrl.rendering import drawing

layouts = pytest.mark.parametrize("vehicle", helpers.LAYOUTS.values(), ids=helpers.LAYOUTS)


@layouts
def test_every_layout_has_what_is_drawn(vehicle):
    """Each rotor in its place, turning the way that its blades are pitched for."""
    model = mjcf.compile_model(vehicle)
    assert model.nbody == 2 and model.nu == vehicle.rotor_count
    assert all("" not in names(model, kind) for kind in KINDS)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for k, rotor in enumerate(vehicle.rotors):
        axis, place = np.array(rotor.axis), data.site(f"rotor_{k + 1}").xpos
        np.testing.assert_allclose(data.site(f"rotor_{k + 1}").xmat[2::3], axis, atol=1e-12)
        hub = data.geom(f"rotor_{k + 1}_hub").xpos
        height = DRAWN_ROTOR_HEIGHT * vehicle.scale
        np.testing.assert_allclose(hub, place + height * axis, atol=1e-9)
        for side in "ab":
            corners = vertices(model, data, f"rotor_{k + 1}_blade_{side}") - hub
            reach = np.linalg.norm(corners, axis=1)
            assert reach.max() == pytest.approx(rotor.radius * 58 / 60, rel=0.01)
            along = corners[reach.argmax()] / reach.max()
            ahead = corners @ (rotor.spin * np.cross(axis, along))  # in the direction of its turn
            root = corners @ along < rotor.radius / 2
            leading, trailing = (corners[root & (sign * ahead > 0)] @ axis for sign in (1, -1))
            assert leading.mean() > trailing.mean()


KINDS = "geom site cam light mat mesh tex".split()


def names(model, kind):
    """Of the elements of a kind."""
    return [getattr(model, kind)(k).name for k in range(getattr(model, f"n{kind}"))]


def vertices(model, data, name):
    """(n, 3) [m] of a mesh, world frame."""
    mesh, geom = model.mesh(model.geom(name).dataid[0]), data.geom(name)
    first, count = mesh.vertadr[0], mesh.vertnum[0]
    return model.mesh_vert[first : first + count] @ geom.xmat.reshape(3, 3).T + geom.xpos


@pytest.mark.parametrize("name", VEHICLES)
def test_the_feet_touch_first_and_then_what_must_not(name):
    """Level over the ground, a tenth of a millimetre too high and too low for each part."""
    vehicle = VEHICLES[name]
    model = mjcf.compile_model(vehicle, contact=True, drawn=False)
    data = mujoco.MjData(model)

    def touching(height, roll=0.0):
        data.qpos[:7] = (0, 0, height, math.cos(roll / 2), math.sin(roll / 2), 0, 0)
        mujoco.mj_forward(model, data)
        return {model.geom(k).name for contact in data.contact for k in contact.geom} - {"ground"}

    foot, hull = -vehicle.foot[2], vehicle.hull[2]
    assert touching(foot + 1e-4) == set()
    assert touching(foot - 1e-4) == {f"foot_{k}" for k in range(1, 5)}
    assert "strike_hull" not in touching(hull + 1e-4) and "strike_hull" in touching(hull - 1e-4)
    # On its side the lowest rotor is the one farthest to the right, its disc upright.
    y, radius = min((rotor.position[1], rotor.radius) for rotor in vehicle.rotors)
    side = {f"strike_{k + 1}" for k, r in enumerate(vehicle.rotors) if r.position[1] < y + 1e-9}
    assert touching(radius - y - 1e-4, math.pi / 2) == side
    assert touching(radius - y + 1e-4, math.pi / 2) == set()


def test_a_metre_on_the_ground_is_a_metre_for_every_aircraft():
    painted = []
    for name in ("paper", "crazyflie"):
        model = mjcf.compile_model(VEHICLES[name])
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        for part in drawing.PAINTED:
            painted.append(vertices(model, data, part))
    for one, other in zip(painted[:2], painted[2:], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
    # The tick at 10 m to the east: 0.035 m wide, 0.07 m and half of that width long each way.
    tick = np.array([10.0 + 0.035 / 2, 0.07 + 0.035 / 4, 0.001])
    assert np.abs(painted[0] - tick).max(axis=1).min() < 2e-4
    assert painted[0][:, 2] == pytest.approx(0.001, abs=1e-6)
