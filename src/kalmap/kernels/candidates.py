"""What a map expects a frame to look like: regressions of the candidates, distances, and how they hang together.

Everything reads the covariance with the motion `phi` that has not reached it yet, so that asking about a few
landmarks costs the same however large the map is.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.layout import NOT_POSITIVE, OK
from kalmap.kernels.regression import congruence, wrap
from kalmap.kernels.sensing import regress_sighting, sighting_block


@compiled
def waiting_block(packed, phi, index, out):
    """The (pose, landmark) block (5, 5), the waiting motion applied to the landmark's cross-covariance."""
    sighting_block(packed, index, out)
    for r in range(2):
        start = (index + r) * (index + r + 1) // 2
        for i in range(3):
            total = 0.0
            for c in range(len(phi)):
                total += phi[i, c] * packed[start + c]
            out[3 + r, i] = total
            out[i, 3 + r] = total


@compiled
def regress_candidates(setup, mean, packed, phi, indices, expected, matrices, spreads):
    """Regress each candidate's sighting. Returns a status code.

    indices: (C,) where each begins in the state. expected: (C, 2) range and bearing. matrices: (C, 2, 5) on the
    additive (pose, landmark) errors. spreads: (C, 2, 2), A P A' + Lambda, the sensor's noise left out.
    """
    cov, block, residual = np.empty((5, 5)), np.empty((5, 5)), np.empty((2, 2))
    for c in range(len(indices)):
        index = indices[c]
        waiting_block(packed, phi, index, block)
        cov[:, :] = block
        status = regress_sighting(
            setup, mean, mean[index], mean[index + 1], cov, expected[c], matrices[c], residual
        )
        if status != OK:
            return status
        congruence(matrices[c], block, 2, 5, spreads[c])
        for i in range(2):
            for j in range(2):
                spreads[c, i, j] += residual[i, j]
    return OK


@compiled
def distances(z, noises, expected, spreads, squared, log_volume):
    """Mahalanobis distance squared and ln det S of every sighting (M) with every candidate (C): two (M, C)."""
    for m in range(len(z)):
        for c in range(len(expected)):
            s00 = spreads[c, 0, 0] + noises[m, 0, 0]
            s01 = spreads[c, 0, 1] + noises[m, 0, 1]
            s11 = spreads[c, 1, 1] + noises[m, 1, 1]
            determinant = s00 * s11 - s01 * s01
            if not determinant > 0.0 or not s00 > 0.0:
                return NOT_POSITIVE
            nu0, nu1 = z[m, 0] - expected[c, 0], wrap(z[m, 1] - expected[c, 1])
            squared[m, c] = (s11 * nu0 * nu0 - 2.0 * s01 * nu0 * nu1 + s00 * nu1 * nu1) / determinant
            log_volume[m, c] = math.log(determinant)
    return OK


@compiled
def _entry(packed, i, j):
    return packed[i * (i + 1) // 2 + j] if j <= i else packed[j * (j + 1) // 2 + i]


@compiled
def cross_blocks(packed, phi, indices, matrices, out):
    """out (C, C, 2, 2): covariance A_c P A_d' of the expected sightings of candidates c and d, Lambda left out."""
    count = len(indices)
    blocks = np.empty((count, 5, 5))
    for c in range(count):
        waiting_block(packed, phi, indices[c], blocks[c])
    joint, half = np.empty((5, 5)), np.empty((2, 5))
    for c in range(count):
        for d in range(c + 1):
            for i in range(3):  # rows: (pose, c); columns: (pose, d)
                for j in range(3):
                    joint[i, j] = blocks[c, i, j]
                for j in range(2):
                    joint[i, 3 + j] = blocks[d, i, 3 + j]
                    joint[3 + j, i] = blocks[c, 3 + j, i]
            for i in range(2):
                for j in range(2):
                    joint[3 + i, 3 + j] = _entry(packed, indices[c] + i, indices[d] + j)
            for r in range(2):
                for j in range(5):
                    total = 0.0
                    for i in range(5):
                        total += matrices[c, r, i] * joint[i, j]
                    half[r, j] = total
            for r in range(2):
                for s in range(2):
                    total = 0.0
                    for j in range(5):
                        total += half[r, j] * matrices[d, s, j]
                    out[c, d, r, s] = total
                    out[d, c, s, r] = total


@compiled
def separations(mean, packed, first, second, extent, out):
    """out (K,): squared Mahalanobis distance of two landmarks from being the same point.

    d' S^-1 d with d = x_i - x_j and S = P_ii + P_jj - P_ij - P_ji + 2 extent^2 I: the joint compatibility of "they are
    one". first, second: (K,) where each landmark begins. extent: m.
    """
    for k in range(len(first)):
        i, j = first[k], second[k]
        dx, dy = mean[i] - mean[j], mean[i + 1] - mean[j + 1]
        s00 = _entry(packed, i, i) + _entry(packed, j, j) - 2.0 * _entry(packed, i, j) + 2.0 * extent * extent
        s11 = _entry(packed, i + 1, i + 1) + _entry(packed, j + 1, j + 1) - 2.0 * _entry(packed, i + 1, j + 1)
        s11 += 2.0 * extent * extent
        s01 = _entry(packed, i + 1, i) + _entry(packed, j + 1, j)
        s01 -= _entry(packed, i, j + 1) + _entry(packed, i + 1, j)
        determinant = s00 * s11 - s01 * s01
        if determinant > 0.0 and s00 > 0.0:
            out[k] = (s11 * dx * dx - 2.0 * s01 * dx * dy + s00 * dy * dy) / determinant
        else:
            out[k] = math.inf  # they differ by exactly what the map says: nothing to merge


@compiled
def hidden_by_sightings(z, expected, width, depth, out):
    """out (C,) bool: something seen in this frame stands before the candidate.

    A sighting hides what is at least `depth` m behind it and within `width` m of its ray.
    """
    for c in range(len(expected)):
        out[c] = False
        for m in range(len(z)):
            if expected[c, 0] - z[m, 0] > depth:
                apart = abs(wrap(z[m, 1] - expected[c, 1]))
                if apart * z[m, 0] < width:
                    out[c] = True
                    break


@compiled
def hidden_by_beams(ranges, bearings, expected, depth, out):
    """out (C,) bool: the beam that points at the candidate came back from at least `depth` m before it.

    bearings: (B,) ascending. A candidate outside the swept sector counts as hidden: the scan says nothing of it.
    A range of 0 is no return: it hides nothing.
    """
    count = len(bearings)
    for c in range(len(expected)):
        at = np.searchsorted(bearings, expected[c, 1])
        if at == 0 or at >= count:
            out[c] = True
            continue
        low = at - 1 if expected[c, 1] - bearings[at - 1] < bearings[at] - expected[c, 1] else at
        out[c] = 0.0 < ranges[low] < expected[c, 0] - depth
