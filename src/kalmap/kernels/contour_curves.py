"""Conics and cubics through measured points that do not extrapolate nonsense, with their covariance.

Among the polynomials that explain the points, the fit takes the one whose gradient along them is nearest to the unit
normal, and whose higher coefficients are small: the gradient-one and ridge fits of Tasdizen, Tarel & Cooper 2000 (IEEE
T-IP 9(3)), as weak priors beside the points' own noise. Distances are weighed as p / |grad p|, by turns.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.contour_fit import across_variance, excess_variance
from kalmap.kernels.implicit import evaluate, monomial_slopes, monomials, second_derivatives

_GRADIENT = 4.0  # 1 / variance with which the gradient at a point is held to the unit normal
_RIDGE = 0.05  # the same, a point, for coefficients of second and third order to be zero
_TURNS = 4  # times that weights and normals are taken anew
_STEEP = 2.5  # most by which gradients along a piece may differ from their mean
_ROUND = 0.15  # most curvature times noise: a bend that the noise hides is a corner
_SHARPEST = 0.8  # rad, most that the curve may turn from one point to the next
_GENTLE = 0.26  # rad, up to which it may turn wherever it likes
_EVEN = 2.5  # beyond, most curvature in mean curvatures: a bend in one place is a corner


@compiled
def invert(matrix, size, inverse):
    """Inverse of a positive definite (size, size), by Cholesky, which overwrites it. False if it is not definite."""
    for j in range(size):
        for k in range(j):
            matrix[j, j] -= matrix[j, k] * matrix[j, k]
        if not matrix[j, j] > 0.0:
            return False
        pivot = math.sqrt(matrix[j, j])
        matrix[j, j] = pivot
        for i in range(j + 1, size):
            for k in range(j):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
            matrix[i, j] /= pivot
    column = np.empty(size)
    for c in range(size):
        for i in range(size):
            value = 1.0 if i == c else 0.0
            for k in range(c, i):
                value -= matrix[i, k] * column[k]
            column[i] = value / matrix[i, i] if i >= c else 0.0
        for i in range(size - 1, -1, -1):
            value = column[i]
            for k in range(i + 1, size):
                value -= matrix[k, i] * column[k]
            column[i] = value / matrix[i, i]
        for i in range(size):
            inverse[i, c] = column[i]
    return True


@compiled
def chord_normals(points, normals):
    """Unit normals (N, 2), to the left of the way through the points, from chords over an eighth of them."""
    count = len(points)
    reach = max(1, count // 8)
    for n in range(count):
        low, high = max(0, n - reach), min(count - 1, n + reach)
        dx, dy = points[high, 0] - points[low, 0], points[high, 1] - points[low, 1]
        length = max(math.hypot(dx, dy), 1e-12)
        normals[n, 0], normals[n, 1] = -dy / length, dx / length


@compiled
def _sum_up(at, normals, weights, size, data, whole, right):
    """Normal equations: data (size, size) of the points alone, whole with the priors, right-hand side (size,)."""
    phi, by_u, by_v = np.empty(10), np.empty(10), np.empty(10)
    data[:, :] = 0.0
    whole[:, :] = 0.0
    right[:] = 0.0
    count = len(at)
    stride = max(1, count // 12)  # the priors need no more than some of the points
    share = _GRADIENT * stride
    for n in range(count):
        monomials(at[n, 0], at[n, 1], phi)
        for i in range(size):
            weighted = weights[n] * phi[i]
            for j in range(i + 1):
                data[i, j] += weighted * phi[j]
        if n % stride == 0:
            monomial_slopes(at[n, 0], at[n, 1], by_u, by_v)
            for i in range(1, size):
                right[i] += share * (normals[n, 0] * by_u[i] + normals[n, 1] * by_v[i])
                for j in range(1, i + 1):
                    whole[i, j] += share * (by_u[i] * by_u[j] + by_v[i] * by_v[j])
    for i in range(size):
        for j in range(i + 1):
            whole[i, j] += data[i, j]
            data[j, i] = data[i, j]
    for i in range(3, size):
        mixed = 0.5 if i == 4 else 1.0 / 3.0 if i in (7, 8) else 1.0
        whole[i, i] += _RIDGE * count * mixed


@compiled
def _weigh(c, at, scale, rays, along, across, rough, normals, weights, residuals, variances):
    """Normals, weights of p (in units), residuals (m) and variances (m^2) of the points by the curve as it stands.

    False if the gradient vanishes at a point.
    """
    for n in range(len(at)):
        p, a, b = evaluate(c, at[n, 0], at[n, 1])
        steep = math.hypot(a, b)
        if not steep > 1e-6:
            return False
        normals[n, 0], normals[n, 1] = a / steep, b / steep
        residuals[n] = scale * p / steep
        variances[n] = across_variance(normals[n, 0], normals[n, 1], rays, along, across, n)
        weights[n] = scale * scale / ((variances[n] + rough) * steep * steep)
        far = abs(residuals[n]) / math.sqrt(variances[n] + rough)
        if far > 3.0:
            weights[n] *= 3.0 / far
    return True


@compiled
def place_points(points, at, origin):
    """Points in units of the farthest one's distance from their mean: fills at (N, 2), origin (2,); returns scale m."""
    origin[0], origin[1] = points[:, 0].mean(), points[:, 1].mean()
    scale = 1e-3
    for n in range(len(points)):
        scale = max(scale, math.hypot(points[n, 0] - origin[0], points[n, 1] - origin[1]))
    for n in range(len(points)):
        at[n, 0], at[n, 1] = (points[n, 0] - origin[0]) / scale, (points[n, 1] - origin[1]) / scale
    return scale


@compiled
def _sandwich(outer, inner, size, out):
    """out (size, size) = outer inner outer, all symmetric."""
    half = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            half[i, j] = 0.0
            for k in range(size):
                half[i, j] += outer[i, k] * inner[k, j]
    for i in range(size):
        for j in range(i + 1):
            value = 0.0
            for k in range(size):
                value += half[i, k] * outer[k, j]
            out[i, j], out[j, i] = value, value


@compiled
def weighted_squares(residuals, variances, rough):
    """Chi-square of residuals (m) whose variances (m^2) are `rough` larger than `variances`."""
    total = 0.0
    for n in range(len(residuals)):
        total += residuals[n] * residuals[n] / (variances[n] + rough)
    return total


@compiled
def fit_polynomial(points, rays, along, across, degree, limit, smooth, coef, cov, origin, residuals):
    """Fit of order `degree` (2 or 3): fills coef (10,), cov (10, 10), origin (2,), residuals (N,) m.

    limit: chi-square by `along` + `smooth` (m^2) from which a first fit is given up as hopeless: thrice as much.

    points (N, 2) must follow one another along the contour. Returns scale m, chi-square, rough m^2 (variance that the
    points' noise does not explain) and whether the fit exists. cov is what the points' noise makes of the
    coefficients: M^-1 A M^-1 with A of the points alone and M with the priors.
    """
    count, size = len(points), 6 if degree == 2 else 10
    at, normals = np.empty((count, 2)), np.empty((count, 2))
    weights, variances = np.empty(count), np.empty(count)
    data, whole, inverse, right = np.empty((10, 10)), np.empty((10, 10)), np.empty((10, 10)), np.empty(10)
    scale = place_points(points, at, origin)
    chord_normals(points, normals)
    for n in range(count):
        variance = across_variance(normals[n, 0], normals[n, 1], rays, along, across, n)
        weights[n] = scale * scale / variance
    coef[:] = 0.0
    cov[:, :] = 0.0
    rough, chi = 0.0, 0.0
    for turn in range(_TURNS):
        _sum_up(at, normals, weights, size, data, whole, right)
        if not invert(whole, size, inverse):
            return scale, math.inf, 0.0, False
        for i in range(size):
            coef[i] = 0.0
            for j in range(size):
                coef[i] += inverse[i, j] * right[j]
        if not _weigh(coef, at, scale, rays, along, across, rough, normals, weights, residuals, variances):
            return scale, math.inf, 0.0, False
        if turn == 0 and weighted_squares(residuals, along, smooth) > 3.0 * limit:
            return scale, math.inf, 0.0, False
        if turn == _TURNS - 2:
            rough, chi = excess_variance(residuals, variances, count - (5 if degree == 2 else 9))
            if rough > 0.0:
                for n in range(count):
                    weights[n] *= variances[n] / (variances[n] + rough)
    _sandwich(inverse, data, size, cov)
    return scale, chi, rough, True


@compiled
def _turned(c, u, v, mean):
    """Unit normal at a point, its steepness beside the mean's, and the curvature there, in units."""
    _p, a, b = evaluate(c, u, v)
    steep = math.hypot(a, b)
    uu, uv, vv = second_derivatives(c, u, v)
    bent = abs(uu * b * b - 2.0 * uv * a * b + vv * a * a) / (steep * steep * steep)
    return a / steep, b / steep, steep / mean, bent


@compiled
def is_sound(c, origin, scale, points, sigma, margin):
    """Whether a curve follows its points (N, 2), in order, like the smooth contour that it stands for.

    Gradients along it, and `margin` m beyond both ends, stay near their mean; the way through the points runs along it;
    half-way between points it passes between them; it has no bend as sharp as a corner. sigma: m, noise of a point.
    """
    count = len(points)
    mean = 0.0
    for n in range(count):
        _p, a, b = evaluate(c, (points[n, 0] - origin[0]) / scale, (points[n, 1] - origin[1]) / scale)
        mean += math.hypot(a, b) / count
    sharpest, most, whole, length = 0.0, 0.0, 0.0, 0.0
    before_x, before_y = 0.0, 0.0
    for n in range(count):
        u, v = (points[n, 0] - origin[0]) / scale, (points[n, 1] - origin[1]) / scale
        nx, ny, share, bent = _turned(c, u, v, mean)
        if not 1.0 / _STEEP <= share <= _STEEP or bent * sigma > _ROUND * scale:
            return False
        if n > 0:
            dx, dy = points[n, 0] - points[n - 1, 0], points[n, 1] - points[n - 1, 1]
            chord = math.hypot(dx, dy)
            u, v = u - 0.5 * dx / scale, v - 0.5 * dy / scale
            p, a, b = evaluate(c, u, v)
            steep = math.hypot(a, b)
            if steep < mean / _STEEP or scale * abs(p) > steep * (0.25 * chord + 3.0 * sigma):
                return False
            turn = math.acos(min(1.0, max(-1.0, nx * before_x + ny * before_y)))
            whole, length = whole + turn, length + chord
            if turn > _GENTLE:
                sharpest, most = max(sharpest, turn), max(most, bent / scale)
        before_x, before_y = nx, ny
        if n == 0 or n == count - 1:
            other = points[1] if n == 0 else points[count - 2]
            side = -1.0 if ny * (points[n, 0] - other[0]) - nx * (points[n, 1] - other[1]) < 0.0 else 1.0
            _a, _b, beyond, _c = _turned(
                c, u + side * ny * margin / scale, v - side * nx * margin / scale, mean
            )
            if not 1.0 / _STEEP <= beyond <= _STEEP:
                return False
    return sharpest <= _SHARPEST and most * length <= _EVEN * whole
