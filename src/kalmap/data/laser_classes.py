"""Classes of laser scanners, and the settings that a log of raw scans starts from.

A log does not name its scanner. It is taken for URG-like if its largest true range, or what it states as the scanner's
range, is at most 6 m, and its beams cover more than 190 degrees or lie closer than 0.45 degrees; else for SICK-like.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.data.drive import Drive, steps_of
from kalmap.data.odometry_gaps import INDOOR
from kalmap.records import ContourConfig, FilterConfig, RunConfig, SensorConfig


class LaserClass(msgspec.Struct, frozen=True):
    """A kind of scanner. max_range: m, to which it is of use; clear_range: as in `ContourConfig`; the rest as in
    `SensorConfig`."""

    name: str
    min_range: float
    max_range: float
    sigma_range: float
    sigma_range_ratio: float
    sigma_bearing_deg: float
    beam_time: float = 0.0
    clear_range: float = ContourConfig().clear_range


SICK = LaserClass(
    "SICK-like",
    min_range=0.1,
    max_range=80.0,
    sigma_range=0.02,
    sigma_range_ratio=0.0,
    sigma_bearing_deg=0.25,
)
"""Time of flight, 180 degrees (LMS 200: 80 m, statistical error 5 mm up to 8 m, resolution 1 cm)."""

URG = LaserClass(
    "URG-like",
    min_range=0.06,
    max_range=5.6,
    sigma_range=0.02,
    sigma_range_ratio=0.01,
    sigma_bearing_deg=0.2,
    beam_time=0.1 / 1024.0,
    clear_range=4.0,
)
"""Phase shift, 240 degrees (URG-04LX: rated 4 m, accuracy 1 cm or 1 %; returns up to 5.6 m, by no means all)."""

SIGMA_LATENCY = 0.1
"""s, between the clocks of a scanner and of wheels that are read by different drivers."""
SIGMA_STAMP = 0.1 / math.sqrt(12.0)
"""s: a driver takes a sweep at any time of the next."""
LEAST_STEP = 0.02
"""m, of a way whose speed says something."""
LEAST_PAIRS = 30
"""Of steps behind each other, from which it is judged whether stamps tell the speed."""
MOST_BACKWARDS = 0.01
"""Share of stamps that may lie at or before the one before."""
SAME_CHANGE = 0.01
"""By how much a speed may change more than a way, as a share, where the scans come at a constant rate."""
URG_RANGE = 6.0
URG_FIELD_DEG = 190.0
URG_SPACING_DEG = 0.45


def laser_class(drive: Drive, stated: float = np.inf) -> LaserClass:
    """The class of a drive's scanner. stated: m, the range that the log says it has."""
    rows = drive.rows()
    if not len(rows):
        return SICK
    bearings = max((drive.bearings[row] for row in rows.tolist()), key=len)
    field = np.rad2deg(bearings[-1] - bearings[0])
    spacing = field / max(1, len(bearings) - 1)
    near = min(stated, _largest(drive, rows)) <= URG_RANGE
    fine = field > URG_FIELD_DEG or (len(bearings) > 1 and spacing < URG_SPACING_DEG)
    return URG if near and fine else SICK


def laser_defaults(drive: Drive, stated: float = np.inf, sigma_stamp: float = SIGMA_STAMP) -> RunConfig:
    """Settings for a drive: the scanner's class, its mounting and its view from the log, contours as the map.

    sigma_stamp: s, by how much stamps are off by chance, where they are of any use.
    """
    timed = stamps_tell(drive)
    kind = laser_class(drive, stated)
    widest = max((float(np.abs(bearings).max(initial=0.0)) for bearings in drive.bearings), default=0.0)
    x, y, heading = drive.mount.tolist()
    return RunConfig(
        filter=FilterConfig(name="ekf"),
        motion=INDOOR,
        sensor=SensorConfig(
            mount_x=x,
            mount_y=y,
            mount_heading_deg=float(np.rad2deg(heading)),
            sigma_range=kind.sigma_range,
            sigma_range_ratio=kind.sigma_range_ratio,
            sigma_bearing_deg=kind.sigma_bearing_deg,
            beam_time=kind.beam_time,
            min_range=kind.min_range,
            max_range=min(kind.max_range, stated, drive.reach),
            field_of_view_deg=min(360.0, max(1.0, 2.0 * float(np.rad2deg(widest)))),
        ),
        contour=ContourConfig(
            method="dc-slasem",
            sigma_latency=SIGMA_LATENCY if timed else 0.0,
            sigma_stamp=sigma_stamp if timed else 0.0,
            clear_range=kind.clear_range,
        ),
    )


def stamps_tell(drive: Drive) -> bool:
    """Whether the stamps say how fast the robot went: with them its speed changes less than its way from scan to scan.

    Where they do not, they are not of the odometry: a log then states a pose beside each scan, and the two are one.
    """
    rows = drive.rows()
    steps, _ = steps_of(drive)
    ways = np.hypot(*steps[rows, :2].T)[1:]
    took = np.diff(drive.taken[rows])
    going = ways[ways > 0.0]
    if not len(going) or (took <= 0.0).mean() > MOST_BACKWARDS:
        return False
    wanted = LEAST_STEP / float(np.median(going))
    if wanted > len(ways):
        return False  # it hardly moved
    apart = max(1, math.ceil(wanted))  # a fast scanner's steps are a few mm
    ways, took = (np.add.reduceat(each, np.arange(0, len(each), apart)) for each in (ways, took))
    pairs = (ways[1:] > LEAST_STEP) & (ways[:-1] > LEAST_STEP) & (took[1:] > 0.0) & (took[:-1] > 0.0)
    if pairs.sum() < LEAST_PAIRS:
        return False
    speeds = np.divide(ways, took, out=np.zeros(len(ways)), where=took > 0.0)
    return _change(speeds, pairs) <= _change(ways, pairs) + SAME_CHANGE


def _change(values: np.ndarray, pairs: np.ndarray) -> float:
    """By which share a value differs from the one before, in the median over pairs of them."""
    before, after = values[:-1][pairs], values[1:][pairs]
    return float(np.median(np.abs(after - before) / (after + before)))


def _largest(drive: Drive, rows: np.ndarray) -> float:
    """The largest true range, m; 0 without any."""
    largest = 0.0
    for row in rows.tolist():
        ranges = drive.ranges[row]
        largest = max(largest, float(ranges[ranges < drive.reach].max(initial=0.0)))
    return largest
