"""Many scans as a few arrays: equal bearings are kept once, and numbers that single precision holds exactly in that."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec
import numpy as np

from kalmap.records import Scan
from kalmap.slam.archive import check_arrays


class StoredScans(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """K scans.

    times, stamps: (K,) s; records: (K,). files: names, file: (K,) which of them. bearings: arrays (B,) rad, fan: (K,)
    which of them, and so how many beams. ranges: m, of all scans one after the other; intensities: likewise, of those
    scans where `bright` (K,) says so.
    """

    times: np.ndarray
    stamps: np.ndarray
    records: np.ndarray
    files: list[str]
    file: np.ndarray
    bearings: list[np.ndarray]
    fan: np.ndarray
    ranges: np.ndarray
    intensities: np.ndarray
    bright: np.ndarray


def stored_scans(scans: Sequence[Scan]) -> StoredScans:
    """The scans, to be written."""
    files: dict[str, int] = {}
    fans: dict[bytes, int] = {}
    bearings: list[np.ndarray] = []
    fan = np.empty(len(scans), dtype=np.int64)
    for row, scan in enumerate(scans):
        angles = np.asarray(scan.bearings, dtype=float)
        fan[row] = fans.setdefault(angles.tobytes(), len(bearings))
        if fan[row] == len(bearings):
            bearings.append(angles)
    return StoredScans(
        times=np.array([scan.time for scan in scans], dtype=float),
        stamps=np.array([scan.stamp for scan in scans], dtype=float),
        records=np.array([scan.record for scan in scans], dtype=np.int64),
        file=np.array([files.setdefault(scan.file, len(files)) for scan in scans], dtype=np.int64),
        files=list(files),
        bearings=bearings,
        fan=fan,
        ranges=_joined(scan.ranges for scan in scans),
        intensities=_joined(scan.intensities for scan in scans if scan.intensities is not None),
        bright=np.array([scan.intensities is not None for scan in scans], dtype=bool),
    )


def scans_of(stored: StoredScans) -> list[Scan]:
    """The scans that were written. Raises ValueError unless the arrays fit together."""
    count = len(stored.times)
    check_arrays(
        (stored.times, (count,), "f"),
        (stored.stamps, (count,), "f"),
        (stored.records, (count,), "i"),
        (stored.file, (count,), "i"),
        (stored.fan, (count,), "i"),
        (stored.bright, (count,), "b"),
        *((angles, (len(angles),), "f") for angles in stored.bearings),
    )
    for which, things in ((stored.file, stored.files), (stored.fan, stored.bearings)):
        if count and not 0 <= which.min() <= which.max() < len(things):
            raise ValueError("a scan's bearings or its file are not there")
    beams = np.array([len(angles) for angles in stored.bearings], dtype=np.int64)[stored.fan]
    ranges = _parts(stored.ranges, beams)
    intensities = iter(_parts(stored.intensities, beams[stored.bright]))
    return [
        Scan(
            time=float(stored.times[row]),
            ranges=ranges[row],
            bearings=stored.bearings[stored.fan[row]],
            intensities=next(intensities) if stored.bright[row] else None,
            record=int(stored.records[row]),
            file=stored.files[stored.file[row]],
            stamp=float(stored.stamps[row]),
        )
        for row in range(count)
    ]


def _joined(parts: Iterable[np.ndarray]) -> np.ndarray:
    """All parts in one row, in single precision if that loses nothing."""
    whole = np.concatenate([np.zeros(0), *(np.asarray(part, dtype=float) for part in parts)])
    with np.errstate(over="ignore", invalid="ignore"):
        half = whole.astype(np.float32)
        exact = half.astype(float).tobytes() == whole.tobytes()
    return half if exact else whole


def _parts(whole: np.ndarray, lengths: np.ndarray) -> list[np.ndarray]:
    """The row cut into parts. Raises ValueError unless they are all of it."""
    check_arrays((whole, (int(lengths.sum()),), "f"))
    return np.split(whole.astype(float), np.cumsum(lengths)[:-1]) if len(lengths) else []
