"""ULog of PX4, by pyulog. Its axes are north, east, down, and ahead, right, down."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pyulog import ULog

from quadrl.base.errors import QuadrlError
from quadrl.evaluation.logs.recording import FLIPPED, Recording, together

TOPICS = {
    "body_rate": ("vehicle_angular_velocity", "xyz[0] xyz[1] xyz[2]"),
    "acceleration": ("vehicle_acceleration", "xyz[0] xyz[1] xyz[2]"),
    "position": ("vehicle_local_position", "x y z"),
    "velocity": ("vehicle_local_position", "vx vy vz"),
    "quaternion": ("vehicle_attitude", "q[0] q[1] q[2] q[3]"),
    "battery": ("battery_status", "voltage_v"),
    "pwm": ("actuator_motors", " ".join(f"control[{k}]" for k in range(8))),
    "rotor_speed": ("esc_status", " ".join(f"esc[{k}].esc_rpm" for k in range(8))),
}
"""Topic and its fields, by what they are part of."""


def read_ulog(path: Path) -> Iterator[Recording]:
    """Read the flight of a file; motors that were never driven are none.

    The world then has x north, y west and z up.
    """
    try:
        found = ULog(str(path), sorted({topic for topic, _ in TOPICS.values()})).data_list
    except Exception as error:  # whatever a damaged file makes of it
        raise QuadrlError(f"{path} is a damaged ULog: {error!r}") from None
    topics = {one.name: one.data for one in found if one.multi_id == 0}
    parts: dict[str, tuple[Any, Any]] = {}
    for part, (topic, names) in TOPICS.items():
        own = topics.get(topic, {})
        columns = [own[name] for name in names.split() if name in own]
        if part in ("pwm", "rotor_speed"):
            columns = [x for x in columns if np.nan_to_num(x).any()]
        if columns:
            parts[part] = own["timestamp"] * 1e-6, np.stack(columns, axis=1)
    for part in ("body_rate", "acceleration", "position", "velocity"):
        if part in parts:
            parts[part] = parts[part][0], parts[part][1] * FLIPPED
    if "quaternion" in parts:
        parts["quaternion"] = parts["quaternion"][0], parts["quaternion"][1] * (1, *FLIPPED)
    if "rotor_speed" in parts:
        parts["rotor_speed"] = parts["rotor_speed"][0], parts["rotor_speed"][1] * math.pi / 30
    yield together(path.stem, parts)
