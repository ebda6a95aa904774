"""The `.dat` logs of CoreSLAM and BreezySLAM: Mines ParisTech's robot with a URG-04LX and wheel encoders.

One line a scan, 707 numbers: time us, a status, ticks of the left and of the right wheel, 20 further status
values, 683 ranges mm. The robot's constants are those published with both programs (Steux & El Hamzaoui 2010). Ranges
below 20 are error codes. Stamps are of when a line was put together, the scans are evenly spaced.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from kalmap.data.covered import without_cover
from kalmap.data.drive import Drive, DriveEvents, cleaned, interpolated
from kalmap.data.laser_classes import laser_defaults
from kalmap.data.text import read_table, read_text
from kalmap.geometry.se2 import compose, exponential
from kalmap.records import Log, LogError

BEAMS = 683
FIRST_RANGE = 24
WHEEL_RADIUS = 0.077
"""m."""
HALF_BASE = 0.165
"""m, half the distance between the wheels."""
TICKS = 2000.0
"""Of a wheel's turn."""
MOUNT = np.array([0.145, 0.0, 0.0])
"""The laser ahead of the middle of the axle."""
FORWARD = 340
"""The beam that looks ahead."""
SPACING_DEG = 360.0 / 1024.0
FIRST_DISTANCE = 0.020
"""m: what is less is an error code."""
SIGMA_STAMP = 0.01
"""s, what is left when the stamps have been evened."""
FARTHEST_STAMP = 0.5
"""s, from when the scan was taken; a computer hangs for no longer."""
NEAR_TURNS = 50
"""Of the scanner, whose stamps say together when each was."""
_HEAD = 1 << 14


def is_coreslam(path: Path) -> bool:
    """Whether a `.dat` begins with a line of 707 numbers, time, ticks and ranges whole ones."""
    if path.suffix != ".dat":
        return False
    try:
        with path.open("rb") as stream:
            words = stream.read(_HEAD).partition(b"\n")[0].split()
    except OSError:
        return False
    whole = [*words[:1], *words[2:4], *words[FIRST_RANGE:]]
    return len(words) == FIRST_RANGE + BEAMS and all(word.lstrip(b"-").isdigit() for word in whole)


def open_coreslam(path: Path) -> Log:
    """The log in a `.dat`. Raises LogError if it cannot be read; bad lines come up when the log is iterated."""
    drive = without_cover(read_coreslam(path))
    return Log(
        name=path.stem,
        source=str(path),
        defaults=laser_defaults(drive, sigma_stamp=SIGMA_STAMP),
        open=DriveEvents(drive),
        files=(str(path),),
    )


def read_coreslam(path: Path) -> Drive:
    """All scans of a `.dat`, the robot's poses by its wheels from (0, 0, 0) on. Records are line numbers."""
    names = ["time", "status", "left", "right", *(f"status {k}" for k in range(4, FIRST_RANGE))]
    names += [f"range {k + 1}" for k in range(BEAMS)]
    table = read_table(read_text(path), names)
    if not len(table.values):
        raise LogError("holds no scans", file=path)
    good = np.ones(len(table.values), dtype=bool)
    good[list(table.malformed)] = False
    stamps = table.values[:, 0] / 1e6
    times, poses = stamps.copy(), np.full((len(good), 3), np.nan)
    times[good] = evened(stamps[good])
    poses[good] = _reckoned(table.values[good, 2:4])
    if (times[good] != stamps[good]).any():
        poses[good] = interpolated(stamps[good], poses[good], times[good])[0]
    ranges = cleaned(table.values[:, FIRST_RANGE:] / 1000.0, FIRST_DISTANCE, np.inf)
    bearings = np.deg2rad((np.arange(BEAMS) - FORWARD) * SPACING_DEG)
    return Drive(
        file=str(path),
        stamps=stamps,
        times=times,
        records=table.records,
        poses=poses,
        ranges=list(ranges),
        bearings=[bearings] * len(ranges),
        malformed=table.malformed,
        mount=MOUNT,
    )


def evened(stamps: np.ndarray) -> np.ndarray:
    """(n,) s, when the scans were taken, up to what all are late by; stamps: (n,) s, when they and the ticks were read.

    The scanner turns at a constant rate and knows nothing of the computer that asks it, 30 ms early or late.
    Every line is a turn; over some seconds the median says which. The stamps stay where one of them is none, goes
    back, or is far from where it should be.
    """
    if len(stamps) < 2 * NEAR_TURNS or not np.isfinite(stamps).all() or (np.diff(stamps) < 0.0).any():
        return stamps
    turns = np.arange(len(stamps))
    period = float(np.median(stamps[NEAR_TURNS:] - stamps[:-NEAR_TURNS])) / NEAR_TURNS
    late = np.pad(stamps - period * turns, NEAR_TURNS // 2, mode="edge")
    even = period * turns + np.median(sliding_window_view(late, NEAR_TURNS + 1), axis=1)
    return even if np.abs(even - stamps).max() < FARTHEST_STAMP and (np.diff(even) > 0.0).all() else stamps


def _reckoned(ticks: np.ndarray) -> np.ndarray:
    """Poses (n, 3) on arcs of constant curvature; ticks (n, 2): left, right."""
    way = np.diff(ticks, axis=0) * (2.0 * np.pi * WHEEL_RADIUS / TICKS)
    turn = (way[:, 1] - way[:, 0]) / (2.0 * HALF_BASE)
    steps = exponential(np.column_stack([way.mean(axis=1), np.zeros(len(way)), turn]))
    poses = np.zeros((len(ticks), 3))
    for k, step in enumerate(steps):
        poses[k + 1] = compose(poses[k], step)
    return poses
