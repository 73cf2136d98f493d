"""Tasks and models of a user's own: they are flown, or refused with what is wrong with them."""

import dataclasses
import math

import helpers
import mujoco
import numpy as np
import pytest

from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import namespace
from quadrl.core.task import TaskState
from quadrl.engines import mjcf
from quadrl.engines.mujoco import DataEngine
from quadrl.tasks.hover import Hover
from quadrl.testing import takes_tensors

# ------------------------------------------------------------------------------- a user's own task


def changed_start(**changes):
    def begin(self, rng, parameters):
        start, state = Hover.begin(self, rng, parameters)
        return dataclasses.replace(start, **{k: f(start) for k, f in changes.items()}), state

    return {"begin": begin}


def changed(method, function):
    """A method of Hover whose result goes through a function."""

    def replaced(self, *args):
        return function(getattr(Hover, method)(self, *args))

    return {method: replaced}


def with_end(function):
    return changed("terminated", lambda ends: ends | {"own": function(ends["away"])})


def with_term(function):
    return changed("reward", lambda terms: terms | {"own": function(terms["progress"])})


HOSTILE = {  # methods, and what the error names
    "start of another shape": (changed_start(velocity=lambda s: s.velocity[:, :2]), "velocity"),
    "start for a batch": (changed_start(velocity=lambda s: np.zeros((5, 3))), "velocity"),
    "start that is NaN": (changed_start(velocity=lambda s: s.velocity * np.nan), "velocity"),
    "start that is far": (changed_start(position=lambda s: s.position + 1e11), "begin"),
    "quaternion of length 2": (changed_start(quaternion=lambda s: 2 * s.quaternion), "quaternion"),
    "no start": (changed("begin", lambda pair: pair[0]), "begin"),
    "a goal that is none": (changed("begin", lambda pair: (pair[0], TaskState(None))), "goal"),
    "reward that is NaN": (with_term(lambda p: p * np.nan), "reward"),
    "reward that is infinite": (with_term(lambda p: p + np.inf), "reward"),
    "reward of another shape": (with_term(lambda p: np.zeros((3, 1))), "own"),
    "reward that is text": (with_term(lambda p: np.full(np.shape(p), "a")), "own"),
    "no reward": (changed("reward", lambda terms: {}), "reward"),
    "a part more": (changed("observe", lambda p: p | {"wind": p["velocity"]}), "observe"),
    "an end for all": (with_end(lambda end: end.any()), "terminated 'own'"),
    "no ends": (changed("terminated", lambda ends: {}), "terminated"),
    "a part missing": (changed("observe", lambda p: dict(list(p.items())[1:])), "observe"),
    "a part too wide": (changed("observe", lambda p: p | {"goal": p["velocity"][:, :2]}), "goal"),
    "parts in disorder": (changed("observe", lambda p: dict(sorted(p.items()))), "observe"),
    "an end that is no bool": (with_end(lambda end: 1.0 * end), "terminated 'own'"),
    "an end of another shape": (with_end(lambda end: end[:, None]), "terminated 'own'"),
    "one end that is no bool": (changed("terminated", lambda ends: 0.0), "terminated"),
    "an error of another shape": (changed("error", lambda error: np.zeros(5)), "error"),
    "a success of another shape": (changed("succeeded", lambda done: done[0]), "succeeded"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_task_that_gives_what_none_may_is_refused(case):
    methods, name = HOSTILE[case]
    with helpers.refused() as caught:
        helpers.idle(helpers.begun(helpers.variant(**methods), 3))
    assert name in caught.value.name


def test_a_reward_that_is_nan_later_is_refused_too():
    def late(self, before, now, end):
        terms = Hover.reward(self, before, now, end)
        return terms | {"late": np.where(now.state.speed > 0.5, np.nan, 0.0)}

    environment = helpers.begun(helpers.variant(reward=late), 3)
    with helpers.refused() as caught:
        for _ in range(40):  # four rotors at full command: more than 0.5 m/s within a second
            environment.step(np.ones((3, 4)))
    assert "reward" in caught.value.name and math.isnan(caught.value.value["late"])


def test_what_a_task_raises_is_its_own_and_the_environment_goes_on():
    failing = [False]

    def terminated(self, now):
        if failing[0]:
            raise ZeroDivisionError("mine")
        return Hover.terminated(self, now)

    environment, other = (
        helpers.begun(helpers.variant(terminated=terminated, compiled=False), 2),
        helpers.begun("hover", 2),
    )
    failing[0] = True
    with pytest.raises(ZeroDivisionError, match="mine"):
        helpers.idle(environment)
    failing[0] = False
    environment.reset(), other.reset()
    for _ in range(5):
        now, expected = (e.step(np.full((2, 4), 0.2)) for e in (environment, other))
        np.testing.assert_array_equal(now.reward, expected.reward)


# ------------------------------------------------------------------------------ a user's own model

BRICK = """<mujoco><option timestep="0.01"/><worldbody><body><freejoint/><site name="s"/>
<geom size="0.1"/></body></worldbody><actuator>{}</actuator></mujoco>""".format(
    '<general site="s" dyntype="filter" gear="0 0 1"/>' * 4
)


def edited(edit):
    spec = mjcf.spec(Vehicle(), drawn=False)
    edit(spec)
    return spec.compile()


def with_body(spec):
    body = spec.worldbody.add_body(name="more", mass=0.1, inertia=[1e-3] * 3, explicitinertial=True)
    body.add_freejoint()


MODELS = {
    "empty": lambda: mujoco.MjModel.from_xml_string("<mujoco/>"),
    "brick": lambda: mujoco.MjModel.from_xml_string(BRICK),
    "hexa": lambda: mjcf.compile_model(VEHICLES["hexa"]),
    "body": lambda: edited(with_body),
    "step": lambda: edited(lambda spec: setattr(spec.option, "timestep", 0.02)),
    "unmarked": lambda: edited(lambda spec: setattr(spec.body("aircraft"), "userdata", (0, 0, 0))),
    "no air": lambda: edited(lambda spec: setattr(spec, "nuserdata", 0)),
}


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize("name", MODELS)
def test_a_model_that_is_no_aircraft_is_refused(name, engine):
    model = MODELS[name]()
    with helpers.refused(match="a model to fly needs"):
        DataEngine(Vehicle(), model, mujoco.MjData(model), altitude=3.0, engine=engine)


def test_a_term_without_a_gradient_is_named_with_the_cure():
    pytest.importorskip("torch")

    def reward(self, before, now, end):
        x, y = (now.state.position[..., k] for k in range(2))
        aside = namespace(x).sqrt(x * x + y * y)  # a length as one writes it by hand
        return Hover.reward(self, before, now, end) | {"miss": -aside}

    lost = r"'miss' has no gradient at rest in the goal by position; .*quadrl.base.rotation.norm"
    with pytest.raises(AssertionError, match=lost):
        takes_tensors(helpers.variant(reward=reward))
