"""Resets of some rows, saving and restoring, and what a task remembers."""

import copy
import dataclasses
import pickle

import helpers
import numpy as np
import pytest
import safetensors.numpy
from helpers import EVERYTHING, drawn, flying
from test_sensors import WILD as EVERY_SENSOR

from quadrl import tasks
from quadrl.aircraft.parameters import AIRCRAFT
from quadrl.aircraft.vehicle import Vehicle
from quadrl.conditions.weather import Weather
from quadrl.core.environment import Environment
from quadrl.core.task import TaskState
from quadrl.tasks.hover import Hover

ENGINES = ("mujoco", "free_flight")
PAPER = Vehicle()


def test_a_reset_of_some_rows_renews_all_that_is_theirs_and_nothing_else():
    environment = flying("target_following", control_mode="velocity")
    for action in helpers.random_actions(6, 4):
        environment.step(action)

    def everything():
        now = environment.snapshot
        parts = {"time": now.time, "action": now.action, "rotor_command": now.rotor_command}
        parts |= {"goal": environment.goals(), "drawn": drawn(environment)}
        parts |= {f"task.{f.name}": getattr(now.task, f.name) for f in dataclasses.fields(now.task)}
        parts |= {
            f.name: getattr(now.potentials, f.name) for f in dataclasses.fields(now.potentials)
        }
        parts |= {"coordinates": helpers.coordinates(environment.engine)}
        return {name: np.array(value) for name, value in parts.items()}

    before = everything()
    environment.reset(np.array([1, 2]))
    after, others = everything(), [0, 3]
    for name, value in before.items():
        np.testing.assert_array_equal(after[name][others], value[others], err_msg=name)
        # The task has a path, at 1 m from where it starts.
        if name not in ("task.goal", "distance"):
            changed = (after[name][[1, 2]] != value[[1, 2]]).reshape(2, -1).any(axis=1)
            assert changed.all(), name
    now = environment.snapshot
    np.testing.assert_allclose(now.time, [0.3, 0, 0, 0.3], rtol=1e-15)
    np.testing.assert_array_equal(now.action[[1, 2]], 0)
    np.testing.assert_array_equal(now.rotor_command[[1, 2]], now.state.rotor_speed[[1, 2]])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_buffer_of_the_caller_is_not_kept(dtype):
    environment, action = flying(randomization=None), np.full((4, 4), 0.25, dtype=dtype)
    environment.step(action)
    action[:] = -1.0
    np.testing.assert_array_equal(environment.snapshot.action, 0.25)
    action[:] = 7.0  # beyond +-1 as well: what is remembered is what was asked
    environment.step(action)
    np.testing.assert_array_equal(environment.snapshot.action, 7.0)
    np.testing.assert_array_equal(action, 7.0)


def resumed(task, path, **settings):
    """Records of a flight, and of two that go on from its middle, through a file."""
    actions = helpers.random_actions(30, 4)
    environment = flying(task, **settings)
    helpers.fly(environment, actions[:11])
    np.savez(path, **environment.save())
    expected = helpers.fly(environment, actions[11:])  # with resets, so that the streams matter
    with np.load(path) as file:
        saved = dict(file)
    fresh, used = flying(task, seed=77, reset=False, **settings), flying(task, seed=78, **settings)
    helpers.fly(used, actions[:5])
    for other in (fresh, used, environment):
        other.restore(saved)
        yield other, helpers.fly(other, actions[11:]), expected


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("randomization", [EVERYTHING, "full"], ids=["parameters", "full"])
def test_what_was_drawn_survives_save_and_restore(randomization, engine, tmp_path):
    gusty = Weather(wind_speed=7.72, gust_speed=5.0, gust_time=0.4)
    around = {"weather": gusty, "observe": EVERY_SENSOR} if randomization == "full" else {}
    for task in (tasks.make("hover", time_limit=0.6), helpers.SHORT["a low landing"]):
        settings = {"engine": engine, "randomization": randomization, **around}
        for _, got, expected in resumed(task, tmp_path / "saved.npz", **settings):
            helpers.assert_records(got, expected)


@pytest.mark.parametrize("engine", ENGINES)
def test_numbers_that_were_not_drawn_yet_do_not_stop_a_state_from_going_on(engine):
    settings = {"engine": engine, "randomization": "full", "count": 3}
    environment, fresh = (flying("hover", **settings) for _ in range(2))
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 3, environment.action_size))
    helpers.fly(environment, actions[:4])
    saved = environment.save()
    names = environment.randomizer.sampler.names
    sizes = len(dataclasses.fields(environment.randomization.sizes))
    assert names[-3:] == ("command_jitter", "command_loss", "loss_time")
    assert all(name.startswith("log_") for name in names[-3 - sizes : -3])
    saved["randomizer.drawn"] = saved["randomizer.drawn"][:, : -3 - sizes]
    del saved["randomizer.last"], saved["randomizer.left"]
    expected = helpers.fly(environment, actions[4:])
    fresh.restore(saved)
    helpers.assert_records(helpers.fly(fresh, actions[4:]), expected)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_reward_of_the_last_commands_goes_on_from_a_file(engine):
    """Compiled steps keep columns, and a file keeps rows: actions and commands were mixed up."""
    given = {"task_options": {"smoothness_weight": 10.0}, "engine": engine, "num_envs": 4}
    one, other = (Environment("hover", seed=seed, **given) for seed in (1, 2))
    one.reset()
    first, second = helpers.random_actions(2, 4)
    one.step(first)
    other.restore(safetensors.numpy.load(safetensors.numpy.save(one.save())))
    np.testing.assert_array_equal(other.step(second).reward, one.step(second).reward)


@pytest.mark.parametrize("engine", ENGINES)
def test_wind_that_somebody_sets_survives_save_and_restore(engine):
    # The wind of a batch used to be a field of the model, which no state of MuJoCo's holds.
    environment, other = (flying(randomization=None, engine=engine, seed=s) for s in (1, 2))
    environment.engine.wind[:] = np.arange(12.0).reshape(4, 3) / 4
    environment.step(np.zeros((4, 4)))
    saved = environment.save()
    other.restore(saved)
    np.testing.assert_array_equal(other.engine.wind, environment.engine.wind)
    for action in helpers.random_actions(5, 4):
        records = [helpers.recorded(e, e.step(action)) for e in (environment, other)]
        helpers.assert_records(records[1:], records[:1])


@pytest.mark.parametrize(
    ("randomization", "changed"),
    [(None, {"mass": 0.7}), ({"mass": (0.9, 1.1)}, {"inertia": (8e-3, 8e-3, 1.4e-2)})],
)
def test_the_state_of_another_aircraft_is_not_restored(randomization, changed):
    other = flying(randomization=randomization)
    before, broken = drawn(other), other.save()
    vehicle = dataclasses.replace(PAPER, **changed)
    wrong = flying(randomization=randomization, vehicle=vehicle).save()
    broken["engine.rows"][0, 0] = np.nan
    for saved, name in ((wrong, "engine.begun"), (broken, "engine.rows")):
        with helpers.refused(name):
            other.restore(saved)
        np.testing.assert_array_equal(drawn(other), before)


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize("randomization", [None, {"mass": (0.9, 1.1)}])
@pytest.mark.parametrize("count", [1, 3])
def test_an_aircraft_that_changed_in_flight_is_saved_copied_and_resumed(
    count, randomization, engine
):
    """The first rotor loses 15 % of its thrust and torque in the third step, as in the guide."""
    settings = {"num_envs": count, "engine": engine, "randomization": randomization}
    environment, fresh = (Environment("hover", seed=s, **settings) for s in (3, 4))
    environment.reset(), fresh.reset()
    flown = environment.engine
    actions = helpers.random_actions(6, count)
    for k, action in enumerate(actions[:3]):
        if k == 2:
            weak = flown.parameters[:1].copy()
            for name in ("thrust_coefficient", "torque_coefficient"):
                weak["rotor"][name][:, 0] *= 0.85
            flown.write_parameters(np.array([0]), weak)
        environment.step(action)
    copies = [copy.deepcopy(environment), pickle.loads(pickle.dumps(environment)), fresh]
    fresh.restore(safetensors.numpy.load(safetensors.numpy.save(environment.save())))
    for action in actions[3:]:
        record, *others = (helpers.recorded(e, e.step(action)) for e in (environment, *copies))
        helpers.assert_records(others, [record] * len(others))
    for one in copies:
        np.testing.assert_array_equal(one.engine.parameters, flown.parameters)
    assert (flown.begun != flown.parameters).any()
    # What cannot change in flight, and what is no number, is refused, and changes nothing.
    before = fresh.engine.parameters.copy()
    for name, value in (("rotor_count", 6.0), ("mass", np.nan)):
        broken = environment.save()
        broken["engine.parameters"].view(AIRCRAFT)[name][0] = value
        with helpers.refused():
            fresh.restore(broken)
        np.testing.assert_array_equal(fresh.engine.parameters, before)


@dataclasses.dataclass(frozen=True)
class Trail(TaskState):
    """Where the aircraft was after the last two steps, and the fastest that it has been."""

    last: np.ndarray  # (N, 3) [m]
    older: np.ndarray  # (N, 3) [m]
    fastest: np.ndarray  # (N,) [m/s]


@dataclasses.dataclass(frozen=True)
class Remembering(Hover):
    """Keeps arrays of the live state, without a copy of its own."""

    def begin(self, rng, parameters):
        start, state = super().begin(rng, parameters)
        zero = 0 * start.position
        return start, Trail(state.goal, start.position, start.position, fastest=zero[:, 0])

    def update(self, before, now):
        fastest = np.maximum(now.task.fastest, now.state.speed)
        return Trail(now.task.goal, now.state.position, now.task.last, fastest)

    def reward(self, before, now, end):
        terms = super().reward(before, now, end)
        way = now.state.position - now.task.older  # over two control steps
        return terms | {"way": np.sqrt((way**2).sum(-1)), "fastest": now.task.fastest}


@pytest.mark.parametrize("control_mode", ["rotor", "position"])
def test_what_a_task_remembers_of_the_live_state_stays_and_survives(control_mode, tmp_path):
    task = Remembering(time_limit=0.6)
    environment = flying(task, control_mode=control_mode)
    been = [np.array(environment.snapshot.state.position)] * 2
    for action in helpers.random_actions(8, 4):
        now = environment.step(action)
        been.append(np.array(environment.snapshot.state.position))
        # It was the position two steps ago, and not a view of what is there by now.
        way = np.sqrt(((been[-1] - been[-3]) ** 2).sum(-1))
        np.testing.assert_allclose(now.reward_terms["way"], way, rtol=1e-12)
        assert way.min() > 0
    settings = {"control_mode": control_mode}
    for _, got, expected in resumed(task, tmp_path / "saved.npz", **settings):
        helpers.assert_records(got, expected)
