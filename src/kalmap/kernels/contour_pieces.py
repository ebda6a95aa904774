"""From a scan to pieces of contour: the one entry, `cut_and_fit`."""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.contour_cut import (
    are_linked,
    is_range,
    order_beams,
    range_variance,
    running_sums,
    straight_runs,
)
from kalmap.kernels.contour_layout import (
    CORNER,
    END,
    HIDDEN,
    MAX_ORDER,
    MIN_LENGTH,
    MIN_POINTS,
    MOUNT_HEADING,
    MOUNT_X,
    MOUNT_Y,
    ONWARD,
    PARAMETER_COST,
    ROUGHNESS,
    SIGMA_BEAM,
    SIGMA_BEND,
    SILENT,
    SPLIT_COST,
    VIEW,
)
from kalmap.kernels.contour_shapes import bend_runs, copy_fit, shape_run
from kalmap.kernels.implicit import evaluate, monomials, project, signed_distance

_ASIDE = 0.15  # m, most that a point may lie beside a piece to be its continuation
_CLOSED = 2.5  # mean spacings of the beams that the two ends of a full circle may lie apart


@compiled
def seen_beams(ranges, order, settings):
    """Places in `order` of the beams that brought a range back."""
    count = 0
    place = np.empty(len(order), dtype=np.int64)
    for k in range(len(order)):
        if is_range(ranges[order[k]], settings):
            place[count] = k
            count += 1
    return place[:count]


@compiled
def locate_beams(ranges, bearings, order, place, settings):
    """Points (n, 2) and rays (n, 2) of the beams at `place` in `order`, and their variances along and across the beam
    (n,), in the robot's frame."""
    count = len(place)
    points, rays = np.empty((count, 2)), np.empty((count, 2))
    along, across = np.empty(count), np.empty(count)
    for n in range(count):
        r = ranges[order[place[n]]]
        angle = bearings[order[place[n]]] + settings[MOUNT_HEADING]
        rays[n, 0], rays[n, 1] = math.cos(angle), math.sin(angle)
        points[n, 0] = settings[MOUNT_X] + r * rays[n, 0]
        points[n, 1] = settings[MOUNT_Y] + r * rays[n, 1]
        along[n] = range_variance(r, settings)
        across[n] = (settings[SIGMA_BEAM] * r) ** 2
    return points, rays, along, across


@compiled
def turned(ring, start):
    """A closed ring (n,) opened before `start`."""
    out = np.empty_like(ring)
    for n in range(len(ring)):
        out[n] = ring[(start + n) % len(ring)]
    return out


@compiled
def link_beams(ranges, bearings, order, place, points, along, full, settings):
    """linked (n,): whether each point and the next one, the first after the last, lie on one contour."""
    count = len(place)
    own = np.empty(count)
    for n in range(count):
        own[n] = ranges[order[place[n]]]
    linked = np.zeros(count, dtype=np.bool_)
    for n in range(count):
        after = (n + 1) % count
        step = bearings[order[place[after]]] - bearings[order[place[n]]]
        missing = place[after] - place[n] - 1
        if after == 0:
            step += 2.0 * math.pi
            missing += len(order)
        if count > 1 and (after > 0 or full):
            linked[n] = are_linked(n, step, missing, own, points, along, settings)
    return linked


@compiled
def ring_start(linked, points, along, settings):
    """Where to open a scan of the full circle: after a gap, or else where its straight runs have their first cut."""
    for n in range(len(linked)):
        if not linked[n]:
            return (n + 1) % len(linked)
    sums = np.empty((len(linked) + 1, 6))
    running_sums(points, along, settings[ROUGHNESS] ** 2, sums)
    cuts = straight_runs(sums, linked, settings[SPLIT_COST])
    return cuts[1] % len(linked)


@compiled
def goes_on(coef, cov, origin, scale, sigma, points, along, across, other):
    """Whether point `other` lies where the piece would go on, three standard deviations allowed but no more than
    `_ASIDE`: a wall whose points have become too far apart to follow."""
    x, y = points[other, 0], points[other, 1]
    away, _gx, _gy = signed_distance(coef, origin[0], origin[1], scale, x, y)
    u, v = (x - origin[0]) / scale, (y - origin[1]) / scale
    _p, by_u, by_v = evaluate(coef, u, v)
    row = np.empty(10)
    monomials(u, v, row)
    own = 0.0
    for i in range(10):
        for j in range(10):
            own += row[i] * cov[i, j] * row[j]
    variance = own * scale * scale / (by_u * by_u + by_v * by_v)
    variance += sigma * sigma + max(along[other], across[other])
    return abs(away) <= min(_ASIDE, 3.0 * math.sqrt(variance))


@compiled
def end_kind(n, side, linked, piece, place, ranges, order, full, onward):
    """How the piece of point n ends there; side: 1 for its last point, -1 for its first. See `contour_layout`.

    onward: whether the point beside it lies on the piece's own curve.
    """
    count = len(place)
    near = n
    for _ in range(3):  # past a point or two of which no piece was made
        other = near + side
        if full:
            other %= count
        if other < 0 or other >= count:
            outside = place[near] + side
            return VIEW if outside < 0 or outside >= len(order) else SILENT
        joined = linked[near] if side > 0 else linked[other]
        if not joined:
            apart = (side * (place[other] - place[near])) % len(order)
            if apart > 1:
                return SILENT
            if near == n and onward:
                return ONWARD
            return HIDDEN if ranges[order[place[other]]] < ranges[order[place[n]]] else END
        if piece[other] >= 0:
            if near == n:
                return CORNER
            step = abs(ranges[order[place[other]]] - ranges[order[place[n]]])
            if step < 0.1:
                return ONWARD
            return HIDDEN if ranges[order[place[other]]] < ranges[order[place[n]]] else END
        near = other
    return ONWARD


@compiled
def end_points(degree, coef, origin, scale, points, ends):
    """Feet of the first and last point: fills ends (2, 2); returns the length along the curve, m."""
    count, total = len(points), 0.0
    stride = count - 1 if degree == 1 else 1
    x, y = 0.0, 0.0
    for n in range(0, count, stride):
        nx, ny = project(coef, origin[0], origin[1], scale, points[n, 0], points[n, 1])
        if n == 0:
            ends[0, 0], ends[0, 1] = nx, ny
        else:
            total += math.hypot(nx - x, ny - y)
        x, y = nx, ny
    ends[1, 0], ends[1, 1] = x, y
    return total


@compiled
def face_sensor(coef, origin, scale, x, y, settings):
    """Turn the signs so that p grows from the curve at (x, y) towards the sensor."""
    _p, a, b = evaluate(coef, (x - origin[0]) / scale, (y - origin[1]) / scale)
    if a * (settings[MOUNT_X] - x) + b * (settings[MOUNT_Y] - y) < 0.0:
        for i in range(len(coef)):
            coef[i] = -coef[i]


@compiled
def fit_runs(linked, points, rays, along, across, settings, coef, cov, origin, shape, bounds, ends, piece):
    """Cut the points into straight runs and make pieces of them: fills the rows of coef (n, 10), cov (n, 10, 10),
    origin (n, 2), shape (n, 4: scale, order, sigma, length), bounds (n, 2: first and last point), ends (n, 2, 2), and
    piece (N,). Returns how many rows."""
    rough, price, highest = settings[ROUGHNESS] ** 2, settings[SPLIT_COST], int(settings[MAX_ORDER])
    sums = np.empty((len(points) + 1, 6))
    running_sums(points, along, rough, sums)
    cuts = straight_runs(sums, linked, price)
    runs = len(cuts) - 1
    bent, spread, place, plain = (
        np.empty((runs, 10)),
        np.empty((runs, 10, 10)),
        np.empty((runs, 2)),
        np.empty((runs, 3)),
    )
    sigma_bend = settings[SIGMA_BEND] if highest > 1 else 0.0
    bend_runs(cuts, points, rays, along, across, rough, sigma_bend, bent, spread, place, plain)
    k, run = 0, np.int64(0)  # of a bare 0 numba would compile `shape_run` once more, for that constant
    while run < runs:
        a, first = cuts[run], run
        if cuts[run + 1] - a < 2:
            run += 1
            continue
        run, degree, scale, excess = shape_run(
            cuts,
            run,
            sums,
            linked,
            points,
            rays,
            along,
            across,
            rough,
            settings[PARAMETER_COST],
            highest,
            plain[:, 1],
            coef[k],
            cov[k],
            origin[k],
        )
        if degree == 1:
            scale, excess = plain[first, 0], plain[first, 2]
            copy_fit(bent[first], spread[first], place[first], coef[k], cov[k], origin[k])
        b = cuts[run]
        length = end_points(degree, coef[k], origin[k], scale, points[a:b], ends[k])
        if b - a < settings[MIN_POINTS] or not length >= settings[MIN_LENGTH]:
            continue
        middle = (a + b) // 2
        face_sensor(coef[k], origin[k], scale, points[middle, 0], points[middle, 1], settings)
        shape[k, 0], shape[k, 1], shape[k, 2] = scale, degree, math.sqrt(max(excess, rough))
        shape[k, 3] = length
        bounds[k, 0], bounds[k, 1] = a, b - 1
        for n in range(a, b):
            piece[n] = k
        k += 1
    return k


@compiled
def is_full_circle(bearings, order):
    """Whether the first beam follows the last one as beams follow one another."""
    if len(order) < 3:
        return False
    span = bearings[order[len(order) - 1]] - bearings[order[0]]
    return 2.0 * math.pi - span <= _CLOSED * span / (len(order) - 1)


@compiled
def cut_and_fit(ranges, bearings, settings):
    """Pieces of contour in one scan: ranges (B,) m, bearings (B,) rad, settings as in `contour_layout`.

    Returns coef (K, 10), cov (K, 10, 10), origin (K, 2), scale (K,), order (K,), sigma (K,), first and last beam (K,),
    ends (K, 2, 2), kinds (K, 2), lengths (K,), points (N, 2), piece (N,) and beam (N,) of every point.
    """
    order = order_beams(bearings)
    place = seen_beams(ranges, order, settings)
    points, rays, along, across = locate_beams(ranges, bearings, order, place, settings)
    count, full = len(place), is_full_circle(bearings, order)
    linked = link_beams(ranges, bearings, order, place, points, along, full, settings)
    if full and count > 1:
        start = ring_start(linked, points, along, settings)
        linked, place = turned(linked, start), turned(place, start)
        points, rays, along, across = locate_beams(ranges, bearings, order, place, settings)
    most = count // 2
    coef, cov, origin = np.empty((most, 10)), np.empty((most, 10, 10)), np.empty((most, 2))
    shape, ends = np.empty((most, 4)), np.empty((most, 2, 2))
    bounds, piece = np.empty((most, 2), dtype=np.int64), np.full(count, -1, dtype=np.int64)
    found = fit_runs(
        linked, points, rays, along, across, settings, coef, cov, origin, shape, bounds, ends, piece
    )
    scale, sigma, lengths = shape[:found, 0].copy(), shape[:found, 2].copy(), shape[:found, 3].copy()
    kinds, beams = np.empty((found, 2), dtype=np.int64), np.empty((2, found), dtype=np.int64)
    degree, beam = np.empty(found, dtype=np.int64), np.empty(count, dtype=np.int64)
    for n in range(count):
        beam[n] = order[place[n]]
    for k in range(found):
        degree[k] = int(shape[k, 1])
        for side in range(2):
            n, way = bounds[k, side], 2 * side - 1
            other = (n + way) % count
            onward = goes_on(coef[k], cov[k], origin[k], scale[k], sigma[k], points, along, across, other)
            kinds[k, side] = end_kind(n, way, linked, piece, place, ranges, order, full, onward)
            beams[side, k] = beam[n]
    fits = coef[:found].copy(), cov[:found].copy(), origin[:found].copy()
    return fits + (
        (scale, degree, sigma, beams[0], beams[1], ends[:found].copy(), kinds, lengths, points, piece, beam)
    )
