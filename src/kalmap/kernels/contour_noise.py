"""How surely the distances of points from pieces of contour are known: points on one piece err together."""

from __future__ import annotations

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.implicit import distance_rows


@compiled
def fill_noise(points, piece, coef, cov, origin, scale, sigma, ends, lengths, offset, askew, noise):
    """noise (M, M) m^2: the covariance of the distances of points (M, 2) from the curves of their pieces (M,).

    coef (K, 10), cov (K, 10, 10), origin (K, 2), scale (K,), sigma (K,), ends (K, 2, 2), lengths (K,): see `Pieces`.
    offset m^2 and askew rad^2: variances by which every piece is shifted and turned beside what its curve says.
    """
    count = len(points)
    rows, weighed, lever = np.empty((count, 10)), np.zeros((count, 10)), np.empty(count)
    for i in range(count):
        k = piece[i]
        distance_rows(coef[k], origin[k, 0], origin[k, 1], scale[k], points[i : i + 1], rows[i : i + 1])
        for a in range(10):
            for b in range(10):
                weighed[i, a] += cov[k, a, b] * rows[i, b]
        way = max(1e-9, lengths[k])
        lever[i] = 0.0
        for z in range(2):
            lever[i] += (points[i, z] - origin[k, z]) * (ends[k, 1, z] - ends[k, 0, z]) / way
    for i in range(count):
        for j in range(i + 1):
            value = 0.0
            if piece[i] == piece[j]:
                for a in range(10):
                    value += weighed[i, a] * rows[j, a]
                value += offset + askew * lever[i] * lever[j]
                if i == j:
                    value += sigma[piece[i]] ** 2
            noise[i, j] = noise[j, i] = value
