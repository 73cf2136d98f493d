"""A reference from a file is flown as well however finely it is sampled."""

import functools

import numpy as np
import pytest

from quadrl import Policy
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.rollout import fly, summarize
from quadrl.tasks import make

TURN = 2 * np.pi / 8


def distance(folder, who, rate, decimals, noise):
    """Mean distance [m] of flights along a slow eight, all of which are flown to the end."""
    time = np.arange(0, 16, 1 / rate)
    place = np.stack([np.sin(TURN * time), np.sin(2 * TURN * time) / 2, 0 * time], axis=-1)
    place += noise * np.random.default_rng(1).normal(size=place.shape)
    lines = (",".join(f"{x:.{decimals}f}" for x in row) for row in place)
    rows = (f"{t:.6f},{line}" for t, line in zip(time, lines, strict=True))
    path = folder / f"{rate}_{decimals}.csv"
    path.write_text("\n".join(["t,x,y,z", *rows]))
    task = make("trajectory", figure=str(path))
    policy = Policy.pretrained("trajectory")
    vehicle = policy.scenario.aircraft
    flies = policy if who == "policy" else make_controller("geometric", task, vehicle)
    figures = summarize(fly(flies, task, episodes=5, vehicle=vehicle))
    assert figures["survival_rate"] == 1.0
    return figures["distance_m"]


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    """The distance along the file of 20 Hz with six digits."""
    folder = tmp_path_factory.mktemp("usual")
    return functools.cache(lambda who: distance(folder, who, 20, 6, 0.0))


@pytest.mark.parametrize("who", ["policy", "controller"])
@pytest.mark.parametrize("rate", [50, 240, 1000])
@pytest.mark.parametrize(("decimals", "noise"), [(6, 0.0), (4, 0.0), (3, 0.0), (6, 1e-5)])
def test_flights_are_as_near_as_along_20_hz(who, rate, decimals, noise, usual, tmp_path):
    assert distance(tmp_path, who, rate, decimals, noise) == pytest.approx(usual(who), rel=0.2)
