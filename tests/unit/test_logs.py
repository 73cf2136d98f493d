"""Readers of logs: each format gives the same recording; and what is no log is refused."""

import contextlib
import dataclasses
import sys
import warnings

import excited
import log_writers
import numpy as np
import pytest

from quadrl import VEHICLES
from quadrl.aircraft.command_map import CommandMap
from quadrl.aircraft.presets import in_real_air
from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.evaluation.logs.reading import read_log

MAP = CommandMap(194.0, 223.0, 834.0)
AIRCRAFT = in_real_air(VEHICLES["crazyflie_brushless"])


@pytest.fixture(scope="module")
def log():
    return excited.fly(AIRCRAFT, MAP, count=1, seconds=1.5)[0]


def same(found, log, within, *without):
    """A recording is a log, within resolutions by name."""
    parts = {**found.motion} | {
        name: getattr(found, name) for name in ("pwm", "rotor_speed", "battery", "acceleration")
    }
    np.testing.assert_allclose(found.time, log["t"], atol=1e-6)
    for name in log.keys() - {"t", *without}:
        np.testing.assert_allclose(parts.pop(name), log[name], atol=within.get(name, 1e-5))
    assert all(left is None for left in parts.values())


def test_tables_are_read(tmp_path, log):
    excited.write_csv(tmp_path / "a.csv", log)
    same(*read_log(tmp_path / "a.csv"), log, {})
    np.savez(tmp_path / "a.npz", **excited.columns(log))
    same(*read_log(tmp_path / "a.npz"), log, {})


def test_units_of_columns_count(tmp_path, log):
    own = excited.columns(log)
    other = {
        "t [ms]": 1e3 * own["t [s]"],
        **{f"gyro_{x} [deg/s]": np.rad2deg(own[f"gyro_{x} [rad/s]"]) for x in "xyz"},
        **{f"m{k} [pwm]": 65535 * own[f"m{k} [share]"] for k in range(1, 5)},
        **{f"m{k} [rpm]": own[f"m{k} [rad/s]"] * 30 / np.pi for k in range(1, 5)},
        **{f"acc_{x} [g]": own[f"acc_{x} [m/s^2]"] / 9.81 for x in "xyz"},
        **{f"{x} [mm]": 1e3 * own[f"{x} [m]"] for x in "xyz"},
        "battery [mV]": 1e3 * own["battery [V]"],
        "note": own["t [s]"],
    }
    kept = {name: own[name] for name in own if name.startswith(("v", "q"))}
    np.savez(tmp_path / "a.npz", **other, **kept)
    same(*read_log(tmp_path / "a.npz"), log, {})


@pytest.mark.parametrize("version", [1, 2])
def test_a_microsd_card_is_read(tmp_path, log, version):
    log = log | {"t": np.round(log["t"] * 4, 2) / 4 if version == 2 else np.arange(600) * 1e-3}
    log_writers.write_microsd(tmp_path / "log00", log, version)
    own = {"pwm": 1e-5, "rotor_speed": 0.06}  # whole numbers of PWM and rpm
    same(*read_log(tmp_path / "log00"), log, own)


def test_ulog_is_read_in_our_axes(tmp_path, log):
    log_writers.write_ulog(tmp_path / "a.ulg", log)
    same(*read_log(tmp_path / "a.ulg"), log, {"rotor_speed": 0.06})  # whole rpm


def test_blackbox_is_read(tmp_path, log):
    log_writers.write_blackbox(tmp_path / "a.bbl", log)
    within = {
        "body_rate": np.deg2rad(0.51),
        "acceleration": 0.51 * 9.81 / 2048,
        "battery": 0.0051,
        "pwm": 0.51 / (2047 - 158),
        "rotor_speed": 0.51 * 100 / 6 * np.pi / 30,
    }
    same(*read_log(tmp_path / "a.bbl"), log, within, "position", "velocity", "quaternion")


def test_rosbags_are_read(tmp_path, log):
    log_writers.write_rosbag(tmp_path / "bag", log)
    same(*read_log(tmp_path / "bag"), log, {}, "battery")


def test_motors_can_be_put_in_order(tmp_path, log):
    excited.write_csv(tmp_path / "a.csv", log)
    (found,) = read_log(tmp_path / "a.csv", "4,1,2,3")
    np.testing.assert_allclose(found.rotor_speed, log["rotor_speed"][:, [3, 0, 1, 2]])
    for wrong in ("1,2,3", "1,2,3,3", "a"):
        with pytest.raises(QuadrlError, match="motors"):
            read_log(tmp_path / "a.csv", wrong)


def test_what_is_slower_than_the_gyro_is_put_on_its_times(tmp_path, log):
    own, slow = excited.columns(log), np.arange(600) % 4 != 0
    for name in own:
        if name.startswith(("v", "q", "x", "y", "z", "m")):
            own[name] = np.where(slow, np.nan, own[name])
    np.savez(tmp_path / "a.npz", **own)
    (found,) = read_log(tmp_path / "a.npz")
    last = slice(0, 596)
    assert np.abs(found.motion["velocity"] - log["velocity"])[last].max() < 0.05
    np.testing.assert_array_equal(found.pwm[3], found.pwm[0])  # held
    assert np.linalg.norm(found.motion["quaternion"], axis=1)[last] == pytest.approx(1)
    # A tenth of a second without any is a gap.
    for name in own:
        if name.startswith("v"):
            own[name][400:500] = np.nan
    np.savez(tmp_path / "a.npz", **own)
    (found,) = read_log(tmp_path / "a.npz")
    assert np.isnan(found.motion["velocity"][410:490]).all()


def test_a_velocity_follows_from_the_position(tmp_path, log):
    own = {k: x for k, x in excited.columns(log).items() if not k.startswith("v")}
    np.savez(tmp_path / "a.npz", **own)
    (found,) = read_log(tmp_path / "a.npz")
    away = found.motion["velocity"] - log["velocity"]
    assert np.sqrt((away[50:-50] ** 2).mean()) < 0.06  # of millimetres of noise


REFUSED = {
    "t [s],gyro_x [rpm]\n0,1\n": r"gyro_x \[rad/s\], gyro_x \[deg/s\]",
    "t [s],gyro_x [rad/s]\n0,1\n": "gyro_y is missing",
    "gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s]\n0,1,2\n": r"t \[s\] is missing",
    "t [s],m1 [pwm],m2 [pwm]\n0,1,2\n": "m3 is missing",
    "t [s],x [m],y [m],z [m]\n0,0,0,0\n1,0,0,0\n": "has no gyro",
    "t [s],gyro_x\n0,1\n": "must be one of",
    "": "is no table",
    "t [s],x [m]\n": "2 names and 1 columns",
    "\x00\ud8ff": "is no table",
    "t [s],x [m]\n0,1,2\n1,2\n": "is no table",
}


@pytest.mark.parametrize("text", REFUSED)
def test_tables_that_lack_something_say_what(tmp_path, text):
    (tmp_path / "a.csv").write_bytes(text.encode(errors="surrogatepass"))
    with pytest.raises(QuadrlError, match=REFUSED[text]) as refused:
        read_log(tmp_path / "a.csv")
    assert "\n" not in str(refused.value)


def test_a_clock_that_runs_back_is_refused(tmp_path, log):
    wrong = log | {"t": np.concatenate([log["t"][:300], log["t"][:300]])}
    excited.write_csv(tmp_path / "a.csv", wrong)
    with pytest.raises(QuadrlError, match="does not rise from 0.7475 s to 0 s"):
        read_log(tmp_path / "a.csv")


@pytest.mark.parametrize("kind", ["ulog", "microsd", "blackbox"])
def test_files_that_are_cut_off_are_read_as_far_as_they_go(tmp_path, log, kind):
    short = {name: x[:40] for name, x in log.items()}
    getattr(log_writers, f"write_{kind}")(tmp_path / "a", short)
    whole = (tmp_path / "a").read_bytes()
    (tmp_path / "a").write_bytes(whole[:20])
    with warnings.catch_warnings(), pytest.raises(QuadrlError) as refused:
        warnings.simplefilter("ignore")
        read_log(tmp_path / "a")
    assert "\n" not in str(refused.value)
    (tmp_path / "a").write_bytes(whole[:-300])  # its power was cut
    with pytest.warns(QuadrlWarning) if kind == "microsd" else contextlib.nullcontext():
        (found,) = read_log(tmp_path / "a")
    np.testing.assert_allclose(found.motion["body_rate"][:30], short["body_rate"][:30], atol=0.01)


def test_a_missing_library_is_named(tmp_path, log, monkeypatch):
    short = {name: x[:40] for name, x in log.items()}
    log_writers.write_ulog(tmp_path / "a.ulg", short)
    monkeypatch.setitem(sys.modules, "pyulog", None)
    monkeypatch.delitem(sys.modules, "quadrl.evaluation.logs.ulog", raising=False)
    with pytest.raises(QuadrlError, match=r"reading a.ulg needs pyulog: .*'quadrl\[logs\]'"):
        read_log(tmp_path / "a.ulg")


def test_a_map_goes_both_ways():
    assert MAP.speed(0.5, 4.0) == pytest.approx(194 + 0.5 * (223 + 4 * 834))
    assert MAP.command(MAP.speed(0.3, 3.7), 3.7) == pytest.approx(0.3)
    with pytest.raises(QuadrlError, match="gain"):
        CommandMap(100.0, -5.0)
    assert dataclasses.replace(AIRCRAFT, command_map=MAP).command_map == MAP
    with pytest.raises(QuadrlError, match="command_map"):
        dataclasses.replace(AIRCRAFT, command_map=3.0)
