"""Least-squares rigid alignment of two point sets in the plane."""

from __future__ import annotations

import math

import numpy as np

# below this share of the points' spread a correlation is rounding and says nothing about rotation
_NOTHING = 1e-12


def align(points: np.ndarray, targets: np.ndarray) -> tuple[float, np.ndarray]:
    """Rotation and translation (no scale) that bring `points` nearest to `targets`, pair by pair.

    points, targets: (K, 2) m. Returns the rotation angle in rad and the translation (2,) in m that
    minimise sum |R p + t - q|^2: with both sets centred, the angle is
    atan2(sum p x q, sum p . q), and t = mean q - R mean p (Horn 1987, Umeyama 1991, in 2-D).

    Where the pairs do not fix a rotation (fewer than two, all in one place, no correlation) the angle
    is 0 and only the centres are brought together; without any pair the translation is 0 too.
    Raises `ValueError` for shapes that do not match and numbers that are not finite.
    """
    points, targets = np.asarray(points, dtype=float), np.asarray(targets, dtype=float)
    if points.shape != targets.shape or points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"two (K, 2) arrays are needed, got {points.shape} and {targets.shape}")
    if not (np.isfinite(points).all() and np.isfinite(targets).all()):
        raise ValueError("points to align must be finite")
    if len(points) == 0:
        return 0.0, np.zeros(2)
    points_centre, targets_centre = points.mean(axis=0), targets.mean(axis=0)
    p, q = points - points_centre, targets - targets_centre
    dot, cross = float(np.sum(p * q)), float(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]))
    sizes = np.linalg.norm(points) * np.linalg.norm(q) + np.linalg.norm(p) * np.linalg.norm(targets)
    angle = math.atan2(cross, dot) if math.hypot(dot, cross) > _NOTHING * sizes else 0.0
    return angle, targets_centre - apply(angle, np.zeros(2), points_centre[None])[0]


def apply(angle: float, translation: np.ndarray, points: np.ndarray) -> np.ndarray:
    """R(angle) p + translation for every row of `points` (K, 2). Headings turn by `angle` alike."""
    c, s = math.cos(angle), math.sin(angle)
    points = np.asarray(points, dtype=float)
    turned = np.column_stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]])
    return np.asarray(turned + translation)
