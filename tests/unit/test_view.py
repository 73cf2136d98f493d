"""`quadrl view`: the flight that goes on, its page without a browser, and what is refused."""

import contextlib
import io
import math
import socket
import sys
import urllib.request

import mujoco
import numpy as np
import pytest
import scipy.spatial
from scipy.spatial.transform import Rotation

from quadrl import cli, tasks
from quadrl.aircraft.specification import resolve
from quadrl.base.primitives import Mesh, Primitive
from quadrl.core.markers import Marker
from quadrl.core.scenario import Scenario
from quadrl.engines import mjcf
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.policy import Policy
from quadrl.rendering.live import readout
from quadrl.rendering.live.flight import Flight, Keyboard
from quadrl.rendering.live.view import others

VEHICLE = resolve(None)
STEP = VEHICLE.control_timestep


def hover(count=1, vehicle=VEHICLE, **options):
    task = tasks.make("hover", **options)
    controller = make_controller("geometric", task, vehicle)
    return Flight(controller, Scenario.of(task, vehicle=vehicle), num_envs=count)


@pytest.fixture
def page():
    """A page of two aircraft, served to nobody."""
    browser = pytest.importorskip("quadrl.rendering.live.browser", exc_type=ModuleNotFoundError)
    flight = hover(2)
    geometric = flight.controller
    choices = {"geometric": lambda: geometric, "policy": lambda: Policy.pretrained("hover")}
    choices["of another task"] = lambda: Policy.pretrained("target_following")
    with contextlib.closing(browser.Page(flight, choices, port=0)) as page:
        yield page


def test_time_passes_as_fast_as_it_is_told_to():
    flight = hover()
    assert flight.advance(0.5 * STEP) == 1  # the first is due at once
    assert flight.advance(0.5 * STEP) == 1
    flight.speed = 4.0
    assert flight.advance(0.5 * STEP) == 2
    flight.paused = True
    assert flight.advance(1.0) == 0
    flight.paused = False
    assert flight.advance(60.0) <= 1 + 0.25 / STEP  # nobody waits for what was missed


def test_between_two_steps_the_aircraft_is_drawn_between_their_poses():
    flight = hover(2)
    flight.push(np.array([1.0, 0.0, 0.0]), 0)
    flight.advance(0.0)
    before = flight.pose.copy()
    flight.advance(1.25 * STEP)
    flight._before[:, 3:7] *= -1  # the same attitude
    drawn = flight.drawn()
    expected = 0.75 * before[:, :3] + 0.25 * flight.pose[:, :3]
    np.testing.assert_allclose(drawn[:, :3], expected, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(drawn[:, 3:7], axis=1), 1.0)
    assert (np.abs((drawn[:, 3:7] * flight.pose[:, 3:7]).sum(1)) > 0.99).all()
    spins = np.sign([rotor.spin for rotor in VEHICLE.rotors])
    np.testing.assert_array_equal(np.sign(flight.pose[0, 7:]), spins)  # the blades turn


def test_an_episode_that_ends_begins_anew_without_a_jump_in_the_picture():
    flight = hover(2, time_limit=3 * STEP, settle_time=STEP)
    flight.wind[:] = (6.0, 0.0, 0.0)
    for _ in range(3):
        flight.step()
    assert flight.episodes == 2
    np.testing.assert_array_equal(flight.time, 0.0)
    np.testing.assert_array_equal(flight.drawn()[:, :3], flight.pose[:, :3])
    assert np.isnan(flight.trail).all()
    flight.endless = True
    for _ in range(5):
        flight.step()
    assert flight.episodes == 2
    assert np.isfinite(flight.trail[-5:]).all()
    np.testing.assert_array_equal(flight.environment.engine.wind, [[6.0, 0.0, 0.0]] * 2)


def test_keys_fly_velocities():
    flight, keyboard = hover(2), Keyboard()
    flight.fly_with(keyboard)
    assert flight.environment.control_mode.name == "velocity"
    flight.endless = True
    for _ in range(3):
        keyboard.press("I")
    for _ in range(40):
        flight.step()
    velocity = flight.environment.engine.qvel[:, :3]
    wanted = 0.75 * flight.environment.control_mode.scale[0]
    np.testing.assert_allclose(np.linalg.norm(velocity, axis=1), wanted, rtol=0.1)
    for _ in range(9):
        keyboard.press("K")
    np.testing.assert_array_equal(keyboard.action, [-1.0, 0.0, 0.0, 0.0])
    keyboard.press("X")
    np.testing.assert_array_equal(keyboard.action, 0.0)


@pytest.mark.parametrize("vehicle", ["paper", "hexa"])
def test_meshes_are_those_of_the_model(vehicle):
    trimesh = pytest.importorskip("trimesh")
    from quadrl.rendering.live import meshes

    def wall(spec):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.1, 2, 1), pos=(3, 0, 1))

    def corners(glb):
        return trimesh.load_scene(io.BytesIO(glb), file_type="glb").to_mesh().vertices

    model = mjcf.compile_model(resolve(vehicle), scene=wall)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    seen = meshes.of_model(model)
    points = [corners(seen.solid), *(mesh.vertices for mesh, _ in seen.clear)]
    for blades, (place, attitude) in zip(seen.blades, seen.hubs, strict=True):
        points.append(place + attitude.apply(corners(blades)))
    drawn = scipy.spatial.KDTree(np.concatenate(points))
    checked = 0
    for geom in range(model.ngeom):
        is_mesh = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
        if not is_mesh or not model.geom_bodyid[geom]:  # what is painted on the ground
            continue
        mesh = model.mesh(model.geom_dataid[geom])
        vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
        axes = data.geom_xmat[geom].reshape(3, 3)
        where = data.geom_xpos[geom] + vertices @ axes.T - data.body("aircraft").xpos
        assert drawn.query(where)[0].max() < 1e-6, model.geom(geom).name
        checked += 1
    assert [rgba[3] < 1 for _, rgba in seen.clear] == [True] * 3  # the discs: front, side, back
    assert checked > 4 * model.nu  # arm, sleeve, two blades and rim of each rotor
    ends = [getattr(corners(seen.world), end)(0) for end in ("min", "max")]
    np.testing.assert_allclose(ends, [[2.9, -2, 0], [3.1, 2, 2]], rtol=1e-6)
    assert meshes.of_model(mjcf.compile_model(resolve(vehicle))).world is None


def test_controls_act_on_the_flight(page):
    engine = page.flight.environment.engine
    page.wind[1].value = 4.0
    page.frame(STEP)
    np.testing.assert_array_equal(engine.wind, [[0.0, 4.0, 0.0]] * 2)
    page.speed.value, page.endless.value = 2.0, True
    steps = page.flight.time[0] / STEP
    page.frame(STEP)
    assert page.flight.time[0] / STEP == pytest.approx(steps + 2)
    page.paused.value = True
    was, place = page.flight.time.copy(), engine.qvel[:, 0].copy()
    page.strength.value, page.aircraft.value = 3.0, 2
    page.push("east")
    page.frame(STEP)
    np.testing.assert_allclose(engine.qvel[:, 0] - place, [0.0, 3.0])
    np.testing.assert_array_equal(page.flight.time, was)
    page.flight.error[:] = (0.1, 0.25)
    assert "10 cm" in readout.html(page.flight, 0) and "25 cm" in readout.html(page.flight, 1)
    assert readout.html(page.flight, 0).count("background:rgb(") == VEHICLE.rotor_count


def test_what_flies_can_be_changed_for_what_fits(page):
    for chosen in ("policy", "of another task"):  # which changes nothing
        page.flown_by.value = chosen
        page.frame(STEP)
        assert page.flown_by.value == "policy" and page.flight.controller.task == "hover"
    page.flown_by.value = "keyboard"
    for _ in range(2):
        page.frame(STEP)
    assert page.flight.controller is page.keyboard


@pytest.mark.parametrize("scale", [None, 90.0])
def test_what_is_offered_commands_what_it_did_in_its_training(scale):
    task, vehicle = tasks.make("hover"), resolve(None, {"action_scale": scale} if scale else {})
    scenario = Scenario.of(task, vehicle=vehicle)
    offered = {name: make() for name, make in others(scenario).items()}
    assert ("hover_ppo" in offered) == (scale is None)
    flight = Flight(offered["geometric"], scenario)
    for controller in offered.values():
        flight.fly_with(controller)
        flight.step()
        if isinstance(controller, Policy):
            assert controller.task == "hover"
            assert controller.scenario.aircraft.action_scale == vehicle.action_scale


def test_aircraft_and_trails_are_drawn_apart_and_where_they_are(page):
    node, trails = page.scene._airframe, page.scene._trails
    begun = len(trails.points)
    page.push("east")
    for _ in range(8):
        page.frame(STEP)
    drawn = page.flight.drawn()
    apart = node.batched_positions - drawn[:, :3]
    np.testing.assert_allclose(np.abs(apart[0] - apart[1]), [page.apart.value, 0, 0], atol=1e-5)
    np.testing.assert_allclose(node.batched_wxyzs, drawn[:, 3:7], atol=1e-6)
    assert len(trails.points) == begun  # viser's client draws no more than there were at first
    places = page.flight.pose[:, :3] + page.scene.offsets(page.apart.value)
    np.testing.assert_allclose(trails.points[-2:, 1], places, atol=1e-5)
    lengths = np.linalg.norm(trails.points[:, 1] - trails.points[:, 0], axis=1).reshape(-1, 2)
    assert (lengths[-3:] > 0).all() and lengths[0].max() == 0
    page.apart.value = 0.0
    page.frame(0.0)
    np.testing.assert_allclose(node.batched_positions, page.flight.drawn()[:, :3], atol=1e-6)


@pytest.mark.parametrize("camera", ["follow", "chase"])
def test_the_camera_stays_with_its_aircraft(page, camera):
    page.camera.value, page.aircraft.value = camera, 2
    page.frame(STEP)
    world, place = page.scene._world, page.scene._airframe.batched_positions[1]
    turn = Rotation.from_quat(world.wxyz, scalar_first=True)
    home = page.flight.environment.origin
    if camera == "follow":  # it looks between the aircraft and its goal
        place = place + (page.flight.environment.goals()[1] - page.flight.pose[1, :3]) / 2
    np.testing.assert_allclose(world.position + turn.apply(place), home, atol=1e-5)
    ahead = Rotation.from_quat(page.flight.drawn()[1, 3:7], scalar_first=True).apply((1, 0, 0))
    seen = turn.apply(ahead)
    if camera == "chase":  # the nose points away from the camera
        assert seen[1] == pytest.approx(0.0, abs=1e-6) and seen[0] > 0


@pytest.mark.parametrize("away", [0.0, 0.5, 3.0, 30.0])
def test_the_camera_that_follows_keeps_the_goal_off_the_panel(page, monkeypatch, away):
    """The panel takes the right 320 of 1366 pixels; a goal far away may lie behind it."""
    stand = np.array((-1.2, -1.7, 0.9))  # of the camera, so that this is to its right:
    right = np.cross(-stand, (0.0, 0.0, 1.0)) / np.hypot(*stand[:2])
    way = away * right
    monkeypatch.setattr(page.flight.environment, "goals", lambda: page.flight.pose[:, :3] + way)
    page.camera.value = "follow"
    page.frame(0.0)
    world, camera = page.scene._world, page.scene._server.initial_camera
    place = page.scene._airframe.batched_positions[page.row]
    ahead = np.subtract(camera.look_at, camera.position)
    edge = math.tan(camera.fov / 2) * 1366 / 768 * (1 - 2 * 320 / 1366)
    for seen in (place, place + way) if away < 30 else (place,):
        seen = seen + world.position - camera.position
        depth = seen @ ahead / np.linalg.norm(ahead)
        assert depth > 0 and abs(seen @ right) / depth < edge


def test_every_marker_and_primitive_is_drawn(page, monkeypatch):
    shapes = [Primitive(shape) for shape in ("sphere", "ellipsoid", "box", "cylinder", "capsule")]
    lit = Primitive("box", (1.0, 2.0, 3.0), (0, 0, 5), glow=0.0)
    mesh = Mesh("roof", np.eye(3), np.array([[0, 1, 2]]))
    shown = [
        *(*shapes, lit, Primitive("mesh", mesh=mesh)),
        Marker("sphere", (1, 0, 1), 0.2, label="1"),
        Marker("ring", (0, 0, 1), 0.5, end=(1, 0, 1)),
        Marker("pad", (3, 0, 2), 0.4),
        Marker("arrow", (0, 0, 1), 0.01, end=(0, 0, 3)),
        Marker("path", points=[(0, 0, 7), (0, 1, 7), (0, 2, 7)]),
    ]
    monkeypatch.setattr(Flight, "markers", lambda flight, row: () if row else shown)
    page.apart.value = 0.0
    page.frame(STEP)
    batches = page.scene._batches
    kinds = "glowing_sphere ellipsoid box cylinder arrow lit_box roof capsule".split()
    assert len(batches) == 8 and all(any(kind in name for name in batches) for kind in kinds)
    np.testing.assert_array_equal(batches["lit_box"].batched_scales, [[1, 2, 3]])
    np.testing.assert_array_equal(batches["glowing_sphere"].batched_positions[1], [1, 0, 1])
    np.testing.assert_allclose(batches["glowing_arrow"].batched_scales[0], [0.02, 0.02, 2])
    np.testing.assert_allclose(batches["glowing_cylinder"].batched_positions[1], [3, 0, 0])
    points = page.scene._marks.points
    ring = points[np.isclose(np.linalg.norm(points - (0, 0, 1), axis=2), 0.5).all(1)]
    assert len(ring) == 48
    np.testing.assert_allclose(ring[..., 0], 0, atol=1e-6)  # it faces east
    assert (points[..., 2] == 7).all(1).sum() == 2
    assert [text for text, _ in page.scene._labelled] == ["1"]
    page.show_markers.value = False
    page.frame(STEP)
    assert not page.scene._batches and not len(page.scene._marks.points)


def test_what_cannot_be_shown_is_said_in_one_line(capsys, monkeypatch):
    pytest.importorskip("viser")

    def said(*words):
        with pytest.raises(SystemExit, match="2"):
            cli.main(["view", "hover", *words])
        text = capsys.readouterr().err
        assert text.count("\n") == 1
        return text

    with socket.socket() as taken:
        taken.bind(("localhost", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        assert port in said("--port", port)
    if sys.platform == "linux":  # other systems always have a screen
        for name in ("DISPLAY", "WAYLAND_DISPLAY"):
            monkeypatch.delenv(name, raising=False)
        assert "screen" in said("--native")
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.delitem(sys.modules, "quadrl.rendering.live.browser", raising=False)
    assert "quadrl view needs viser: python -m pip install 'quadrl[view]'" in said()


def test_the_command_serves_until_it_is_interrupted(capsys, monkeypatch):
    browser = pytest.importorskip("quadrl.rendering.live.browser", exc_type=ModuleNotFoundError)
    served = []

    def frame(page, seconds):
        with urllib.request.urlopen(page.address, timeout=10) as answer:
            served.append((page.address, answer.read()))
        raise KeyboardInterrupt

    monkeypatch.setattr(browser.Page, "frame", frame)
    cli.main("view --controller lqr --num-envs 3 --port 0".split())
    ((address, text),) = served
    assert b"<html" in text and address in capsys.readouterr().out
    with socket.socket() as probe:
        assert probe.connect_ex(("localhost", int(address.rpartition(":")[2]))) != 0
