"""A batch among solids, built for a processor: clearance, touch and rays."""

import numpy as np
import pytest
import torch

from quadrl.core import batch as batch_module
from quadrl.core.batch import Batch
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario

AIRCRAFT, STEPS = 24, 60


@pytest.fixture(autouse=True)
def _quickly(monkeypatch):
    monkeypatch.setattr(batch_module, "FEWEST", AIRCRAFT)
    monkeypatch.setenv("QUADRL_CFLAGS", "-O1")


def forest(trees):
    return Scenario.of("navigation", engine="free_flight", trees=trees, control_mode="velocity")


def test_navigation_measures_what_the_engine_measures():
    flown = forest(20)
    batch, environment = (
        Batch(flown, AIRCRAFT, 3, "cpu", "float64"),
        Environment(flown, num_envs=AIRCRAFT, seed=3),
    )
    environment.reset()
    batch.reset()
    torch.manual_seed(0)
    same, nearest = np.ones(AIRCRAFT, dtype=bool), np.inf
    for _ in range(STEPS):
        batch.action[0].uniform_(-1.0, 1.0)
        batch.action[0, :, 0] = 1.0
        done, found = environment.step(batch.action[0].numpy()), batch.step()
        same &= environment.engine.clearance() > 1.0  # nearer, MuJoCo may fly
        over = done.terminated | done.truncated
        np.testing.assert_allclose(
            found.final.numpy()[same],
            np.concatenate(list(done.observation.values()), axis=-1)[same],
            rtol=0,
            atol=1e-14,
        )
        np.testing.assert_array_equal(found.over.numpy()[same], over[same])
        ranges = np.exp(done.observation["range_finder"])
        nearest = min(nearest, ranges[same].min(initial=np.inf))
    assert nearest < 2.5


def test_an_aircraft_that_flies_into_a_tree_has_touched_it():
    flown = forest(66)
    batch = Batch(flown, AIRCRAFT, 3, "cpu")
    batch.reset()
    batch.action[0, :, 0] = 1.0
    ends = torch.zeros(len(batch.layout.ends))
    for _ in range(200):
        ends += batch.step().ends.sum(1)
    found = dict(zip(batch.layout.ends, ends.tolist(), strict=True))
    assert found["obstacle"] > AIRCRAFT / 2
