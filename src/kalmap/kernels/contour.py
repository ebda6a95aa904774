"""Sampled environment maps: which samples a scan shows on which piece of contour, and the update that follows.

The state is a pose and N samples, points on the contours of obstacles. A sample seen on a piece of the scan is
measured by its signed orthogonal distance from the piece's curve, in the robot's frame, with the measured value 0
(equations (3), (4) and (9) to (11) of Sun et al. 2010): scalars, several hundred a scan, applied as one block.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.contour_state import calibration_effect
from kalmap.kernels.implicit import project, signed_distance
from kalmap.kernels.layout import INVARIANT, JACOBIAN, NOT_POSITIVE, OK, RULE
from kalmap.kernels.regression import left_jacobian, regress, square_root, weights
from kalmap.kernels.sensing import sighting_block, to_twist

HIDDEN = -1  # out of view, or something stands before it
OPEN = -2  # the scanner looks through where the sample is
ASIDE = -3  # in view, but on no piece: between pieces, or too far from one


@compiled
def _nearest_beam(bearings, bearing):
    """The beam that points there, -1 if none does within a spacing, as they are on average. bearings ascend."""
    count = len(bearings)
    if count == 1:
        return 0 if bearings[0] == bearing else -1
    near = (bearings[count - 1] - bearings[0]) / (count - 1) * (1.0 + 1e-9)
    after = min(np.searchsorted(bearings, bearing), count - 1)
    before = max(after - 1, 0)
    beam = after if abs(bearings[after] - bearing) < abs(bearing - bearings[before]) else before
    return beam if abs(bearings[beam] - bearing) <= near else -1


@compiled
def _beyond(ranges, beam, r, margin):
    """Whether the beam and both its neighbours measured farther than r by the margin: +1; nearer: -1; else 0."""
    farther, nearer = 0, 0
    first, last = max(0, beam - 1), min(len(ranges) - 1, beam + 1)
    for b in range(first, last + 1):
        farther += ranges[b] > r + margin
        nearer += ranges[b] < r - margin
    if farther == last - first + 1:
        return 1
    return -1 if nearer == last - first + 1 else 0


@compiled
def _nearest_piece(beam, piece_of_beam, coef, origin, scale, limit, x, y, nx, ny, gradient):
    """Of the pieces under the beam and its neighbours the one nearest to (x, y) that faces the same way, within limit.

    Returns its number, or HIDDEN, and the signed distance from it; writes its gradient (2,).
    """
    best, last, found, distance = limit, -1, HIDDEN, 0.0
    for b in range(max(0, beam - 1), min(len(piece_of_beam), beam + 2)):
        k = piece_of_beam[b]
        if k < 0 or k == last:
            continue
        last = k
        value, gx, gy = signed_distance(coef[k], origin[k, 0], origin[k, 1], scale[k], x, y)
        if abs(value) < best and gx * nx + gy * ny > 0.7:
            best, found, distance = abs(value), k, value
            gradient[0], gradient[1] = gx, gy
    return found, distance


@compiled
def look(
    pose,
    samples,
    normals,
    mount,
    bearings,
    ranges,
    piece_of_beam,
    coef,
    origin,
    scale,
    reach,
    limit,
    found,
    g,
    gradient,
):
    """What the scan says about every sample, with the robot at `pose`.

    samples, normals: (N, 2) in the map. mount: (3,) the scanner on the robot. bearings: (B,) ascending, in the
    scanner's frame; ranges: (B,), +inf where nothing came back; piece_of_beam: (B,) or -1; coef (K, 10), origin (K, 2),
    scale (K,): the pieces' curves in the robot's frame. reach: (2,) m, how far the scanner sees, and up to where its
    silence says that nothing is there. limit: m, greatest distance from a curve. Writes for every sample: found (N,)
    its piece, or HIDDEN, OPEN, ASIDE; g (N,) m its signed distance; gradient (N, 2) of the distance in the robot's
    frame. Returns how many were found.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    cm, sm = math.cos(mount[2]), math.sin(mount[2])
    count = 0
    for i in range(len(samples)):
        found[i] = HIDDEN
        dx, dy = samples[i, 0] - pose[0], samples[i, 1] - pose[1]
        x, y = c * dx + s * dy, -s * dx + c * dy
        lx, ly = x - mount[0], y - mount[1]
        lx, ly = cm * lx + sm * ly, -sm * lx + cm * ly
        r = math.hypot(lx, ly)
        if r < 1e-3 or r > reach[0] + limit:
            continue
        nx, ny = c * normals[i, 0] + s * normals[i, 1], -s * normals[i, 0] + c * normals[i, 1]
        if nx * (mount[0] - x) + ny * (mount[1] - y) < 0.05 * r:
            continue  # its face is turned away
        beam = _nearest_beam(bearings, math.atan2(ly, lx))
        if beam < 0:
            continue
        found[i], g[i] = _nearest_piece(
            beam, piece_of_beam, coef, origin, scale, limit, x, y, nx, ny, gradient[i]
        )
        if found[i] >= 0:
            count += 1
            continue
        beyond = _beyond(ranges, beam, r, limit)
        if beyond == 0:
            found[i] = ASIDE
        elif beyond > 0 and (r < reach[1] or math.isfinite(ranges[beam])):
            found[i] = OPEN
    return count


@compiled
def _normal_equations(pose, start, prior, samples, sigma, found, g, gradient, normal, right):
    """Write normal (3, 3) and right (3,) of the next step of `fit_pose`; returns the sum of squared distances, m^2."""
    normal[:] = prior
    for i in range(3):
        right[i] = 0.0
        for j in range(3):
            right[i] -= prior[i, j] * (pose[j] - start[j])
    c, s = math.cos(pose[2]), math.sin(pose[2])
    row, squares = np.empty(3), 0.0
    for i in range(len(samples)):
        if found[i] < 0:
            continue
        gx, gy = gradient[i, 0], gradient[i, 1]
        wx, wy = c * gx - s * gy, s * gx + c * gy
        row[0], row[1] = -wx, -wy
        row[2] = wx * (samples[i, 1] - pose[1]) - wy * (samples[i, 0] - pose[0])
        variance = sigma[found[i]] ** 2 + 1e-4
        weight = 1.0 / (variance * (1.0 + g[i] * g[i] / (9.0 * variance)))
        squares += g[i] * g[i]
        for p in range(3):
            right[p] -= weight * row[p] * g[i]
            for q in range(3):
                normal[p, q] += weight * row[p] * row[q]
    return squares


@compiled
def fit_pose(
    pose,
    information,
    samples,
    normals,
    mount,
    bearings,
    ranges,
    piece_of_beam,
    coef,
    origin,
    scale,
    sigma,
    reach,
    limits,
    rounds,
    found,
    g,
    gradient,
):
    """Move `pose` to where the scan fits the samples best, the samples held. Returns (found, mean squared distance).

    information: (3, 3), in the map's axes, of the pose that was handed in: the prior; on return that of the fit.
    limits: (2,) m, the greatest distance from a curve in the first and in the last round. sigma: (K,) m of the pieces.
    reach: see `look`.
    Gauss-Newton on the signed distances with Cauchy's weights; found, g and gradient are those of the last round.
    """
    prior, start = information.copy(), pose.copy()
    normal, right = np.empty((3, 3)), np.empty(3)
    matched, squares = 0, 0.0
    for turn in range(rounds):
        limit = max(limits[1], limits[0] * 0.5**turn)
        matched = look(
            pose,
            samples,
            normals,
            mount,
            bearings,
            ranges,
            piece_of_beam,
            coef,
            origin,
            scale,
            reach,
            limit,
            found,
            g,
            gradient,
        )
        squares = _normal_equations(pose, start, prior, samples, sigma, found, g, gradient, normal, right)
        step = np.linalg.solve(normal, right)
        pose[0] += step[0]
        pose[1] += step[1]
        pose[2] += step[2]
        if turn > 2 and abs(step[0]) + abs(step[1]) < 1e-4 and abs(step[2]) < 1e-5 and limit <= limits[1]:
            break
    information[:] = normal
    return matched, squares / max(1, matched)


@compiled
def _distance_at(setup, pose, sample, deviation, coef, ox, oy, scale):
    """The signed distance with (pose, sample) deviated; in invariant coordinates by a twist about the robot."""
    turn = pose[2]
    if setup[INVARIANT] == 0.0:
        turn += deviation[2]
        dx, dy = (
            sample[0] + deviation[3] - pose[0] - deviation[0],
            sample[1] + deviation[4] - pose[1] - deviation[1],
        )
    else:  # seen from the robot, only V' (xi_sample - xi_position) is left of the twist
        s, v = left_jacobian(deviation[2])
        ux, uy = deviation[3] - deviation[0], deviation[4] - deviation[1]
        dx, dy = sample[0] + s * ux + v * uy - pose[0], sample[1] - v * ux + s * uy - pose[1]
    cosine, sine = math.cos(turn), math.sin(turn)
    return signed_distance(coef, ox, oy, scale, cosine * dx + sine * dy, cosine * dy - sine * dx)[0]


@compiled
def regress_distances(
    setup, mean, packed, mount, indices, piece, coef, origin, scale, matrices, distances, residuals
):
    """Regress the signed distances of M samples on their (pose, sample) blocks, all at the same prior.

    The scanner's calibration, columns 3 and 4, is small and near linear: its derivatives are taken at the mean.
    mount: (3,) the scanner on the robot. indices: (M,) where the samples begin; piece: (M,) the curve of each. Writes
    matrices (M, 7) on the additive errors, distances (M,) m as they are to be expected, residuals (M,) m^2: what the
    regression leaves. Returns a status code.
    """
    cov, root = np.empty((5, 5)), np.empty((5, 5))
    points, deviation = np.empty((2, 5, 1)), np.empty(5)
    offset, matrix, residual = np.empty(1), np.empty((1, 5)), np.empty((1, 1))
    place, slope, effect = np.empty((1, 2)), np.empty((1, 2)), np.empty((1, 2))
    spread = weights(setup, 5)[0] if int(setup[RULE]) != JACOBIAN else 0.0
    invariant = setup[INVARIANT] != 0.0
    cosine, sine = math.cos(mean[2]), math.sin(mean[2])
    for m in range(len(indices)):
        k, sample = piece[m], mean[indices[m] : indices[m] + 2]
        ox, oy = origin[k, 0], origin[k, 1]
        dx, dy = sample[0] - mean[0], sample[1] - mean[1]
        place[0, 0], place[0, 1] = cosine * dx + sine * dy, cosine * dy - sine * dx
        value, gx, gy = signed_distance(coef[k], ox, oy, scale[k], place[0, 0], place[0, 1])
        slope[0, 0], slope[0, 1] = gx, gy
        calibration_effect(place, slope, mount, effect)
        matrices[m, 3], matrices[m, 4] = -effect[0, 0], -effect[0, 1]
        if int(setup[RULE]) == JACOBIAN:
            wx, wy = cosine * gx - sine * gy, sine * gx + cosine * gy
            matrices[m, 0], matrices[m, 1], matrices[m, 2] = -wx, -wy, wx * dy - wy * dx
            matrices[m, 5], matrices[m, 6] = wx, wy
            distances[m], residuals[m] = value, 0.0
            continue
        sighting_block(packed, indices[m], cov)
        if invariant:
            to_twist(cov, dx, dy)
        if not square_root(cov, 5, root):
            return NOT_POSITIVE
        for i in range(5):
            for sign in range(2):
                for q in range(5):
                    deviation[q] = spread * root[q, i] if sign == 0 else -spread * root[q, i]
                points[sign, i, 0] = (
                    _distance_at(setup, mean, sample, deviation, coef[k], ox, oy, scale[k]) - value
                )
        regress(setup, points[0], points[1], 5, 1, root, offset, matrix, residual, 0)
        if invariant:
            matrix[0, 2] += dy * matrix[0, 3] - dx * matrix[0, 4]
        matrices[m, :3], matrices[m, 5:] = matrix[0, :3], matrix[0, 3:]
        distances[m], residuals[m] = value + offset[0], residual[0, 0]
    return OK


@compiled
def uncovered(
    pose,
    hits,
    piece_of_hit,
    mount,
    steepest,
    coef,
    origin,
    scale,
    spacing,
    samples,
    normals,
    new,
    normal,
    piece,
):
    """Where the scan shows contour that no sample stands for: points on the pieces' curves, in the robot's frame.

    hits: (H, 2) m in the robot's frame, in the order of the beams. mount: (3,) the scanner on the robot. steepest: sine
    of the least angle between a beam and the contour. spacing: (K,) m, of each piece. Writes new (H, 2), normal (H, 2)
    and piece (H,) and returns how many. A point counts as covered within 0.75 spacings of a sample that
    faces the same way; where neighbouring beams are farther apart than two spacings nothing is known between them.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    count = 0
    for h in range(len(hits)):
        k = piece_of_hit[h]
        if k < 0:
            continue
        x, y = project(coef[k], origin[k, 0], origin[k, 1], scale[k], hits[h, 0], hits[h, 1])
        value, gx, gy = signed_distance(coef[k], origin[k, 0], origin[k, 1], scale[k], x, y)
        if not abs(value) < 1e-3 or math.hypot(x - hits[h, 0], y - hits[h, 1]) > 0.2:
            continue  # no foot on the curve
        away = math.hypot(mount[0] - x, mount[1] - y)
        if gx * (mount[0] - x) + gy * (mount[1] - y) < steepest * away * math.hypot(gx, gy):
            continue
        near = (0.75 * spacing[k]) ** 2
        mx, my = pose[0] + c * x - s * y, pose[1] + s * x + c * y
        nx, ny = c * gx - s * gy, s * gx + c * gy
        covered = False
        for i in range(len(samples)):
            dx, dy = samples[i, 0] - mx, samples[i, 1] - my
            if dx * dx + dy * dy < near and nx * normals[i, 0] + ny * normals[i, 1] > 0.5:
                covered = True
                break
        for i in range(count):
            if covered:
                break
            dx, dy = new[i, 0] - x, new[i, 1] - y
            covered = dx * dx + dy * dy < near and gx * normal[i, 0] + gy * normal[i, 1] > 0.5
        wide = 2.0 * spacing[k]
        alone = True
        for other in (h - 1, h + 1):
            if 0 <= other < len(hits) and piece_of_hit[other] == k:
                alone &= math.hypot(hits[other, 0] - hits[h, 0], hits[other, 1] - hits[h, 1]) > wide
        if covered or alone:
            continue
        new[count, 0], new[count, 1] = x, y
        size = math.hypot(gx, gy)
        normal[count, 0], normal[count, 1] = gx / size, gy / size
        piece[count] = k
        count += 1
    return count
