"""What the pairs chosen so far say about the rest: the Cholesky factor of a growing joint innovation covariance.

A hypothesis of k pairs (m_j, c_j) has the joint innovation covariance with blocks G[c_i, c_j] + [i = j] R_{m_j},
G = cross. Its lower factor grows by one block row (2 rows) a pair. Kept are, for every candidate c and not only
for the chosen ones, W_j[c] = L_jj^-1 cov(z_j, z_c | pairs before j): for a chosen c that is a block of the factor,
and for every other one it yields, given the first k pairs,

    cov(z_c | k) = G[c, c] - sum_j W_j[c]' W_j[c],    E(z_c | k) - E(z_c) = sum_j W_j[c]' y_j,

y_j the whitened innovation of pair j. The joint distance squared is sum_j |y_j|^2 (the chain rule of Gaussians):
a pair adds its own distance squared *given the pairs before it*, and nothing is inverted twice. What belongs to k
pairs stands in `given[k]`; to take a pair back is to go on with a smaller k.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.layout import INNOVATION_NOT_POSITIVE, OK

# Planes of given (K + 1, 9, C): the last pair's W (2 x 2), the covariance (xx, xy, yy) and the shift of the mean.
_W00, _W01, _W10, _W11, _XX, _XY, _YY, _SHIFT_X, _SHIFT_Y, _PLANES = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9

ZERO_PIVOT = 1e-13  # a pivot below this share of its variance before any pair is rounding


@compiled
def unconditioned(cross, pairs):
    """(given, total) with room for so many pairs, holding none. total: (pairs + 1,) joint distances squared."""
    count = len(cross)
    given, total = np.zeros((pairs + 1, _PLANES, count)), np.zeros(pairs + 1)
    for c in range(count):
        given[0, _XX, c], given[0, _XY, c], given[0, _YY, c] = (
            cross[c, c, 0, 0],
            cross[c, c, 0, 1],
            cross[c, c, 1, 1],
        )
    return given, total


@compiled
def _pair_root(noise, given, k, c):
    """(l00, l10, l11): lower root of a pair's innovation covariance given k pairs; l11 = 0 if it has none."""
    s00, s11 = given[k, _XX, c] + noise[0, 0], given[k, _YY, c] + noise[1, 1]
    l10 = given[k, _XY, c] + noise[0, 1]
    if not s00 > ZERO_PIVOT * (given[0, _XX, c] + noise[0, 0]):
        return 0.0, 0.0, 0.0
    l00 = math.sqrt(s00)
    l10 /= l00
    pivot = s11 - l10 * l10
    if not pivot > ZERO_PIVOT * (given[0, _YY, c] + noise[1, 1]):
        return 0.0, 0.0, 0.0
    return l00, l10, math.sqrt(pivot)


@compiled
def added_distance(nu, noises, given, k, m, c):
    """What the pair (m, c) would add to the joint distance squared of k pairs; -1: its covariance has no root."""
    l00, l10, l11 = _pair_root(noises[m], given, k, c)
    if l11 == 0.0:
        return -1.0
    y0 = (nu[m, c, 0] - given[k, _SHIFT_X, c]) / l00
    y1 = (nu[m, c, 1] - given[k, _SHIFT_Y, c] - l10 * y0) / l11
    return y0 * y0 + y1 * y1


@compiled
def add_pair(nu, cross, noises, given, total, k, m, a):
    """Make (m, a) pair number k, counted from 0: fills given[k + 1] and total[k + 1]. Returns a status code."""
    l00, l10, l11 = _pair_root(noises[m], given, k, a)
    if l11 == 0.0:
        return INNOVATION_NOT_POSITIVE
    y0 = (nu[m, a, 0] - given[k, _SHIFT_X, a]) / l00
    y1 = (nu[m, a, 1] - given[k, _SHIFT_Y, a] - l10 * y0) / l11
    total[k + 1] = total[k] + (y0 * y0 + y1 * y1)
    new, old = given[k + 1], given[k]
    _conditional_cross(cross, given, k, a, new)
    r00, r11 = 1.0 / l00, 1.0 / l11
    for c in range(len(cross)):
        w00, w01 = new[_W00, c] * r00, new[_W01, c] * r00
        w10, w11 = (new[_W10, c] - l10 * w00) * r11, (new[_W11, c] - l10 * w01) * r11
        new[_W00, c], new[_W01, c], new[_W10, c], new[_W11, c] = w00, w01, w10, w11
        new[_XX, c] = old[_XX, c] - w00 * w00 - w10 * w10
        new[_XY, c] = old[_XY, c] - w00 * w01 - w10 * w11
        new[_YY, c] = old[_YY, c] - w01 * w01 - w11 * w11
        new[_SHIFT_X, c] = old[_SHIFT_X, c] + w00 * y0 + w10 * y1
        new[_SHIFT_Y, c] = old[_SHIFT_Y, c] + w01 * y0 + w11 * y1
    return OK


@compiled
def _conditional_cross(cross, given, k, a, new):
    """Write cov(z_a, z_c | k pairs) = G[a, c] - sum_j W_j[a]' W_j[c] of every c into the W planes of `new`."""
    count = len(cross)
    for c in range(count):
        new[_W00, c], new[_W01, c] = cross[a, c, 0, 0], cross[a, c, 0, 1]
        new[_W10, c], new[_W11, c] = cross[a, c, 1, 0], cross[a, c, 1, 1]
    for j in range(1, k + 1):
        w = given[j]
        a00, a01, a10, a11 = w[_W00, a], w[_W01, a], w[_W10, a], w[_W11, a]
        for c in range(count):
            new[_W00, c] -= a00 * w[_W00, c] + a10 * w[_W10, c]
            new[_W01, c] -= a00 * w[_W01, c] + a10 * w[_W11, c]
            new[_W10, c] -= a01 * w[_W00, c] + a11 * w[_W10, c]
            new[_W11, c] -= a01 * w[_W01, c] + a11 * w[_W11, c]
