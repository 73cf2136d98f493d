"""The equations twice: in C (both engines) and in the array API (`quadrl/engines/dynamics.py`)."""

import dataclasses

import helpers
import mujoco
import numpy as np
import pytest
import torch

from quadrl.aircraft.aerodynamics import ROTOR_EFFECTS
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import MAX_ROTORS, Vehicle
from quadrl.base.rotation import norm
from quadrl.engines import dynamics, mjcf
from quadrl.engines.mujoco import BatchEngine, DataEngine

COUNT = 9  # more than free flight takes at a time
FIELDS = [field.name for field in dataclasses.fields(dynamics.Motion)]
EVERY = helpers.LAYOUTS | helpers.IN_AIR
every_layout = pytest.mark.parametrize("name", EVERY)


@dataclasses.dataclass
class Case:
    """Aircraft that all differ, in motions that all differ, each in an air of its own."""

    vehicle: Vehicle
    table: np.ndarray
    motion: helpers.Motion
    command: np.ndarray
    air: np.ndarray

    @classmethod
    def of(cls, name):
        vehicle = EVERY[name]
        motion = helpers.random_motion(vehicle, COUNT, speed=6.0, turn=6.0, wind=5.0, rotor=0.4)
        # Where the air acts, some are near the ground and others are not.
        motion.position += (0, 0, 0.5) if name in helpers.IN_AIR else helpers.UP
        command = helpers.random_commands(vehicle, COUNT, 1, rotor=0.6)[0]
        rising = command > motion.rotor_speed
        assert rising.any() and not rising.all()
        noise = np.random.default_rng(5).normal(size=(COUNT, MAX_ROTORS))
        air = np.concatenate([motion.wind, noise], axis=-1)
        return cls(vehicle, helpers.parameter_rows(vehicle, COUNT), motion, command, air)

    def equations(self, function, *more):
        """What a function of `dynamics` gives."""
        motion = dynamics.Motion(*(getattr(self.motion, name) for name in FIELDS))
        given = (self.command, self.air, -GRAVITY, *more)
        return function(Parameters.of(self.table), motion, *given)


def step_of_equations(p, motion, command, wind, gravity, timestep):
    """One step [s] of the classical Runge-Kutta method."""

    def moved(start, rate, time):
        parts = ((getattr(start, name), getattr(rate, name)) for name in FIELDS)
        return dynamics.Motion(*(was + time * change for was, change in parts))

    fixed = command, wind, gravity
    k1 = dynamics.derivative(p, motion, *fixed)
    k2 = dynamics.derivative(p, moved(motion, k1, timestep / 2), *fixed)
    k3 = dynamics.derivative(p, moved(motion, k2, timestep / 2), *fixed)
    k4 = dynamics.derivative(p, moved(motion, k3, timestep), *fixed)
    rate = moved(moved(moved(k1, k2, 2), k3, 2), k4, 1)
    after = moved(motion, rate, timestep / 6)
    unit = after.quaternion / norm(after.quaternion)[..., None]
    return dataclasses.replace(after, quaternion=unit)


@every_layout
def test_a_step_of_free_flight_is_that_of_the_equations(name):
    case = Case.of(name)
    flying = BatchEngine(case.vehicle, COUNT, altitude=3.0, engine="free_flight", per_row=True)
    flying.write_parameters(np.arange(COUNT), case.table)
    helpers.put(flying, case.motion, origin=0)
    flying.ctrl[:], flying.air[:] = case.command, case.air
    flying.advance(1)
    step = case.equations(step_of_equations, case.vehicle.physics_timestep)
    found = helpers.taken(flying, origin=0)
    for field in FIELDS:
        value = getattr(step, field)
        atol = 1e-12 * np.abs(value).max()
        np.testing.assert_allclose(getattr(found, field), value, rtol=0, atol=atol, err_msg=field)
        # It is a step: what it changes is far more than the tolerance.
        assert np.abs(value - getattr(case.motion, field)).min() > 0


@every_layout
def test_the_accelerations_of_mujoco_are_the_derivative(name):
    case = Case.of(name)
    model = mjcf.compile_model(case.vehicle, drawn=False)
    data = mujoco.MjData(model)
    one = DataEngine(case.vehicle, model, data, altitude=3.0)
    rate = case.equations(dynamics.derivative)
    acceleration = np.empty((COUNT, 6))
    spin_up = np.empty_like(case.command)
    for row in range(COUNT):
        one.write_parameters(np.array([0]), case.table[row : row + 1])
        motion = helpers.Motion(*(x[row : row + 1] for x in vars(case.motion).values()))
        helpers.put(one, motion, origin=0)
        one.ctrl[:], one.air[:] = case.command[row], case.air[row]
        mujoco.mj_forward(model, data)
        acceleration[row], spin_up[row] = data.qacc, data.act_dot
    expected = (rate.velocity, rate.body_rate, rate.rotor_speed)
    for got, value in zip(
        (acceleration[:, :3], acceleration[:, 3:], spin_up), expected, strict=True
    ):
        np.testing.assert_allclose(got, value, rtol=0, atol=1e-12 * np.abs(value).max())


def test_a_rotor_at_rest_has_a_derivative_without_subnormal_numbers():
    """As graphics processors compute, in single precision."""
    case = Case.of(next(iter(helpers.IN_AIR)))
    still = {name: torch.zeros(getattr(case.motion, name).shape) for name in FIELDS}
    still |= {
        "quaternion": torch.tensor([[1.0, 0, 0, 0]] * COUNT),
        "position": 3 + still["position"],
    }
    given = Parameters.of(case.table).map(lambda array: torch.tensor(array, dtype=torch.float32))
    command, air = (torch.zeros(array.shape) for array in (case.command, case.air))
    assert torch.set_flush_denormal(True)
    try:
        rate = dynamics.derivative(
            given, dynamics.Motion(**still), command, air, 0.0, ROTOR_EFFECTS
        )
    finally:
        torch.set_flush_denormal(False)
    for name in FIELDS:
        assert torch.isfinite(getattr(rate, name)).all(), name
