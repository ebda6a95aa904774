"""A proposal that has seen the frame: where a particle's pose is likely, given its map and the sightings.

The pose is x(e) = x compose exp(R e), e ~ N(0, I), R the root of the motion since the last frame. The mode of
p(e) prod_z (c(z) + sum_j P_D w_j N(z; h(x(e), m_j), S_j)), the likelihood of a Poisson map, is found by expectation
maximisation: every pair's probability at the present e, then one Gauss-Newton step with these as weights. The first
pairs are judged with the uncertainty of the pose in their covariance, later ones with what is left of it, so that no
association is decided. The Gaussian at the mode is sampled; the weight is p(e) / q(e) times the set likelihood. That is
exact for a whole draw (`spread_by` 1); with part of the deviation drawn the rest stays as the particle's covariance,
and the likelihood, blurred by it, is an approximation.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.frame import in_view
from kalmap.kernels.looks import noise_root, sight_jacobian
from kalmap.kernels.regression import left_jacobian, wrap
from kalmap.kernels.set_layout import (
    CLUTTER,
    DETECTION,
    GATE,
    L11,
    L21,
    L22,
    LOOK,
    WEIGHT,
    X,
    Y,
)

_ROUNDS = 6
_SETTLED = 1e-2
_LEAST_WEIGHT = 1e-3  # lighter components say too little about the pose


@compiled
def moved(pose, root, e, out):
    """out = pose compose exp(root e)."""
    xi0 = root[0, 0] * e[0]
    xi1 = root[1, 0] * e[0] + root[1, 1] * e[1]
    xi2 = root[2, 0] * e[0] + root[2, 1] * e[1] + root[2, 2] * e[2]
    s, c = left_jacobian(xi2)
    dx, dy = s * xi0 - c * xi1, c * xi0 + s * xi1
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    out[0] = pose[0] + cosine * dx - sine * dy
    out[1] = pose[1] + sine * dx + cosine * dy
    out[2] = wrap(pose[2] + xi2)


@compiled
def world_root(heading, root, out):
    """The root of a body-frame motion in the world's axes (x, y, heading), lower triangular again."""
    cosine, sine = math.cos(heading), math.sin(heading)
    turned = np.empty((3, 3))
    for k in range(3):
        turned[0, k] = cosine * root[0, k] - sine * root[1, k]
        turned[1, k] = sine * root[0, k] + cosine * root[1, k]
        turned[2, k] = root[2, k]
    lower_rows(turned, out)


@compiled
def lower_rows(rows, out):
    """Lower root (3, 3) of rows rows' for rows (3, K), by Gram-Schmidt; overwrites rows."""
    width = rows.shape[1]
    out[:, :] = 0.0
    for r in range(3):
        for c in range(r):
            total = 0.0
            for k in range(width):
                total += rows[r, k] * rows[c, k]
            out[r, c] = total if out[c, c] > 0.0 else 0.0
            for k in range(width):
                rows[r, k] -= out[r, c] * rows[c, k]
        size = 0.0
        for k in range(width):
            size += rows[r, k] * rows[r, k]
        size = math.sqrt(size)
        out[r, r] = size
        for k in range(width):
            rows[r, k] = rows[r, k] / size if size > 0.0 else 0.0


@compiled
def root_of_inverse(information, factor):
    """Upper root of the inverse of I + A, A (3, 3) semi-definite, factor factor' = (I + A)^-1; ln det (I + A).

    By the Cholesky factor G of I + A, whose pivots are one at least however much rounding takes: factor = G^-T.
    """
    lower = np.zeros((3, 3))
    log_determinant = 0.0
    for j in range(3):
        pivot = information[j, j]
        for k in range(j):
            pivot -= lower[j, k] * lower[j, k]
        pivot = max(pivot, 1.0)
        log_determinant += math.log(pivot)
        lower[j, j] = math.sqrt(pivot)
        for i in range(j + 1, 3):
            total = information[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = total / lower[j, j]
    factor[:, :] = 0.0
    for r in range(3):  # row r of G^-1 is column r of the factor
        for c in range(r + 1):
            total = 1.0 if r == c else 0.0
            for k in range(c, r):
                total -= lower[r, k] * factor[c, k]
            factor[c, r] = total / lower[r, r]
    return log_determinant


@compiled
def _pivots(cov, least):
    """(c11, c21, c22) of an innovation to (c11, c21 / c11, c22 - c21^2 / c11), the last of them least^2 or more."""
    slope = cov[1] / cov[0]
    cov[2] = max(cov[2] - slope * cov[1], least * least)
    cov[1] = slope


@compiled
def _expect(setup, pose, root, noise, component, spread, matrix, by_e, own, wide):
    """Range and bearing of a component; by_e (2, 3): their derivatives by e; own, wide (3,): pivots of the innovation.

    own leaves the pose's part out, wide has what spread (3, 3) still leaves of e in it. matrix (2, 5): scratch.
    """
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    distance, bearing = sight_jacobian(setup, pose[0], pose[1], pose[2], component[X], component[Y], matrix)
    s_r, cross, s_b = noise_root(setup, noise, distance)
    for r in range(2):
        ahead = cosine * matrix[r, 0] + sine * matrix[r, 1]
        left = cosine * matrix[r, 1] - sine * matrix[r, 0]
        for k in range(3):
            by_e[r, k] = ahead * root[0, k] + left * root[1, k] + matrix[r, 2] * root[2, k]
    a0 = matrix[0, 3] * component[L11] + matrix[0, 4] * component[L21]
    a1 = matrix[1, 3] * component[L11] + matrix[1, 4] * component[L21]
    b0, b1 = matrix[0, 4] * component[L22], matrix[1, 4] * component[L22]
    own[0] = a0 * a0 + b0 * b0 + s_r * s_r
    own[1] = a0 * a1 + b0 * b1 + s_r * cross
    own[2] = a1 * a1 + b1 * b1 + cross * cross + s_b * s_b
    for r in range(2):
        for c in range(r + 1):
            total = own[r + c]
            for k in range(3):
                for m in range(3):
                    total += by_e[r, k] * spread[k, m] * by_e[c, m]
            wide[r + c] = total
    _pivots(wide, s_b)
    _pivots(own, s_b)
    return distance, bearing


@compiled
def _pull(nu0, nu1, weight, by_e, own, information, pull):
    """Add what one pair, of that probability, says of e: information (3, 3) and pull (3,)."""
    i11 = 1.0 / own[2]
    i01 = -own[1] * i11
    i00 = 1.0 / own[0] - own[1] * i01
    for k in range(3):
        g0 = by_e[0, k] * i00 + by_e[1, k] * i01
        g1 = by_e[0, k] * i01 + by_e[1, k] * i11
        pull[k] += weight * (g0 * nu0 + g1 * nu1)
        for m in range(3):
            information[k, m] += weight * (g0 * by_e[0, m] + g1 * by_e[1, m])


@compiled
def _accumulate(setup, rules, pose, root, noise, block, active, looks, seen, z, spread, information, pull):
    """Add every pair's information (3, 3) and pull (3,) on e at this pose; spread (3, 3): what e still varies by."""
    matrix, by_e, expected = np.empty((2, 5)), np.empty((seen, 2, 3)), np.empty((seen, 2))
    own, wide, scale = np.empty((seen, 3)), np.empty((seen, 3)), np.empty(seen)
    for j in range(seen):
        component = block[active[j]]
        expected[j, 0], expected[j, 1] = _expect(
            setup, pose, root, noise, component, spread, matrix, by_e[j], own[j], wide[j]
        )
        size = 2.0 * math.pi * math.sqrt(wide[j, 0] * wide[j, 2])
        scale[j] = looks[j, DETECTION] * component[WEIGHT] / size
    share = np.empty(seen)
    for i in range(len(z)):
        whole = rules[CLUTTER]
        for j in range(seen):
            share[j] = 0.0
            nu0, nu1 = z[i, 0] - expected[j, 0], wrap(z[i, 1] - expected[j, 1])
            if nu0 * nu0 > rules[GATE] * wide[j, 0]:
                continue
            across = nu1 - wide[j, 1] * nu0
            squared = nu0 * nu0 / wide[j, 0] + across * across / wide[j, 2]
            if squared < rules[GATE]:
                share[j] = scale[j] * math.exp(-0.5 * squared)
                whole += share[j]
        for j in range(seen):
            if share[j] >= 1e-6 * whole:
                nu0, nu1 = z[i, 0] - expected[j, 0], wrap(z[i, 1] - expected[j, 1])
                _pull(nu0, nu1, share[j] / whole, by_e[j], own[j], information, pull)


@compiled
def propose(setup, rules, profile, beams, pose, root, noise, block, count, z, normal, spread_by, out, left):
    """Sample a pose into `out` (3,); returns ln p(e) / q(e).

    pose (3,): where odometry puts the particle; root (3, 3) as above, lower. normal (3,): standard normal draws,
    multiplied with `spread_by` (1: a sample, 0: the mode). left (3, 3): on return the root of what the sightings
    leave of the pose's covariance, in the world's axes.
    """
    wide_root = np.empty((3, 3))
    world_root(pose[2], root, wide_root)
    active, looks = np.empty(count, np.int64), np.empty((count + 1, LOOK))
    seen = in_view(setup, rules, profile, beams, pose, wide_root, noise, block, count, active, looks)
    heavy = 0
    for j in range(seen):
        if block[active[j], WEIGHT] >= _LEAST_WEIGHT:
            active[heavy] = active[j]
            looks[heavy] = looks[j]
            heavy += 1
    e, here = np.zeros(3), pose.copy()
    information, pull, factor, spread = np.eye(3), np.zeros(3), np.eye(3), np.eye(3)
    log_determinant = 0.0
    if heavy and len(z):
        for _ in range(_ROUNDS):
            information[:, :] = 0.0
            for k in range(3):
                information[k, k], pull[k] = 1.0, -e[k]
            _accumulate(
                setup, rules, here, root, noise, block, active, looks, heavy, z, spread, information, pull
            )
            log_determinant = root_of_inverse(information, factor)
            size = 0.0
            for k in range(3):
                step = 0.0
                for m in range(3):
                    spread[k, m] = 0.0
                    for n in range(max(k, m), 3):
                        spread[k, m] += factor[k, n] * factor[m, n]
                    step += spread[k, m] * pull[m]
                size += step * step
                e[k] += step
            moved(pose, root, e, here)
            if size < _SETTLED * _SETTLED:
                break
    return _sample(pose, root, e, factor, log_determinant, normal, spread_by, out, left)


@compiled
def _sample(pose, root, e, factor, log_determinant, normal, spread_by, out, left):
    """Draw from N(e, factor factor'), factor upper triangular, and say what it weighs."""
    drawn = np.empty(3)
    prior, own = 0.0, 0.0
    for k in range(3):
        drawn[k] = e[k]
        for m in range(k, 3):
            drawn[k] += spread_by * factor[k, m] * normal[m]
        prior += drawn[k] * drawn[k]
        own += normal[k] * normal[k]
    moved(pose, root, drawn, out)
    product = np.zeros((3, 3))
    for r in range(3):
        for c in range(3):
            for k in range(min(r, c) + 1):
                product[r, c] += root[r, k] * factor[k, c]
    world_root(out[2], product, left)
    return -0.5 * prior + 0.5 * spread_by * spread_by * own - 0.5 * log_determinant
