"""The same numbers, bit for bit, through every door, in every batch, on any number of threads."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest

import quadrl
from quadrl import testing
from quadrl.environment import Environment
from quadrl.interfaces import INTERFACES
from quadrl.tasks import TASKS, make
from quadrl.tasks.hover import Hover

SEED, AIRCRAFT = 11, 4


ACTIONS = testing.varied_actions(160, AIRCRAFT)  # more than three times the horizon below


def short(name):
    return make(name, horizon=testing.EPISODE)


@pytest.fixture(scope="module")
def plain_loop():
    """Flights by bare mj_step, one a task."""
    flights = {}

    def get(name):
        if name not in flights:
            flights[name] = testing.fly("mj_step", short(name), SEED, ACTIONS)
        return flights[name]

    return get


@pytest.mark.parametrize("name", TASKS)
def test_the_flights_that_are_compared_have_several_episodes_and_both_ends(name, plain_loop):
    flight = plain_loop(name)
    assert flight["terminated"].sum() >= 2  # the climb and the dive end early, more than once
    assert flight["truncated"].any()
    assert not (flight["terminated"] & flight["truncated"]).any()
    starts = flight["observation"][1:][(flight["terminated"] | flight["truncated"])[:-1]]
    assert len(np.unique(starts, axis=0)) == len(starts)


@pytest.mark.parametrize("door", [door for door in testing.DOORS if door != "mj_step"])
@pytest.mark.parametrize("name", TASKS)
def test_door_gives_the_numbers_of_a_plain_mj_step_loop(name, door, plain_loop):
    expected = plain_loop(name)
    flight = testing.fly(door, short(name), SEED, ACTIONS)
    for column in testing.COLUMNS:
        # Gymnasium's observations and TorchRL's numbers are float32 casts of the same float64.
        cast = expected[column].astype(flight[column].dtype)
        np.testing.assert_array_equal(flight[column], cast, err_msg=f"{door}: {column}")
    assert flight["state"].dtype == np.float64
    if door == "dm_control":
        assert flight["observation"].dtype == flight["reward"].dtype == np.float64


@pytest.mark.parametrize("action", [name for name in INTERFACES if name != "rotor"])
@pytest.mark.parametrize("name", ["hover", "landing"])  # in free flight, and with contact
def test_every_interface_gives_the_same_numbers_through_every_door(name, action):
    task, actions = make(name, horizon=1.0), ACTIONS[:50]
    expected = testing.fly("mj_step", task, SEED, actions, action)
    assert expected["truncated"].sum() >= 2  # several episodes
    for door in testing.DOORS[1:]:
        flight = testing.fly(door, task, SEED, actions, action)
        for column in testing.COLUMNS:
            cast = expected[column].astype(flight[column].dtype)
            np.testing.assert_array_equal(flight[column], cast, err_msg=f"{door}: {column}")


@dataclasses.dataclass(frozen=True)
class Dropped(Hover):
    """Falls to the ground, bounces and lies there."""

    contact = True

    def terminated(self, state, measures, fields, vehicle):
        return measures.distance > 4.0


@pytest.mark.parametrize("altitude", [0.9, 0.07])  # from the air, and on its feet [m]
@pytest.mark.parametrize("door", [door for door in testing.DOORS if door != "mj_step"])
def test_contact_gives_the_same_numbers_too(door, altitude):
    task = Dropped(altitude=altitude, radius=0.01, horizon=2.0)
    actions = np.full((90, 2, 4), -1.0, np.float32)
    expected = testing.fly("mj_step", task, SEED, actions)
    height = expected["state"][:, :, 2]
    assert (height > -0.01).all()  # it never falls through the ground
    assert (height < 0.15).sum() > 20  # and lies there for a second of the two
    flight = testing.fly(door, task, SEED, actions)
    for column in testing.COLUMNS:
        cast = expected[column].astype(flight[column].dtype)
        np.testing.assert_array_equal(flight[column], cast, err_msg=f"{door}: {column}")


@pytest.mark.parametrize("name", TASKS)
def test_the_public_names_lead_to_the_same_episodes(name):
    camel = name.replace("_", " ").title().replace(" ", "")
    action = testing.varied_actions(1, 3)[0]
    single, vector = gym.make(f"quadrl/{camel}-v0"), gym.make_vec(f"quadrl/{camel}-v0", num_envs=3)
    dm = quadrl.load(name, {"random": 7})
    met, _ = vector.reset(seed=5)
    np.testing.assert_array_equal(met[2], single.reset(seed=7)[0])
    flat = np.concatenate(list(dm.reset().observation.values()))
    np.testing.assert_array_equal(met[2], flat.astype(np.float32))
    _, rewards, *_ = vector.step(action)
    assert single.step(action[2])[1] == dm.step(action[2]).reward == rewards[2]


@pytest.mark.parametrize("name", TASKS)
def test_neighbours_and_threads_change_nothing(name):
    task = make(name, horizon=1.0)
    actions = testing.varied_actions(50, 5)

    def fly(rows, threads):
        environment = Environment(
            task, num_envs=len(rows), seed=SEED + rows[0], num_threads=threads
        )
        seen = [environment.flatten(environment.reset(), np.empty((len(rows), environment.size)))]
        for action in actions[:, rows]:
            now = environment.step(action)
            over = now.terminated | now.truncated
            seen.append(environment.flatten(now.observation, np.empty_like(seen[0])))
            if over.any():
                environment.reset(over)
        return np.stack(seen)

    together = fly([0, 1, 2, 3, 4], 2)
    np.testing.assert_array_equal(together, fly([0, 1, 2, 3, 4], 1))
    np.testing.assert_array_equal(together[:, 3:4], fly([3], 1))
    np.testing.assert_array_equal(together[:, 1:3], fly([1, 2], 2))
