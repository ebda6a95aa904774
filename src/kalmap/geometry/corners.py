"""Corners: where the lines through two sets of points meet, and how the corner moves with every point.

The appendix of Sun et al. 2010 fits y = k x + b, which no upright wall has, and differentiates numerically. Here the
lines are fitted by total least squares and the derivatives are closed.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

_PARALLEL = 1e-9


class Corner(msgspec.Struct, frozen=True, eq=False):
    """position: (2,) m. first, second: (N, 2, 2) derivatives of the position by each point of the two sets,
    [point, coordinate of the corner, coordinate of the point]."""

    position: np.ndarray
    first: np.ndarray
    second: np.ndarray


def corner(first: np.ndarray, second: np.ndarray) -> Corner:
    """The meeting point of the total-least-squares lines through points (N, 2) and (M, 2), and its Jacobians.

    A line passes through its points' mean m along the angle a with tan 2a = 2 Sxy / (Sxx - Syy). With unit normals n,
    directions t and the corner c, n_k . c = n_k . m_k for both lines, so
    n_k . dc = n_k . dm_k - (t_k . (m_k - c)) da_k.

    Raises `ValueError` for fewer than two points, points all in one place or all round alike, and lines that are
    parallel.
    """
    (m1, a1, turn1), (m2, a2, turn2) = _line(first), _line(second)
    n1, n2 = _normal(a1), _normal(a2)
    normals = np.array([n1, n2])
    if abs(normals[0, 0] * normals[1, 1] - normals[0, 1] * normals[1, 0]) < _PARALLEL:
        raise ValueError("parallel lines have no corner")
    inverse = np.linalg.inv(normals)
    position = inverse @ np.array([n1 @ m1, n2 @ m2])
    sides = []
    for k, (mean, angle, turn) in enumerate(((m1, a1, turn1), (m2, a2, turn2))):
        lever = math.cos(angle) * (mean[0] - position[0]) + math.sin(angle) * (mean[1] - position[1])
        moved = normals[k] / len(turn) - lever * turn
        sides.append(inverse[:, k][None, :, None] * moved[:, None, :])
    return Corner(position, sides[0], sides[1])


def _normal(angle: float) -> np.ndarray:
    return np.array([-math.sin(angle), math.cos(angle)])


def _line(points: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Mean (2,), direction rad, and the direction's derivatives by every coordinate (N, 2)."""
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1:] != (2,) or len(points) < 2:
        raise ValueError(f"a line needs two or more points (N, 2), got {points.shape}")
    mean = points.mean(axis=0)
    x, y = (points - mean).T
    wide, skew = float(x @ x - y @ y), float(2.0 * (x @ y))
    squared = wide**2 + skew**2
    if not squared > 1e-24 * float(x @ x + y @ y) ** 2:
        raise ValueError("the points have no direction")
    # d wide = 2 x dx - 2 y dy, d skew = 2 (x dy + y dx); the mean's own shift drops out of both
    turn = np.column_stack([wide * y - skew * x, wide * x + skew * y]) / squared
    return mean, 0.5 * math.atan2(skew, wide), turn
