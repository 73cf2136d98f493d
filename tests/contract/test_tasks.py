"""Every task keeps the contract of quadrl.testing, and flies through every API as by mj_step."""

import dataclasses

import flights
import numpy as np
import pytest
from helpers import mostly_slow, needs_dm_control

from quadrl.base.rotation import Array, namespace
from quadrl.control.modes import CONTROL_MODES
from quadrl.control.reading import Reading
from quadrl.core.one_of import OneOf
from quadrl.core.task import Potentials, TaskState
from quadrl.envs.gymnasium import QuadrotorEnv
from quadrl.evaluation.evaluate import evaluate
from quadrl.tasks import TASKS, make
from quadrl.tasks.hover import Hover
from quadrl.tasks.landing import Landing
from quadrl.tasks.static_waypoint import StaticWaypoint
from quadrl.testing import (
    EPISODE,
    check_task,
    flies_alone_as_in_a_batch,
    keeps_dm_env,
    keeps_gymnasium,
    varied_actions,
)

SEED, AIRCRAFT = 11, 4
ACTIONS = varied_actions(100, AIRCRAFT)  # more than twice the time limit of the flights
WAYPOINTS = ((0.0, 0.1, 0.3), (0.1, 0.0, 0.9), (0.0, 0.0, 5.0))


@pytest.mark.parametrize("name", mostly_slow(TASKS, "hover", "landing"))
def test_task_keeps_the_contract(name):
    check_task(name)


@pytest.mark.parametrize("name", TASKS)
def test_the_yardstick_is_guided_in_any_namespace(name):
    torch = pytest.importorskip("torch")
    draw = np.random.default_rng(3).normal
    arrays = {"rotation": draw(size=(5, 3, 3)), "rotor_speed": draw(size=(5, 4))}
    arrays |= {
        k: draw(size=(5, 3)) for k in ("velocity", "body_rate", "to_goal", "target_velocity")
    }
    expected = make(name).guide(Reading(**arrays))
    for settings in ({}, {"device": "meta"}):
        tensors = {key: torch.tensor(array, **settings) for key, array in arrays.items()}
        for got, wanted in zip(make(name).guide(Reading(**tensors)), expected, strict=True):
            assert got.shape == wanted.shape and got.device.type == settings.get("device", "cpu")
            if not settings:
                np.testing.assert_allclose(got.numpy(), wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", [*TASKS, "all"])
def test_the_yardstick_flies_what_the_task_senses(name):
    alone = evaluate("geometric", name, episodes=1, engine="free_flight", time_limit=0.2)
    assert alone.rollout.action.shape[1:] == (1, alone.vehicle.rotor_count)


@pytest.mark.slow
def test_a_route_keeps_it_too():
    # The first waypoint is reached at once, the second by the aircraft that climbs.
    check_task(StaticWaypoint(waypoints=WAYPOINTS, reach=0.35))


@pytest.mark.slow
def test_one_of_several_tasks_keeps_it_too():
    check_task(OneOf(members=("hover", "straight_and_level"), time_limit=1.5))
    check_task(OneOf(members=("hover", "landing"), time_limit=1.5))  # one on the ground


def check_identity(task, actions=ACTIONS, mode="rotor"):
    """Fly a task through every API; returns the flight by mj_step, which all of them repeat."""
    expected = flights.fly("mj_step", task, SEED, actions, mode)
    for api in list(flights.APIS)[1:]:
        flight = flights.fly(api, task, SEED, actions, mode)
        for column, value in flight.items():
            # Gymnasium's observations and TorchRL's numbers are float32 casts of the same float64.
            cast = expected[column].astype(value.dtype)
            np.testing.assert_array_equal(value, cast, err_msg=f"{api}: {column}")
        if api in ("environment", "dm_control"):
            assert flight["observation"].dtype == flight["reward"].dtype == np.float64
    return expected


@pytest.mark.parametrize("name", mostly_slow(TASKS, "hover"))
def test_every_api_gives_the_numbers_of_a_plain_mj_step_loop(name):
    flight = check_identity(make(name, time_limit=EPISODE))
    over = flight["terminated"] | flight["truncated"]
    assert flight["terminated"].sum() >= 2  # the climb and the dive end early, more than once
    assert not (flight["terminated"] & flight["truncated"]).any()
    starts = flight["met"][1:][over[:-1]]
    assert len(np.unique(starts, axis=0)) == len(starts)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [mode for mode in CONTROL_MODES if mode != "rotor"])
@pytest.mark.parametrize("name", ["hover", "landing"])  # in free flight, and with contact
def test_every_control_mode_gives_the_same_numbers_too(name, mode):
    flight = check_identity(make(name, time_limit=0.25), ACTIONS[:12, 1:3], mode)
    assert flight["truncated"].sum() >= 2  # several episodes


@dataclasses.dataclass(frozen=True)
class Dropped(Hover):
    """Falls to the ground, bounces and lies there."""

    contact = True

    def terminated(self, now):
        return now.potentials.distance > 4.0


@pytest.mark.slow
@pytest.mark.parametrize("altitude", [0.9, 0.07])  # from the air, and on its feet [m]
def test_contact_gives_the_same_numbers_too(altitude):
    task = Dropped(altitude=altitude, radius=0.01, time_limit=2.0)
    flight = check_identity(task, np.full((90, 2, 4), -1.0, np.float32))
    height = flight["observation"][:, :, 2] + altitude
    assert (height > -0.01).all()  # it never falls through the ground
    assert (height < 0.15).sum() > 20  # and lies there for a second of the two


# ------------------------------------------------------------------------- faults are noticed


def begun(change):
    """`begin` of hover with its start and its state changed."""
    return lambda self, rng, parameters: change(*Hover.begin(self, rng, parameters))


def rewarded(name, change):
    """`reward` of hover with a term changed: a function of all terms and the snapshot."""

    def reward(self, before, now, end):
        terms = Hover.reward(self, before, now, end)
        return terms | {name: change(terms, now)}

    return reward


def level_goal(self, now):
    terms, height = Hover.observe(self, now), now.state.height
    goal = terms["goal"]
    flat = namespace(goal).stack([goal[..., 0], goal[..., 1], 0 * height], axis=-1)
    return terms | {"goal": flat}


def measured_by_a_power(self, now):
    given = {name: getattr(Hover.measure(self, now), name) for name in Potentials.__slots__}
    square = given["to_goal"] * given["to_goal"]
    distance = (square[..., 0] + square[..., 1] + square[..., 2]) ** 0.5
    return Potentials(**given | {"distance": distance})


def nan_far_away(terms, now):
    distance, xp = now.potentials.distance, namespace(now.time)
    return xp.where(distance > 2.0, 0 * distance + xp.nan, distance)  # not at once


def of_a_goal_that_moves(self, before, now):
    now.task.goal[..., 0] += 0.1
    return now.task


def by_branches(distance):
    return distance if (distance < 2.0).any() else 2 * distance


def random_goal(start, state):
    return start, TaskState(state.goal + 0.01 * np.random.normal())


def start_by_the_mean(start, state):
    return dataclasses.replace(start, position=0.9 * start.position.mean(0) + start.position), state


def no_rotation(start, state):
    return dataclasses.replace(start, quaternion=2 * start.quaternion), state


def error(change):
    """`error` of hover, changed."""
    return {"error": lambda self, now: change(now.potentials.distance)}


@dataclasses.dataclass(frozen=True)
class Last(TaskState):
    place: Array


FAULTS = {
    "a start as it was drawn": (
        "task.place is state.position after every step, but not at a start .*: make it in",
        {
            "begin": begun(lambda start, state: (start, Last(state.goal, start.position))),
            "update": lambda self, _, now: Last(now.task.goal, now.state.position),
        },
    ),
    "a missing text": ("solved must be a text", {"solved": ""}),
    "other random numbers": ("two starts for one key", {"begin": begun(random_goal)}),
    "no rotation": ("quaternion of begin.*of norm 1", {"begin": begun(no_rotation)}),
    "a start by the mean of the batch": (
        "begin of one aircraft and of a batch differ: start.position",
        {"begin": begun(start_by_the_mean)},
    ),
    "a constant entry": ("entries .2. of 'goal' never change", {"observe": level_goal}),
    "a reward by the mean of the batch": (
        "one aircraft and a batch get different numbers: spin",
        {"reward": rewarded("spin", lambda terms, now: terms["spin"] - terms["spin"].mean())},
    ),
    "a reward that is not a number": ("near.*nan", {"reward": rewarded("near", nan_far_away)}),
    "words to draw": ("markers fails.*'str'", {"markers": lambda self, now: ["a sphere"]}),
    "a negative error": ("an error is negative", error(lambda distance: distance - 0.5)),
    "a changed argument": ("read-only", {"update": of_a_goal_that_moves}),
    "a batch of four": ("a function of 1 rows.* fails", error(lambda x: x + 0 * x[2])),
    "an error in NumPy alone": ("torch arrays fails|gives error as ndarray", error(np.array)),
    "a branch on numbers": ("fails:.*meta", error(by_branches)),
    "no gradient in the goal": (
        "'error' has no gradient at rest in the goal by position; take lengths by .*norm",
        {"measure": measured_by_a_power},
    ),
    "double precision alone": (
        "of float32, error becomes torch.float64",
        error(lambda x: namespace(x).astype(x, namespace(x).float64)),
    ),
}


@dataclasses.dataclass(frozen=True)
class Faulty(Hover):
    """A hover that is given a fault."""

    compiled = False


@pytest.mark.slow
@pytest.mark.parametrize(("message", "changes"), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_noticed(message, changes, monkeypatch):
    for name, value in changes.items():
        monkeypatch.setattr(Faulty, name, value)
    with pytest.raises(AssertionError, match=f"(?s){message}"):
        check_task(Faulty)


class NotADataclass(Hover):
    """Its option is none, for want of @dataclass."""

    limit: float = 1.0


@dataclasses.dataclass(frozen=True)
class Undocumented(NotADataclass):
    limit: float = 1.0


@pytest.mark.parametrize(
    ("kind", "message"),
    [(NotADataclass, "must be a frozen dataclass"), (Undocumented, "limit needs a docstring")],
)
def test_a_faulty_declaration_is_noticed(kind, message):
    with pytest.raises(AssertionError, match=message):
        check_task(kind)


def test_an_unfair_api_is_noticed(monkeypatch):
    needs_dm_control()
    from quadrl.envs.dm_control import QuadrotorTask

    fair = QuadrotorTask.get_reward
    off_by_a_bit = lambda *given: np.nextafter(fair(*given), np.inf)  # noqa: E731
    monkeypatch.setattr(QuadrotorTask, "get_reward", off_by_a_bit)
    with pytest.raises(AssertionError, match="dm_control and a batch differ: reward"):
        flies_alone_as_in_a_batch(Landing(), ACTIONS[:, 3])


def test_the_check_of_dm_control_notices_a_fault(monkeypatch):
    needs_dm_control()
    from quadrl.envs import dm_control

    monkeypatch.setattr(dm_control.QuadrotorTask, "get_reward", lambda self, physics: "much")
    with pytest.raises(AssertionError, match="dm_env"):
        keeps_dm_env(Hover(time_limit=0.5), ACTIONS[:15, 0])


def test_the_check_of_gymnasium_notices_a_fault(monkeypatch):
    monkeypatch.setattr(QuadrotorEnv, "reset", lambda self, **_: (np.zeros(22), {}))
    with pytest.raises(AssertionError, match="check_env"):
        keeps_gymnasium(Hover(time_limit=0.5))
