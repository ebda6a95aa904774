"""What a ROS 1 bag or a ROS 2 bag (sqlite3 or MCAP) holds for a drive: laser scans, odometry, transforms.

Only header stamps are used: the time of recording comes from another clock. Read by `rosbags`, without ROS.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kalmap.data.ros_frames import Edge, Edges, bare, matrix
from kalmap.data.streams import Malformed
from kalmap.data.text import reason
from kalmap.records import LogError

SCAN = "sensor_msgs/msg/LaserScan"
POSE = "nav_msgs/msg/Odometry"
TRANSFORM = "tf2_msgs/msg/TFMessage"
TRANSFORMS = (TRANSFORM, "tf/msg/tfMessage")
METADATA = "metadata.yaml"


class _Unreadable(Exception):
    """A message that is not what its type says."""


class ScanMessage(msgspec.Struct, frozen=True):
    """A LaserScan. number: of the message on its topic, from 1; order: its place in the bag. faults come as `fault`."""

    number: int
    order: int
    stamp: float = float("nan")
    frame: str = ""
    start: float = 0.0
    step: float = 0.0
    low: float = 0.0
    high: float = 0.0
    ranges: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(0, dtype=np.float32))
    intensities: np.ndarray | None = None
    fault: Malformed | None = None


class PoseMessage(msgspec.Struct, frozen=True):
    """An Odometry. T: (4, 4) the robot in the odometry's frame, None if it is not to be used."""

    number: int
    order: int
    stamp: float = float("nan")
    child: str = ""
    T: np.ndarray | None = None


class Bag(msgspec.Struct, frozen=True):
    """The messages of a bag that a drive is made of.

    scan_topic, odometry_topic: those that were taken; the latter is a topic of transforms where `poses` is None.
    """

    file: str
    topics: dict[str, tuple[str, int]]
    scan_topic: str
    odometry_topic: str
    scans: list[ScanMessage]
    poses: list[PoseMessage] | None
    edges: Edges
    notes: tuple[str, ...]


def is_bag(path: Path) -> bool:
    """Whether a file is a bag by its name, or a folder by the metadata of a ROS 2 bag in it."""
    if path.is_dir():
        return (path / METADATA).is_file()
    return path.suffix in (".bag", ".db3", ".mcap") or path.name == METADATA


def read_bag(path: Path, scan_topic: str | None = None, odometry_topic: str | None = None) -> Bag:
    """Read a bag, choosing the topics that are not named.

    Raises LogError if it cannot be read, or if scans, odometry or a named topic are missing; it lists what is there.
    """
    with _opened(path) as (reader, parse):
        topics = {
            name: (info.msgtype or "several types", info.msgcount) for name, info in reader.topics.items()
        }
        scans_from, notes = _choose_scans(path, topics, scan_topic)
        poses_from, more = _choose_odometry(path, topics, odometry_topic)
        wanted = [
            connection
            for connection in reader.connections
            if connection.topic in (scans_from, poses_from) or connection.msgtype in TRANSFORMS
        ]
        scans: list[ScanMessage] = []
        poses: list[PoseMessage] = []
        transforms: dict[tuple[str, str], list[tuple[float, int, np.ndarray]]] = {}
        for order, (connection, _, raw) in enumerate(reader.messages(connections=wanted)):
            kind = connection.msgtype
            if connection.topic == scans_from:
                scans.append(_scan(parse, raw, len(scans) + 1, order))
            elif kind == POSE:
                poses.append(_pose(parse, raw, len(poses) + 1, order))
            else:
                _add_transforms(parse, raw, order, transforms)
    edges = {
        pair: Edge(
            stamps=np.array([stamp for stamp, _, _ in found]),
            orders=np.array([order for _, order, _ in found]),
            matrices=np.array([T for _, _, T in found]),
        )
        for pair, found in transforms.items()
    }
    by_topic = topics[poses_from][0] == POSE
    return Bag(
        str(path), topics, scans_from, poses_from, scans, poses if by_topic else None, edges, notes + more
    )


def contents(topics: dict[str, tuple[str, int]]) -> str:
    """The topics of a bag, as a message lists them."""
    if not topics:
        return "the bag is empty"
    return "it holds " + ", ".join(
        f"{name} ({kind}, {count})" for name, (kind, count) in sorted(topics.items())
    )


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Callable[[bytes, str], Any]]]:
    """A reader, and how to parse its messages. Whatever the library says of a damaged file becomes a LogError."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.serde import SerdeError
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise LogError(f"bags need the package rosbags: {error}", file=path) from error
    first = path.suffix == ".bag"
    # The messages used here have the same layout in all releases, so that strange types beside them do no harm.
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    if first:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORM))
    parse = store.deserialize_ros1 if first else store.deserialize_cdr

    def parsed(raw: bytes, kind: str) -> Any:
        try:
            return parse(raw, kind)
        except (SerdeError, AssertionError, IndexError) as error:
            raise _Unreadable(f"cannot be read as {kind}: {reason(error)}") from error

    try:
        with (Reader1 if first else Reader2)(path) as reader:
            yield reader, parsed
    except LogError:
        raise
    except Exception as error:  # the library, its decompressors and its databases each have their own errors
        raise LogError(f"cannot be read as a bag: {reason(error)}", file=path) from error


def _choose_scans(
    path: Path, topics: dict[str, tuple[str, int]], wanted: str | None
) -> tuple[str, tuple[str, ...]]:
    found = {name: count for name, (kind, count) in topics.items() if kind == SCAN and count}
    if wanted is not None:
        return _named(path, topics, wanted, set(found), "scan_topic", "laser scans"), ()
    if not found:
        raise LogError(f"no laser scans ({SCAN}); {contents(topics)}", file=path, field="scan_topic")
    chosen = "/scan" if "/scan" in found else max(sorted(found), key=found.__getitem__)
    return chosen, _said(chosen, found, "laser scans", "--scan-topic")


def _choose_odometry(
    path: Path, topics: dict[str, tuple[str, int]], wanted: str | None
) -> tuple[str, tuple[str, ...]]:
    found = {name: count for name, (kind, count) in topics.items() if kind == POSE and count}
    trees = {name: count for name, (kind, count) in topics.items() if kind in TRANSFORMS and count}
    if wanted is not None:
        return _named(path, topics, wanted, {*found, *trees}, "odometry_topic", "odometry or transforms"), ()
    if found:
        chosen = "/odom" if "/odom" in found else max(sorted(found), key=found.__getitem__)
        return chosen, _said(chosen, found, "odometry", "--odometry-topic")
    if not trees:
        problem = f"no odometry, neither {POSE} nor transforms; {contents(topics)}"
        raise LogError(problem, file=path, field="odometry_topic")
    return ("/tf" if "/tf" in trees else max(sorted(trees), key=trees.__getitem__)), ()


def _named(
    path: Path, topics: dict[str, tuple[str, int]], wanted: str, fitting: set[str], field: str, what: str
) -> str:
    name = wanted if wanted in topics else "/" + wanted
    if name in fitting:
        return name
    problem = f"{wanted} holds no {what}" if name in topics else f"no topic {wanted}"
    raise LogError(f"{problem}; {contents(topics)}", file=path, field=field)


def _said(chosen: str, found: dict[str, int], what: str, option: str) -> tuple[str, ...]:
    others = [f"{name} ({count})" for name, count in sorted(found.items()) if name != chosen]
    if not others:
        return ()
    return (
        f"several topics of {what}: {chosen} ({found[chosen]}) is read, not {', '.join(others)}; see {option}",
    )


def _stamp(header: Any) -> float:
    """s. One division, so that the result is the double nearest to the stamp."""
    return (int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)) / 1e9


def _scan(parse: Callable[[bytes, str], Any], raw: bytes, number: int, order: int) -> ScanMessage:
    try:
        message = parse(raw, SCAN)
    except _Unreadable as error:
        return ScanMessage(number, order, fault=Malformed("message", str(error)))
    beams = len(message.ranges)
    start, step = float(message.angle_min), float(message.angle_increment)
    low, high = float(message.range_min), float(message.range_max)
    fault = None
    if not beams:
        fault = Malformed("ranges", "holds no ranges")
    elif not np.isfinite([start, step]).all() or (beams > 1 and step == 0):
        fault = Malformed("angle_increment", f"expected angles, found {start} and a step of {step} rad")
    elif np.isnan([low, high]).any():
        fault = Malformed("range_max", f"expected the scanner's range, found {low} to {high} m")
    return ScanMessage(
        number=number,
        order=order,
        stamp=_stamp(message.header),
        frame=bare(message.header.frame_id),
        start=start,
        step=step,
        low=low,
        high=high if high > 0 else np.inf,
        ranges=np.array(message.ranges),
        intensities=np.array(message.intensities) if len(message.intensities) == beams else None,
        fault=fault,
    )


def _pose(parse: Callable[[bytes, str], Any], raw: bytes, number: int, order: int) -> PoseMessage:
    try:
        message = parse(raw, POSE)
    except _Unreadable:  # reported by the drive: a message without a pose
        return PoseMessage(number, order)
    pose = message.pose.pose
    T = matrix(_vector(pose.position), _quaternion(pose.orientation))
    return PoseMessage(number, order, _stamp(message.header), bare(message.child_frame_id), T)


def _add_transforms(
    parse: Callable[[bytes, str], Any],
    raw: bytes,
    order: int,
    transforms: dict[tuple[str, str], list[tuple[float, int, np.ndarray]]],
) -> None:
    """What cannot be read is passed over: a drive needs few of its transforms, and says what it misses."""
    try:
        message = parse(raw, TRANSFORM)
    except _Unreadable:
        return
    for each in message.transforms:
        T = matrix(_vector(each.transform.translation), _quaternion(each.transform.rotation))
        if T is not None:
            pair = bare(each.header.frame_id), bare(each.child_frame_id)
            transforms.setdefault(pair, []).append((_stamp(each.header), order, T))


def _vector(v: Any) -> np.ndarray:
    return np.array([v.x, v.y, v.z])


def _quaternion(q: Any) -> np.ndarray:
    return np.array([q.x, q.y, q.z, q.w])


def most_common(names: list[str]) -> str:
    """The most frequent name; the first of equals."""
    return Counter(names).most_common(1)[0][0]
