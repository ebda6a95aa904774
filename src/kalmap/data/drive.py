"""A drive as a laser log tells it: raw scans, each with the robot's pose by odometry, and the events made of them.

The scans come in the order in which they were taken. Where the stamps are not in that order, `time` of the events is
put right and `Scan.stamp` keeps what the log printed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import msgspec
import numpy as np

from kalmap.data.odometry_gaps import LONGEST, LOST, Silence, step_covariance
from kalmap.data.plausibility import NAMED
from kalmap.data.streams import Malformed, OdometryStream, ScanStream, Streams
from kalmap.geometry.se2 import compose, exponential, inverse, logarithm
from kalmap.records import Event, LogError, Odometry, Scan, Skipped

TICK = 1e-6
"""s between two events of which the second is stamped earlier."""
HOLD = 0.5
"""s, how far outside the span of separate odometry messages a scan may lie and still take the nearest pose."""
LEAST_REACH = 4.0
"""m: no scanner sees less far than a URG-04LX."""
MOST_VALUES = 5_000_000
"""How many ranges are looked at to find the code for no return."""
SICK_CODES = tuple(code / unit for unit in (100.0, 1000.0) for code in (8183, 8187, 8188, 8189, 8190, 8191))
"""m: what a SICK LMS sends instead of a distance, in its cm and its mm mode; the first of each six is the lowest."""

Skip = Callable[[Skipped], None]


Fan = tuple[int, float, float]
"""How many beams a scan has, and the bearings of the first and the last, rad: these tell one set of beams."""


def fan_of(bearings: np.ndarray) -> Fan:
    """Which set of beams (B,) it is; B > 0."""
    return len(bearings), float(bearings[0]), float(bearings[-1])


class Drive(msgspec.Struct, frozen=True, kw_only=True):
    """n records of one laser, in the order in which they were taken.

    file: where they stand. stamps: (n,) s, as printed. records: (n,) lines or messages, from 1.
    poses: (n, 3) m, m, rad of the robot by odometry, in any fixed frame. ranges: n arrays (B,) m, +inf for no return;
    bearings: n arrays (B,) rad, ascending, in the laser's frame. intensities: n arrays (B,), or None.
    malformed: row -> why it could not be read; its numbers are NaN. left_out: row -> why it is passed over without
    being a fault. jumps: row -> how the clock jumps before it; the odometry across a jump is not used.
    silences: of the odometry that the poses were interpolated from.
    times: (n,) s, when the scans were taken, where that is known better than the stamps say.
    covered: set of beams -> (B,) bool, which of them see the robot itself and are left out.
    mount: (3,) the laser in the robot's frame. reach: m, what lies at or beyond it is no return; inf if not known.
    notes: what the reader decided that a user should know.
    """

    file: str
    stamps: np.ndarray
    records: np.ndarray
    poses: np.ndarray
    ranges: Sequence[np.ndarray]
    bearings: Sequence[np.ndarray]
    intensities: Sequence[np.ndarray] | None = None
    malformed: dict[int, Malformed] = msgspec.field(default_factory=dict)
    left_out: dict[int, str] = msgspec.field(default_factory=dict)
    jumps: dict[int, Malformed] = msgspec.field(default_factory=dict)
    silences: tuple[Silence, ...] = ()
    covered: dict[Fan, np.ndarray] = msgspec.field(default_factory=dict)
    mount: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(3))
    reach: float = np.inf
    times: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    @property
    def taken(self) -> np.ndarray:
        """(n,) s, when the scans were taken, as well as it is known."""
        return self.stamps if self.times is None else self.times

    def rows(self) -> np.ndarray:
        """The rows that become events."""
        kept = np.ones(len(self.stamps), dtype=bool)
        kept[[*self.malformed, *self.left_out]] = False
        return np.flatnonzero(kept)


class DriveEvents(msgspec.Struct, frozen=True):
    """A `Log.open` made of a drive."""

    drive: Drive

    def __call__(self, skip: Skip | None) -> Iterator[Event]:
        return events(self.drive, skip)

    def streams(self) -> Streams:
        """The drive as raw streams, for `kalmap.data.check`."""
        return _streams(self.drive)


def cleaned(ranges: np.ndarray, low: float, high: float) -> np.ndarray:
    """Ranges as they are inside [low, high], else +inf; also NaN, zero and negative ones."""
    with np.errstate(invalid="ignore"):
        seen = (ranges > 0) & (ranges >= low) & (ranges <= high)
    return np.where(seen, ranges, np.inf)


def no_return(scans: Sequence[np.ndarray]) -> float:
    """The range that codes "no return", m: what lies at or beyond it is no distance. inf where none stands out.

    It is the largest value, if it is one of SICK's error codes, or if it is 4 m or more, at least 5 beams share it
    exactly, and ten times as many as share any of the 20 values below it.
    """
    total = sum(len(scan) for scan in scans)
    if not total:
        return np.inf
    values = np.concatenate([*scans[:: 1 + total // MOST_VALUES]])
    values, counts = np.unique(values[np.isfinite(values)], return_counts=True)
    if not len(values):
        return np.inf
    largest = float(values[-1])
    if np.isclose(largest, SICK_CODES, rtol=1e-6, atol=0.0).any():
        return (SICK_CODES[0] if largest > 10 else SICK_CODES[6]) - 1e-4
    below = counts[-21:-1]
    stands_out = largest >= LEAST_REACH and len(below) > 0 and counts[-1] >= max(5, 10 * below.max())
    return largest if stands_out else np.inf


def pose_between(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Poses (n, 3) on the arcs of constant twist from a (n, 3) to b (n, 3); share: (n,), 0 is a and 1 is b."""
    return compose(a, exponential(share[:, None] * logarithm(compose(inverse(a), b))))


def interpolated(times: np.ndarray, poses: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (n, 3) at instants (n,), and (n,) how many seconds each lies outside the span of the times.

    times: (K,) s, non-decreasing, K > 0. Outside the span the nearest pose is taken.
    """
    inside = np.clip(at, times[0], times[-1])
    after = np.clip(np.searchsorted(times, inside, side="right"), 1, max(1, len(times) - 1))
    after = np.minimum(after, len(times) - 1)
    before = np.maximum(after - 1, 0)
    length = times[after] - times[before]
    share = np.divide(inside - times[before], length, out=np.zeros(len(at)), where=length > 0)
    return pose_between(poses[before], poses[after], share), np.abs(at - inside)


SET_BACK = 10.0
"""s: messages overtake each other by less; a stamp so far back is of a clock that was set."""


def times_put_right(drive: Drive) -> np.ndarray:
    """(n,) s, non-decreasing: the stamps, and `TICK` after the event before where a stamp lies before that.

    After a jump of the clock back, or a stamp that lies `SET_BACK` before the one before it, all stamps are moved on by
    the same amount. Rows that become no events keep theirs.
    """
    times = drive.taken.copy()
    last, moved, jumped = -np.inf, 0.0, False
    for row, stamp in enumerate(times.tolist()):
        jumped |= row in drive.jumps
        if row in drive.malformed or row in drive.left_out:
            continue
        if stamp + moved < (last if jumped else last - SET_BACK):
            moved = last + TICK - stamp
        # Unix seconds have a grain of 0.24 us, so a tick is never lost
        last = stamp + moved if stamp + moved >= last else last + TICK
        times[row], jumped = last, False
    return times


def steps_between(poses: np.ndarray) -> np.ndarray:
    """(n, 3) each pose seen from the pose before it; the first row is zero."""
    steps = np.zeros((len(poses), 3))
    steps[1:] = compose(inverse(poses[:-1]), poses[1:])
    return steps


def events(drive: Drive, skip: Skip | None) -> Iterator[Event]:
    """An `Odometry` and a `Scan` for each record, in order.

    The first odometry has no samples. The one after a jump of the clock is zero and states the covariance `LOST`; one
    across a silence of the odometry states a covariance, too.
    skip: is told of each bad record that is passed over; None: a bad record raises `LogError` when its turn comes.
    """
    times = times_put_right(drive)
    steps, jumped = steps_of(drive)
    silent = silent_of(drive)
    last: float | None = None
    for row in range(len(drive.stamps)):
        fault = drive.malformed.get(row) or drive.jumps.get(row)
        if fault is not None:
            _report(drive, row, fault, skip)
        if row in drive.malformed or row in drive.left_out:
            continue
        time, record = float(times[row]), int(drive.records[row])
        yield Odometry(
            time,
            np.zeros((0, 3)) if last is None else steps[row : row + 1],
            np.zeros(0) if last is None else np.array([time - last]),
            None if last is None else _stated(steps[row], bool(jumped[row]), float(silent[row])),
            record,
            drive.file,
        )
        yield _scan(drive, row, time)
        last = time
    if last is None:
        raise LogError("no scan that can be used", file=drive.file)


def steps_of(drive: Drive) -> tuple[np.ndarray, np.ndarray]:
    """Steps (n, 3) to the rows that become events, zero where the clock jumped since the one before, (n,) bool."""
    rows = drive.rows()
    steps = np.zeros((len(drive.stamps), 3))
    steps[rows] = steps_between(drive.poses[rows])
    jumped = np.zeros(len(drive.stamps), dtype=bool)
    after = np.searchsorted(rows, sorted(drive.jumps))
    jumped[rows[after[after < len(rows)]]] = True
    steps[jumped] = 0.0
    return steps, jumped


def outside_silences(drive: Drive) -> Drive:
    """The drive without the scans that lie inside a silence of its odometry: nobody knows where they were taken.

    What a jump of the clock made of two messages in a row is no silence.
    """
    stamps, rows = drive.stamps, np.arange(len(drive.stamps))
    inside = np.zeros(len(rows), dtype=bool)
    jumps = [(stamps[row - 1], stamps[row]) for row in drive.jumps if row > 0]
    silences = tuple(
        each for each in drive.silences if not any(a < each.end and b > each.begin for a, b in jumps)
    )
    for each in silences:
        beside = (rows >= each.first) & (rows <= each.last)
        inside |= beside & (stamps > each.begin) & (stamps < each.end)
    inside[[*drive.malformed, *drive.left_out]] = False
    found = dict.fromkeys(np.flatnonzero(inside).tolist(), "inside a silence of the odometry")
    return msgspec.structs.replace(drive, silences=silences, left_out={**drive.left_out, **found})


def silent_of(drive: Drive) -> np.ndarray:
    """(n,) s, how long the odometry was silent during the steps to the rows that become events."""
    silent, rows = np.zeros(len(drive.stamps)), drive.rows()
    for each in drive.silences:
        beside = rows[(rows >= each.first) & (rows <= each.last)]
        begin, end = drive.stamps[beside[:-1]], drive.stamps[beside[1:]]
        silent[beside[1:]] += np.maximum(0.0, np.minimum(end, each.end) - np.maximum(begin, each.begin))
    return silent


def silence_notes(drive: Drive) -> tuple[str, ...]:
    """A note on the silences of the odometry that scans lie in, or on both sides of."""
    rows = drive.rows()
    stamps = drive.stamps[rows]
    crossed = []
    for each in drive.silences:
        beside = stamps[(rows >= each.first) & (rows <= each.last)]
        inside = drive.stamps[each.first : each.last + 1]
        left_out = ((inside > each.begin) & (inside < each.end)).any()
        if left_out or (len(beside) and beside.min() <= each.begin and beside.max() >= each.end):
            crossed.append(each)
    if not crossed:
        return ()
    longest = sorted(crossed, key=lambda each: each.begin - each.end)[:NAMED]
    told = ", ".join(f"{s.end - s.begin:.4g} s from {s.begin:.13g} s to {s.end:.13g} s" for s in longest)
    return (
        f"{drive.file}: the odometry is silent for longer than {LONGEST:g} s {len(crossed)} time"
        f"{'s' * (len(crossed) != 1)} ({told}{', ...' * (len(crossed) > NAMED)}); scans inside are left out, and the "
        "motion across is doubted",
    )


def _stated(step: np.ndarray, jumped: bool, silent: float) -> np.ndarray | None:
    """(1, 3, 3) the covariance of a step (3,) where it is not the usual one."""
    if jumped:
        return LOST[None]
    return step_covariance(step, silent)[None] if silent > 0 else None


def _scan(drive: Drive, row: int, time: float) -> Scan:
    stamp = float(drive.stamps[row])
    covered = _covered(drive, row)
    used = slice(None) if covered is None else ~covered
    return Scan(
        time,
        np.ascontiguousarray(reaching(drive, row)[used], dtype=np.float64),
        drive.bearings[row][used],
        None if drive.intensities is None else drive.intensities[row][used],
        int(drive.records[row]),
        drive.file,
        stamp if stamp != time else float("nan"),
    )


def reaching(drive: Drive, row: int) -> np.ndarray:
    """(B,) the ranges of a row, +inf from the drive's reach on and where the beam is covered."""
    ranges, covered = drive.ranges[row], _covered(drive, row)
    seen = ranges < drive.reach
    return np.where(seen if covered is None else seen & ~covered, ranges, np.inf)


def _covered(drive: Drive, row: int) -> np.ndarray | None:
    """(B,) which of a row's beams are covered, None without any."""
    return (
        drive.covered.get(fan_of(drive.bearings[row])) if drive.covered and len(drive.bearings[row]) else None
    )


def _report(drive: Drive, row: int, fault: Malformed, skip: Skip | None) -> None:
    record = int(drive.records[row])
    if skip is None:
        raise LogError(fault.problem, file=drive.file, record=record, field=fault.field)
    skip(Skipped(drive.file, record, fault.field, fault.problem))


def _streams(drive: Drive) -> Streams:
    """Odometry of the rows that can be used, and all scans, padded with +inf to the widest."""
    times, rows = times_put_right(drive), drive.rows()
    ranges = np.full((len(drive.stamps), max(map(len, drive.ranges), default=0)), np.inf)
    for row in rows.tolist():
        ranges[row, : len(drive.ranges[row])] = reaching(drive, row)
    return Streams(
        odometry=OdometryStream(
            file=drive.file,
            times=times[rows],
            records=drive.records[rows],
            names=("dx", "dy", "dtheta"),
            values=steps_of(drive)[0][rows],
            durations=np.diff(times[rows], prepend=times[rows[:1]]),
        ),
        scans=ScanStream(
            file=drive.file,
            times=times,
            records=drive.records,
            malformed=drive.malformed,
            left_out=drive.left_out,
            ranges=ranges,
            bearings=max(drive.bearings, key=len, default=np.zeros(0)),
        ),
    )
