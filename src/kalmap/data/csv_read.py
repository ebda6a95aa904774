"""Reads a log in the csv layout of `docs/csv-layout.md`."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kalmap.data import csv_layout as layout
from kalmap.data.blocks import StreamEvents
from kalmap.data.streams import ROUNDED, FixStream, OdometryStream, SightingStream, Streams, identities
from kalmap.data.text import Table, parse_rows, read_text
from kalmap.records import Log, LogError, Reference, RunConfig


class _Columns(msgspec.Struct, frozen=True):
    """A csv file: its column names, its numbers, and where they stand."""

    path: Path
    names: tuple[str, ...]
    table: Table

    def __getitem__(self, name: str) -> np.ndarray:
        return self.table.values[:, self.names.index(name)].copy()

    def stack(self, names: Sequence[str]) -> np.ndarray:
        return np.column_stack([self[name] for name in names])


def open_csv(folder: Path) -> Log:
    """The log in a folder of csv files. Raises `LogError` for headers or a `log.json` that are wrong."""
    header, raw = _header(folder)
    _check_start(folder, header)
    motion = _motion_columns(_names(folder / layout.ODOMETRY))
    identified = (folder / layout.SIGHTINGS).is_file() and "id" in _names(folder / layout.SIGHTINGS)
    config = _config(folder, header, raw, motion, identified)
    events = (layout.ODOMETRY, layout.SIGHTINGS, layout.FIXES, layout.LANDMARKS, layout.HEADER)
    return Log(
        name=header.name or folder.resolve().name,
        source=str(folder),
        defaults=config,
        open=StreamEvents(lambda: _streams(folder, header.landmarks_complete)),
        references=tuple(_references(folder, header)),
        start=np.array(header.start),
        start_covariance=np.array(header.start_covariance),
        files=tuple(str(folder / name) for name in events if (folder / name).is_file()),
        truth_ids=header.truth_ids,
    )


def _header(folder: Path) -> tuple[layout.Header, Any]:
    """`log.json`, checked, and as it stands: so that what it leaves out can be told."""
    path = folder / layout.HEADER
    if not path.is_file():
        return layout.Header(), {}
    text = read_text(path)
    try:
        return msgspec.json.decode(text, type=layout.Header), msgspec.json.decode(text)
    except msgspec.ValidationError as error:
        # msgspec says "what is wrong - at `$.config.motion`" and names an unknown key itself.
        problem, _, place = str(error).partition(" - at ")
        raise LogError(problem, file=path, field=place.strip("`").removeprefix("$.") or None) from error
    except msgspec.DecodeError as error:
        raise LogError(f"not JSON: {error}", file=path) from error


def _check_start(folder: Path, header: layout.Header) -> None:
    covariance = np.array(header.start_covariance)
    if np.allclose(covariance, covariance.T, rtol=1e-9, atol=0.0):
        smallest, *_, largest = np.linalg.eigvalsh(covariance).tolist()
        if smallest >= -ROUNDED * max(largest, 0.0):
            return
        problem = "is not positive semi-definite"
    else:
        problem = "expected a symmetric matrix"
    raise LogError(problem, file=folder / layout.HEADER, field="start_covariance")


def _config(
    folder: Path, header: layout.Header, raw: Any, motion: tuple[str, ...], identified: bool
) -> RunConfig:
    """The settings of `log.json`, completed by what the tables show."""
    models = layout.MOTIONS[motion]
    config = header.config or RunConfig()
    if not layout.names(raw, "config", "association", "method"):
        chosen = msgspec.structs.replace(config.association, method="known" if identified else "likelihood")
        config = msgspec.structs.replace(config, association=chosen)
    if not layout.names(raw, "config", "motion", "sample_time"):
        period = _sample_time(folder / layout.ODOMETRY)
        config = msgspec.structs.replace(
            config, motion=msgspec.structs.replace(config.motion, sample_time=period)
        )
    if not layout.names(raw, "config", "motion", "model"):
        return msgspec.structs.replace(config, motion=msgspec.structs.replace(config.motion, model=models[0]))
    if config.motion.model not in models:
        raise LogError(
            f"{config.motion.model!r} does not go with the columns {', '.join(motion)} of {layout.ODOMETRY}",
            file=folder / layout.HEADER,
            field="config.motion.model",
        )
    return config


def _sample_time(path: Path) -> float:
    """The odometry's median period, s, for which the sigmas are meant: a sample split at a sighting then
    keeps its noise. 0 where a record says itself how long it lasted, or no period can be told.
    """
    odometry = _odometry(path)
    steps = np.diff(odometry.times[np.isfinite(odometry.times)])
    steps = steps[steps > 0.0]
    return 0.0 if odometry.durations is not None or not len(steps) else float(np.median(steps))


def _lines(path: Path) -> tuple[list[list[str]], list[int]]:
    """The records of a csv file that are not blank, and the line on which each ends."""
    if not path.is_file():
        raise LogError("not found", file=path)
    reader = csv.reader(io.StringIO(read_text(path), newline=""), strict=True)
    rows, numbers = [], []
    try:
        for row in reader:
            if row:
                rows.append(row)
                numbers.append(reader.line_num)
    except csv.Error as error:
        raise LogError(f"not csv: {error}", file=path, record=reader.line_num) from error
    if not rows:
        raise LogError("is empty: expected a header row", file=path)
    return rows, numbers


def _names(path: Path) -> tuple[str, ...]:
    """The header row alone."""
    if not path.is_file():
        raise LogError("not found", file=path)
    try:
        with path.open(encoding="utf-8-sig", errors="replace", newline="") as stream:
            return tuple(name.strip() for name in next(csv.reader(stream), []))
    except (OSError, csv.Error) as error:
        raise LogError(f"cannot be read: {error}", file=path) from error


def _read(
    path: Path, required: Sequence[str], optional: Sequence[str] | None, blank: Sequence[str] = ()
) -> _Columns:
    """A file with the required columns.

    optional: what others there may be; None: any. blank: which of the required may be blank, as may the
    others then.
    """
    rows, numbers = _lines(path)
    names = tuple(name.strip() for name in rows[0])
    for name in required:
        if name not in names:
            raise LogError(
                f"no such column; found {', '.join(names)}", file=path, record=numbers[0], field=name
            )
    for k, name in enumerate(names):
        if not name or name in names[:k]:
            raise LogError("column without name or named twice", file=path, record=numbers[0], field=name)
        if optional is not None and name not in required and name not in optional:
            raise LogError("unknown column", file=path, record=numbers[0], field=name)
    may_be_blank = [name for name in names if name not in required or name in blank] if blank else ()
    table = parse_rows(rows[1:], np.array(numbers[1:], dtype=np.int64), names, may_be_blank)
    return _Columns(path, names, table)


def _motion_columns(names: Sequence[str]) -> tuple[str, ...]:
    for columns in layout.MOTIONS:
        if set(columns) <= set(names):
            return columns
    return next(iter(layout.MOTIONS))


def _streams(folder: Path, landmarks_complete: bool) -> Streams:
    known = None
    if landmarks_complete and (folder / layout.LANDMARKS).is_file():
        known = _landmarks(folder)[0]
    return Streams(
        refuse_early=True,
        odometry=_odometry(folder / layout.ODOMETRY),
        sightings=_sightings(folder / layout.SIGHTINGS) if (folder / layout.SIGHTINGS).is_file() else None,
        fixes=_fixes(folder / layout.FIXES) if (folder / layout.FIXES).is_file() else None,
        known_ids=known,
    )


def _odometry(path: Path) -> OdometryStream:
    motion = _motion_columns(_names(path))
    terms = layout.covariance_columns(motion)
    columns = _read(path, ("time", *motion), ("duration", *terms))
    times = columns["time"]
    durations = columns["duration"] if "duration" in columns.names else None
    if durations is None and motion == ("dx", "dy", "dtheta"):
        # The first movement's beginning is not known: it is taken to have lasted as long as the second.
        steps = np.maximum(np.nan_to_num(np.diff(times)), 0.0)
        durations = np.concatenate([steps[:1], steps]) if len(steps) else np.ones(len(times))
    return OdometryStream(
        file=str(path),
        times=times,
        records=columns.table.records,
        malformed=columns.table.malformed,
        names=motion,
        values=columns.stack(motion),
        covariance=_covariance(columns, motion),
        durations=durations,
    )


def _covariance(columns: _Columns, names: tuple[str, ...]) -> np.ndarray | None:
    """(n, c, c) from the columns of its upper triangle; all of them or none."""
    terms = layout.covariance_columns(names)
    there = [name for name in terms if name in columns.names]
    if not there:
        return None
    for name in terms:
        if name not in there:
            raise LogError(f"is missing beside {there[0]}", file=columns.path, record=1, field=name)
    covariance = np.zeros((len(columns.table.values), len(names), len(names)))
    for name, (i, j) in terms.items():
        covariance[:, i, j] = covariance[:, j, i] = columns[name]
    return covariance


def _sightings(path: Path) -> SightingStream:
    columns = _read(path, ("time", "range", "bearing"), None, blank=("range", "bearing"))
    values = columns.stack(("range", "bearing"))
    # A frame in which nothing was seen is a row with a time and nothing else.
    empty = np.isnan(columns.table.values).sum(axis=1) == len(columns.names) - 1
    empty &= np.isfinite(columns["time"])
    ids = None
    if "id" in columns.names:
        numbers = columns["id"]
        numbers = np.where(np.isnan(numbers), -1.0, numbers)
        ids = identities(numbers)
    terms = layout.covariance_columns(("range", "bearing"))
    others = [name for name in columns.names if name not in ("time", "range", "bearing", "id", *terms)]
    return SightingStream(
        file=str(path),
        times=columns["time"],
        records=columns.table.records,
        malformed=columns.table.malformed,
        values=values,
        ids=ids,
        covariance=_covariance(columns, ("range", "bearing")),
        attributes={name: columns[name] for name in others} or None,
        empty=empty if empty.any() else None,
    )


def _fixes(path: Path) -> FixStream:
    columns = _read(path, ("time", "x", "y"), ("heading",), blank=("heading",))
    heading = columns["heading"] if "heading" in columns.names else np.full(len(columns.table.values), np.nan)
    return FixStream(
        file=str(path),
        times=columns["time"],
        records=columns.table.records,
        malformed=columns.table.malformed,
        values=np.column_stack([columns["x"], columns["y"], heading]),
    )


def _landmarks(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    columns = _whole(_read(folder / layout.LANDMARKS, ("id", "x", "y"), ()), ("id", "x", "y"))
    return identities(columns["id"]), columns.stack(("x", "y"))


def _whole(columns: _Columns, finite: Sequence[str]) -> _Columns:
    """A table that nothing can be skipped in: every row must be good."""
    table = columns.table
    for row, why in sorted(table.malformed.items()):
        raise LogError(why.problem, file=columns.path, record=int(table.records[row]), field=why.field)
    for name in finite:
        bad = np.flatnonzero(~np.isfinite(columns[name]))
        if len(bad):
            raise LogError(
                f"expected a finite number, found {columns[name][bad[0]]}",
                file=columns.path,
                record=int(table.records[bad[0]]),
                field=name,
            )
    return columns


def _references(folder: Path, header: layout.Header) -> list[Reference]:
    """`truth.csv` and `landmarks.csv` as one reference; the fixes as another."""
    found = []
    truth, ids, landmarks = np.zeros((0, 4)), np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    has_truth, has_landmarks = (folder / layout.TRUTH).is_file(), (folder / layout.LANDMARKS).is_file()
    if has_landmarks:
        ids, landmarks = _landmarks(folder)
    if has_truth:
        columns = _read(folder / layout.TRUTH, ("time", "x", "y", "heading"), (), blank=("heading",))
        truth = _whole(columns, ("time", "x", "y")).stack(("time", "x", "y", "heading"))
    if has_truth or has_landmarks:
        found.append(
            Reference(
                frame=header.truth_frame,
                kind=header.truth_kind,
                point=np.array(header.truth_point),
                times=truth[:, 0].copy(),
                positions=truth[:, 1:3].copy(),
                headings=truth[:, 3].copy(),
                landmark_ids=ids,
                landmarks=landmarks,
            )
        )
    if (folder / layout.FIXES).is_file():
        fixes = _fixes(folder / layout.FIXES)
        good = np.isfinite(fixes.times) & np.isfinite(fixes.values[:, :2]).all(axis=1)
        if good.any():
            values = fixes.values[good]
            found.append(
                Reference(
                    frame="other",
                    kind="gps",
                    times=fixes.times[good],
                    positions=values[:, :2].copy(),
                    headings=values[:, 2].copy(),
                )
            )
    return found
