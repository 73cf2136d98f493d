"""Pictures and videos: what is drawn is where it should be, and nothing is left half done."""

import contextlib
import ctypes
import dataclasses
import functools
import math
import os
import sys
import types
from pathlib import Path
from typing import get_args

import gymnasium as gym
import helpers
import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from PIL import Image, ImageFont
from scipy import ndimage
from scipy.spatial.transform import Rotation

from quadrl import rendering
from quadrl.aircraft.presets import VEHICLES
from quadrl.base.errors import RenderingUnavailable
from quadrl.base.primitives import Primitive
from quadrl.base.shield import shield_triton
from quadrl.core.markers import Kind, Marker
from quadrl.core.scenario import Scenario
from quadrl.core.trajectory import FAILURE, SUCCESS, TIME_OVER, outcome
from quadrl.engines import mjcf
from quadrl.rendering import (
    Renderer,
    drawing,
    gl,
    overlay,
    read_scenarios,
    render_trajectory,
    write_contact_sheet,
    write_video,
)
from quadrl.rendering.camera import eased, in_view, keeping, moving_camera, moving_views, smoothed
from quadrl.rendering.horizon import horizon
from quadrl.rendering.overlay import Panel
from quadrl.rendering.pictures import LiveFlight, Pictures

SIZE = 200  # [pixels], of square pictures
PER_METRE = SIZE / 2 / math.tan(math.radians(21)) / 4  # [pixels] 4 m away, the field of view 42 deg
POSE = np.array([0, 0, 3, 1, 0, 0, 0], float)
ELSEWHERE = np.array([0, 50, 3, 1, 0, 0, 0], float)  # out of the pictures that look for a shape
CAMERAS = ("follow", "fixed", "track", "chase", "onboard")
SMALL = dict(width=160, height=120)


@pytest.fixture(scope="module")
def model(cheap_pictures):
    """The paper's aircraft."""
    return mjcf.compile_model(VEHICLES["paper"])


@pytest.fixture(scope="module")
def renderer(model):
    with Renderer(model, SIZE, SIZE) as opened:
        yield opened


def yawed(angle):
    return np.array([0, 0, 3, math.cos(angle / 2), 0, 0, math.sin(angle / 2)])


def looking(lookat=(0, 0, 3), distance=4.0, elevation=0.0):
    """A camera that looks along +y: east is to the right, up is up."""
    camera = mujoco.MjvCamera()
    camera.type, camera.azimuth = mujoco.mjtCamera.mjCAMERA_FREE, 90.0
    camera.lookat, camera.distance, camera.elevation = lookat, distance, elevation
    return camera


def changed(a, b, by=12):
    """Which pixels differ visibly, (height, width); Mesa's threads round some of them anew."""
    return np.abs(a.astype(int) - b.astype(int)).max(-1) > by


def drawn(renderer, camera, **what):
    """Rows and columns of the pixels that something changes."""
    pictures = [renderer.frame(ELSEWHERE, camera=camera, **k) for k in ({}, what)]
    return np.nonzero(changed(*pictures))


def flight(states=4, **values):
    """Flight to the north-east, a metre east and a quarter of a turn to the left in each state."""
    k = np.arange(states)
    qpos = np.stack([yawed(math.pi / 2 * i) for i in k])
    qpos[:, 0], qpos[:, 1] = k, 2 * k
    values = dict(rotor_speed=np.outer(k, [100.0, 200.0, 300.0, 400.0]), goal=qpos[:, :3]) | values
    return rendering.Trajectory(
        time=0.05 * (k + 1),
        qpos=qpos,
        error=10.0 - k,
        reward=k + 1.0,
        control_timestep=0.05,
        max_rotor_speed=400.0,
        task="hover",
        **values,
    )


def test_every_camera_shows_which_way_the_aircraft_heads(renderer):
    assert renderer.cameras == CAMERAS
    for camera in CAMERAS:
        front, back, again = (renderer.frame(yawed(a), camera=camera) for a in (0, math.pi, 0))
        assert front.shape == (SIZE, SIZE, 3) and front.dtype == np.uint8
        assert front.std() > 10 and not changed(front, again).any(), camera
        assert changed(front, back).sum() > 20 or camera == "onboard", camera


def test_the_front_rotor_is_orange_and_the_rear_one_blue(renderer):
    camera = looking(distance=0.9)  # heads east: the front is to the right
    picture = renderer.frame(POSE, camera=camera).astype(int)
    aircraft = changed(picture, renderer.frame(ELSEWHERE, camera=camera))
    difference = picture[..., 0] - picture[..., 2]
    orange, blue = (np.nonzero(aircraft & (sign * difference > 60))[1] for sign in (1, -1))
    assert len(orange) > 20 and orange.mean() > SIZE / 2 + 25
    assert len(blue) > 20 and blue.mean() < SIZE / 2 - 25


LINE = dict(position=(-0.5, 0, 3), size=0.02, end=(0.5, 0, 3))
ROUND = dict(position=(0, 0, 3), size=0.4, end=(0, 1, 3))  # faces the camera


@pytest.mark.parametrize(
    ("kind", "half", "options"),  # half of the width [m]; a circle is thicker than its radius
    [("goal", 0.1, {}), ("sphere", 0.1, {}), ("ring", 0.41, ROUND), ("pad", 0.41, ROUND)]
    + [("line", 0.5, LINE), ("arrow", 0.5, LINE)]
    + [("box", 0.1, {}), ("cylinder", 0.1, {}), ("ellipsoid", 0.1, {}), ("capsule", 0.1, {})]
    + [("path", 0.5, dict(size=0.02, points=((-0.5, 0, 3), (0, 0, 3.2), (0.5, 0, 3))))],
)
def test_markers_are_where_they_should_be(renderer, kind, half, options):
    options = {"position": (0, 0, 3), "rgba": (1.0, 0.0, 0.0, 1.0)} | options
    red = (Marker if kind in get_args(Kind) else Primitive)(kind, **options)
    _, columns = drawn(renderer, looking(), markers=[red])
    assert len(columns) >= 10 and columns.mean() == pytest.approx(SIZE / 2, abs=4)
    assert np.ptp(columns) == pytest.approx(2 * half * PER_METRE, abs=6)


def test_a_goal_a_pad_on_the_ground_and_a_trail_are_where_they_should_be(renderer):
    rows, columns = drawn(renderer, looking(), goal=[0.5, 0, 3.3])
    # A radius of 0.08 m is 5.2 pixels; below hang the drop line and, further down, the ring.
    ball = rows < SIZE / 2 - 0.22 * PER_METRE
    assert columns[ball].mean() == pytest.approx(SIZE / 2 + 0.5 * PER_METRE - 0.5, abs=1)
    assert rows.min() == pytest.approx(SIZE / 2 - 0.38 * PER_METRE, abs=1.5)
    # Seen from 4 m above the ground; its circle adds 0.02 * 0.5 + 0.003 = 0.013 m to the radius.
    above = looking((0, 0, 0), elevation=-90.0)
    for extent in drawn(renderer, above, markers=[Marker("pad", (0, 0, 3), 0.5)]):
        assert np.ptp(extent) == pytest.approx(2 * 0.513 * PER_METRE, abs=2.5)
    path = np.stack([np.linspace(-0.5, 0.5, 30), np.zeros(30), np.full(30, 3.2)], -1)
    rows, columns = drawn(renderer, looking(), trail=path)
    assert columns.max() == pytest.approx(SIZE / 2 + 0.5 * PER_METRE, abs=2)
    np.testing.assert_allclose(rows, SIZE / 2 - 0.2 * PER_METRE, atol=2)


def test_a_trail_shows_the_speeds_of_the_whole_way():
    # From rest to the fastest, 4 m/s, of a flight that has come to 3 m/s: three quarters of it.
    points, speed = np.zeros((1000, 3)), np.linspace(0.0, 3.0, 1000)
    points[:, 0] = np.linspace(0.0, 1.0, 1000)
    trail = drawing.speed_trail(points, speed, 4.0, 1.0)
    assert len(trail.points) == drawing.SPEED_PIECES + 1
    np.testing.assert_array_equal(trail.points[[0, -1]], points[[0, -1]])
    np.testing.assert_array_equal(trail.rgba[0], drawing.SLOW)
    end = 0.25 * drawing.SLOW + 0.75 * drawing.FAST
    np.testing.assert_allclose(trail.rgba[-1], end)


@pytest.mark.parametrize("rotor", [0, 1])
def test_blades_turn_counter_clockwise_by_their_angle(renderer, rotor):
    """Seen from above, whichever way the rotor spins in flight."""
    x, y, _ = VEHICLES["paper"].rotors[rotor].position
    camera, angles = looking((x, y, 3), 0.25, -90.0), np.zeros(4)
    still = renderer.frame(POSE, camera=camera, rotor_angles=angles).astype(float)
    angles[rotor] = math.radians(40)
    turned = renderer.frame(POSE, camera=camera, rotor_angles=angles)
    disc = np.hypot(*(np.indices((SIZE, SIZE)) - SIZE / 2)) < 45
    errors = [
        np.abs(ndimage.rotate(still, degrees, reshape=False) - turned)[disc].mean()
        for degrees in (40, -40)
    ]
    assert errors[0] < 0.6 * errors[1]


def test_what_cannot_be_drawn_is_refused(model, renderer):
    with helpers.refused("camera", "sky", "one of follow, fixed, track, chase, onboard"):
        renderer.frame(POSE, camera="sky")
    with helpers.refused("width", 1922, lists="1920"):
        Renderer(model, 1922, 9)
    with helpers.refused("shapes to draw", 2001):
        renderer.frame(POSE, markers=[Marker("ring")] * 50)  # of 48 shapes each
    with helpers.refused("kind", "cube"):
        Marker("cube")
    with helpers.refused("end", None):
        Marker("line")


def test_follow_frames_spheres_rings_pads_and_paths():
    goal, north = np.zeros(3), np.array([0.0, 5.0, 2.0])
    ring, path = Marker("ring", (0, 5, 2), 0.5), Marker("path", points=((1, 2, 3), (4, 5, 6)))
    upright, pad = Marker("ring", (0, 5, 2), 0.5, end=(0, 9, 2)), Marker("pad", (0, 5, 2), 0.5)
    rest = [Marker("sphere", (7, 7, 7)), Marker("arrow", end=(9, 9, 9)), Primitive("box")]
    flat, across, ground = np.array([0.5, 0.5, 0]), np.array([0.5, 0, 0.5]), north * (1, 1, 0)
    expected = [goal, north - flat, north + flat, north - across, north + across]
    expected += [ground - flat, ground + flat, (1, 2, 3), (4, 5, 6), (7, 7, 7)]
    np.testing.assert_allclose(in_view(goal, [ring, upright, pad, path, *rest]), expected)


def test_chase_looks_where_the_aircraft_heads_and_does_not_jump():
    poses = np.stack([yawed(math.radians(a)) for a in (170, 179, 188, 197)])
    views = moving_views("chase", poses, poses[:, :3], [[Marker("sphere", (9, 9, 9))]] * 4)
    np.testing.assert_allclose(views[:, :3], poses[:, :3])  # the goal alone is in view
    np.testing.assert_allclose(views[:, 4:], [[a, -17] for a in (170, 179, 188, 197)])
    smooth = smoothed(views, 2.0)[:, 4]
    assert 0 < np.ptp(smooth) < 27 and np.all(np.diff(smooth) > 0)


@pytest.mark.parametrize("camera", ["follow", "chase"])
@pytest.mark.parametrize(
    ("heading", "goal"), [(0.0, (3, 0, 3)), (2.0, (-2, -2, 3)), (4.0, (0, 1, 0))]
)
def test_moving_cameras_keep_aircraft_and_goal_in_view(renderer, camera, heading, goal):
    pose, away = yawed(heading), POSE + np.array([0, 0, 90, 0, 0, 0, 0])
    seen = pose[None], np.array([goal], float), [()]
    view = moving_camera(moving_views(camera, *seen, aspect=renderer.aspect)[0])
    pictures = [renderer.frame(pose, camera=view, goal=g) for g in (goal, None)]
    assert not changed(renderer.frame(pose, camera=camera, goal=goal), pictures[0]).any()
    # A goal fades and a ring on the ground may hide it: its ball and its line cover some pixels.
    assert changed(*pictures).sum() > 8
    assert changed(pictures[1], renderer.frame(away, camera=view)).sum() > 30


@pytest.mark.parametrize("way", [(0, 0, -1.5), (0, 5, 0), (3, 0, 2)])
def test_a_camera_steps_back_for_an_aircraft_that_leaves_its_view_in_haste(renderer, way):
    pose, away = POSE + np.array([*way, 0, 0, 0, 0]), POSE + np.array([0, 0, 90, 0, 0, 0, 0])
    slow = moving_views("follow", POSE[None], POSE[None, :3], [()], aspect=renderer.aspect)
    size = 1.0, renderer.aspect
    quick = keeping(slow, pose[None, :3], *size)
    np.testing.assert_array_equal(keeping(slow, POSE[None, :3], *size), slow)
    shown = [
        changed(*(renderer.frame(p, camera=moving_camera(view[0])) for p in (pose, away))).sum()
        for view in (slow, quick)
    ]
    assert shown[0] == 0 and shown[1] > 4


def test_the_camera_of_a_flight_in_progress_lags():
    last = np.array([0.0, 0, 3, 2, 170, -17])
    view = np.array([1.0, 0, 3, 4, -170, -17])  # 20 deg on, not 340 deg back
    np.testing.assert_array_equal(eased(view, last, 0.0), last)
    np.testing.assert_allclose(eased(view, last, 100.0), [1, 0, 3, 4, 190, -17])
    half = eased(view, last, 0.3 * math.log(2))
    np.testing.assert_allclose(half, [0.5, 0, 3, 3, 180, -17])


def test_every_marker_can_have_a_label(renderer):
    place = {"line": dict(end=(0.5, 0, 3)), "path": dict(points=((0, 0, 3), (0.5, 0, 3)))}
    place |= {"arrow": place["line"], "pad": dict(end=(0, 0, 9))}  # at its position
    for kind in get_args(Kind):
        marker = functools.partial(Marker, kind, (0, 0, 3), 0.05, **place.get(kind, {}))
        shown = [[marker(label=label)] for label in ("", "7")]
        pictures = [renderer.frame(ELSEWHERE, camera=looking(), markers=m) for m in shown]
        assert 5 < changed(*pictures).sum() < 400, kind


def test_what_is_painted_on_the_ground(renderer):
    # From above, looking along +y: north is up in the picture, and orange.
    pixels = renderer.frame(ELSEWHERE, camera=looking((0, 0, 0), 5.0, -90.0)).astype(int)
    rows, columns = np.nonzero(pixels[..., 0] - pixels[..., 2] > 60)
    assert len(rows) > 20 and rows.max() <= SIZE / 2 + 1
    assert columns.mean() == pytest.approx(SIZE / 2, abs=5)
    lean = mjcf.compile_model(VEHICLES["paper"], drawn=False)
    assert (lean.nmesh, lean.ntex, lean.ngeom) == (0, 0, 0)


def test_resampled():
    # States at 0.05, 0.10, 0.15 and 0.20 s; 40 frames a second are two a state.
    goal = np.array([[0, 0, 3], [0.1, 0, 3], [1.1, 0, 3], [1.1, 0, 3]], float)
    markers = [(Marker("sphere", (float(k), 0, 3)),) for k in range(4)]
    twice = flight(goal=goal, markers=markers).resampled(40)
    half = np.arange(7) / 2  # states
    np.testing.assert_allclose(twice.time, 0.05 * (1 + half))
    np.testing.assert_allclose(twice.qpos[:, :2], half[:, None] * (1, 2), atol=1e-9)
    yaw = np.unwrap(2 * np.arctan2(twice.qpos[:, 6], twice.qpos[:, 3]))
    np.testing.assert_allclose(np.degrees(yaw), 90 * half, atol=1e-6)
    np.testing.assert_allclose(twice.rotor_speed[:, 3], 400 * half)
    np.testing.assert_allclose(twice.error, 10 - half)
    np.testing.assert_allclose(twice.reward, [1, 1, 2, 2, 3, 3, 4])  # shown until the next one
    # From 0 to 0.1 m the goal moves at 2 m/s; from 0.1 to 1.1 m, at 20 m/s, it jumps.
    np.testing.assert_allclose(twice.goal[:, 0], [0, 0.05, 0.1, 0.1, 1.1, 1.1, 1.1], atol=1e-9)
    np.testing.assert_allclose([m[0].position[0] for m in twice.markers], half, atol=1e-9)
    assert flight(markers=markers[2:3]).resampled(40).markers == markers[2:3]


def test_a_flight_is_drawn_as_it_was_flown(model, monkeypatch):
    asked = []
    monkeypatch.setattr(gl, "open_renderer", lambda *_: None)
    monkeypatch.setattr(gl, "close", lambda _: None)
    monkeypatch.setattr(Renderer, "frame", lambda *given, **options: asked.append(options))
    for states, fps in ((7, 20), (7, 10), (1, 20)):
        constant = flight(states, rotor_speed=np.full((states, 4), 31.4))
        list(render_trajectory(constant, model, **SMALL, fps=fps, overlay=False))
    assert len(asked) == 7 + 4 + 1
    view = looking()
    list(render_trajectory(flight(1), model, **SMALL, camera=view, overlay=False))
    assert asked.pop()["camera"] is view
    for k, one in enumerate(asked[:7]):  # 31.4 rad/s are a quarter of a turn in a state
        np.testing.assert_allclose(one["rotor_angles"], 1.57 * k * np.array([1, -1, 1, -1]))
    for few, many in zip(asked[7:11], asked[:7:2], strict=True):  # every other picture, the same
        for name in ("rotor_angles", "trail", "goal"):
            np.testing.assert_allclose(few[name], many[name], atol=1e-9)
        np.testing.assert_allclose(few["camera"].lookat, many["camera"].lookat)


@pytest.mark.parametrize("rotors", [4, 8])
def test_the_panel_shows_rotor_speeds_in_its_corner_and_the_outcome_below(rotors):
    panel = Panel(240, "x" * 200, [(1.0, 0.42, 0.1)] * rotors)  # a title that is cut
    assert not panel.fits(160, 120) and (rotors == 8 or panel.fits(400, 300))
    blank = np.full((240, 400, 3), 128, np.uint8)
    slow, fast, good, bad = pictures = [blank.copy() for _ in range(4)]
    shown = (0, ""), (1, ""), (0, SUCCESS), (0, FAILURE)
    for picture, (share, end) in zip(pictures, shown, strict=True):
        panel.draw(picture, ["0.10 s", "0.12 m"], np.full(rotors, share), outcome=end)
    rows, columns = np.nonzero(changed(blank, slow, by=3))
    # 18 pixels of margin, 146 of height and 314 + 21 a rotor of width, times 0.8.
    assert 13 <= min(rows.min(), columns.min()) and rows.max() <= 14 + 117
    assert columns.max() == pytest.approx(0.8 * (18 + 314 + 21 * rotors), abs=2)
    bars = changed(slow, fast) & (fast[..., 0] > 200)
    assert bars.sum() == pytest.approx(rotors * 12 * 91 * 0.8**2, rel=0.15)
    rows, _ = np.nonzero(changed(slow, good))
    assert rows.min() > 0.8 * (18 + 146) and len(rows) > 500
    green, red = (p[rows.min() :].reshape(-1, 3).astype(int).sum(0) for p in (good, bad))
    assert green[1] > red[1] and red[0] > green[0]


def test_the_font_has_all_that_the_panel_writes():
    font = ImageFont.load_default(size=20)
    errors = (0.0, 1e-9, 6.3e-5, 0.0063, 0.063, 63.0, 1234.5, math.nan)
    lines = [overlay.flight_lines(1.0, x, 2.0, -3.0, 4.0) for x in errors]
    assert lines[2]["error"] == "0.063 mm"
    text = "".join(name + value for each in lines for name, value in each.items()) + "…°"
    box, *glyphs = (bytes(font.getmask(x)) for x in ("\ufffe", *sorted({*text} - {" "})))
    assert box not in glyphs


def test_the_outcome_in_words():
    ends = [(True, False, True), (False, True, True), (True, False, False), (False, True, False)]
    assert [outcome(*end) for end in ends] == [SUCCESS, SUCCESS, FAILURE, TIME_OVER]
    assert outcome(False, False, False) == ""


def test_the_horizon_is_that_of_a_pilot():
    def sky(x, y, *angles):
        """Whether a point of the dial is blue, -1 to 1 to the right and up."""
        attitude = Rotation.from_euler("ZYX", angles, degrees=True).as_quat(scalar_first=True)
        dial, cover = horizon(101, attitude)
        assert cover[50, 50] == 255 and cover[0, 0] == 0
        red, _, blue = dial[round(50 - 50 * y), round(50 + 50 * x)].astype(int)
        return blue > red

    # Yaw, pitch and roll of axes that point ahead, left and up: nose down and right down count up.
    assert sky(0.6, 0.3, 70, 0, 0) and not sky(0.6, -0.3, 70, 0, 0)
    assert not sky(0.6, 0.2, 0, 0, 40) and sky(-0.6, -0.2, 0, 0, 40)  # the right wing is down
    assert sky(0.2, -0.3, 0, -25, 0) and not sky(0.2, -0.6, 0, -25, 0)  # half a radius at 25 deg


# mediapy and imageio_ffmpeg leave pipes of processes that are over to the garbage collector.
leaves_pipes = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


@leaves_pipes
def test_a_video_plays(model, tmp_path):
    # States at 0.05 to 0.25 s: 0.2 s at 20 frames a second are 5 frames.
    path = write_video(flight(5), model, tmp_path / "a.mp4", fps=20, **SMALL)
    assert list(path.parent.iterdir()) == [path]
    meta, *frames = imageio_ffmpeg.read_frames(str(path))
    assert (meta["size"], meta["fps"], meta["codec"]) == ((160, 120), 20.0, "h264")
    assert meta["pix_fmt"].startswith("yuv420p") and len(frames) == 5
    picture = next(render_trajectory(flight(5), model, fps=20, **SMALL)).astype(int)
    video = np.frombuffer(frames[0], np.uint8).reshape(picture.shape)
    assert np.abs(video - picture).mean() < 8  # lossy, but that picture
    assert path.read_bytes().index(b"moov") < path.read_bytes().index(b"mdat")  # plays at once


@pytest.mark.parametrize(
    ("name", "value"),
    [("width", 161), ("height", 1), ("width", 0), ("width", 100_000), ("height", -2)]
    + [("fps", 0.0), ("fps", 1e9), ("fps", math.nan), ("camera", "sky"), ("path", "a.avi")],
)
def test_what_cannot_be_a_video_is_refused_before_anything_is_written(model, name, value):
    options = SMALL | {"path": "a.mp4", name: value}
    with helpers.refused(name, value):
        write_video(flight(), model, **options)
    assert not list(Path().iterdir())


@leaves_pipes
def test_what_is_written_tells_its_progress_and_can_be_stopped(model):
    done = []

    def stopping(*progress):
        done.append(progress)
        if len(done) == 2:
            raise stop

    for write, path, total, stop in (
        (write_video, Path("b.mp4"), 5, KeyboardInterrupt),
        (write_video, Path("b.gif"), 5, SystemExit),
        (write_contact_sheet, Path("b.png"), 12, ValueError),
    ):
        done.clear()
        path.write_text("the old one")
        with pytest.raises(stop):
            write(flight(5), model, path, fps=20, **SMALL, on_frame=stopping)
        assert done == [(1, total), (2, total)] and list(Path().iterdir()) == [path]
        assert path.read_text() == "the old one"
        path.unlink()


@leaves_pipes
def test_flights_side_by_side(model):
    long, short = flight(9, outcome="time over"), flight(5, outcome="failed")
    path = write_video([long, short, long], model, "a.mp4", fps=20, label=["a", "b", "c"], **SMALL)
    meta, *frames = imageio_ffmpeg.read_frames(str(path))
    assert meta["size"] == (320, 240) and len(frames) == 9 + 20  # and a second of the outcome
    frames = [np.frombuffer(frame, np.uint8).reshape(240, 320, 3) for frame in frames]
    assert frames[0][125:, 165:].max() < 20  # three of four places
    moves = [
        [changed(one[:120, x : x + 160], two[:120, x : x + 160], 40).sum() for x in (0, 160)]
        for one, two in zip(frames, frames[1:], strict=False)
    ]
    assert all(first > 20 for first, _ in moves[:8])
    assert all(second < 20 for _, second in moves[5:])  # it waits
    assert all(max(pair) < 20 for pair in moves[9:])


@pytest.mark.slow
def test_a_gif_and_contact_sheets(model):
    path = write_video(flight(5), model, "a.gif", fps=10, **SMALL)
    with Image.open(path) as gif:
        assert (gif.format, gif.size, gif.n_frames) == ("GIF", (160, 120), 3)
        assert gif.info["duration"] == 100
    two = [flight(9), flight(5)]
    for shown, name, form in ((two, "a.jpg", "JPEG"), (two[0], "a.png", "PNG")):
        path = write_contact_sheet(shown, model, name, **SMALL, fine=False)
        with Image.open(path) as sheet:
            rows = 2 if shown is two else 3
            assert (sheet.format, sheet.size) == (form, (4 * 162, rows * 122))
            pixels = np.asarray(sheet)
    tiles = pixels.reshape(3, 122, 4, 162, 3)[:, 1:-1, :, 1:-1].swapaxes(1, 2)
    first, last = next(render_trajectory(two[0], model, **SMALL, overlay=False)), tiles[2, 3]
    assert changed(tiles[0, 0], first).sum() < 0.2 * first[..., 0].size  # but for the time
    assert changed(first, last).mean() > 0.05
    with helpers.refused("path", "b.mp4"):
        write_contact_sheet(two[0], model, "b.mp4", **SMALL)
    assert not Path("b.mp4").exists()


@pytest.mark.slow
@leaves_pipes
@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "a.png", "a.jpg"])
def test_what_is_drawn_carries_its_scenarios(model, name):
    odd = {"task": "landing", "task_options": {"start_height": 1.5}, "weather": {"wind_speed": 2.0}}
    told = [Scenario.of(one) for one in (odd, {"task": "hover", "vehicle": "crazyflie"})]
    flights = [dataclasses.replace(flight(2), scenario=one.to_json()) for one in told]
    write = write_video if name in ("a.mp4", "a.gif") else write_contact_sheet
    path = write(flights, model, name, **SMALL, fine=False)
    assert [one.to_json() for one in read_scenarios(path)] == [one.to_json() for one in told]
    write([flight(2)], model, name, **SMALL)  # made by hand: none is known
    assert name != "a.gif" or Image.open(name).n_frames == 2  # with the comment before them
    for content in (path.read_bytes(), b"no picture"):
        path.write_bytes(content)
        with helpers.refused(match=f"{name} carries no scenario .*quadrl render"):
            read_scenarios(path)


@leaves_pipes
def test_a_failure_of_the_encoder_leaves_the_old_video(model, monkeypatch, tmp_path):
    old = Path("a.mp4")
    old.write_text("the old one")
    program = tmp_path / "encoder"
    program.write_text("#!/bin/sh\necho no room >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr("mediapy._get_ffmpeg_path", lambda: str(program))
    with pytest.raises(RenderingUnavailable, match="no room"):  # the encoder's own words
        write_video(flight(), model, old, **SMALL)
    assert old.read_text() == "the old one" and list(Path().glob("*.mp4")) == [old]
    assert not list(Path().glob(".*"))


@pytest.mark.parametrize("height", [240, 480, 1080])
def test_the_print_of_the_panel_can_be_read(height):
    """Its capitals are 10 pixels high, and higher in large pictures."""
    picture = np.zeros((height, 2 * height, 3), np.uint8)
    Panel(height, "", []).draw(picture, ["HHHHHH"], [])
    rows, columns = np.nonzero(picture[..., 0] > 180)  # but for the horizon, behind the value
    rows = rows[columns < 0.8 * max(1.0, height / 576) * 196]
    assert np.ptp(rows) + 1 >= max(10, 0.016 * height)


def test_gymnasium_shows_the_panel_and_the_outcome():
    options = dict(render_mode="rgb_array", width=400, height=300, time_limit=0.15)
    with contextlib.closing(gym.make("quadrl/Hover-v0", **options)) as env:
        pictures = []
        for _ in range(2):
            env.reset(seed=0)
            pictures.append([env.render(), env.render()])
            pictures[-1] += [env.step(np.zeros(4)) and env.render() for _ in range(3)]
    for one, other in zip(*pictures, strict=True):
        assert changed(one, other).sum() < 5  # a new episode remembers nothing
    begin, same, *_, late, end = pictures[0]
    assert changed(begin, same).sum() < 5
    assert changed(late[140:165, 15:100], end[140:165, 15:100]).mean() > 0.5  # the outcome
    environment = helpers.begun("hover")
    with contextlib.closing(Pictures(environment, "follow", 160, 96)) as drawing:
        small = drawing.frame()
    with Renderer(environment.scenario.compile_model(), 400, 300) as opened:
        plain = LiveFlight("follow").picture(opened, environment, 0)
    assert small[:12].mean() > 150 and plain[:12].mean() > 150  # sky in the corner
    assert begin[15:130, 15:300].mean() < 0.8 * plain[15:130, 15:300].mean()
    assert changed(begin[170:], plain[170:]).sum() < 5


def test_a_picture_of_a_flight_in_progress_shows_where_it_came_from(renderer):
    recorder = types.SimpleNamespace(scale=1.0, spins=renderer.spins, aspect=1.0)
    recorder.frame = lambda qpos, **options: options
    flying = LiveFlight("follow")

    def see(time, x):
        pose = POSE + np.array([x, 0, 0, 0, 0, 0, 0])
        return flying.picture(recorder, helpers.in_flight(time, pose, rotor_speed=10.0), 0)

    assert len(see(0.0, 0)["trail"]) == 1 and len(see(0.0, 0)["trail"]) == 1
    later = see(0.1, 1.0)
    np.testing.assert_allclose(later["trail"][:, 0], [0, 1])
    np.testing.assert_allclose(later["rotor_angles"], [1, -1, 1, -1])
    assert later["camera"].lookat[0] == pytest.approx(1 - math.exp(-0.1 / 0.3))
    np.testing.assert_allclose(see(4.2, 2.0)["trail"][:, 0], [2])  # older than 4 s is gone
    for time, x in ((0.05, 5.0), (0.0, 7.0), (0.0, 9.0)):  # the last begins before a second picture
        fresh = see(time, x)
        assert fresh["camera"].lookat[0] == x and fresh["trail"][:, 0].tolist() == [x]
        assert not fresh["rotor_angles"].any()


@pytest.mark.parametrize("fine", [True, False])
def test_without_a_graphics_card_shadows_and_edges_are_cheap(model, monkeypatch, fine):
    asked, begin = [], mujoco.Renderer.__init__

    def record(self, given, *rest):
        asked.append((given.vis.quality.offsamples, given.vis.quality.shadowsize))
        begin(self, given, *rest)

    monkeypatch.setattr("mujoco.Renderer.__init__", record)
    monkeypatch.setattr(gl, "drawn_by_processor", lambda: not fine)
    monkeypatch.setattr(model.vis.quality, "offsamples", 4)
    below = looking((2.5, 0, 0), 2.0, -60.0)  # where the sun casts the shadow from 3 m: 0.84 * 3
    with Renderer(model, SIZE, SIZE) as opened:
        dark = [opened.frame(pose, camera=below).astype(int) for pose in (POSE, ELSEWHERE)]
    assert asked == [(4, 512) if fine else (0, 0)]
    assert (model.vis.quality.offsamples, model.vis.quality.shadowsize) == (4, 512)
    rows, columns = np.nonzero((dark[1] - dark[0]).sum(-1) > 60)
    assert len(rows) > 100 and abs(columns.mean() - SIZE / 2) < 12
    assert abs(rows.mean() - SIZE / 2) < 12


def test_who_draws_is_read_from_the_library(renderer, monkeypatch):
    names = {b"llvmpipe (LLVM 15.0.6, 256 bits)": True, b"softpipe": True, None: False}
    for name, software in (names | {b"NVIDIA H200/PCIe/SSE2": False}).items():
        monkeypatch.setattr("OpenGL.GL.glGetString", lambda which, name=name: name)
        gl.drawn_by_processor.cache_clear()
        assert gl.drawn_by_processor() == software
    gl.drawn_by_processor.cache_clear()


def test_no_graphics_library_is_reported(model, monkeypatch):
    def broken(*_):
        raise RuntimeError("no display")

    broken.__module__ = mujoco.Renderer.__module__
    monkeypatch.setattr("mujoco.Renderer", broken)
    with pytest.raises(RenderingUnavailable, match="no display"):
        Renderer(model, **SMALL)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux draws without a screen")
def test_triton_is_loaded_with_its_own_symbols(monkeypatch, tmp_path):
    library = tmp_path / "triton" / "_C" / "libtriton.so"
    library.parent.mkdir(parents=True)
    library.write_text("not one: that it cannot be loaded does no harm")
    (tmp_path / "triton" / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "triton", raising=False)
    loaded, load = [], ctypes.CDLL

    def record(name, mode=0):
        loaded.append((name, bool(mode & os.RTLD_DEEPBIND)))
        return load(name, mode=mode)

    shield_triton.cache_clear()
    monkeypatch.setattr("ctypes.CDLL", record)
    shield_triton()
    assert loaded == [(str(library), True)]
