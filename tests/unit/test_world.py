"""The world as sensors and tasks see it: one measurement, the ground in it, and many solids."""

import mujoco
import numpy as np
import pytest
from helpers import begun, refused

from quadrl.aircraft.presets import VEHICLES
from quadrl.conditions.scene import Scene
from quadrl.conditions.sensor import Sensor, register_sensor
from quadrl.conditions.solids import Box, Cylinder, Gate, Pose, Sphere, heading
from quadrl.core.environment import Environment
from quadrl.engines.mjcf import compile_model
from quadrl.tasks.hover import Hover

LEVEL = {"quaternion": [1.0, 0.0, 0.0, 0.0], "velocity": [0.0] * 3, "body_rate": [0.0] * 3}


@pytest.mark.parametrize("name", VEHICLES)
def test_the_height_above_the_ground_is_that_of_the_lowest_geom(name):
    """But for the thickness of discs, a sixth of their radius, and the roundness of feet."""
    turns = np.random.default_rng(3).normal(size=(48, 4))
    turns[0] = LEVEL["quaternion"]
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    environment = begun("hover", num_envs=48, vehicle=name)
    environment.reset(start=LEVEL | {"quaternion": turns, "position": [0.2, 0.1, -1.5]})
    vehicle, expected = environment.vehicle, []
    slab = Scene([Box("slab", length=6.0, width=6.0, height=2.0)])  # MuJoCo measures no plane
    model = compile_model(vehicle, contact=True, drawn=False, scene=slab.add_to)
    data, ground = mujoco.MjData(model), model.geom("slab_0").id
    model.geom_pos[ground], model.geom_quat[ground] = [0.0, 0.0, -1.0], LEVEL["quaternion"]
    parts = np.flatnonzero((model.geom_bodyid == 1) & (model.geom_conaffinity != 0))
    for qpos in environment.engine.qpos:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        far = (mujoco.mj_geomDistance(model, data, ground, k, 9.0, None) for k in parts)
        expected.append(min(far))
    found = environment.snapshot.above_ground
    off = max(0.008 * vehicle.scale, *(rotor.radius / 12 for rotor in vehicle.rotors))
    np.testing.assert_allclose(found, expected, rtol=0, atol=off)
    assert found[0] == pytest.approx(expected[0], abs=1e-6)  # on its feet


@register_sensor
class NearPost(Sensor):
    """Offset of a post, whether it was touched, and what is free about: a user's own sensor."""

    compiled = True
    name, size = "near_post", 6

    def sense(self, now):
        """From the world and the true state."""
        offset = now.world.position[:, 3] - now.true.position
        others = now.world.touched[:, 3], now.world.clearance, now.above_ground
        return np.concatenate([offset, np.stack(others, axis=-1)], axis=-1)


class Grove(Hover):
    """Two gates that drift and turn, and two posts of drawn sizes at drawn places."""

    name = "grove"
    compiled = True
    sensors = {"clearance": {"reach": 0.8}, "near_post": {}}

    def solids(self):
        return [Gate("gate", opening=1.5, count=2), Cylinder("post", count=2)]

    def move(self, state, time):
        drift = 1.2 + 0.3 * time[:, None] * [1.0, -1.0]
        place = np.stack([drift, -drift, 0.0 * drift], axis=-1)
        return {"gate": Pose(place, heading(0.4 * time[:, None] + [0.0, 1.0]))}

    def place(self, rng, start, state):
        off = rng.uniform(-0.8, 0.8, 4).reshape(-1, 2, 2)
        off += np.where(off < 0.0, -0.4, 0.4)
        place = np.concatenate([off, 0.0 * off[..., :1]], axis=-1)
        return super().place(rng, start, state) | {"post": Pose(place, size=abs(off) * [0.1, 5.0])}

    def reward(self, before, now, end):
        room = now.sensed["clearance"][..., 0] - before.sensed["clearance"][..., 0]
        near = now.world.position[..., 2, 0] - now.world.position[..., 1, 1]
        return {"room": room, "near": near + now.above_ground, "hit": now.touched[..., 3] * 1.0}


class OneByOne(Grove):
    """The same, each solid by itself, and not compiled."""

    def solids(self):
        names = [f"{solid.name}{k}" for solid in super().solids() for k in range(2)]
        return [Gate(name, opening=1.5) for name in names[:2]] + [*map(Cylinder, names[2:])]

    def move(self, state, time):
        return alone(super().move(state, time))

    def place(self, rng, start, state):
        placed = super().place(rng, start, state)
        return alone({"post": placed.pop("post")}) | placed


def alone(placed):
    """Poses of single solids, from those (n, 2, ...) of kinds; single ones stay."""
    return {
        f"{name}{k}": Pose(*(a if a is None else a[:, k] for a in vars(pose).values()))
        for name, pose in placed.items()
        for k in range(2)
    }


@pytest.mark.parametrize(("engine", "count"), [("mujoco", 1), ("free_flight", 24)])
def test_solids_of_a_kind_are_seen_and_touched_as_single_ones(engine, count):
    """By tasks and sensors, compiled or not, from a reset, a step or a saved state on."""
    rng, hits = np.random.default_rng(4), 0
    pair = [begun(kind(), count, seed=1, engine=engine) for kind in (Grove, OneByOne)]
    for step in range(36):
        action = rng.uniform(-0.6, 0.6, (count, 4))
        if step % 12 == 0:
            for each in pair:
                each.reset(np.arange(0, count, 2))
        else:
            np.testing.assert_array_equal(*(each.step(action).reward for each in pair))
        now, other = (each.snapshot for each in pair)
        for name in ("clearance", "touched", "touch_speed"):
            np.testing.assert_array_equal(getattr(now, name), getattr(other, name))
        for name in ("gate", "post"):
            singles = [other.solid(f"{name}{k}") for k in range(2)]
            np.testing.assert_array_equal(now.solid(name), np.stack(singles, axis=1))
        np.testing.assert_allclose(now.solid("gate")[..., 2], 0.0, atol=1e-12)
        offset = now.solid("post")[:, 1] - now.state.position
        others = now.touched[:, 3], now.clearance, now.above_ground
        sensed = np.concatenate([offset, np.stack(others, axis=-1)], axis=-1)
        least = np.minimum(np.minimum(now.clearance, now.above_ground), 0.8)
        for each in pair:
            np.testing.assert_array_equal(each.sensed["near_post"], sensed)
            np.testing.assert_array_equal(each.sensed["clearance"][:, 0], least)
        hits += now.touched.sum()
    assert (hits or count == 1) and not pair[0].not_compiled and pair[1].not_compiled
    for shown, single in zip(*(each.markers() for each in pair), strict=True):
        np.testing.assert_array_equal(shown.position, single.position)
    restored = Environment(Grove(), num_envs=count, seed=8, engine=engine)
    restored.restore(pair[0].save())
    found, expected = (each.step(action) for each in (restored, pair[1]))
    np.testing.assert_array_equal(found.observation["near_post"], expected.observation["near_post"])
    np.testing.assert_array_equal(found.reward, expected.reward)


def test_over_open_ground_the_clearance_is_the_height_of_the_feet():
    """Of the paper's aircraft, whose feet are 7 cm below its centre; a control step late."""
    observe = {"sensors": {"clearance": {"delay": 0.05, "reach": 5.0}}}
    environment = begun("hover", num_envs=3, observe=observe)
    start = LEVEL | {"position": np.array([[0.0, 0.0, z] for z in (0.0, -1.0, 17.0)])}
    first = environment.reset(start=start)["clearance"][:, 0]
    np.testing.assert_allclose(first, [2.93, 1.93, 5.0], rtol=0, atol=1e-12)
    for _ in range(3):
        expected = np.minimum(environment.snapshot.state.height - 0.07, 5.0)
        found = environment.step(np.full((3, 4), 0.2)).observation["clearance"][:, 0]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    assert (found > first)[:2].all()


ALIKE = np.ones((2, 3, 3))


@pytest.mark.parametrize(
    ("pose", "name"),
    [
        (Pose(ALIKE[:, 0]), "position of tree"),
        (Pose(ALIKE[:, :2]), "position of tree"),
        (Pose(np.where(np.eye(3), np.nan, ALIKE)), "position of tree"),
        (Pose(ALIKE, np.ones((2, 4))), "quaternion of tree"),
        (Pose(ALIKE, np.ones((2, 3, 4))), "quaternion of tree"),
        (Pose(ALIKE, size=ALIKE[:, :1, :1]), "size of tree (radius)"),
    ],
)
def test_poses_of_another_shape_or_without_a_place_are_refused_and_change_nothing(pose, name):
    given, far = [], np.tile([[5.0, 0.0, 0.0]], (64, 3, 1))
    own = {
        "solids": lambda self: [Sphere("tree", count=3)],
        "place": lambda self, rng, start, state: {
            "tree": given[0] if given else Pose(far[: len(state.goal)])
        },
    }
    environment = begun(type("Trees", (Hover,), own)(), num_envs=2)
    environment.step(np.zeros((2, 4)))
    saved = environment.save()
    given.append(pose)
    with refused(name):
        environment.reset()
    for key, array in environment.save().items():
        np.testing.assert_array_equal(array, saved[key])
