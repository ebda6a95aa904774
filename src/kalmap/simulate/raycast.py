"""What a laser scanner measures among circles and walls: exact ranges, and noise on them."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.records import ConfigError


class Scanner(msgspec.Struct, frozen=True, eq=False):
    """Where a scanner's beams point and how far they reach.

    bearings: (B,) rad, 0 ahead, positive left, ascending. max_range: m.
    """

    bearings: np.ndarray
    max_range: float


SICK = Scanner(np.deg2rad(0.5 * np.arange(361) - 90.0), 80.0)
"""SICK LMS 2xx: 361 beams, 0.5 degrees apart, over the half plane ahead."""

SICK_180 = Scanner(np.deg2rad(np.arange(180) - 90.0), 80.0)
"""The same scanner in its coarse mode: 180 beams, one degree apart, as most logs of buildings have it."""

URG = Scanner(2.0 * np.pi / 1024.0 * np.arange(-341, 342), 4.0)
"""Hokuyo URG-04LX: 683 of 1024 steps to the turn (0.35 degrees apart, 240 in all); beyond 4 m it is not specified."""


def cast(
    poses: np.ndarray,
    circles: np.ndarray,
    bearings: np.ndarray,
    max_range: float,
    *,
    moving: np.ndarray | None = None,
    segments: np.ndarray | None = None,
) -> np.ndarray:
    """Exact ranges (F, B) m from every pose along every bearing to what is nearest, +inf where nothing is hit.

    poses: (F, 3) m, m, rad of the sensor. circles: (N, 3) x, y, radius m. bearings: (B,) rad, in any order.
    moving: (F, K, 3) circles that stand elsewhere at every pose. segments: (S, 4) walls from x, y to x, y.

    A beam is a line without width. From inside a circle its wall is seen from inside; a beam along a wall,
    which has no thickness, passes it by. Hits farther than `max_range` are none.

    Raises `ConfigError` for wrong shapes, values that are not finite, and negative radii.
    """
    return cast_hits(poses, circles, bearings, max_range, moving=moving, segments=segments)[0]


def cast_hits(
    poses: np.ndarray,
    circles: np.ndarray,
    bearings: np.ndarray,
    max_range: float,
    *,
    moving: np.ndarray | None = None,
    segments: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """`cast`, and what every beam met, (F, B) int64: the row of `circles`, N + k for moving circle k,
    N + K + s for segment s, -1 for nothing."""
    from kalmap.kernels.raycast import NOTHING, cast_rays

    poses = _checked("poses", poses, (None, 3))
    circles = _checked("circles", circles, (None, 3))
    still = np.zeros((len(poses), 0, 3)) if moving is None else moving
    movers = _checked("moving", still, (len(poses), None, 3))
    walls = _checked("segments", np.zeros((0, 4)) if segments is None else segments, (None, 4))
    bearings = _checked("bearings", bearings, (None,))
    if not max_range > 0.0:
        raise ConfigError(f"ray casting: max_range must be positive, got {max_range}")
    for name, rows in (("circles", circles), ("moving", movers)):
        if (rows[..., 2] < 0.0).any():
            raise ConfigError(f"ray casting: {name} must have radii of zero or more")
    ranges = np.full((len(poses), len(bearings)), np.inf)
    targets = np.full(ranges.shape, NOTHING, dtype=np.int64)
    if ranges.size:
        order = np.argsort(bearings, kind="stable")
        found = cast_rays(poses, circles, movers, walls, bearings[order], float(max_range))
        ranges[:, order], targets[:, order] = found
    return ranges, targets


def noisy(ranges: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Ranges with independent normal noise of standard deviation `sigma` m; +inf stays.

    One number is drawn for every beam, hit or not, so that scans of different worlds can share their noise.
    Raises `ConfigError` if sigma is negative or not finite.
    """
    if not (math.isfinite(sigma) and sigma >= 0.0):
        raise ConfigError(f"range noise: sigma must be finite and zero or more, got {sigma}")
    return np.asarray(ranges + sigma * rng.standard_normal(np.shape(ranges)))


def _checked(name: str, values: np.ndarray, shape: tuple[int | None, ...]) -> np.ndarray:
    """Finite float64 values of that shape; None stands for any number of rows."""
    array = np.ascontiguousarray(values, dtype=np.float64)
    fits = array.ndim == len(shape) and all(want in (None, have) for want, have in zip(shape, array.shape))
    if not fits:
        expected = ", ".join("n" if size is None else str(size) for size in shape)
        raise ConfigError(f"ray casting: {name} must be ({expected}), got {array.shape}")
    if not np.isfinite(array).all():
        raise ConfigError(f"ray casting: {name} must be finite")
    return array
