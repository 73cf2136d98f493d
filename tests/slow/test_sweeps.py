"""The stored exact solutions are what an integration gives today."""

import sys
from pathlib import Path

import numpy as np
import pytest
import solutions

sys.path.append(str(Path(__file__).parents[1] / "data"))

import extreme  # noqa: E402
import make_reference  # noqa: E402


@pytest.mark.parametrize("name", ["leaning", "hexa"])
def test_the_stored_ends_are_what_an_integration_gives_today(name):
    for part, array in make_reference.flights(name).items():
        np.testing.assert_allclose(solutions.exact(name)[part], array, rtol=1e-9, atol=1e-9)


def test_the_stored_extreme_flights_are_what_an_integration_gives_today():
    vehicle = extreme.vehicles(make_reference.AIRCRAFT)[5]
    fresh = make_reference.extreme_flights(vehicle)
    np.testing.assert_allclose(solutions.exact("extreme/5"), fresh, rtol=1e-7, atol=1e-7)
