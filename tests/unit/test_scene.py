"""Solids in the world: how far they are, what they stop, and that both engines agree."""

import dataclasses

import mujoco
import numpy as np
import pytest
from helpers import begun, refused

from quadrl.aircraft.presets import VEHICLES
from quadrl.base.rotation import rotation_matrix
from quadrl.conditions.scene import Scene
from quadrl.conditions.solids import Box, Capsule, Cylinder, Gate, Pose, Sphere, heading
from quadrl.core.environment import Environment
from quadrl.engines.mjcf import compile_model
from quadrl.engines.mujoco import make
from quadrl.engines.state import Start
from quadrl.evaluation.rollout import fly
from quadrl.tasks.hover import Hover
from quadrl.testing import check_task

PAPER = VEHICLES["paper"]
EVERY = Scene(
    [
        Sphere("ball", radius=0.3),
        Cylinder("post", radius=0.1, height=4.0),
        Capsule("branch", radius=0.1, length=3.6),
        Box("wall", length=0.2, width=3.0, height=2.0),
        Gate("gate", opening=1.2, frame=0.1),
    ]
)


def flown(scene, poses, velocity, steps=12, engine="mujoco", vehicle=PAPER):
    """Engine and track (steps + 1, N, 3) [m] of aircraft at hover speed, from the origin on."""
    count = len(velocity)
    model = compile_model(vehicle, drawn=False, scene=scene.add_to if scene else None)
    made = make(engine, vehicle, model, count, altitude=3.0)
    rest, hover = np.zeros((count, 3)), np.tile(vehicle.hover_speed, (count, 1))
    level = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    start = Start(rest, level, np.asarray(velocity, dtype=float), rest, hover)
    solids = scene.poses(poses, count, made.origin) if scene else None
    made.place(np.arange(count), start, solids=solids)
    made.ctrl[:] = hover
    track, hits = [made.state.position.copy()], np.zeros((count, 2))
    made.clearances = [made.clearance()]
    for _ in range(steps):
        made.hits[:] = 0.0
        made.advance(10)
        made.read()
        track.append(made.state.position.copy())
        made.clearances.append(made.clearance())
        if scene:
            hits = np.where(made.hits[:, 1:] > hits[:, 1:], made.hits, hits)
    return made, np.array(track), hits


def enclosing(vehicle):
    """Centres (3,) and radii [m] of balls about hull, discs, arms (three each) and feet."""
    scale = vehicle.size / 0.23
    yield np.zeros(3), max(vehicle.hull)
    for rotor in vehicle.rotors:
        tip, up = np.array(rotor.position), np.array(rotor.axis)
        yield tip + vehicle.rotor_height * up, np.hypot(1.0, 0.005 / 0.06) * rotor.radius
        for middle in (1 / 6, 3 / 6, 5 / 6):
            yield middle * tip, np.linalg.norm(tip) / 6 + 0.008 * scale
    x, y, z = vehicle.foot
    for ahead, left in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        yield np.array([ahead * x, left * y, z + 0.008 * scale]), 0.008 * scale


@pytest.mark.parametrize("name", VEHICLES)
def test_clearance_is_a_lower_bound_of_the_distance_to_what_can_touch(name):
    """Small balls about each part of an aircraft, as far as the farthest part or less."""
    vehicle, rng, count = VEHICLES[name], np.random.default_rng(1), 96
    scene = Scene([Sphere("ball", radius=0.02 * vehicle.scale)])
    level = flown(scene, {}, np.zeros((count, 3)), 0, vehicle=vehicle)[0]
    model, data = level.model, mujoco.MjData(level.model)
    ball, parts = level.solids.geoms[0], np.flatnonzero(level.model.geom_bodyid == 1)
    near = model.geom_pos[rng.choice(parts, count)]
    way = rng.normal(size=(count, 3))
    away = rng.uniform(0, 0.3, (count, 1)) * vehicle.size
    places = near + away * way / np.linalg.norm(way, axis=1, keepdims=True)
    made = flown(scene, {"ball": Pose(places)}, np.zeros((count, 3)), 0, vehicle=vehicle)[0]
    measured, touches = np.zeros(count), np.zeros(count, dtype=bool)
    for row in range(count):
        model.geom_pos[ball] = made.solids.poses[row, 0, :3]
        data.qpos[:] = made.qpos[row]
        mujoco.mj_forward(model, data)
        measured[row] = min(mujoco.mj_geomDistance(model, data, ball, k, 9.0, None) for k in parts)
        touches[row] = (data.contact.dist <= 0).any()  # a grip reaches farther
    free = measured > 1e-6
    assert (made.clearance() <= np.where(free, measured, 0.0) + 1e-6).all()
    assert touches.sum() > 10 and free.sum() > 10 and (made.clearance()[touches] < 0).all()
    # By the size of the hull at most; it is a ball there, and each disc another one.
    coarse = max(*vehicle.hull, *(rotor.radius for rotor in vehicle.rotors))
    assert (made.clearance()[free] > measured[free] - coarse).all()


@pytest.mark.parametrize("solid", EVERY.solids, ids=EVERY.names)
def test_clearance_is_the_distance_that_mujoco_measures(solid):
    scene = Scene([solid])
    rng, count = np.random.default_rng(0), 40
    turn = rng.normal(size=(count, 4))
    turn /= np.linalg.norm(turn, axis=1)[:, None]
    poses = {solid.name: Pose(rng.uniform(-4, 4, (count, 3)), turn)}
    engine, *_ = flown(scene, poses, np.zeros((count, 3)), steps=0)
    found = engine.clearance()
    spec = mujoco.MjSpec()
    scene.add_to(spec)
    centres, radii = zip(*enclosing(PAPER), strict=True)
    body = spec.worldbody.add_body(mocap=True)
    for k, (centre, radius) in enumerate(zip(centres, radii, strict=True)):
        kind = mujoco.mjtGeom.mjGEOM_SPHERE
        body.add_geom(name=f"part_{k}", type=kind, size=[radius, 0, 0], pos=centre)
    model = spec.compile()
    data, solids = mujoco.MjData(model), engine.solids.geoms - engine.solids.geoms[0]
    for row in range(count):
        where = engine.solids.poses[row]
        model.geom_pos[solids], model.geom_quat[solids] = where[:, :3], where[:, 3:]
        data.mocap_pos[0], data.mocap_quat[0] = engine.qpos[row, :3], engine.qpos[row, 3:]
        mujoco.mj_kinematics(model, data)
        parts = [model.geom(f"part_{k}").id for k in range(len(centres))]
        least = min(
            mujoco.mj_geomDistance(model, data, solid, part, 100.0, None)
            for solid in solids
            for part in parts
        )
        if least > 0.01:  # what overlaps MuJoCo measures otherwise
            assert found[row] == pytest.approx(least, abs=1e-6)
        else:
            assert found[row] < 0.02


@pytest.mark.parametrize("count", [1, 11])
def test_both_engines_stop_at_a_post_and_say_how_fast_it_was_hit(count):
    ahead = np.stack([1.0 + 0.1 * np.arange(count), *np.zeros((2, count))], axis=-1)
    poses = {"post": Pose(ahead)}
    scene = Scene([Cylinder("post", radius=0.1, height=4.0)])
    velocity = np.tile([3.0, 0.0, 0.0], (count, 1))
    tracks, hits = [], []
    for engine in ("mujoco", "free_flight"):
        _, track, hit = flown(scene, poses, velocity, engine=engine)
        # The rotor ahead is 0.2 m from the centre and 0.1 m wide; contacts give way a little.
        assert (track[:, :, 0].max(axis=0) < ahead[:, 0] - 0.25).all()
        np.testing.assert_array_equal(hit[:, 0], 1.0)
        assert (abs(hit[:, 1] - 2.95) < 0.05).all()  # 3 m/s less the drag
        tracks.append(track)
        hits.append(hit)
    # Free flight turns the attitude by a method of fourth order, which shows after a hit.
    np.testing.assert_allclose(tracks[0][:7], tracks[1][:7], rtol=0, atol=1e-4)
    np.testing.assert_allclose(hits[0], hits[1], rtol=1e-6)


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize("name", VEHICLES)
def test_a_post_between_hull_and_rotor_is_touched(name, engine):
    """A post half as thick as an arm, in the middle of what hull and discs leave of one."""
    vehicle = VEHICLES[name]
    tip = np.array(vehicle.rotors[0].position)
    arm = np.linalg.norm(tip)
    middle = (max(vehicle.hull) + arm - vehicle.rotors[0].radius) / 2 / arm * tip
    across = np.array([[-tip[1], tip[0], 0.0]]) / arm
    scene = Scene([Cylinder("post", radius=0.002 * vehicle.scale, height=4.0)])
    pose = {"post": Pose(middle + 2.0 * vehicle.size * across)}
    velocity = 10.0 * vehicle.size * across
    hits = flown(scene, pose, velocity, steps=6, engine=engine, vehicle=vehicle)[2]
    assert hits[0, 0] == 1 and hits[0, 1] > 2 * vehicle.size


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_a_post_in_the_way_of_an_arm_swings_the_aircraft_around_it(engine):
    """A post of 6 cm half-way along the arm of the paper's aircraft, at 2 m/s.

    The impulse J at 0.12 m takes J / m of its speed and turns it by 0.12 J / J_z, so that the arm
    stops: 2 = J (1 / 0.65 + 0.12^2 / 0.013), of which 1.16 m/s are the speed's, in still air.
    """
    scene = Scene([Cylinder("post", radius=0.03, height=4.0)])
    pose = {"post": Pose(np.array([[0.122, 1.0, 0.0]]))}
    _, track, hits = flown(scene, pose, [[0.0, 2.0, 0.0]], steps=10, engine=engine)
    assert hits[0].tolist() == [1.0, pytest.approx(1.98, abs=0.02)]
    speed = (track[-1, 0, 1] - track[-5, 0, 1]) / 0.4
    assert 0.3 < speed < 2.0 - 1.16


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize("solid", EVERY.solids, ids=EVERY.names)
def test_a_size_of_a_row_acts_as_the_declared_one(solid, engine):
    count, name = 4, solid.name
    declared = [getattr(solid, length) for length in solid.lengths]
    size = np.random.default_rng(0).uniform(0.6, 1.5, (count, len(declared))) * declared
    place = np.tile([1.3, 0.65 if name == "gate" else 0.0, 0.0], (count, 1))
    pose = Pose(place, heading(np.full(count, 0.2)), size)
    velocity = np.tile([3.0, 0.0, 0.0], (count, 1))
    made, track, hits = flown(Scene([solid]), {name: pose}, velocity, engine=engine)
    assert hits[:, 0].any()
    for row in range(count):
        own = dataclasses.replace(solid, **dict(zip(solid.lengths, size[row], strict=True)))
        one = Pose(place[:1], pose.quaternion[:1])
        sized = dataclasses.replace(one, size=size[row : row + 1])
        for scene, where in ((Scene([own]), one), (Scene([solid]), sized)):
            alone, path, hit = flown(scene, {name: where}, velocity[:1], engine=engine)
            np.testing.assert_array_equal(path[:, 0], track[:, row])
            np.testing.assert_array_equal(hit[0], hits[row])
            np.testing.assert_array_equal(alone.clearances, np.array(made.clearances)[:, [row]])
            np.testing.assert_array_equal(alone.solids.centres[0], made.solids.centres[row])
            pictures = [s.primitives(e, k)[0].size for s, e, k in ((scene, alone, 0),
                        (Scene([solid]), made, row))]  # fmt: skip
            np.testing.assert_array_equal(*pictures)


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_among_many_posts_the_nearest_is_known_all_the_way(engine):
    draw, count, many = np.random.default_rng(2).uniform, 3, 14
    places = np.stack([draw(-3, 9, (many, count)), draw(0.7, 4, (many, count))], axis=-1)
    places *= np.sign(draw(-1, 1, (many, count, 1))) * [0, 1] + [1, 0]
    places[0] = [[8.0, 0.0]] * count  # in the way
    scene = Scene([Cylinder(f"post_{k}", radius=0.1, height=4.0) for k in range(many)])
    level = np.concatenate([places, 0 * places[..., :1]], axis=-1)
    poses = {f"post_{k}": Pose(level[k]) for k in range(many)}
    velocity = np.array([[5.0, 0, 0], [5.0, 0.02, 0], [4.5, -0.02, 0]])
    flight, track, hits = flown(scene, poses, velocity, steps=30, engine=engine)
    assert (hits[:, 0] > 0).all() and (track[:, :, 0].max(axis=0) < 7.75).all()
    parts = list(enclosing(PAPER))
    # Level, since nothing has been touched.
    before = np.maximum.accumulate(track[:, :, 0]) < 7.0
    free = [
        np.linalg.norm((track + centre)[:, None, :, :2] - places, axis=-1).min(axis=1) - radius
        for centre, radius in parts
    ]
    clearance = np.array(flight.clearances)
    np.testing.assert_allclose(clearance[before], np.min(free, axis=0)[before] - 0.1, atol=1e-9)
    assert before.sum() > 40
    row = np.array([2])
    np.testing.assert_array_equal(flight.clearance(row), flight.clearance()[row])
    # Posts that have come nearer since.
    aside = {name: Pose(pose.position - [6.0, 0, 0]) for name, pose in poses.items()}
    flight.solids.place(np.arange(count), scene.poses(aside, count, flight.origin))
    there = flown(scene, aside, velocity, steps=0)[0]
    there.qpos[:] = flight.qpos
    np.testing.assert_array_equal(flight.clearance(), there.clearance())
    # Some wider, and then again as they are declared.
    wide = {k: Pose(aside[k].position, size=np.tile([0.4, 5.0], (count, 1))) for k in aside}
    flight.solids.place(np.arange(count), scene.poses(wide, count, flight.origin))
    assert (flight.clearance() < there.clearance()).all()
    flight.solids.place(np.arange(count), scene.poses(aside, count, flight.origin))
    np.testing.assert_array_equal(flight.clearance(), there.clearance())


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_a_solid_that_no_episode_places_stands_where_it_is_declared(engine):
    post = Cylinder("post", radius=0.1, height=4.0, position=(1.0, 2.0, 0.0))
    task = type("BesidePost", (Hover,), {"name": "beside_post", "solids": lambda _: [post]})()
    environment = Environment(task, num_envs=3, seed=0, engine=engine)
    for rows in (None, np.array([False, True, False])):
        environment.reset() if rows is None else environment.reset(rows)
        np.testing.assert_array_equal(environment.snapshot.solid("post"), [post.position] * 3)
        environment.step(np.zeros((3, 4)))
        assert (abs(environment.snapshot.clearance - 5**0.5) < 1.2).all()


def test_far_from_every_solid_an_aircraft_flies_as_without():
    velocity = np.array([[3.0, 1.0, 0.5], [0.0, -2.0, 0.0]])
    far = {solid.name: Pose(np.full((2, 3), 20.0)) for solid in EVERY.solids}
    for engine in ("mujoco", "free_flight"):
        _, with_solids, hits = flown(EVERY, far, velocity, engine=engine)
        _, without, _ = flown(None, {}, velocity, engine=engine)
        # MuJoCo takes shorter steps where an aircraft can touch something.
        most = 0 if engine == "free_flight" else 1e-9
        np.testing.assert_allclose(with_solids, without, rtol=0, atol=most)
        assert not hits.any()


def test_a_gate_is_open_in_its_middle_and_turns_with_its_pose():
    scene, ahead = Scene([Gate("gate", opening=1.2, frame=0.1)]), np.array([[1.5, 0.0, 0.0]])
    north, velocity = heading(np.array([np.pi / 2])), np.array([[4.0, 0.0, 0.0]])
    aside = ahead + [0.0, 0.65, 0.0]  # the bar stands in the way
    for pose, hits in ((Pose(ahead), False), (Pose(aside), True), (Pose(ahead, north), True)):
        _, track, hit = flown(scene, {"gate": pose}, velocity, engine="free_flight", steps=16)
        assert (track[-1, 0, 0] > 2.0) != hits and hit.any() == hits
    bars = Scene([Gate("gate")]).poses({"gate": Pose(ahead, north)}, 1, np.zeros(3))
    # Turned to the north the bars aside stand to the west and to the east of its centre.
    turned = rotation_matrix(north) @ np.array([0.0, 0.55, 0.0])
    np.testing.assert_allclose(bars[0, 2, :3], ahead[0] + turned[0], atol=1e-12)


def of_size(*lengths, count=1):
    return Pose(np.zeros((count, 3)), size=np.tile(lengths, (count, 1)))


def placing(last=None, **poses):
    return lambda: EVERY.poses(poses, 1, np.zeros(3), last)


def turned_by(quaternion):
    return placing(ball=Pose(np.zeros((1, 3)), quaternion))


@pytest.mark.parametrize(
    ("make_it", "name"),
    [
        (lambda: Sphere("ball", radius=0.0), "ball radius"),
        (lambda: Sphere("ball", radius=1e10), "ball radius"),
        (lambda: Box("wall", grip=-1.0), "wall grip"),
        (lambda: Box("wall", grip=np.inf), "wall grip"),
        (lambda: Box("wall", length=-1.0), "wall length"),
        (lambda: Cylinder("post", height="2 m"), "post height"),  # pyright: ignore
        (lambda: Sphere("no name"), "solid"),
        *((lambda k=k: Sphere("tree", count=k), "tree count") for k in (0, 1.5, 10_001, np.nan)),
        (lambda: Sphere("ball", position=(0.0, np.nan, 0.0)), r"ball position\[1\]"),
        (lambda: Sphere("ball", position=(0.0, 0.0, 1e10)), r"ball position\[2\]"),
        (lambda: Sphere("ball", position=(0.0, 0.0)), "ball position"),  # pyright: ignore
        (lambda: Sphere("ball", position="near"), "ball position"),  # pyright: ignore
        (lambda: Box("wall", rgba=(1.0, 0.0, 0.0)), "wall rgba"),  # pyright: ignore
        (lambda: Box("wall", rgba=(255.0, 0.0, 0.0, 1.0)), r"wall rgba\[0\]"),
        (lambda: Scene([Sphere("ball"), Box("ball")]), "solids"),
        (lambda: Scene(["post"]), "solids"),  # pyright: ignore
        (lambda: Scene(None), "solids"),  # pyright: ignore
        (lambda: Scene(Sphere("ball")), "solids"),  # pyright: ignore
        (placing(bal=Pose(np.zeros((1, 3)))), "place"),
        (lambda: EVERY.poses(None, 1, np.zeros(3)), "place"),  # pyright: ignore
        (lambda: EVERY.poses(None, 1, np.zeros(3), np.ones((1, 7, 7))), "move"),  # pyright: ignore
        (placing(ball=np.zeros((1, 3))), "place"),
        (placing(ball=Pose(np.zeros(3))), "position of ball"),
        (placing(ball=Pose(None)), "position of ball"),
        (placing(ball=Pose([["here", "there", "up"]])), "position of ball"),
        (placing(ball=Pose(np.full((1, 3), np.nan))), "position of ball"),
        (placing(ball=Pose(np.full((1, 3), -1.01e9))), "position of ball"),
        (turned_by(np.zeros((1, 4))), "quaternion of ball"),
        (turned_by(np.full((1, 4), 1e-320)), "quaternion of ball"),
        (turned_by(np.full((1, 4), 0.52)), "quaternion of ball"),
        (turned_by(np.array([[1.0, 0.0, np.nan, 0.0]])), "quaternion of ball"),
        (turned_by(np.ones((1, 3))), "quaternion of ball"),
        (placing(ball=of_size(0.0)), "size of ball"),
        (placing(ball=of_size(1.01e9)), "size of ball"),
        (placing(ball=of_size(np.nan)), "size of ball"),
        (placing(post=of_size(0.1)), r"size of post \(radius, height\)"),
        (placing(np.ones((1, 7, 7)), ball=of_size(0.1)), "size of ball .* None in `move`"),
    ],
)
def test_what_no_world_can_hold_is_refused(make_it, name):
    with refused(match=f"^{name}"):
        make_it()


def test_a_quaternion_of_nearly_unit_length_means_its_direction():
    unit = np.array([[0.6, 0.0, 0.8, 0.0]])
    made = [
        EVERY.poses({"wall": Pose(np.zeros((1, 3)), length * unit)}, 1, np.zeros(3))
        for length in (1.0, 0.995, 1.005)
    ]
    np.testing.assert_allclose(made[1:], [made[0]] * 2, rtol=0, atol=1e-15)


# ---------------------------------------------------------------------------------- in a task


@dataclasses.dataclass(frozen=True)
class Posted(Hover):
    """Hover beside a post that stands somewhere else in each episode."""

    name = "posted"
    asks = starts = ends = solved = "as hover, and the post is not touched"

    def solids(self):
        return [Cylinder("post", radius=0.2, height=8.0), Sphere("ball", position=(0.0, 9.0, 0.0))]

    def place(self, rng, start, state):
        return {"post": Pose(rng.level_direction() * 1.2)}

    def reward(self, before, now, end):
        return super().reward(before, now, end) | {"room": 0.1 * now.clearance}

    def terminated(self, now):
        return super().terminated(now) | {"post": now.touched.any(-1)}


def test_pictures_have_solids_where_they_stand_in_the_episode():
    environment = begun(Posted(), num_envs=2)
    where = environment.snapshot.world.position + environment.origin
    for row in range(2):
        post, ball = environment.markers(row)[-2:]
        assert (post.shape, ball.shape) == ("cylinder", "sphere") and post.glow == 0.0
        np.testing.assert_allclose([post.position, ball.position], where[row])
        np.testing.assert_allclose(post.size[:2], [0.2, 4.0])
    flown = fly(lambda seen: np.zeros((len(seen), 4)), Posted(time_limit=0.2), episodes=1)
    flight = flown.trajectory(environment.vehicle).resampled(60)
    assert len(flight.markers) == len(flight.time) and flight.markers[5][-2].shape == "cylinder"


@dataclasses.dataclass(frozen=True)
class Sized(Posted):
    """The post is of another thickness in each episode."""

    name = "sized"

    def place(self, rng, start, state):
        radius = rng.uniform(0.1, 0.3)
        size = np.stack([radius, 0.0 * radius + 8.0], axis=-1)
        return {"post": dataclasses.replace(super().place(rng, start, state)["post"], size=size)}


@pytest.mark.slow
@pytest.mark.parametrize("task", [Posted, Sized])
def test_a_task_with_solids_keeps_the_contract_in_every_api(task):
    check_task(task)


def test_tasks_see_the_same_in_both_engines_and_a_touch_ends_the_episode():
    count, seen = 40, {}
    for engine in ("mujoco", "free_flight"):
        environment = Environment(Posted(), num_envs=count, seed=5, engine=engine)
        rest = dict.fromkeys(("position", "body_rate"), [0.0, 0.0, 0.0])
        level = {"quaternion": [1.0, 0.0, 0.0, 0.0], "velocity": [1.5, 0.0, 0.0]}
        environment.reset(start=rest | level)
        post = environment.snapshot.solid("post")
        clearance, over, speed = [], np.zeros(count, dtype=bool), np.zeros(count)
        for _ in range(16):
            done, now = environment.step(np.zeros((count, 4))), environment.snapshot
            assert (now.touched.any(-1) | (now.touch_speed == 0)).all()
            assert not now.touched[:, 1].any()  # the ball is far away
            speed = np.where(over, speed, np.maximum(speed, now.touch_speed))
            over |= now.touched[:, 0]
            assert (done.terminated | ~now.touched[:, 0]).all()
            clearance.append(np.where(over, 0.0, now.clearance))
        seen[engine] = post, np.array(clearance), over, speed
        assert not now.touched[over, 0].all()  # some have bounced off since
        # Whoever touched it flew towards it; the drag takes 2 % of the speed.
        assert over.any() and not over.all() and (post[over, 0] > 0.9).all()
        assert (speed[over] < 1.5).all()
    one, other = seen.values()
    for k in range(3):
        np.testing.assert_allclose(one[k], other[k], rtol=0, atol=1e-6)
    # What tumbles after its first touch may touch again, faster, in the same control step.
    np.testing.assert_allclose(one[3], other[3], rtol=0.01)


def test_a_reset_of_some_rows_moves_their_solids_alone():
    batch = begun(Posted(), num_envs=4, seed=7)
    places = batch.snapshot.solid("post").copy()
    batch.reset(np.array([1, 3]))
    moved = abs(batch.snapshot.solid("post") - places).max(axis=-1)
    np.testing.assert_array_equal(moved > 0.01, [False, True, False, True])


def unchanged(environment, saved):
    for name, array in environment.save().items():
        np.testing.assert_array_equal(array, saved[name])


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_a_start_in_a_solid_is_refused_and_changes_nothing(engine):
    """The ball of 0.2 m stands 9 m to the north, and a rotor's hub 0.23 m from the centre."""
    environment = begun(Posted(), num_envs=3, engine=engine)
    before = environment.save()
    level = {"quaternion": [1.0, 0.0, 0.0, 0.0]}
    for north, rows in (((0.0, 9.05, 9.4), [1, 2]), ((9.0, 0.0, 0.0), [0])):
        places = np.array([(0.0, y, 0.0) for y in north])
        said = rf"be outside of post, ball; rows that begin in one: \{rows}"
        with refused("position at the start", match=said):
            environment.reset(start=level | {"position": places})
    with refused("position at the start", match=r"\[2\]"):
        environment.reset(np.array([2]), start=level | {"position": [0.0, 9.0, 0.0]})
    unchanged(environment, before)
    # The edge of a rotor may be in it: whoever touches a solid is no fault of the scene.
    environment.reset(start=level | {"position": [0.0, 9.45, 0.0]})
    declared = {"solids": lambda self: [Sphere("ball", radius=2.0)]}
    sized = {
        "solids": lambda self: [Sphere("ball")],
        "place": lambda self, rng, start, state: {"ball": of_size(2.0, count=len(state.goal))},
    }
    for solids in (declared, sized):
        with refused("position at the start", lists="ball"):
            begun(type("InBall", (Hover,), solids)(), num_envs=3, engine=engine)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_aircraft_may_begin_on_their_feet(vehicle):
    deck = {"solids": lambda self: [Box("deck", length=4.0, width=4.0, height=0.2)]}
    environment = Environment(type("OnDeck", (Hover,), deck)(), vehicle=vehicle, seed=0)
    height = 0.1 - environment.vehicle.foot[2]
    still = dict.fromkeys(("velocity", "body_rate"), [0.0, 0.0, 0.0])
    environment.reset(start={"position": [0, 0, height], "quaternion": [1, 0, 0, 0]} | still)
    environment.step(np.full((1, environment.action_size), -0.1))
    assert environment.snapshot.landed.all()
    np.testing.assert_allclose(environment.snapshot.state.position, [[0, 0, height]], atol=0.01)


def gate_at(time, ahead=0.0, turn=0.0, **others):
    """A gate that drifts and turns, or is elsewhere."""
    level = np.stack([4.0 + 0.5 * time + ahead, 0 * time, 0 * time], axis=-1)
    return {"gate": dataclasses.replace(Pose(level, heading(0.2 * time + turn)), **others)}


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize(
    ("then", "said"),
    [
        (lambda time: None, "^move"),
        (lambda time: gate_at(time, position=None), "^position of gate"),
        (lambda time: gate_at(time, quaternion=np.zeros((2, 4))), "^quaternion of gate"),
        # By 5 m in 10 ms, and by a radian.
        (lambda time: gate_at(time, 5.0), r"^speed \[m/s\] of gate .* \[500.5, .* 100 and 0.5"),
        (lambda time: gate_at(time, turn=1.0), r"of gate in `move`, and turn \[rad\] .* 1.002"),
    ],
    ids=["None", "no place", "zeros", "jumps", "turns"],
)
def test_a_move_that_no_solid_makes_is_refused_and_changes_nothing(then, said, engine):
    """It goes wrong at 0.12 s, in the second physics step of the third control step."""
    own = {
        "solids": lambda self: [Sphere("ball", position=(0.0, 5.0, 0.0)), Gate("gate")],
        "move": lambda self, state, time: gate_at(time) if time[0] < 0.115 else then(time),
    }
    environment = begun(type("Lost", (Hover,), own)(), num_envs=2, engine=engine)
    for _ in range(2):
        environment.step(np.zeros((2, 4)))
    saved = environment.save()
    with refused(match=said):
        environment.step(np.ones((2, 4)))
    unchanged(environment, saved)


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize(
    ("own", "said"),
    [
        ({"solids": lambda self: None}, "^solids"),
        ({"place": lambda self, rng, start, state: None}, "^place"),
        ({"place": lambda self, *_: {"gate": Pose(None)}}, "^position of gate"),
    ],
)
def test_a_task_that_forgets_to_return_is_refused_by_name(own, said, engine):
    gate = {"solids": lambda self: [Gate("gate", position=(4.0, 0.0, 0.0))]}
    with refused(match=said):
        begun(type("Forgets", (Hover,), gate | own)(), engine=engine)


def test_sizes_come_from_the_seed_of_the_row_and_stay_with_a_saved_state():
    batch = begun(Sized(), num_envs=4, seed=7)
    table, saved = batch.engine.solids.table.copy(), batch.save()
    assert len({*table["size"][:, 0, 0]}) == 4
    for row in range(4):
        alone = begun(Sized(), seed=7 + row)
        np.testing.assert_array_equal(alone.engine.solids.table[0], table[row])
    other = Environment(Sized(), num_envs=4, seed=99)
    other.restore(saved)
    np.testing.assert_array_equal(other.engine.solids.table, table)


def test_a_task_without_solids_says_so_when_one_is_asked_for():
    environment = begun("hover")
    with refused(match="declares no solids"):
        environment.snapshot.clearance  # noqa: B018 - it is a property


MOVES = {  # a deck's place [m] and heading [rad] at a time [s]
    "sways": lambda t: ((0.4 * np.sin(1.2 * t), 0.3 * np.cos(1.2 * t), 0.2 * np.cos(3.0 * t)), 0.0),
    "turns": lambda t: ((0.0, 0.0, 0.0), 0.5 * t),
}
DECK = Scene([Box("deck", length=4.0, width=4.0, height=0.2)])


def carried(path, count=1, engine="mujoco", place=(0.0, 0.0), drop=0.0, time=3.0, still=False):
    """Aircraft (T, n, 3) [m] on a deck, rotors off, as seen from it, and the engine at the end.

    Where it stands still, it is the deck's frame: gravity and wind are those in it.
    """
    model = compile_model(PAPER, drawn=False, scene=DECK.add_to)
    made, step = make(engine, PAPER, model, count, altitude=3.0), PAPER.physics_timestep

    def poses(t):
        place, turn = path(0.0 if still else t)
        pose = Pose(np.tile(place, (count, 1)), heading(np.full(count, turn)))
        return DECK.poses({"deck": pose}, count, made.origin)

    def velocity(t):
        return (np.array(path(t + step)[0]) - path(t)[0]) / step

    rest, height = np.zeros((count, 3)), 0.1 - PAPER.foot[2] + drop
    start = Start(
        position=rest + path(0.0)[0] + (*place, height),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        velocity=rest + (0.0 if still else velocity(0.0)),
        body_rate=rest,
        rotor_speed=np.zeros((count, PAPER.rotor_count)),
    )
    made.place(np.arange(count), start, solids=poses(0.0))
    made.ctrl[:], track, gravity = 0.0, [], made.model.opt.gravity.copy()
    for k in range(round(time / step)):
        t = k * step
        if still:
            made.wind[:] = -velocity(t)
            made.model.opt.gravity[:] = gravity - (velocity(t) - velocity(t - step)) / step
        made.solids.move(poses(t + step), step)
        made.advance(1)
        made.read()
        track.append(made.state.position - path(0.0 if still else t + step)[0])
    return np.array(track), made


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_a_deck_that_moves_carries_an_aircraft_as_its_own_frame_would(engine):
    frame, _ = carried(MOVES["sways"], still=True)
    track, _ = carried(MOVES["sways"], count=2, engine=engine)
    # A deck stands still within a physics step, in which it moves by 5 mm.
    np.testing.assert_allclose(track, np.tile(frame, (1, 2, 1)), rtol=0, atol=2.5e-3)
    assert abs(track - frame)[..., 2].max() < 7e-4


def test_a_deck_that_turns_takes_an_aircraft_around():
    track, made = carried(MOVES["turns"], place=(0.5, 0.0))
    radius = np.linalg.norm(track[:, 0, :2], axis=-1)
    np.testing.assert_allclose(radius, 0.5, atol=0.01)
    turned = np.arctan2(track[-1, 0, 1], track[-1, 0, 0])
    assert turned == pytest.approx(1.5, abs=0.03)
    matrix = rotation_matrix(made.qpos[:, 3:])[0]
    assert np.arctan2(matrix[1, 0], matrix[0, 0]) == pytest.approx(1.5, abs=0.03)


def test_solids_stay_where_they_have_arrived():
    _, made = carried(MOVES["sways"], time=0.2)
    there = made.solids.poses.copy()
    made.advance(3)
    np.testing.assert_array_equal(made.solids.table["position"], there[..., :3])


@pytest.mark.parametrize("sink", [-0.5, 0.0, 0.5])
def test_a_touch_of_what_moves_counts_from_it(sink):
    """An aircraft falls 2 cm, from the speed of a deck that sinks or rises."""
    _, made = carried(lambda t: ((0.3 * t, 0.0, -sink * t), 0.0), drop=0.02, time=0.3)
    landed, into, along, *_ = made.feet[0]
    assert landed == 1 and into == pytest.approx(np.sqrt(2 * 9.81 * 0.02), abs=0.06)
    assert along < 0.02 and made.hits[0, 1] == pytest.approx(into, abs=0.02)


# ---------------------------------------------------------------------------- how hard contacts are

THIN = Scene([Box("wall", length=0.02, width=4.0, height=4.0)])


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize("name", VEHICLES)
def test_a_fall_of_30_cm_does_not_sink_in(name, engine):
    vehicle = VEHICLES[name]
    made = make(engine, vehicle, compile_model(vehicle, contact=True, drawn=False), 2, altitude=0.0)
    rest = np.zeros((2, 3))
    start = Start(
        position=rest + (0.0, 0.0, 0.3 - vehicle.foot[2]),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        velocity=rest,
        body_rate=rest,
        rotor_speed=np.zeros((2, vehicle.rotor_count)),
    )
    made.place(np.arange(2), start)
    made.ctrl[:], lowest = 0.0, np.inf
    for _ in range(round(1.0 / vehicle.physics_timestep)):
        made.advance(1)
        made.read()
        lowest = min(lowest, made.state.position[:, 2].min() + vehicle.foot[2])
    assert -4e-3 < lowest and (vehicle.mass > 0.1 or -3e-3 < lowest)
    assert abs(made.state.position[:, 2] + vehicle.foot[2]).max() < 2e-4
    assert made.state.speed.max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize("name", VEHICLES)
def test_nobody_passes_or_sticks_in_a_thin_wall(name, engine):
    vehicle, count = VEHICLES[name], 32
    velocity = np.repeat([[12.0, 0.0, 0.0], [24.0, 0.0, 0.0]], count // 2, axis=0)
    # Each meets it elsewhere within a physics step.
    ahead = 0.5 + velocity[:, 0] * vehicle.physics_timestep * np.arange(count) / 8
    poses = {"wall": Pose(np.stack([ahead, *np.zeros((2, count))], axis=-1))}
    steps = round(0.6 / vehicle.physics_timestep / 10)
    _, track, hits = flown(THIN, poses, velocity, steps, engine, vehicle)
    assert hits[:, 0].all() and (hits[:, 1] > 0.5 * velocity[:, 0]).all()
    assert (track[..., 0] < ahead).all() and (track[-1, :, 0] < ahead - 0.03).all()


# ------------------------------------------------------------------------- faster than a step


def struck(engine, vehicle, solid, path, start, time, **motion):
    """Hits (T, n) [m/s] of aircraft in each step, 0 for none, and the engine at the end.

    `path` gives the pose of the solid at a time [s].
    """
    scene, count, step = Scene([solid]), len(start), vehicle.physics_timestep
    model = compile_model(vehicle, drawn=False, scene=scene.add_to)
    made = make(engine, vehicle, model, count, altitude=30.0)
    zero, level = np.zeros((count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    hover = np.tile(vehicle.hover_speed, (count, 1))
    state = {"quaternion": level, "velocity": zero, "body_rate": zero} | motion

    def poses(t):
        return scene.poses({solid.name: path(t)}, count, made.origin)

    placed = Start(position=start, rotor_speed=hover, **state)
    made.place(np.arange(count), placed, solids=poses(0.0))
    made.ctrl[:], hits = hover, []
    for k in range(round(time / step)):
        made.hits[:] = 0.0
        if path(1.0) is not path(0.0):
            made.solids.move(poses((k + 1) * step), step)
        made.advance(1)
        hits.append(np.where(made.hits[:, 0] > 0, made.hits[:, 1], 0.0))
        made.read()
    return np.array(hits), made


WALL = Box("wall", length=0.02, width=8.0, height=8.0)


@pytest.mark.parametrize("speed", [(24.0, 0.0), (0.0, 24.0), (24.0, 24.0), (0.0, 90.0)])
@pytest.mark.parametrize("name", VEHICLES)
def test_no_thin_wall_is_passed_untouched(name, speed):
    """At any attitude, from any part of a step before a wall of 2 cm, which may come, too."""
    vehicle, rng, count = VEHICLES[name], np.random.default_rng(0), 24
    flies, comes = speed
    turn = rng.normal(size=(count, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    begins = 1.0 + rng.uniform(0, 1, count) * sum(speed) * vehicle.physics_timestep
    still = Pose(np.stack([begins, 0 * begins, 0 * begins], axis=-1))

    def path(t):
        return still if comes == 0 else Pose(still.position - [comes * t, 0.0, 0.0])

    flown = {"quaternion": turn, "velocity": np.tile([flies, 0.0, 0.0], (count, 1))}
    time = 3.0 / sum(speed)
    hits, _ = struck("free_flight", vehicle, WALL, path, np.zeros((count, 3)), time, **flown)
    # The drag takes up to a sixth of the speed; who tumbles after a touch may touch again, faster.
    fastest = hits.max(axis=0)
    assert (fastest > 0.8 * sum(speed)).all() and np.median(fastest) < 1.05 * sum(speed)


@pytest.mark.slow
@pytest.mark.parametrize("name", VEHICLES)
def test_a_thin_wall_stops_an_aircraft_at_any_attitude(name):
    """As fast as the page of own tasks says."""
    vehicle, rng, count, speed = VEHICLES[name], np.random.default_rng(2), 48, 14.0
    turn = rng.normal(size=(count, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    begins = 1.0 + rng.uniform(0, 1, count) * speed * vehicle.physics_timestep
    still = Pose(np.stack([begins, 0 * begins, 0 * begins], axis=-1))
    flown = {"quaternion": turn, "velocity": np.tile([speed, 0.0, 0.0], (count, 1))}
    origin = np.zeros((count, 3))
    hits, made = struck("free_flight", vehicle, WALL, lambda t: still, origin, 0.5, **flown)
    assert (hits.max(axis=0) > 0).all()
    assert (made.state.position[:, 0] < begins - 0.01).all()


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_a_pass_that_no_contact_shows_is_noted_once(engine):
    """At 100 m/s, feet first: 50 cm in a physics step of a Crazyflie, which is 3 cm high."""
    vehicle, count = VEHICLES["crazyflie"], 40
    start = np.zeros((count, 3))
    start[:, 0] = np.linspace(-1.0, -0.5, count)
    thin = Box("wall", length=1e-3, width=8.0, height=8.0)
    pose = Pose(np.zeros((count, 3)))
    down = np.tile([np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0], (count, 1))  # the body's z to the west
    velocity = np.tile([100.0, 0.0, 0.0], (count, 1))
    flown = {"quaternion": down, "velocity": velocity}
    hits, made = struck(engine, vehicle, thin, lambda t: pose, start, 0.02, **flown)
    passed = made.qvel[:, 0] > 60.0  # the rest is drag
    assert passed.sum() >= count / 3
    # Between two steps the wall may be half-way through an aircraft.
    assert ((hits > 0).sum(axis=0)[passed] == 1).mean() > 0.9
    assert (hits.max(axis=0) > 60.0).all()


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_who_leaves_a_wall_or_flies_beside_it_has_not_touched_it(engine):
    """One begins 1 cm behind the wall and flies off, one along it, and one ahead of it as it comes.

    Within a quarter of a step of 10 ms that wall stands 8 cm farther, at its half-way pose.
    """
    room = 0.29 + 0.02
    start = 1.0 + np.array([[room, 0.0, 0.0], [room + 0.13, 0.0, 0.0], [-room, -3.0, 0.0]])
    velocity = np.array([[60.0, 0.0, 0.0], [64.0, 0.0, 0.0], [0.0, 60.0, 0.0]])
    comes = np.array([[0.0, 0.0, 0.0], [60.0, 0.0, 0.0], [0.0, 0.0, 0.0]])

    def path(t):
        return Pose(np.tile([1.0, 0.0, 0.0], (3, 1)) + comes * t)

    hits, made = struck(engine, PAPER, WALL, path, start, 0.05, velocity=velocity)
    assert (hits == 0).all() and (made.clearance() > 0).all()


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize("name", VEHICLES)
def test_a_bar_that_turns_by_half_a_radian_a_step_sweeps_up_who_hovers(name, engine):
    vehicle, count = VEHICLES[name], 60
    rate = 0.49 / vehicle.physics_timestep
    begins = np.linspace(0.0, 1.0, count)

    def path(t):
        return Pose(np.zeros((count, 3)), heading(begins + rate * t))

    bar = Box("bar", length=4.0, width=0.02, height=0.5)
    start = np.tile([-0.9, -1.2, 0.0], (count, 1))  # where half a turn passes
    hits, _ = struck(engine, vehicle, bar, path, start, np.pi / rate)
    # The bar is 1.5 m from its axis there; what it has thrown may meet it again.
    assert (hits.max(axis=0) > 0.7 * 1.5 * rate).all()


# ------------------------------------------------------------------------- what nobody sees at once


def test_a_list_of_the_nearest_holds_only_as_far_as_none_else_can_be_nearer():
    """Eight balls stand 1 m to the west and a ninth 2.5 m to the east, to which it flies by 1 m.

    The nearest listed one is then 2 m away, and the one that is not listed 1.5 m.
    """
    scene = Scene([Sphere(f"ball_{k}", radius=0.01) for k in range(9)])
    height = 0.05 * np.arange(8)
    west = -np.sqrt(1.01**2 - height**2)
    places = [(x, 0.0, z) for x, z in zip(west, height, strict=True)] + [(2.51, 0.0, 0.0)]
    poses = {f"ball_{k}": Pose(np.array([place])) for k, place in enumerate(places)}
    made, *_ = flown(scene, poses, np.zeros((1, 3)), steps=0)
    made.qpos[0, 0] += 1.0
    # The rotor ahead: its hub 0.23 m away and 3 cm higher, in a ball about its disc.
    free = np.hypot(1.51 - 0.23, 0.03) - np.hypot(0.06, 0.005) - 0.01
    assert made.clearance()[0] == pytest.approx(free, abs=1e-9)


def test_only_the_inner_half_of_the_hull_must_be_free_at_a_start():
    """Over a ball of 20 cm; the hull of the paper's aircraft is 4.5 cm deep below its middle."""
    declared = {"solids": lambda self: [Sphere("ball", position=(0.0, 9.0, 0.0))]}
    environment = begun(type("OverBall", (Hover,), declared)())
    level = {"quaternion": [1.0, 0.0, 0.0, 0.0]}
    environment.reset(start=level | {"position": [0.0, 9.0, 0.2226]})
    with refused("position at the start"):
        environment.reset(start=level | {"position": [0.0, 9.0, 0.2224]})


def test_what_a_snapshot_has_of_moving_solids_stays_as_it_was():
    moves = {
        "solids": lambda self: [Gate("gate")],
        "move": lambda self, state, time: gate_at(time),
    }
    environment = begun(type("Leaving", (Hover,), moves)(), num_envs=2)
    environment.step(np.zeros((2, 4)))
    world = environment.snapshot.world
    place = world.position.copy()
    environment.step(np.zeros((2, 4)))
    np.testing.assert_array_equal(world.position, place)
    assert (environment.snapshot.world.position != place).any()


@pytest.mark.parametrize("other_sign", [1.0, -1.0])
def test_a_solid_turns_rigidly_the_short_way_around(other_sign):
    """By 0.48 rad in a step of 10 ms; a quaternion and its negative are the same attitude."""
    scene, step = Scene([Box("wall", length=2.0, width=1.0, height=1.0)]), 0.01
    made, *_ = flown(scene, {}, np.zeros((1, 3)), steps=0)
    for k in (1, 2):
        turn = other_sign**k * heading(np.array([0.48 * k]))
        pose = {"wall": Pose(np.zeros((1, 3)), turn)}
        made.solids.move(scene.poses(pose, 1, made.origin, made.solids.poses), step)
        half = rotation_matrix(heading(np.array([0.48 * (k - 0.5)])))[0]
        np.testing.assert_allclose(made.solids.table["turn"][0, 0].reshape(3, 3), half, atol=1e-12)
    # The rate is that of the sine of half the angle.
    np.testing.assert_allclose(made.solids.motion[0, 0, 3:], [0, 0, 2 * np.sin(0.24) / step])


def test_a_deck_that_turns_fast_holds_an_aircraft_at_its_distance():
    """At 2 rad/s, 0.5 m from the axis: 2 m/s^2 towards it, a fifth of what friction can give."""
    track, _ = carried(lambda t: ((0.0, 0.0, 0.0), 2.0 * t), place=(0.5, 0.0), time=2.0)
    radius = np.linalg.norm(track[:, 0, :2], axis=-1)
    np.testing.assert_allclose(radius[100:], radius[100], atol=1e-3)


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
@pytest.mark.parametrize("grip", [0.9, 1.2])
def test_a_grip_is_a_multiple_of_the_weight_of_the_whole_aircraft(grip, engine):
    """Under a ceiling, feet up: what grips with less than its weight lets it fall."""
    scene = Scene([Box("ceiling", length=4.0, width=4.0, height=0.2, grip=grip)])
    made = make(engine, PAPER, compile_model(PAPER, drawn=False, scene=scene.add_to), 1, altitude=9)
    none, over = np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0, 0.0]])
    start = Start(none, over, none, none, np.zeros((1, PAPER.rotor_count)))
    up = {"ceiling": Pose(np.array([[0.0, 0.0, 0.1 - PAPER.foot[2] - 1e-4]]))}
    made.place(np.array([0]), start, solids=scene.poses(up, 1, made.origin))
    made.ctrl[:] = 0.0
    made.advance(50)
    made.read()
    assert made.feet[0, 0] == 1
    fall = -made.state.position[0, 2]
    assert fall < 0.005 if grip > 1 else fall > 0.1
