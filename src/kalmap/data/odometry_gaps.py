"""Silences of an odometry between whose messages scans are laid: which they are, and the noise of a step across one."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.data.plausibility import GAP_PERIODS
from kalmap.records import MotionConfig

INDOOR = MotionConfig(
    model="increments", sigma_distance_ratio=0.1, sigma_rotation_deg=0.5, sigma_rotation_ratio=0.1
)
"""Odometry of wheeled robots on floors, a step being the way between two scans."""
LONGEST = 1.0
"""s: odometry comes ten to fifty times a second, and in a second an indoor robot begins or ends any of its motions."""
UNSEEN = np.array([0.35, 0.35, 0.35])
"""m/s, m/s, rad/s: how fast an indoor robot may go to and fro in a silence, beside what its odometry says afterwards:
at any speed up to 0.6 either way."""
LOST = np.diag([0.5**2, 0.5**2, np.deg2rad(20.0) ** 2])
"""m^2, rad^2: how little is known of the motion across a jump of the clock."""


class Silence(msgspec.Struct, frozen=True):
    """An odometry without messages from begin to end, s. first, last: rows of the drive whose clock it is on."""

    begin: float
    end: float
    first: int
    last: int


def silences(times: np.ndarray, first: int, last: int) -> tuple[Silence, ...]:
    """The silences of an odometry with the stamps (K,), non-decreasing, beside the rows from `first` to `last`.

    They are longer than `LONGEST`, and than `GAP_PERIODS` of the usual periods where the odometry is a slow one.
    """
    steps = np.diff(times)
    moving = steps[steps > 0]
    if not len(moving):
        return ()
    long = np.flatnonzero(steps > max(LONGEST, GAP_PERIODS * float(np.median(moving))))
    return tuple(Silence(float(times[k]), float(times[k + 1]), first, last) for k in long.tolist())


def step_covariance(step: np.ndarray, silent: float) -> np.ndarray:
    """(3, 3) m^2, m^2, rad^2 of a step (3,) across `silent` s of silence: the usual noise, and that of unseen motion.

    Odometry strays in proportion to its way, and the way may have been longer than it looks: to and fro, by `UNSEEN`.
    It is never doubted more than across a jump of the clock.
    """
    ratios = np.array([INDOOR.sigma_distance_ratio, INDOOR.sigma_distance_ratio, INDOOR.sigma_rotation_ratio])
    ways = np.array([np.hypot(step[0], step[1]), np.hypot(step[0], step[1]), step[2]])
    usual = (ratios * ways) ** 2 + np.array([0.0, 0.0, np.deg2rad(INDOOR.sigma_rotation_deg) ** 2])
    return np.diag(usual + np.minimum((ratios * UNSEEN * silent) ** 2, np.diag(LOST)))
