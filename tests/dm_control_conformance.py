"""dm_control's own suite test on our domain alone; a script, since it rewrites dm_control."""

import quadrl  # isort: skip - before mujoco, which reads MUJOCO_GL at its import

from absl.testing import absltest
from dm_control import suite

suite._DOMAINS.clear()
quadrl.suite.register()
assert sorted(suite.ALL_TASKS) == sorted(quadrl.suite.ALL_TASKS)

from dm_control.suite.suite_test import SuiteTest  # noqa: E402, F401 - reads ALL_TASKS

if __name__ == "__main__":
    absltest.main()
