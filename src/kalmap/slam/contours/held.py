"""Whether scans hold the vehicle in every direction, or leave it to its odometry along one, as in a corridor."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kalmap.slam.contours.leg import Leg

LOOSE = 0.7  # of the variance that the odometry alone would have, above which scans are said to tell nothing
LEAST = 0.02  # m, standard deviation of the odometry alone, below which a local map is too short to tell


def holding(legs: Sequence[Leg], frames: np.ndarray) -> dict[str, float]:
    """What is told of it. frames: (n, 3) of the legs' maps.

    `weakest_direction_sigma_m`, `weakest_direction_deg`: standard deviation of the vehicle at the end of a local map,
    as seen from its start and its heading given, in the direction that is known least; of the map where that is
    largest, and the direction in the whole map, -90 to 90 deg. `local_maps_loose`: how many maps are known no better
    there than by the odometry alone. NaN where there is no map.
    """
    worst, direction, loose = math.nan, math.nan, 0
    for leg, frame in zip(legs, frames, strict=True):
        if not len(leg.covariances):
            continue
        variance, axis = _weakest(leg.covariances[-1])
        alone = float(axis @ leg.driven @ axis)
        loose += alone > LEAST**2 and variance > LOOSE * alone
        if not math.sqrt(variance) <= worst:
            worst = math.sqrt(variance)
            turned = math.degrees(math.atan2(axis[1], axis[0]) + frame[2])
            direction = (turned + 90.0) % 180.0 - 90.0
    return {
        "weakest_direction_sigma_m": worst,
        "weakest_direction_deg": direction,
        "local_maps_loose": loose,
    }


def _weakest(covariance: np.ndarray) -> tuple[float, np.ndarray]:
    """The largest variance of a place, the heading given, and its direction (2,)."""
    block = covariance[:2, :2].copy()
    if covariance[2, 2] > 0.0:
        block -= np.outer(covariance[:2, 2], covariance[:2, 2]) / covariance[2, 2]
    values, vectors = np.linalg.eigh(block)
    return max(0.0, float(values[1])), vectors[:, 1]
