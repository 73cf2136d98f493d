"""References from files: what is read is what was meant, smooth, and kept as it flies."""

import copy
import json
import os
import pickle

import numpy as np
import pytest
from helpers import refused

from quadrl import tasks
from quadrl.base.errors import QuadrlWarning
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.learning.config import TrainConfig
from quadrl.tasks import reference_rows

RATE = 2 * np.pi / 8
TIME = np.arange(0, 8, 0.1)
PLACE = np.sin(TIME), np.sin(2 * TIME) / 2, 0.1 * TIME


def eight(time):
    """Place [m] and acceleration [m/s^2] of a slow eight, (n, 3), which asks for 1.3 m/s^2."""
    x, y = np.sin(RATE * time), np.sin(2 * RATE * time) / 2
    still = 0 * time
    return np.stack([x, y, still], -1), -(RATE**2) * np.stack([x, 4 * y, still], -1)


def write(path, names, columns, decimals=6):
    lines = (",".join(f"{x:.{decimals}f}" for x in row) for row in zip(*columns, strict=True))
    path.write_text("\n".join([names, *lines]))
    return str(path)


def flown(task, time, order=0):
    """The reference of a task at times (n,), or a derivative of it, (n, 3)."""
    like = np.zeros((len(time), 3))
    return task.curve.at(task.curve.reference(None, like), time, order)


@pytest.mark.parametrize("rate", [20, 50, 100, 240, 1000])
@pytest.mark.parametrize(("decimals", "noise"), [(6, 0.0), (4, 0.0), (3, 0.0), (6, 1e-5)])
def test_a_curve_is_as_good_however_finely_it_is_sampled(rate, decimals, noise, tmp_path):
    time = np.arange(0, 16, 1 / rate)
    place = eight(time)[0] + noise * np.random.default_rng(1).normal(size=(len(time), 3))
    # Times are rounded, too: steps of 4 and 5 ms at 240 Hz.
    figure = write(tmp_path / "eight.csv", "t,x,y,z", (time, *place.T), decimals)
    task = tasks.make("trajectory", figure=figure)
    at = np.linspace(0, 15.9, 5000)
    rounding = np.sqrt(3) / 2 * 10.0**-decimals
    off = np.linalg.norm(flown(task, at) - eight(at)[0], axis=1).max()
    assert off < 5e-4 + rounding
    if decimals > 3:
        assert off < 2e-4
    wrong = np.linalg.norm(flown(task, at, 2) - eight(at)[1], axis=1).max()
    assert wrong < 0.1 * 1.3
    assert len(json.dumps(Scenario.of(task).to_json())) < 25_000


def test_times_in_whole_milliseconds_are_no_noise(tmp_path):
    time = np.arange(0, 16, 1 / 240)
    columns = np.round(1e3 * time), *eight(time)[0].T
    task = tasks.make("trajectory", figure=write(tmp_path / "own.csv", "t_ms,x,y,z", columns))
    at = np.linspace(0, 15.9, 5000)
    assert np.linalg.norm(flown(task, at, 2) - eight(at)[1], axis=1).max() < 0.02


def test_a_corner_is_passed_nearby_and_with_a_tolerance_by_what_can_be_flown(tmp_path):
    time = np.arange(0, 8, 0.01)
    there = 1 - 0.4567 * np.abs(time % 4 - 2)  # there and back
    figure = write(tmp_path / "own.csv", "t,x,y,z", (time, there, 0 * time, 0 * time))
    for tolerance, near in ((0.0, 2e-3), (1e-3, 1e-2)):
        task = tasks.make("trajectory", figure=figure, figure_tolerance=tolerance)
        assert np.abs(flown(task, time)[:, 0] - there).max() < near
    Environment(task, vehicle="crazyflie")


def test_the_pieces_of_a_curve_meet(tmp_path):
    time = np.arange(0, 16, 1e-3)
    figure = write(tmp_path / "eight.csv", "t,x,y,z", (time, *eight(time)[0].T))
    task, edge = tasks.make("trajectory", figure=figure), 0.02 * np.arange(1, 750)
    for order in range(3):
        before, after = flown(task, edge - 1e-9, order), flown(task, edge + 1e-9, order)
        np.testing.assert_allclose(before, after, atol=1e-6)


NORTH = np.pi / 2 - 0.1 * TIME  # headings from north, clockwise, of those from east
HALF = 0.05 * TIME
X, Y, Z = PLACE


@pytest.mark.parametrize(
    ("names", "columns"),
    [
        ("t,y,x,z", (TIME, Y, X, Z)),
        ("z,time_ms,x,y,vx,vy", (Z, 1e3 * TIME, X, Y, Y, X)),
        ("# t [s], x [mm], y(cm), z_m, yaw [deg]", (TIME, 1e3 * X, 1e2 * Y, Z, 5.729578 * TIME)),
        ("t,p_x,p_y,p_z,q_w,q_x,q_y,q_z,v_x",
         (TIME, X, Y, Z, np.cos(HALF), 0 * X, 0 * X, np.sin(HALF), X)),
        ("timestamp,px,py,pz,yaw,yaw_rate", (TIME, X, Y, Z, 0.1 * TIME, X)),
        ("t,north,east,down,yaw", (TIME, Y, X, -Z, NORTH)),
        ("t,east,north,up,yaw_rad", (TIME, X, Y, Z, 0.1 * TIME)),
    ],
)  # fmt: skip
def test_columns_are_read_by_their_names_in_their_units_and_frames(names, columns, tmp_path):
    task = tasks.make("trajectory", figure=write(tmp_path / "own.csv", names, columns))
    at = np.array([0.0, 2.345, 7.7])
    expected = np.stack([np.sin(at), np.sin(2 * at) / 2, 0.1 * at], axis=-1)
    np.testing.assert_allclose(flown(task, at), expected, atol=2e-4)
    turns = any(name in names for name in ("yaw [", "yaw_rad", "yaw,", "q_w", "down,yaw"))
    np.testing.assert_allclose(task.curve.heading(at), 0.1 * at * turns, atol=1e-4)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ("t,x,y,vx", "no column z, but t, x, y, vx"),
        ("t,x,y,z_ft", "no column z, but t, x, y, z_ft"),
        ("t,x,z,p_x,y", "its columns x and p_x are the same"),
        ("t,x,y,z,heading", "yaw, yaw_rad, yaw_deg; its column heading is not known"),
        ("t,x,y,z,yaw_grad", "its column yaw_grad is not known"),
        ("t_min,x,y,z", "t, t_s, t_ms, .*; its column t_min is not known"),
        ("t,x,y,up,z", "its columns up and z are the same"),
    ],
)
def test_a_column_that_is_missing_doubled_or_mistaken_is_refused_by_its_name(
    names, message, tmp_path
):
    columns = [TIME if name.startswith("t") else X for name in names.split(",")]
    with refused("trajectory figure", match=message):
        tasks.make("trajectory", figure=write(tmp_path / "own.csv", names, columns))


def test_what_the_further_columns_hold_is_not_read(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text("t,x,frame,y,z\n" + "\n".join(f"{t:.1f},0,map,0,0" for t in TIME))
    assert not flown(tasks.make("trajectory", figure=str(path)), TIME).any()


def test_times_begin_at_0(tmp_path):
    figure = write(tmp_path / "own.csv", "t,x,y,z", (TIME + 0.1, *PLACE))
    with refused("trajectory figure", match="row 1 is at 0.1 s"):
        tasks.make("trajectory", figure=figure)


def test_a_heading_in_degrees_is_refused_or_told(tmp_path):
    def made(yaw, name="yaw"):
        columns = TIME, *PLACE, yaw
        figure = write(tmp_path / "own.csv", f"t,x,y,z,{name}", columns)
        return tasks.make("trajectory", figure=figure)

    with refused("trajectory figure", match="from row 60 to 61 yaw jumps from 177 to 0 rad"):
        made(np.arange(80) * 3.0 % 180)
    with refused("trajectory figure", match="yaw jumps from 16 to 0 rad"):
        made(np.arange(80) * 2.0 % 18)
    with pytest.warns(QuadrlWarning, match="in radians, up to 90; call the column yaw_rad or"):
        made(0 * TIME + 90)
    assert made(0 * TIME + 90, "yaw_deg").curve.heading(TIME)[5] == pytest.approx(np.pi / 2)
    with refused("trajectory figure", match="up to 10 rad/s; from 4 to 4.1 s it goes at 30 rad/s"):
        made(3.0 * (TIME > 4.05))


def test_a_limit_has_a_tolerance_and_its_message_the_digits_that_differ(tmp_path):
    time = np.linspace(0, 10, 100)

    def helix(turn):
        columns = time, np.cos(time), np.sin(time), 0.2 * time, turn * time
        figure = write(tmp_path / "own.csv", "t,x,y,z,yaw_rad", columns, 12)
        return tasks.make("trajectory", figure=figure)

    assert helix(10.0).curve.heading(np.array([5.0])) == pytest.approx(50.0)
    with refused("trajectory figure", match="at up to 10 rad/s; .* it goes at 10.001 rad/s"):
        helix(10.001)

    def wide(size):
        place = size * np.cos(time), size * np.sin(time), 0 * time
        figure = write(tmp_path / "own.csv", "t,x,y,z", (time, *place), 3)
        return tasks.make("trajectory", figure=figure)

    wide(3.0)
    with refused("trajectory figure", match="within 3 m .*; it goes 3.00[345].*, 0 m far"):
        wide(3.004)
    assert reference_rows.apart(10.0004, 10.0) == "10.0004"


def test_noise_is_smoothed_and_told_unless_it_is_named(tmp_path, recwarn):
    time = np.arange(0, 16, 0.01)
    noise = 1e-3 * np.random.default_rng(2).normal(size=(len(time), 3))
    figure = write(tmp_path / "own.csv", "t,x,y,z", (time, *(eight(time)[0] + noise).T))
    at = np.linspace(0.5, 15, 3000)
    with pytest.warns(QuadrlWarning, match="passes the rows .* 1.7 mm .*; figure_tolerance=0.0017"):
        task = tasks.make("trajectory", figure=figure)
    assert np.linalg.norm(flown(task, at) - eight(at)[0], axis=1).max() < 2e-3
    # Through all rows it would be some 1 mm * sqrt(6) / (10 ms)^2 = 24 m/s^2.
    assert np.linalg.norm(flown(task, at, 2), axis=1).max() < 3
    # 2 cm from row to row of 1 kHz is 30 m/s and more, and no jump.
    time = np.arange(0, 2, 0.001)
    noisy = 2e-2 * np.random.default_rng(2).normal(size=(3, len(time)))
    fine = write(tmp_path / "fine.csv", "t,x,y,z", (time, *noisy))
    with pytest.warns(QuadrlWarning, match="figure_tolerance=0.03"):
        tasks.make("trajectory", figure=fine)
    recwarn.clear()
    named = tasks.make("trajectory", figure=figure, figure_tolerance=0.0017)
    assert np.linalg.norm(flown(named, at, 2), axis=1).max() < 1.6
    assert not recwarn


@pytest.mark.filterwarnings("ignore:.*noisy or have corners")
def test_too_much_thrust_tells_noise_from_speed(tmp_path):
    time = np.arange(0, 16, 0.05)
    noise = 2e-2 * np.random.default_rng(0).normal(size=(len(time), 3))
    figure = write(tmp_path / "noisy.csv", "t,x,y,z", (time, *(eight(time)[0] + noise).T))
    with refused("trajectory figure", match="without noise or corners, as figure_tolerance=") as no:
        Environment("trajectory", vehicle="crazyflie", task_options={"figure": figure})
    named = float(no.value.allowed.split("=")[1].split()[0])
    options = {"figure": figure, "figure_tolerance": named}
    Environment("trajectory", vehicle="crazyflie", task_options=options)
    # 1.5 m (3 rad/s)^2 = 13.5 m/s^2 level, from the third second on: 1.70 weights in all.
    angle = 1.5 * np.clip(time - 3, 0, None) ** 2 / (1 + 0.5 * np.clip(time - 3, 0, None))
    fast = 1.5 * np.cos(angle), 1.5 * np.sin(angle), 0 * time
    figure = write(tmp_path / "fast.csv", "t,x,y,z", (time, *fast))
    with refused("trajectory figure", match="a slower one; it asks for .* weights of thrust"):
        Environment("trajectory", vehicle="crazyflie", task_options={"figure": figure})


def test_polynomials_of_the_crazyswarm_are_followed(tmp_path):
    """Two pieces: x = t^2 / 4 for 2 s; then x = 1 + t - t^2 / 4 for 2 s; yaw = 0.1 t and on."""
    names = ["duration", *(f"{k}^{n}" for k in ("x", "y", "z", "yaw") for n in range(8))]
    rows = np.zeros((2, 33))
    rows[:, 0] = 2.0
    rows[0, names.index("x^2")], rows[1, names.index("x^0")] = 0.25, 1.0
    rows[1, names.index("x^1")], rows[1, names.index("x^2")] = 1.0, -0.25
    rows[:, names.index("yaw^1")], rows[1, names.index("yaw^0")] = 0.1, 0.2
    path = tmp_path / "polynomials.csv"
    path.write_text(
        ",".join(names) + "\n" + "\n".join(",".join(map(str, row)) + "," for row in rows)
    )
    task = tasks.make("trajectory", figure=str(path))
    at = np.array([0.0, 1.0, 1.5, 2.5, 3.0, 4.0, 9.0])
    expected = [0.0, 0.25, 0.5625, 1 + 0.5 - 0.0625, 1 + 1 - 0.25, 2.0, 2.0]
    np.testing.assert_allclose(flown(task, at)[:, 0], expected, atol=3e-4)
    np.testing.assert_allclose(task.curve.heading(at[:5]), 0.1 * at[:5], atol=1e-3)
    for rows[1, 0] in (-1.0, 0.0):
        lines = [",".join(map(str, row)) for row in rows]
        path.write_text("\n".join([",".join(names), *lines]))
        with refused("trajectory figure", match=f"row 2 takes {rows[1, 0]:g} s"):
            tasks.make("trajectory", figure=str(path))


@pytest.mark.parametrize("size", [0.1, 1.0])
def test_waypoints_without_times_are_flown_from_rest_to_rest_within_limits(size, tmp_path):
    places = size * np.array([[0, 0, 0], [1, 0, 0.2], [1, 1, 0], [0, 1, 0]])
    figure = write(tmp_path / "way.csv", "x,y,z", places.T)
    task = tasks.make("trajectory", figure=figure)
    at = np.linspace(0, task.figure.seconds, 4000)
    curve = flown(task, at)
    for place in places:
        assert np.linalg.norm(curve - place, axis=1).min() < 1e-3
    speed, acceleration = (np.linalg.norm(flown(task, at, k), axis=1).max() for k in (1, 2))
    assert (acceleration if size < 1 else 3 * speed) == pytest.approx(3.0, abs=0.1)
    assert speed < 1.03 and acceleration < 3.1
    assert np.linalg.norm(flown(task, at[[0, -5]], 1), axis=1).max() < 0.02
    with refused("trajectory figure", match="rows 1 and 2 are one place"):
        doubled = write(tmp_path / "twice.csv", "x,y,z", places[[0, 0, 1]].T)
        tasks.make("trajectory", figure=doubled)


def test_what_flew_is_kept_without_its_file(tmp_path, monkeypatch, recwarn):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "own.csv", "t,x,y,z,yaw_rad", (TIME, *PLACE, 0.1 * TIME))
    task = tasks.make("trajectory", figure="own.csv")
    saved = json.loads(json.dumps(Scenario.of(task, vehicle="crazyflie").to_json()))
    assert "coefficients" not in repr(task)
    for same in (copy.deepcopy(task), pickle.loads(pickle.dumps(task)), Scenario.of(saved).task):
        assert same == task and hash(same) == hash(task)
        np.testing.assert_array_equal(same.curve.pieces, task.curve.pieces)
    assert tasks.make("trajectory", **saved["task_options"]) == task
    # A longer flight has the rest of the file, too.
    long = tasks.make("trajectory", figure="own.csv", time_limit=3.0).replace(time_limit=6.0)
    np.testing.assert_array_equal(flown(long, TIME[:60]), flown(task, TIME[:60]))
    os.remove("own.csv")
    assert Scenario.of(saved).task == task and not recwarn
    write(tmp_path / "own.csv", "t,x,y,z", (TIME, *PLACE))
    with pytest.warns(QuadrlWarning, match="own.csv is not the file whose curve is flown"):
        assert Scenario.of(saved).task == task
    assert Scenario.of(saved, task_options={"figure": "own.csv"}).task != task


def test_a_training_flies_and_keeps_one_curve_though_its_file_changes(tmp_path):
    figure = write(tmp_path / "own.csv", "t,x,y,z", (TIME, *PLACE))
    config = TrainConfig("trajectory", task_options={"figure": figure})
    begun = config.scenario.task.figure
    write(tmp_path / "own.csv", "t,x,y,z", (TIME, Y, X, Z))
    kept = config.resolved()["scenario"]["task_options"]["figure"]
    assert config.training_scenario.task.figure == begun and kept["digest"] == begun.digest
    os.remove(figure)
    resumed = TrainConfig.of_saved(config.resolved(), steps=10_000_000)
    assert resumed.scenario.task.figure == begun


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        ({"coefficients": [[0, 0, 0]]}, "coefficients = .* rows of 3 or 4 numbers"),
        ({"coefficients": None}, "not iterable"),
        ({"seconds": "soon"}, "seconds = 'soon': must be a number between"),
        ({"spacing": 0}, "spacing = 0: must be a number between"),
        ({"file": 7}, "not '?int"),
        ({"shape": 1}, "field of trajectory figure = 'shape'"),
    ],
)
def test_a_record_that_was_edited_into_nonsense_is_refused(edit, message, tmp_path):
    figure = write(tmp_path / "own.csv", "t,x,y,z", (TIME, *PLACE))
    saved = Scenario.of(tasks.make("trajectory", figure=figure)).to_json()
    saved["task_options"]["figure"] |= edit
    with refused("trajectory figure", match=f"name the csv file instead; .*{message}"):
        Scenario.of(saved)


def test_a_tolerance_that_would_do_nothing_is_refused(tmp_path):
    with refused("trajectory figure_tolerance", match="must be 0, or with a csv file"):
        tasks.make("trajectory", figure_tolerance=0.01)
    figure = write(tmp_path / "own.csv", "t,x,y,z", (TIME, *PLACE))
    task = tasks.make("trajectory", figure=figure, figure_tolerance=0.01)
    with refused("trajectory figure_tolerance", match="0.01, or with a csv file, .* named again"):
        task.replace(figure_tolerance=0.0)
    assert task.replace(figure=figure, figure_tolerance=0.0).figure.tolerance == 0.0


def test_a_pipe_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with refused("trajectory figure", match="there is no such file"):
        tasks.make("trajectory", figure=str(tmp_path / "pipe.csv"))
