"""The control step as one text: compiled for a processor it has the bits of the library."""

from types import SimpleNamespace

import numpy as np
import pytest

from quadrl.core import compiled
from quadrl.core.environment import Environment
from quadrl.core.source import whole
from quadrl.engines import native
from quadrl.engines.native.compiling import compile_generated

ROBUST = {
    "observe": {"rotor_speed": "estimated", "disturbance": True, "action_history": 2},
    "randomization": {
        "noise": {"position": 0.01, "attitude": 0.01},
        "observation_delay": (0.0, 0.03),
        "command_delay": (0.0, 0.02),
        "mass": (0.9, 1.1),
    },
    "weather": "light",
    "aerodynamics": "full",
}
CASES = [
    pytest.param(1, "hover", {}, id="hover"),
    pytest.param(8, "hover", ROBUST, id="robust"),
    pytest.param(1, "landing", {"control_mode": "thrust_body_rate"}, id="landing"),
]


def begun(task, **settings):
    environment = Environment(task, num_envs=19, seed=3, engine="free_flight", **settings)
    environment.reset()
    return environment


def text_of(environment):
    return whole(environment._step._program, environment.control_mode)


@pytest.mark.parametrize(("lanes", "task", "settings"), CASES)
def test_the_text_flies_the_bits_of_the_library(lanes, task, settings, monkeypatch):
    pair = [begun(task, **settings) for _ in range(2)]
    assert not pair[1].not_compiled
    monkeypatch.setenv("QUADRL_CFLAGS", "-O1")  # a third of the time to compile
    wide = f"#define LANES {lanes}\n" if lanes > 1 else ""  # one is what a GPU takes
    text = compile_generated(wide + text_of(pair[1]))
    monkeypatch.delenv("QUADRL_CFLAGS")
    flown = []
    starts = [] if "observe" in settings else ["begin", "place"]
    for name in ("step", *starts):
        given, own = getattr(native.library(), f"quadrl_{name}"), getattr(text, f"quadrl_{name}")
        own.restype, own.argtypes = given.restype, given.argtypes
    monkeypatch.setattr(pair[1].engine, "_step", lambda *a: flown.append(1) or text.quadrl_step(*a))
    shown, ends = SimpleNamespace(library=lambda: text, address=native.address), 0
    rng = np.random.default_rng(2)
    for _ in range(40):
        action = rng.normal(0, 0.4, (19, pair[0].action_size))
        done, expected = (each.step(action) for each in pair)
        np.testing.assert_array_equal(done.reward, expected.reward)
        for name, term in expected.observation.items():
            np.testing.assert_array_equal(done.observation[name], term, err_msg=name)
        np.testing.assert_array_equal(pair[0].engine.qpos, pair[1].engine.qpos)
        over = expected.terminated | expected.truncated
        ends += over.sum()
        first = pair[0].reset(over)
        with monkeypatch.context() as patch:
            patch.setattr(compiled, "native", shown if starts else native)
            for name, term in pair[1].reset(over).items():
                np.testing.assert_array_equal(first[name], term, err_msg=name)
    assert len(flown) >= 40 and ends
