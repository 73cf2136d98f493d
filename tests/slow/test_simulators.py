"""Policies in the simulators themselves, where their environments exist."""

import pytest

from quadrl.base.errors import QuadrlError
from quadrl.deploy.crosscheck import crosscheck
from quadrl.deploy.simulators import SIMULATORS, environment_of
from quadrl.evaluation.controllers import policy_of


@pytest.mark.parametrize("simulator", SIMULATORS)
@pytest.mark.parametrize("name", ["hover", "hover_robust_crazyflie_brushless"])
def test_matched_flights_are_those_of_quadrl_in_the_same_air(simulator, name, monkeypatch):
    monkeypatch.setenv("QUADRL_INSTALL", "no")
    try:
        environment_of(simulator)
    except QuadrlError as error:
        pytest.skip(str(error))
    found = crosscheck(policy_of(name), simulators=(simulator,), episodes=4)
    assert not any(one.wrong for each in found.checks.values() for one in each)
    own = [row for row in found.rows if row.flown_in == "quadrl"][-2:]  # in its air, if it differs
    there = [row for row in found.rows if row.aircraft == "matched"]
    for row, like in zip(there, own, strict=True):
        assert row.success_rate == pytest.approx(like.success_rate, abs=0.25)
        assert row.position_error_m == pytest.approx(like.position_error_m, rel=0.3, abs=1e-4)
