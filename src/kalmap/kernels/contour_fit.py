"""A line through measured points, and one that may bend by as much as their noise hides, with their covariances.

A point's noise across the curve, whose unit normal is n, is along * (n . ray)^2 + across * (1 - (n . ray)^2) + rough,
variances in m^2: `along` and `across` the beam that measured it (ray, unit), and the contour's own roughness.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled

_HUBER = 3.0  # standard deviations from which a point pulls no harder
_EXCESS = 2.5  # standard deviations by which chi-square must exceed its mean to speak of roughness


@compiled
def across_variance(nx, ny, rays, along, across, n):
    """Variance of point n square to a curve of unit normal (nx, ny) there."""
    facing = nx * rays[n, 0] + ny * rays[n, 1]
    facing *= facing
    return along[n] * facing + across[n] * (1.0 - facing)


@compiled
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


@compiled
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


@compiled
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


@compiled
def _powers(points, n, coef, origin, scale, row):
    """Fills row (4,) with 1, t, t^2, t^3 of point n along the line in `coef`; returns its distance, in scales."""
    dx, dy = (points[n, 0] - origin[0]) / scale, (points[n, 1] - origin[1]) / scale
    row[0], row[1] = 1.0, coef[2] * dx - coef[1] * dy
    row[2] = row[1] * row[1]
    row[3] = row[2] * row[1]
    return coef[1] * dx + coef[2] * dy


@compiled
def _bend(points, variances, prior, coef, origin, scale, shape, spread):
    """Weighted least squares of the distances from the line on the powers: turns `shape` (4,), from where outliers are
    judged, into the solution; fills spread (4, 4), its covariance, in units of scale. prior (4,): information."""
    right, row = np.zeros(4), np.empty(4)
    spread[:, :] = 0.0
    for i in range(4):
        spread[i, i] = prior[i]
    for n in range(len(points)):
        away = _powers(points, n, coef, origin, scale, row)
        far = away
        for i in range(4):
            far -= shape[i] * row[i]
        far = scale * abs(far) / math.sqrt(variances[n])
        weight = scale * scale / variances[n] * min(1.0, _HUBER / max(far, 1e-12))
        for i in range(4):
            right[i] += weight * row[i] * away
            for j in range(4):
                spread[i, j] += weight * row[i] * row[j]
    for i in range(4):
        spread[i, i] *= 1.0 + 1e-9  # points that coincide say nothing of the slope
        spread[i, i] += 1e-12
    spread[:, :] = np.linalg.inv(spread)
    for i in range(4):
        shape[i] = 0.0
        for j in range(4):
            shape[i] += spread[i, j] * right[j]


@compiled
def fit_bent_line(points, rays, along, across, sigma_bend, smooth, coef, cov, origin):
    """The line of `fit_line` and how it bends: a cubic along it, whose second derivative has a prior of mean 0 and
    `sigma_bend`, 1/m, and whose third the same, 1/m^2.

    A straight fit to a wall whose bend the noise hides is off by as much as its own standard deviations, and in every
    scan the same way. Here the bend is estimated, however little of it shows, and stands in the covariance.
    Returns scale m, the weighted squares of the residuals, whose variances are `along` + `smooth`, m^2, and rough m^2.
    """
    scale, _chi, rough = fit_line(points, rays, along, across, coef, cov, origin)
    count, nx, ny = len(points), coef[1], coef[2]
    prior = np.zeros(4)
    prior[2], prior[3] = (2.0 / (sigma_bend * scale)) ** 2, (6.0 / (sigma_bend * scale * scale)) ** 2
    shape, spread, row = np.zeros(4), np.empty((4, 4)), np.empty(4)
    residuals, variances = np.empty(count), np.empty(count)
    for n in range(count):
        variances[n] = across_variance(nx, ny, rays, along, across, n)
    for turn in range(2):
        _bend(points, variances + rough, prior, coef, origin, scale, shape, spread)
        for n in range(count):
            residuals[n] = scale * _powers(points, n, coef, origin, scale, row)
            for i in range(4):
                residuals[n] -= scale * shape[i] * row[i]
        if turn == 0:
            rough = excess_variance(residuals, variances, count - 4)[0]
    squares = 0.0
    for n in range(count):
        squares += residuals[n] * residuals[n] / (along[n] + smooth)
    design = np.zeros((4, 10))  # the coefficients are linear in the shape; t = ny u - nx v
    design[0, 0], design[1, 1], design[1, 2] = -1.0, -ny, nx
    design[2, 3], design[2, 4], design[2, 5] = -ny * ny, 2.0 * nx * ny, -nx * nx
    design[3, 6], design[3, 9] = -ny * ny * ny, nx * nx * nx
    design[3, 7], design[3, 8] = 3.0 * ny * ny * nx, -3.0 * ny * nx * nx
    coef += np.dot(shape, design)
    cov[:, :] = np.dot(design.T, np.dot(spread, design))
    return scale, squares, rough
