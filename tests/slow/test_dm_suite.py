"""dm_control in processes of its own: its own suite test, and what draws its pictures."""

import functools
import re
from pathlib import Path

import pytest
from helpers import needs_dm_control
from processes import python

from quadrl.tasks import TASKS

needs_dm_control()

run = functools.partial(python, "-W", "error", without=("MUJOCO_GL",))


def test_dm_controls_own_suite_test_passes():
    output = run(Path(__file__).parents[1] / "dm_control_conformance.py").stderr
    assert output.rstrip().endswith("OK"), output  # nothing skipped either
    # One test of the constants, and nine of every task but for one of navigation.
    assert int(re.search(r"Ran (\d+) tests", output)[1]) == 9 * len(TASKS)
    for name in TASKS:
        assert output.count(f"task='{name}'") >= 2 * (8 - (name == "navigation"))


@pytest.mark.parametrize("first", ["", "import dm_control.suite; "])
def test_physics_render_draws_without_a_screen_and_leaves_no_variable(first):
    # In a process of its own: dm_control chooses what draws once.
    ignore = "import warnings; warnings.simplefilter('ignore'); " if first else ""
    code = (
        "import os, quadrl; before = dict(os.environ);"
        "environment = quadrl.load('hover'); environment.reset();"
        "assert dict(os.environ) == before;"
        "picture = environment.physics.render(96, 128, camera_id='track');"
        "assert picture.shape == (96, 128, 3), picture.shape;"
        "assert picture.reshape(-1, 3).std(axis=0).min() > 5, 'blank';"
        "assert 'MUJOCO_GL' not in os.environ; environment.physics.free()"
    )
    run("-c", ignore + first + code)
