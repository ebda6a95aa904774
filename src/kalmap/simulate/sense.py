"""What the sensor sees from given poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from kalmap.geometry.angles import wrap

# pairs of pose and feature that are looked at in one go: keeps the memory of large worlds flat
_PAIRS = 500_000
# squares on a side of what the features cover: a sensor that sees next to nothing needs no finer ones
_MOST_SQUARES = 1 << 20

_Pairs = tuple[np.ndarray, np.ndarray]


def visible(
    poses: np.ndarray,
    landmarks: np.ndarray,
    max_range: float,
    field_of_view_deg: float,
    min_range: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which features are in view from which pose, and the exact range and bearing to them.

    poses (F, 3), landmarks (N, 2), or (F, N, 2) where they move from pose to pose; a feature is in view if
    its range is `min_range` or more and below `max_range` (m) and its bearing strictly inside the field of
    view (at 180 degrees: the open half plane ahead; at 360: all).
    Returns frame (M,) int64, feature (M,) int64, and range m and bearing rad (M, 2), ordered by frame and
    then by feature.
    """
    found = []
    moving = landmarks.ndim == 3
    pairs = _all_pairs(len(poses), landmarks.shape[1]) if moving else _near_pairs(poses, landmarks, max_range)
    for frame, feature in pairs:
        there = landmarks[frame, feature] if moving else landmarks[feature]
        dx, dy = there[:, 0] - poses[frame, 0], there[:, 1] - poses[frame, 1]
        squared = dx * dx + dy * dy
        near = np.flatnonzero((squared >= min_range**2) & (squared < max_range**2))
        near = near[np.lexsort((feature[near], frame[near]))]
        frame, feature, dx, dy = frame[near], feature[near], dx[near], dy[near]
        bearing = wrap(np.arctan2(dy, dx) - poses[frame, 2])
        ahead = _in_view(dx, dy, bearing, poses[frame, 2], field_of_view_deg)
        exact = np.column_stack([np.hypot(dx, dy), bearing])[ahead]
        found.append((frame[ahead], feature[ahead], exact))
    if not found:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    frames, features, values = zip(*found)
    return np.concatenate(frames), np.concatenate(features), np.concatenate(values)


def _all_pairs(frames: int, features: int) -> Iterator[_Pairs]:
    """Every feature with every frame, so many frames at once as `_PAIRS` allows."""
    rows = max(1, _PAIRS // max(1, features))
    for first in range(0, frames, rows):
        count = min(rows, frames - first)
        frame, feature = np.divmod(np.arange(count * features), max(1, features))
        yield frame + first, feature


def _near_pairs(poses: np.ndarray, landmarks: np.ndarray, max_range: float) -> Iterator[_Pairs]:
    """Every frame with the features of the nine squares around it, each a little wider than `max_range`.

    Features are sorted by row and column of their square, so that three squares side by side are one stretch.
    """
    if not len(landmarks) or not len(poses):
        return
    low = landmarks.min(axis=0)
    cell = max(1.001 * max_range, float(np.ptp(landmarks, axis=0).max()) / _MOST_SQUARES)
    column, row = np.floor((landmarks - low) / cell).astype(np.int64).T
    width = int(column.max()) + 1
    order = np.argsort(row * width + column, kind="stable")
    keys = (row * width + column)[order]
    at = np.clip(np.floor((poses[:, :2] - low) / cell), -2, _MOST_SQUARES + 2).astype(np.int64)
    left, right = np.maximum(at[:, 0] - 1, 0), np.minimum(at[:, 0] + 1, width - 1)
    rows = (at[:, 1, None] + np.arange(-1, 2)) * width
    first = np.searchsorted(keys, rows + left[:, None])
    count = np.maximum(np.searchsorted(keys, rows + right[:, None], side="right") - first, 0)
    count[left > right] = 0
    ends = np.cumsum(count.sum(axis=1))
    cuts = np.searchsorted(ends, np.arange(_PAIRS, ends[-1], _PAIRS), side="right")
    for begin, end in pairwise(np.unique([0, *cuts, len(poses)])):
        some = count[begin:end].ravel()
        within = np.arange(some.sum()) - np.repeat(np.cumsum(some) - some, some)
        frame = np.repeat(np.repeat(np.arange(begin, end), 3), some)
        yield frame, order[np.repeat(first[begin:end].ravel(), some) + within]


def _in_view(
    dx: np.ndarray, dy: np.ndarray, bearing: np.ndarray, heading: np.ndarray, field_of_view_deg: float
) -> np.ndarray:
    if field_of_view_deg == 180.0:
        # as the simulator states it: no arctangent decides about a feature exactly abeam
        return dx * np.cos(heading) + dy * np.sin(heading) > 0
    if field_of_view_deg >= 360.0:
        return np.ones(len(bearing), dtype=bool)
    return np.abs(bearing) < math.radians(field_of_view_deg) / 2
