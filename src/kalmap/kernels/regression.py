"""Statistical linear regression of a small function: one scheme for all four linearisers.

With y0 = f(mean), y(+-i) = f(mean +- s S_i), S S' = cov, the odd parts o_i = (y(+i) - y(-i)) / 2 and the
even parts e_i = (y(+i) + y(-i)) / 2 - y0 say everything (arrays hold differences from y0):

    mean = y0 + 2 w_m sum e_i,    A = D S^-1 with D_i = o_i / s,    P_yy = D D' + Lambda,

Lambda from the even parts alone. Unscented, central-difference (Norgaard et al. 2000, equation (14) of
Chen & Cheng 2012) and cubature rules differ in s, w_m and Lambda only; the Jacobian has Lambda = 0.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.layout import (
    CENTRAL_DIFFERENCE,
    RULE,
    RULE_A,
    RULE_B,
    RULE_C,
    UNSCENTED,
)

ZERO_PIVOT = 1e-13  # a pivot below this share of its diagonal is a zero direction of a semi-definite matrix
ZERO_COLUMN = 1e-4  # what may stand beside a zero pivot, as a correlation: |entry|^2 <= pivot times diagonal
NEGATIVE_PIVOT = -1e-9  # below this share the matrix is not a covariance
ROUNDING = 1e-14  # relative error of a pivot before cancellation, with room for the sums that made the matrix


@compiled
def weights(setup, n):
    """(s, w_m, w_0, w_e) of the rule in n dimensions: Lambda = w_0 mu mu' + w_e sum (e_i - c)(e_i - c)'.

    mu = 2 w_m sum e_i; the centre c is mu for the unscented and cubature rules, 0 for central differences.
    """
    rule = int(setup[RULE])
    if rule == UNSCENTED:
        alpha = setup[RULE_A]
        kappa = 3.0 - n if math.isnan(setup[RULE_C]) else setup[RULE_C]
        spread = alpha * alpha * (n + kappa)
        w = 0.5 / spread
        return math.sqrt(spread), w, (spread - n) / spread + 1.0 - alpha * alpha + setup[RULE_B], 2.0 * w
    if rule == CENTRAL_DIFFERENCE:
        h2 = setup[RULE_A] ** 2
        return setup[RULE_A], 0.5 / h2, 0.0, (h2 - 1.0) / (h2 * h2)
    return math.sqrt(n), 0.5 / n, 0.0, 1.0 / n


@compiled
def _root_column(cov, n, root, j, slack, spread):
    """Column j of the root; False if the matrix is not semi-definite there. slack (n,): rounding of each row's pivot.

    A pivot within its rounding of zero gives a zero column. spread: share of its diagonal that counts as zero at least.
    """
    pivot = cov[j, j]
    for k in range(j):
        pivot -= root[j, k] * root[j, k]
    scale = abs(cov[j, j])
    if not (pivot >= NEGATIVE_PIVOT * scale - slack[j]):
        return False
    for i in range(j):
        root[i, j] = 0.0
    zero = pivot <= max(spread * scale, slack[j])
    if not zero:
        root[j, j] = math.sqrt(pivot)
    else:
        root[j, j] = 0.0
    for i in range(j + 1, n):
        total = cov[i, j]
        for k in range(j):
            total -= root[i, k] * root[j, k]
        if not zero:
            root[i, j] = total / root[j, j]
            continue
        root[i, j] = 0.0  # a semi-definite matrix has nothing beside a zero pivot
        other = abs(cov[i, i])
        rounding = math.sqrt(slack[i] * slack[j])
        if not (abs(total) <= ZERO_COLUMN * math.sqrt(scale * other) + 1e-12 * other + rounding):
            return False
    return True


@compiled
def square_root(cov, n, root):
    """Lower root of a semi-definite matrix: a zero pivot gives a zero column. False if it is indefinite.

    Where the plain recursion fails it is done again with a running bound on its rounding errors: a tiny pivot, such as
    the way across of a vehicle that has just started, magnifies them in the rows below, which must not look indefinite.
    """
    slack = np.zeros(n)
    plain = True
    for j in range(n):
        if not _root_column(cov, n, root, j, slack, ZERO_PIVOT):
            plain = False
            break
    if plain:
        return True
    slack[:] = 0.0
    for j in range(n):
        if not _root_column(cov, n, root, j, slack, ZERO_PIVOT):
            return False
        if root[j, j] > 0.0:
            share = ROUNDING * abs(cov[j, j]) / (root[j, j] * root[j, j])
            for i in range(j + 1, n):
                slack[i] += share * root[i, j] * root[i, j]
    return True


@compiled
def regress(setup, plus, minus, n, m, root, mean, matrix, residual, linear):
    """Mean offset (m,), regression matrix (m, n) and residual covariance Lambda (m, m) from the points.

    plus, minus: (n, m) values at the points +-i, as differences from the value at the mean; overwritten.
    linear: so many leading inputs are known to act linearly and independently of the rest (their root is a block of
    its own): their points are not read and their columns of `matrix` are the caller's.
    """
    s, w_mean, w_zero, w_even = weights(setup, n)
    half = 0.5 / s
    for r in range(m):
        total = 0.0
        for i in range(linear, n):
            odd = (plus[i, r] - minus[i, r]) * half
            even = 0.5 * (plus[i, r] + minus[i, r])
            plus[i, r], minus[i, r] = odd, even
            total += even
        mean[r] = 2.0 * w_mean * total
    centred = 0.0 if int(setup[RULE]) == CENTRAL_DIFFERENCE else 1.0
    for r in range(m):
        for c in range(r + 1):
            total = (w_zero + linear * centred * w_even) * mean[r] * mean[c]
            for i in range(linear, n):
                total += w_even * (minus[i, r] - centred * mean[r]) * (minus[i, c] - centred * mean[c])
            residual[r, c] = total
            residual[c, r] = total
    for j in range(n - 1, linear - 1, -1):  # matrix root = D, solved from the last column back
        pivot = root[j, j]
        for r in range(m):
            total = plus[j, r]
            for i in range(j + 1, n):
                total -= matrix[r, i] * root[i, j]
            matrix[r, j] = total / pivot if pivot != 0.0 else 0.0


@compiled
def wrap(angle):
    """The same angle in [-pi, pi)."""
    if -math.pi <= angle < math.pi:
        return angle
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return -math.pi if wrapped >= math.pi else wrapped  # NaN stays NaN


@compiled
def left_jacobian(angle):
    """(s, c) of V(angle) = [[s, -c], [c, s]], the position part of the SE(2) exponential."""
    if abs(angle) < 1e-4:
        square = angle * angle
        return 1.0 - square / 6.0, angle * (0.5 - square / 24.0)
    return math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle


@compiled
def congruence(matrix, cov, m, n, out):
    """out = matrix cov matrix' for small blocks, symmetric to the last bit."""
    product = np.empty((m, n))
    for r in range(m):
        for c in range(n):
            total = 0.0
            for k in range(n):
                total += matrix[r, k] * cov[k, c]
            product[r, c] = total
    for r in range(m):
        for c in range(r + 1):
            total = 0.0
            for k in range(n):
                total += product[r, k] * matrix[c, k]
            out[r, c] = total
            out[c, r] = total
