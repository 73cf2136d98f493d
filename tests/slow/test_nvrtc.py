"""The control step as one text, compiled for GPUs, which need not be there."""

import re

import pytest

from quadrl.core.environment import Environment
from quadrl.core.launch import cubin
from quadrl.core.source import text

pytest.importorskip("cuda.core", reason="the extra gpu is not installed")
TASKS = (
    *("hover", "static_waypoint", "random_waypoint", "straight_and_level", "target_following"),
    *("race", "recovery", "trajectory"),
)


UNCERTAIN = {"mass": (0.9, 1.1), "command_delay": (0.0, 0.04), "noise": {"position": 0.01}}
CONDITIONS = [
    ("hover", {"control_mode": "velocity"}),
    ("hover", {"aerodynamics": "full", "weather": "light"}),
    ("hover", {"randomization": UNCERTAIN, "observe": {"rotor_speed": "estimated"}}),
    ("navigation", {"control_mode": "velocity"}),
]


def source(task="hover", precision="float32", **settings):
    environment = Environment(task, engine="free_flight", num_envs=8, **settings)
    environment.reset()
    return text(environment, precision)


@pytest.mark.parametrize("arch", ["sm_75", "sm_90", "sm_100"])
def test_hover_fits_into_the_registers(arch):
    _, used = cubin(source(), "float32", arch)
    assert used["step"]["registers"] <= 160 and used["step"]["spilled"] == 0


@pytest.mark.parametrize("arch", ["sm_75", "sm_90", "sm_100"])
@pytest.mark.parametrize("task", TASKS)
def test_every_task_is_compiled(task, arch):
    code, used = cubin(source(task), "float32", arch)
    assert used.keys() == {"step", "start"} and b"step" in code.code
    if arch == "sm_90":
        assert cubin(source(task, "float64"), "float64", arch)[1].keys() == used.keys()


@pytest.mark.parametrize(("task", "settings"), CONDITIONS)
def test_every_condition_is_compiled(task, settings):
    for precision in ("float32", "float64"):
        used = cubin(source(task, precision, **settings), precision, "sm_90")[1]
        assert used.keys() == {"step", "start"}


@pytest.mark.parametrize(("task", "settings"), [("hover", {}), ("race", {}), *CONDITIONS])
def test_nothing_is_computed_in_double_precision_but_the_reduction_of_angles(task, settings):
    """CUDA's sine and cosine reduce angles beyond 1e5 so, which no flight has."""
    from cuda.bindings import nvrtc

    whole = re.sub(r'_Pragma\("GCC unroll \d+"\)', "", source(task, **settings))
    options = [b"--gpu-architecture=compute_90", b"--ftz=true", b"--prec-div=false"]
    options += [b"--prec-sqrt=false", b"--device-as-default-execution-space"]
    _, program = nvrtc.nvrtcCreateProgram(whole.encode(), b"step", 0, [], [])
    (result,) = nvrtc.nvrtcCompileProgram(program, len(options), options)
    assert result == 0
    _, size = nvrtc.nvrtcGetPTXSize(program)
    ptx = b" " * size
    nvrtc.nvrtcGetPTX(program, ptx)
    found = set(re.findall(r"^\s*(\w+\.\S*f64\S*)", ptx.decode(), re.MULTILINE))
    assert found <= {"cvt.rn.f64.s64", "mul.f64", "cvt.rn.ftz.f32.f64"}


def test_a_text_that_is_wrong_is_refused():
    with pytest.raises(Exception, match="nothing_known"):
        cubin(source().replace("step_row(&b", "nothing_known(&b"), "float32", "sm_90")
