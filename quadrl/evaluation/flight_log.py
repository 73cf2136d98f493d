"""Logs of real flights, as `open_loop` flies them again; docs/data has some, with their sources.

The world frame has z up; the body frame x forward, y left and z up.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from quadrl.aircraft.command_map import CommandMap
from quadrl.base.errors import QuadrlError
from quadrl.evaluation.logs.recording import Recording
from quadrl.evaluation.logs.table import read_npz
from quadrl.evaluation.stand import stand_map

MOTION = ("position", "quaternion", "velocity", "body_rate")
"""[m] and [m/s], world frame; (w, x, y, z) from body to world; [rad/s], body frame."""


@dataclasses.dataclass(frozen=True)
class FlightLog:
    """A flight as it was logged, T samples."""

    name: str
    time: np.ndarray  # (T,) [s], rising
    command: np.ndarray  # (T, R) rotor speeds that were asked for [rad/s], in the aircraft's order
    motion: Mapping[str, np.ndarray]
    """Arrays (T, k) by the names of MOTION: of all four, or of the body rate alone."""
    rotor_speed: np.ndarray | None = None
    """(T, R) as measured [rad/s]; where they are there, they fly in place of the commands."""


def read(path: Path, stand: Path) -> dict[str, FlightLog]:
    """Read the flights of an archive of docs/data by name.

    Args:
        path: An npz file; README.txt of docs/data says which arrays it holds.
        stand: Table of a thrust stand, whose line makes rotor speeds of commands: over PWM times
            voltage, over PWM alone where a flight has no voltage.
    """
    logs = (flown(one, stand_map(stand, one.battery is not None)) for one in read_npz(path))
    return {log.name: log for log in logs}


def flown(recording: Recording, command_map: CommandMap | None) -> FlightLog:
    """Make of a recording what `open_loop` flies: with its commands, or by its measured speeds.

    Raises:
        QuadrlError: It has neither rotor speeds, nor commands and what they mean.
    """
    speeds, motion = recording.rotor_speed, recording.motion
    if not {"quaternion", "velocity"} <= {*motion}:
        motion = {"body_rate": motion["body_rate"]}
    command = speeds
    if recording.pwm is not None and command_map is not None:
        battery = 0.0 if recording.battery is None else recording.battery
        command = command_map.speed(recording.pwm, battery)
    if command is None:
        raise QuadrlError(
            f"{recording.name} has motor commands and no rotor speeds: what a command means is "
            "unknown; give --stand, the table of a thrust stand, or a log with rotor speeds"
        )
    return FlightLog(recording.name, recording.time, command, motion, speeds)
