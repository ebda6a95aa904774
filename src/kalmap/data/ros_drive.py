"""A drive out of the messages of a ROS bag: clocks, odometry at the scans' stamps, and the laser's mounting."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from kalmap.data.covered import without_cover
from kalmap.data.drive import HOLD, Drive, DriveEvents, cleaned, interpolated, no_return, outside_silences
from kalmap.data.laser_classes import laser_defaults
from kalmap.data.odometry_gaps import Silence, silences
from kalmap.data.ros_bags import METADATA, Bag, ScanMessage, contents, most_common, read_bag
from kalmap.data.ros_frames import BASES, Mounting, mounting, odometry_edge, planar
from kalmap.data.streams import Malformed
from kalmap.records import Log, LogError

BACK = 1.0
"""s: a stamp that lies further before an earlier one means that the clock was set; less is a message out of order."""
FORWARD = 60.0
"""s: a longer step is no pause of the scanner but a jump of the clock."""


class _Track(msgspec.Struct, frozen=True):
    """Odometry: stamps (K,) s and orders (K,) in the order of the bag, poses (K, 3). base: the robot's frame."""

    base: str
    stamps: np.ndarray
    orders: np.ndarray
    poses: np.ndarray


def open_bag(path: Path, scan_topic: str | None = None, odometry_topic: str | None = None) -> Log:
    """The log in a ROS 1 or ROS 2 bag.

    scan_topic, odometry_topic: by default the only ones of their type, else /scan and /odom, else those with most
    messages; without odometry messages, the transform from odom to the robot. Raises LogError if something of this is
    missing. Bad messages and jumps of the clock come up when the log is iterated; records count the scans from 1.
    """
    path = path.parent if path.name == METADATA else path
    bag = read_bag(path, scan_topic, odometry_topic)
    drive = without_cover(bag_drive(bag))
    reach = max((scan.high for scan in bag.scans if scan.fault is None), default=np.inf)
    files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    return Log(
        name=path.stem if path.is_file() else path.name,
        source=str(path),
        defaults=laser_defaults(drive, stated=reach),
        open=DriveEvents(drive),
        files=tuple(map(str, files)),
        settings={"scan_topic": bag.scan_topic, "odometry_topic": bag.odometry_topic},
    )


def bag_drive(bag: Bag) -> Drive:
    """The scans of a bag in the order of their stamps, epoch by epoch of their clock."""
    good = [scan for scan in bag.scans if scan.fault is None]
    track, faults = _track(bag)
    notes = list(bag.notes)
    frame = most_common([scan.frame for scan in good]) if good else ""
    mount = Mounting(np.zeros(3), False) if frame == track.base else None
    if mount is None:
        mount = mounting(bag.edges, track.base, frame, bag.file)
    if mount is None:
        mount = Mounting(np.zeros(3), False)
        notes.append(
            f"no transform from {track.base!r} to the laser {frame!r}: it is taken to sit at the robot's origin"
        )
    stamps = np.array([scan.stamp for scan in good])
    epochs = _epochs(stamps)
    order: np.ndarray = np.lexsort((np.arange(len(good)), stamps, epochs))
    late = int((np.diff(order) < 0).sum())
    if late:
        notes.append(f"scans out of order were sorted by their stamps ({late})")
    poses, outside = _poses_at(track, good, epochs)
    rows = [(good[k], k) for k in order.tolist()]
    return _assembled(bag, rows, faults, track, poses, outside, epochs, frame, mount, notes)


def _assembled(
    bag: Bag,
    sorted_scans: list[tuple[ScanMessage, int]],
    faults: list[tuple[int, int, Malformed]],
    track: _Track,
    poses: np.ndarray,
    outside: np.ndarray,
    epochs: np.ndarray,
    frame: str,
    mount: Mounting,
    notes: list[str],
) -> Drive:
    """Scans and faults as the rows of a drive. faults: (order, number, what) of messages that cannot be used."""
    bad = [(scan.order, scan.number, scan.fault) for scan in bag.scans if scan.fault is not None]
    waiting = sorted([*bad, *faults], key=lambda fault: fault[:2], reverse=True)
    scans: list[ScanMessage] = []
    at: list[int] = []
    malformed: dict[int, Malformed] = {}
    left_out: dict[int, str] = {}
    jumps: dict[int, Malformed] = {}
    before: tuple[ScanMessage, int] | None = None
    for scan, k in [*sorted_scans, (None, -1)]:
        while waiting and (scan is None or waiting[-1][0] < scan.order):
            place, number, fault = waiting.pop()
            malformed[len(scans)] = fault
            scans.append(ScanMessage(number, place))
            at.append(-1)
        if scan is None:
            break
        if scan.frame != frame:
            left_out[len(scans)] = f"of another laser, {scan.frame!r}"
        elif outside[k] > HOLD:
            left_out[len(scans)] = "outside the span of the odometry"
        if before is not None and (jump := _jump(before, (scan, k), epochs)) is not None:
            jumps[len(scans)] = jump
        scans.append(scan)
        at.append(k)
        before = scan, k
    fans: dict[tuple[float, float, int], tuple[np.ndarray, np.ndarray]] = {}
    for scan in scans:
        key = scan.start, scan.step, len(scan.ranges)
        if key not in fans:
            fans[key] = _fan(*key, mount.upside_down)
    turned = [fans[scan.start, scan.step, len(scan.ranges)] for scan in scans]
    ranges = [cleaned(scan.ranges[order], scan.low, scan.high) for scan, (_, order) in zip(scans, turned)]
    lit = bool(scans) and all(scan.intensities is not None or k < 0 for scan, k in zip(scans, at))
    bits = [
        np.zeros(0) if scan.intensities is None else scan.intensities[order].astype(np.float64)
        for scan, (_, order) in zip(scans, turned)
    ]
    drive = Drive(
        file=bag.file,
        stamps=np.array([scan.stamp for scan in scans]),
        records=np.array([scan.number for scan in scans], dtype=np.int64),
        poses=np.vstack([poses, np.full((1, 3), np.nan)])[at] if at else np.zeros((0, 3)),
        ranges=ranges,
        bearings=[bearings for bearings, _ in turned],
        intensities=bits if lit else None,
        malformed=malformed,
        left_out=left_out,
        jumps=jumps,
        silences=_silences(track, epochs, np.array(at, dtype=np.int64)),
        mount=mount.pose,
        reach=no_return(ranges),
        notes=tuple(notes),
    )
    return outside_silences(drive)


def _jump(
    before: tuple[ScanMessage, int], after: tuple[ScanMessage, int], epochs: np.ndarray
) -> Malformed | None:
    step = after[0].stamp - before[0].stamp
    if epochs[after[1]] != epochs[before[1]]:
        return Malformed("header.stamp", f"the clock jumps by {step:.6g} s from {before[0].stamp:.13g} s")
    if step > FORWARD:
        return Malformed("header.stamp", f"the clock jumps by {step:.6g} s from {before[0].stamp:.13g} s")
    return None


def _epochs(stamps: np.ndarray) -> np.ndarray:
    """(n,) how often the clock was set back before each message."""
    epochs = np.zeros(len(stamps), dtype=np.int64)
    newest, epoch = -np.inf, 0
    for k, stamp in enumerate(stamps.tolist()):
        if stamp < newest - BACK:
            epoch, newest = epoch + 1, -np.inf
        newest = max(newest, stamp)
        epochs[k] = epoch
    return epochs


def _track(bag: Bag) -> tuple[_Track, list[tuple[int, int, Malformed]]]:
    """The bag's odometry, from messages or from transforms, and the messages of it that cannot be used."""
    if bag.poses is not None:
        faults = [
            (pose.order, pose.number, Malformed(bag.odometry_topic, "expected a finite pose in this message"))
            for pose in bag.poses
            if pose.T is None
        ]
        poses = [pose for pose in bag.poses if pose.T is not None]
        if not poses:
            raise LogError(f"no message of {bag.odometry_topic} holds a finite pose", file=bag.file)
        child = most_common([pose.child for pose in poses]) or _base(bag)
        matrices = np.array([pose.T for pose in poses])
        stamps, orders = (np.array([getattr(pose, name) for pose in poses]) for name in ("stamp", "order"))
        return _Track(child, stamps, orders, planar(matrices)), faults
    pair = odometry_edge(bag.edges)
    if pair is None:
        frames = ", ".join(f"{parent} -> {child}" for parent, child in sorted(bag.edges)) or "none"
        problem = (
            f"no odometry: no topic of it, and no transform out of odom ({frames}); {contents(bag.topics)}"
        )
        raise LogError(problem, file=bag.file, field="odometry_topic")
    edge = bag.edges[pair]
    return _Track(pair[1], edge.stamps, edge.orders, planar(edge.matrices)), []


def _base(bag: Bag) -> str:
    """The robot's frame where the odometry does not name it."""
    pair = odometry_edge(bag.edges)
    return BASES[0] if pair is None else pair[1]


def _poses_at(track: _Track, scans: list[ScanMessage], epochs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (n, 3) at the scans' stamps, and (n,) s by how much each lies outside the odometry of its epoch."""
    stamps = np.array([scan.stamp for scan in scans])
    poses, outside = np.zeros((len(scans), 3)), np.zeros(len(scans))
    for epoch, chosen in _track_of_epochs(track, epochs).items():
        mine = epochs == epoch
        poses[mine], outside[mine] = interpolated(track.stamps[chosen], track.poses[chosen], stamps[mine])
    return poses, outside


def _track_of_epochs(track: _Track, epochs: np.ndarray) -> dict[int, np.ndarray]:
    """The odometry's messages for each epoch of the scans, in the order of their stamps.

    If both clocks were set back equally often they are one, and each epoch of the scans has its own odometry.
    """
    of_track = _epochs(track.stamps)
    together = of_track.max(initial=0) == epochs.max(initial=0)
    of_epochs = {}
    for epoch in np.unique(epochs).tolist():
        chosen = np.flatnonzero(of_track == epoch) if together else np.arange(len(of_track))
        of_epochs[epoch] = chosen[np.argsort(track.stamps[chosen], kind="stable")]
    return of_epochs


def _silences(track: _Track, epochs: np.ndarray, at: np.ndarray) -> tuple[Silence, ...]:
    """The odometry's silences. epochs: (n,) of the scans; at: (m,) the scan of each row of the drive, -1 for none."""
    of_rows = np.append(epochs, -1)[at]
    found: list[Silence] = []
    for epoch, chosen in _track_of_epochs(track, epochs).items():
        rows = np.flatnonzero(of_rows == epoch)
        found += silences(track.stamps[chosen], int(rows[0]), int(rows[-1]))
    return tuple(found)


def _fan(start: float, step: float, beams: int, upside_down: bool) -> tuple[np.ndarray, np.ndarray]:
    """Bearings (B,) ascending in [-pi, pi], anti-clockwise seen from above, and the order (B,) of the beams."""
    bearings = start + step * np.arange(beams)
    bearings = -bearings if upside_down else bearings
    edge = np.pi + 1e-6  # angles are printed as float32
    bearings = np.where(bearings > edge, bearings - 2 * np.pi, bearings)
    bearings = np.where(bearings < -edge, bearings + 2 * np.pi, bearings)
    order = np.argsort(bearings, kind="stable")
    return np.ascontiguousarray(bearings[order]), order
