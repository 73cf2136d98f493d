"""LSY race: where things stand, what is seen of it, and what ends a race."""

import mujoco
import numpy as np
import pytest
from helpers import refused

from quadrl import tasks
from quadrl.core.environment import Environment
from quadrl.tasks.arena import nominal
from quadrl.tasks.lsy_race import LsyRace

AT_REST = {"velocity": (0.0, 0.0, 0.0), "quaternion": (1, 0, 0, 0)}


def begun(count=1, position=None, **options):
    """An environment at its first snapshot, the aircraft at rest somewhere."""
    settings = {"vehicle": "crazyflie_brushless", "engine": "free_flight"}
    environment = Environment(LsyRace(**options), num_envs=count, seed=3, **settings)
    environment.reset(start=None if position is None else AT_REST | {"position": position})
    return environment


def world(task, row):
    """MuJoCo's model of the solids of a row, and a point that moves about as a tiny ball."""
    spec = mujoco.MjSpec()
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    for centre, through, left in task.gates[row].reshape(-1, 3, 3):
        quat = np.zeros(4)
        axes = np.array([through, left, np.cross(through, left)])
        mujoco.mju_mat2Quat(quat, axes.T.ravel())
        body = spec.worldbody.add_body(pos=centre, quat=quat)
        for side in (-1, 1):
            body.add_geom(type=box, pos=[0, 0, 0.28 * side], size=[0.01, 0.36, 0.08])
            body.add_geom(type=box, pos=[0, 0.28 * side, 0], size=[0.01, 0.08, 0.36])
        body.add_geom(type=box, pos=[0, 0, -0.36 - 1.0], size=[0.05, 0.05, 1.0])
    for x, y, top in task.poles[row].reshape(-1, 3):
        spec.worldbody.add_geom(type=cylinder, pos=[x, y, top - 2.0], size=[0.015, 2.0, 0])
    body = spec.worldbody.add_body(mocap=True)
    body.add_geom(name="point", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-4, 0, 0])
    model = spec.compile()
    return model, mujoco.MjData(model)


def test_what_is_free_is_the_distance_that_mujoco_measures():
    draw = np.random.default_rng(0)
    places = draw.uniform((-1.6, -1.0, 0.3), (1.4, 1.0, 1.6), (60, 3))
    now = begun(60, places).snapshot
    found = now.task.room(now.state.position, LsyRace().course)
    for row in range(60):
        model, data = world(now.task, row)
        data.mocap_pos[0] = now.state.position[row]
        mujoco.mj_kinematics(model, data)
        point = model.geom("point").id
        others = [k for k in range(model.ngeom) if k != point]
        least = min(mujoco.mj_geomDistance(model, data, k, point, 9.0, None) for k in others)
        assert found[row] == pytest.approx(max(least, 0.0), abs=3e-4)


def test_gates_and_poles_stand_elsewhere_in_each_episode_of_level_two_alone():
    gates, poles = (np.array(rows) for rows in nominal(LsyRace().course))
    for level in (0, 1, 2):
        task = begun(200, level=level).snapshot.task
        moved = abs(task.gates - gates).reshape(200, -1, 3, 3)[..., 0, :]
        fallen = abs(task.poles - poles).reshape(200, -1, 3)
        should = gates.reshape(-1, 3, 3)[:, 1]
        axes = task.gates.reshape(200, -1, 3, 3)[:, :, 1:]
        up = np.cross(axes[:, :, 0], axes[:, :, 1])
        np.testing.assert_allclose(np.linalg.norm(axes, axis=-1), 1.0, rtol=1e-12)
        np.testing.assert_allclose((axes[:, :, 0] * axes[:, :, 1]).sum(-1), 0.0, atol=1e-12)
        # Roll, pitch and yaw, one after the other about axes of the world.
        roll = np.arctan2(axes[..., 1, 2], up[..., 2])
        pitch = -np.arcsin(axes[..., 0, 2])
        yaw = np.arctan2(axes[..., 0, 1], axes[..., 0, 0])
        turned = (yaw - np.arctan2(should[:, 1], should[:, 0]) + np.pi) % (2 * np.pi) - np.pi
        angles = [abs(angle).max() for angle in (roll, pitch, turned)]
        most = *moved.max(axis=(0, 1)), *angles, *fallen.max(axis=(0, 1))
        bounds = np.array([0.15, 0.15, 0.1, 0.05, 0.1, 0.2, 0.15, 0.15, 0.05])
        if level == 2:
            assert (most < bounds).all() and (most > 0.95 * bounds).all()
        else:
            np.testing.assert_allclose(most, 0.0, atol=1e-7)


def test_where_they_truly_stand_is_seen_from_near_and_known_from_then_on():
    environment = begun(1, (-1.5, 0.75, 0.5))
    truth = environment.snapshot.task
    gates, poles = (np.array(rows).reshape(4, -1) for rows in nominal(LsyRace().course))

    def seen(position):
        """The first gate and the poles, world frame, as an aircraft sees them from somewhere."""
        environment.engine.qpos[0, :3] = np.add(position, environment.origin)
        environment.engine.qvel[:] = 0.0
        now = environment.step(np.zeros((1, 4)))
        place, turn = environment.snapshot.state.position[0], environment.snapshot.state.rotation[0]
        to_gate = now.observation["goal"][0]
        to_poles = now.observation["poles"][0].reshape(4, 3)
        return place + turn @ to_gate, place + to_poles @ turn.T

    for place, near in (((-1.5, 0.75, 0.5), False), ((-0.4, 1.0, 1.9), True), ((-1.5, 1, 1), True)):
        gate, found = seen(place)
        np.testing.assert_allclose(gate, gates[0, :3], atol=1e-6)
        first = truth.poles[0, :3] if near else poles[0]
        np.testing.assert_allclose(found[:, :2], [first[:2], *poles[1:, :2]], atol=1e-6)
    gate, _ = seen((0.2, 0.5, 1.9))  # 0.4 m from the gate by the map, high above it
    np.testing.assert_allclose(gate, truth.gates[0, :3], atol=1e-6)


@pytest.mark.parametrize(
    ("position", "ends"),
    [
        ((-1.5, 0.75, 0.5), False),
        ((-2.51, 0.75, 0.5), True),
        ((0.0, 1.51, 0.5), True),
        ((0.0, 0.0, 2.05), True),
        ((0.0, 0.75 + 0.015 + LsyRace.ball + 0.01, 1.0), False),  # beside a pole
        ((0.0, 0.75 + 0.015 + LsyRace.ball - 0.01, 1.0), True),
        ((0.0, -0.75, 1.2), False),  # in the middle of the last gate
        ((0.0, -0.75 + 0.14, 1.2), True),  # too near to its frame
        ((0.0, -0.75, 0.5), True),  # on its stand
    ],
)
def test_a_race_ends_where_the_aircraft_may_not_be(position, ends):
    environment = begun(1, (-1.5, 0.75, 0.5), level=0)
    environment.engine.qpos[0, :3] = np.add(position, environment.origin)
    environment.engine.qvel[:] = 0.0
    done = environment.step(np.zeros((1, 4)))
    assert done.terminated[0] == ends and not done.is_success[0]


def test_practice_begins_in_the_middle_of_gates():
    task = LsyRace(flying=1.0)
    environment = begun(300, flying=1.0)
    now = environment.snapshot
    assert set(now.task.gate) == {1.0, 2.0, 3.0} == set(now.task.passed)
    centre, through, _ = task.gate(now.task, now.task.gate - 1)
    np.testing.assert_allclose(now.state.position, centre, atol=1e-12)
    speed = np.linalg.norm(now.state.velocity, axis=1)
    assert speed.max() > 0.95 and (speed < 1.0).all()
    np.testing.assert_allclose(now.state.velocity, speed[:, None] * through, atol=1e-12)


def test_no_other_levels():
    with refused(name="lsy_race level", value=3):
        tasks.make("lsy_race", level=3)


def test_in_practice_the_ball_may_be_smaller():
    size = begun(300, least_ball=0.02).snapshot.task.ball
    assert 0.02 <= size.min() < 0.025 and 0.065 < size.max() < 0.07
    environment = begun(1, (-1.5, 0.75, 0.5), level=0, ball=0.01, least_ball=0.01)
    environment.engine.qpos[0, :3] = np.add((0.0, -0.75 + 0.18, 1.2), environment.origin)
    assert not environment.step(np.zeros((1, 4))).terminated[0]  # 2 cm from the last frame
    with refused(name="lsy_race least_ball", value=0.1):
        tasks.make("lsy_race", least_ball=0.1)


def test_progress_is_paid_up_to_a_speed_and_leads_around_the_second_gate():
    task = LsyRace(level=0, paid_speed=2.0, progress_weight=10.0)
    gate, wrong = task.course.centre[1], -task.course.axes[1, 0]
    state = begun(1, level=0).snapshot.task
    centre, through, left = task.gate(state, np.array([1.0]))
    ahead = lambda *place: task._way_left(replaced, np.array([place]))[0]  # noqa: E731
    replaced = type(state)(**vars(state) | {"goal": centre, "through": through, "left": left})
    before, behind = gate + wrong, gate - 0.3 * wrong
    assert ahead(*before) == pytest.approx(1.0)  # straight on, from in front of it
    assert ahead(*behind) == pytest.approx(0.9)  # from behind by a place 0.3 m before it
    for speed, paid in ((1.0, 1.0), (5.0, 2.0)):
        environment = begun(1, (-1.5, 0.75, 0.5), level=0, paid_speed=2.0, progress_weight=10.0)
        way = task.course.centre[0] - (-1.5, 0.75, 0.5)
        way /= np.linalg.norm(way)
        environment.engine.qvel[0, :3] = speed * way
        done = environment.step(np.zeros((1, 4)))
        step = environment.vehicle.control_timestep
        assert done.reward_terms["progress"][0] == pytest.approx(10.0 * paid * step, rel=0.25)


def test_a_moment_costs_what_is_asked_for_five_hundredths_of_a_second():
    for weight in (0.0, 0.5):
        environment = begun(2, time_weight=weight)
        done = environment.step(np.zeros((2, 4)))
        cost = weight * environment.vehicle.control_timestep / 0.05
        assert done.reward_terms["time"] == pytest.approx([-cost, -cost])
