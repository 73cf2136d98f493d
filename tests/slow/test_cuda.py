"""The control step as one text, compiled for a GPU, which need not be there."""

import pytest

from quadrl.core.environment import Environment
from quadrl.core.source import whole

OPTIONS = {"device_as_default_execution_space": True, "fma": False, "arch": "sm_90"}


@pytest.mark.parametrize(
    "settings",
    [{}, {"control_mode": "velocity", "observe": {"rotor_speed": "estimated"}}],
    ids=["hover", "loops and sensors"],
)
def test_cuda_compiles_the_text(settings):
    cuda = pytest.importorskip("cuda.core", reason="the extra gpu is not installed")
    environment = Environment("hover", **settings)
    environment.reset()
    text = whole(environment._step._program, environment.control_mode)

    def compiled(text):
        return cuda.Program(text, "c++", cuda.ProgramOptions(**OPTIONS)).compile("cubin").code

    assert b"control_step" in compiled(text)
    with pytest.raises(Exception, match="nothing_known"):
        compiled(text.replace("quadrl_step(s,", "nothing_known(s,"))
