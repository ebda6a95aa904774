"""Implicit polynomial curves p(u, v) = 0 of order up to 3, point by point: value, derivatives, signed distance.

A curve is ten coefficients on [1, u, v, u2, uv, v2, u3, u2v, uv2, v3] with u = (x - ox) / s, v = (y - oy) / s. The
distance is g = p / |grad p|, equation (3) of Sun et al. 2010 (Taubin 1991), in the metres of x and y.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled

TERMS = 10


@compiled
def monomials(u, v, out):
    """out (10,): what the coefficients are multiplied by at (u, v)."""
    out[0], out[1], out[2] = 1.0, u, v
    out[3], out[4], out[5] = u * u, u * v, v * v
    out[6], out[7], out[8], out[9] = u * u * u, u * u * v, u * v * v, v * v * v


@compiled
def monomial_slopes(u, v, along_u, along_v):
    """Derivatives (10,) of the monomials by u and by v."""
    along_u[:] = 0.0
    along_v[:] = 0.0
    along_u[1], along_v[2] = 1.0, 1.0
    along_u[3], along_u[4], along_v[4], along_v[5] = 2.0 * u, v, u, 2.0 * v
    along_u[6], along_u[7], along_u[8] = 3.0 * u * u, 2.0 * u * v, v * v
    along_v[7], along_v[8], along_v[9] = u * u, 2.0 * u * v, 3.0 * v * v


@compiled
def evaluate(c, u, v):
    """p and its derivatives by u and by v."""
    p = c[0] + u * (c[1] + u * (c[3] + u * c[6])) + v * (c[2] + v * (c[5] + v * c[9]))
    p += u * v * (c[4] + u * c[7] + v * c[8])
    by_u = c[1] + u * (2.0 * c[3] + 3.0 * u * c[6]) + v * (c[4] + 2.0 * u * c[7] + v * c[8])
    by_v = c[2] + v * (2.0 * c[5] + 3.0 * v * c[9]) + u * (c[4] + u * c[7] + 2.0 * v * c[8])
    return p, by_u, by_v


@compiled
def second_derivatives(c, u, v):
    """Derivatives of p by uu, uv and vv."""
    uu = 2.0 * (c[3] + 3.0 * u * c[6] + v * c[7])
    uv = c[4] + 2.0 * (u * c[7] + v * c[8])
    vv = 2.0 * (c[5] + u * c[8] + 3.0 * v * c[9])
    return uu, uv, vv


@compiled
def signed_distance(c, ox, oy, scale, x, y):
    """g at (x, y) in m, and its exact gradient: grad p / |grad p| - p H grad p / |grad p|^3.

    Where the gradient of p vanishes there is no distance: all three are NaN.
    """
    u, v = (x - ox) / scale, (y - oy) / scale
    p, by_u, by_v = evaluate(c, u, v)
    squared = by_u * by_u + by_v * by_v
    if not squared > 0.0:
        return math.nan, math.nan, math.nan
    steep = math.sqrt(squared)
    uu, uv, vv = second_derivatives(c, u, v)
    share = p / squared
    gx = (by_u - share * (uu * by_u + uv * by_v)) / steep
    gy = (by_v - share * (uv * by_u + vv * by_v)) / steep
    return scale * p / steep, gx, gy


@compiled
def distance_rows(c, ox, oy, scale, points, rows):
    """rows (N, 10): derivative of the distance at every point (N, 2) m by the coefficients, p being near 0.

    Two points on one curve whose coefficients have covariance C (10, 10) share the noise rows_i' C rows_j, m^2.
    """
    for n in range(len(points)):
        u, v = (points[n, 0] - ox) / scale, (points[n, 1] - oy) / scale
        _p, by_u, by_v = evaluate(c, u, v)
        monomials(u, v, rows[n])
        rows[n] *= scale / math.hypot(by_u, by_v)


@compiled
def project(c, ox, oy, scale, x, y):
    """The foot (x, y) of a point on the curve: Newton's method on p = 0 and (point - foot) x grad p = 0.

    For points whose distance is small beside the radius of curvature; elsewhere it may end on another branch or, where
    the method fails, off the curve, which `evaluate` tells.
    """
    pu, pv = (x - ox) / scale, (y - oy) / scale
    u, v = pu, pv
    for _ in range(12):
        p, a, b = evaluate(c, u, v)
        uu, uv, vv = second_derivatives(c, u, v)
        du, dv = pu - u, pv - v
        across = du * b - dv * a
        ju = -b + du * uv - dv * uu
        jv = a + du * vv - dv * uv
        det = a * jv - b * ju
        if not abs(det) > 1e-12:
            break
        step_u, step_v = -(p * jv - across * b) / det, -(a * across - ju * p) / det
        length = math.hypot(step_u, step_v)
        if length > 0.5:  # of the curve's scale: no leap
            step_u, step_v = 0.5 * step_u / length, 0.5 * step_v / length
        u, v = u + step_u, v + step_v
        if length < 1e-13:
            break
    return ox + scale * u, oy + scale * v


@compiled
def bend(c, u, v):
    """Curvature at (u, v) in 1 / scale, positive where the curve bends away from the side with p > 0."""
    _p, a, b = evaluate(c, u, v)
    uu, uv, vv = second_derivatives(c, u, v)
    return (uu * b * b - 2.0 * uv * a * b + vv * a * a) / math.pow(a * a + b * b, 1.5)


@compiled
def distances(coef, origin, scale, piece, points):
    """(g, gx, gy) (N, 3) of every point (N, 2) to the curve that `piece` (N,) names among K."""
    out = np.empty((len(points), 3))
    for n in range(len(points)):
        k = piece[n]
        out[n, 0], out[n, 1], out[n, 2] = signed_distance(
            coef[k], origin[k, 0], origin[k, 1], scale[k], points[n, 0], points[n, 1]
        )
    return out
