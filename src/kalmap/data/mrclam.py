"""UTIAS MRCLAM: five indoor robots and 15 bar-coded landmarks (Leung et al., IJRR 30(8), 2011).

One robot's log at a time. Its sightings of other robots are left out. A bar code that the run's table
does not list has no subject: its sighting keeps the id -1. Clock: Unix seconds.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from kalmap.data.blocks import StreamEvents
from kalmap.data.streams import OdometryStream, SightingStream, Streams, find_faults, identities
from kalmap.data.text import Table, read_table, read_text
from kalmap.records import AssociationConfig, Log, LogError, MotionConfig, Reference, RunConfig, SensorConfig

DEFAULTS = RunConfig(
    motion=MotionConfig(
        model="unicycle",
        sigma_speed=0.02,
        sigma_turn_rate_deg=1.5,
        sigma_turn_rate_ratio=0.2,
        sample_time=1.0,
        exact_standstill=True,
        biases=("speed_scale", "turn_rate_scale"),
        prior_speed_scale=0.1,
        prior_turn_rate_scale=0.1,
    ),
    sensor=SensorConfig(
        sigma_range=0.05,
        sigma_range_ratio=0.05,
        sigma_bearing_deg=1.0,
        outlier_gate=0.999,
        max_range=10.0,
        field_of_view_deg=75.0,
    ),
    association=AssociationConfig(
        method="known", management="trial", confirm=6, confirm_window=60, ambiguity=4.6
    ),
)

COMMAND_LATENCY = 0.2
"""s: the odometry rows are commands, which the robots obey this much later. Turning against motion capture fits
best with 0.2 or 0.3 s in all ten robot runs that have it."""

LAST_ROBOT = 5
"""Subjects 1 to 5 are the robots, 6 to 20 the landmarks."""


def mrclam_robots(path: str | Path) -> list[int]:
    """The robots whose odometry a MRCLAM folder holds, in order; empty for any other folder."""
    found = (re.fullmatch(r"Robot(\d+)_Odometry\.dat(\.xz)?", p.name) for p in Path(path).glob("Robot*"))
    return sorted({int(match.group(1)) for match in found if match})


def open_mrclam(folder: Path, robot: int | None) -> Log:
    """The log of one robot, by default the first.

    With motion capture of that robot the map frame is the capture's and the start is the true pose at
    the first odometry record. Without, the start is (0, 0, 0) and the landmarks' reference must be aligned.
    """
    robots = mrclam_robots(folder)
    robot = 1 if robot is None else robot
    if robot not in robots:
        there = ", ".join(map(str, robots)) or "none"
        raise LogError(f"no odometry of robot {robot}; robots in this folder: {there}", file=folder)
    files = [
        _existing(folder, f"Robot{robot}_Odometry.dat"),
        _existing(folder, f"Robot{robot}_Measurement.dat"),
        _existing(folder, "Barcodes.dat"),
    ]
    ids, landmarks = _landmarks(folder)
    truth = _find(folder, f"Robot{robot}_Groundtruth.dat")
    start, reference = np.zeros(3), None
    if truth is not None:
        start, reference = _truth(truth, _odometry(files[0]), ids, landmarks)
    elif len(ids):
        reference = Reference(frame="other", kind="survey", landmark_ids=ids, landmarks=landmarks)
    number = re.search(r"(\d+)$", folder.resolve().name)
    return Log(
        name=f"mrclam-{number.group(1)}-robot-{robot}" if number else f"mrclam-robot-{robot}",
        source=str(folder),
        defaults=DEFAULTS,
        open=StreamEvents(lambda: Streams(odometry=_odometry(files[0]), sightings=_sightings(*files[1:]))),
        references=() if reference is None else (reference,),
        start=start,
        files=tuple(map(str, files)),
    )


def _find(folder: Path, name: str) -> Path | None:
    return next((p for p in (folder / name, folder / f"{name}.xz") if p.is_file()), None)


def _existing(folder: Path, name: str) -> Path:
    path = _find(folder, name)
    if path is None:
        raise LogError("not found, neither plain nor with .xz", file=folder / name)
    return path


def _whole(path: Path, columns: tuple[str, ...]) -> np.ndarray:
    """A small table that the whole log depends on: every row must be good."""
    table = read_table(read_text(path), columns)
    for row, why in sorted(table.malformed.items()):
        raise LogError(why.problem, file=path, record=int(table.records[row]), field=why.field)
    wrong = np.argwhere(~np.isfinite(table.values))
    if len(wrong):
        row, column = wrong[0]
        raise LogError(
            f"expected a finite number, found {table.values[row, column]}",
            file=path,
            record=int(table.records[row]),
            field=columns[column],
        )
    return table.values


def _landmarks(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    path = _find(folder, "Landmark_Groundtruth.dat")
    if path is None:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    rows = _whole(path, ("subject", "x", "y", "std x", "std y"))
    return identities(rows[:, 0]), np.ascontiguousarray(rows[:, 1:3])


def _truth(
    path: Path, odometry: OdometryStream, ids: np.ndarray, landmarks: np.ndarray
) -> tuple[np.ndarray, Reference]:
    """The start pose, interpolated at the first odometry record, and the reference.

    Raises `LogError` if the capture does not cover that instant: the start would be a guess.
    """
    rows = _whole(path, ("time", "x", "y", "heading"))
    times, poses = rows[:, 0], rows[:, 1:]
    begin = odometry.times[find_faults(odometry)[0]][:1]
    if not len(times) or not len(begin) or not times[0] <= begin[0] <= times[-1]:
        raise LogError("does not cover the time of the first odometry record", file=path)
    x, y = (float(np.interp(begin[0], times, poses[:, k])) for k in (0, 1))
    heading = float(np.interp(begin[0], times, np.unwrap(poses[:, 2])))
    reference = Reference(
        times=times.copy(),
        positions=np.ascontiguousarray(poses[:, :2]),
        headings=poses[:, 2].copy(),
        landmark_ids=ids,
        landmarks=landmarks,
    )
    wrapped = (heading + np.pi) % (2 * np.pi) - np.pi
    return np.array([x, y, wrapped]), reference


def _odometry(path: Path) -> OdometryStream:
    names = ("speed", "turn_rate")
    table = read_table(read_text(path), ("time", *names))
    times = table.values[:, 0] + COMMAND_LATENCY
    # Four of the five robots of run 9 begin like this; the command belongs to something before the run.
    early = len(times) > 1 and times[0] > times[1]
    return OdometryStream(
        file=str(path),
        times=times,
        records=table.records,
        malformed=table.malformed,
        left_out={0: "the first command is stamped later than the second"} if early else {},
        names=names,
        values=np.ascontiguousarray(table.values[:, 1:]),
    )


def _sightings(path: Path, barcodes: Path) -> SightingStream:
    table = read_table(read_text(path), ("time", "barcode", "range", "bearing"))
    subjects = _subjects(table, _whole(barcodes, ("subject", "barcode")))
    # Rows without a proper bar code are kept so that they are reported.
    kept = (subjects > LAST_ROBOT) | (subjects < 0)
    place = np.cumsum(kept) - 1
    return SightingStream(
        file=str(path),
        times=table.values[kept, 0],
        records=table.records[kept],
        malformed={int(place[row]): why for row, why in table.malformed.items()},
        values=table.values[kept, 2:],
        ids=subjects[kept],
    )


def _subjects(table: Table, barcodes: np.ndarray) -> np.ndarray:
    """(n,) the subject that each row's bar code belongs to, -1 for none; -2 where it is no number."""
    subject_of = dict(zip(barcodes[:, 1].tolist(), identities(barcodes[:, 0]).tolist()))
    codes, which = np.unique(table.values[:, 1], return_inverse=True)
    known = np.array([subject_of.get(float(code), -1) for code in codes], dtype=np.int64)
    known[~np.isfinite(codes)] = -2
    return known[which]
