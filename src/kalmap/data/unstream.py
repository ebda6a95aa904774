"""Raw streams out of events, for logs that are not made of files: every event is a record."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from kalmap.data.csv_layout import MOTIONS
from kalmap.data.streams import FixStream, OdometryStream, ScanStream, SightingStream, Streams
from kalmap.records import Fix, Log, Odometry, Scan, Sightings


def streams_of_events(log: Log) -> Streams:
    """The streams of a log as its events tell them; records count the events of a kind from 1.

    Scans of different sizes are padded with +inf, no return.
    """
    odometry, sightings, scans, fixes = [], [], [], []
    for event in log:
        if isinstance(event, Odometry):
            odometry.append(event)
        elif isinstance(event, Sightings):
            sightings.append(event)
        elif isinstance(event, Scan):
            scans.append(event)
        else:
            fixes.append(event)
    return Streams(
        odometry=_odometry(log, odometry),
        sightings=_sightings(log, sightings) if sightings else None,
        scans=_scans(log, scans) if scans else None,
        fixes=_fixes(log, fixes) if fixes else None,
    )


def _odometry(log: Log, blocks: list[Odometry]) -> OdometryStream:
    names = next(c for c, models in MOTIONS.items() if log.defaults.motion.model in models)
    sizes = [len(block.values) for block in blocks]
    ends = [b.time - (b.durations.sum() - np.cumsum(b.durations)) for b in blocks]
    none = np.zeros(0)
    return OdometryStream(
        file=log.source,
        times=np.fmax.accumulate(np.concatenate([none, *ends])) if _ordered(blocks) else np.concatenate(ends),
        records=np.repeat(np.arange(1, len(blocks) + 1), sizes),
        names=names,
        values=np.concatenate([np.zeros((0, len(names))), *(b.values for b in blocks)]),
        durations=np.concatenate([none, *(b.durations for b in blocks)]),
    )


def _ordered(blocks: list[Odometry]) -> bool:
    """Whether the blocks are in order of time; if so, only rounding makes a sample end before the last."""
    return all(a.time <= b.time for a, b in pairwise(blocks))


def _sightings(log: Log, frames: list[Sightings]) -> SightingStream:
    sizes = [max(1, len(frame.values)) for frame in frames]
    nothing = np.full((1, 2), np.nan)
    identified = any(frame.ids is not None for frame in frames)
    ids = [
        frame.ids if frame.ids is not None and len(frame.ids) else np.full(size, -1)
        for frame, size in zip(frames, sizes)
    ]
    return SightingStream(
        file=log.source,
        times=np.repeat([frame.time for frame in frames], sizes),
        records=np.repeat(np.arange(1, len(frames) + 1), sizes),
        values=np.concatenate([frame.values if len(frame.values) else nothing for frame in frames]),
        ids=np.concatenate(ids) if identified else None,
        empty=np.repeat([not len(frame.values) for frame in frames], sizes),
    )


def _scans(log: Log, scans: list[Scan]) -> ScanStream:
    widest = max(scans, key=lambda scan: len(scan.ranges))
    ranges = np.full((len(scans), len(widest.ranges)), np.inf)
    for row, scan in zip(ranges, scans):
        row[: len(scan.ranges)] = scan.ranges
    return ScanStream(
        file=log.source,
        times=np.array([scan.time for scan in scans]),
        records=np.arange(1, len(scans) + 1),
        ranges=ranges,
        bearings=widest.bearings,
    )


def _fixes(log: Log, fixes: list[Fix]) -> FixStream:
    return FixStream(
        file=log.source,
        times=np.array([fix.time for fix in fixes]),
        records=np.arange(1, len(fixes) + 1),
        values=np.array([[fix.x, fix.y, fix.heading] for fix in fixes]),
    )
