"""Implicit polynomial curves of order 1 to 3: value, gradient, and the signed distance with its exact gradient."""

import math

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def distance_with_gradient(coef, origin, scale, x, y, gradient):
    """g = p / |grad p| at (x, y) m, and its gradient (2,): grad p / |grad p| - p H grad p / |grad p|^3.

    coef: (10,) on [1, u, v, u2, uv, v2, u3, u2v, uv2, v3], u = (x - origin_x) / scale.
    """
    u, v = (x - origin[0]) / scale, (y - origin[1]) / scale
    p = coef[0] + coef[1] * u + coef[2] * v + u * (coef[3] * u + coef[4] * v) + coef[5] * v * v
    p += u * u * (coef[6] * u + coef[7] * v) + v * v * (coef[8] * u + coef[9] * v)
    pu = coef[1] + 2.0 * coef[3] * u + coef[4] * v + 3.0 * coef[6] * u * u + 2.0 * coef[7] * u * v + coef[8] * v * v
    pv = coef[2] + coef[4] * u + 2.0 * coef[5] * v + coef[7] * u * u + 2.0 * coef[8] * u * v + 3.0 * coef[9] * v * v
    puu = 2.0 * coef[3] + 6.0 * coef[6] * u + 2.0 * coef[7] * v
    puv = coef[4] + 2.0 * coef[7] * u + 2.0 * coef[8] * v
    pvv = 2.0 * coef[5] + 2.0 * coef[8] * u + 6.0 * coef[9] * v
    size = math.hypot(pu, pv)
    bend = p / size**3
    gradient[0] = pu / size - bend * (puu * pu + puv * pv)
    gradient[1] = pv / size - bend * (puv * pu + pvv * pv)
    return scale * p / size
