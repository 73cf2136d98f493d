"""Hostile input: whatever is given, it works or is refused with one clear line of quadrl's own.

Never a crash, a hang, somebody else's exception, or a number that is silently wrong. Hypothesis
makes the input, the same at every run (`derandomize`).
"""

import contextlib
import dataclasses
import io
import json
import math
import pickle
import struct

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import quadrl
from quadrl import tasks
from quadrl.environment import ActionError, Environment
from quadrl.envs.gymnasium import QuadrotorEnv, QuadrotorVectorEnv
from quadrl.envs.torchrl import QuadrotorEnv as TorchEnv
from quadrl.errors import QuadrlError
from quadrl.flight import EngineError
from quadrl.learning import checkpoint
from quadrl.learning.config import (
    GAEConfig,
    PPOConfig,
    RunError,
    TrainConfig,
    TRPOConfig,
    make_task,
    parse_options,
)
from quadrl.policy import FORMAT, SHIPPED, Policy, PolicyError
from quadrl.simulation import SingleSimulation
from quadrl.task import Fields, OptionError, Task, TaskError
from quadrl.tasks.hover import Hover
from quadrl.vehicle import VEHICLES, Vehicle, VehicleError

EXAMPLES = 60
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
def refusal(*kinds):
    """What is refused, is with an error of quadrl's in one line that says something."""
    try:
        yield
    except QuadrlError as error:
        text = str(error)
        assert isinstance(error, kinds or QuadrlError), repr(error)
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


def core(num_envs):
    environment = Environment("hover", num_envs=num_envs, seed=0)
    environment.reset()
    return environment, environment.step, lambda now: [now.reward, *now.observation.values()]


def gymnasium_door(door):
    door.reset(seed=0)
    return door.environment, door.step, lambda now: now[:2]


def dm_control_door():
    door = quadrl.load("hover", {"random": 0})
    door.reset()
    environment = door.task._environment
    return environment, door.step, lambda now: [now.reward, *now.observation.values()]


def torchrl_door():
    door = TorchEnv("hover", 2, seed=0)
    met = door.reset()

    def step(action):
        tensor = action if isinstance(action, torch.Tensor) else torch.as_tensor(action)
        return door._step(met.clone().set("action", tensor, non_tensor=False))

    return door.environment, step, lambda now: [now["reward"].numpy(), now["observation"].numpy()]


DOORS = {
    "core, one": lambda: core(None),
    "core, two": lambda: core(2),
    "gymnasium": lambda: gymnasium_door(QuadrotorEnv()),
    "gymnasium vector": lambda: gymnasium_door(
        QuadrotorVectorEnv("hover", 2, autoreset_mode="DISABLED")
    ),
    "dm_control": dm_control_door,
}


def plain(action):
    """Whether an action is one that may be taken: real numbers, all of them finite."""
    array = np.asarray(action)
    return array.dtype.kind in "fiub" and np.isfinite(array.astype(float)).all()


@pytest.mark.parametrize("door", DOORS)
def test_an_action_is_flown_or_refused(door):
    environment, step, numbers = DOORS[door]()
    expected = (*environment.shape, 4)
    flown = []

    @profile
    @given(ACTIONS)
    @example(np.full(expected, 1e308))
    @example(np.full(expected, np.inf))
    @example(np.full(expected, 0.1j))
    @example(np.full(expected, 0.5))
    def check(action):
        before = environment.simulation.qpos.copy()
        accepted = False
        with refusal(ActionError):
            now = step(action)
            accepted = True
        if not accepted:
            np.testing.assert_array_equal(environment.simulation.qpos, before)
            return
        assert plain(action) and np.shape(action) == expected
        assert all(np.isfinite(part).all() for part in numbers(now))
        flown.append(action)
        if environment.shape or environment.simulation.qpos[2] < 1.0:
            environment.reset()

    check()
    assert len(flown) >= 3


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float64, torch.int64])
def test_torchrl_takes_a_tensor_or_refuses_it(dtype):
    _, step, numbers = torchrl_door()
    with refusal(ActionError):
        assert all(np.isfinite(part).all() for part in numbers(step(torch.ones(2, 4).to(dtype))))


@pytest.mark.parametrize(
    "action",
    [
        torch.full((2, 4), math.nan),
        torch.full((2, 4), -math.inf),
        torch.zeros(2, 5),
        torch.zeros(2),
        torch.zeros(2, 4, dtype=torch.complex64),
    ],
)
def test_torchrl_refuses_what_is_no_action(action):
    _, step, _ = torchrl_door()
    with pytest.raises(ActionError):
        step(action)


def test_a_refused_action_leaves_the_flight_as_it_was():
    def fly(hostile):
        environment = Environment("hover", num_envs=2, seed=3)
        environment.reset()
        for k in range(10):
            if hostile:
                for bad in (np.full((2, 4), np.nan), "abc", np.zeros(4)):
                    with pytest.raises(ActionError):
                        environment.step(bad)
            environment.step(np.full((2, 4), 0.1 * k - 0.5))
        return environment.simulation.qpos.copy()

    np.testing.assert_array_equal(fly(True), fly(False))


# ---------------------------------------------------------------------- options and environments


def fly_briefly(task, vehicle=None, engine="mujoco"):
    """Two steps; every number finite, whatever diverges is terminated and counted."""
    environment = Environment(task, num_envs=2, seed=0, vehicle=vehicle, engine=engine)
    seen = [environment.flatten(environment.reset())]
    for _ in range(2):
        now = environment.step(np.array([[0.3, -0.1, 0.2, 0.0], [1.0, 1.0, -1.0, -1.0]]))
        seen += [environment.flatten(now.observation), now.reward, now.error]
        assert (now.terminated >= now.diverged).all()
    assert all(np.isfinite(part).all() for part in seen)


def option_of(kind):
    names = [field.name for field in dataclasses.fields(kind)]
    return st.dictionaries(st.sampled_from(names), VALUES, min_size=1, max_size=2)


@pytest.mark.parametrize("name", list(tasks.TASKS))
def test_options_of_a_task_fly_or_are_refused(name):
    @profile
    @given(option_of(tasks.TASKS[name]))
    def check(options):
        with refusal(OptionError, TaskError):
            fly_briefly(tasks.make(name, **options))

    check()


@pytest.mark.parametrize(
    ("task", "option"),
    [
        ("hover", {"horizon": "5"}),
        ("hover", {"horizon": 10**400}),
        ("hover", {"settle": 1e308}),
        ("hover", {"radius": 1e300}),
        ("hover", {"altitude": 1e12}),
        ("target_following", {"slowest": 0, "fastest": 0}),
        ("target_following", {"climb_share": 2}),
        ("straight_and_level", {"line_speed": 0}),
        ("static_waypoint", {"waypoints": 5}),
        ("static_waypoint", {"waypoints": ((1, 2, "x"),)}),
        ("static_waypoint", {"waypoints": ((1, 2, 3e300),)}),
    ],
)
def test_an_option_that_came_through_once_is_refused(task, option):
    with pytest.raises(OptionError, match=next(iter(option))):
        tasks.make(task, **option)


TEXTS = st.one_of(
    st.text(max_size=30),
    st.builds(
        "{}={}".format,
        st.sampled_from(["horizon", "waypoints", "radius", "", "__class__", "name"]),
        st.one_of(
            st.text(max_size=10),
            st.recursive(
                st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=3),
                lambda inner: (
                    st.lists(inner, max_size=3)
                    | st.dictionaries(st.text(max_size=2), inner, max_size=2)
                ),
                max_leaves=6,
            ).map(json.dumps),
        ),
    ),
)


@profile
@given(st.sampled_from(["hover", "static_waypoint"]), st.lists(TEXTS, max_size=2).map(tuple))
@example("static_waypoint", ("waypoints=" + "[" * 100_000,))
@example("hover", ("horizon=" + "1" * 5000,))
@example("hover", ("horizon=1" + "0" * 400,))
@example("hover", ("horizon=NaN",))
def test_options_as_text_make_a_task_or_are_refused(task, pairs):
    with refusal(OptionError):
        assert isinstance(make_task(task, parse_options(pairs)), Task)


ARGUMENTS = {"num_envs": 2, "seed": 0, "vehicle": None, "num_threads": 1, "action": "rotor"}
ARGUMENTS |= {"engine": "mujoco", "task": "hover"}
SMALL = VALUES.filter(lambda v: not (isinstance(v, int) and 100 < v <= 1 << 20))


@profile
@given(st.sampled_from(list(ARGUMENTS)), SMALL)
@example("seed", -1)
@example("vehicle", "racer")
@example("vehicle", [])
@example("num_threads", 1.5)
def test_arguments_of_an_environment_work_or_are_refused(name, value):
    with refusal():
        environment = Environment(**(ARGUMENTS | {name: value}))
        assert np.isfinite(environment.reset()["position"]).all()


@profile
@given(
    st.one_of(
        hnp.arrays(st.sampled_from([np.int64, np.float64, np.bool_, object]), hnp.array_shapes()),
        st.lists(VALUES, max_size=3),
        st.lists(st.integers(-1, 3), max_size=3),
    )
)
@example(np.array([True]))
@example(np.array([0.5]))
def test_rows_to_reset_are_numbers_or_a_mask(rows):
    environment = Environment("hover", num_envs=3, seed=0)
    environment.reset()
    before = environment.simulation.qpos.copy()
    try:
        array = np.asarray(rows)
    except (ValueError, OverflowError):
        return
    with refusal(OptionError):
        environment.reset(array)
        if array.dtype == bool and array.shape == (3,):
            named = set(np.flatnonzero(array))
        else:
            assert array.dtype.kind in "iu" or not len(array)
            named = set(array.tolist())
        changed = (environment.simulation.qpos != before).any(axis=1)
        assert set(np.flatnonzero(changed)) == named


# ------------------------------------------------------------------------------------- parameters


def test_parameters_of_an_aircraft_fly_or_are_refused():
    names = [field.name for field in dataclasses.fields(Vehicle)]
    near = st.floats(0.01, 100).flatmap(
        lambda factor: st.sampled_from([n for n in names if n not in ("name", "inertia")]).map(
            lambda name: {name: getattr(Vehicle(), name) * factor}
        )
    )

    @profile
    @given(st.one_of(option_of(Vehicle), near), st.sampled_from(["mujoco", "flight"]))
    @example({"mass": 1e-15, "inertia": (1e-15,) * 3}, "mujoco")
    @example({"mass": 1e10, "inertia": (1e10,) * 3}, "flight")
    @example({"arm_length": 1e-3, "rotor_radius": 1e-3}, "mujoco")
    @example({"arm_length": 1e3, "rotor_radius": 1e3}, "flight")
    @example({"thrust_coefficient": 1e-15}, "flight")
    @example({"lag_rate": 1e10, "drag_coefficient": 1e10, "moment_coefficient": 1e10}, "flight")
    def check(values, engine):
        with refusal(VehicleError):
            vehicle = Vehicle(**values)
            fly_briefly("hover", vehicle, engine)

    check()


@pytest.mark.parametrize(
    "values",
    [
        {"mass": 10**400},
        {"mass": True},
        {"mass": 1e-300},
        {"physics_step": 1e-300},
        {"control_step": 1e300},
        {"physics_step": 1e-9},  # 50 million steps at every action
        {"thrust_coefficient": 5e-324},
        {"mass": 1e10, "thrust_coefficient": 1e-15},
        {"arm_length": 1e-5},
        {"inertia": (1e-300,) * 3},
        {"inertia": "abc"},
        {"name": None},
    ],
)
def test_an_aircraft_that_came_through_once_is_refused(values):
    with pytest.raises(VehicleError, match="control_step|" + next(iter(values))):
        Vehicle(**values)


@pytest.mark.parametrize("kind", [TrainConfig, PPOConfig, TRPOConfig, GAEConfig])
def test_a_configuration_is_sound_or_refused(kind):
    accepted = []

    @profile
    @given(option_of(kind))
    def check(values):
        with refusal():
            accepted.append(config := kind(**values))
            for field in dataclasses.fields(config):
                value, default = getattr(config, field.name), field.default
                if isinstance(default, int):
                    assert isinstance(value, int) and not isinstance(value, bool)
                elif isinstance(default, float):
                    assert isinstance(value, (int, float)) and math.isfinite(value)
            json.dumps(dataclasses.asdict(config), allow_nan=False)

    check()
    assert accepted


# ------------------------------------------------------------------------------------------ files


class Payload:
    def __reduce__(self):
        import os

        return os.system, ("touch ran",)


def of_header(header, data=b""):
    """A safetensors file with any header."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def sound_checkpoint(folder):
    path = folder / checkpoint.CHECKPOINT
    tensors = {"actor": {"weight": torch.ones(3, 2), "bias": torch.zeros(3)}, "steps": np.arange(4)}
    checkpoint.save(path, tensors, {"iteration": 3})
    return path.read_bytes()


SHIPPED_POLICY = (SHIPPED / "hover_ppo.safetensors").read_bytes()
READERS = {
    "policy": (Policy.load, PolicyError, FORMAT),
    "checkpoint": (checkpoint.load, RunError, checkpoint.FORMAT),
}
MUTATIONS = st.lists(
    st.tuples(
        st.sampled_from(["flip", "cut", "insert", "repeat", "number"]),
        st.one_of(st.integers(0, 40), st.integers(0, 1200), st.integers(0, 1 << 14)),
        st.binary(min_size=1, max_size=8),
    ),
    min_size=1,
    max_size=4,
)


def mutated(content, mutations):
    for kind, place, new in mutations:
        at = place % max(1, len(content))
        if kind == "flip":
            content = content[:at] + new + content[at + len(new) :]
        elif kind == "cut":
            content = content[:at] + content[at + len(new) :] if place % 2 else content[:at]
        elif kind == "insert":
            content = content[:at] + new + content[at:]
        elif kind == "repeat":
            content = content[:at] + content[at : at + 64] * 2 + content[at + 64 :]
        else:  # the length of the header
            content = new.ljust(8, b"\0") + content[8:]
    return content


def read_hostile(reader, path, content):
    """Read; a policy that is read gives finite actions."""
    load, kind, _ = READERS[reader]
    path.write_bytes(content)
    with refusal(kind):
        read = load(path)
        if isinstance(read, Policy):
            size = len(read.mean)
            observations = np.array([np.zeros(size), np.full(size, 1e30), np.full(size, -1e3)])
            actions = read(observations)
            assert actions.shape == (3, 4) and (np.abs(actions) <= 1).all()


@pytest.mark.parametrize("reader", READERS)
def test_a_mutated_file_is_read_or_refused(reader, tmp_path):
    sound = SHIPPED_POLICY if reader == "policy" else sound_checkpoint(tmp_path)
    path = tmp_path / "file.safetensors"

    @settings(profile, max_examples=5 * EXAMPLES)
    @given(MUTATIONS)
    def check(mutations):
        read_hostile(reader, path, mutated(sound, mutations))

    check()


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=4),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=5,
)
DTYPE_SIZES = {"F32": 4, "F64": 8, "F16": 2, "BF16": 2, "F8_E4M3": 1, "I64": 8, "BOOL": 1, "U8": 1}
NAMES = ["mean", "deviation", "weight_0", "bias_0", "weight_1", "a/b", "a", "/", "", "weight_-1"]
TENSORS = st.dictionaries(
    st.sampled_from(NAMES),
    st.tuples(st.sampled_from(list(DTYPE_SIZES)), st.lists(st.integers(0, 8), max_size=3)),
    max_size=5,
)


@pytest.mark.parametrize("reader", READERS)
def test_a_file_of_any_header_is_read_or_refused(reader, tmp_path):
    path = tmp_path / "file.safetensors"
    form = READERS[reader][2]
    ours = {"format": form, "task": "hover", "metadata": {}, "numbers": {}}
    keys = st.dictionaries(st.sampled_from(list(ours)), JSON, max_size=2)

    @settings(profile, max_examples=3 * EXAMPLES)
    @given(keys, TENSORS, st.binary(min_size=1, max_size=8))
    def check(changes, tensors, fill):
        header, data = {"__metadata__": {"quadrl": json.dumps({**ours, **changes})}}, b""
        for name, (dtype, shape) in tensors.items():
            size = DTYPE_SIZES[dtype] * math.prod(shape)
            place = [len(data), len(data) + size]
            header[name] = {"dtype": dtype, "shape": shape, "data_offsets": place}
            data += (fill * size)[:size]
        read_hostile(reader, path, of_header(header, data))

    check()


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\0" * 8,
        struct.pack("<Q", 2**63) + b"{}",
        struct.pack("<Q", 10**8) + b"{}",
        of_header(b'{"a":' * 100_000),
        of_header({"__metadata__": {"quadrl": "[" * 200_000}}),
        of_header({"__metadata__": {"quadrl": "1" * 5000}}),
        of_header({"__metadata__": {"quadrl": json.dumps({"format": checkpoint.FORMAT})}}),
    ],
)
def test_a_file_made_to_break_the_reader_is_refused(reader, content, tmp_path):
    load, kind, _ = READERS[reader]
    (path := tmp_path / "file.safetensors").write_bytes(content)
    with pytest.raises(kind):
        load(path)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("way", ["pickle", "torch", "numpy"])
def test_a_file_that_would_run_code_is_refused_and_does_not_run(reader, way, tmp_path):
    path, load = tmp_path / "file.safetensors", READERS[reader][0]
    content = io.BytesIO()
    if way == "pickle":
        content.write(pickle.dumps(Payload()))
    elif way == "torch":
        torch.save(Payload(), content)
    else:
        np.save(content, np.array([Payload()]), allow_pickle=True)
    path.write_bytes(content.getvalue())
    with pytest.raises(READERS[reader][1], match="damaged"):
        load(path)
    assert not (tmp_path / "ran").exists()
    if way == "pickle":  # the payload is alive: whoever unpickles it runs it, here in tmp_path
        pickle.loads(path.read_bytes())
        assert (tmp_path / "ran").exists()


@pytest.mark.parametrize("names", [("a", "a/b"), ("a/b", "a"), ("/", "//")])
def test_a_checkpoint_with_a_tensor_within_a_tensor_is_refused(names, tmp_path):
    place = {
        name: {"dtype": "F32", "shape": [1], "data_offsets": [4 * k, 4 * k + 4]}
        for k, name in enumerate(names)
    }
    table = {"quadrl": json.dumps({"format": checkpoint.FORMAT, "numbers": {}})}
    (path := tmp_path / "c").write_bytes(of_header({"__metadata__": table} | place, b"\0" * 8))
    with pytest.raises(RunError, match="damaged"):
        checkpoint.load(path)


def test_weights_that_overflow_are_refused(tmp_path):
    policy = Policy.load(SHIPPED / "hover_ppo.safetensors")
    # Each is finite; in single precision 128 of them with a tanh of 1 before each are not.
    large = (policy.weights[0], np.full_like(policy.weights[1], 3e38))
    dataclasses.replace(policy, weights=large).save(tmp_path / "policy.safetensors")
    with pytest.raises(PolicyError, match="so large"):
        Policy.load(tmp_path)


def test_a_saved_environment_of_another_shape_is_refused():
    saved = Environment("hover", num_envs=2, seed=0)
    saved.reset()
    kept = saved.save()
    for name in kept:
        for wrong in (kept[name][..., :1], np.zeros(7), kept[name].astype(np.complex128)):
            if wrong.shape != kept[name].shape or wrong.dtype != kept[name].dtype:
                with pytest.raises(OptionError, match=name):
                    Environment("hover", num_envs=2).restore({**kept, name: wrong})
    with pytest.raises(OptionError, match="steps is nothing"):
        Environment("hover", num_envs=2).restore({k: v for k, v in kept.items() if k != "steps"})


# ------------------------------------------------------------------------------- a user's own task


def hostile_task(**methods):
    """Hover with some methods replaced."""
    body = {"name": "hostile", "__annotations__": {}, **methods}
    return dataclasses.dataclass(frozen=True)(type("Hostile", (Hover,), body))()


def changed_start(**changes):
    def sample(self, draw, vehicle):
        start, fields = Hover.sample(self, draw, vehicle)
        return dataclasses.replace(start, **{k: f(start) for k, f in changes.items()}), fields

    return {"sample": sample}


def changed_reward(term):
    def reward(self, *args):
        terms = Hover.reward(self, *args)
        return terms | {"own": term(terms["progress"])}

    return {"reward": reward}


def changed_parts(function):
    def observe(self, *args):
        return function(Hover.observe(self, *args))

    return {"observe": observe}


HOSTILE = {
    "start of another shape": (changed_start(velocity=lambda s: np.zeros(3)[:2]), "velocity"),
    "start for a batch": (changed_start(velocity=lambda s: np.zeros((5, 3))), "velocity of shape"),
    "start that is NaN": (changed_start(velocity=lambda s: s.velocity * np.nan), "not finite"),
    "start that is far": (changed_start(position=lambda s: s.position + 1e11), "not finite"),
    "quaternion of length 2": (changed_start(quaternion=lambda s: 2 * s.quaternion), "quaternion"),
    "reward that is NaN": (changed_reward(lambda p: p * np.nan), "not finite.*'own'"),
    "reward that is infinite": (changed_reward(lambda p: p + np.inf), "not finite.*'own'"),
    "reward of another shape": (changed_reward(lambda p: np.zeros((3, 1))), "own"),
    "reward that is text": (changed_reward(lambda p: np.full(np.shape(p), "a")), "own"),
    "a part missing": (changed_parts(lambda p: dict(list(p.items())[1:])), "observe gives"),
    "a part too wide": (changed_parts(lambda p: p | {"goal": p["velocity"][..., :2]}), "goal"),
    "parts in disorder": (changed_parts(lambda p: dict(sorted(p.items()))), "in this order"),
    "an end that is no bool": (
        {"terminated": lambda self, state, m, f, v: np.asarray(m.distance)},
        "terminated has",
    ),
    "an end of another shape": (
        {"terminated": lambda self, state, m, f, v: np.zeros((7,), dtype=bool)},
        "terminated has",
    ),
    "an error of another shape": ({"error": lambda self, s, m, f: np.zeros(5)}, "error has"),
}


@pytest.mark.parametrize("num_envs", [None, 3])
@pytest.mark.parametrize("case", HOSTILE)
def test_a_task_that_gives_what_none_may_is_refused(case, num_envs):
    methods, says = HOSTILE[case]
    environment = Environment(hostile_task(**methods), num_envs=num_envs, seed=0)
    with pytest.raises(TaskError, match=says):
        environment.reset()
        environment.step(np.zeros((*environment.shape, 4)))


@pytest.mark.parametrize("num_envs", [None, 3])
def test_a_reward_that_is_nan_later_is_refused_too(num_envs):
    def late(self, before, now, *args):
        terms = Hover.reward(self, before, now, *args)
        return terms | {"late": np.where(now.speed > 0.5, np.nan, 0.0) + 0 * now.distance}

    environment = Environment(hostile_task(reward=late), num_envs=num_envs, seed=0)
    environment.reset()
    with pytest.raises(TaskError, match="not finite.*'late': nan"):
        for _ in range(40):  # four rotors at full command: more than 0.5 m/s within a second
            environment.step(np.ones((*environment.shape, 4)))


def test_what_a_task_raises_is_its_own_and_the_environment_goes_on():
    failing = [True]

    def terminated(self, *args):
        if failing[0]:
            raise ZeroDivisionError("mine")
        return Hover.terminated(self, *args)

    environment = Environment(hostile_task(terminated=terminated), num_envs=2, seed=0)
    failing[0] = False
    environment.reset()
    failing[0] = True
    with pytest.raises(ZeroDivisionError, match="mine"):
        environment.step(np.zeros((2, 4)))
    failing[0] = False
    environment.reset()
    other = Environment("hover", num_envs=2, seed=0)
    other.reset()
    other.reset()
    for _ in range(5):
        now, expected = (e.step(np.full((2, 4), 0.2)) for e in (environment, other))
        np.testing.assert_array_equal(now.reward, expected.reward)


@profile
@given(VALUES)
@example(Hover())
@example(type("Nameless", (Task,), {}))
@example(type("Odd", (Hover,), {"name": "two words"}))
@example(type("Taken", (Hover,), {"name": "landing"}))
def test_what_is_no_task_is_not_registered(kind):
    before = dict(tasks.TASKS)
    with pytest.raises(OptionError):
        tasks.register(kind)
    assert before == tasks.TASKS


def test_fields_of_a_task_may_be_its_own_numbers():
    @dataclasses.dataclass
    class Own(Fields):
        extra: np.ndarray

    def sample(self, draw, vehicle):
        start, fields = Hover.sample(self, draw, vehicle)
        return start, Own(goal=fields.goal, extra=draw.uniform(0, 1))

    fly_briefly(hostile_task(sample=sample))


# ------------------------------------------------------------------------------ a user's own model

PENDULUM = """<mujoco><option timestep="0.01"/><worldbody><body><joint name="hinge"/>
<geom size="0.1" pos="0.3 0 0"/></body></worldbody>
<actuator><motor joint="hinge"/></actuator></mujoco>"""
BRICK = """<mujoco><option timestep="0.01"/><worldbody><body><freejoint/><site name="s"/>
<geom size="0.1"/></body></worldbody><actuator>{}</actuator></mujoco>""".format(
    '<general site="s" dyntype="filter" gear="0 0 1"/>' * 4
)


def with_body(spec):
    body = spec.worldbody.add_body(name="more", mass=0.1, inertia=[1e-3] * 3, explicitinertial=True)
    body.add_freejoint()


def with_step(spec):
    spec.option.timestep = 0.02


def unmarked(spec):
    spec.body("aircraft").userdata = (0, 0, 0)


@pytest.mark.parametrize("engine", ["mujoco", "flight"])
@pytest.mark.parametrize(
    "model",
    [
        lambda: mujoco.MjModel.from_xml_string("<mujoco/>"),
        lambda: mujoco.MjModel.from_xml_string(PENDULUM),
        lambda: mujoco.MjModel.from_xml_string(BRICK),
        *(
            lambda edit=edit: (spec := Vehicle().spec(drawn=False), edit(spec), spec.compile())[2]
            for edit in (with_body, with_step, unmarked)
        ),
    ],
    ids=["empty", "pendulum", "brick", "body", "step", "unmarked"],
)
def test_a_model_that_is_no_aircraft_is_refused(model, engine):
    made = model()
    with pytest.raises(EngineError, match="a model to fly needs"):
        SingleSimulation(Vehicle(), made, mujoco.MjData(made), altitude=3.0, engine=engine)


def test_a_users_scene_is_flown():
    spec = Vehicle().spec(contact=True)
    spec.worldbody.add_geom(
        name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 1, 1], pos=[3, 0, 1]
    )
    model = spec.compile()
    simulation = SingleSimulation(Vehicle(), model, mujoco.MjData(model), altitude=3.0)
    environment = Environment("hover", seed=0, simulation=simulation)
    environment.reset()
    assert np.isfinite(environment.step(np.zeros(4)).reward)


@pytest.mark.parametrize("name", list(VEHICLES))
def test_every_aircraft_keeps_its_parameters(name):
    # Checking turns whole numbers into floats and nothing else.
    again = Vehicle(**dataclasses.asdict(VEHICLES[name]))
    assert again == VEHICLES[name]
