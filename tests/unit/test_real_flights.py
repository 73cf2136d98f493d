"""Real flights flown again, against made ones whose numbers are known, and the recorded figures."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadrl import VEHICLES
from quadrl.aircraft.presets import in_real_air
from quadrl.base.errors import QuadrlError
from quadrl.engines.mujoco import BatchEngine
from quadrl.engines.state import Start
from quadrl.evaluation import open_loop
from quadrl.evaluation.flight_log import FlightLog, read
from quadrl.evaluation.identification import TRIMS, at_bounds, changed, fit
from scripts.reports import flights, report

CRAZYFLIE = VEHICLES["crazyflie"]
AIR = in_real_air(CRAZYFLIE)
STEP = CRAZYFLIE.physics_timestep


def made(vehicle, count=8, seconds=1.4):
    """Logs (count) of an aircraft under commands that rise and fall about its hover."""
    steps, dead = round(seconds / STEP), round(vehicle.dead_time / STEP)
    time = STEP * np.arange(steps + 1)
    rng = np.random.default_rng(0)
    # The first tenth of a second is hover, so the rotors begin in balance.
    rise = np.clip((time - 0.1) / 0.1, 0, 1)[:, None, None]
    waves = np.sin(rng.uniform(8, 60, (count, 4)) * time[:, None, None] + rng.uniform(0, 6, (4,)))
    command = vehicle.hover_speed * (1 + 0.06 * rise * waves)  # (T, count, R)
    engine = BatchEngine(vehicle, count, altitude=1000.0, engine="free_flight")
    still = np.zeros((count, 3))
    level = np.tile((1.0, 0, 0, 0), (count, 1))
    moving = rng.uniform(-1, 1, (count, 3))
    engine.place(np.arange(count), Start(still, level, moving, still, command[0].copy()))
    found = []
    for k in range(steps + 1):
        found.append(np.concatenate([engine.qpos, engine.qvel], axis=1))
        engine.ctrl[:] = command[max(k - dead, 0)]
        engine.advance(1)
    parts = np.split(np.stack(found), (3, 7, 10), axis=-1)
    logs = []
    for k in range(count):
        motion = dict(zip(open_loop.MOTION, (part[:, k] for part in parts), strict=True))
        motion["position"] = motion["position"] - engine.origin + (0, 0, 10)
        logs.append(FlightLog(f"made {k}", time, command[:, k], motion))
    return logs


def test_the_right_aircraft_predicts_its_own_flights_exactly():
    where = [open_loop.windows(log) for log in made(AIR)]
    truth = open_loop.measured(where)
    away = open_loop.errors(open_loop.fly(AIR, where), truth)
    held = open_loop.errors(open_loop.hold(where), truth)
    assert set(away) == {"position", "velocity", "body_rate", "attitude"}
    for name, sizes in away.items():  # rotors remember 0.6 s of commands: e^-7 of 100 rad/s is left
        assert (sizes < 2e-3 * held[name]).all(), name
    # Without its dead time it is late by 10 ms.
    late = dataclasses.replace(AIR, dead_time=0.0)
    wrong = open_loop.errors(open_loop.fly(late, where), truth)
    assert (wrong["body_rate"] > 20 * away["body_rate"]).all()


def test_a_fit_finds_the_numbers_that_flew():
    true = dict(thrust=1.1, rotor_drag=1.5)
    flown = dict(zip(TRIMS, (1.01, 0.98, 1.02), strict=True)) | {"lag_rate": 0.9}
    turning = dict(inertia_x=1.2, inertia_y=1.3, torque=1.2)
    aircraft = changed(AIR, true | flown | turning)
    where = [open_loop.windows(log) for log in made(aircraft)]
    found, spread = fit(AIR, where, [*true], "velocity")
    assert found["thrust"] == pytest.approx(1.1, rel=0.01)  # whatever is wrong with its turning
    own = flown | turning
    found, spread = fit(changed(AIR, true), where, [*own], "body_rate")
    assert found == pytest.approx(own, rel=0.01)
    assert at_bounds(found) == [] and max(spread.values()) < 0.01
    # What the bounds of physics hold back is named.
    found, _ = fit(changed(aircraft, {"inertia_x": 0.5 / 1.2}), where, ["inertia_x"], "body_rate")
    assert at_bounds(found) == ["inertia_x"]


def test_names_that_are_unknown_are_refused():
    where = [open_loop.windows(log) for log in made(AIR, count=1)]
    with pytest.raises(QuadrlError, match="wingspan"):
        fit(AIR, where, ["wingspan"], "velocity")
    with pytest.raises(QuadrlError, match="speed"):
        fit(AIR, where, ["thrust"], "speed")


def steady(time, rate=(0.0, 0.0, 2.0), velocity=(1.0, 0.0, -0.5)):
    """A log of an aircraft that turns and moves evenly."""
    turned = Rotation.from_rotvec(time[:, None] * np.array(rate)).as_quat(scalar_first=True)
    motion = {
        "position": (0.0, 0.0, 50.0) + time[:, None] * np.array(velocity),
        "quaternion": turned,
        "velocity": np.tile(velocity, (len(time), 1)),
        "body_rate": np.tile(rate, (len(time), 1)),
    }
    return FlightLog("steady", time, np.full((len(time), 4), 1800.0), motion)


def test_holding_the_state_is_right_in_steady_motion():
    where = [open_loop.windows(steady(0.01 * np.arange(200)))]
    held = open_loop.errors(open_loop.hold(where), open_loop.measured(where))
    assert all((sizes < 1e-9).all() for sizes in held.values())


def test_windows_keep_clear_of_gaps_and_of_the_ground():
    time = 0.01 * np.arange(500)
    log = steady(np.delete(time, slice(250, 255)))  # nothing between 2.49 s and 2.55 s
    _, start = open_loop.windows(log)
    assert start[0] == pytest.approx(0.6) and start[-1] <= 4.49
    clear = (start + 0.5 < 2.5) | (start - 0.6 > 2.5)
    assert clear.all() and len(start) == 6 + 5  # from 0.60 to 1.85 s, and from 3.35 to 4.35 s
    low = dataclasses.replace(log, motion=log.motion | {"position": 0 * log.motion["position"]})
    assert not len(open_loop.windows(low)[1])


@pytest.fixture(scope="module")
def real():
    return flights.sets()


def test_an_archive_is_read_in_si_units(tmp_path):
    share, volts = np.linspace(0.1, 1.0, 40), np.linspace(4.0, 3.0, 40)
    rpm = (100 + 200 * share * volts) * 60 / (2 * np.pi)  # 100 rad/s + 200 rad/s a volt
    table = np.stack([65535 * share, volts, 1.01 * rpm, 0.99 * rpm], axis=1)
    stand = tmp_path / "stand.csv"
    np.savetxt(stand, table, delimiter=",", header="pwm,vbat[V],rpm1,rpm2", comments="")
    pwm = np.array([[0, 13107], [65535, 32768]], dtype=np.uint16)  # 0, 0.2, 1, 0.5
    gyro = np.array([[1000, 0, -500], [0, 0, 0]], dtype=np.int16)
    own = {"a_pwm": pwm, "a_gyro": gyro, "a_t0": 3.0, "rate": 100.0, "gyro_scale": 0.001}
    np.savez(tmp_path / "logs.npz", **own, a_battery=np.array([[3.0], [4.0]]))
    (log,) = read(tmp_path / "logs.npz", stand).values()
    assert log.time == pytest.approx([3.0, 3.01])
    assert log.motion["body_rate"] == pytest.approx(np.array([[1, 0, -0.5], [0, 0, 0]]))
    # 0, 0.2 of 3 V; 1, 0.5 of 4 V
    assert log.command == pytest.approx(np.array([[100, 220], [900, 500]]), rel=1e-4)


def test_measurements_agree_with_each_other(real):
    where, _ = real[flights.CAPTURED]
    truth = open_loop.measured(where)
    held = open_loop.hold(where)
    still = {name: np.repeat(part, 3, 0) for name, part in open_loop.measured(where, (0,)).items()}
    turned = Rotation.from_quat(held["quaternion"][1], scalar_first=True)
    now = Rotation.from_quat(still["quaternion"][1], scalar_first=True)
    # With other axes or signs in velocity or gyro than in the pose, standing still were nearer.
    backwards = (now * turned.inv() * now).as_quat(scalar_first=True)
    back = {**still, "position": 2 * still["position"] - held["position"]}
    back["quaternion"] = np.stack([backwards] * 3)
    for name in ("position", "attitude"):
        sizes = [open_loop.errors(motion, truth)[name][1] for motion in (held, still, back)]
        assert sizes == sorted(sizes) and sizes[2] > 2 * sizes[0], name


def compared(judged):
    """What is recorded of a set, and what comes now."""
    recorded = report.load("flights")
    for name, (where, _) in judged.items():
        fits = [row for row in recorded["fits"] if row["flights"] == name]
        before = [row for row in recorded["rows"] if row["flights"] == name]
        for now, then in zip(flights.judge(where, fits), before, strict=True):
            assert now["model"] == then["model"]
            for quantity in flights.UNITS:
                assert now[quantity] == pytest.approx(then[quantity], rel=1e-3), now["model"]


def test_real_flights_are_predicted_as_the_page_says(real):
    compared(real)


def replaced(vehicle, **changes):
    """An aircraft with changes to all rotors: factors."""
    rotors = (
        dataclasses.replace(r, **{k: getattr(r, k) * x for k, x in changes.items()})
        for r in vehicle.rotors
    )
    return dataclasses.replace(vehicle, rotors=tuple(rotors))


def swapped(vehicle):
    """An aircraft whose first two motors are connected the wrong way."""
    one, two, *others = vehicle.rotors
    return dataclasses.replace(vehicle, rotors=(two, one, *others))


def test_an_error_in_the_model_shows(real, monkeypatch):
    errors = {
        "half of k_T": lambda v: replaced(v, thrust_coefficient=0.5, max_speed=1.3),
        "two rotors swapped": swapped,
        "a lag twice as long": lambda v: replaced(v, lag_up=0.5, lag_down=0.5),
        "no dead time": lambda v: dataclasses.replace(v, dead_time=0.0),
    }
    for name, planted in errors.items():
        with monkeypatch.context() as patch:
            for model in ("CRAZYFLIE", "AIR", "BEGUN"):
                patch.setattr(flights, model, planted(getattr(flights, model)))
            with pytest.raises(AssertionError):
                compared({flights.BY_HAND: real[flights.BY_HAND]})
                pytest.fail(name)  # a planted error that nothing notices


def test_planted_errors_are_worse_than_holding_the_state(real):
    (captured, _), (by_hand, _) = real[flights.CAPTURED], real[flights.BY_HAND]

    def error(where, motion, quantity):
        return open_loop.errors(motion, open_loop.measured(where))[quantity][1]  # at 0.1 s

    def flown(where, vehicle, quantity):
        return error(where, open_loop.fly(vehicle, where), quantity)

    held = error(by_hand, open_loop.hold(by_hand), "body_rate")
    assert flown(by_hand, CRAZYFLIE, "body_rate") < held
    assert flown(by_hand, swapped(CRAZYFLIE), "body_rate") > held
    fits = report.load("flights")["fits"]
    found = next(row["factors"] for row in fits if row["flights"] == flights.CAPTURED)
    found = changed(flights.BEGUN, found)
    held = error(captured, open_loop.hold(captured), "velocity")
    assert flown(captured, found, "velocity") < held
    # Half of the thrust is half of gravity, 0.5 m/s after 0.1 s.
    assert (
        flown(captured, replaced(found, thrust_coefficient=0.5, max_speed=1.3), "velocity") > held
    )
