"""CARMEN text logs, raw or corrected: one message a line, its last three words being ipc_time, host and logger_time.

    FLASER n ranges... x y theta  ox oy otheta
    ROBOTLASER1 type start_angle field_of_view resolution maximum_range accuracy remission_mode
        n ranges... m remissions...  x y theta  ox oy otheta  tv rv forward_distance side_distance turn_axis
    RAWLASER1 type start_angle field_of_view resolution maximum_range accuracy remission_mode
        n ranges... m remissions...
    ODOM x y theta tv rv accel
    PARAM name value

x y theta is the laser, ox oy otheta the robot, both by odometry. FLASER carries no angles: the beams spread over the
180 degrees ahead of SICK's scanners, or over the 100 degrees of their finest modes. Early ROBOTLASER1 lines hold no
remissions, not even their number. RAWLASER1 has no pose: there the ODOM lines are interpolated.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import msgspec
import numpy as np

from kalmap.data.covered import without_cover
from kalmap.data.drive import HOLD, Drive, DriveEvents, cleaned, interpolated, no_return, outside_silences
from kalmap.data.laser_classes import laser_defaults
from kalmap.data.odometry_gaps import Silence, silences
from kalmap.data.relations import PACKED, relations_beside
from kalmap.data.streams import Malformed
from kalmap.data.text import read_text
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.records import Log, LogError

LASERS = ("FLASER", "ROBOTLASER1", "RAWLASER1")
"""Messages of the front laser. The more frequent of the first two is read; the third where there are none of them."""
OTHER_LASERS = ("RLASER", "LASER3", "LASER4", "LASER5", "ROBOTLASER2", "RAWLASER2", "RAWLASER3", "RAWLASER4")
KNOWN = (*LASERS, *OTHER_LASERS, "ODOM", "PARAM", "SYNC", "TRUEPOS", "NEFF")
MOUNT = "robot_frontlaser_offset"

NARROW = (101, 200, 201, 400, 401)
"""Numbers of beams of SICK's modes of 100 degrees."""
MOST_BEAMS = 100_000
POSES = ("x", "y", "theta", "odom_x", "odom_y", "odom_theta")
HEADER = (
    "laser_type",
    "start_angle",
    "field_of_view",
    "resolution",
    "maximum_range",
    "accuracy",
    "remission_mode",
)


class _Scan(msgspec.Struct, frozen=True, gc=False):
    """A laser message. poses: (6,) laser and robot, NaN without. geometry: start and step, rad. reach: m."""

    ranges: np.ndarray
    poses: np.ndarray
    stamp: float
    geometry: tuple[float, float]
    reach: float


def is_carmen(path: Path) -> bool:
    """Whether a file's name says that it is a CARMEN log."""
    name = path.name.lower()
    for ending in PACKED:
        name = name.removesuffix(ending)
    return name.endswith((".clf", ".log"))


def open_carmen(path: Path) -> Log:
    """The log in a CARMEN file, with the relations beside it.

    Raises LogError if the file cannot be read or holds no message of a front laser. Bad lines come up when the log
    is iterated; records are line numbers.
    """
    drive = without_cover(read_carmen(path))
    name = path.name
    for ending in (*PACKED, ".clf", ".log"):
        name = name.removesuffix(ending)
    return Log(
        name=name,
        source=str(path),
        defaults=laser_defaults(drive),
        open=DriveEvents(drive),
        references=relations_beside(path),
        files=(str(path),),
    )


def read_carmen(path: Path) -> Drive:
    """All scans of the front laser in a CARMEN file."""
    text = read_text(path)
    lines = text.split("\n")
    # A line that the file ends in has been cut, unless all its words are there.
    last = len(lines) if lines[-1] else 0
    kinds = [line.split(None, 1)[0] if line and not line.isspace() else "" for line in lines]
    counts = Counter(kinds)
    kind = _front_laser(path, counts)
    found: list[_Scan | Malformed] = []
    numbers: list[int] = []
    for number, (name, line) in enumerate(zip(kinds, lines), start=1):
        if name == kind:
            found.append(_parse_scan(line.split(), kind, number == last))
        elif number == last and _is_cut(name, line):
            found.append(Malformed("line", "the file ends in the middle of a line"))
        else:
            continue
        numbers.append(number)
    return _drive(path, kind, found, np.array(numbers, dtype=np.int64), lines, kinds, counts)


def _front_laser(path: Path, counts: Counter[str]) -> str:
    posed = max(("ROBOTLASER1", "FLASER"), key=lambda name: counts[name])
    kind = posed if counts[posed] else "RAWLASER1"
    if counts[kind]:
        return kind
    held = ", ".join(f"{counts[name]} {name}" for name in KNOWN if counts[name])
    if held:
        raise LogError(f"no message of a front laser ({', '.join(LASERS)}); it holds {held}", file=path)
    raise LogError(f"no line of a CARMEN log ({', '.join(LASERS)}, ODOM, ...)", file=path)


def _is_cut(name: str, line: str) -> bool:
    """Whether a last line without its line break, of another kind than the laser's, lacks words."""
    if name == "ODOM":
        return len(line.split()) < 9
    partial = any(known.startswith(name) for known in ("ODOM", *LASERS)) and name not in KNOWN
    return bool(name) and (partial or name in OTHER_LASERS)


def _parse_scan(words: list[str], kind: str, unfinished: bool) -> _Scan | Malformed:
    """A laser message out of its words, the first of which is its name."""
    head = 1 if kind == "FLASER" else 1 + len(HEADER)
    beams = _count(words, head, "num_readings")
    if isinstance(beams, Malformed):
        return beams
    end = head + 1 + beams
    poses = 0 if kind == "RAWLASER1" else 6
    after = poses + (5 if kind == "ROBOTLASER1" else 0) + 1
    if kind != "FLASER" and not _early(words, end, after):
        remissions = _count(words, end, "num_remissions", least=0)
        if isinstance(remissions, Malformed):
            return remissions
        end += 1 + remissions
    missing = end + after + (2 if unfinished else 0) - len(words)
    if missing > 0:
        return Malformed("line", f"is cut short: {missing} words are missing")
    if len(words) > end + after + 2:
        return Malformed("line", f"expected {end + after + 2} words for {beams} beams, found {len(words)}")
    try:
        ranges = np.array([float(word) for word in words[head + 1 : head + 1 + beams]])
        pose = np.array([float(word) for word in words[end : end + poses]] or [np.nan] * 6)
        header = [float(word) for word in words[1:head]]
        stamp = float(words[end + after - 1])
    except ValueError:
        return _not_a_number(words, head, beams, end, poses, end + after - 1)
    wanted = [*zip(POSES[:poses], pose), *zip(HEADER, header), ("ipc_time", stamp)]
    for field, value in wanted:
        if not np.isfinite(value):
            return Malformed(field, f"expected a finite number, found {value}")
    if kind == "FLASER":
        return _Scan(ranges, pose, stamp, _angles(beams), np.inf)
    start, step, reach = header[1], header[3], header[4]
    if beams > 1 and not 0 < step <= np.pi:
        return Malformed("resolution", f"expected an angle between 0 and pi rad, found {step}")
    return _Scan(ranges, pose, stamp, (start, step), reach if reach > 0 else np.inf)


def _early(words: list[str], end: int, after: int) -> bool:
    """Whether a ROBOTLASER1 line holds no remissions, not even their number."""
    return len(words) == end + after + 2 and after > 1


def _count(words: list[str], at: int, field: str, least: int = 1) -> int | Malformed:
    if len(words) <= at:
        return Malformed("line", f"is cut short: {field} is missing")
    word = words[at]
    if not (word.isascii() and word.isdigit() and least <= int(word[:9]) <= MOST_BEAMS):
        return Malformed(field, f"expected a number from {least} to {MOST_BEAMS}, found {word!r}")
    return int(word)


def _not_a_number(
    words: list[str], head: int, beams: int, poses_at: int, poses: int, stamp_at: int
) -> Malformed:
    """Which word of a message is no number."""
    named = {head + 1 + k: f"range {k + 1}" for k in range(beams)}
    named |= {poses_at + k: POSES[k] for k in range(poses)} | {1 + k: HEADER[k] for k in range(head - 1)}
    named[stamp_at] = "ipc_time"
    for at, field in named.items():
        try:
            float(words[at])
        except ValueError:
            return Malformed(field, f"expected a number, found {words[at]!r}")
    raise AssertionError("every word was a number")


def _angles(beams: int) -> tuple[float, float]:
    """Bearing of the first beam and the step, rad, of a FLASER message."""
    field = 100.0 if beams in NARROW else 180.0
    if beams == 1:
        return 0.0, 0.0
    return float(np.deg2rad(-field / 2)), float(np.deg2rad(field / (beams - beams % 2)))


def _drive(
    path: Path,
    kind: str,
    found: list[_Scan | Malformed],
    records: np.ndarray,
    lines: list[str],
    kinds: list[str],
    counts: Counter[str],
) -> Drive:
    nothing = _Scan(np.zeros(0), np.full(6, np.nan), np.nan, (0.0, 0.0), np.inf)
    malformed = {row: one for row, one in enumerate(found) if isinstance(one, Malformed)}
    scans = [nothing if isinstance(one, Malformed) else one for one in found]
    poses = np.array([scan.poses for scan in scans])
    stamps = np.array([scan.stamp for scan in scans])
    good = np.array([row for row in range(len(scans)) if row not in malformed], dtype=np.int64)
    left_out: dict[int, str] = {}
    others = [f"{counts[name]} {name}" for name in OTHER_LASERS if counts[name] and kind != "RAWLASER1"]
    notes = [f"only {kind} is read; left out: {', '.join(others)}"] if others else []
    silent: tuple[Silence, ...] = ()
    if kind == "RAWLASER1":
        poses, left_out, silent = _odometry_at(path, stamps, good, lines, kinds)
    ranges = [cleaned(scan.ranges, 0.0, np.nextafter(scan.reach, 0.0)) for scan in scans]
    fans = {
        (scan.geometry, len(scan.ranges)): scan.geometry[0] + scan.geometry[1] * np.arange(len(scan.ranges))
        for scan in scans
    }
    drive = Drive(
        file=str(path),
        stamps=stamps,
        records=records,
        poses=poses[:, 3:],
        ranges=ranges,
        bearings=[fans[scan.geometry, len(scan.ranges)] for scan in scans],
        malformed=malformed,
        left_out=left_out,
        silences=silent,
        mount=_mount(poses[good], lines, kinds),
        reach=no_return(ranges),
        notes=tuple(notes),
    )
    return outside_silences(drive)


def _mount(poses: np.ndarray, lines: list[str], kinds: list[str]) -> np.ndarray:
    """(3,) the laser in the robot's frame: as the parameter says, or as the poses (n, 6) of both do."""
    for kind, line in zip(kinds, lines):
        words = line.split() if kind == "PARAM" else []
        if len(words) > 2 and words[1] == MOUNT:
            try:
                offset = float(words[2])
            except ValueError:
                break
            if np.isfinite(offset):
                return np.array([offset, 0.0, 0.0])
    if not len(poses) or not np.isfinite(poses).all():
        return np.zeros(3)
    mounts = compose(inverse(poses[:, 3:]), poses[:, :3])
    middle = np.median(mounts[:, :2], axis=0)
    heading = np.arctan2(np.median(np.sin(mounts[:, 2])), np.median(np.cos(mounts[:, 2])))
    mount = np.array([*middle, heading])
    # Poses are printed with six digits: what is less than that is nothing.
    return np.where(np.abs(mount) < 1e-4, 0.0, mount)


def _odometry_at(
    path: Path, stamps: np.ndarray, good: np.ndarray, lines: list[str], kinds: list[str]
) -> tuple[np.ndarray, dict[int, str], tuple[Silence, ...]]:
    """Poses (n, 6) of the scans by the ODOM lines, the scans that no odometry covers, and its silences."""
    rows = []
    for kind, line in zip(kinds, lines):
        words = line.split() if kind == "ODOM" else []
        try:
            # speeds may be missing, so the stamp is found from the end
            row = [float(word) for word in (*words[1:4], words[-3])] if len(words) > 6 else []
        except ValueError:
            continue
        if len(row) == 4 and np.isfinite(row).all():
            rows.append(row)
    if not rows:
        raise LogError("no odometry: neither the laser's messages nor ODOM lines tell a pose", file=path)
    table = np.array(rows)
    table[:, 2] = wrap(table[:, 2])
    poses = np.full((len(stamps), 6), np.nan)
    times = np.maximum.accumulate(table[:, 3])
    found, outside = interpolated(times, table[:, :3], stamps[good])
    poses[good, 3:] = found
    away = good[outside > HOLD].tolist()
    return poses, dict.fromkeys(away, "outside the span of the odometry"), silences(times, 0, len(stamps) - 1)
