"""Binary logs of a Crazyflie's microSD deck.

Byte 0xBC; uint16 version, 1 or 2; uint16 number of events; for each event uint16 id, its name,
uint16 number of variables, and their names with the letter of their type as in Python's struct,
"gyro.x(f)"; names end in a zero byte. Then events: uint16 id; time, uint32 [ms] or in version 2
uint64 [us]; the variables. At the end a CRC-32 of all. All is little-endian.
"""

from __future__ import annotations

import contextlib
import math
import struct
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.aircraft.rotors import GRAVITY
from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.evaluation.logs.recording import Recording, together
from quadrl.evaluation.logs.table import DEGREE, FULL_PWM

VARIABLES: dict[str, tuple[str, Any]] = {
    "body_rate": ("gyro.x gyro.y gyro.z", DEGREE),
    "acceleration": ("acc.x acc.y acc.z", GRAVITY),
    "position": ("stateEstimate.x stateEstimate.y stateEstimate.z", 1.0),
    "velocity": ("stateEstimate.vx stateEstimate.vy stateEstimate.vz", 1.0),
    "quaternion": (" ".join(f"stateEstimate.q{x}" for x in "wxyz"), 1.0),
    # Its pitch is positive nose up.
    "angles": (
        "stateEstimate.roll stateEstimate.pitch stateEstimate.yaw",
        np.array([DEGREE, -DEGREE, DEGREE]),
    ),
    "pwm": ("motor.m1 motor.m2 motor.m3 motor.m4", 1 / FULL_PWM),
    "rotor_speed": ("rpm.m1 rpm.m2 rpm.m3 rpm.m4", math.pi / 30),
    "battery": ("pm.vbat", 1.0),
}
"""Variables and what a number of them is in SI units, by what they are part of."""


def read_microsd(path: Path) -> Iterator[Recording]:
    """Read the flight of a file; variables of a part may be in any one event."""
    data = path.read_bytes()
    if zlib.crc32(data[:-4]) != int.from_bytes(data[-4:], "little"):
        text = (
            f"{path}: the checksum is wrong, as of a log that was cut off; read as far as it goes"
        )
        warnings.warn(text, QuadrlWarning, stacklevel=2)
    try:
        events = _events(data)
    except (struct.error, KeyError, ValueError) as error:
        raise QuadrlError(f"{path} is no log of a microSD deck: {error!r}") from None
    parts: dict[str, tuple[Any, Any]] = {}
    for part, (names, factor) in VARIABLES.items():
        for time, columns in events:
            if all(name in columns for name in names.split()):
                values = np.stack([columns[name] for name in names.split()], axis=1)
                parts[part] = time, values * factor
    yield together(path.stem or path.name, parts)


def _events(data: bytes) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Times (n,) [s] and variables (n,) by name, of each event."""
    _, version, count = struct.unpack_from("<BHH", data)
    if version not in (1, 2):
        raise ValueError(f"version {version}")
    head, place = "<HI" if version == 1 else "<HQ", 5
    forms_at = struct.calcsize(head)
    names: dict[int, list[str]] = {}
    forms: dict[int, struct.Struct] = {}
    rows: dict[int, list[tuple[Any, ...]]] = {}

    def text() -> str:
        nonlocal place
        end = data.index(0, place)
        found, place = data[place:end].decode(), end + 1
        return found

    for _ in range(count):
        (event,) = struct.unpack_from("<H", data, place)
        place += 2
        text()
        (many,) = struct.unpack_from("<H", data, place)
        place += 2
        variables = [text() for _ in range(many)]
        names[event] = [name[:-3] for name in variables]
        forms[event] = struct.Struct("<" + "".join(name[-2] for name in variables))
        rows[event] = []
    while place < len(data) - 4:
        event = int.from_bytes(data[place : place + 2], "little")
        with contextlib.suppress(struct.error):  # the last one may be cut off
            _, time = struct.unpack_from(head, data, place)
            rows[event].append((time, *forms[event].unpack_from(data, place + forms_at)))
        place += forms_at + forms[event].size
    tables = {event: np.array(own, dtype=float) for event, own in rows.items() if own}
    second = 1e-3 if version == 1 else 1e-6
    return [
        (table[:, 0] * second, dict(zip(names[event], table[:, 1:].T, strict=True)))
        for event, table in tables.items()
    ]
