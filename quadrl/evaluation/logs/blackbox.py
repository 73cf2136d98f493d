"""Blackbox of Betaflight, by orangebox. Its axes are ours: x ahead, y left, z up."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from orangebox import Parser

from quadrl.aircraft.rotors import GRAVITY
from quadrl.base.errors import QuadrlError
from quadrl.evaluation.logs.recording import Recording, together

FIELDS = {
    "body_rate": "gyroADC",
    "acceleration": "accSmooth",
    "pwm": "motor",
    "rotor_speed": "eRPM",
}
"""Fields with an index, by what they are part of."""
KNOWN = {*FIELDS.values(), "vbatLatest"}


def read_blackbox(path: Path) -> Iterator[Recording]:
    """Read the flights of a file: gyro and motors, and where there accelerometer, eRPM, battery."""
    logging.getLogger("orangebox").setLevel(logging.ERROR)
    try:
        parser = Parser.load(str(path))
        count = parser.reader.log_count
        for number in range(1, count + 1):
            parser.set_log_index(number)
            name = path.stem if count == 1 else f"{path.stem}_{number}"
            frames: list[Any] = []
            with contextlib.suppress(IndexError, TypeError, RuntimeError):  # cut off: no power
                frames.extend(frame.data for frame in parser.frames())
            yield _recording(name, parser.headers, parser.field_names, frames)
    except (IndexError, KeyError, TypeError, ValueError, RuntimeError) as error:
        if isinstance(error, QuadrlError):
            raise
        raise QuadrlError(f"{path} is a damaged blackbox log: {error!r}") from None


def _recording(name: str, headers: Any, names: list[str], frames: list[Any]) -> Recording:
    wanted = {n: k for k, n in enumerate(names) if n == "time" or n.partition("[")[0] in KNOWN}
    rows = np.array([[frame[k] for k in wanted.values()] for frame in frames], dtype=float)
    columns = dict(zip(wanted, rows.reshape(-1, len(wanted)).T, strict=True))
    time = columns["time"] * 1e-6
    low, high = headers["motorOutput"]
    fine = 10 if headers.get("blackbox_high_resolution") else 1
    scale = {
        "body_rate": math.pi / 180 / fine,
        "acceleration": GRAVITY / headers.get("acc_1G", 2048),
        "pwm": 1 / (high - low),
        # Hundreds of electrical turns a minute, of as many pairs of poles.
        "rotor_speed": 100 * 2 / headers.get("motor_poles", 14) * math.pi / 30,
    }
    parts: dict[str, tuple[Any, Any]] = {}
    for part, field in FIELDS.items():
        own = [columns[f"{field}[{k}]"] for k in range(8) if f"{field}[{k}]" in columns]
        if own:
            values = np.stack(own, axis=1) - (low if part == "pwm" else 0)
            parts[part] = time, np.maximum(values, 0 if part == "pwm" else -np.inf) * scale[part]
    if "vbatLatest" in columns:
        parts["battery"] = time, columns["vbatLatest"] * 0.01
    return together(name, parts)
