"""An integral of the position error takes away what a proportional controller leaves."""

import pytest

from quadrl.control import Gains
from quadrl.control.integrating import Integrating
from quadrl.core.scenario import Scenario
from quadrl.evaluation.rollout import fly, summarize


@pytest.mark.parametrize(("integral", "low", "high"), [(0.0, 0.1, 1.0), (1.0, 0.0, 0.05)])
def test_a_heavy_aircraft_hangs_below_the_goal_without_an_integral(integral, low, high):
    scenario = Scenario.of("hover", engine="free_flight", randomization={"mass": (1.15, 1.15)})
    gains = Gains(**{**scenario.task.gains, "level": 1.3, "height": 1.3})
    flyer = Integrating(scenario.aircraft, scenario.task, gains, integral)
    # k_z k_v e = g (mass - 1), of the factor: e below the goal.
    assert low <= summarize(fly(flyer, scenario, episodes=2))["position_error_m"] < high
