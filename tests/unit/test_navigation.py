"""Navigation: what a forest is, what pays in it, and the planners beside policies."""

import numpy as np
import pytest
from helpers import begun, refused

from quadrl.core.environment import Environment
from quadrl.evaluation.planners import PLANNERS, Flyer, Sight
from quadrl.tasks.navigation import LENGTH, WIDTH, Navigation
from scripts.reports.forest import FOREST, flown

MIDDLE = {
    name: {key: float(np.sqrt(max(low, 0.01) * high)) for key, (low, high) in ends.items()}
    for name, (_, ends) in PLANNERS.items()
}


def test_trees_stand_in_the_forest_as_many_as_each_episode_draws():
    environment = begun(Navigation(trees=40, fewest=10), num_envs=400, seed=1)
    place = environment.snapshot.solid("tree")
    stands = place[..., 2] > 0
    assert {*stands.sum(axis=1)} == {*range(10, 41)}
    x, y = place[stands][:, 0], place[stands][:, 1]
    assert 1.5 <= x.min() and x.max() <= LENGTH and abs(y).max() <= WIDTH / 2
    radius = environment.engine.solids.table["size"][:, 2:, 0]
    assert 0.15 <= radius.min() < 0.16 and 0.39 < radius.max() <= 0.4


class Stirring(Navigation):
    """The same, as if trees might move."""

    moves = True

    def move(self, state, time):
        return {}


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_a_forest_that_stands_is_flown_in_whole_steps_to_the_same_bits(engine, monkeypatch):
    settings = dict(num_envs=8, seed=3, control_mode="velocity", engine=engine)
    stands, stirs = (Environment(kind(), **settings) for kind in (Navigation, Stirring))
    stands.reset(), stirs.reset()
    monkeypatch.setattr(stands.engine.solids, "move", None)
    rng = np.random.default_rng(0)
    for _ in range(80):
        action = rng.uniform(-0.2, 1.0, (8, 4))
        one, other = (flown.step(action) for flown in (stands, stirs))
        np.testing.assert_array_equal(one.reward, other.reward)
        for name, seen in one.observation.items():
            np.testing.assert_array_equal(seen, other.observation[name])
    assert stirs.engine.solids.moves and not stands.engine.solids.moves


@pytest.mark.parametrize(("speed", "paid"), [(1.0, 1.0), (2.0, 2.0), (3.0, 1.0)])
def test_progress_pays_up_to_the_speed_that_is_asked_and_less_beyond(speed, paid):
    task = Navigation(trees=0, slowest=2.0, fastest=2.0, progress_weight=1.0)
    environment = begun(task, num_envs=1, control_mode="velocity", engine="mujoco")
    environment.reset(start={"velocity": np.array([speed, 0.0, 0.0])})
    before = environment.snapshot.state.position[0, 0]
    done = environment.step(np.zeros((1, 4)))
    way = environment.snapshot.state.position[0, 0] - before
    assert done.reward_terms["progress"][0] == pytest.approx(0.1 - abs(0.1 - way))
    assert done.reward_terms["progress"][0] / 0.05 == pytest.approx(paid, abs=0.15)


def test_balls_hang_in_the_air():
    environment = begun(Navigation(trees=0, balls=12), num_envs=50)
    height = environment.snapshot.solid("ball")[..., 2]
    assert -1.0 <= height.min() < -0.9 and 0.9 < height.max() <= 1.0


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_balls_swing_no_faster_than_is_said_and_are_met_where_they_are(engine):
    task = Navigation(trees=0, balls=6, ball_speed=2.0, altitude=4.0)
    environment = begun(task, num_envs=8, seed=2, control_mode="velocity", engine=engine)
    way, last = [], environment.snapshot.solid("ball").copy()
    for _ in range(80):
        environment.step(np.zeros((8, 4)))
        now = environment.snapshot.solid("ball")
        way.append(np.linalg.norm(now - last, axis=-1) / environment.vehicle.control_timestep)
        last = now.copy()
    assert 1.9 < np.max(way) <= 2.0 + 1e-9 and np.min(np.max(way, axis=0)) > 1.9
    # The one alone comes as near to who hangs beyond the end of its way as its radius says.
    alone = dict(num_envs=8, seed=2, control_mode="velocity", engine=engine)
    environment = begun(task.replace(balls=1), **alone)
    there = environment.snapshot.task
    middle, way = there.middle[:, 0], there.way[:, 0]
    inwards = -np.sign(middle[:, 1:2] * way[:, 1:2])  # where no wall stands
    beyond = middle + inwards * way * (1 + 1.2 / 1.5)
    environment.seed(2)
    environment.reset(start={"position": beyond})
    np.testing.assert_array_equal(environment.snapshot.task.middle, there.middle)
    least = np.full(8, np.inf)
    for _ in range(100):
        environment.step(np.zeros((8, 4)))
        least = np.minimum(least, environment.snapshot.clearance)
    free = 1.2 - environment.engine.solids.table["size"][:, 2, 0] - least
    assert (free > 0.1).all() and (free < 0.45).all() and np.ptp(free) < 0.15


def test_walls_stand_anyhow_and_are_seen():
    environment = begun(Navigation(trees=0, walls=20), num_envs=50)
    placed, size = environment.snapshot.solid("wall"), environment.engine.solids.table["size"]
    assert placed.shape == (50, 20, 3) and 1.0 <= 2 * size[:, 2:, 0].min() < 1.05
    assert 2.95 < 2 * size[:, 2:, 0].max() <= 3.0 and np.allclose(2 * size[:, 2:, 1], 0.2)
    assert (environment.snapshot.sensed["range_finder"] < np.log(7.9)).any(axis=1).mean() > 0.9


def sight(distance):
    """What is seen along 40 rays of 240 degrees at 1.5 m/s, 1.5 m/s asked."""
    angle = np.radians(240 * ((np.arange(40) + 0.5) / 40 - 0.5))
    moving, asked = np.array([[1.5, 0.0]]), np.array([1.5])
    return Sight(angle, distance(angle)[None], 8.0, moving, asked, np.zeros(1))


@pytest.mark.parametrize("name", PLANNERS)
def test_a_planner_flies_ahead_and_turns_from_what_is_in_the_way(name):
    plan, numbers = PLANNERS[name][0], MIDDLE[name]
    free = plan(sight(lambda angle: np.full(40, 8.0)), numbers)[0]
    assert free[0] > 1.3 and abs(free[1]) < 0.2
    right = sight(lambda angle: np.where((angle < 0.1) & (angle > -0.5), 1.2, 8.0))
    assert plan(right, numbers)[0, 1] > 0.05  # to the left


def test_the_sampler_comes_through_a_light_forest():
    name = "short-horizon sampler"
    scenario = Environment(Navigation(), **FOREST).scenario
    got = flown(Flyer(PLANNERS[name][0], MIDDLE[name], scenario), 0, 16, task_options={"trees": 18})
    asked = scenario.task.fastest
    assert got["success"] >= 0.9 and 0.8 * asked < got["speed"] < asked


def test_fewest_trees_are_at_most_all():
    with refused("navigation fewest"):
        Navigation(trees=5, fewest=6)
