"""A device is compared with the processor; here it is the processor itself, by the same text."""

import pytest

from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.learning import device_check
from quadrl.learning.device_check import Differences, compare

HOVER = Scenario.of("hover", engine="free_flight", time_limit=0.2)


def test_a_device_that_flies_the_same_shows_no_fault():
    found = compare(HOVER, "cpu", steps=25)
    # The same arithmetic in double precision; in single, 24 bits of a step's motion.
    assert found.flags == 0 and found.double == 0.0 and 0.0 < found.single < 1e-5
    assert found.ends >= device_check.COMPARED and found.fine("rotor")


def test_another_aircraft_is_seen(monkeypatch):
    def heavier(scenario, **given):
        return Environment(scenario, vehicle_options={"mass": 0.66}, **given)

    monkeypatch.setattr(device_check, "Environment", heavier)
    assert not compare(HOVER, "cpu", steps=5).fine("rotor")


@pytest.mark.parametrize(
    ("found", "modes"),
    [
        (Differences(0, 1e-9, 1e-6, 1), {"rotor": True, "velocity": True}),
        (
            Differences(flags=0, double=1e-9, single=1e-4, ends=1),
            {"rotor": False, "velocity": True},
        ),
        (Differences(1, 0.0, 0.0, 1), {"rotor": False, "velocity": False}),
    ],
)
def test_loops_may_differ_more_and_no_end_may(found, modes):
    assert {mode: found.fine(mode) for mode in modes} == modes
