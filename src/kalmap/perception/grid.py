"""Scans at known poses to an occupancy grid, cell by cell: every beam frees what it crosses and hits where it ends.

Evidence of the scans is added up as log-odds (Moravec & Elfes 1985; Thrun, Burgard & Fox 2005, table 9.1), each scan
once a cell, so that the order of the scans does not matter.
"""

from __future__ import annotations

import math

import numpy as np

from kalmap.records import ConfigError, EstimationError, OccupancyGrid, Sweeps
from kalmap.records.grid import FREE, OCCUPIED, UNKNOWN

HIT, MISS = 0.75, 0.4
"""Probability that a cell is occupied which one scan hit, or passed, and of which nothing else is known.

One scan is enough to call a cell occupied, three to call it free, and a wall stays that more than a quarter of the
scans hit.
"""
OCCUPIED_ABOVE, FREE_BELOW = 0.65, 0.25
"""Probabilities beyond which a cell counts as occupied or free: where Nav2 draws the lines."""
MOST_CELLS = 25_000_000


def occupancy_grid(
    sweeps: Sweeps,
    *,
    resolution: float = 0.05,
    min_range: float = 0.0,
    max_range: float = math.inf,
    clear_range: float | None = None,
    margin: float = 0.5,
    most_cells: int = MOST_CELLS,
) -> OccupancyGrid:
    """Trace every beam from its scanner's place to its end.

    resolution: m, the side of a cell. min_range, max_range: m: a range between them hits something; what is shorter, or
    NaN, says nothing; a longer one came back from nothing and frees its way up to `clear_range` (None: `max_range`; 0:
    nothing). margin: m around the scanner's places and what was hit; ways freed beyond are cut off there.
    most_cells: a grid that would have more is refused.

    Raises `ConfigError` for limits that make no sense, and `EstimationError` for poses that are not finite, for no scan
    at all and for a grid of more cells than allowed.
    """
    _check_settings(resolution, min_range, max_range, margin)
    poses = np.ascontiguousarray(sweeps.poses, dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(poses).all(axis=1))
    if len(bad):
        raise EstimationError(f"no grid can be made: the pose of scan {bad[0] + 1} is not finite")
    if not len(poses):
        raise EstimationError("no grid can be made: there is no scan")
    firsts = np.concatenate([[0], np.cumsum([len(scan.ranges) for scan in sweeps.scans])]).astype(np.int64)
    ranges = np.concatenate([scan.ranges for scan in sweeps.scans]).astype(np.float64)
    bearings = np.concatenate([scan.bearings for scan in sweeps.scans]).astype(np.float64)
    places = np.concatenate([poses[:, :2], sweeps.points(min_range, max_range)])
    origin, shape = _layout(places, resolution, margin, most_cells)
    clears = max_range if clear_range is None else clear_range
    # all that was hit lies in the grid, and ways are cut off where they leave it
    diagonal = math.hypot(*shape) * resolution
    limits = np.array([min_range, min(max_range, diagonal), min(clears, diagonal)])
    hits, passes = _counts(poses, firsts, ranges, bearings, limits, origin, resolution, shape)
    return OccupancyGrid(origin, resolution, classify(hits, passes))


def classify(hits: np.ndarray, passes: np.ndarray) -> np.ndarray:
    """What cells are, from how many scans hit and passed them: int8 of their shape."""
    odds = hits * _log_odds(HIT) + passes * _log_odds(MISS)
    cells = np.full(hits.shape, UNKNOWN, dtype=np.int8)
    cells[odds > _log_odds(OCCUPIED_ABOVE)] = OCCUPIED
    cells[odds < _log_odds(FREE_BELOW)] = FREE
    return cells


def _log_odds(probability: float) -> float:
    return math.log(probability / (1.0 - probability))


def _counts(
    poses: np.ndarray,
    firsts: np.ndarray,
    ranges: np.ndarray,
    bearings: np.ndarray,
    limits: np.ndarray,
    origin: np.ndarray,
    resolution: float,
    shape: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """In how many scans each cell was hit and passed."""
    from kalmap.kernels.grid import trace_beams  # numba takes its time to load

    hits, passes, marks = (np.zeros(shape, dtype=np.int32) for _ in range(3))
    trace_beams(poses, firsts, ranges, bearings, limits, origin, resolution, hits, passes, marks)
    return hits, passes


def _layout(
    points: np.ndarray, resolution: float, margin: float, most_cells: int
) -> tuple[np.ndarray, tuple[int, int]]:
    """Lower left corner, on whole cells, and shape (H, W) of a grid that holds all points."""
    low = np.floor((points.min(axis=0) - margin) / resolution)
    width, height = np.ceil((points.max(axis=0) + margin) / resolution) - low + 1.0
    if width * height > most_cells:
        raise EstimationError(
            f"no grid can be made: {width * resolution:.0f} m x {height * resolution:.0f} m at {resolution:g} m a cell "
            f"are {width * height:.2g} cells, more than {most_cells:.2g}; a coarser resolution or a shorter range helps"
        )
    # rounded, so that -12 cells of 0.05 m are -0.6 m and not -0.6000000000000001
    return np.round(low * resolution, 9), (int(height), int(width))


def _check_settings(resolution: float, min_range: float, max_range: float, margin: float) -> None:
    if not (resolution > 0.0 and math.isfinite(resolution)):
        raise ConfigError(f"the resolution of a grid must be above 0 m, not {resolution}")
    if not 0.0 <= min_range < max_range:
        raise ConfigError(f"ranges from {min_range} m to {max_range} m hold nothing")
    if not (margin >= 0.0 and math.isfinite(margin)):
        raise ConfigError(f"the margin of a grid must be 0 m or more, not {margin}")
