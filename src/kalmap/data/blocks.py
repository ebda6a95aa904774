"""Events from raw streams: in order of time, odometry in blocks that end where something is seen.

A record of held odometry (speed and steering, speed and turn rate) holds from its own time until the
next record's. Where a frame or a scan falls in between, the sample is split at that instant, so that the
block before it ends exactly there. The durations of the pieces sum to the elapsed time. A `Fix` splits
no sample: it comes after the last sample that ended at or before it. Movements that ended at their time
(increments) are never split either.

A held log begins at its first odometry record and ends at its last, which is held for at most
`HOLD_LAST` to reach a last observation. What lies outside is left out, and `kalmap.data.check` counts it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import msgspec
import numpy as np

from kalmap.data.streams import Fault, OdometryStream, SightingStream, Streams, find_faults
from kalmap.records import Event, Fix, LogError, Odometry, Scan, Sightings, Skipped

LONGEST_BLOCK = 0.5
"""s; a single sample may be longer."""
HOLD_LAST = 0.5
"""s, how long the last record of held odometry may be held to reach a last observation."""
ROUNDING = 1e-6
"""s, so that twenty samples of 25 ms make one block of half a second, also on a clock of Unix seconds."""

Detector = Callable[[Scan], Sightings]
Skip = Callable[[Skipped], None]


class StreamEvents(msgspec.Struct, frozen=True):
    """A `Log.open` made of raw streams. `streams` reads the files anew at each call.

    detector: turns each scan into sightings; None hands the scans on as they are.
    """

    streams: Callable[[], Streams]
    detector: Detector | None = None

    def __call__(self, skip: Skip | None) -> Iterator[Event]:
        return events(self.streams(), skip, self.detector)


class _Samples(msgspec.Struct, frozen=True):
    """n odometry samples. starts, ends, durations: (n,) s; values (n, c); covariance (n, c, c) or None."""

    starts: np.ndarray
    ends: np.ndarray
    durations: np.ndarray
    values: np.ndarray
    covariance: np.ndarray | None
    records: np.ndarray
    file: str = ""


class _Item(msgspec.Struct, frozen=True):
    """Things that happen at `times`; `make` builds the one with index k. At equal times, by `priority`."""

    times: np.ndarray
    priority: int
    make: Callable[[int], Event | Fault]


def events(streams: Streams, skip: Skip | None, detector: Detector | None = None) -> Iterator[Event]:
    """The log's events in order of time.

    skip: is told of each bad record that is passed over. None: a bad record raises `LogError` when the
    iteration gets to it, that is, after all earlier events.
    """
    good = {}
    faults: list[Fault] = []
    for name, stream in streams.named().items():
        good[name], found = find_faults(stream, streams.known_ids)
        faults += found
    starts = _frame_starts(streams.sightings, good.get("sightings"))
    seen = _observation_times(streams, good, starts)
    samples = _samples(streams.odometry, good["odometry"], seen)
    begin, end = covered(streams.odometry, good["odometry"], seen)
    if streams.refuse_early and streams.sightings is not None:
        early = good["sightings"] & (streams.sightings.times < begin)
        faults += [_too_early(streams.sightings, row) for row in np.flatnonzero(early).tolist()]
    if (seen == begin).any():  # seen before anything moved: the filter has to know that odometry is there
        yield _standing(streams.odometry, begin)
    items = _items(streams, good, starts, detector, faults)
    done = 0
    for item, index in _in_order(items, begin, end):
        position = int(np.searchsorted(samples.ends, item.times[index], side="right"))
        yield from _blocks(samples, done, position)
        done = max(done, position)
        thing = item.make(index)
        if not isinstance(thing, Fault):
            yield thing
        elif skip is None:
            raise LogError(thing.problem, file=thing.file, record=thing.record, field=thing.field)
        else:
            skip(Skipped(thing.file, thing.record, thing.field, thing.problem))
    yield from _blocks(samples, done, len(samples.ends))
    if not good["odometry"].any():
        raise LogError("no odometry record that can be used", file=streams.odometry.file)


def _too_early(sightings: SightingStream, row: int) -> Fault:
    return Fault(
        file=sightings.file,
        row=row,
        record=int(sightings.records[row]),
        field="time",
        problem="a sighting before any odometry",
        time=float(sightings.times[row]),
        after=False,
    )


def _standing(odometry: OdometryStream, time: float) -> Odometry:
    """A block of no samples at the start."""
    count = odometry.values.shape[1]
    return Odometry(
        time, np.zeros((0, count)), np.zeros(0), record=int(odometry.records[0]), file=odometry.file
    )


def covered(odometry: OdometryStream, good: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    """The span of time, s, that a log's odometry covers; what happens outside is left out.

    good: (n,) records that can be used. seen: times of the observations. Movements that ended at their
    time say nothing about when the log begins: then the span is unlimited.
    """
    times = odometry.times[good]
    if odometry.durations is not None or not len(times):
        return -np.inf, np.inf
    reachable = seen[(seen > times[-1]) & (seen <= times[-1] + HOLD_LAST)]
    return float(times[0]), float(reachable.max(initial=times[-1]))


def _samples(odometry: OdometryStream, good: np.ndarray, seen: np.ndarray) -> _Samples:
    times, values, records = odometry.times[good], odometry.values[good], odometry.records[good]
    covariance = None if odometry.covariance is None else odometry.covariance[good]
    if odometry.durations is not None:
        durations = odometry.durations[good]
        samples = _Samples(times - durations, times, durations, values, covariance, records, odometry.file)
        movement = odometry.names[0] == "dx"
        return samples if movement else _split(samples, seen)
    _, last = covered(odometry, good, seen)
    ends = np.append(times[1:], last)[: len(times)]
    lasting = ends > times
    held = _Samples(
        times[lasting],
        ends[lasting],
        (ends - times)[lasting],
        values[lasting],
        None if covariance is None else covariance[lasting],
        records[lasting],
        odometry.file,
    )
    return _split(held, seen)


def _split(samples: _Samples, seen: np.ndarray) -> _Samples:
    """Cuts samples at the instants that lie strictly inside them. The sensor's noise is as it was."""
    instants = np.unique(seen)
    owner = np.searchsorted(samples.ends, instants, side="left")
    inside = owner < len(samples.ends)
    instants, owner = instants[inside], owner[inside]
    # A start computed as end - duration may be a rounding error before the previous end.
    previous = np.append(-np.inf, samples.ends)[owner]
    inside = (instants > np.maximum(samples.starts[owner], previous)) & (instants < samples.ends[owner])
    instants, owner = instants[inside], owner[inside]
    if not len(instants):
        return samples
    ends = np.concatenate([samples.ends, instants])
    owners = np.concatenate([np.arange(len(samples.ends)), owner])
    order = np.argsort(ends, kind="stable")
    ends, owners = ends[order], owners[order]
    first = np.append(True, owners[1:] != owners[:-1])
    starts = np.where(first, samples.starts[owners], np.append(-np.inf, ends[:-1]))
    whole = np.bincount(owners, minlength=len(samples.ends))[owners] == 1
    durations = np.where(whole, samples.durations[owners], ends - starts)
    covariance = None
    if (
        samples.covariance is not None
    ):  # white within the sample: what is shorter is noisier, the whole is as it was
        share = np.divide(samples.durations[owners], durations, out=np.ones(len(owners)), where=durations > 0)
        covariance = samples.covariance[owners] * share[:, None, None]
    values, records = samples.values[owners], samples.records[owners]
    return _Samples(starts, ends, durations, values, covariance, records, samples.file)


def _blocks(samples: _Samples, low: int, high: int) -> Iterator[Odometry]:
    """Samples low to high - 1 in blocks of at most `LONGEST_BLOCK`."""
    while low < high:
        limit = samples.starts[low] + LONGEST_BLOCK + ROUNDING
        cut = high
        if samples.ends[high - 1] > limit:
            cut = low + max(1, int(np.searchsorted(samples.ends[low:high], limit, side="right")))
        covariance = samples.covariance
        yield Odometry(
            float(samples.ends[cut - 1]),
            samples.values[low:cut],
            samples.durations[low:cut],
            None if covariance is None else covariance[low:cut],
            int(samples.records[low]),
            samples.file,
        )
        low = cut


def _frame_starts(sightings: SightingStream | None, good: np.ndarray | None) -> np.ndarray:
    """(F + 1,) where each frame begins among the good records, and their number."""
    if sightings is None or good is None or not good.any():
        return np.zeros(1, dtype=np.int64)
    times = sightings.times[good]
    return np.concatenate([[0], np.flatnonzero(np.diff(times)) + 1, [len(times)]])


def _observation_times(streams: Streams, good: dict[str, np.ndarray], starts: np.ndarray) -> np.ndarray:
    """Times of all frames and scans, which split odometry samples."""
    times = [np.zeros(0)]
    if streams.sightings is not None:
        times.append(streams.sightings.times[good["sightings"]][starts[:-1]])
    if streams.scans is not None:
        times.append(streams.scans.times[good["scans"]])
    return np.concatenate(times)


def _items(
    streams: Streams,
    good: dict[str, np.ndarray],
    starts: np.ndarray,
    detector: Detector | None,
    faults: list[Fault],
) -> list[_Item]:
    early = [fault for fault in faults if not fault.after]
    late = [fault for fault in faults if fault.after]
    items = [
        _Item(np.array([fault.time for fault in early]), 0, early.__getitem__),
        _Item(np.array([fault.time for fault in late]), 4, late.__getitem__),
    ]
    if streams.sightings is not None:
        times = streams.sightings.times[good["sightings"]][starts[:-1]]
        items.append(_Item(times, 1, _frame_maker(streams.sightings, good["sightings"], starts)))
    if streams.scans is not None:
        scans, rows = streams.scans, np.flatnonzero(good["scans"])

        def scan(k: int) -> Event:
            row = rows[k]
            bits = None if scans.intensities is None else scans.intensities[row]
            sweep = Scan(
                float(scans.times[row]),
                scans.ranges[row],
                scans.bearings,
                bits,
                int(scans.records[row]),
                scans.file,
            )
            return sweep if detector is None else detector(sweep)

        items.append(_Item(scans.times[rows], 2, scan))
    if streams.fixes is not None:
        fixes, kept = streams.fixes, np.flatnonzero(good["fixes"])

        def fix(k: int) -> Event:
            row = kept[k]
            x, y, heading = fixes.values[row].tolist()
            return Fix(float(fixes.times[row]), x, y, heading, int(fixes.records[row]), fixes.file)

        items.append(_Item(fixes.times[kept], 3, fix))
    return items


def _frame_maker(stream: SightingStream, good: np.ndarray, starts: np.ndarray) -> Callable[[int], Event]:
    """Builds frame k out of the good records of a stream."""
    times, values, records = (
        stream.times[good],
        np.ascontiguousarray(stream.values[good]),
        stream.records[good],
    )
    ids = None if stream.ids is None else stream.ids[good]
    covariance = None if stream.covariance is None else stream.covariance[good]
    attributes = (
        None if stream.attributes is None else {name: a[good] for name, a in stream.attributes.items()}
    )
    empty = np.zeros(len(times), dtype=bool) if stream.empty is None else stream.empty[good]

    def frame(k: int) -> Event:
        low, high = int(starts[k]), int(starts[k + 1])
        rows = slice(low + 1 if empty[low] else low, high)
        return Sightings(
            float(times[low]),
            values[rows],
            None if ids is None else ids[rows],
            None if covariance is None else covariance[rows],
            None if attributes is None else {name: a[rows] for name, a in attributes.items()},
            int(records[low]),
            stream.file,
        )

    return frame


def _in_order(items: list[_Item], begin: float, end: float) -> Iterator[tuple[_Item, int]]:
    """Everything that happens from begin to end, and every fault, by time and then by priority."""
    times = np.concatenate([item.times for item in items])
    priority = np.concatenate([np.full(len(item.times), item.priority) for item in items])
    which = np.concatenate([np.full(len(item.times), i) for i, item in enumerate(items)])
    index = np.concatenate([np.arange(len(item.times)) for item in items])
    order = np.lexsort((index, priority, times))
    is_fault = (priority == 0) | (priority == 4)
    order = order[(is_fault | ((times >= begin) & (times <= end)))[order]]
    for i, k in zip(which[order].tolist(), index[order].tolist()):
        yield items[i], k
