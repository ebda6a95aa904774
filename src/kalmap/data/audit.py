"""`association.sqlite`: the audit trail of data association, in one file that explains itself.

`sqlite3 association.sqlite .schema` says what each column is, and `SELECT * FROM decisions WHERE frame = 812` reads
as sentences. A number that is not known is NULL and comes back as NaN; NaN itself is never written.
`kalmap.data.audit_read` reads it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kalmap.data.files import moved_into_place
from kalmap.records import REASONS, Frame, KalmapError, Reason
from kalmap.records.trail import trouble

AUDIT = "association.sqlite"
FORMAT = "kalmap-association/1"
APPLICATION = 0x6B6D6170  # "kmap", in the file's header: what kind of sqlite file this is
VERSION = 1

_SCHEMA = """
CREATE TABLE about ( -- what this file is and where it comes from
  name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE reasons ( -- why a sighting went where it went
  reason INTEGER PRIMARY KEY, name TEXT NOT NULL, sentence TEXT NOT NULL);
CREATE TABLE frames ( -- one row a frame of sightings
  frame INTEGER PRIMARY KEY, -- counted from 0
  time REAL, -- s
  x REAL, y REAL, heading REAL, -- m, m, rad: the robot's pose as predicted, before the frame was used
  sensor_x REAL, sensor_y REAL, sensor_heading REAL, -- m, m, rad: the sensor's own pose
  gate REAL, new_gate REAL, -- squared Mahalanobis distances: a pair is possible below, a new landmark beyond
  contests INTEGER NOT NULL, between_gates INTEGER NOT NULL, offsets INTEGER NOT NULL, rivals INTEGER NOT NULL);
    -- sightings decided in doubt, by kind of doubt
CREATE TABLE notes ( -- what is true of a whole frame
  frame INTEGER, number INTEGER, note TEXT NOT NULL, PRIMARY KEY (frame, number)) WITHOUT ROWID;
CREATE TABLE sightings ( -- one row a sighting
  frame INTEGER, sighting INTEGER, -- the place in its frame, from 0
  range REAL, bearing REAL, -- m, rad, in the sensor's frame
  landmark INTEGER NOT NULL, -- what it was given to or founded; -2: left unused
  reason INTEGER NOT NULL,
  trial INTEGER NOT NULL, -- 1 if that landmark was still on trial afterwards
  noise_rr REAL, noise_rb REAL, noise_bb REAL, -- m^2, m rad, rad^2: its covariance
  PRIMARY KEY (frame, sighting)) WITHOUT ROWID;
CREATE TABLE candidates ( -- one row a pair that was considered
  frame INTEGER, number INTEGER, sighting INTEGER NOT NULL, landmark INTEGER NOT NULL,
  squared REAL, -- squared Mahalanobis distance d^2
  log_volume REAL, -- ln det S
  PRIMARY KEY (frame, number)) WITHOUT ROWID;
CREATE TABLE expected ( -- where the landmarks of the pairs were expected
  frame INTEGER, number INTEGER, landmark INTEGER NOT NULL,
  x REAL, y REAL, -- m, in the map
  p_xx REAL, p_xy REAL, p_yy REAL, -- m^2: covariance in the map's axes, sensor noise left out
  PRIMARY KEY (frame, number)) WITHOUT ROWID;
CREATE TABLE managed ( -- what happened to landmarks
  frame INTEGER, number INTEGER, landmark INTEGER NOT NULL,
  action TEXT NOT NULL, -- founded, confirmed, retired or merged
  why TEXT NOT NULL,
  into_landmark INTEGER NOT NULL, -- the other landmark of a merger, else -1
  PRIMARY KEY (frame, number)) WITHOUT ROWID;
CREATE TABLE landmarks ( -- the life of every landmark number, in frames; NULL: that never happened
  landmark INTEGER PRIMARY KEY,
  fate TEXT NOT NULL, -- confirmed, trial, retired or merged: what it was at the end
  founded INTEGER, confirmed INTEGER, ended INTEGER,
  merged_into INTEGER,
  sightings INTEGER NOT NULL, first_seen INTEGER, last_seen INTEGER);
CREATE VIEW decisions AS -- for people
  SELECT s.frame, f.time, s.sighting, s.landmark, c.squared, f.gate, r.sentence
  FROM sightings s JOIN frames f USING (frame) JOIN reasons r USING (reason)
  LEFT JOIN candidates c ON c.frame = s.frame AND c.sighting = s.sighting AND c.landmark = s.landmark;
"""

# After the rows, so that they are built in one go.
_INDICES = (
    "CREATE INDEX sightings_of_landmark ON sightings (landmark)",
    "CREATE INDEX candidates_of_landmark ON candidates (landmark)",
    "CREATE INDEX managed_of_landmark ON managed (landmark)",
    "CREATE INDEX frames_by_time ON frames (time)",
)

_LANDMARKS = """
INSERT INTO landmarks
WITH
  known AS (SELECT landmark FROM sightings WHERE landmark >= 0 UNION SELECT landmark FROM candidates
    UNION SELECT landmark FROM managed UNION SELECT into_landmark FROM managed WHERE into_landmark >= 0),
  seen AS (SELECT landmark, count(*) AS times, min(frame) AS first_seen, max(frame) AS last_seen,
    min(CASE WHEN trial = 0 THEN frame END) AS believed, min(CASE WHEN reason = :founded THEN frame END) AS founded
    FROM sightings GROUP BY landmark),
  done AS (SELECT landmark, min(CASE WHEN action = 'founded' THEN frame END) AS founded,
    min(CASE WHEN action = 'confirmed' THEN frame END) AS confirmed,
    max(CASE WHEN action = 'retired' THEN frame END) AS retired,
    max(CASE WHEN action = 'merged' THEN frame END) AS merged,
    max(CASE WHEN action = 'merged' THEN into_landmark END) AS target FROM managed GROUP BY landmark),
  lives AS (SELECT landmark, coalesce(done.founded, seen.founded) AS founded,
    coalesce(done.confirmed, seen.believed) AS confirmed, retired, merged, target,
    coalesce(times, 0) AS times, first_seen, last_seen
    FROM known LEFT JOIN seen USING (landmark) LEFT JOIN done USING (landmark))
SELECT landmark,
  CASE WHEN merged IS NOT NULL THEN 'merged' WHEN retired IS NOT NULL THEN 'retired'
    WHEN confirmed IS NULL AND (founded IS NOT NULL OR times > 0) THEN 'trial' ELSE 'confirmed' END,
  founded, confirmed, coalesce(merged, retired), target, times, first_seen, last_seen
FROM lives
"""

_COLUMNS = {"frames": 14, "notes": 3, "sightings": 10, "candidates": 6, "expected": 8, "managed": 6}
_AT_ONCE = 200  # frames whose rows are handed over together
_Rows = dict[str, list[tuple[Any, ...]]]


def write_audit(path: Path | str, frames: Iterable[Frame], meta: Mapping[str, str]) -> None:
    """Write an audit trail as one sqlite file: a reader sees the file that was there before, or all of the new one.

    meta: name and text of anything that says where the trail comes from (log, method, command).
    Raises KalmapError if a frame's arrays do not fit each other, two frames have the same number, or the file cannot
    be written; then the file that was there before is still there.
    """
    path = Path(path)
    try:
        with moved_into_place(path) as part:
            _write(part, frames, meta)
    except sqlite3.IntegrityError as error:
        raise KalmapError(f"{path}: two frames of the audit trail have the same number") from error
    except sqlite3.Error as error:
        raise KalmapError(f"{path}: cannot be written: {error}") from error


def _write(path: Path, frames: Iterable[Frame], meta: Mapping[str, str]) -> None:
    """One transaction, without a journal: the file is nobody's until it is moved into place."""
    connection = sqlite3.connect(path, isolation_level=None)
    try:
        connection.executescript(
            f"PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF; PRAGMA application_id = {APPLICATION};"
            f"PRAGMA user_version = {VERSION}; BEGIN; {_SCHEMA}"
        )
        about = {**meta, "format": FORMAT, "units": "m, s, rad; squared Mahalanobis distances have none"}
        connection.executemany("INSERT INTO about VALUES (?, ?)", about.items())
        reasons = [(int(reason), Reason(reason).name, REASONS[reason]) for reason in REASONS]
        connection.executemany("INSERT INTO reasons VALUES (?, ?, ?)", reasons)
        for rows in _batches(frames):
            for table, found in rows.items():
                marks = ", ".join("?" * _COLUMNS[table])
                connection.executemany(f"INSERT INTO {table} VALUES ({marks})", found)
        connection.execute(_LANDMARKS, {"founded": int(Reason.FOUNDED)})
        for statement in (*_INDICES, "COMMIT"):
            connection.execute(statement)
    finally:
        connection.close()


def _batches(frames: Iterable[Frame]) -> Iterator[_Rows]:
    """The rows of all tables, a few hundred frames at a time."""
    rows: _Rows = {name: [] for name in _COLUMNS}
    for count, frame in enumerate(frames, 1):
        _check(frame)
        _add(rows, frame)
        if count % _AT_ONCE == 0:
            yield rows
            rows = {name: [] for name in _COLUMNS}
    yield rows


def _check(frame: Frame) -> None:
    """Raise KalmapError unless all arrays of a frame have the lengths that the others ask for."""
    why, sightings, pairs, landmarks = (
        frame.why,
        len(frame.values),
        len(frame.why.pairs),
        len(frame.landmarks),
    )
    wanted = (
        ("pose", frame.pose, (3,)),
        ("sensor", frame.sensor, (3,)),
        ("values", frame.values, (sightings, 2)),
        ("labels", frame.labels, (sightings,)),
        ("trial", frame.trial, (sightings,)),
        ("reasons", why.reasons, (sightings,)),
        ("noises", frame.noises, (sightings, 2, 2)),
        ("pairs", why.pairs, (pairs, 2)),
        ("squared", why.squared, (pairs,)),
        ("log_volume", why.log_volume, (pairs,)),
        ("landmarks", frame.landmarks, (landmarks,)),
        ("positions", frame.positions, (landmarks, 2)),
        ("spreads", frame.spreads, (landmarks, 2, 2)),
    )
    for name, values, shape in wanted:
        # Nothing of something may come with any shape: an empty list made an array.
        if values is not None and np.shape(values) != shape and (np.size(values) or np.prod(shape)):
            raise KalmapError(
                f"frame {frame.number} of the audit trail: {name}: expected {shape}, found {np.shape(values)}"
            )
    if pairs and not 0 <= why.pairs[:, 0].min() <= why.pairs[:, 0].max() < sightings:
        raise KalmapError(
            f"frame {frame.number} of the audit trail: pairs: speak of a sighting that is not there"
        )


def _add(rows: _Rows, frame: Frame) -> None:
    """Append a frame's rows. Covariances keep their lower triangle."""
    number, why, found = frame.number, frame.why, trouble(frame)
    head = (number, frame.time, *frame.pose.tolist(), *frame.sensor.tolist(), why.gate, why.new_gate)
    counts = (found.contests, found.between_gates, found.offsets, found.rivals)
    rows["frames"].append((*head, *counts))
    rows["notes"] += [(number, k, note) for k, note in enumerate(why.notes)]
    labels, reasons, trial = frame.labels.tolist(), why.reasons.tolist(), frame.trial.tolist()
    seen = zip(frame.values.tolist(), labels, reasons, trial, _lower(frame.noises, len(labels)))
    rows["sightings"] += [
        (number, m, *value, label, reason, int(on_trial), *noise)
        for m, (value, label, reason, on_trial, noise) in enumerate(seen)
    ]
    pairs = zip(why.pairs.tolist(), why.squared.tolist(), why.log_volume.tolist())
    rows["candidates"] += [
        (number, k, *pair, squared, volume) for k, (pair, squared, volume) in enumerate(pairs)
    ]
    places = zip(
        frame.landmarks.tolist(), frame.positions.tolist(), _lower(frame.spreads, len(frame.landmarks))
    )
    rows["expected"] += [
        (number, k, landmark, *position, *spread) for k, (landmark, position, spread) in enumerate(places)
    ]
    rows["managed"] += [
        (number, k, one.landmark, one.action, one.why, one.into) for k, one in enumerate(why.managed)
    ]


def _lower(covariances: np.ndarray | None, count: int) -> list[Any]:
    """The three numbers of each symmetric (2, 2); three unknown ones where there are none."""
    if covariances is None:
        return [(None, None, None)] * count
    return covariances.reshape(-1, 4)[:, (0, 2, 3)].tolist()
