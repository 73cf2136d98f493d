"""Pictures by several renderers in one process, without a screen; each case is a process."""

import importlib.util
import sys

import pytest
from helpers import needs_dm_control
from processes import python

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux draws without a screen")

PREAMBLE = """
import os, mujoco, numpy as np
before = dict(os.environ)
import quadrl
assert dict(os.environ) == before
def ours():
    from quadrl.engines import mjcf
    from quadrl.rendering import Renderer
    model = mjcf.compile_model(quadrl.Vehicle())
    model.vis.quality.shadowsize, model.vis.quality.offsamples = 256, 0  # cheaper to draw
    return Renderer(model, 80, 60)
pose = [0, 0, 3, 1, 0, 0, 0]
def check(a, b):  # Mesa's threads round some pixels differently
    np.testing.assert_allclose(a.astype(int), b.astype(int), atol=3)
"""
OURS = """
renderer = ours()
first = renderer.frame(pose)
"""
MUJOCO = """
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
other = mujoco.Renderer(model, 60, 80)
other.update_scene(data)
draw = other.render
before = draw()
"""
DM_CONTROL = """
environment = quadrl.load("hover", task_kwargs={"random": 0})
environment.reset()
draw = lambda: environment.physics.render(48, 64)
before = draw()
"""
BOTH = """
check(draw(), before)
check(renderer.frame(pose), first)
with ours() as second:
    check(second.frame(pose), first)
check(draw(), before)
check(renderer.frame(pose), first)
assert before.std() > 10 and first.std() > 10
"""


def run(code, before="", **variables):
    """Run code in a process without a screen, warnings being errors; its end must be clean.

    Some of it may come before `import quadrl`.
    """
    if DM_CONTROL in code:
        needs_dm_control()
    names = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM")
    done = python("-W", "error", "-c", before + PREAMBLE + code, without=names, **variables)
    assert (done.stderr, done.stdout) == ("", "")


@pytest.mark.parametrize(
    "code",
    [
        OURS + MUJOCO + BOTH + "other.close()",
        OURS + MUJOCO + BOTH + "other.close()" + DM_CONTROL + BOTH,
        DM_CONTROL + OURS + BOTH,
    ],
    ids=["mujoco", "first", "second"],
)
def test_without_a_screen_it_draws_beside_other_renderers(code):
    """Each draws what it should and none spoils another's end, though mujoco was imported first."""
    run(code)


@pytest.mark.skipif(not importlib.util.find_spec("triton"), reason="triton is not installed")
@pytest.mark.parametrize(
    ("before", "code"),
    [("", OURS), ("", DM_CONTROL), ("", MUJOCO), ("import mujoco\n" + MUJOCO, "")],
    ids=["ours", "dm_control", "mujoco", "mujoco first"],
)
def test_triton_can_be_imported_after_a_picture(before, code):
    run(code + "\nimport triton\n", before, MUJOCO_GL="egl")


FORKED = """
import os, signal, sys
from quadrl.base.errors import RenderingUnavailable
child = os.fork()
if child == 0:
    signal.alarm(30)  # kills one that hangs
    try:
        in_child()
    except RenderingUnavailable as error:
        os._exit("forked from one that had drawn" not in str(error))
    os._exit(2)
assert os.waitpid(child, 0)[1] == 0
"""
CLOSED = "other.close()\ndel other, draw\n"


@pytest.mark.parametrize(
    ("code", "in_child"),
    [
        (OURS, "renderer.frame(pose)"),
        (OURS + "renderer.close()", "ours()"),
        (MUJOCO, "ours()"),
        (MUJOCO + CLOSED, "ours()"),
        (DM_CONTROL, "draw()"),
        (DM_CONTROL, "ours()"),
    ],
)
def test_what_is_forked_from_a_process_that_has_drawn_says_so_and_never_hangs(code, in_child):
    run(f"{code}\nin_child = lambda: {in_child}\n{FORKED}", MUJOCO_GL="egl")


def test_a_forked_process_draws_where_none_before_it_has():
    run("""
import os, signal
child = os.fork()
if child == 0:
    signal.alarm(60)
    assert ours().frame(pose).std() > 10
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
""")
