"""Flights of every layout against the exact solution of the paper's equations, in both engines.

The ends of the flights were integrated by tests/reference.py and stored (tests/data/README.md).
"""

import dataclasses

import helpers
import pytest
import reference
import solutions

# Ratios of the errors of a step and of a quarter of it. The RK4 of MuJoCo 3 turns the attitude once
# a step by the mean of the stages' body rates, so the attitude and what follows from it are of
# second order, 1/16; body rates and rotor speeds know no attitude and are of fourth order, 1/256,
# as all of free flight and of MuJoCo 4 is. A wrong coefficient would leave an error that stays.
FOURTH = dict.fromkeys(reference.QUANTITIES[:5], 256)
SECOND = dict.fromkeys(("position", "attitude", "velocity", "body_velocity"), 16)
ORDERS = {"mujoco": FOURTH if helpers.FOURTH_ORDER else SECOND, "free_flight": FOURTH}
# Largest errors of a flight of 20 control steps, 1 s of the paper's aircraft, by share of the step.
# With the velocity in the body frame, as the paper has it, the error of the attitude times the
# speed, up to 19 m/s, comes on top.
LIMITS = {1: 2.5e-3, 1 / 4: 1.5e-4}
BODY_LIMITS = {1: 7e-3, 1 / 4: 4.5e-4}


def worst(engine, name, share):
    """Largest deviation of the flights of a name, by quantity."""
    vehicle = helpers.LAYOUTS.get(name, helpers.LAYOUTS["paper"])
    finer = dataclasses.replace(vehicle, physics_timestep=vehicle.physics_timestep * share)
    apart = solutions.deviations(finer, engine, name, 20 * vehicle.control_timestep)
    return dict(zip(reference.QUANTITIES, apart.max(axis=0), strict=True))


@pytest.mark.parametrize("engine", ORDERS)
@pytest.mark.parametrize("name", helpers.LAYOUTS)
def test_flights_converge_to_the_exact_solution(name, engine):
    coarse, fine = (worst(engine, name, share) for share in LIMITS)
    for error, share in ((coarse, 1), (fine, 1 / 4)):
        assert error.pop("body_velocity") < BODY_LIMITS[share]
        assert max(error.values()) < LIMITS[share], (share, error)
    for quantity, ratio in ORDERS[engine].items():
        if quantity in coarse:
            assert coarse[quantity] / fine[quantity] == pytest.approx(ratio, rel=0.2), quantity
    assert max(fine["body_rate"], fine["rotor_speed"]) < 1e-7
