"""Bags of ROS 1 and 2, by rosbags. Topics are found by the types of their messages."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from quadrl.base.errors import QuadrlError
from quadrl.evaluation.logs.recording import Recording, together
from quadrl.evaluation.logs.table import COLUMNS

IMU, ODOMETRY = "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"
BATTERY = "sensor_msgs/msg/BatteryState"
MOTORS = ("std_msgs/msg/Float32MultiArray", "std_msgs/msg/Float64MultiArray")
UNITS = {
    unit.replace("/", "_"): (part, factor)
    for part in ("pwm", "rotor_speed")
    for unit, factor in COLUMNS[part][1].items()
}
"""What the last word of a topic of motors says, such as /motors/rpm: part and factor."""


def read_rosbag(path: Path) -> Iterator[Recording]:
    """Read the flight of a bag: Imu, Odometry, BatteryState, and motors as an array of numbers.

    The topic of the motors ends in what the numbers are: /pwm, /share, /rpm or /rad_s. Times are
    those of the headers, for arrays those of the bag. The twist of Odometry is in the body frame.
    """
    rows: dict[str, list[tuple[float, Any]]] = {}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
            for connection, stamp, raw in bag.messages():
                kind, word = connection.msgtype, connection.topic.rpartition("/")[2]
                if kind not in (IMU, ODOMETRY, BATTERY, *MOTORS):
                    continue
                message: Any = bag.deserialize(raw, kind)
                if kind in MOTORS:
                    if word in UNITS:
                        part, factor = UNITS[word]
                        rows.setdefault(part, []).append((stamp * 1e-9, message.data * factor))
                    continue
                time = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
                for part, value in _values(kind, message):
                    rows.setdefault(part, []).append((time, value))
    except (AnyReaderError, OSError) as error:
        raise QuadrlError(f"{path} is no bag that can be read: {error}") from None
    parts = {part: tuple(map(np.array, zip(*own, strict=True))) for part, own in rows.items()}
    if {"quaternion", "velocity"} <= {*parts}:
        turned = Rotation.from_quat(parts["quaternion"][1], scalar_first=True)
        parts["velocity"] = parts["velocity"][0], turned.apply(parts["velocity"][1])
    yield together(path.stem, parts)  # type: ignore[arg-type]


def _values(kind: str, message: Any) -> Iterator[tuple[str, Any]]:
    if kind == IMU:
        yield "body_rate", _numbers(message.angular_velocity)
        yield "acceleration", _numbers(message.linear_acceleration)
    elif kind == ODOMETRY:
        yield "position", _numbers(message.pose.pose.position)
        yield "quaternion", _numbers(message.pose.pose.orientation, "wxyz")
        yield "velocity", _numbers(message.twist.twist.linear)
    else:
        yield "battery", [message.voltage]


def _numbers(vector: Any, names: str = "xyz") -> list[float]:
    return [getattr(vector, name) for name in names]
