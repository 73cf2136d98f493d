"""LSY race: where things stand, what is seen of it, and what ends a race."""

import gymnasium
import mujoco
import numpy as np
import pytest
from helpers import matrices, random_quaternions, refused

from quadrl import tasks
from quadrl.core.contact import touches_ground
from quadrl.core.environment import Environment
from quadrl.tasks.arena import nominal
from quadrl.tasks.lsy_race import LsyRace

AT_REST = {"velocity": (0.0, 0.0, 0.0), "quaternion": (1, 0, 0, 0)}


def begun(count=1, position=None, quaternion=None, **options):
    """An environment at its first snapshot, the aircraft at rest somewhere."""
    settings = {"vehicle": "cf21B_500", "engine": "free_flight"}
    environment = Environment(LsyRace(**options), num_envs=count, seed=3, **settings)
    given = {} if quaternion is None else {"quaternion": quaternion}
    environment.reset(
        start=AT_REST | {"position": position} | given if position is not None else {}
    )
    return environment


def frames(task, row):
    """MuJoCo's model of the frames and stands of a row as the competition has them, and a box."""
    spec = mujoco.MjSpec()
    box = mujoco.mjtGeom.mjGEOM_BOX
    for centre, through, left in task.gates[row].reshape(-1, 3, 3):
        quat = np.zeros(4)
        axes = np.array([through, left, np.cross(through, left)])
        mujoco.mju_mat2Quat(quat, axes.T.ravel())
        body = spec.worldbody.add_body(pos=centre, quat=quat)
        for side in (-1, 1):
            body.add_geom(type=box, pos=[0, 0, 0.28 * side], size=[0.01, 0.36, 0.08])
            body.add_geom(type=box, pos=[0, 0.28 * side, 0], size=[0.01, 0.08, 0.36])
        body.add_geom(type=box, pos=[0, 0, -0.86], size=[0.05, 0.05, 0.5])
    spec.worldbody.add_body(mocap=True).add_geom(name="own", type=box, size=[0.07, 0.07, 0.02])
    model = spec.compile()
    return model, mujoco.MjData(model)


def to_poles(task, row, position, rotation):
    """Distance of the box from the nearest pole, by places along the axes of the poles."""
    least = np.inf
    for x, y, top in task.poles[row].reshape(-1, 3):
        along = np.linspace(max(top - 1.6, position[2] - 0.2), min(top, position[2] + 0.2), 801)
        places = np.stack([0 * along + x, 0 * along + y, along], axis=1) - position
        outside = abs(places @ rotation) - (0.07, 0.07, 0.02)
        least = min(least, np.linalg.norm(np.maximum(outside, 0), axis=1).min() - 0.015)
    return least


def test_the_box_touches_where_it_truly_does_and_no_distance_is_overstated():
    draw, count = np.random.default_rng(0), 150
    task = begun(count).snapshot.task
    kind, which = draw.integers(0, 4, count), draw.integers(0, 4, count)
    places = np.zeros((count, 3))
    for row, (what, k) in enumerate(zip(kind, which, strict=True)):
        centre, through, left = task.gates[row].reshape(4, 3, 3)[k]
        up = np.cross(through, left)
        if what == 0:  # near a pole
            off = draw.uniform(-0.14, 0.14, 2)
            places[row] = *(task.poles[row, 3 * k : 3 * k + 2] + off), draw.uniform(0.1, 1.7)
        elif what == 1:  # near a stand
            off = draw.uniform(-0.16, 0.16, 2)
            places[row] = centre + off[0] * through + off[1] * left - draw.uniform(0.3, 1) * up
        else:  # near a frame
            off = draw.normal(0, 0.06), *draw.uniform(-0.5, 0.5, 2)
            places[row] = centre + off[0] * through + off[1] * left + off[2] * up
    places[:, 2] = np.maximum(places[:, 2], 0.12)
    quaternion = random_quaternions(draw, count)
    quaternion[::3, 1:3] *= 0.1  # nearly level
    quaternion[::9, 1:3] = 0.0
    quaternion /= np.linalg.norm(quaternion, axis=1)[:, None]
    now = begun(count, places, quaternion=quaternion).snapshot
    found, turned = now.task.clearance(now.state, LsyRace().course), matrices(quaternion)
    assert 0.3 < (found < 0).mean() < 0.7
    for row in range(count):
        model, data = frames(now.task, row)
        data.mocap_pos[0], data.mocap_quat[0] = places[row], quaternion[row]
        mujoco.mj_kinematics(model, data)
        own = model.geom("own").id
        others = (k for k in range(model.ngeom) if k != own)
        least = min(mujoco.mj_geomDistance(model, data, k, own, 9.0, None) for k in others)
        poles = to_poles(now.task, row, places[row], turned[row])
        assert found[row] < max(min(least, poles), 0.0) + 2e-6
        assert (found[row] < 0) == (least < 0 or poles < 0) or 0 < poles < 1e-3


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("position", "ends"),
    [
        ((-1.5, 0.75, 0.5), False),
        ((-2.99, 0.75, 0.5), False),
        ((-3.01, 0.75, 0.5), True),
        ((0.0, 3.01, 0.5), True),
        ((0.0, 0.0, 2.49), False),
        ((0.0, 0.0, 2.51), True),
        ((0.0, 0.75 + 0.015 + 0.07 + 0.01, 1.0), False),  # beside a pole
        ((0.0, 0.75 + 0.015 + 0.07 - 0.01, 1.0), True),
        # A corner points at it: 0.07 sqrt(2) = 0.0990 and 0.015 are 0.1140 = 0.0806 sqrt(2).
        ((0.0816, 0.75 + 0.0816, 1.0), False),
        ((0.0796, 0.75 + 0.0796, 1.0), True),
        ((0.0, -0.75, 1.2), False),  # in the middle of the last gate
        ((0.0, -0.75 + 0.2 - 0.07 - 0.01, 1.2), False),  # beside its frame, above, below
        ((0.0, -0.75 + 0.2 - 0.07 + 0.01, 1.2), True),
        ((0.0, -0.75, 1.2 + 0.2 - 0.02 - 0.01), False),
        ((0.0, -0.75, 1.2 + 0.2 - 0.02 + 0.01), True),
        ((0.0, -0.75, 0.5), True),  # on its stand
    ],
)
def test_a_race_ends_where_the_aircraft_may_not_be(position, ends):
    environment = begun(1, (-1.5, 0.75, 0.5), level=0)
    environment.engine.qpos[0, :3] = np.add(position, environment.origin)
    environment.engine.qvel[:] = 0.0
    done = environment.step(np.zeros((1, 4)))
    assert done.terminated[0] == ends and not done.is_success[0]


def test_it_begins_on_the_floor_with_its_rotors_at_rest_and_has_half_a_second_to_leave_it():
    environment = begun(20)
    state = environment.snapshot.state
    assert (0.01 <= state.position[:, 2]).all() and (state.position[:, 2] < 0.03).all()
    assert (state.rotor_speed == 0).all() and (environment.snapshot.rotor_command == 0).all()
    # Level, since one that falls on a single foot and only climbs turns over.
    environment.reset(start={"quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (20, 1))})
    climbing = np.arange(20) < 10
    for step in range(1, 40):
        done = environment.step(np.where(climbing[:, None], 1.0, -1.0) * np.ones((20, 4)))
        stays = environment.snapshot.state.height[~climbing]
        assert (stays > 0.5 * environment.vehicle.ground_clearance).all()  # the floor carries it
        assert (done.terminated[~climbing] == (step > 25)).all()
        assert not done.terminated[climbing].any()
        if step == 25:
            assert (environment.snapshot.state.position[climbing, 2] > 0.1).all()
    # What has passed a gate has flown, however long ago it began.
    environment = begun(1, (-1.5, 0.75, 0.5), flying=1.0)
    environment.engine.qpos[0, 2] = 0.01
    assert environment.step(np.zeros((1, 4))).terminated[0]


def test_practice_begins_in_the_middle_of_gates():
    task = LsyRace(flying=1.0)
    environment = begun(300, flying=1.0)
    now = environment.snapshot
    assert set(now.task.gate) == {1.0, 2.0, 3.0} == set(now.task.passed)
    centre, through, _ = task.gate(now.task, now.task.gate - 1)
    np.testing.assert_allclose(now.state.position, centre, atol=1e-12)
    speed = np.linalg.norm(now.state.velocity, axis=1)
    assert speed.max() > 0.95 and (speed < 1.0).all()
    assert (now.state.rotor_speed == environment.vehicle.hover_speed).all()
    np.testing.assert_allclose(now.state.velocity, speed[:, None] * through, atol=1e-12)


def test_its_id_says_that_its_numbers_have_changed():
    assert LsyRace.gymnasium_id() == "quadrl/LsyRace-v2" in gymnasium.registry
    assert tasks.TASKS["hover"].gymnasium_id() == "quadrl/Hover-v0" in gymnasium.registry


def test_no_other_levels():
    with refused(name="lsy_race level", value=3):
        tasks.make("lsy_race", level=3)


def test_in_practice_the_box_may_be_smaller():
    size = begun(300, least_box=0.3).snapshot.task.size
    assert 0.3 <= size.min() < 0.32 and 0.98 < size.max() < 1.0
    environment = begun(1, (-1.5, 0.75, 0.5), level=0, box=0.5, least_box=0.5)
    for aside, ends in ((0.2 - 0.045, False), (0.2 - 0.025, True)):  # half its edge: 3.5 cm
        environment.engine.qpos[0, :3] = np.add((0.0, -0.75 + aside, 1.2), environment.origin)
        environment.engine.qvel[:] = 0.0
        assert environment.step(np.zeros((1, 4))).terminated[0] == ends
    for name, value in (("least_box", 1.1), ("box", 2.0)):
        with refused(name=f"lsy_race {name}", value=value):
            tasks.make("lsy_race", **{name: value})


def test_a_passage_counts_within_a_square_of_45_cm_as_in_the_competition():
    for aside, passes in ((0.22, True), (0.23, False)):
        environment = begun(1, (-1.5, 0.75, 0.5), level=0)
        task = environment.snapshot.task
        place = task.goal + aside * task.left
        environment.engine.qpos[0, :3] = (place - 0.001 * task.through)[0] + environment.origin
        environment.engine.qvel[:] = 0.0
        environment.step(np.zeros((1, 4)))  # now it is before the gate
        environment.engine.qvel[0, :3] = 1.0 * task.through[0]
        environment.step(np.zeros((1, 4)))
        assert (environment.snapshot.task.passed[0] == 1) == passes


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


@pytest.mark.parametrize(("place", "stands"), [(0.035, True), (0.065, False)])
def test_who_stands_on_the_edge_of_a_rotor_is_on_the_ground(place, stands):
    """The height of its centre alone does not tell."""
    side = begun(1, (-1.5, 0.75, place), (np.sqrt(0.5), np.sqrt(0.5), 0, 0))
    vehicle, height = side.vehicle, side.snapshot.state.height.item()
    edge = abs(vehicle.rotors[0].position[1]) + vehicle.rotors[0].radius
    assert vehicle.ground_clearance < height and (height < edge) == stands
    assert touches_ground(side.snapshot, bounces=True).item() == stands


def test_who_falls_on_the_ground_has_touched_it_however_short_the_touch():
    rows, rest = 24, np.zeros((24, 3))
    for name, tilt, limit in (("landing", 1.0, 0.5), ("perching", 0.0, 0.2)):
        made = Environment(name, num_envs=rows, seed=0, engine="free_flight")
        level = [np.cos(tilt / 2), np.sin(tilt / 2), 0.0, 0.0]
        start = rest + (3.0, 0.0, 0.0) - made.origin
        start[:, 2] += np.linspace(0.5, 0.7, rows)
        given = {"velocity": rest - (0.0, 0.0, 2.0), "body_rate": rest, "position": start}
        made.reset(start=given | {"quaternion": np.tile(level, (rows, 1))})
        struck, over = np.zeros((2, rows), dtype=bool)
        last = made.snapshot.state.velocity[:, 2].copy()
        for _ in range(20):
            done = made.step(np.full((rows, 4), -1.0))
            speed = made.snapshot.state.velocity[:, 2]
            before = struck.copy()
            struck |= speed > last + limit  # the ground has pushed
            last = speed.copy()
            over |= done.terminated
            assert over[before].all()  # at once, or a control step later with an edge
            if struck.all():
                break
        assert struck.all() and not done.is_success.any()
