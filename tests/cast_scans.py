"""Ray-cast scans of worlds with known trunks, for the tests of detectors."""

from __future__ import annotations

import numpy as np

from kalmap.records import Scan
from kalmap.simulate.raycast import SICK, cast, cast_hits, noisy

STEP = np.deg2rad(0.5)
HERE = np.zeros((1, 3))
NOISE = 0.015  # m, the scanner's own by its data sheet; the simulated trunks have no bark


def look(circles, *, segments=None, scanner=SICK, rng=None, poses=HERE):
    """One scan from every pose among circles (N, 3)."""
    ranges = cast(poses, np.asarray(circles, float), scanner.bearings, scanner.max_range, segments=segments)
    ranges = ranges if rng is None else noisy(ranges, NOISE, rng)
    return [Scan(float(k), row, scanner.bearings) for k, row in enumerate(ranges)]


def scattered(rng, count, apart, diameters=(0.1, 1.0), reach=40.0):
    """Trunks (N, 3) ahead of the origin, their centres `apart` m from each other."""
    kept = np.zeros((0, 3))
    while len(kept) < count:
        at = rng.uniform([3.0, -reach], [reach, reach])
        if np.hypot(*at) < reach and (np.hypot(*(kept[:, :2] - at).T) > apart).all():
            kept = np.vstack([kept, [*at, 0.5 * rng.uniform(*diameters)]])
    return kept


def polar(points):
    return np.column_stack([np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])])


def plane(values):
    return np.column_stack([values[:, 0] * np.cos(values[:, 1]), values[:, 0] * np.sin(values[:, 1])])


def whole(circles, reach):
    """Which circles nearer than `reach` m are hit, by every beam that would hit them if they stood alone, with
    nothing nearer in the beams beside these."""
    ranges, targets = cast_hits(HERE, circles, SICK.bearings, SICK.max_range)
    seen = np.zeros(len(circles), dtype=bool)
    for k, circle in enumerate(circles):
        alone = cast(HERE, circle[None], SICK.bearings, SICK.max_range)[0]
        beams = np.flatnonzero(np.isfinite(alone))
        if len(beams) and beams[0] > 0 and beams[-1] < 360 and np.hypot(*circle[:2]) < reach:
            beside = ranges[0, [beams[0] - 1, beams[-1] + 1]]
            seen[k] = (targets[0, beams] == k).all() and (beside > alone[beams].min()).all()
    return seen
