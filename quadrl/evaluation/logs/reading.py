"""Reads logs of any known format."""

from __future__ import annotations

import importlib
from pathlib import Path

from quadrl.base.errors import QuadrlError
from quadrl.base.extras import needed
from quadrl.evaluation.logs.recording import Recording, reordered

FORMATS = {
    b"PK": "table read_npz",
    b"ULog": "ulog read_ulog",
    b"H Product:Blackbox": "blackbox read_blackbox",
    b"\xbc": "microsd read_microsd",
    b"#ROSBAG": "rosbag read_rosbag",
    b"\x89MCAP": "rosbag read_rosbag",
}
"""Module and function by what files begin with; folders are bags of ROS 2, all others tables."""
KINDS = "csv, npz, ULog, Betaflight blackbox, rosbag, or binary of a Crazyflie's microSD card"


def read_log(path: Path, motors: str = "") -> list[Recording]:
    """Read the flights of a log.

    Args:
        path: The file; a folder for a bag of ROS 2.
        motors: Numbers of the log's motors in the order of the aircraft's, such as "4,1,3,2"; empty
            if they are in that order.

    Raises:
        QuadrlError: There is no such file, it is of no known format, or it lacks what flies.
        MissingLibrary: The library of the format is not installed.
    """
    if not path.exists():
        raise QuadrlError(name="log", value=str(path), allowed=f"a file: {KINDS}")
    if path.is_dir():
        found = "rosbag read_rosbag"
    else:
        with open(path, "rb") as file:
            begins = file.read(32)
        found = next((x for k, x in FORMATS.items() if begins.startswith(k)), "table read_csv")
    module, function = found.split()
    with needed(f"reading {path.name}"):
        read = getattr(importlib.import_module(f"quadrl.evaluation.logs.{module}"), function)
        logs = list(read(path))
    if not motors:
        return logs
    try:
        order = [int(k) for k in motors.split(",")]
    except ValueError:
        order = []
    if not order or sorted(order) != list(range(1, len(order) + 1)):
        allowed = "each of the numbers 1, 2 and so on once, such as 4,1,3,2"
        raise QuadrlError(name="motors", value=motors, allowed=allowed)
    return [reordered(log, order) for log in logs]
