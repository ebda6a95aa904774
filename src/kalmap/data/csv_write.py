"""Writes any log in the csv layout of `docs/csv-layout.md`, so that reading it back gives the same events."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kalmap.data import csv_layout as layout
from kalmap.records import Fix, Log, LogError, Odometry, Reference, Scan, Sightings


def write_csv_log(log: Log, folder: Path) -> None:
    """Writes `log` into `folder`, which must not exist or be empty.

    Numbers are written with as many digits as it takes to read the same ones back. The first reference
    in the frame "map" becomes `truth.csv` and `landmarks.csv`; other references are not written. Raises
    `LogError` for a log with raw scans, which the layout has no place for, and for a folder in use.
    """
    folder = Path(folder)
    odometry, sightings, fixes = _collect(log)
    reference = next((r for r in log.references if r.frame == "map"), None)
    try:
        if folder.exists() and any(folder.iterdir()):
            raise LogError("is not empty; the log is not written", file=folder)
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / layout.ODOMETRY, *_odometry_rows(log, odometry))
        if sightings:
            _write(folder / layout.SIGHTINGS, *_sighting_rows(sightings))
        if fixes:
            rows = ([fix.time, fix.x, fix.y, _cell(fix.heading)] for fix in fixes)
            _write(folder / layout.FIXES, ["time", "x", "y", "heading"], rows)
        if reference is not None:
            _write_reference(folder, reference)
        header = msgspec.json.encode(_header(log, sightings, reference))
        (folder / layout.HEADER).write_bytes(msgspec.json.format(header, indent=2) + b"\n")
    except OSError as error:
        raise LogError(f"cannot be written: {error}", file=folder) from error


def _collect(log: Log) -> tuple[list[Odometry], list[Sightings], list[Fix]]:
    odometry: list[Odometry] = []
    sightings: list[Sightings] = []
    fixes: list[Fix] = []
    for event in log:
        if isinstance(event, Odometry):
            odometry.append(event)
        elif isinstance(event, Sightings):
            sightings.append(event)
        elif isinstance(event, Fix):
            fixes.append(event)
        elif isinstance(event, Scan):
            raise LogError(
                "the csv layout has no place for raw scans; give a detector when opening the log",
                file=log.source,
            )
    return odometry, sightings, fixes


def _write(path: Path, names: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(names)
        writer.writerows(rows)


def _cell(number: float) -> float | str:
    """Blank for NaN: not measured."""
    return "" if np.isnan(number) else number


def _odometry_rows(log: Log, blocks: list[Odometry]) -> tuple[list[str], list[list[float]]]:
    """One row a sample, with its end and its duration, so that nothing has to be computed back."""
    motion = next(c for c, models in layout.MOTIONS.items() if log.defaults.motion.model in models)
    terms = layout.covariance_columns(motion)
    stated = any(block.covariance is not None for block in blocks)
    names = ["time", "duration", *motion, *(terms if stated else ())]
    rows: list[list[float]] = []
    previous = -np.inf
    for block in blocks:
        remaining = block.durations.sum() - np.cumsum(block.durations)
        # Rounding must not let time go back, nor move the block's own end.
        ends = np.clip(block.time - remaining, min(previous, block.time), block.time)
        ends[-1:] = previous = block.time
        columns = [ends, block.durations, *block.values.T]
        if stated and block.covariance is not None:
            columns += [block.covariance[:, i, j] for i, j in terms.values()]
        elif stated:
            raise LogError("states a covariance for some odometry samples only", file=log.source)
        rows += np.column_stack(columns).tolist()
    return names, rows


def _sighting_rows(frames: list[Sightings]) -> tuple[list[str], list[list[Any]]]:
    first = next((frame for frame in frames if len(frame.values)), frames[0])
    terms = layout.covariance_columns(("range", "bearing")) if first.covariance is not None else {}
    others = list(first.attributes or {})
    identified = first.ids is not None
    names = ["time", "range", "bearing", *(["id"] if identified else []), *terms, *others]
    rows: list[list[Any]] = []
    for frame in frames:
        if not len(frame.values):
            rows.append([frame.time] + [""] * (len(names) - 1))
            continue
        columns: list[list[Any]] = [[frame.time] * len(frame.values), *frame.values.T.tolist()]
        if identified:
            columns.append(frame.ids.tolist() if frame.ids is not None else [-1] * len(frame.values))
        if frame.covariance is not None:
            columns += [frame.covariance[:, i, j].tolist() for i, j in terms.values()]
        columns += [(frame.attributes or {})[name].tolist() for name in others]
        rows += map(list, zip(*columns))
    return names, rows


def _write_reference(folder: Path, reference: Reference) -> None:
    if len(reference.times):
        columns = [reference.times, *reference.positions.T, reference.headings]
        rows = ([*row[:3], _cell(row[3])] for row in np.column_stack(columns).tolist())
        _write(folder / layout.TRUTH, ["time", "x", "y", "heading"], rows)
    if len(reference.landmark_ids):
        points = zip(reference.landmark_ids.tolist(), *reference.landmarks.T.tolist())
        _write(folder / layout.LANDMARKS, ["id", "x", "y"], points)


def _header(log: Log, frames: list[Sightings], reference: Reference | None) -> dict[str, Any]:
    header: dict[str, Any] = {
        "name": log.name,
        "config": log.defaults,
        "start": log.start.tolist(),
        "start_covariance": log.start_covariance.tolist(),
        "truth_ids": log.truth_ids,
    }
    if reference is not None:
        seen = {i for frame in frames if frame.ids is not None for i in frame.ids.tolist()} - {-1}
        header |= {
            "truth_kind": reference.kind,
            "truth_point": reference.point.tolist(),
            "landmarks_complete": seen <= set(reference.landmark_ids.tolist()),
        }
    return header
