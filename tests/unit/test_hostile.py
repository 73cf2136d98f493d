"""Hostile input: whatever is given, it works or is refused with one clear line of quadrl's own.

Never a crash, a hang, somebody else's exception, or a number that is silently wrong. Hypothesis
makes the input, the same at every run (`derandomize`).
"""

import contextlib
import dataclasses
import math

import helpers
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from quadrl import tasks
from quadrl.aircraft.rotors import PAPER_ROTORS
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.conditions.observing import Observing
from quadrl.conditions.randomization import Randomization
from quadrl.core.environment import Environment
from quadrl.core.task import Task
from quadrl.learning.config import TrainConfig
from quadrl.learning.settings import ALGORITHM_CONFIGS
from quadrl.tasks.hover import Hover

EXAMPLES = 25
profile = settings(
    max_examples=EXAMPLES,
    derandomize=True,
    database=None,
    deadline=None,  # a slow machine is no fault
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

ODD = st.sampled_from(
    [None, True, "", "5", "abc", b"5", (), [], {}, 10**400, -(10**400), 5j, math.nan, math.inf]
    + [-math.inf, 1e308, -1e308, 5e-324, -0.0, 0, -1, np.float32(2), np.array(2.0), np.ones(3)]
    + [(1, 2), ((1, 2, 3), (4,)), [[1, "x", 3]], float, object(), 2**63, np.int64(3)]
)
VALUES = st.one_of(ODD, st.floats(), st.integers(), st.text(max_size=5))


@contextlib.contextmanager
def refusal():
    """What is refused, is with an error of quadrl's in one line that says something."""
    try:
        yield
    except QuadrlError as error:
        text = str(error)
        assert len(text) > 10 and "\n" not in text.strip(), text
        assert len(text) < 1000, f"{len(text)} characters"


# ---------------------------------------------------------------------------------------- actions

DTYPES = st.sampled_from(["f2", "f4", "f8", "g", "c16", "i1", "i8", "u8", "?", "O", "U3", "m8[s]"])
ARRAYS = DTYPES.flatmap(
    lambda dtype: hnp.arrays(
        np.dtype(dtype),
        st.sampled_from([(4,), (2, 4), (), (0,), (3,), (4, 1), (1, 4), (2, 4, 1), (3, 4)]),
        elements=st.one_of(VALUES, st.none()) if dtype == "O" else None,
    )
)
LISTS = st.lists(st.one_of(VALUES, st.lists(VALUES, max_size=2)), min_size=3, max_size=5)
ACTIONS = st.one_of(ARRAYS, ARRAYS, LISTS, VALUES)
FLYING = helpers.begun(num_envs=2)


@profile
@given(ACTIONS)
@example(np.full((2, 4), 1e308))
@example(np.array([[np.inf, -np.inf, 0, 0], [0, 0, 0, 0]]))
@example(np.full((2, 4), 0.1j))
@example(np.full((2, 4), 0.5))
def test_an_action_is_flown_or_refused(action):
    before, taken = helpers.coordinates(FLYING.engine), False
    with refusal():
        now = FLYING.step(action)
        taken = True
    if not taken:
        np.testing.assert_array_equal(helpers.coordinates(FLYING.engine), before)
        return
    array = np.asarray(action)
    assert array.dtype.kind in "fiub" and np.isfinite(array.astype(float)).all()
    assert array.shape == (2, 4)
    assert all(np.isfinite(part).all() for part in (now.reward, *now.observation.values()))


# ---------------------------------------------------------------------- options and environments


def fly_briefly(task, **settings):
    """Two steps; every number finite, whatever diverges is terminated and counted."""
    environment = Environment(task, num_envs=2, seed=0, **settings)
    rotors = environment.vehicle.rotor_count
    seen = [environment.flatten(environment.reset())]
    for _ in range(2):
        now = environment.step(np.array([np.resize((0.3, -0.1, 0.2), rotors), np.ones(rotors)]))
        seen += [environment.flatten(now.observation), now.reward, now.error]
        assert (now.terminated >= now.diverged).all()
    assert all(np.isfinite(part).all() for part in seen)


def some_of(names):
    return st.dictionaries(st.sampled_from(list(names)), VALUES, min_size=1, max_size=2)


def fields(kind):
    return [field.name for field in dataclasses.fields(kind)]


@pytest.mark.slow
@pytest.mark.parametrize("name", list(tasks.TASKS))
def test_options_of_a_task_fly_or_are_refused(name):
    @profile
    @given(some_of(fields(tasks.TASKS[name])))
    def check(options):
        with refusal():
            fly_briefly(tasks.make(name, **options))

    check()


ARGUMENTS = {"num_envs": 2, "seed": 0, "vehicle": None, "num_threads": 1, "control_mode": "rotor"}
ARGUMENTS |= {"engine": "mujoco", "task": "hover", "randomization": None, "observe": None}
SMALL = VALUES.filter(lambda v: not (isinstance(v, int) and 100 < v <= 1 << 20))


@profile
@given(st.sampled_from(list(ARGUMENTS)), SMALL)
@example("seed", -1)
@example("vehicle", "racer")
@example("vehicle", [])
@example("num_threads", 1.5)
@example("randomization", 5)
@example("randomization", "mass")
@example("randomization", [("mass", (1, 2))])
@example("observe", "all")
def test_arguments_of_an_environment_work_or_are_refused(name, value):
    with refusal():
        environment = Environment(**(ARGUMENTS | {name: value}))
        assert np.isfinite(environment.reset()["position"]).all()


@profile
@given(
    st.dictionaries(
        st.sampled_from(fields(Randomization)),
        st.one_of(VALUES, st.tuples(VALUES, VALUES), st.tuples(st.floats(0, 1), st.floats(0, 1))),
        min_size=1,
        max_size=2,
    )
)
@example({"noise": {"position": 1e300}})
@example({"noise": {"attitude": 1e9}, "bias": {"attitude": 1e9}})
@example({"pushes": {"rate": 1e9, "velocity": 3000.0, "body_rate": 49.0}})
@example({"command_delay": 10.0, "observation_delay": (0.0, 10.0)})
def test_randomizations_fly_or_are_refused(randomization):
    with refusal():
        fly_briefly("hover", randomization=randomization)


@profile
@given(st.dictionaries(st.sampled_from(fields(Observing)), VALUES, min_size=1, max_size=2))
@example({"observation_history": 1000, "action_history": 1000})
def test_options_of_the_observation_fly_or_are_refused(observe):
    with refusal():
        fly_briefly("hover", observe=observe)


@profile
@given(
    st.one_of(
        hnp.arrays(
            st.sampled_from([np.int64, np.float64, np.bool_, object]), hnp.array_shapes(max_dims=2)
        ),
        st.lists(VALUES, max_size=3),
        st.lists(st.integers(-1, 3), max_size=3),
    )
)
@example(np.array([True]))
@example(np.array([0.5]))
def test_rows_to_reset_are_numbers_or_a_mask(rows):
    environment = helpers.begun(num_envs=3)
    before = environment.engine.qpos.copy()
    try:
        array = np.asarray(rows)
    except (ValueError, OverflowError):
        return
    with refusal():
        environment.reset(array)
        if array.dtype == bool and array.shape == (3,):
            named = set(np.flatnonzero(array))
        else:
            assert array.dtype.kind in "iu" or not len(array)
            named = set(array.tolist())
        changed = (environment.engine.qpos != before).any(axis=1)
        assert set(np.flatnonzero(changed)) == named


# ------------------------------------------------------------------------------------- parameters

NUMBERS = ("mass", "drag_coefficient", "moment_coefficient", "action_scale", "control_timestep")
ROTOR_NUMBERS = ("thrust_coefficient", "torque_coefficient", "lag_up", "lag_down", "max_speed")
NEAR = st.dictionaries(
    st.sampled_from(NUMBERS + ROTOR_NUMBERS), st.floats(0.01, 100), min_size=1, max_size=2
)


def vehicle(changes):
    """The paper's aircraft with parameters of its own or of all its rotors changed."""
    rotor = {n: v for n, v in changes.items() if n in fields(PAPER_ROTORS[0])}
    rotors = tuple(dataclasses.replace(r, **rotor) for r in PAPER_ROTORS)
    return Vehicle(**{"rotors": rotors} | {n: v for n, v in changes.items() if n not in rotor})


@profile
@given(some_of({*fields(Vehicle), *fields(PAPER_ROTORS[0])}) | NEAR, st.sampled_from([True, False]))
@example({"mass": 1e-15, "inertia": (1e-15,) * 3}, True)
@example({"mass": 1e10, "inertia": (1e10,) * 3}, False)
@example({"thrust_coefficient": 1e-15}, True)
@example({"lag_up": 1e10, "drag_coefficient": 1e10, "moment_coefficient": 1e10}, True)
def test_parameters_of_an_aircraft_fly_or_are_refused(changes, free):
    near = {n: v * getattr(Vehicle() if n in NUMBERS else PAPER_ROTORS[0], n)
            for n, v in changes.items() if n in NUMBERS + ROTOR_NUMBERS
            and isinstance(v, float) and 0.01 <= v <= 100}  # fmt: skip
    with refusal():
        made = vehicle(changes | near)
        fly_briefly("hover", vehicle=made, engine="free_flight" if free else "mujoco")


@pytest.mark.parametrize("name", ["train", *ALGORITHM_CONFIGS])
def test_a_configuration_is_sound_or_refused(name):
    kind = TrainConfig if name == "train" else ALGORITHM_CONFIGS[name]
    accepted = []

    @profile
    @given(some_of(fields(kind)))
    @example({})
    def check(values):
        with refusal():
            accepted.append(config := kind(**values))
            for field in dataclasses.fields(config):
                value, default = getattr(config, field.name), field.default
                if isinstance(default, bool):
                    assert isinstance(value, bool)
                elif isinstance(default, int):
                    assert isinstance(value, int) and not isinstance(value, bool)
                elif isinstance(default, float):
                    assert isinstance(value, (int, float)) and math.isfinite(value)

    check()
    assert accepted


@profile
@given(VALUES)
@example(Hover())
@example(type("Nameless", (Task,), {}))
@example(type("Odd", (Hover,), {"name": "two words"}))
@example(type("Taken", (Hover,), {"name": "landing"}))
def test_what_is_no_task_is_not_registered(kind):
    before = dict(tasks.TASKS)
    with helpers.refused():
        tasks.register(kind)
    assert before == tasks.TASKS
