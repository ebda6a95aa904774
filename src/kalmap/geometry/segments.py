"""Distances from points to straight segments."""

from __future__ import annotations

import numpy as np

_PIECE = 1.0  # m: longer segments are cut, so that the middle of a piece says where all of it lies
_FIRST = 6  # middles looked up for every point at first


def segment_distances(points: np.ndarray, segments: np.ndarray, cutoff: float = np.inf) -> np.ndarray:
    """(P,) distance of each point (P, 2) to the nearest of the segments (S, 4) from x, y to x, y; inf beyond `cutoff`.

    A segment without length is a point. Exact: the nearest middles of pieces are looked up in a tree, more and more of
    them until none further away can belong to a piece that is nearer.
    """
    points, segments = np.asarray(points, dtype=np.float64), np.asarray(segments, dtype=np.float64)
    distances = np.full(len(points), np.inf)
    if not len(segments) or not len(points):
        return distances
    from scipy.spatial import cKDTree

    pieces = _pieces(segments)
    half = 0.5 * float(np.hypot(*(pieces[:, 2:] - pieces[:, :2]).T).max())
    tree = cKDTree(0.5 * (pieces[:, :2] + pieces[:, 2:]))
    rows, count = np.arange(len(points)), min(_FIRST, len(pieces))
    while len(rows):
        reach, found = tree.query(
            points[rows], k=[*range(1, count + 1)], distance_upper_bound=cutoff + half + 1e-9
        )
        owners, columns = np.nonzero(found < len(pieces))
        each = np.full(found.shape, np.inf)
        each[owners, columns] = _to_segments(points[rows[owners]], pieces[found[owners, columns]])
        best = np.minimum(each.min(axis=1), cutoff)
        distances[rows] = each.min(axis=1)
        more = (reach[:, -1] - half < best) & (found[:, -1] < len(pieces)) & (count < len(pieces))
        rows, count = rows[more], min(4 * count, len(pieces))
    distances[distances > cutoff] = np.inf
    return distances


def _pieces(segments: np.ndarray) -> np.ndarray:
    """The segments, those longer than `_PIECE` cut into equal pieces."""
    counts = np.maximum(1, np.ceil(np.hypot(*(segments[:, 2:] - segments[:, :2]).T) / _PIECE)).astype(
        np.int64
    )
    owner = np.repeat(np.arange(len(segments)), counts)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    start, way = segments[owner, :2], (segments[:, 2:] - segments[:, :2])[owner]
    low, high = (place / counts[owner])[:, None], ((place + 1) / counts[owner])[:, None]
    return np.hstack([start + low * way, start + high * way])


def _to_segments(points: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """(N,) distance of each point to the segment of its row."""
    start, way = segments[:, :2], segments[:, 2:] - segments[:, :2]
    length = (way**2).sum(axis=1)
    along = ((points - start) * way).sum(axis=1)
    share = np.clip(np.divide(along, length, out=np.zeros(len(points)), where=length > 0.0), 0.0, 1.0)
    return np.asarray(np.hypot(*(points - start - share[:, None] * way).T))
