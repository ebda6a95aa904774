"""Applying a frame: gains, correction and covariance in one pass, for any regression of the sightings.

Equations (23)-(25) of Chen & Cheng 2012, for all sightings of a frame at once: with G = A P, S = A G' + R,
L L' = S and W = L^-1 G, the mean moves by W' L^-1 nu and P by -W' W. In invariant coordinates the correction
goes through the SE(2) exponential and P <- T P T' follows, T = I + a e_theta', a = J (x+ - x-) on positions:
a change of rank two that joins the same pass.
"""

import math

import numpy as np
from numba import njit

from kalmap.kernels.compiled import compiled
from kalmap.kernels.layout import (
    BIAS_COUNT,
    INNOVATION_NOT_POSITIVE,
    INVARIANT,
    NOT_FINITE,
    OK,
    OUTLIER_GATE,
    SEQUENTIAL,
)
from kalmap.kernels.packed import add_outer, transform_leading
from kalmap.kernels.regression import congruence, left_jacobian, wrap
from kalmap.kernels.sensing import first_bad_noise, regress_landmark, regress_sighting, sighting_block


@compiled
def regress_frame(setup, mean, packed, z, indices, matrices, innovation, residuals):
    """Regress every sighting of a frame on its own (pose, landmark) block, all at the same prior.

    matrices: (M, 2, 5). innovation: (2 M,). residuals: (M, 2, 2), to be added to the noise.
    """
    cov, predicted = np.empty((5, 5)), np.empty(2)
    for m in range(len(z)):
        index = indices[m]
        sighting_block(packed, index, cov)
        status = regress_sighting(
            setup, mean, mean[index], mean[index + 1], cov, predicted, matrices[m], residuals[m]
        )
        if status != OK:
            return status
        innovation[2 * m] = z[m, 0] - predicted[0]
        innovation[2 * m + 1] = wrap(z[m, 1] - predicted[1])
    return OK


@compiled
def gather_rows(packed, n, indices, rows):
    """Rows of P in one sweep: two for each landmark of `indices`, then three of the pose; (2 M + 3, >= n).

    Row by row of the triangle, so that what a row holds of all the columns wanted is fetched together.
    """
    pose = 2 * len(indices)
    for i in range(n):
        base = i * (i + 1) // 2
        for c in range(3):
            rows[pose + c, i] = packed[base + c] if c <= i else packed[c * (c + 1) // 2 + i]
    for m in range(len(indices)):
        index = indices[m]
        first = index * (index + 1) // 2
        second = first + index + 1
        for i in range(index + 1):
            rows[2 * m, i] = packed[first + i]
        for i in range(index + 2):
            rows[2 * m + 1, i] = packed[second + i]
        rows[2 * m, index + 1] = packed[second + index]
    for i in range(n):
        base = i * (i + 1) // 2
        for m in range(len(indices)):
            if i > indices[m] + 1:
                rows[2 * m, i] = packed[base + indices[m]]
                rows[2 * m + 1, i] = packed[base + indices[m] + 1]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _fill_gain_rows(packed, n, indices, matrices, rows, work):
    """work[2 m + r, :n] = A_m P. rows: work space for the rows of P, at least (2 M + 3, n)."""
    gather_rows(packed, n, indices, rows)
    pose = 2 * len(indices)
    x_row, y_row, turn_row = rows[pose], rows[pose + 1], rows[pose + 2]
    for m in range(len(indices)):
        first, second = rows[2 * m], rows[2 * m + 1]
        for r in range(2):
            a, b, c = matrices[m, r, 0], matrices[m, r, 1], matrices[m, r, 2]
            d, e = matrices[m, r, 3], matrices[m, r, 4]
            row = work[2 * m + r]
            for i in range(n):
                row[i] = a * x_row[i] + b * y_row[i] + c * turn_row[i] + d * first[i] + e * second[i]


@compiled
def _innovation_root(indices, matrices, noises, work, root):
    """Cholesky root of S = A P A' + noise from the rows A P in `work`. False if S is not positive definite."""
    k = 2 * len(indices)
    for i in range(k):
        for j in range(i + 1):
            m, r = j // 2, j % 2
            total = matrices[m, r, 3] * work[i, indices[m]] + matrices[m, r, 4] * work[i, indices[m] + 1]
            for c in range(3):
                total += matrices[m, r, c] * work[i, c]
            if i // 2 == m:
                total += noises[m, i % 2, r]
            for p in range(j):
                total -= root[i, p] * root[j, p]
            if i == j:
                if not total > 0.0:
                    return False
                root[i, i] = math.sqrt(total)
            else:
                root[i, j] = total / root[j, j]
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _whiten(root, k, n, work, negated, innovation, correction):
    """work <- L^-1 work, innovation <- L^-1 innovation, correction <- work' innovation. Returns the NIS.

    negated: its first k rows become -work.
    """
    nis = 0.0
    correction[:n] = 0.0
    for i in range(k):
        row, minus = work[i], negated[i]
        y = innovation[i]
        for p in range(i):
            factor = root[i, p]
            other = work[p]
            for j in range(n):
                row[j] -= factor * other[j]
            y -= factor * innovation[p]
        scale = 1.0 / root[i, i]
        y *= scale
        innovation[i] = y
        nis += y * y
        for j in range(n):
            value = row[j] * scale
            row[j] = value
            minus[j] = -value
            correction[j] += value * y
    return nis


@compiled
def _correct_mean(setup, mean, n, correction, shift):
    """Apply the correction; in invariant coordinates leave a = J (x+ - x-) of the positions in `shift`."""
    d = 3 + int(setup[BIAS_COUNT])
    turn = correction[2]
    s, v = 1.0, 0.0
    if setup[INVARIANT] != 0.0:  # exp(xi) x - x = V d: the twist's xi = d - J x d_theta drops out
        s, v = left_jacobian(turn)
    for i in range(2, d):
        mean[i] += correction[i]
        shift[i] = 0.0
    for i in range(-2, n - d, 2):
        p = 0 if i < 0 else d + i
        dx = s * correction[p] - v * correction[p + 1]
        dy = v * correction[p] + s * correction[p + 1]
        mean[p] += dx
        mean[p + 1] += dy
        shift[p], shift[p + 1] = -dy, dx
    mean[2] = wrap(mean[2])


@compiled
def apply_rows(setup, mean, packed, n, k, root, innovation, left, right):
    """Correct mean and covariance from the k rows A P in `right` and the root of S. Returns (status, NIS).

    left: its row k + 2 holds the heading's row of P. After an error nothing has been changed.
    """
    correction, shift = np.empty(n), np.empty(n)
    nis = _whiten(root, k, n, right, left, innovation, correction)
    if not math.isfinite(nis):
        return NOT_FINITE, nis
    rank = k
    if setup[INVARIANT] != 0.0:
        theta_row = right[k + 1]
        theta_row[:n] = left[k + 2, :n]  # the heading's row of P, as it was gathered
        for p in range(k):
            factor = right[p, 2]
            for j in range(n):
                theta_row[j] -= factor * right[p, j]
    _correct_mean(setup, mean, n, correction, shift)
    if setup[INVARIANT] != 0.0:
        half = 0.5 * right[k + 1, 2]
        for j in range(n):
            right[k, j] = right[k + 1, j] + half * shift[j]
            left[k, j] = shift[j]
            left[k + 1, j] = right[k, j]
            right[k + 1, j] = shift[j]
        rank = k + 2
    if rank % 2 == 1:
        left[rank, :n] = 0.0
        right[rank, :n] = 0.0
        rank += 1
    add_outer(packed, n, left, right, rank)
    return OK, nis


@compiled
def apply_frame(setup, mean, packed, n, indices, matrices, innovation, noises, left, right):
    """One joint update with M regressed sightings. Returns (status, NIS).

    noises: (M, 2, 2), sensor noise plus Lambda. left, right: work space, each at least (2 M + 6, n).
    After an error nothing has been changed.
    """
    k = 2 * len(indices)
    _fill_gain_rows(packed, n, indices, matrices, left, right)
    root = np.zeros((k, k))
    if not _innovation_root(indices, matrices, noises, right, root):
        return INNOVATION_NOT_POSITIVE, 0.0
    return apply_rows(setup, mean, packed, n, k, root, innovation, left, right)


@compiled
def constrain_equal(setup, mean, packed, n, first, second, extent, left, right):
    """Make two landmarks one: the observation x_first - x_second = 0. Returns (status, distance squared).

    first, second: where they begin. extent: m, standard deviation of where either seems to be from another side; 0 is a
    noise-free constraint, for points. Then the covariance is singular in their difference until one is removed.
    left, right: as for `apply_frame` with one sighting more than two.
    """
    gather_rows(packed, n, np.array([first, second]), left)
    for r in range(2):
        for i in range(n):
            right[r, i] = left[r, i] - left[2 + r, i]
    left[4, :n] = left[6, :n]
    root = np.zeros((2, 2))
    noise = 2.0 * extent * extent
    s00 = right[0, first] - right[0, second] + noise
    s10 = right[1, first] - right[1, second]
    s11 = right[1, first + 1] - right[1, second + 1] + noise
    if not s00 > 0.0 or not s11 - s10 * s10 / s00 > 0.0:
        return INNOVATION_NOT_POSITIVE, 0.0
    root[0, 0] = math.sqrt(s00)
    root[1, 0] = s10 / root[0, 0]
    root[1, 1] = math.sqrt(s11 - root[1, 0] * root[1, 0])
    innovation = np.array([mean[second] - mean[first], mean[second + 1] - mean[first + 1]])
    return apply_rows(setup, mean, packed, n, 2, root, innovation, left, right)


@compiled
def inflate_outliers(gate, packed, indices, matrices, innovation, noises):
    """Inflate the noise of sightings that contradict the map until their innovation lies on the gate.

    Returns by how much their distances squared exceeded the gate in all, so that the NIS can still tell of them.
    gate: Mahalanobis distance squared. noises: (M, 2, 2), sensor noise plus Lambda, changed in place by
    (d^2 / gate - 1) S: a redescending weight, so that a gross error moves the state less the grosser it is, while
    a true contradiction (a loop closed late) still pulls, frame after frame.
    """
    cov, spread, excess = np.empty((5, 5)), np.empty((2, 2)), 0.0
    for m in range(len(indices)):
        sighting_block(packed, indices[m], cov)
        congruence(matrices[m], cov, 2, 5, spread)
        s00 = spread[0, 0] + noises[m, 0, 0]
        s01 = spread[0, 1] + noises[m, 0, 1]
        s11 = spread[1, 1] + noises[m, 1, 1]
        determinant = s00 * s11 - s01 * s01
        if not determinant > 0.0:
            continue  # the joint update says so, with its name
        nu0, nu1 = innovation[2 * m], innovation[2 * m + 1]
        squared = (s11 * nu0 * nu0 - 2.0 * s01 * nu0 * nu1 + s00 * nu1 * nu1) / determinant
        if squared > gate:
            excess += squared - gate
            factor = squared / gate - 1.0
            noises[m, 0, 0] += factor * s00
            noises[m, 0, 1] += factor * s01
            noises[m, 1, 0] += factor * s01
            noises[m, 1, 1] += factor * s11
    return excess


@compiled
def update_frame(setup, mean, packed, n, z, indices, noises, left, right):
    """Regress and apply a frame's matched sightings, jointly or one after the other. Returns (status, NIS)."""
    count = len(indices)
    if first_bad_noise(noises) >= 0:  # before anything is changed
        return INNOVATION_NOT_POSITIVE, 0.0
    matrices, residuals = np.empty((count, 2, 5)), np.empty((count, 2, 2))
    innovation = np.empty(2 * count)
    group = 1 if setup[SEQUENTIAL] != 0.0 else count
    nis = 0.0
    for first in range(0, count, group):
        last = first + group
        a, v, r = matrices[first:last], innovation[2 * first : 2 * last], residuals[first:last]
        status = regress_frame(setup, mean, packed, z[first:last], indices[first:last], a, v, r)
        if status != OK:
            return status, nis
        for m in range(group):
            for i in range(2):
                for j in range(2):
                    r[m, i, j] += noises[first + m, i, j]
        if setup[OUTLIER_GATE] > 0.0:
            nis += inflate_outliers(setup[OUTLIER_GATE], packed, indices[first:last], a, v, r)
        status, part = apply_frame(setup, mean, packed, n, indices[first:last], a, v, r, left, right)
        if status != OK:
            return status, nis
        nis += part
    return OK, nis


@compiled
def flush_and_update(setup, mean, packed, n, phi, z, indices, noises, left, right):
    """Carry the waiting motion `phi` to the map, then `update_frame`: one call from Python instead of two."""
    transform_leading(packed, n, len(phi), phi)
    return update_frame(setup, mean, packed, n, z, indices, noises, left, right)


@compiled
def append_landmark(mean, packed, n, landmark, matrix, noise, residual):
    """Append a landmark regressed on (pose, range, bearing): O(n). The buffers must have room. Returns n + 2."""
    for r in range(2):
        start = (n + r) * (n + r + 1) // 2
        for j in range(n):
            total = 0.0
            for i in range(3):
                entry = packed[i * (i + 1) // 2 + j] if j <= i else packed[j * (j + 1) // 2 + i]
                total += matrix[r, i] * entry
            packed[start + j] = total
        for c in range(r + 1):
            total = residual[r, c]
            for i in range(3):
                total += packed[start + i] * matrix[c, i]
            for i in range(2):
                for j in range(2):
                    total += matrix[r, 3 + i] * noise[i, j] * matrix[c, 3 + j]
            packed[start + n + c] = total
        mean[n + r] = landmark[r]
    return n + 2


@compiled
def append_frame(setup, mean, packed, n, z, noises):
    """Found a landmark for every sighting of z. Returns (status, new n)."""
    if first_bad_noise(noises) >= 0:
        return INNOVATION_NOT_POSITIVE, n
    landmark, matrix, residual = np.empty(2), np.empty((2, 5)), np.empty((2, 2))
    before, cov = n, np.empty((3, 3))
    for i in range(3):
        for j in range(i + 1):
            cov[i, j] = packed[i * (i + 1) // 2 + j]
            cov[j, i] = cov[i, j]
    for m in range(len(z)):
        status = regress_landmark(setup, mean, z[m], cov, noises[m], landmark, matrix, residual)
        if status != OK:
            return status, before
        if not (math.isfinite(landmark[0]) and math.isfinite(landmark[1])):
            return NOT_FINITE, before
        n = append_landmark(mean, packed, n, landmark, matrix, noises[m], residual)
        if not math.isfinite(packed[n * (n + 1) // 2 - 1] + packed[n * (n - 1) // 2 - 1]):
            return NOT_FINITE, before
    return OK, n
