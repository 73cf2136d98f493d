"""The world as sensors and tasks see it: one measurement, the ground in it, and many solids."""

import dataclasses

import mujoco
import numpy as np
import pytest
from helpers import begun, refused

from quadrl.aircraft.presets import VEHICLES
from quadrl.conditions.sensor import Sensor, register_sensor
from quadrl.conditions.solids import Cylinder, Gate, Pose, Sphere, heading
from quadrl.core.environment import Environment
from quadrl.engines.mjcf import compile_model
from quadrl.tasks.hover import Hover

LEVEL = {"quaternion": [1.0, 0.0, 0.0, 0.0], "velocity": [0.0] * 3, "body_rate": [0.0] * 3}


def lowest(model, data):
    """Height of the lowest point of what can touch of an aircraft [m]."""
    kinds, found = mujoco.mjtGeom, []
    for k in np.flatnonzero((model.geom_bodyid == 1) & (model.geom_conaffinity != 0)):
        (radius, half, _), up = model.geom_size[k], data.geom_xmat[k].reshape(3, 3)[2]
        depth = {
            kinds.mjGEOM_SPHERE: radius,
            kinds.mjGEOM_ELLIPSOID: np.linalg.norm(up * model.geom_size[k]),
            kinds.mjGEOM_CAPSULE: radius + half * abs(up[2]),
            kinds.mjGEOM_CYLINDER: half * abs(up[2]) + radius * np.hypot(up[0], up[1]),
        }
        found.append(data.geom_xpos[k, 2] - depth[kinds(model.geom_type[k])])
    return min(found)


@pytest.mark.parametrize("name", VEHICLES)
def test_the_height_above_the_ground_is_that_of_the_lowest_geom(name):
    """But for the thickness of discs, a sixth of their radius, and the roundness of feet."""
    rng, count = np.random.default_rng(3), 64
    turns = rng.normal(size=(count, 4))
    turns[0] = [1.0, 0.0, 0.0, 0.0]
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    environment = begun("hover", num_envs=count, vehicle=name)
    environment.reset(start=LEVEL | {"quaternion": turns, "position": rng.normal(size=(count, 3))})
    model = compile_model(environment.vehicle, contact=True, drawn=False)
    data, expected = mujoco.MjData(model), []
    for qpos in environment.engine.qpos:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        expected.append(lowest(model, data))
    found = environment.snapshot.above_ground
    vehicle = environment.vehicle
    off = max(0.008 * vehicle.scale, *(rotor.radius / 12 for rotor in vehicle.rotors))
    np.testing.assert_allclose(found, expected, rtol=0, atol=off)
    assert found[0] == pytest.approx(expected[0], abs=1e-12)  # on its feet


@register_sensor
class NearPost(Sensor):
    """Offset of the post, how far it is free, and whether it was touched: a user's own sensor."""

    name, size = "near_post", 5

    def sense(self, now):
        """From the world and the true state."""
        world, offset = now.world, now.world.solid("post") - now.true.position
        others = world.clearance, world.touched[:, 0], now.above_ground
        return np.concatenate([offset[:, :2], np.stack(others, axis=-1)], axis=-1)


@dataclasses.dataclass(frozen=True)
class Blind(Hover):
    """Drift to a post, of which sensors alone tell."""

    name = "blind"
    compiled = True
    sensors = {"near_post": {}, "clearance": {"reach": 2.0}}

    def solids(self):
        return [Cylinder("post", radius=0.1, height=8.0)]

    def place(self, rng, start, state):
        return {"post": Pose(rng.level_direction() * 1.2)}

    def reward(self, before, now, end):
        room = now.sensed["clearance"][..., 0] - before.sensed["clearance"][..., 0]
        low = {"room": room, "low": -0.1 * now.above_ground}
        return low | {"hit": now.sensed["near_post"][..., 3] * 1.0}


def seen(environment):
    """What the two sensors must give of the world of the snapshot."""
    now = environment.snapshot
    offset = (now.solid("post") - now.state.position)[:, :2]
    others = now.clearance, now.touched[:, 0], now.above_ground
    free = np.minimum(np.minimum(now.clearance, now.above_ground), 2.0)
    return np.concatenate([offset, np.stack(others, axis=-1)], axis=-1), free[:, None]


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_sensors_see_the_world_that_the_snapshot_shows(engine):
    count, rng = 24, np.random.default_rng(0)
    pair = [Environment(kind(), num_envs=count, seed=2, engine=engine) for kind in (Blind, Written)]
    touched = 0
    for step in range(40):
        if step % 12 == 0:
            rows = None if not step else np.arange(0, count, 3)
            start = LEVEL | {"velocity": [2.0, 0.0, 0.0]}
            for each in pair:
                each.reset(rows, start=start if rows is None else None)
        else:
            action = rng.uniform(-0.3, 0.3, (count, 4))
            one, other = (each.step(action) for each in pair)
            np.testing.assert_array_equal(one.reward, other.reward)
        for each in pair:
            for name, expected in zip(("near_post", "clearance"), seen(each), strict=True):
                np.testing.assert_array_equal(each.sensed[name], expected)
        touched += pair[0].snapshot.touched.sum()
    assert touched and not pair[0].not_compiled and pair[1].not_compiled
    restored = Environment(Blind(), num_envs=count, seed=9, engine=engine)
    restored.restore(pair[0].save())
    for _ in range(3):
        found, expected = (each.step(0.1 * np.ones((count, 4))) for each in (restored, pair[0]))
        for name, array in expected.observation.items():
            np.testing.assert_array_equal(found.observation[name], array)
        np.testing.assert_array_equal(found.reward, expected.reward)


class Written(Blind):
    """The same, not compiled."""

    compiled = False


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_over_open_ground_the_clearance_is_the_height_of_the_feet(engine):
    """Of the paper's aircraft, whose feet are 7 cm below its centre; a control step late."""
    observe = {"sensors": {"clearance": {"delay": 0.05, "reach": 5.0}}}
    environment = begun("hover", num_envs=3, observe=observe, engine=engine)
    start = LEVEL | {"position": np.array([[0.0, 0.0, z] for z in (0.0, -1.0, 17.0)])}
    first = environment.reset(start=start)["clearance"][:, 0]
    np.testing.assert_allclose(first, [2.93, 1.93, 5.0], rtol=0, atol=1e-12)
    for _ in range(3):
        expected = np.minimum(environment.snapshot.state.height - 0.07, 5.0)
        found = environment.step(np.full((3, 4), 0.2)).observation["clearance"][:, 0]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    assert (found > first)[:2].all()


@dataclasses.dataclass(frozen=True)
class Grove(Hover):
    """Posts of random thickness and gates that drift and turn, placed by arrays or one by one."""

    name = "grove"
    compiled = True
    together: bool = True

    def solids(self):
        if self.together:
            return [Gate("gate", opening=1.5, count=2), Cylinder("post", height=6.0, count=4)]
        gates = [Gate(f"gate{k}", opening=1.5) for k in range(2)]
        return gates + [Cylinder(f"post{k}", height=6.0) for k in range(4)]

    def laid(self, name, pose):
        """Poses by name, from arrays (n, count, k)."""
        if self.together:
            return {name: pose}
        parts = {f.name: getattr(pose, f.name) for f in dataclasses.fields(pose)}
        return {
            f"{name}{k}": Pose(**{f: None if a is None else a[:, k] for f, a in parts.items()})
            for k in range(pose.position.shape[1])
        }

    def move(self, state, time):
        drift = 1.5 + 0.3 * time[:, None] * [1.0, -1.0]
        place = np.stack([drift, -drift, 0.0 * drift], axis=-1)
        return self.laid("gate", Pose(place, heading(0.4 * time[:, None] + [0.0, 1.0])))

    def place(self, rng, start, state):
        off = rng.uniform(-1.0, 1.0, 8).reshape(-1, 4, 2)
        off += np.where(off < 0.0, -0.5, 0.5)
        size = np.concatenate([0.05 * abs(off[..., :1]), 5.0 + abs(off[..., 1:])], axis=-1)
        place = np.concatenate([off, 0.0 * off[..., :1]], axis=-1)
        return super().place(rng, start, state) | self.laid("post", Pose(place, size=size))

    def reward(self, before, now, end):
        if self.together:
            near = now.solid("post")[..., 2, 0] - now.solid("gate")[..., 1, 1]
        else:
            near = now.solid("post2")[..., 0] - now.solid("gate1")[..., 1]
        return {"near": near, "hit": now.touched[..., 3] * 1.0}


@pytest.mark.parametrize(("engine", "count"), [("mujoco", 1), ("free_flight", 24)])
def test_solids_that_are_placed_together_are_those_that_are_placed_alone(engine, count):
    rng, hits = np.random.default_rng(4), 0
    made = Grove(), Grove(together=False)
    pair = [Environment(task, num_envs=count, seed=1, engine=engine) for task in made]
    for step in range(36):
        if step % 12 == 0:
            for each in pair:
                each.reset(np.arange(0, count, 1 if not step else 2))
        action = rng.uniform(-0.6, 0.6, (count, 4))
        found, expected = (each.step(action) for each in pair)
        np.testing.assert_array_equal(found.reward, expected.reward)
        one, other = (each.snapshot for each in pair)
        for name, number in (("gate", 2), ("post", 4)):
            alone = [other.solid(f"{name}{k}") for k in range(number)]
            np.testing.assert_array_equal(one.solid(name), np.stack(alone, axis=1))
        for name in ("clearance", "touched", "touch_speed"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        hits += one.touched.sum()
    assert (hits or count == 1) and not pair[0].not_compiled
    saved, other_saved = (each.save() for each in pair)
    np.testing.assert_array_equal(saved["engine.solids"], other_saved["engine.solids"])
    for shown, expected in zip(*(each.markers() for each in pair), strict=True):
        np.testing.assert_array_equal(shown.position, expected.position)
    restored = Environment(Grove(), num_envs=count, seed=8, engine=engine)
    restored.restore(saved)
    found, expected = (each.step(action).reward for each in (restored, pair[0]))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("count", [0, -1, 1.5, 10_001, "many", np.nan])
def test_a_count_is_a_whole_number_from_1_on(count):
    with refused("tree count"):
        Sphere("tree", count=count)


TREES = [Sphere("tree", radius=0.2, count=3)]


@pytest.mark.parametrize(
    ("pose", "name"),
    [
        (Pose(np.zeros((2, 3))), "position of tree"),
        (Pose(np.zeros((2, 2, 3))), "position of tree"),
        (Pose(np.where(np.eye(3), np.nan, 9.0)[None].repeat(2, 0)), "position of tree"),
        (Pose(np.full((2, 3, 3), np.inf)), "position of tree"),
        (Pose(np.zeros((2, 3, 3)), np.ones((2, 4))), "quaternion of tree"),
        (Pose(np.zeros((2, 3, 3)), np.ones((2, 3, 4))), "quaternion of tree"),
        (Pose(np.zeros((2, 3, 3)), size=np.ones((2, 1))), "size of tree (radius)"),
        (Pose(np.zeros((2, 3, 3)), size=np.full((2, 3, 1), np.nan)), "size of tree (radius)"),
    ],
)
def test_poses_of_another_shape_or_without_a_place_are_refused_and_change_nothing(pose, name):
    far, given = 5.0 * np.arange(1.0, 4.0)[:, None] * [1.0, 0.0, 0.0], list[Pose]()

    def place(self, rng, start, state):
        return {"tree": given[0] if given else Pose(np.tile(far, (len(state.goal), 1, 1)))}

    own = {"solids": lambda self: TREES, "place": place}
    environment = begun(type("Trees", (Hover,), own)(), num_envs=2)
    environment.step(np.zeros((2, 4)))
    saved = environment.save()
    given.append(pose)
    with refused(name):
        environment.reset()
    for key, array in environment.save().items():
        np.testing.assert_array_equal(array, saved[key])
