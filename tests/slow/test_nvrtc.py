"""The control step as one text, compiled for GPUs, which need not be there."""

import pytest

from quadrl.core.environment import Environment
from quadrl.core.launch import cubin
from quadrl.core.source import text

pytest.importorskip("cuda.core", reason="the extra gpu is not installed")
TASKS = (
    *("hover", "static_waypoint", "random_waypoint", "straight_and_level", "target_following"),
    *("race", "recovery", "trajectory"),
)


def source(task="hover", precision="float32", **settings):
    environment = Environment(task, engine="free_flight", **settings)
    environment.reset()
    return text(environment, precision)


@pytest.mark.parametrize("arch", ["sm_75", "sm_90", "sm_100"])
def test_hover_fits_into_the_registers(arch):
    _, used = cubin(source(), "float32", arch)
    assert used["step"]["registers"] <= 160 and used["step"]["spilled"] == 0


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("task", TASKS)
def test_every_task_is_compiled(task, precision):
    code, used = cubin(source(task, precision), precision, "sm_90")
    assert used.keys() == {"step", "start"} and b"step" in code.code


def test_a_text_that_is_wrong_is_refused():
    with pytest.raises(Exception, match="nothing_known"):
        cubin(source().replace("step_row(&b", "nothing_known(&b"), "float32", "sm_90")
