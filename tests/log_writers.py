"""Writers of the formats in which autopilots log, for logs of `excited`."""

import struct
import zlib

import numpy as np
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

FLIPPED = np.array([1.0, -1.0, -1.0])
RPM = 30 / np.pi


def write_ulog(path, log):
    """As PX4 does: north, east, down; ahead, right, down."""
    time = np.rint(log["t"] * 1e6).astype(np.uint64)
    sent = np.pad(log["pwm"], ((0, 0), (0, 8)), constant_values=np.nan)
    down = {k: log[k] * FLIPPED for k in ("body_rate", "acceleration", "position", "velocity")}
    topics = {
        "vehicle_angular_velocity": ("float[3] xyz", "3f", down["body_rate"]),
        "vehicle_acceleration": ("float[3] xyz", "3f", down["acceleration"]),
        "vehicle_attitude": ("float[4] q", "4f", log["quaternion"] * (1, *FLIPPED)),
        "vehicle_local_position": (
            *("float x;float y;float z;float vx;float vy;float vz", "6f"),
            np.concatenate([down["position"], down["velocity"]], axis=1),
        ),
        "battery_status": ("float voltage_v", "f", log["battery"]),
        "actuator_motors": ("float[12] control", "12f", sent),
    }
    out = [b"ULog\x01\x12\x35\x01", struct.pack("<Q", 0)]

    def message(kind, content):
        out.append(struct.pack("<HB", len(content), ord(kind)) + content)

    message("B", bytes(40))
    for name, (fields, _, _) in topics.items():
        message("F", f"{name}:uint64_t timestamp;{fields};".encode())
    message("F", b"esc_report:uint64_t timestamp;int32_t esc_rpm;")
    message("F", b"esc_status:uint64_t timestamp;esc_report[8] esc;")
    for k, name in enumerate([*topics, "esc_status"]):
        message("A", struct.pack("<BH", 0, k) + name.encode())
    rpm = np.rint(log["rotor_speed"] * RPM).astype(int)
    for row, now in enumerate(time):
        for k, (_, form, values) in enumerate(topics.values()):
            message("D", struct.pack(f"<HQ{form}", k, now, *values[row]))
        reports = [x for one in (*rpm[row], 0, 0, 0, 0) for x in (int(now), int(one))]
        message("D", struct.pack("<HQ" + "Qi" * 8, len(topics), now, *reports))
    path.write_bytes(b"".join(out))


def write_microsd(path, log, version=2):
    """As a Crazyflie does, with its variables in two events."""
    roll = Rotation.from_quat(log["quaternion"], scalar_first=True).as_euler("ZYX")[:, ::-1]
    state = np.concatenate([log["position"], log["velocity"]], axis=1)
    events = {
        "fixedFrequency": {
            **dict(
                zip((f"gyro.{x}(f)" for x in "xyz"), np.rad2deg(log["body_rate"]).T, strict=True)
            ),
            **dict(zip((f"acc.{x}(f)" for x in "xyz"), log["acceleration"].T / 9.81, strict=True)),
            **{f"motor.m{k + 1}(H)": np.rint(65535 * log["pwm"][:, k]) for k in range(4)},
            **{f"rpm.m{k + 1}(H)": np.rint(RPM * log["rotor_speed"][:, k]) for k in range(4)},
            "pm.vbat(f)": log["battery"][:, 0],
        },
        "estimated": {
            **dict(
                zip(
                    (f"stateEstimate.{x}(f)" for x in "x y z vx vy vz".split()),
                    state.T,
                    strict=True,
                )
            ),
            **dict(
                zip(
                    (f"stateEstimate.{x}(f)" for x in ("roll", "pitch", "yaw")),
                    (np.rad2deg(roll) * (1, -1, 1)).T,
                    strict=True,
                )
            ),
        },
    }
    out = [struct.pack("<BHH", 0xBC, version, len(events))]
    forms = []
    for k, (name, variables) in enumerate(events.items()):
        names = b"".join(one.encode() + b"\0" for one in variables)
        out.append(struct.pack("<H", k) + name.encode() + b"\0")
        out.append(struct.pack("<H", len(variables)) + names)
        forms.append("".join(one[-2] for one in variables))
    tables = [np.stack([*variables.values()], axis=1) for variables in events.values()]
    for row, now in enumerate(log["t"]):
        for k, (form, table) in enumerate(zip(forms, tables, strict=True)):
            clock = round(now * (1e6 if version == 2 else 1e3))
            cells = [int(x) if kind == "H" else x for kind, x in zip(form, table[row], strict=True)]
            out.append(struct.pack("<HQ" if version == 2 else "<HI", k, clock))
            out.append(struct.pack("<" + form, *cells))
    data = b"".join(out)
    path.write_bytes(data + struct.pack("<I", zlib.crc32(data)))


def write_blackbox(path, log):
    """As Betaflight does, with whole frames alone: no pose."""
    low, high, poles = 158, 2047, 12
    columns = {
        "loopIteration": np.arange(len(log["t"])),
        "time": log["t"] * 1e6,
        **{f"gyroADC[{k}]": np.rad2deg(log["body_rate"][:, k]) for k in range(3)},
        **{f"accSmooth[{k}]": log["acceleration"][:, k] / 9.81 * 2048 for k in range(3)},
        "vbatLatest": log["battery"][:, 0] * 100,
        **{f"motor[{k}]": low + (high - low) * log["pwm"][:, k] for k in range(4)},
        **{f"eRPM[{k}]": log["rotor_speed"][:, k] * RPM * poles / 2 / 100 for k in range(4)},
    }
    signed = [name.startswith(("gyro", "acc")) for name in columns]
    head = [
        "Product:Blackbox flight data recorder by Nicholas Sherlock",
        "Data version:2",
        "I interval:1",
        "P interval:1/1",
        "Field I name:" + ",".join(columns),
        "Field I signed:" + ",".join(str(int(x)) for x in signed),
        "Field I predictor:" + ",".join("0" for _ in columns),
        "Field I encoding:" + ",".join("0" if x else "1" for x in signed),
        "acc_1G:2048",
        f"motorOutput:{low},{high}",
        f"motor_poles:{poles}",
    ]
    out = ["".join(f"H {line}\n" for line in head).encode()]
    for row in np.stack([np.rint(x).astype(int) for x in columns.values()], axis=1).tolist():
        whole = [
            (2 * x if x >= 0 else -2 * x - 1) if s else x for x, s in zip(row, signed, strict=True)
        ]
        out.append(b"I" + b"".join(map(_variable, whole)))
    path.write_bytes(b"".join(out) + b"E\xffEnd of log\0")


def _variable(number):
    """Seven bits a byte, the last without the eighth."""
    out = bytearray()
    while number >= 128:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes([*out, number])


def write_rosbag(path, log):
    """As ROS 2 does."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    stamp, header = kinds["builtin_interfaces/msg/Time"], kinds["std_msgs/msg/Header"]
    vector, point = kinds["geometry_msgs/msg/Vector3"], kinds["geometry_msgs/msg/Point"]
    turned = kinds["geometry_msgs/msg/Quaternion"]
    pose, twist = kinds["geometry_msgs/msg/Pose"], kinds["geometry_msgs/msg/Twist"]
    nine, many = np.zeros(9), np.zeros(36)
    inverse = Rotation.from_quat(log["quaternion"], scalar_first=True).inv()
    body = inverse.apply(log["velocity"])

    def imu(row, head):
        rate, acc = vector(*log["body_rate"][row]), vector(*log["acceleration"][row])
        return kinds["sensor_msgs/msg/Imu"](head, turned(0, 0, 0, 1), nine, rate, nine, acc, nine)

    def odometry(row, head):
        w, x, y, z = log["quaternion"][row]
        place = pose(point(*log["position"][row]), turned(x, y, z, w))
        moves = twist(vector(*body[row]), vector(0, 0, 0))
        with_pose = kinds["geometry_msgs/msg/PoseWithCovariance"](place, many)
        with_twist = kinds["geometry_msgs/msg/TwistWithCovariance"](moves, many)
        return kinds["nav_msgs/msg/Odometry"](head, "base_link", with_pose, with_twist)

    def motors(values):
        layout = kinds["std_msgs/msg/MultiArrayLayout"]([], 0)
        return lambda row, _: kinds["std_msgs/msg/Float64MultiArray"](layout, values[row])

    topics = {
        "/imu": ("sensor_msgs/msg/Imu", imu),
        "/odometry": ("nav_msgs/msg/Odometry", odometry),
        "/motors/share": ("std_msgs/msg/Float64MultiArray", motors(log["pwm"])),
        "/motors/rpm": ("std_msgs/msg/Float64MultiArray", motors(log["rotor_speed"] * RPM)),
    }
    with Writer(path, version=9) as bag:
        for topic, (kind, make) in topics.items():
            connection = bag.add_connection(topic, kind, typestore=store)
            for row, now in enumerate(log["t"]):
                nanoseconds = round(now * 1e9)
                seconds, rest = divmod(nanoseconds, 10**9)
                message = make(row, header(stamp(seconds, rest), "world"))
                bag.write(connection, nanoseconds, store.serialize_cdr(message, kind))
