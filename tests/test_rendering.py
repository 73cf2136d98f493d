"""Pictures and videos: what is drawn is where it should be, and nothing is left half done."""

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest

import quadrl
from quadrl import VEHICLES
from quadrl.rendering import (
    Flight,
    Renderer,
    RenderingUnavailable,
    aircraft_scale,
    follow_cameras,
    in_view,
    render_flight,
    write_video,
)
from quadrl.task import Marker, OptionError

WIDTH, HEIGHT = 160, 120
CAMERAS = ("follow", "fixed", "track", "chase", "onboard")
POSE = np.array([0, 0, 3, 1, 0, 0, 0], float)
ELSEWHERE = np.array([0, 50, 3, 1, 0, 0, 0], float)  # out of the pictures that look for a shape


@pytest.fixture(scope="module")
def model():
    return quadrl.Vehicle().compile()


@pytest.fixture(scope="module")
def renderer(model):
    with Renderer(model, WIDTH, HEIGHT) as opened:
        yield opened


def yawed(angle: float) -> np.ndarray:
    return np.array([0, 0, 3, math.cos(angle / 2), 0, 0, math.sin(angle / 2)])


def look_north(lookat, distance: float) -> mujoco.MjvCamera:
    """A level camera looking along +y: east is to the right, up is up."""
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat, camera.distance = lookat, distance
    camera.azimuth, camera.elevation = 90.0, 0.0
    return camera


def same(a: np.ndarray, b: np.ndarray) -> bool:
    """Mesa's threads round some pixels differently from time to time."""
    return a.shape == b.shape and np.abs(a.astype(int) - b.astype(int)).max() <= 3


def changed(a: np.ndarray, b: np.ndarray, by: int = 12) -> np.ndarray:
    """Which pixels differ visibly, (height, width)."""
    return np.abs(a.astype(int) - b.astype(int)).max(-1) > by


def make_flight(states: int = 4, step: float = 0.05) -> Flight:
    """Level flight to the north-east, the yaw turning by 90 degrees a state."""
    time = step * np.arange(1, states + 1)
    k = np.arange(states)
    qpos = np.stack([yawed(math.pi / 2 * i) for i in k])
    qpos[:, 0], qpos[:, 1] = k, 2 * k
    return Flight(
        time=time,
        qpos=qpos,
        rotor_speed=np.outer(k, [100.0, 200.0, 300.0, 400.0]),
        error=10.0 - k,
        reward=k + 1.0,
        goal=np.tile([0.5, 0.0, 3.5], (states, 1)),
        control_step=step,
        max_rotor_speed=400.0,
        task="hover",
    )


def test_cameras(renderer):
    assert renderer.cameras == CAMERAS


@pytest.mark.parametrize("camera", CAMERAS)
def test_every_camera_shows_something(renderer, camera):
    picture = renderer.frame(POSE, camera=camera)
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert picture.dtype == np.uint8
    assert picture.std() > 10
    assert same(picture, renderer.frame(POSE, camera=camera))


@pytest.mark.parametrize("camera", [c for c in CAMERAS if c != "onboard"])
def test_front_is_not_back(model, camera):
    with Renderer(model, 4 * WIDTH, 4 * HEIGHT) as large:
        front = large.frame(yawed(0.0), camera=camera)
        back = large.frame(yawed(math.pi), camera=camera)
    assert changed(front, back).sum() > 100


def test_the_front_rotor_is_orange_and_the_rear_one_blue(renderer):
    # Seen from the north, heading east: the front is to the right.
    picture = renderer.frame(POSE, camera=look_north([0, 0, 3], 0.9)).astype(int)
    red, _, blue = np.moveaxis(picture, -1, 0)
    without = renderer.frame(ELSEWHERE, camera=look_north([0, 0, 3], 0.9))
    aircraft = changed(picture, without)
    columns = np.arange(WIDTH) * np.ones((HEIGHT, 1))
    orange, blueish = aircraft & (red > blue + 60), aircraft & (blue > red + 60)
    assert orange.sum() > 20 and blueish.sum() > 20
    assert columns[orange].mean() > WIDTH / 2 + 20
    assert columns[blueish].mean() < WIDTH / 2 - 20


def test_the_goal_is_where_it_should_be(model):
    # A field of view of 42 degrees and 200 pixels, 4 m away: 100 / (tan(21 deg) * 4) = 65.1
    # pixels a metre. The goal at 0.5 m to the right of the centre and 0.3 m above: column
    # 100 + 32.6, row 100 - 19.5; its radius of 0.08 m is 5.2 pixels, so its top is at row 75.3.
    camera = look_north([0, 0, 3], 4.0)
    assert model.vis.global_.fovy == 42.0
    with Renderer(model, 200, 200) as square:
        without = square.frame(ELSEWHERE, camera=camera)
        with_goal = square.frame(ELSEWHERE, camera=camera, goal=[0.5, 0, 3.3])
    rows, columns = np.nonzero(changed(without, with_goal))
    ball = rows < 86  # below hang the drop line and, further down, the ring
    assert ball.sum() > 30
    assert columns[ball].mean() == pytest.approx(132.6 - 0.5, abs=1.0)
    assert rows.min() == pytest.approx(75.3, abs=1.5)
    assert rows[ball].mean() == pytest.approx(80.5 - 0.5, abs=1.0)


def test_follow_keeps_the_goal_in_view(renderer):
    near = renderer.frame(POSE, goal=[1, 1, 3])
    far = renderer.frame(POSE, goal=[-4, 3, 4])
    assert changed(near, far).any()
    # It looks half way to the goal, from 0.75 m + twice half of the separation: 0.75 + 3 = 3.75.
    (camera,) = follow_cameras(POSE[None, :3], [np.array([[3.0, 0.0, 3.0]])])
    np.testing.assert_allclose(camera.lookat, [1.5, 0.0, 3.0])
    assert camera.distance == pytest.approx(3.75)
    # No further than 7 m away, and then the aircraft stays within 7 / 4 m of the middle.
    (camera,) = follow_cameras(POSE[None, :3], [np.array([[0.0, 0.0, 10.0]])])
    np.testing.assert_allclose(camera.lookat, [0.0, 0.0, 4.75])
    assert camera.distance == 7.0


def test_follow_keeps_goals_to_come_in_view_and_comes_nearer_to_a_small_aircraft(renderer):
    ahead, later = np.array([1.0, 0.0, 3.0]), Marker("sphere", (0.0, 2.0, 3.0))
    points = in_view(ahead, [later, Marker("line", end=(9.0, 0.0, 3.0))])
    np.testing.assert_array_equal(points, [ahead, later.position])
    # A box of 1 m by 2 m: half of its diagonal, twice, is sqrt(5).
    (camera,) = follow_cameras(POSE[None, :3], [points])
    np.testing.assert_allclose(camera.lookat, [0.5, 1.0, 3.0])
    assert camera.distance == pytest.approx(0.75 + math.sqrt(5))
    small = aircraft_scale(VEHICLES["crazyflie"].compile())
    assert small == pytest.approx(0.2)  # arms of 0.046 m, and the paper's of 0.23 m
    (camera,) = follow_cameras(POSE[None, :3], [POSE[None, :3]], scale=small)
    assert camera.distance == pytest.approx(0.27)  # a fifth of 1.35 m


def test_a_pad_lies_on_the_ground(model):
    # Seen from above, at 4 m: 65.1 pixels a metre, as for the goal. A radius of 0.5 m reaches 32.5
    # pixels to each side, and the edge 0.02 * 0.5 + 0.003 = 0.013 m farther; on the ground, 3 m
    # below its position, it is not nearer.
    camera = look_north([0, 0, 0], 4.0)
    camera.elevation = -90.0
    with Renderer(model, 200, 200) as square:
        without = square.frame(ELSEWHERE, camera=camera)
        pad = square.frame(ELSEWHERE, camera=camera, markers=[Marker("pad", (0, 0, 3), 0.5)])
    rows, columns = np.nonzero(changed(without, pad))
    assert np.ptp(columns) == pytest.approx(2 * 0.513 * 65.1, abs=2.5)
    assert np.ptp(rows) == pytest.approx(2 * 0.513 * 65.1, abs=2.5)


def test_goals_are_labelled(renderer):
    camera = look_north([0, 0, 3], 4.0)
    plain, seven = (Marker("sphere", (0, 0, 3), label=label) for label in ("", "7"))
    pictures = [renderer.frame(ELSEWHERE, camera=camera, markers=[m]) for m in (plain, seven)]
    assert 5 < changed(*pictures).sum() < 400


def test_a_trail_shows_where_it_has_been(model):
    camera = look_north([0, 0, 3], 4.0)
    path = np.stack([np.linspace(-0.5, 0.5, 30), np.zeros(30), np.full(30, 3.2)], -1)
    with Renderer(model, 200, 200) as square:
        without = square.frame(ELSEWHERE, camera=camera)
        with_trail = square.frame(ELSEWHERE, camera=camera, trail=path)
    rows, columns = np.nonzero(changed(without, with_trail))
    # 65.1 pixels a metre: columns 67 to 133, row 100 - 13. The old end is the thinnest.
    assert columns.min() < 90 and columns.max() == pytest.approx(132.6, abs=2)
    np.testing.assert_allclose(rows, 87.0, atol=2.0)


@pytest.mark.parametrize(
    "marker",
    [
        Marker("goal", (0, 0, 3)),
        Marker("sphere", (0, 0, 3)),
        Marker("ring", (0, 0, 3), size=0.4, end=(0, 1, 3)),
        Marker("pad", (0, 0, 3), size=0.4, end=(0, 1, 3)),
        Marker("line", (-0.5, 0, 3), size=0.02, end=(0.5, 0, 3)),
        Marker("arrow", (-0.5, 0, 3), size=0.02, end=(0.5, 0, 3)),
        Marker("path", size=0.02, points=((-0.5, 0, 3), (0, 0, 3.2), (0.5, 0, 3))),
    ],
    ids=lambda marker: marker.kind,
)
def test_markers_are_drawn_in_the_middle(renderer, marker):
    camera = look_north([0, 0, 3], 4.0)
    rgba = (1.0, 0.0, 0.0, 1.0)
    red = dataclasses.replace(marker, rgba=rgba)
    without = renderer.frame(ELSEWHERE, camera=camera)
    rows, columns = np.nonzero(
        changed(without, renderer.frame(ELSEWHERE, camera=camera, markers=[red]))
    )
    assert len(rows) >= 10
    # Those with two ends reach from -0.5 m to 0.5 m: at 60 / (tan(21 deg) * 4) = 39.1 pixels a
    # metre, from column 60 to 99.
    if marker.kind in ("line", "arrow", "path"):
        np.testing.assert_allclose([columns.min(), columns.max()], [60.5, 98.5], atol=2)
    assert columns.mean() == pytest.approx(WIDTH / 2, abs=4)


def test_the_rotors_turn(renderer):
    camera = look_north([0, 0, 3], 0.9)
    camera.elevation = -60.0
    still = renderer.frame(POSE, camera=camera, rotor_angles=np.zeros(4))
    turned = renderer.frame(POSE, camera=camera, rotor_angles=np.full(4, math.pi / 2))
    assert same(still, renderer.frame(POSE, camera=camera))
    assert changed(still, turned).sum() > 20


def test_the_rotors_turn_in_a_flight_as_fast_as_they_do(model):
    # 31.4 rad/s are a quarter of a turn from one state to the next, 0.05 s later.
    still = dataclasses.replace(
        make_flight(2), qpos=np.stack([POSE, POSE]), rotor_speed=np.zeros((2, 4))
    )
    quarter = dataclasses.replace(still, rotor_speed=np.full((2, 4), math.pi / 2 / 0.05))
    options = dict(width=640, height=480, fps=20, overlay=False, camera="track")
    standing, turning = (list(render_flight(f, model, **options)) for f in (still, quarter))
    assert changed(standing[0], turning[0]).sum() == 0
    assert changed(standing[1], standing[0]).sum() == 0
    assert changed(turning[1], turning[0]).sum() > 20


def test_unknown_cameras_and_sizes_are_refused(model, renderer):
    with pytest.raises(OptionError, match="unknown camera 'sky'.*follow, fixed, track, chase"):
        renderer.frame(POSE, camera="sky")
    with pytest.raises(OptionError, match="mean chase"):
        renderer.frame(POSE, camera="chse")
    for size in ((1922, 1080), (1920, 1082), (0, 100), (100, -2)):
        with pytest.raises(OptionError, match="at most 1920x1080 can be drawn"):
            Renderer(model, *size)


def test_no_graphics_library_is_said_so(model, monkeypatch):
    def none(*_, **__):
        raise RuntimeError("no display")

    monkeypatch.setattr("mujoco.Renderer", none)
    with pytest.raises(RenderingUnavailable, match="apt install libegl1.*failed with: no display"):
        Renderer(model, WIDTH, HEIGHT)


def test_resampled():
    # States at 0.05, 0.10, 0.15 and 0.20 s; 40 frames a second are two a state.
    flight = make_flight()
    goal = np.array([[0, 0, 3], [0.1, 0, 3], [1.1, 0, 3], [1.1, 0, 3]], float)
    twice = dataclasses.replace(flight, goal=goal).resampled(40)
    np.testing.assert_allclose(twice.time, [0.05, 0.075, 0.10, 0.125, 0.15, 0.175, 0.20])
    np.testing.assert_allclose(twice.qpos[:, 0], [0, 0.5, 1, 1.5, 2, 2.5, 3], atol=1e-9)
    np.testing.assert_allclose(twice.qpos[:, 1], [0, 1, 2, 3, 4, 5, 6], atol=1e-9)
    yaw = np.unwrap(2 * np.arctan2(twice.qpos[:, 6], twice.qpos[:, 3]))
    np.testing.assert_allclose(np.degrees(yaw), [0, 45, 90, 135, 180, 225, 270], atol=1e-6)
    np.testing.assert_allclose(twice.rotor_speed[:, 3], [0, 200, 400, 600, 800, 1000, 1200])
    np.testing.assert_allclose(twice.error, [10, 9.5, 9, 8.5, 8, 7.5, 7])
    # The reward of a step is shown until the next one.
    np.testing.assert_allclose(twice.reward, [1, 1, 2, 2, 3, 3, 4])
    # From 0 to 0.1 m the goal moves at 2 m/s; from 0.1 to 1.1 m, at 20 m/s, it jumps.
    np.testing.assert_allclose(twice.goal[:, 0], [0, 0.05, 0.1, 0.1, 1.1, 1.1, 1.1], atol=1e-9)


def test_resampled_markers_move_and_jump():
    moving = [(Marker("sphere", (float(k), 0, 3)),) for k in range(4)]
    twice = dataclasses.replace(make_flight(), markers=moving).resampled(40)
    at = [tuple(m.position[0] for m in markers) for markers in twice.markers]
    np.testing.assert_allclose(at, np.arange(7)[:, None] / 2, atol=1e-9)
    fixed = dataclasses.replace(make_flight(), markers=(moving[2],)).resampled(40)
    assert fixed.markers == (moving[2],)


def test_a_flight_of_one_state_is_one_frame(model):
    (frame,) = render_flight(make_flight(1), model, width=WIDTH, height=HEIGHT)
    assert frame.std() > 10


def test_few_pictures_of_a_flight_show_what_many_do(model):
    # Ten pictures a second are every other one of twenty: with the same speed, trail and camera.
    flight = dataclasses.replace(make_flight(7), goal=np.tile([6.0, 6.0, 3.0], (7, 1)))
    options = dict(width=320, height=240)
    few, many = (list(render_flight(flight, model, fps=fps, **options)) for fps in (10, 20))
    assert (len(few), len(many)) == (4, 7)
    for picture, other in zip(few, many[::2], strict=True):
        assert same(picture, other)


def test_overlay_is_in_its_corner_alone(model):
    options = dict(width=320, height=240, fps=20, trail=False)
    plain = next(render_flight(make_flight(2), model, overlay=False, **options))
    panel = next(render_flight(make_flight(2), model, overlay=True, **options))
    rows, columns = np.nonzero(changed(plain, panel, by=3))
    # 18 pixels of margin and 286 x 138 of panel, times 0.72.
    assert 12 <= rows.min() and rows.max() <= 13 + 99
    assert 12 <= columns.min() and columns.max() <= 13 + 206
    assert len(rows) > 0.8 * 99 * 206


def test_overlay_shows_the_rotor_speeds(model):
    slow = dataclasses.replace(make_flight(2), rotor_speed=np.zeros((2, 4)))
    fast = dataclasses.replace(make_flight(2), rotor_speed=np.full((2, 4), 400.0))
    options = dict(width=320, height=240, fps=20, trail=False)
    pictures = [next(render_flight(f, model, **options)).astype(int) for f in (slow, fast)]
    bars = [picture[13:112, 150:220] for picture in pictures]
    orange = [(bar[..., 0] > bar[..., 2] + 100).sum() for bar in bars]
    assert orange[1] > orange[0] + 300  # a bar of 12 x 86 pixels, times 0.72 each way


def test_video_plays(model, tmp_path):
    # States at 0.05 to 0.40 s: 0.35 s at 20 frames a second are 8 frames.
    path = write_video(
        make_flight(8), model, tmp_path / "new" / "a.mp4", width=WIDTH, height=HEIGHT, fps=20
    )
    assert [p.name for p in path.parent.iterdir()] == ["a.mp4"]
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), *raw]
    played = subprocess.run(command, capture_output=True)
    assert b"160x120" in played.stderr and b"20 fps" in played.stderr
    assert b"h264" in played.stderr and b"yuv420p" in played.stderr
    pictures = np.frombuffer(played.stdout, np.uint8).reshape(-1, HEIGHT, WIDTH, 3)
    assert len(pictures) == 8
    drawn = list(render_flight(make_flight(8), model, width=WIDTH, height=HEIGHT, fps=20))
    for video, picture in zip(pictures, drawn, strict=True):
        assert np.abs(video.astype(int) - picture).mean() < 8  # lossy, but that picture


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"width": 161}, "161x120 pixels: a video needs an even width and height"),
        ({"height": 1}, "160x1 pixels: a video needs an even width and height"),
        ({"width": 0}, "0x120 pixels: at most 1920x1080"),
        ({"width": 100_000}, "at most 1920x1080"),
        ({"height": -2}, "at most 1920x1080"),
        ({"fps": 0.0}, "fps = 0.0: 1 to 240"),
        ({"fps": -1.0}, "fps = -1.0: 1 to 240"),
        ({"fps": 1e9}, "1 to 240"),
        ({"fps": math.nan}, "fps = nan: 1 to 240"),
        ({"camera": "sky"}, "unknown camera 'sky'.*follow, fixed"),
    ],
)
def test_videos_that_cannot_be_are_refused_before_anything_is_written(
    model, tmp_path, options, says
):
    options = {"width": WIDTH, "height": HEIGHT} | options
    with pytest.raises(OptionError, match=says):
        write_video(make_flight(), model, tmp_path / "new" / "a.mp4", **options)
    assert not list(tmp_path.iterdir())


def test_names_that_cannot_be_a_video_are_refused(model, tmp_path):
    with pytest.raises(OptionError, match=r"a\.gif: the name of a video must end in \.mp4"):
        write_video(make_flight(), model, tmp_path / "a.gif")
    (tmp_path / "a.mp4").mkdir()
    with pytest.raises(OptionError, match=r"a\.mp4 is a folder"):
        write_video(make_flight(), model, tmp_path / "a.mp4")


class Stop(Exception):
    pass


@pytest.mark.parametrize("error", [Stop("half way"), KeyboardInterrupt()])
@pytest.mark.parametrize("frames", [0, 3])
def test_a_failure_leaves_nothing_and_keeps_the_old_video(
    model, tmp_path, monkeypatch, error, frames
):
    def broken(*_, **__):
        for _ in range(frames):
            yield np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        raise error

    monkeypatch.setattr("quadrl.rendering.render_flight", broken)
    path = tmp_path / "a.mp4"
    path.write_text("the old one")
    with pytest.raises(type(error)) as caught:
        write_video(make_flight(), model, path, width=WIDTH, height=HEIGHT)
    assert caught.value is error
    assert path.read_text() == "the old one"
    assert list(tmp_path.iterdir()) == [path]


# mediapy leaves the pipes of a process that failed to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_encoder_that_fails_is_said_so(model, tmp_path, monkeypatch):
    monkeypatch.setattr("mediapy._get_ffmpeg_path", lambda: "/bin/false")
    with pytest.raises(RenderingUnavailable, match=r"a\.mp4 could not be written"):
        write_video(make_flight(), model, tmp_path / "a.mp4", width=WIDTH, height=HEIGHT)
    assert not list(tmp_path.iterdir())


def run(code: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(Path(quadrl.__file__).parents[1])}
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


def test_beside_dm_control_in_one_process():
    """Both draw what they should, and neither spoils the other's end."""
    done = run("""
import quadrl
import numpy as np
environment = quadrl.load("hover", task_kwargs={"random": 0})
environment.reset()
before = environment.physics.render(48, 64)
from quadrl.rendering import Renderer
pose = [0, 0, 3, 1, 0, 0, 0]
def check(a, b):  # Mesa's threads round some pixels differently
    np.testing.assert_allclose(a.astype(int), b.astype(int), atol=3)
with Renderer(quadrl.Vehicle().compile(), 80, 60) as renderer:
    first = renderer.frame(pose)
    check(environment.physics.render(48, 64), before)
    check(renderer.frame(pose), first)
check(environment.physics.render(48, 64), before)
assert before.std() > 10 and first.std() > 10
""")
    assert (done.returncode, done.stderr, done.stdout) == (0, "", "")


def test_before_dm_control_in_one_process():
    done = run("""
import quadrl
from quadrl.rendering import Renderer
with Renderer(quadrl.Vehicle().compile(), 80, 60) as renderer:
    renderer.frame([0, 0, 3, 1, 0, 0, 0])
environment = quadrl.load("hover")
environment.reset()
assert environment.physics.render(48, 64).std() > 10
""")
    assert (done.returncode, done.stderr, done.stdout) == (0, "", "")
