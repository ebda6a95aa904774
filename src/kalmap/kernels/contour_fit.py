"""A line through measured points, with its covariance.

A point's noise across the curve, whose unit normal is n, is along * (n . ray)^2 + across * (1 - (n . ray)^2) + rough,
variances in m^2: `along` and `across` the beam that measured it (ray, unit), and the contour's own roughness.
"""

import math

import numpy as np
from numba import njit

_HUBER = 3.0  # standard deviations from which a point pulls no harder
_EXCESS = 2.5  # standard deviations by which chi-square must exceed its mean to speak of roughness


@njit(cache=True, nogil=True, error_model="numpy")
def across_variance(nx, ny, rays, along, across, n):
    """Variance of point n square to a curve of unit normal (nx, ny) there."""
    facing = nx * rays[n, 0] + ny * rays[n, 1]
    facing *= facing
    return along[n] * facing + across[n] * (1.0 - facing)


@njit(cache=True, nogil=True, error_model="numpy")
def scatter(points, weights):
    """Weighted mean (x, y), unit direction of the principal axis, and the weights' sum."""
    total, mx, my = 0.0, 0.0, 0.0
    for n in range(len(points)):
        total += weights[n]
        mx += weights[n] * points[n, 0]
        my += weights[n] * points[n, 1]
    mx, my = mx / total, my / total
    xx, xy, yy = 0.0, 0.0, 0.0
    for n in range(len(points)):
        dx, dy = points[n, 0] - mx, points[n, 1] - my
        xx += weights[n] * dx * dx
        xy += weights[n] * dx * dy
        yy += weights[n] * dy * dy
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    return mx, my, math.cos(angle), math.sin(angle), total


@njit(cache=True, nogil=True, error_model="numpy")
def excess_variance(residuals, variances, freedom):
    """Variance (m^2) that residuals (m) show beyond their own `variances`, 0 where chance explains them.

    Residuals beyond `_HUBER` standard deviations, the excess included, count as if they lay there.
    Also returns chi-square as it is.
    """
    chi = 0.0
    for n in range(len(residuals)):
        chi += residuals[n] * residuals[n] / variances[n]
    if freedom <= 0 or chi <= freedom + _EXCESS * math.sqrt(2.0 * freedom):
        return 0.0, chi
    excess, lost = 0.0, freedom / len(residuals)
    for _ in range(8):  # what counts as far off grows with the excess
        surplus = 0.0
        for n in range(len(residuals)):
            most = _HUBER * _HUBER * (variances[n] + excess)
            surplus += min(residuals[n] * residuals[n], most) - lost * variances[n]
        excess = max(0.0, surplus / freedom)
    return excess, chi


@njit(cache=True, nogil=True, error_model="numpy")
def fit_line(points, rays, along, across, coef, cov, origin):
    """Weighted total least squares: fills coef (10,), cov (10, 10), origin (2,).

    Returns scale m, chi-square and rough m^2, the variance that the points' noise does not explain.
    points (N, 2), rays (N, 2), along (N,), across (N,), N >= 2. The line is p = n . (u, v) about the weighted mean, in
    units of half the points' extent; weights follow from the direction found before, three times over.
    The offset at the mean has variance 1 / sum w, the angle 1 / sum w t^2, and the two are independent.
    """
    count = len(points)
    weights, variances, residuals = np.empty(count), np.empty(count), np.empty(count)
    for n in range(count):
        weights[n] = 1.0 / max(along[n], across[n])
    mx, my, tx, ty, total = scatter(points, weights)
    rough, chi = 0.0, 0.0
    for turn in range(4):
        for n in range(count):
            variances[n] = across_variance(-ty, tx, rays, along, across, n)
            residuals[n] = tx * (points[n, 1] - my) - ty * (points[n, 0] - mx)
        if turn == 3:
            rough, chi = excess_variance(residuals, variances, count - 2)
            if rough == 0.0:
                break
        for n in range(count):
            spread = variances[n] + rough
            far = abs(residuals[n]) / math.sqrt(spread)
            weights[n] = 1.0 / spread if far <= _HUBER else _HUBER / (far * spread)
        mx, my, tx, ty, total = scatter(points, weights)
    lowest, highest, lever = 0.0, 0.0, 0.0
    for n in range(count):
        t = tx * (points[n, 0] - mx) + ty * (points[n, 1] - my)
        lowest, highest, lever = min(lowest, t), max(highest, t), lever + weights[n] * t * t
    scale = max(0.5 * (highest - lowest), 1e-3)
    coef[:] = 0.0
    cov[:, :] = 0.0
    origin[0], origin[1] = mx, my
    coef[1], coef[2] = -ty, tx
    cov[0, 0] = 1.0 / (total * scale * scale)
    cov[1, 1], cov[2, 2], cov[1, 2] = tx * tx / lever, ty * ty / lever, tx * ty / lever
    cov[2, 1] = cov[1, 2]
    return scale, chi, rough
