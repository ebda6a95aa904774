"""What the sensor sees from given poses."""

from __future__ import annotations

import math

import numpy as np

from kalmap.geometry.angles import wrap

# pairs of pose and feature that are looked at in one go: keeps the memory of large worlds flat
_PAIRS = 500_000


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
    rows = max(1, _PAIRS // max(1, landmarks.shape[-2]))
    for first in range(0, len(poses), rows):
        part = poses[first : first + rows]
        there = landmarks[first : first + rows] if moving else landmarks[None]
        dx = there[:, :, 0] - part[:, 0, None]
        dy = there[:, :, 1] - part[:, 1, None]
        squared = dx * dx + dy * dy
        frame, feature = np.nonzero((squared >= min_range**2) & (squared < max_range**2))
        dx, dy = dx[frame, feature], dy[frame, feature]
        bearing = wrap(np.arctan2(dy, dx) - part[frame, 2])
        ahead = _in_view(dx, dy, bearing, part[frame, 2], field_of_view_deg)
        exact = np.column_stack([np.hypot(dx, dy), bearing])[ahead]
        found.append((frame[ahead] + first, feature[ahead], exact))
    if not found:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    frames, features, values = zip(*found)
    return np.concatenate(frames), np.concatenate(features), np.concatenate(values)


def _in_view(
    dx: np.ndarray, dy: np.ndarray, bearing: np.ndarray, heading: np.ndarray, field_of_view_deg: float
) -> np.ndarray:
    if field_of_view_deg == 180.0:
        # as the simulator states it: no arctangent decides about a feature exactly abeam
        return dx * np.cos(heading) + dy * np.sin(heading) > 0
    if field_of_view_deg >= 360.0:
        return np.ones(len(bearing), dtype=bool)
    return np.abs(bearing) < math.radians(field_of_view_deg) / 2
