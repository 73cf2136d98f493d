"""A task's step, compiled: the same bits as its functions give, or it is run as it is written."""

import ctypes
import dataclasses
import functools

import helpers
import numpy as np
import pytest

from quadrl import tasks
from quadrl.base.trace import FLAGS, LOGICAL, C, Trace
from quadrl.core.environment import Environment
from quadrl.engines import native
from quadrl.tasks.hover import Hover

STEPS = 40
SEEN = {"rotor_speed": "estimated", "airspeed": True, "disturbance": True, "action_history": 2}


def variant(base=Hover, options=None, **members):
    """A task with some methods or members replaced."""
    body = {"name": base.name, "__annotations__": {}, **members}
    return dataclasses.dataclass(frozen=True)(type("Variant", (base,), body))(**(options or {}))


def arrays(record, name=""):
    """Every array of nested records, by name."""
    if dataclasses.is_dataclass(record):
        record = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}
    if isinstance(record, dict):
        return {k: v for n, part in record.items() for k, v in arrays(part, f"{name}.{n}").items()}
    return {name: record} if isinstance(record, np.ndarray) else {}


def pair(base=Hover, options=None, members=None, **settings):
    """An environment of a task, and one whose step is not compiled."""
    made = []
    for compiled in (True, False):
        task = variant(base, options, **(members or {}), compiled=compiled)
        made.append(Environment(task, seed=5, **settings))
        made[-1].reset()
    assert not made[1].compiled
    return made


def same_flights(one, other, steps=STEPS, seed=0):
    """Fly both, episode after episode; every array must be the same. How many episodes ended."""
    rng, ended = np.random.default_rng(seed), 0
    for _ in range(steps):
        action = rng.uniform(-0.7, 0.7, (one.num_envs, one.action_size))
        given = [(e.step(action), e.snapshot) for e in (one, other)]
        found, expected = (arrays({"done": d, "now": now}) for d, now in given)
        assert found.keys() == expected.keys()
        for name, array in expected.items():
            assert found[name].dtype == array.dtype, name
            np.testing.assert_array_equal(found[name], array, err_msg=name)
        done = given[1][0]
        over = done.terminated | done.truncated
        if over.any():
            one.reset(over), other.reset(over)
        ended += int(over.sum())
    return ended


@pytest.mark.parametrize(
    ("count", "settings"),
    [
        (1, {}),
        (21, {"vehicle": "racer", "engine": "free_flight"}),
        (3, {"vehicle": "hexa", "control_mode": "velocity"}),
        (4, {"randomization": "full", "observe": SEEN}),
    ],
    ids=["one", "batch", "loops", "randomized"],
)
@pytest.mark.parametrize("task", tasks.TASKS)
def test_the_same_bits_as_the_functions_of_the_task(task, count, settings):
    options = {"time_limit": 0.5, "settle_time": 0.2}
    one, other = pair(tasks.TASKS[task], options, num_envs=count, **settings)
    assert one.compiled
    assert same_flights(one, other) >= count


def test_true_parameters_are_read_live():
    members = {
        "true_parameters": True,
        "error": lambda self, now: now.potentials.distance * now.parameters.mass,
    }
    one, other = pair(members=members, num_envs=3, randomization={"mass": (0.7, 0.9)})
    assert one.compiled
    same_flights(one, other)


def test_the_state_and_the_action_before_are_seen():
    def reward(self, before, now, end):
        moved = now.state.position[..., 0] - before.state.position[..., 0]
        turned = now.action[..., 0] - before.action[..., 0]
        return Hover.reward(self, before, now, end) | {"moved": moved, "turned": turned}

    for mode, compiled in (("rotor", True), ("velocity", False)):
        one, other = pair(members={"reward": reward}, num_envs=3, control_mode=mode)
        # The loops read the state at every physics step, so that of the step before is gone.
        assert (one.compiled is not None) == compiled
        same_flights(one, other)


def noisy(self, now):
    return np.random.default_rng().normal(size=now.state.height.shape) + now.potentials.distance


def branching(self, now):
    return now.state.height < (1.0 if now.state.speed.max() > 0 else 0.0)


FAR = "now.potentials.to_goal[..., 0] > 0.1, now.potentials.to_goal[..., 1] > 0.1"
SILENT = [  # what NumPy does with objects that it does not know is not what it does with numbers
    f"np.any([{FAR}], axis=0)",
    f"np.logical_or.reduce([{FAR}])",
    "(now.potentials.distance > 0.1).astype(bool)",
    "np.count_nonzero(now.potentials.to_goal > 0.1, axis=-1) > 1",
    "np.array([bool(x) for x in now.potentials.distance > 0.1])",
    "now.potentials.distance > (0.5 if now.potentials.distance[0] == 0.5 else 0.1)",
    "np.sum(now.potentials.to_goal, axis=-1, where=now.potentials.to_goal > 0) > 0.1",
    "np.max(now.potentials.to_goal, axis=-1, initial=0.3) > 0.3",
    "np.nan_to_num(now.potentials.distance) > 0.1",
    "np.sum(np.concatenate([now.potentials.to_goal] * 3, axis=-1), axis=-1) > 0.1",
    "np.isin(now.potentials.distance, [0.5]) | (now.potentials.distance > 0.1)",
]


@pytest.mark.parametrize("expression", SILENT)
def test_what_numpy_would_do_otherwise_with_symbols_is_not_compiled(expression):
    # Not where an episode begins: a task whose episodes end there is refused.
    terminated = eval(f"lambda self, now: ({expression}) & (now.time > 0)", {"np": np})
    environments = [
        helpers.begun(variant(terminated=terminated, compiled=compiled), 2)
        for compiled in (True, False)
    ]
    for _ in range(4):
        first, second = (helpers.idle(environment) for environment in environments)
        np.testing.assert_array_equal(first.terminated, second.terminated)
    assert environments[0].compiled is None and environments[0].not_compiled


def test_a_task_that_takes_the_compiler_long_is_run_as_it_is_written():
    def rays(self, now):
        turned = [now.potentials.distance * k for k in range(1500)]
        return functools.reduce(np.add, turned)

    assert helpers.begun(variant(error=rays), 2).compiled is None


def test_a_transition_is_flattened_after_the_next_reset_too():
    environment = helpers.begun("hover", 3)
    done = helpers.idle(environment)
    before = environment.flatten(done.observation)
    environment.reset()
    np.testing.assert_array_equal(environment.flatten(done.observation), before)


@pytest.mark.parametrize(
    "members",
    [
        {"error": noisy},
        {"terminated": branching},
        {"error": lambda self, now: np.linalg.norm(now.potentials.to_goal, axis=-1)},
        {"error": lambda self, now: np.cumsum(now.potentials.to_goal, axis=-1)[..., 2]},
    ],
    ids=["random numbers", "a branch", "linear algebra", "an unknown operation"],
)
def test_what_is_more_than_arithmetic_is_run_as_it_is_written(members):
    environment = helpers.begun(variant(**members), 2)
    assert environment.compiled is None
    for _ in range(3):
        helpers.idle(environment)


def test_options_share_the_compiled_code(monkeypatch, tmp_path):
    monkeypatch.setenv("QUADRL_CACHE", str(tmp_path))
    native.compile_generated.cache_clear()
    for limit, weight in ((5.0, 17.0), (7.0, 19.0)):
        task = tasks.make("hover", time_limit=limit, progress_weight=weight)
        assert helpers.begun(task, 1).compiled
    assert len(list(tmp_path.iterdir())) == 1


def test_what_somebody_holds_is_not_written_to_again():
    environment = helpers.begun("hover", 3)
    held = [helpers.idle(environment) for _ in range(12)]
    kept = [{name: array.copy() for name, array in arrays(now).items()} for now in held]
    for _ in range(12):
        helpers.idle(environment)
    for now, copies in zip(held, kept, strict=True):
        for name, array in arrays(now).items():
            np.testing.assert_array_equal(array, copies[name], err_msg=name)


# ------------------------------------------------------------------------------ single operations

NUMBERS = np.array([0.0, -0.0, 1.0, -1.5, 0.3, 2.0, 1e300, -1e-300, np.inf, -np.inf, np.nan])
UNARY = {"negative", "absolute", "sqrt", "sin", "cos", "exp", "log", "tan", "tanh", "arcsin",
         "arccos", "arctan", "invert", "logical_not"}  # fmt: skip
LIBRARY = {"sin", "cos", "exp", "log", "tan", "tanh", "arcsin", "arccos", "arctan", "arctan2"}


def run(compute, *columns):
    """What a function of rows gives, compiled: one output (n,) of inputs (n,)."""
    trace = Trace()
    places = (np.array([f"state[{k} * columns + i]"], object) for k in range(len(columns)))
    result = compute(*(trace.inputs(place) for place in places))
    body = trace.body({"out[i]": np.asarray(result, object)[0]})
    source = (
        "#include <math.h>\n#include <stdint.h>\nvoid step(int64_t n, int64_t columns, "
        "const double* c, const double* state, double* out)\n{ for (int64_t i = 0; i < n; ++i) {\n"
        f"{body} }} }}".replace("void step", '__attribute__((visibility("default"))) void step')
    )
    step = native.compile_generated(source).step
    step.argtypes, step.restype = [ctypes.c_int64] * 2 + [ctypes.c_void_p] * 3, None
    table, constants = np.array(columns, dtype=float), np.array([*trace.constants, 0.0])
    out = np.empty(table.shape[1])
    step(*2 * (table.shape[1],), *(a.ctypes.data for a in (constants, table, out)))
    return out


@pytest.mark.parametrize("name", sorted(C.keys() | {"square", "power", "clip"}))
def test_every_operation_is_that_of_numpy(name):
    first, second = (grid.ravel() for grid in np.meshgrid(NUMBERS, NUMBERS))
    columns = [first] if name in UNARY else [first, second]
    function = getattr(np, name, None)

    def compute(*values):
        if name in LOGICAL:
            return np.where(function(*(value > 0.5 for value in values)), 1.0, 0.0)
        if name == "where":
            return np.where(values[0] > 0.5, values[0], values[1])
        if name in ("square", "power"):
            return values[0] ** 2 + 0 * values[-1]
        if name == "clip":
            return np.clip(values[0], -1.0, 1.0) + 0 * values[1]
        result = function(*values)
        return np.where(result, 1.0, 0.0) if name in FLAGS else result

    with np.errstate(all="ignore"):
        expected, found = compute(*columns), run(compute, *columns)
    if name in LIBRARY:
        np.testing.assert_allclose(found, expected, rtol=1e-15, atol=1e-300)
    else:
        np.testing.assert_array_equal(found, expected)


def test_sums_and_choices_over_an_axis():
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(3, 50))

    def compute(*values):
        vector = np.stack(values, axis=-1)
        largest = np.max(vector, axis=-1)
        pairs = vector[..., None, :] - vector[..., :, None]
        spread = pairs.max(axis=(-2, -1))
        centred = vector - vector.max(axis=-1, keepdims=True)
        first, rest = np.split(centred, [1], axis=-1)
        chosen = np.where((vector[..., 0] > 0) & (largest > 1), np.sum(vector, axis=-1), -largest)
        return chosen + spread * first[..., 0] + np.sum(rest, axis=-1, keepdims=True)[..., 0]

    np.testing.assert_array_equal(run(compute, *columns), compute(*columns))
