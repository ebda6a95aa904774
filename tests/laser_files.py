"""Small laser logs for tests: CARMEN lines, and bags written by rosbags' own writers (the readers' oracle)."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from kalmap.records import Odometry, Scan

SCAN, ODOM, TF = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
KINDS = ("bag", "sqlite3", "mcap")


def spelt(values) -> str:
    """Numbers as text that reads back bit for bit."""
    return " ".join(repr(float(value)) for value in values)


def flaser(ranges, pose, time, laser=None) -> str:
    """A FLASER line."""
    laser = pose if laser is None else laser
    return f"FLASER {len(ranges)} {spelt(ranges)} {spelt(laser)} {spelt(pose)} {time!r} host {time!r}"


def odom(pose, time) -> str:
    """An ODOM line."""
    return f"ODOM {spelt(pose)} 0 0 0 {time!r} host {time!r}"


def write(path: Path, lines, end="\n") -> Path:
    """A text file of lines."""
    path.write_text("\n".join(lines) + end)
    return path


def pairs(log, skip=None) -> tuple[list[Odometry], list[Scan]]:
    """The odometry and the scans of a log, which must come in turns, in order of time."""
    events = list(log.open(skip))
    moves, scans = events[::2], events[1::2]
    assert all(isinstance(event, Odometry) for event in moves)
    assert all(isinstance(event, Scan) for event in scans)
    assert [move.time for move in moves] == [scan.time for scan in scans]
    assert all(a.time <= b.time for a, b in pairwise(scans))
    return moves, scans


def transform(pose) -> np.ndarray:
    """(3, 3) homogeneous: the oracle of poses composed."""
    x, y, a = pose
    return np.array([[np.cos(a), -np.sin(a), x], [np.sin(a), np.cos(a), y], [0.0, 0.0, 1.0]])


def increment(before, after) -> np.ndarray:
    """(3,) `after` seen from `before`, by matrices."""
    T = np.linalg.inv(transform(before)) @ transform(after)
    return np.array([T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])])


def yaw(angle: float) -> tuple[float, float, float, float]:
    """Quaternion x, y, z, w of a turn about the vertical."""
    return 0.0, 0.0, float(np.sin(angle / 2)), float(np.cos(angle / 2))


class Message(NamedTuple):
    """topic, type, and what the message holds; recorded: s, when it was recorded."""

    topic: str
    kind: str
    stamp: float
    frame: str
    data: dict[str, Any]
    recorded: float | None = None


def scan(stamp, ranges, frame="laser", topic="/scan", recorded=None, **other) -> Message:
    """A LaserScan; by default a degree a beam from -90 degrees, 0.1 to 30 m."""
    data = {"start": np.deg2rad(-90), "step": np.deg2rad(1), "low": 0.1, "high": 30.0, "bits": ()} | other
    return Message(topic, SCAN, stamp, frame, {"ranges": ranges, **data}, recorded)


def odometry(stamp, pose, topic="/odom", recorded=None, quaternion=None) -> Message:
    """An Odometry of base_link in odom."""
    x, y, a = pose
    return Message(topic, ODOM, stamp, "odom", {"place": (x, y, 0.0), "turn": quaternion or yaw(a)}, recorded)


def tf(stamp, parent, child, place, turn, topic="/tf", recorded=None) -> Message:
    """A transform."""
    return Message(topic, TF, stamp, parent, {"child": child, "place": place, "turn": turn}, recorded)


def still(messages, parent="base_link", child="laser", place=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0, 1.0)):
    """The messages, and before them a static transform."""
    return [tf(0.0, parent, child, place, turn, "/tf_static", recorded=0.0), *messages]


def arc(t):
    """A drive along a circle of 2 m radius at 0.5 m/s, from t = 100 s on."""
    a = 0.25 * (t - 100.0)
    return 2 * np.sin(a), 2 * (1 - np.cos(a)), a


def drive(count=6, beams=9, seed=3, **kind):
    """Odometry at 100.0, 100.1, ... and scans in between, of random float32 ranges."""
    rng, messages = np.random.default_rng(seed), []
    for k in range(count):
        messages.append(odometry(100 + k / 10, arc(100 + k / 10)))
        if k + 1 < count:
            ranges = rng.uniform(0.2, 29, beams).astype(np.float32)
            messages.append(scan(100.03 + k / 10, ranges, **kind))
    return messages


def jumped(shift):
    """A drive whose clock jumps after the third scan, in scans and odometry alike."""
    return [m._replace(stamp=m.stamp + (shift if k > 5 else 0.0)) for k, m in enumerate(drive(10))]


def write_bag(folder: Path, kind: str, messages: list[Message], name: str = "drive") -> Path:
    """A ROS 1 bag, or a ROS 2 bag with sqlite3 or MCAP; recorded in the order of the list unless told otherwise."""
    if kind == "bag":
        store = get_typestore(Stores.ROS1_NOETIC)
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
        path = folder / f"{name}.bag"
        writer: Any = Writer1(path)
    else:
        store = get_typestore(Stores.ROS2_HUMBLE)
        path = folder / f"{name}-{kind}"
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    serialize = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
    with writer:
        connections: dict[str, Any] = {}
        for number, message in enumerate(messages):
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.kind, typestore=store
                )
            recorded = 1000.0 + number if message.recorded is None else message.recorded
            body = serialize(_built(store, message, kind == "bag"), message.kind)
            writer.write(connections[message.topic], int(recorded * 1e9), body)
    return path


def _built(store, message: Message, first: bool):
    types, data = store.types, message.data
    nanoseconds = round(message.stamp * 1e9)
    time = types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    sequence = {"seq": 0} if first else {}
    header = types["std_msgs/msg/Header"](stamp=time, frame_id=message.frame, **sequence)
    if message.kind == SCAN:
        beams = len(data["ranges"])
        return types[SCAN](
            header=header,
            angle_min=data["start"],
            angle_max=data["start"] + data["step"] * (beams - 1),
            angle_increment=data["step"],
            time_increment=0.0,
            scan_time=0.1,
            range_min=data["low"],
            range_max=data["high"],
            ranges=np.asarray(data["ranges"], dtype=np.float32),
            intensities=np.asarray(data["bits"], dtype=np.float32),
        )
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    turn = quaternion(*data["turn"])
    if message.kind == TF:
        body = types["geometry_msgs/msg/Transform"](translation=vector(*data["place"]), rotation=turn)
        stamped = types["geometry_msgs/msg/TransformStamped"](
            header=header, child_frame_id=data["child"], transform=body
        )
        return types[TF](transforms=[stamped])
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](*data["place"]), orientation=turn
    )
    twist = types["geometry_msgs/msg/Twist"](linear=vector(0.0, 0.0, 0.0), angular=vector(0.0, 0.0, 0.0))
    return types[ODOM](
        header=header,
        child_frame_id="base_link",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )
