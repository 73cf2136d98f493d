"""What the competition's simulator is told of the races."""

import numpy as np

from quadrl.core.scenario import Scenario
from quadrl.deploy.races import solids
from quadrl.tasks.arena import DEPTH


def test_each_race_has_its_solids_and_frames_as_thin_as_they_are():
    scenario = Scenario.of("lsy_race", engine="free_flight")
    told = solids(scenario, 3)
    places, sides = np.array(told["places"]), 4 * len(scenario.task.course.gates)
    assert places.shape == (3, len(told["shapes"]), 7)
    np.testing.assert_allclose(np.linalg.norm(places[..., 3:], axis=-1), 1.0)
    assert {size[0] for _, size in told["shapes"][:sides]} == {DEPTH}
    assert np.ptp(places[:, :sides, :3], axis=0).max() > 0.01  # each race has its own course
