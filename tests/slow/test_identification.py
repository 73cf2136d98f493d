"""Aircraft from logs: a simulated one gives its own numbers back, real flights what they tell."""

import dataclasses
import json
import warnings

import excited
import log_writers
import numpy as np
import pytest

from quadrl import VEHICLES
from quadrl.aircraft.command_map import CommandMap
from quadrl.aircraft.presets import in_real_air
from quadrl.base.errors import QuadrlError
from quadrl.cli import main
from quadrl.evaluation.identification import changed
from quadrl.evaluation.identify import identify
from quadrl.evaluation.logs.reading import read_log
from scripts.reports.report import DOCS

GIVEN = VEHICLES["crazyflie_brushless"]
TRUE = {
    **{"thrust": 1.12, "rotor_drag": 0.7, "torque": 1.25, "rotor_inertia": 0.6},
    **{"roll_trim": 1.02, "pitch_trim": 0.985, "yaw_trim": 1.01},
    **{"inertia_x": 1.2, "inertia_y": 0.85, "flapping_moment": 1.3, "flapping_pitch": 1.4},
    **{"lag_up": 1.2, "lag_down": 0.8},
}
FLOWN = dataclasses.replace(changed(in_real_air(GIVEN), TRUE), dead_time=0.0075)
MAP = CommandMap(194.0, 0.0, 890.0)
WITHIN = {
    **{"thrust": 0.01, "inertia_x": 0.05, "inertia_y": 0.05, "flapping_moment": 0.1},
    **{"flapping_pitch": 0.1, "lag_up": 0.1, "lag_down": 0.1, "torque": 0.05},
    **{"rotor_drag": 0.15, "rotor_inertia": 0.25},
    **{"roll_trim": 0.005, "pitch_trim": 0.005, "yaw_trim": 0.005},
}


@pytest.fixture(scope="module")
def logs():
    return excited.fly(FLOWN, MAP)


def own_numbers(vehicle, *without):
    """Refuse numbers of a vehicle that are not those that flew."""
    ways = zip(vehicle.rotors, FLOWN.rotors, strict=True)
    for one, true in ways:
        assert one.thrust_coefficient == pytest.approx(true.thrust_coefficient, rel=0.01)
        if "torque" not in without:
            assert one.torque_coefficient == pytest.approx(true.torque_coefficient, rel=0.05)
        if "lag" not in without:
            assert one.lag_up == pytest.approx(true.lag_up, rel=0.1)
            assert one.lag_down == pytest.approx(true.lag_down, rel=0.1)
    if "lag" not in without:
        assert vehicle.dead_time == FLOWN.dead_time
    for axis in range(2):
        assert vehicle.inertia[axis] == pytest.approx(FLOWN.inertia[axis], rel=0.05)
    air, true = vehicle.aerodynamics, FLOWN.aerodynamics
    if "air" not in without:
        assert air.flapping_moment == pytest.approx(true.flapping_moment, rel=0.1)
        assert air.flapping_pitch == pytest.approx(true.flapping_pitch, rel=0.1)
        assert air.rotor_drag == pytest.approx(true.rotor_drag, rel=0.15)


def test_an_aircraft_gives_its_own_numbers_back_from_tables(tmp_path, logs, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for k, log in enumerate(logs):
        excited.write_csv(tmp_path / f"{k}.csv", log)
    words = [*(f"{k}.csv" for k in range(4)), "--vehicle", GIVEN.name, "--out", "mine.json"]
    main(["identify", *words])
    said = capsys.readouterr().out
    assert "0.1 s" in said and {*tmp_path.glob("mine_*.png")} == {
        tmp_path / f"mine_{k}.png" for k in range(4)
    }
    from quadrl.aircraft.specification import resolve

    made = resolve("mine.json")
    own_numbers(made)
    speed = MAP.speed(np.array([0.3, 0.45]), 4.0)
    assert made.command_map.speed(np.array([0.3, 0.45]), 4.0) == pytest.approx(speed, rel=0.01)
    found = json.loads((tmp_path / "mine.json").read_text())["identified"]
    assert found["not_identified"] == {}
    for name, factor in found["factors"].items():
        wrong = abs(factor / TRUE[name] - 1)
        assert wrong < WITHIN[name]
        assert wrong < 8 * found["standard_errors"][name] + 0.001  # the least that they can be
    VEHICLES.pop("mine")


def test_the_page_identifies_and_replays(tmp_path, logs, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for k in range(2):
        excited.write_csv(tmp_path / f"flight{k + 1}.csv", logs[k])
    page = (DOCS / "flights.md").read_text()
    shown = [line.split()[1:] for line in page.splitlines() if line.startswith("quadrl ")]
    assert [words[0] for words in shown] == ["identify", "replay"]
    for words in shown:
        main(words)
    said = capsys.readouterr().out
    assert "wrote mine.json" in said and "wrote flight1_replay.png" in said
    VEHICLES.pop("mine")


def test_commands_and_a_stand_are_enough(tmp_path, logs):
    pwm, volts = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, 30), (3.6, 4.1)))
    speed = np.where(pwm > 0, MAP.speed(pwm, volts), 0)
    rotor = FLOWN.rotors[0]
    ratio = rotor.torque_coefficient / rotor.thrust_coefficient
    lift = rotor.thrust_coefficient * speed**2
    table = np.stack([65535 * pwm, volts, speed * 30 / np.pi, lift, ratio * lift], axis=1)
    head = "pwm,vbat[V],rpm,thrust[N],torque[N m]"
    np.savetxt(tmp_path / "s.csv", table, delimiter=",", header=head, comments="")
    for k, log in enumerate(logs):
        np.savez(tmp_path / f"{k}.npz", **excited.columns(log, "rotor_speed"))
    read = [log for k in range(4) for log in read_log(tmp_path / f"{k}.npz")]
    # Another inertia about z, which torque tells.
    x, y, z = GIVEN.inertia
    found = identify(
        read, dataclasses.replace(GIVEN, inertia=(x, y, 0.85 * z)), "mine", tmp_path / "s.csv"
    )
    own_numbers(found.vehicle)
    assert found.vehicle.inertia[2] == pytest.approx(z, rel=0.05)
    assert found.vehicle.command_map.gain_by_volt == pytest.approx(890, rel=0.01)


def test_a_log_of_another_format_gives_the_same(tmp_path, logs):
    log_writers.write_ulog(tmp_path / "a.ulg", {k: x[::2] for k, x in logs[0].items()})
    own_numbers(identify(read_log(tmp_path / "a.ulg"), GIVEN, "mine").vehicle)


def test_without_pose_the_body_rate_alone_is_judged(tmp_path, logs):
    pose = ("position", "velocity", "quaternion")
    for k, log in enumerate(logs):
        np.savez(tmp_path / f"{k}.npz", **excited.columns(log, *pose))
    read = [log for k in range(4) for log in read_log(tmp_path / f"{k}.npz")]
    with pytest.warns(UserWarning, match="may pass for inertia"):
        found = identify(read, GIVEN, "mine")
    assert [name for name, sizes in found.table[0].items() if sizes == []] == [
        *("attitude", "velocity", "position"),
    ]
    assert {"thrust", "rotor_drag", "flapping_moment"} <= {*found.not_identified}
    # The moment of the airspeed stays unknown.
    assert found.table[-1]["body_rate"][1] < 0.85 * found.table[1]["body_rate"][1]


def test_a_twin_of_a_real_aircraft_is_predicted_as_well_as_it_should_be(tmp_path):
    # Rotors that differ, a centre of mass that is off, and more noise than the numbers had above.
    lifts, (x, y, _) = (1.05, 0.97, 0.94, 1.03), (0.001, -0.0015, 0)
    rotors = tuple(
        dataclasses.replace(
            rotor,
            thrust_coefficient=rotor.thrust_coefficient * lift,
            torque_coefficient=rotor.torque_coefficient * lift,
            position=(rotor.position[0] - x, rotor.position[1] - y, 0.008),
        )
        for rotor, lift in zip(FLOWN.rotors, lifts, strict=True)
    )
    twin = dataclasses.replace(FLOWN, rotors=rotors)
    read = []
    for k, log in enumerate(excited.fly(twin, MAP, seed=3, noise=2.0)):
        np.savez(tmp_path / f"{k}.npz", **excited.columns(log, "pwm", "battery"))
        read += read_log(tmp_path / f"{k}.npz")
    found = identify(read, GIVEN, "mine").table[-1]
    assert found["body_rate"][1] < 0.75  # [rad/s] after 0.1 s
    assert found["attitude"][1] < 0.040  # [rad] after 0.1 s
    assert found["position"][2] < 0.12  # [m] after 0.5 s


def test_real_flights_tell_thrust_and_drag_and_no_more():
    stand = DOCS / "data" / "thrust_stand_cf2.1-stock-prop.csv"
    read = read_log(DOCS / "data" / "nanobench_extract.npz")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = identify(read, VEHICLES["crazyflie"], "mine", stand)
    assert {*found.factors} == {"thrust", "rotor_drag"}
    assert found.vehicle.inertia == VEHICLES["crazyflie"].inertia
    for name in ("inertia_x", "inertia_y", "torque", "lag_up", "flapping_moment", "roll_trim"):
        assert "where holding the rate has" in found.not_identified[name]
    by_model = {row["model"]: row for row in found.table}
    fitted, held = (by_model[name]["velocity"][1] for name in ("fitted", "hold"))
    assert fitted < 0.5 * held


def test_commands_of_another_flight_are_refused_with_a_number(tmp_path, logs):
    own = [
        log | {k: logs[(n + 1) % 4][k] for k in ("pwm", "rotor_speed")}
        for n, log in enumerate(logs)
    ]
    read = []
    for k, log in enumerate(own):
        np.savez(tmp_path / f"{k}.npz", **excited.columns(log))
        read += read_log(tmp_path / f"{k}.npz")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = identify(read, GIVEN, "mine")
        except QuadrlError as refused:
            assert any(letter.isdigit() for letter in str(refused))
        else:
            assert not {"inertia_x", "inertia_y", "torque"} & {*found.factors}


def test_a_wrong_mass_is_refused_with_the_number(tmp_path, logs):
    np.savez(tmp_path / "a.npz", **excited.columns(logs[0]))
    light = dataclasses.replace(GIVEN, mass=0.4 * GIVEN.mass)
    with pytest.raises(QuadrlError, match=r"thrust runs to 0\.50 times .*0\.5 to 2"):
        identify(read_log(tmp_path / "a.npz"), light, "mine")
