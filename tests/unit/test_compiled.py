"""A task's step, compiled: the same bits as its functions give, or it is run as it is written."""

import ctypes
import dataclasses
import functools
import math
import os
import re
import time

import helpers
import numpy as np
import pytest
import torch
from helpers import variant

from quadrl import tasks
from quadrl.base import trace
from quadrl.base.errors import NativeError, QuadrlWarning
from quadrl.base.operations import FLAGS, LOGICAL, REVERSE, C
from quadrl.base.trace import Trace, look_up
from quadrl.conditions.sensor import SENSORS
from quadrl.conditions.solids import Cylinder, Gate, Pose
from quadrl.core.environment import Environment
from quadrl.engines.engine import ENGINES
from quadrl.engines.native import compiling
from quadrl.engines.rowwise import RowFunction
from quadrl.learning.config import TrainConfig
from quadrl.learning.run import would_gain
from quadrl.tasks.hover import Hover
from quadrl.testing import is_the_same_compiled

STEPS = 40
LOST = {"command_loss": 2.0, "command_jitter": 0.5, "command_delay": (0.0, 0.04)}
SEEN = {"rotor_speed": "estimated", "airspeed": True, "disturbance": True, "action_history": 2}


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
    assert made[1].not_compiled
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
            begun = [e.reset(over) for e in (one, other)]
            for name, term in begun[1].items():
                np.testing.assert_array_equal(begun[0][name], term, err_msg=name)
        ended += int(over.sum())
    return ended


SETTINGS = {
    "one": (1, {}),
    "batch": (21, {"vehicle": "racer", "engine": "free_flight"}),
    "loops": (3, {"vehicle": "hexa", "control_mode": "velocity"}),
    # Some come near the ground, which MuJoCo flies, at other physics steps than their neighbours.
    "loops in free flight": (21, {"control_mode": "thrust_body_rate", "engine": "free_flight"}),
    "drawn": (9, {"engine": "free_flight", "randomization": {"mass": (0.7, 0.9)}}),
    "randomized": (4, {"randomization": "full", "observe": SEEN}),
    "lost": (21, {"engine": "free_flight", "randomization": LOST, "observe": SEEN}),
}
# A batch of each task; the rest concerns a task's step alike, whatever it computes. The contract
# flies one aircraft of each.
FEW = ("hover", "landing", "race")
FLOWN = [(task, name) for name in SETTINGS for task in (tasks.TASKS if name == "batch" else FEW)]


@pytest.mark.slow
@pytest.mark.parametrize(("task", "name"), FLOWN)
def test_the_same_bits_as_the_functions_of_the_task(task, name):
    count, settings = SETTINGS[name]
    options = {"time_limit": 0.5, "settle_time": 0.2}
    one, other = pair(tasks.TASKS[task], options, num_envs=count, **settings)
    assert not one.not_compiled
    assert same_flights(one, other) >= count


@pytest.mark.parametrize("mode", ["rotor", "position"])
@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_who_diverges_ends_as_in_python_and_neighbours_fly_on(engine, mode):
    one, other = pair(num_envs=11, engine=engine, control_mode=mode)
    for environment in (one, other):
        helpers.idle(environment)
        environment.engine.qvel[[2, 9], 0] = np.nan, 1e7  # no number, and faster than a step sees
    given = [(helpers.idle(e), e.snapshot) for e in (one, other)]
    found, expected = (arrays({"done": d, "now": now}) for d, now in given)
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)
    np.testing.assert_array_equal(np.flatnonzero(given[0][0].diverged), [2, 9])
    same_flights(one, other, 5)


def test_a_step_that_fails_leaves_the_last_one_to_look_at(monkeypatch):
    environment = helpers.begun("landing", 3, engine="free_flight")
    helpers.idle(environment)
    before = arrays(environment.snapshot)
    before = {name: array.copy() for name, array in before.items()}

    def removed(rows, steps):
        raise NativeError("the rotor callbacks were removed")

    monkeypatch.setattr(environment.engine, "touch", removed)
    environment.engine.qpos[1, 2] = 0.05  # MuJoCo has to fly it
    with pytest.raises(NativeError, match="removed"):
        helpers.idle(environment)
    for name, array in arrays(environment.snapshot).items():
        np.testing.assert_array_equal(array, before[name], err_msg=name)


def moved(self, before, now, end):
    way = now.state.position[..., 0] - before.state.position[..., 0]
    turned = now.action[..., 0] - before.action[..., 0]
    return Hover.reward(self, before, now, end) | {"moved": way, "turned": turned}


MASS = {"error": lambda self, now: now.potentials.distance * now.parameters.mass}
READ = {  # members of a task, and how it is flown
    "true parameters": (MASS | {"true_parameters": True}, {"randomization": {"mass": (0.7, 0.9)}}),
    "the state and the action before": ({"reward": moved}, {}),
    "before, by loops that look at the state in between": (
        {"reward": moved},
        {"control_mode": "velocity"},
    ),
}


@pytest.mark.parametrize("case", READ)
def test_what_a_task_reads_is_what_it_is_live(case):
    members, settings = READ[case]
    one, other = pair(members=members, num_envs=3, **settings)
    assert not one.not_compiled
    same_flights(one, other)


POSTED = {
    "solids": lambda self: [
        *(Gate(name, opening=2.2) for name in ("first", "second")),
        Cylinder("post", radius=0.05),
    ],
    "place": lambda self, rng, start, state: {"post": Pose(1.3 * rng.level_direction())},
    "error": lambda self, now: now.clearance,
    "succeeded": lambda self, now, end: now.touched[..., 1] | (now.touch_speed > 0.5),
    "reward": lambda self, before, now, end: {
        "closer": before.clearance - now.clearance,
        "hit": np.where(before.touched[..., 0] | now.touched.any(-1), -1.0, 0.0),
        "post": now.solid("post")[..., 0] - before.solid("second")[..., 0],
    },
}


@pytest.mark.slow
@pytest.mark.parametrize(("count", "engine"), [(1, "mujoco"), (21, "free_flight")])
def test_solids_are_seen_and_touched(count, engine):
    options = {"time_limit": 1.5, "settle_time": 0.2}
    one, other = pair(options=options, members=POSTED, num_envs=count, engine=engine)
    assert not one.not_compiled
    hits = 0
    for seed in range(4):
        same_flights(one, other, seed=seed)
        hits += one.snapshot.touched.sum()
    assert hits or count == 1  # else nothing of a touch was compared


def noisy(self, now):
    return now.potentials.distance + torch.normal(0.0, 1.0, (1,)).item()


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
    written = helpers.begun(variant(terminated=terminated, compiled=False), 2)
    with pytest.warns(QuadrlWarning, match="the step of the task hover is not compiled"):
        environment = helpers.begun(variant(terminated=terminated), 2)
    for _ in range(4):
        first, second = (helpers.idle(each) for each in (environment, written))
        np.testing.assert_array_equal(first.terminated, second.terminated)


def test_a_transition_is_flattened_after_the_next_reset_too():
    environment = helpers.begun("hover", 3)
    done = helpers.idle(environment)
    before = environment.flatten(done.observation)
    environment.reset()
    np.testing.assert_array_equal(environment.flatten(done.observation), before)


def rays(self, now):
    return functools.reduce(np.add, [now.potentials.distance * k for k in range(4200)])


def norm(self, now):
    return np.linalg.norm(now.potentials.to_goal, axis=-1)


def summed(self, now):
    return np.cumsum(now.potentials.to_goal, axis=-1)[..., 2]


@pytest.mark.parametrize(
    ("name", "function", "reason"),
    [
        ("error", noisy, "something else each time"),
        ("terminated", branching, "all rows at once"),
        ("error", norm, "numpy.linalg.norm"),
        ("error", summed, "cumsum"),
        ("error", rays, "it needs more than 8000 operations"),  # the compiler would take long
    ],
)
def test_what_is_more_than_arithmetic_is_run_as_it_is_written(name, function, reason):
    task = variant(**{name: function})
    with pytest.warns(QuadrlWarning, match=reason):
        environment = helpers.begun(task, 2)
    assert reason in environment.not_compiled
    for _ in range(3):
        helpers.idle(environment)
    helpers.begun(task, 2)  # it is said once for a class of tasks


@pytest.mark.parametrize(
    "method", ["measure", "terminated", "error", "succeeded", "reward", "update", "observe"]
)
def test_a_fault_of_the_task_is_raised_as_it_is(method):
    def fail(self, *given):
        raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine"):
        Environment(variant(**{method: fail}))


def test_a_fault_with_symbols_alone_is_the_reason_for_which_it_is_not_compiled():
    def error(self, now):
        if now.potentials.distance.dtype != np.float64:
            raise KeyError("mine")
        return now.potentials.distance

    with pytest.warns(QuadrlWarning, match="with symbols it raises KeyError: 'mine'"):
        helpers.idle(helpers.begun(variant(error=error)))


def test_options_change_the_numbers_and_not_the_code(monkeypatch):
    # Also where two numbers happen to be equal: a wheel brings each task's code, for all options.
    # Without a compiler the task is run as it is written.
    sources = set()

    def note(source):
        sources.add(source)
        raise NativeError("there is no C compiler\nof any name")

    monkeypatch.setattr(compiling, "compile_generated", note)
    weights = {name: 1.0 for name in vars(Hover()) if name.endswith("_weight")} | {"altitude": 1.0}
    weights["smoothness_weight"] = 0.0
    for options in ({}, weights, {"time_limit": 1.0, "max_distance": 1.0}):
        with pytest.warns(QuadrlWarning, match="not compiled: there is no C compiler;"):
            helpers.idle(helpers.begun(variant(options=options)))
    assert len(sources) == 1


# ------------------------------------------------------------------------------ who is compiled


class Lazy:
    """Answers to every name with what it holds now."""

    held = {"weight": 1.0}

    def __getattr__(self, name):
        return Lazy.held[name]


class AttrDict(dict):
    __getattr__ = dict.__getitem__


PROXY, SETTINGS_OF = Lazy(), AttrDict(weight=1.0)
NUMBERS_OF = np.array([1.0])
VIEW = np.broadcast_to(NUMBERS_OF, 3)  # read-only, of what may change
LINE = np.polynomial.Polynomial([0.0, 1.0])


def put_number(weight):
    NUMBERS_OF[:] = weight


def put_slope(weight):
    LINE.coef[1] = weight


FOLLOWED = {  # what a reward reads, and how it changes
    "a lazy proxy": (lambda: PROXY.weight, lambda weight: Lazy.held.update(weight=weight)),
    "an AttrDict": (lambda: SETTINGS_OF.weight, lambda weight: SETTINGS_OF.update(weight=weight)),
    "a view": (lambda: VIEW[0], put_number),
    "a polynomial": (lambda: LINE(1.0), put_slope),
    "a library": (
        lambda: float(os.environ["WEIGHT"]),
        lambda weight: os.environ.update(WEIGHT=str(weight)),
    ),
}


@pytest.mark.parametrize("case", FOLLOWED)
def test_a_task_of_ones_own_follows_what_it_reads_elsewhere(case):
    weight, change = FOLLOWED[case]

    @dataclasses.dataclass(frozen=True)
    class Mine(Hover):
        def reward(self, before, now, end):
            return {"own": weight() * (1 + 0 * now.state.speed)}

    change(1.0)
    environment = helpers.begun(Mine(), 2)  # without a warning
    assert "`compiled = True`" in environment.not_compiled
    for value in (1.0, 2.0, 3.0):
        change(value)
        np.testing.assert_array_equal(helpers.idle(environment).reward, value)


def test_a_class_asks_for_itself_and_not_for_those_that_change_it():
    assert not helpers.begun(Hover(), 2).not_compiled
    assert not helpers.begun(variant(error=lambda self, now: now.time), 2).not_compiled
    inherited = type("Mine", (Hover,), {"error": lambda self, now: now.time})
    assert helpers.begun(inherited(), 2).not_compiled


def test_a_training_says_what_compiling_a_task_of_ones_own_would_gain(monkeypatch):
    def slow(self, now):
        time.sleep(1e-3)  # compiled, it is not called; by a sanitizer nothing else is sure to gain
        return now.potentials.distance

    own = ({"error": slow}, {"error": norm})
    kinds = [type(variant(name="mine", compiled=False, **members)) for members in own]
    monkeypatch.setitem(tasks.TASKS, "mine", kinds[0])
    said = r"`compiled = True` in the class \w+, a control step of 1 aircraft takes \d+ us, not \d+"
    assert re.search(said, would_gain(TrainConfig("mine", num_envs=1)))
    assert would_gain(TrainConfig("hover")) == ""  # it has it
    monkeypatch.setitem(tasks.TASKS, "mine", kinds[1])  # and this cannot
    assert would_gain(TrainConfig("mine", num_envs=1)) == ""


def test_every_task_of_quadrl_is_compiled():
    for task in tasks.TASKS.values():
        assert vars(task)["compiled"] is True


def test_a_constant_that_is_not_a_number_is_the_same_each_time():
    def error(self, now):
        return np.where(now.time > 100.0, np.nan, now.potentials.distance)

    one, other = pair(members={"error": error}, num_envs=2)
    assert not one.not_compiled
    same_flights(one, other)


COUNTED = []


def test_the_contract_flies_the_compiled_step_beside_the_written_one():
    def reward(self, before, now, end):
        COUNTED.append(1)
        return {"own": (1.0 if len(COUNTED) < 60 else 2.0) + 0 * now.state.speed}

    is_the_same_compiled(variant(options={"time_limit": 1.0}))
    with pytest.raises(AssertionError, match="compiled = True.*reward"):
        is_the_same_compiled(variant(reward=reward))


PAIR = (1.0, 2.0)
FIXED = np.array([1.0])


def test_what_cannot_change_is_compiled():
    def error(self, now):
        length = math.hypot(*PAIR) + np.linalg.norm(np.zeros(3)) + functools.partial(max)(1, 2)
        return now.potentials.distance * FIXED * np.pi * self.radius * PAIR[0] * length

    assert not helpers.begun(variant(error=error), 2).not_compiled


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("task", tasks.TASKS)
def test_what_a_transition_holds_is_its_own_but_the_observation(task, compiled):
    environment = helpers.begun(variant(tasks.TASKS[task], compiled=compiled), 3)
    held = [helpers.idle(environment) for _ in range(4)]
    kept = [arrays(dataclasses.replace(now, observation={}, truth={})) for now in held]
    copies = [{name: array.copy() for name, array in own.items()} for own in kept]
    seen = {name: array.copy() for name, array in held[-1].observation.items()}
    for rows in ([1, 2], None):
        environment.reset(rows)
    if compiled:
        helpers.idle(environment)  # as long as the state of an engine
        for name, array in seen.items():
            np.testing.assert_array_equal(held[-1].observation[name], array, err_msg=name)
    for own, copied in zip(kept, copies, strict=True):
        for name, array in own.items():
            np.testing.assert_array_equal(array, copied[name], err_msg=name)


# ------------------------------------------------------------------------------ single operations

NUMBERS = np.array([0.0, -0.0, 1.0, -1.5, 0.3, 2.0, 1e300, -1e-300, np.inf, -np.inf, np.nan])
UNARY = {"negative", "absolute", "sqrt", "sin", "cos", "exp", "log", "tan", "tanh", "arcsin",
         "arccos", "arctan", "invert", "logical_not", "floor"}  # fmt: skip
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
    step = compiling.compile_generated(source).step
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


@pytest.mark.parametrize("size", [1, 4])
def test_a_look_up_gives_the_entries_that_numpy_gives(size):
    table = np.random.default_rng(0).normal(size=(size, 2, 3))

    def compute(index):
        entries = look_up(table, np.stack([index, index + 1.0], axis=-1))  # (n, 2, 2, 3)
        return np.sum(entries[:, 0, 1] * entries[:, 1, 0], axis=-1) + look_up(
            table[:, 0, 0], np.array(2.0)
        )

    expected, found = compute(NUMBERS), run(compute, NUMBERS)
    np.testing.assert_array_equal(found, expected)
    # -0.0 and below are the first; the largest and infinity the last; NaN again the first.
    places = [0, 0, 1, 0, 0, 2, size, 0, size, 0, 0]
    entries = table[np.minimum(places, size - 1)]
    np.testing.assert_array_equal(look_up(table, NUMBERS), entries)


def test_a_look_up_does_not_reach_into_derivatives():
    def derivative(x):
        result, symbol = (x * look_up(np.array([2.0, 3.0]), np.floor(x))).item(), x.item()
        by = symbol.trace.vector_jacobian_product([result], [1.0], [symbol])
        return np.array(by, object) + 0 * x

    np.testing.assert_array_equal(run(derivative, np.array([0.5, 1.5])), [2.0, 3.0])


def test_tables_that_are_too_large_are_refused_with_their_size(monkeypatch):
    monkeypatch.setattr(trace, "MAX_TABLES", 5)

    def error(self, now):
        return now.potentials.distance * look_up(np.arange(6.0), now.time)

    with pytest.warns(QuadrlWarning, match="its look-ups need [0-9]+ numbers, more than 5"):
        assert helpers.begun(variant(error=error), 2).not_compiled


@pytest.mark.parametrize("name", sorted(REVERSE.keys() - {"floor", "look_up"}))
def test_every_derivative_is_that_of_differences(name):
    columns = np.random.default_rng(0).uniform(0.2, 1.4, (1 if name in UNARY else 2, 40))

    def function(*values):
        if name == "where":
            return np.where(values[0] < values[1], values[0] * values[0], 3 * values[1])
        return getattr(np, name)(*values)

    for k in range(len(columns)):

        def derivative(*values, k=k):
            result, symbol = function(*values).item(), values[k].item()
            by = symbol.trace.vector_jacobian_product([result], [1.0], [symbol])
            return np.array(by, object) + 0 * values[k]

        step = 1e-5 * (np.arange(len(columns)) == k)[:, None]
        ends = function(*(columns + step)) - function(*(columns - step))
        np.testing.assert_allclose(run(derivative, *columns), ends / 2e-5, rtol=1e-8, atol=1e-9)


def test_an_operation_without_a_derivative_is_refused():
    x = Trace().inputs(np.array(["x[i]"], object))
    with pytest.raises(TypeError, match="arctan2 has no derivative"):
        x.item().trace.vector_jacobian_product([np.arctan2(x, 2.0).item()], [1.0], x)


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


def test_a_function_takes_what_it_reads_of_a_hundred_posts_and_no_more():
    made = RowFunction(lambda row: row[:, 50:51] * row[:, 99:] - row[:, :1], 100, fixed=2)
    assert made.places == {0: 0, 1: 1, 50: 2, 99: 3} and made.taken == 4
    x, y = np.zeros((4, 8)), np.zeros((1, 8))  # for eight rows
    x[:] = np.arange(1.0, 5.0)[:, None] + np.arange(8)
    compute = compiling.compile_generated(made.source).compute
    compute(*(ctypes.c_void_p(a.ctypes.data) for a in (made.constants, x, y)), 8)
    np.testing.assert_array_equal(y[0], x[2] * x[3] - x[0])


ALL_SEEN = {
    "rotor_speed": "estimated",
    "relative_rotor_speed": True,
    "action_history": 1,
    "observation_history": 1,
    "privileged": True,
    "sensors": {
        "airspeed": {"noise": 0.3, "bias": 0.2, "delay": 0.1},
        "clearance": {"reach": 2.0, "noise": 0.01},
        "disturbance": {"rate": 10},
        "aim": {"beside_goal": True},
        "estimate": {"rate": 10},
        "state": {"delay": 0.05},
    },
}
DRAWN = {
    "noise": {"position": 0.01, "attitude": 0.02, "velocity": 0.05, "body_rate": 0.05},
    "bias": {"position": 0.02, "velocity": 0.03},
    "observation_delay": (0.0, 0.07),
    "rate_delay": (0.0, 0.03),
    "command_delay": (0.0, 0.03),
    "mass": (0.9, 1.1),
}


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("mode", ["rotor", "thrust_body_rate"])
def test_compiled_sensors_are_the_written_ones(engine, mode):
    """All of them, with errors, ages and rates, among resets and aircraft that diverge."""
    kind = type("Written", (Hover,), {"compiled": False})
    flown = {"engine": engine, "control_mode": mode, "num_envs": 11, "seed": 5}
    flown |= {"observe": ALL_SEEN, "randomization": DRAWN, "weather": "light"}
    flown |= {"events": ["rotor_failure", "gust_front"]}
    pair = [Environment(task, **flown) for task in (Hover(), kind())]
    for each in pair:
        each.reset()
    assert not pair[0].not_compiled and pair[1].not_compiled
    rng, ends, broken = np.random.default_rng(3), 0, 0
    for step in range(30):
        action = rng.normal(0, 0.5, (11, pair[0].action_size))
        if step in (9, 19):
            for each in pair:
                each.engine.qvel[step % 4] = 1e6
        done, expected = (each.step(action) for each in pair)
        for name, term in expected.observation.items():
            np.testing.assert_array_equal(done.observation[name], term, err_msg=name)
        np.testing.assert_array_equal(done.reward, expected.reward)
        np.testing.assert_array_equal(pair[0].privileged, pair[1].privileged)
        over = expected.terminated | expected.truncated | (np.arange(11) == step)
        ends, broken = ends + over.sum(), broken + expected.diverged.sum()
        first, other = (each.reset(over) for each in pair)
        for name, term in other.items():
            np.testing.assert_array_equal(first[name], term, err_msg=name)
        for name, array in pair[1].save().items():
            np.testing.assert_array_equal(pair[0].save()[name], array, err_msg=name)
    assert ends > 15 and broken == 2


def test_a_sensor_that_does_not_ask_for_it_is_not_compiled(monkeypatch):
    monkeypatch.setattr(SENSORS["airspeed"], "compiled", False)
    environment = Environment("hover", observe={"airspeed": True})
    environment.reset()
    assert environment.not_compiled == (
        "the class of the sensor airspeed does not say `compiled = True`"
    )


def test_long_histories_are_not_compiled():
    lengths = {length: Environment("hover", observe={"observation_history": length})
               for length in (2, 20)}  # fmt: skip
    for environment in lengths.values():
        environment.reset()
    assert not lengths[2].not_compiled
    assert lengths[20].not_compiled.startswith("its sensors remember")
