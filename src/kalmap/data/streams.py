"""A log's raw streams, as the files hold them, and what is wrong with their records.

A reader turns files into `Streams`: one table per sensor, every record kept, in SI units, in the
order of the file. `find_faults` says which records cannot be used. `kalmap.data.blocks` makes events
of the others; `kalmap.data.check` reports on all of them.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator

import msgspec
import numpy as np

ROUNDED = 1e-6
"""Share of a covariance's largest eigenvalue by which its smallest may be negative."""


class Malformed(msgspec.Struct, frozen=True):
    """Why a record is no good: the field that is wrong, and what was expected there."""

    field: str
    problem: str


class Stream(msgspec.Struct, frozen=True, kw_only=True):
    """What all streams share (n records).

    file: where they stand. times: (n,) s, as they are, also where they go back.
    records: (n,) where in the file each stands, from 1.
    malformed: index of a record -> why it could not be read at all; its numbers are NaN.
    left_out: index of a record -> why it is passed over without being a fault: a known quirk of the log.
    """

    file: str
    times: np.ndarray
    records: np.ndarray
    malformed: dict[int, Malformed] = msgspec.field(default_factory=dict)
    left_out: dict[int, str] = msgspec.field(default_factory=dict)


class OdometryStream(Stream, frozen=True, kw_only=True):
    """The vehicle's own motion.

    names: c names of the columns. values: (n, c), SI. covariance: (n, c, c) or None.
    durations: (n,) s: record i is a movement that ended at its time and lasted that long. None: a
        record holds from its time until the next record's.
    """

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray | None = None
    durations: np.ndarray | None = None


class SightingStream(Stream, frozen=True, kw_only=True):
    """Landmarks seen, one a record; neighbouring records of the same time are one frame.

    values: (n, 2) range m, bearing rad. ids, covariance, attributes: as in `Sightings`, for all records.
    empty: (n,) True where the record only says that nothing was seen at its time; None: nowhere.
    """

    values: np.ndarray
    ids: np.ndarray | None = None
    covariance: np.ndarray | None = None
    attributes: dict[str, np.ndarray] | None = None
    empty: np.ndarray | None = None


class ScanStream(Stream, frozen=True, kw_only=True):
    """Laser sweeps. ranges: (n, B) m, +inf for no return; bearings: (B,); intensities: (n, B) or None."""

    ranges: np.ndarray
    bearings: np.ndarray
    intensities: np.ndarray | None = None


class FixStream(Stream, frozen=True, kw_only=True):
    """Positions from outside. values: (n, 3) x m, y m, heading rad (NaN where it is not measured)."""

    values: np.ndarray


class Streams(msgspec.Struct, frozen=True, kw_only=True):
    """All streams of a log.

    known_ids: the identities that exist; None where the log does not list them. refuse_early: a sighting
    before the first odometry is a fault; else, as a known quirk of recorded logs, it is left out.
    """

    odometry: OdometryStream
    sightings: SightingStream | None = None
    scans: ScanStream | None = None
    fixes: FixStream | None = None
    known_ids: np.ndarray | None = None
    refuse_early: bool = False

    def named(self) -> dict[str, Stream]:
        """The streams that exist, by name."""
        found = {
            "odometry": self.odometry,
            "sightings": self.sightings,
            "scans": self.scans,
            "fixes": self.fixes,
        }
        return {name: stream for name, stream in found.items() if stream is not None}


class Fault(msgspec.Struct, frozen=True):
    """A record that cannot be used, and when in the log's course that turns up.

    row: index in the stream; record: place in the file. time: s, the record's own time, or the last
    good one before it if its own is what is wrong (`after` is True then).
    """

    file: str
    row: int
    record: int
    field: str
    problem: str
    time: float
    after: bool


def identities(numbers: np.ndarray) -> np.ndarray:
    """Ids (n,) int64 out of float64; -2, which is a fault, where it is no whole number or is too large."""
    whole = np.isfinite(numbers) & (numbers == np.rint(numbers)) & (np.abs(numbers) < 2.0**53)
    return np.where(whole, numbers, -2.0).astype(np.int64)


Check = tuple[str, np.ndarray, Callable[[int], str]]


def find_faults(stream: Stream, known_ids: np.ndarray | None = None) -> tuple[np.ndarray, list[Fault]]:
    """Which records of a stream can be used, (n,) bool, and the faults of the others, in file order."""
    times = stream.times
    bad = np.zeros(len(times), dtype=bool)
    reasons = dict(stream.malformed)
    bad[[*reasons, *stream.left_out]] = True
    for field, mask, tell in _checks(stream, known_ids):
        for row in np.flatnonzero(mask & ~bad):
            reasons[int(row)] = Malformed(field, tell(int(row)))
        bad |= mask
    counted = np.isfinite(times)
    counted[list(stream.left_out)] = False
    disordered = _disordered(times, counted)
    for row in np.flatnonzero(disordered & ~bad):
        reasons[int(row)] = Malformed("time", _tell_order(times, int(row)))
    good = ~(bad | disordered)
    if not reasons:
        return good, []
    timed = counted & ~disordered
    clock = np.maximum.accumulate(np.where(timed, times, -np.inf))
    faults = [
        Fault(
            stream.file,
            row,
            int(stream.records[row]),
            reasons[row].field,
            reasons[row].problem,
            float(clock[row]),
            not timed[row],
        )
        for row in sorted(reasons)
    ]
    return good, faults


def _disordered(times: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """(n,) True for the fewest records without which time never goes back, among those that are `counted`.

    The longest non-decreasing subsequence is kept, so that one stamp far ahead does not condemn all that
    follow. It is searched from the end, because then, of two records in the wrong order, the late one goes.
    """
    finite = np.flatnonzero(counted)
    out = np.zeros(len(times), dtype=bool)
    if not np.any(np.diff(times[finite]) < 0):
        return out
    backwards = (-times[finite][::-1]).tolist()
    tails: list[float] = []
    tail_at: list[int] = []
    before = np.full(len(backwards), -1)
    for i, value in enumerate(backwards):
        k = bisect_right(tails, value)
        before[i] = tail_at[k - 1] if k else -1
        tails[k : k + 1] = [value]
        tail_at[k : k + 1] = [i]
    out[finite] = True
    i = tail_at[-1]
    while i >= 0:
        out[finite[len(backwards) - 1 - i]] = False
        i = int(before[i])
    return out


def _tell_order(times: np.ndarray, row: int) -> str:
    earlier = times[:row][np.isfinite(times[:row])]
    if len(earlier) and earlier.max() > times[row]:
        return f"time goes back to {times[row]:.13g} s after {earlier.max():.13g} s"
    return f"time {times[row]:.13g} s is ahead of the records that follow"


def _checks(stream: Stream, known_ids: np.ndarray | None) -> Iterator[Check]:
    yield "time", ~np.isfinite(stream.times), _tell_finite(stream.times)
    if isinstance(stream, OdometryStream):
        yield from _check_odometry(stream)
    elif isinstance(stream, SightingStream):
        yield from _check_sightings(stream, known_ids)
    elif isinstance(stream, ScanStream):
        # +inf is a beam without return, so only NaN, -inf and negative ranges are wrong.
        wrong: np.ndarray = ~(stream.ranges >= 0)
        yield (
            "range",
            np.logical_or.reduce(wrong, axis=1),
            lambda k: (
                f"beam {int(np.argmax(wrong[k])) + 1}: expected a range of 0 or more, "
                f"found {stream.ranges[k, np.argmax(wrong[k])]:.6g}"
            ),
        )
    elif isinstance(stream, FixStream):
        for column, name in enumerate(("x", "y")):
            yield name, ~np.isfinite(stream.values[:, column]), _tell_finite(stream.values[:, column])
        yield "heading", np.isinf(stream.values[:, 2]), _tell_finite(stream.values[:, 2])


def _check_odometry(stream: OdometryStream) -> Iterator[Check]:
    for column, name in enumerate(stream.names):
        yield name, ~np.isfinite(stream.values[:, column]), _tell_finite(stream.values[:, column])
    if stream.durations is not None:
        lengths = stream.durations
        yield "duration", ~(np.isfinite(lengths) & (lengths >= 0)), _tell_positive(lengths)
    if stream.covariance is not None:
        yield from _check_covariance(stream.covariance)


def _check_sightings(stream: SightingStream, known_ids: np.ndarray | None) -> Iterator[Check]:
    seen = np.ones(len(stream.times), dtype=bool) if stream.empty is None else ~stream.empty
    ranges, bearings = stream.values[:, 0], stream.values[:, 1]
    yield "range", seen & ~(np.isfinite(ranges) & (ranges >= 0)), _tell_positive(ranges)
    yield "bearing", seen & ~np.isfinite(bearings), _tell_finite(bearings)
    for name, values in (stream.attributes or {}).items():
        yield name, seen & ~np.isfinite(values), _tell_finite(values)
    if stream.covariance is not None:
        for field, wrong, tell in _check_covariance(stream.covariance):
            yield field, seen & wrong, tell
    if stream.ids is None:
        return
    ids = stream.ids
    yield "id", seen & (ids < -1), lambda k: "expected a whole number of 0 or more, or -1 for unknown"
    if known_ids is not None:
        unknown = seen & (ids >= 0) & ~np.isin(ids, known_ids)
        yield "id", unknown, lambda k: f"unknown id {ids[k]}: not among the landmarks of the log"


def _check_covariance(covariance: np.ndarray) -> Iterator[Check]:
    finite = np.isfinite(covariance).all(axis=(1, 2))
    yield "covariance", ~finite, lambda k: "expected finite numbers in the covariance"
    safe = np.where(finite[:, None, None], covariance, np.eye(covariance.shape[1]))
    spreads = np.linalg.eigvalsh(safe)
    # Covariances are written rounded, so that a zero may come out slightly negative.
    negative: np.ndarray = spreads[:, 0] < -ROUNDED * spreads[:, -1]
    yield "covariance", negative | (spreads[:, -1] < 0), lambda k: "is not positive semi-definite"


def _tell_finite(values: np.ndarray) -> Callable[[int], str]:
    return lambda row: f"expected a finite number, found {values[row]}"


def _tell_positive(values: np.ndarray) -> Callable[[int], str]:
    return lambda row: f"expected a finite number of 0 or more, found {values[row]}"
