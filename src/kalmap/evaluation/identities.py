"""Identities from outside for sightings that carry none."""

from __future__ import annotations

import math

import numpy as np

from kalmap.evaluation.pairing import best_pairing
from kalmap.records import SightingTruth

_UNIDENTIFIED = -1
_ABSURD = 1e12  # m, rad, s: numbers beyond this measure nothing, and would overflow


def sighting_identities(
    times: np.ndarray,
    values: np.ndarray,
    truth: SightingTruth,
    *,
    cutoff: float = 0.5,
    tolerance: float = 1e-3,
) -> np.ndarray:
    """(M,) int64 ids of sightings made at `times` (M,) s with `values` (M, 2) range m, bearing rad; -1: none.

    A sighting may be one of `truth` if both were made within `tolerance` (s) of each other and lie less than
    `cutoff` (m) apart in the sensor's plane. Each is at most one. Where several compete, the pairing with
    the least total distance is taken, a sighting left over counting as `cutoff`. Sightings and truths that
    are not finite have no partner. Neither list need be in order of time.

    Raises `ValueError` for arrays of the wrong shape, or a cutoff or tolerance that is not finite and
    positive.
    """
    if not (math.isfinite(cutoff) and math.isfinite(tolerance) and cutoff > 0 and tolerance > 0):
        raise ValueError(f"cutoff and tolerance must be finite and positive, got {cutoff} and {tolerance}")
    found, found_rows = _places(times, values)
    given, given_rows = _places(truth.times, truth.values)
    if len(truth.ids) != len(truth.times):
        raise ValueError(f"as many ids as times are needed, got {len(truth.ids)} and {len(truth.times)}")
    ids = np.full(len(times), _UNIDENTIFIED, dtype=np.int64)
    if len(found) and len(given):
        rows, columns = best_pairing(*_candidates(found, given, cutoff, tolerance), cutoff)
        ids[found_rows[rows]] = truth.ids[given_rows[columns]]
    return ids


def _places(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) x m, y m, time s of the sightings that are finite, and which ones they are (n,)."""
    times, values = np.asarray(times, dtype=float), np.asarray(values, dtype=float)
    if times.ndim != 1 or values.shape != (len(times), 2):
        raise ValueError(f"times (M,) and values (M, 2) are needed, got {times.shape} and {values.shape}")
    rows = np.flatnonzero((np.abs(times) < _ABSURD) & (np.abs(values) < _ABSURD).all(axis=1))
    distance, bearing = values[rows].T
    return np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing), times[rows]]), rows


def _candidates(
    found: np.ndarray, given: np.ndarray, cutoff: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (K,) of both lists that may be the same, and their distances (K,) m."""
    from scipy.spatial import cKDTree

    # In units of cutoff and tolerance, partners lie in a cube; it is searched a little too far and then cut.
    scale, zero = np.array([cutoff, cutoff, tolerance]), given.min(axis=0)
    tree, other = cKDTree((found - zero) / scale), cKDTree((given - zero) / scale)
    near = tree.sparse_distance_matrix(other, 1.0 + 1e-6, p=np.inf, output_type="ndarray")
    rows, columns = near["i"], near["j"]
    gap = found[rows] - given[columns]
    distance = np.hypot(gap[:, 0], gap[:, 1])
    kept = (distance < cutoff) & (np.abs(gap[:, 2]) <= tolerance)
    return rows[kept], columns[kept], distance[kept]
