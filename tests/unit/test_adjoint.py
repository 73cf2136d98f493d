"""The reverse of free flight, beside torch's of the same equations, `quadrl/engines/dynamics.py`.

That these equations are those of the C step is in test_dynamics.py.
"""

import dataclasses
import math

import helpers
import numpy as np
import pytest
import torch
from test_dynamics import step_of_equations

from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.presets import VEHICLES, in_real_air
from quadrl.aircraft.rotors import GRAVITY
from quadrl.engines import dynamics
from quadrl.engines.mujoco import BatchEngine

COUNT = 19  # more than the kernel takes at a time, and no whole lanes
STEPS = 5
# In air with four rotors: for more of them the compiler takes ten seconds and more.
LEANING = dataclasses.replace(
    VEHICLES["paper"],
    rotors=[
        dataclasses.replace(rotor, axis=(0.6 * x - 0.3 * y, 0.6 * y + 0.3 * x, z))
        for rotor in VEHICLES["paper"].rotors
        for x, y in [rotor.position[:2]]
        for z in [math.sqrt(1 - 0.45 * (x**2 + y**2))]
    ],
)
IN_AIR = {name: it for name, it in helpers.IN_AIR.items() if it.rotor_count == 4}
IN_AIR |= {"leaning in air": in_real_air(LEANING)}
EVERY = helpers.LAYOUTS | IN_AIR
every_layout = pytest.mark.parametrize("name", EVERY)


def flying(name, *, per_row=True, count=COUNT):
    """Aircraft that differ, in motions that differ, some near the ground where it has an effect."""
    vehicle, rng = EVERY[name], np.random.default_rng(5)
    batch = BatchEngine(vehicle, count, altitude=3.0, engine="free_flight", per_row=per_row)
    own = len(batch.parameters)  # 1 where all are the same
    batch.write_parameters(np.arange(own), helpers.parameter_rows(vehicle, own))
    motion = helpers.random_motion(vehicle, count, speed=6.0, turn=6.0, wind=5.0, rotor=0.4)
    motion.velocity[::4] *= 3.0  # out of the range of the inflow
    motion.velocity[1::4] *= 0.1
    radius = max(rotor.disc for rotor in vehicle.rotors)
    motion.position[:, 2] = np.linspace(0.2, 12.0, count) * radius
    helpers.put(batch, motion, origin=helpers.UP * (name not in IN_AIR))
    batch.ctrl[:] = helpers.random_commands(vehicle, count, 1, rotor=0.8)[0]
    batch.air[:, 3:] = rng.normal(size=batch.air[:, 3:].shape)
    return batch


def off(got, expected):
    """Largest difference of each row, over the row's largest number."""
    return np.abs(got - expected).max(1) / np.abs(expected).max(1)


@pytest.mark.parametrize("per_row", [False, True])
@every_layout
def test_a_leg_leads_where_the_engine_flies(name, per_row):
    batch = flying(name, per_row=per_row)
    leg = batch.leg(STEPS)
    batch.advance(STEPS)
    np.testing.assert_array_equal(leg.fly(), helpers.coordinates(batch))


@pytest.mark.parametrize("per_row", [False, True])
@every_layout
def test_the_derivatives_are_those_of_the_equations_in_tensors(name, per_row):
    batch = flying(name, per_row=per_row)
    leg = batch.leg(2)
    given = np.random.default_rng(1).normal(size=leg.start.shape)
    p = Parameters.of(batch.parameters).map(lambda array: torch.tensor(array.copy()))
    start, command, air = (torch.tensor(x) for x in (leg.start, leg.command, leg.air))
    leaves = start.requires_grad_(), command.requires_grad_()
    now = dynamics.Motion(*start.split([3, 4, 3, 3, start.shape[1] - 13], dim=-1))
    for _ in range(leg.steps):
        now = step_of_equations(p, now, command, air, -GRAVITY, batch.vehicle.physics_timestep)
    now = torch.cat(list(vars(now).values()), -1)
    expected = torch.autograd.grad((now * torch.tensor(given)).sum(), leaves)
    for got, other in zip(leg.vector_jacobian_product(given), expected, strict=True):
        assert off(got, other.numpy()).max() < 1e-12


def test_what_stands_still_in_still_air_has_derivatives():
    # The roots of drag, of the inflow and of the moment have none at zero: they are left out.
    for name in ("paper", "paper in air"):
        batch = flying(name)
        batch.qvel[:], batch.act[:], batch.air[:] = 0.0, 0.0, 0.0
        leg = batch.leg(STEPS)
        assert all(
            np.isfinite(part).all() for part in leg.vector_jacobian_product(np.ones_like(leg.start))
        )


def test_mujocos_steps_are_refused():
    batch = BatchEngine(EVERY["paper"], 2, altitude=3.0, engine="mujoco")
    with helpers.refused(match="'free_flight'"):
        batch.leg(STEPS)
