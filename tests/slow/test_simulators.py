"""Policies in the simulators themselves, where their environments exist."""

import pytest
from runs import train

from quadrl.base.errors import QuadrlError
from quadrl.deploy import betaflight
from quadrl.deploy.crosscheck import crosscheck
from quadrl.deploy.simulators import SIMULATORS, environment_of, there
from quadrl.evaluation.controllers import policy_of
from quadrl.evaluation.policy import Policy
from quadrl.learning.config import TrainConfig


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


def test_betaflight_holds_a_place_by_its_own_rate_loops(tmp_path):
    if not there(betaflight.NAME):
        pytest.skip(f"{betaflight.WANTED} is not installed")
    config = TrainConfig(
        "hover", vehicle="racer", control_mode="thrust_body_rate", aerodynamics="full"
    )
    policy = Policy.load(train(config, tmp_path / "run"))
    one, other = (
        crosscheck(policy, simulators=(betaflight.NAME,), episodes=3).rows[2] for _ in range(2)
    )
    assert one.flown_in == "Betaflight 4.6.0" and one.delay == 0.0
    assert one.success_rate == other.success_rate == 1.0
    assert one.position_error_m < 0.01
    assert one.position_error_m == pytest.approx(other.position_error_m, rel=0.2)
