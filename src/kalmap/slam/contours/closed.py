"""A local map that is closed: a Gaussian that is never changed again, the scans it came from, and its shape."""

from __future__ import annotations

from functools import cached_property

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from kalmap.kernels import correlate

ENOUGH = 2  # scans that must have seen a sample before loops are judged by it
CELL = 0.1  # m, of the grids that places are searched on
REACH = 0.4  # m, how far from a contour its neighbourhood is known
BLUR = 0.1  # m, standard deviation of the fit in the search
DIRECTIONS, LEVELS = 8, 5
DENSE = 0.1  # m between points along a contour
LEAST_APART = (
    0.02  # m along a contour between neighbours: of one drawn twice, no step goes from one to the other
)


class ClosedMap(msgspec.Struct, frozen=True, eq=False, dict=True):
    """Pose at the end and N samples, in the frame of the vehicle's pose at the start.

    mean: (3 + 2 N,). covariance: (3 + 2 N, 3 + 2 N). normals: (N, 2) towards the free side. sightings: (N,) scans that
    corrected each sample. spacing: m between samples.
    """

    mean: np.ndarray
    covariance: np.ndarray
    normals: np.ndarray
    sightings: np.ndarray
    spacing: float

    @property
    def end(self) -> np.ndarray:
        """(3,) T_start_end."""
        return self.mean[:3]

    @property
    def end_covariance(self) -> np.ndarray:
        """(3, 3)."""
        return self.covariance[:3, :3]

    @property
    def samples(self) -> np.ndarray:
        """(N, 2) m."""
        return self.mean[3:].reshape(-1, 2)

    @cached_property
    def shape(self) -> Shape:
        """What loops are searched and judged by."""
        return Shape.of(self)


class Shape(msgspec.Struct, frozen=True, eq=False, dict=True):
    """The contours of a closed map as segments from sample to sample, and as points along them.

    pairs: (S, 2) rows of the samples that a segment joins; segments: (S, 4) m; normals: (S, 2).
    points: (P, 2) m, point_normals (P, 2), segment (P,) that each lies on and share (P,) of the way along it.
    centre: (2,) m and radius m of a circle about all of it. low: (2,) m, corner of the grid nearest (H, W).
    """

    pairs: np.ndarray
    segments: np.ndarray
    normals: np.ndarray
    points: np.ndarray
    point_normals: np.ndarray
    segment: np.ndarray
    share: np.ndarray
    centre: np.ndarray
    radius: float
    low: np.ndarray
    nearest: np.ndarray
    distance: np.ndarray

    @classmethod
    def of(cls, closed: ClosedMap) -> Shape:
        """The shape of a map: of its samples that more than one scan saw."""
        pairs = neighbours(closed.samples, closed.normals, closed.spacing)
        pairs = pairs[(closed.sightings[pairs] >= ENOUGH).all(axis=1)]
        ends = closed.samples[pairs]
        segments = np.ascontiguousarray(ends.reshape(-1, 4))
        normals = _across(ends, closed.normals[pairs].sum(axis=1))
        counts = np.maximum(1, np.rint(np.hypot(*(ends[:, 1] - ends[:, 0]).T) / DENSE)).astype(np.int64)
        segment = np.repeat(np.arange(len(pairs)), counts)
        first = np.repeat(np.cumsum(counts) - counts, counts)
        share = (np.arange(len(segment)) - first + 0.5) / counts[segment] if len(segment) else np.zeros(0)
        points = ends[segment, 0] + share[:, None] * (ends[segment, 1] - ends[segment, 0])
        low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.zeros(2))
        centre = 0.5 * (low + high)
        radius = float(np.hypot(*(points - centre).T).max(initial=0.0))
        low = low - REACH - CELL
        columns, rows = (np.ceil((high + REACH + CELL - low) / CELL)).astype(int) + 1
        nearest = np.full((rows, columns), -1, dtype=np.int32)
        distance = np.full((rows, columns), REACH, dtype=np.float32)
        correlate.nearest_segments(segments, low, CELL, REACH, nearest, distance)
        return cls(
            pairs,
            segments,
            normals,
            points,
            normals[segment],
            segment,
            share,
            centre,
            radius,
            low,
            nearest,
            distance,
        )

    @property
    def length(self) -> float:
        """m of contour."""
        return DENSE * len(self.points)

    @cached_property
    def levels(self) -> np.ndarray:
        """(L, D, H, W) uint8, see `kalmap.kernels.correlate.fill_levels`."""
        levels = np.zeros((LEVELS, DIRECTIONS, *self.nearest.shape), dtype=np.uint8)
        correlate.fill_levels(self.nearest, self.distance, self.normals, BLUR, levels)
        return levels


def _across(ends: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """(S, 2) unit normals of segments (S, 2, 2), on the side of `facing` (S, 2).

    What scans said of a sample's normal is less sure than the way from one sample to the next, and the map does not
    know how unsure it is.
    """
    way = ends[:, 1] - ends[:, 0]
    normals = np.column_stack([-way[:, 1], way[:, 0]])
    normals *= np.where((normals * facing).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    return np.asarray(normals / np.maximum(1e-9, np.hypot(*normals.T))[:, None])


def neighbours(samples: np.ndarray, normals: np.ndarray, spacing: float) -> np.ndarray:
    """(S, 2) rows of samples that follow each other on one contour, by place and normal alone.

    Each sample has at most one neighbour to either side: the nearest within 1.6 spacings whose normal agrees within 40
    degrees, not more than a third of the way aside; and two are joined if each is the other's.
    """
    close = (
        cKDTree(samples).query_pairs(1.6 * spacing, output_type="ndarray")
        if len(samples)
        else np.zeros((0, 2), int)
    )
    both = np.concatenate([close, close[:, ::-1]])
    way = samples[both[:, 1]] - samples[both[:, 0]]
    own, other = normals[both[:, 0]], normals[both[:, 1]]
    along = way[:, 1] * own[:, 0] - way[:, 0] * own[:, 1]
    across = np.abs((way * own).sum(axis=1))
    fits = ((own * other).sum(axis=1) > 0.76) & (across < 0.35 * np.abs(along) + 0.03)
    fits &= np.abs(along) > LEAST_APART
    both, along = both[fits], along[fits]
    order = np.lexsort((np.abs(along), along > 0.0, both[:, 0]))
    both, side = both[order], along[order] > 0.0
    first = np.ones(len(both), dtype=bool)
    first[1:] = (both[1:, 0] != both[:-1, 0]) | (side[1:] != side[:-1])
    chosen = both[first]
    number = len(samples) + 1
    forward, backward = chosen[:, 0] * number + chosen[:, 1], chosen[:, 1] * number + chosen[:, 0]
    mutual = chosen[np.isin(forward, backward)]
    return np.asarray(mutual[mutual[:, 0] < mutual[:, 1]], dtype=np.int64)
