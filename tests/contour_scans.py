"""Ray-cast scans of rooms, columns and doorways, for the tests of contours."""

from __future__ import annotations

import numpy as np

from kalmap.records import Scan, SensorConfig
from kalmap.simulate.raycast import cast

SIGMA = 0.01
LASER = SensorConfig(sigma_range=SIGMA, max_range=80.0, field_of_view_deg=360.0)
HALF = np.deg2rad(np.arange(-90.0, 90.0, 1.0))
FINE = np.deg2rad(np.arange(-90.0, 90.1, 0.5))
FULL = np.deg2rad(np.arange(-180.0, 180.0, 0.5))
NONE = np.zeros((0, 3))


def scan_of(*, walls=None, circles=NONE, bearings=FINE, pose=(0.0, 0.0, 0.0), rng=None, sigma=SIGMA):
    """One scan from `pose` among walls (S, 4) and circles (N, 3), noisy if there is an `rng`."""
    segments = None if walls is None else np.array(walls, dtype=float)
    ranges = cast(
        np.array([pose], dtype=float), np.array(circles, dtype=float), bearings, 80.0, segments=segments
    )[0]
    if rng is not None:
        ranges = ranges + sigma * rng.standard_normal(len(ranges))
    return Scan(0.0, ranges, bearings)


def room(left, bottom, right, top):
    """Four walls (4, 4)."""
    return [
        [left, bottom, right, bottom],
        [right, bottom, right, top],
        [right, top, left, top],
        [left, top, left, bottom],
    ]
