"""Wheels that tell every way, and every turn, too long or too short by a share: what that moves the vehicle by.

A wheel base is known to a few percent, a radius to one. As states, the two scales would come out too small if their
derivative were the odometry's own way: its noise is what they are asked to explain (errors in variables; Fuller 1987,
Measurement Error Models, section 1.1). The way that the scans show has none of it, or next to none, and stands in its
place: an instrument. It is known only when a scan has been fitted, and so the pose is given its share of the scales'
errors then, before the scan corrects it.
"""

from __future__ import annotations

import numpy as np

from kalmap.geometry.angles import wrap


def moved_by_scales(scales: np.ndarray, last: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(2, 3) m, m, rad: by how much a unit of the ways' scale, and of the turns', has moved the vehicle.

    scales: (3,) factors of increments (forward, left, turn). last, pose: (3,) at the last scan and at this one, by the
    scans. A turn's share of the place is that of an even arc.
    """
    x, y, turn = pose - last
    turn = wrap(turn)
    _, way, turned = 1.0 / scales
    bend = 0.5 * turn * turned
    return np.array([[way * x, way * y, 0.0], [-bend * y, bend * x, turn * turned]])
