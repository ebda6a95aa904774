"""A trajectory as files: the TUM format of evo and others, and a table with covariances that reads back exactly."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kalmap.data.files import csv_text, read_text
from kalmap.records import LogError, Trajectory

COLUMNS = ("time", "x", "y", "heading", "p_xx", "p_xy", "p_xt", "p_yy", "p_yt", "p_tt")
_UPPER_3 = np.triu_indices(3)


def by_stamp(trajectory: Trajectory) -> Trajectory:
    """With the log's own stamps for times, and in their order."""
    stamps = trajectory.printed()
    order = np.argsort(stamps, kind="stable")
    return Trajectory(stamps[order], trajectory.poses[order], trajectory.covariances[order])


def tum_text(course: Trajectory) -> str:
    """Time, position and unit quaternion of a rotation about z, as evo and the TUM tools read it."""
    half = 0.5 * course.poses[:, 2]
    rows = zip(course.times, course.poses[:, 0], course.poses[:, 1], np.sin(half), np.cos(half), strict=True)
    return "".join(f"{t:.9f} {x:.9g} {y:.9g} 0 0 0 {z:.9g} {w:.9g}\n" for t, x, y, z, w in rows)


def trajectory_csv(course: Trajectory) -> str:
    """One row an instant; p_t is of the heading, rad."""
    upper = course.covariances[:, _UPPER_3[0], _UPPER_3[1]]
    return csv_text(COLUMNS, np.column_stack([course.times, course.poses, upper]).tolist())


def read_trajectory_csv(path: Path | str) -> Trajectory:
    """Read a `trajectory.csv`, exactly as it was written.

    Raises `LogError`, naming file, row (the header is 1) and field, for what is not such a file.
    """
    path = Path(path)
    rows = _csv_rows(path, COLUMNS)
    table = np.array([_numbers(path, number, row) for number, row in rows]).reshape(-1, 10)
    covariances = np.empty((len(table), 3, 3))
    covariances[:, _UPPER_3[0], _UPPER_3[1]] = table[:, 4:]
    covariances[:, _UPPER_3[1], _UPPER_3[0]] = table[:, 4:]
    return Trajectory(times=table[:, 0].copy(), poses=table[:, 1:4].copy(), covariances=covariances)


def _csv_rows(path: Path, columns: Sequence[str]) -> list[tuple[int, list[str]]]:
    """The rows below the header with their numbers in the file, all of them of the right length."""
    rows = [(number, row) for number, row in enumerate(csv.reader(io.StringIO(read_text(path))), 1) if row]
    if not rows or tuple(rows[0][1]) != tuple(columns):
        raise LogError(f"expected the columns {','.join(columns)}", file=path, record=1)
    for number, row in rows[1:]:
        if len(row) != len(columns):
            raise LogError(f"expected {len(columns)} fields, found {len(row)}", file=path, record=number)
    return rows[1:]


def _numbers(path: Path, number: int, row: list[str]) -> list[float]:
    values = []
    for column, text in zip(COLUMNS, row, strict=True):
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise LogError(
                f"expected a finite number, found {text!r}", file=path, record=number, field=column
            )
        values.append(value)
    return values
