"""Aircraft from logs: what is wrong with a log is said; the file that is written; the stand."""

import dataclasses
import json
import re
import warnings
from pathlib import Path

import excited
import numpy as np
import pytest

from quadrl import VEHICLES
from quadrl.aircraft.command_map import CommandMap
from quadrl.aircraft.presets import in_real_air
from quadrl.base.errors import QuadrlError
from quadrl.cli import main
from quadrl.core.environment import Environment
from quadrl.evaluation.identification import changed
from quadrl.evaluation.identify import answers, begin
from quadrl.evaluation.log_checks import check_log, hardly_moved
from quadrl.evaluation.logs.reading import read_log
from quadrl.evaluation.rotor_response import fit_response
from quadrl.evaluation.stand import read_stand, stand_map

MAP = CommandMap(194.0, 223.0, 834.0)
GIVEN = VEHICLES["crazyflie_brushless"]
AIRCRAFT = in_real_air(GIVEN)
STAND = Path(__file__).parents[2] / "docs/data/thrust_stand_cf2.1-stock-prop.csv"


@pytest.fixture(scope="module")
def log():
    return excited.fly(AIRCRAFT, MAP, count=1, seconds=12.0)[0]


def checked(path, log, *without):
    """What is said of a log."""
    np.savez(path / "a.npz", **excited.columns(log, *without))
    (found,) = read_log(path / "a.npz")
    return list(check_log(found, GIVEN))


def test_a_sound_log_is_passed(tmp_path, log):
    assert checked(tmp_path, log) == []
    assert checked(tmp_path, log, "rotor_speed") == []
    assert checked(tmp_path, log, "pwm", "acceleration", "battery") == []


def swapped(log, name, signs=(1, 1, 1), order=(0, 1, 2)):
    """A log with another order and other signs of axes."""
    return log | {name: log[name][:, list(order)] * signs}


REFUSED = {
    "milliseconds": (lambda x: x | {"t": 1e3 * x["t"]}, r"t \[ms\]"),
    "microseconds": (lambda x: x | {"t": 1e6 * x["t"]}, r"t \[us\]"),
    "slow": (lambda x: {k: v[::10] for k, v in x.items()}, "100 Hz"),
    "degrees": (lambda x: swapped(x, "body_rate", (57.3,) * 3), "deg/s"),
    "roll sign": (lambda x: swapped(x, "body_rate", (-1, 1, 1)), "gyro_x is what .* -gyro_x"),
    "y down": (lambda x: swapped(x, "body_rate", (1, -1, -1)), "-gyro_y.*-gyro_z"),
    "axes swapped": (
        *(lambda x: swapped(x, "body_rate", order=(1, 0, 2)), "gyro_x is what is called gyro_y"),
    ),
    "velocity down": (lambda x: swapped(x, "velocity", (1, 1, -1)), "vz is what .* -vz"),
    "world": (
        *(lambda x: swapped(swapped(x, "velocity", (-1, -1, 1)), "position", (-1, -1, 1)),),
        "one world frame",
    ),
    "g": (lambda x: x | {"acceleration": x["acceleration"] / 9.81}, r"acc_x \[g\]"),
    "accelerometer down": (lambda x: swapped(x, "acceleration", (1, -1, -1)), "turn z up"),
    "pwm as share": (lambda x: x | {"pwm": 65535 * x["pwm"]}, r"is it \[pwm\] or \[share\]"),
    "share as pwm": (lambda x: x | {"pwm": x["pwm"] / 65535}, r"\[share\] goes to 1"),
    "saturated": (
        lambda x: x | {"pwm": np.minimum(3 * x["pwm"], 1.0)},
        "limit for .* full battery",
    ),
    "still": (
        lambda x: (
            x
            | {
                k: 0 * x[k] + x[k].mean(axis=0)
                for k in ("pwm", "rotor_speed", "body_rate", "velocity")
            }
        ),
        "nothing moves",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_makes_a_fit_impossible_is_refused(tmp_path, log, name):
    spoil, says = REFUSED[name]
    with pytest.raises(QuadrlError, match=says) as refused:
        checked(tmp_path, spoil(log))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("order", [(3, 0, 1, 2), (1, 0, 2, 3), (0, 3, 2, 1)])
def test_another_order_of_motors_is_refused_and_the_right_one_named(tmp_path, log, order):
    wrong = log | {name: log[name][:, list(order)] for name in ("pwm", "rotor_speed")}
    with pytest.raises(QuadrlError, match="another order") as refused:
        checked(tmp_path, wrong)
    found = re.search(r"--motors ([\d,]+)$", str(refused.value))[1]
    (log,) = read_log(tmp_path / "a.npz", found)
    assert list(check_log(log, GIVEN)) == []


def test_propellers_that_turn_the_other_way_are_refused(tmp_path, log):
    np.savez(tmp_path / "a.npz", **excited.columns(log))
    rotors = tuple(dataclasses.replace(rotor, spin=-rotor.spin) for rotor in GIVEN.rotors)
    with pytest.raises(QuadrlError, match="yaws against the spins"):
        list(check_log(*read_log(tmp_path / "a.npz"), dataclasses.replace(GIVEN, rotors=rotors)))


WARNED = {
    "gap": (
        lambda x: {k: np.delete(v, slice(2000, 2100), 0) for k, v in x.items()},
        "1 gaps, of up",
    ),
    "some at the limit": (
        lambda x: x | {"pwm": np.where(x["t"][:, None] < 1.0, 1.0, x["pwm"])},
        "limit for 8%",
    ),
    "accelerometer": (lambda x: x | {"acceleration": x["acceleration"] * 0.8}, "not 9.81"),
}


@pytest.mark.parametrize("name", WARNED)
def test_what_weakens_a_fit_is_told(tmp_path, log, name):
    spoil, says = WARNED[name]
    found = checked(tmp_path, spoil(log))
    assert [line for line in found if re.search(says, line)], found


def test_what_is_hardly_flown_is_named(tmp_path, log):
    spoilt = {
        "yaw": swapped(log, "body_rate", (1, 1, 0.1)),
        "roll": swapped(log, "body_rate", (0.1, 1, 1)),
        "thrust": log | {"rotor_speed": 0 * log["rotor_speed"] + 1500},
    }
    for lacks, wrong in spoilt.items():
        np.savez(tmp_path / "a.npz", **excited.columns(wrong))
        assert hardly_moved(*read_log(tmp_path / "a.npz")) == {lacks}


def test_rotors_follow_as_they_did(log, tmp_path):
    np.savez(tmp_path / "a.npz", **excited.columns(log))
    other = changed(GIVEN, {"lag_up": 0.6, "lag_down": 1.5})
    found = fit_response(read_log(tmp_path / "a.npz"), dataclasses.replace(other, dead_time=0.0))
    own = AIRCRAFT.rotors[0]
    assert found.dead_time == AIRCRAFT.dead_time
    assert found.lag_up == pytest.approx(own.lag_up, rel=0.05)
    assert found.lag_down == pytest.approx(own.lag_down, rel=0.05)
    speed = found.command_map.speed(np.array([0.3, 0.45]), 4.0)
    assert speed == pytest.approx(MAP.speed(np.array([0.3, 0.45]), 4.0), rel=0.01)
    backwards = log | {"pwm": 1 - log["pwm"]}
    np.savez(tmp_path / "a.npz", **excited.columns(backwards))
    with pytest.raises(QuadrlError, match="slower at full command"):
        fit_response(read_log(tmp_path / "a.npz"), GIVEN)


def test_a_stand_gives_what_it_measured(tmp_path):
    speed = np.linspace(0, 2000, 30)
    table = np.stack(
        [speed * 30 / np.pi, 4e-8 * speed**2 + 0.01, 2e-10 * speed**2, speed / 1000], 1
    )
    head = "rpm [rpm],thrust [N],torque [N m],current [A]"
    np.savetxt(tmp_path / "s.csv", table, delimiter=",", header=head, comments="")
    found = read_stand(tmp_path / "s.csv")
    assert found.thrust_coefficient == pytest.approx(4e-8) and found.residual < 1e-9
    assert found.torque_coefficient == pytest.approx(2e-10)
    assert (found.max_speed, found.current) == pytest.approx((2000, 2))
    with pytest.raises(QuadrlError, match="no column pwm"):
        stand_map(tmp_path / "s.csv", battery=False)
    # Four stock rotors on one scale, which shows -1.2 g at rest; with these it were 2.02e-8.
    found = read_stand(STAND)
    assert found.thrust_coefficient == pytest.approx(2.10e-8, rel=0.01)
    assert found.torque_coefficient is None and found.residual < 0.05


def test_an_aircraft_that_ignores_its_commands_shows():
    assert answers(GIVEN, GIVEN) == pytest.approx(1, abs=0.1)  # air takes a little
    slow = dataclasses.replace(GIVEN, inertia=tuple(3 * x for x in GIVEN.inertia))
    assert answers(slow, GIVEN) == pytest.approx(1 / 3, abs=0.03)


def test_a_fit_begins_with_something_of_every_effect():
    for name in ("crazyflie", "racer", "hexa"):
        air = begin(VEHICLES[name]).aerodynamics
        assert air.rotor_drag and air.flapping_moment and air.rotor_inertia
    own = begin(dataclasses.replace(VEHICLES["crazyflie"], name="mine"))
    # 0.4 1/s of linear drag: force over mass and speed.
    assert own.aerodynamics.rotor_drag * own.hover_speed.sum() / own.mass == pytest.approx(0.4)


def command(*words):
    """Exit code of a command line."""
    try:
        main([*map(str, words)])
    except SystemExit as end:
        return end.code
    return 0


def test_a_file_is_an_aircraft_in_every_command(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("quadrl.aircraft.presets.VEHICLES", VEHICLES)
    table = np.stack([np.linspace(0, 65535, 20), np.linspace(0, 24000, 20)], 1)
    table = np.concatenate([table, 3.9e-8 * (table[:, 1:] * np.pi / 30) ** 2], 1)
    head = "pwm,rpm,thrust [N]"
    np.savetxt("stand.csv", table, delimiter=",", header=head, comments="")
    name = "mine_from_a_stand"
    words = ("identify", "--stand", "stand.csv", "--vehicle", GIVEN.name, "--out", f"{name}.json")
    assert command(*words) == 0
    said = capsys.readouterr().out
    assert "3.9e-08" in said and "check --vehicle mine_from_a_stand.json" in said
    environment = Environment("hover", vehicle=f"{name}.json")
    own = environment.vehicle
    assert own.name == name and own.mass == GIVEN.mass
    assert own.rotors[0].thrust_coefficient == pytest.approx(3.9e-8)
    assert own.command_map.speed(0.5) == pytest.approx(12000 * np.pi / 30, rel=0.01)
    assert command("check", "--vehicle", f"{name}.json", "--json") == 0
    assert json.loads(capsys.readouterr().out)["vehicle"] == name
    assert command("export", f"{name}.json", "--to", "mjcf") == 0
    capsys.readouterr()
    VEHICLES.pop(name)
    broken = json.loads((tmp_path / f"{name}.json").read_text())
    broken["vehicle"]["name"] = "racer"
    (tmp_path / "b.json").write_text(json.dumps(broken))
    for file, says in (("b.json", "no other aircraft has"), ("gone.json", "a file that exists")):
        assert command("check", "--vehicle", file) == 2
        assert says in capsys.readouterr().err
    (tmp_path / "c.json").write_text("[1]")
    assert command("check", "--vehicle", "c.json") == 2
    assert "must hold" in capsys.readouterr().err


REFUSED_COMMANDS = {
    "": "quadrl identify LOG...; or --stand FILE",
    "gone.csv": "gone.csv",
    "a.npz --out a.txt": "ends in .json",
    "a.npz --out racer.json": "another name",
    "a.npz --out no/a.json": "no folder",
    "a.npz --motors 1,2": "motors",
    "b.npz --vehicle crazyflie_brushless": "give --stand",
    "a.npz --vehicle hexa": "4 motors, and hexa has 6 rotors",
}


@pytest.mark.parametrize("words", REFUSED_COMMANDS)
def test_what_cannot_be_identified_is_refused(tmp_path, monkeypatch, capsys, log, words):
    monkeypatch.chdir(tmp_path)
    np.savez("a.npz", **excited.columns(log))
    np.savez("b.npz", **excited.columns(log, "rotor_speed"))
    before = {*tmp_path.iterdir()}
    assert command("identify", *words.split()) == 2
    said = capsys.readouterr().err
    assert REFUSED_COMMANDS[words] in said and said.count("\n") == 1
    assert {*tmp_path.iterdir()} == before


def test_a_log_is_flown_again(tmp_path, monkeypatch, capsys, log):
    monkeypatch.chdir(tmp_path)
    np.savez("a.npz", **excited.columns(log))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert command("replay", "a.npz", "--vehicle", GIVEN.name, "--seconds", "3") == 0
    said = capsys.readouterr().out
    assert "predictions of a" in said and "wrote a_replay.png" in said
    rate = [float(x) for x in said[said.index("body rate") :].splitlines()[1].split()[2:]]
    assert rate[1] < 0.2 * rate[0]  # the aircraft that flew, beside holding the rate
    assert (tmp_path / "a_replay.png").stat().st_size > 10_000
    assert command("replay", "a.npz", "--vehicle", GIVEN.name, "--begin", "50") == 2
    assert "lasts from 0 s to 11.9975 s" in capsys.readouterr().err
