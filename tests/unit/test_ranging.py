"""Range finders: rays as MuJoCo casts them, what is seen of them, and what is refused."""

import dataclasses

import mujoco
import numpy as np
import pytest
from helpers import begun, idle, refused

from quadrl.conditions.ranging import RangeFinder
from quadrl.conditions.sensor import SENSORS, Sensor, register_sensor
from quadrl.conditions.solids import Box, Capsule, Cylinder, Gate, Pose, Sphere
from quadrl.core.environment import Environment
from quadrl.core.saving import Copied
from quadrl.engines.rays import Rays
from quadrl.tasks.hover import Hover
from quadrl.tasks.navigation import Navigation

ENGINES = ("free_flight", "mujoco")
DOWN = ((0.0, 0.0, -1.0),)


@dataclasses.dataclass(frozen=True)
class Rubble(Hover):
    """Solids of every kind, turned and sized at random, about a start in their midst."""

    name = "rubble"

    def solids(self):
        """A few of each."""
        return [
            Cylinder("post", count=20), Sphere("ball", count=20), Box("block", count=20),
            Gate("gate", count=3), Capsule("branch", count=20),
        ]  # fmt: skip

    def place(self, rng, start, state):
        """At least 1.5 m off."""
        drawn, placed = np.random.default_rng(3), {}
        for solid in self.solids():
            shape = len(start.position), solid.count
            turn = drawn.normal(size=(*shape, 4))
            place = drawn.uniform([-8, -8, -2], [8, 8, 4], (*shape, 3))
            near = np.linalg.norm(place - start.position[:, None], axis=-1) < 1.5
            place[near] += 10
            turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
            size = drawn.uniform(0.1, 0.7, (*shape, len(solid.lengths)))
            placed[solid.name] = Pose(place, turn, size)
        return placed


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("frame", ["body", "yaw", "world"])
def test_a_hundred_thousand_rays_of_tilted_aircraft_are_those_of_mujoco(frame, engine):
    count, each = 22, 800  # and six times that
    drawn = np.random.default_rng(0)
    turn = drawn.normal(size=(count, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    environment = begun(Rubble(), num_envs=count, seed=1, engine=engine)
    environment.reset(start={"quaternion": turn})
    rays = Rays(drawn.normal(size=(each, 3)), 20.0, (0.05, 0.02, -0.03), frame)
    found, flown = rays.measured(environment.engine), environment.engine
    model, expected = environment.scenario.compile_model(drawn=False), np.empty((count, each))
    data, solids, geom = mujoco.MjData(model), flown.solids, np.zeros(1, np.int32)
    for row, into in enumerate(expected):
        model.geom_pos[solids.geoms] = solids.table["position"][row]
        model.geom_quat[solids.geoms] = solids.poses[row, :, 3:7]
        model.geom_size[solids.geoms] = solids.table["size"][row]
        model.geom_rbound[solids.geoms] = 2.0  # as far as any of them reaches
        data.qpos[:] = flown.qpos[row]
        mujoco.mj_kinematics(model, data)
        ends = rays.ends(flown.qpos[row, :3], flown.qpos[row, 3:], np.ones(each))
        along = ends[:, 1] - ends[:, 0]
        for k, one in enumerate(along):
            into[k] = mujoco.mj_ray(model, data, ends[0, 0], one, None, 1, 1, geom)
    expected = np.where((expected < 0) | (expected > 20.0), 20.0, expected)
    assert 0.2 < (expected < 20.0).mean() < 0.9
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    some = np.array([5, 20, 3])
    np.testing.assert_array_equal(rays.measured(flown, some), found[some])


def test_a_field_of_view_is_filled_from_the_right_to_the_left_and_upwards():
    finder = RangeFinder(across=4, up=2, wide=80.0, high=20.0)
    level, up = np.radians([-30.0, -10.0, 10.0, 30.0]), np.radians([-5.0, 5.0])
    x, y, z = finder.rays.along.reshape(2, 4, 3).transpose(2, 0, 1)
    np.testing.assert_allclose(np.arctan2(y, x), np.tile(level, (2, 1)), atol=1e-12)
    np.testing.assert_allclose(np.arcsin(z), np.tile(up[:, None], (1, 4)), atol=1e-12)


def heights(observe=None, **settings):
    """What a beam downwards sees of 400 aircraft 3 m above the ground, and the environment."""
    given = {"directions": DOWN, "frame": "world", **(observe or {})}
    sensors = {"sensors": {"range_finder": given}}
    environment = begun("hover", num_envs=400, seed=2, observe=sensors, **settings)
    return environment.sensed["range_finder"], environment


def test_a_beam_sees_the_ground_as_far_as_it_reaches():
    seen, environment = heights()
    assert not environment.not_compiled
    np.testing.assert_allclose(seen[:, 0], np.minimum(environment.engine.qpos[:, 2], 4.0))
    seen, _ = heights({"reach": 2.0})
    assert (seen == 2.0).all()
    seen, _ = heights({"directions": ((0.0, 0.0, 1.0),)})
    assert (seen == 4.0).all()


def test_errors_are_shares_of_the_distance_and_what_is_lost_sees_nothing():
    seen, environment = heights({"share": 0.02, "dropout": 0.1, "reach": 9.0})
    lost, height = seen[:, 0] == 9.0, environment.engine.qpos[:, 2]
    assert abs(lost.mean() - 0.1) < 5 * np.sqrt(0.09 / 400)
    share = (seen[:, 0] / height - 1)[~lost] / 0.02
    assert abs(share.mean()) < 5 / np.sqrt(lost.size) and abs(share.std() - 1) < 0.2
    seen, _ = heights({"reach": 2.0, "noise": 1.0})  # there is nothing to be wrong about
    assert (seen == 2.0).all()


def test_what_is_near_counts_for_more_in_steps_and_by_its_change():
    now, environment = heights({"step": 0.25, "log": True, "change": True})
    steps = np.round(environment.engine.qpos[:, 2] / 0.25) * 0.25
    np.testing.assert_allclose(now, np.stack([np.log(steps), 0 * steps], axis=-1))
    down = np.full((400, 4), -1.0)
    for _ in range(5):
        seen, now = now, environment.step(down).observation["range_finder"].copy()
    assert (now[:, 1] < 0).any()
    np.testing.assert_allclose(now[:, 1], now[:, 0] - seen[:, 0])


def test_samples_come_at_a_rate_that_is_no_share_of_the_control_rate():
    """15 in a second of 20 steps: three of four steps bring one."""
    observe = {"sensors": {"time_of_flight": {"frame": "world", "directions": DOWN, "step": 0.0}}}
    environment, news = begun("hover", num_envs=1, seed=3, observe=observe), []
    last = np.array(environment.sensed["time_of_flight"])
    for _ in range(40):
        environment.step(np.full((1, 4), -0.2))
        now = np.array(environment.sensed["time_of_flight"])
        news.append(bool((now != last).any()))
        last = now
    assert news == [False, True, True, True] * 10


@pytest.mark.parametrize("name", ["multi_ranger", "time_of_flight", "ring", "depth_image"])
def test_what_people_carry_sees_a_forest(name):
    environment = begun(Navigation(), num_envs=2, observe={"sensors": {name: {}}})
    kind = SENSORS[name]
    seen, finder = environment.sensed[name], kind()
    assert seen.shape == (2, finder.rays.count) and finder.rays.count in (5, 64, 40, 768)
    assert seen.max() <= finder.reach
    if name != "multi_ranger":
        assert seen.min() < finder.reach


@dataclasses.dataclass(frozen=True)
class Slow(Navigation):
    """The same forest without a compiled step."""

    name = "slow_navigation"


ERRORS = {"noise": 0.01, "share": 0.02, "dropout": 0.05, "step": 0.001, "rate": 15, "delay": 0.05}


@pytest.mark.parametrize("engine", ENGINES)
def test_a_compiled_step_sees_what_is_written(engine):
    flights = []
    for task in (Navigation(), Slow()):
        observe = {"sensors": {"range_finder": {**ERRORS, "across": 24, "change": True}}}
        made = begun(task, num_envs=9, seed=5, engine=engine, observe=observe)
        assert bool(made.not_compiled) is isinstance(task, Slow)
        steps, drawn = [], np.random.default_rng(1)
        for _ in range(40):
            done = made.step(drawn.uniform(-1, 1, (9, 4)))
            steps.append({name: np.array(part) for name, part in done.observation.items()})
            if (over := done.terminated).any():
                made.reset(over)
        flights.append(steps)
    for one, other in zip(*flights, strict=True):
        for name, part in one.items():
            np.testing.assert_array_equal(part, other[name], err_msg=name)


def test_what_is_seen_continues_from_a_saved_state():
    environment = begun(Navigation(), num_envs=4, seed=7)
    for _ in range(5):
        idle(environment)
    saved = environment.save()
    then = np.array(idle(environment).observation["range_finder"])
    fresh = Environment(Navigation(), num_envs=4, seed=0)
    assert isinstance(fresh, Copied)
    fresh.restore(saved)
    np.testing.assert_array_equal(idle(fresh).observation["range_finder"], then)


@register_sensor
class Whiskers(Sensor):
    """Two beams to the front that say how much free way they share: a sensor of one's own."""

    compiled = True
    name, unit = "whiskers", "m"
    rays = Rays([[1.0, 0.3, 0.0], [1.0, -0.3, 0.0]], reach=5.0)

    def sense(self, now):
        """The shorter one."""
        return np.min(now.world.ranges(self.name), axis=-1)[:, None]


def test_a_sensor_of_ones_own_casts_rays():
    environment = begun(Navigation(), num_envs=6, observe={"sensors": {"whiskers": {}}})
    assert not environment.not_compiled
    expected = Whiskers.rays.measured(environment.engine).min(axis=1)
    np.testing.assert_array_equal(environment.sensed["whiskers"][:, 0], expected)


def test_pictures_show_the_rays_that_meet_something():
    environment = begun("hover", observe={"sensors": {"multi_ranger": {}}})
    assert not [one for one in environment.markers() if one.kind == "line"]
    beam = {"directions": (*DOWN, (0.0, 0.0, 1.0)), "frame": "world"}
    environment = begun("hover", observe={"sensors": {"range_finder": beam}})
    (line,) = (one for one in environment.markers() if getattr(one, "shape", "") == "line")
    ends = environment.engine.qpos[0, :3] * [[1, 1, 1], [1, 1, 0]]
    np.testing.assert_allclose(line.points, ends, atol=1e-12)


def test_what_lies_on_the_ground_of_a_world_of_solids_has_touched_it():
    environment = begun(Navigation(), num_envs=1)
    down = np.array([[0.0, 0.0, -0.3, 0.0]])
    for _ in range(100):
        if (done := environment.step(down)).terminated.any():
            break
    assert [name for name, holds in done.ended.items() if holds.any()] == ["ground"]
    assert environment.snapshot.above_ground[0] < 0.02


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"reach": 0.0}, "reach of rays"),
        ({"across": 0}, "range_finder across"),
        ({"across": 64, "up": 64}, "1 to 1024"),
        ({"directions": ((0.0, 0.0, 0.0),)}, "of a length"),
        ({"directions": ((1.0, 0.0),)}, "directions"),
        ({"frame": "nose"}, "body, yaw, world"),
        ({"dropout": 1.0}, "dropout"),
        ({"log": 1}, "True or False"),
    ],
)
def test_rays_that_cannot_be_are_refused(options, words):
    with refused(match=words):
        begun("hover", observe={"sensors": {"range_finder": options}})


def test_a_forest_without_a_way_is_refused_with_the_number():
    with refused("navigation trees", match="0.27 m apart"):
        Environment("navigation", task_options={"trees": 900})
