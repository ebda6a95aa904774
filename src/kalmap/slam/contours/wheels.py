"""Wheels that tell every way, and every turn, too long or too short by a share: what that moves the vehicle by.

A wheel base is known to a few percent, a radius to one. As states, the two scales would come out too small if their
derivative were the odometry's own way: its noise is what they are asked to explain (errors in variables; Fuller 1987,
Measurement Error Models, section 1.1). The way that the scans show has little of it, and stands in its place: an
instrument. It is known only when a scan has been fitted, and so the pose is given its share of the scales' errors then,
before the scan corrects it.
"""

from __future__ import annotations

import math

import numpy as np

LEAST, MOST = 0.5, 2.0
"""Factors beyond which no scale is believed."""
DRIFT = np.array([0.001, 0.003])
"""By how much the scales are others a local map later: carpets, loads, tyres."""
BIAS = np.array([0.004, 0.012])
"""By how much they come out too large on simulated floors: a fit of a scan is not quite free of the odometry."""


def factors(scales: np.ndarray) -> np.ndarray:
    """(3,) by which increments (forward, left, turn) are multiplied. scales: (2,) of ways and turns."""
    way, turn = (min(max(1.0 + scale, LEAST), MOST) for scale in scales.tolist())
    return np.array([way, way, turn])


def moved_by_scales(scales: np.ndarray, lever: np.ndarray, last: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(2, 3) m, m, rad: by how much a unit of the ways' scale, and of the turns', has moved the vehicle.

    scales: (2,). lever: (2,) m, the point that the odometry speaks of, in the vehicle's frame: its way is what is
    scaled. last, pose: (3,) at the last scan and at this one, by the scans. A turn's share of the place is that of an
    even arc.
    """
    x, y, heading = pose.tolist()
    last_x, last_y, last_heading = last.tolist()
    ax, ay = _turned(lever, heading)
    bx, by = _turned(lever, last_heading)
    x, y = x + ax - last_x - bx, y + ay - last_y - by
    _, way, turned = (1.0 / factors(scales)).tolist()
    turn = turned * math.remainder(heading - last_heading, 2.0 * math.pi)
    return np.array([[way * x, way * y, 0.0], [turn * (ay - 0.5 * y), turn * (0.5 * x - ax), turn]])


def _turned(lever: np.ndarray, heading: float) -> tuple[float, float]:
    """A point in the vehicle's frame, turned into the map's. In floats: it is asked for at every event."""
    c, s = math.cos(heading), math.sin(heading)
    x, y = lever.tolist()
    return c * x - s * y, s * x + c * y
