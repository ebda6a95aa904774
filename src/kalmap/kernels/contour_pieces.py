"""From a scan to pieces of contour: the one entry, `cut_and_fit`."""

import math

import numpy as np
from numba import njit

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
    ROUGHNESS,
    SIGMA_BEAM,
    SILENT,
    SPLIT_COST,
    VIEW,
)
from kalmap.kernels.contour_shapes import shape_run
from kalmap.kernels.implicit import distance_rows, evaluate, project, signed_distance

_ASIDE = 0.15  # m, most that a point may lie beside a piece to be its continuation
_CLOSED = 2.5  # mean spacings of the beams that the two ends of a full circle may lie apart


@njit(cache=True, nogil=True, error_model="numpy")
def locate_beams(ranges, bearings, order, settings):
    """The beams of `order` that brought a range back: place in `order` (n,), points (n, 2), rays (n, 2), variances
    along and across the beam (n,), all in the robot's frame."""
    count = 0
    place = np.empty(len(order), dtype=np.int64)
    for k in range(len(order)):
        if is_range(ranges[order[k]], settings):
            place[count] = k
            count += 1
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
    return place[:count], points, rays, along, across


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def ring_start(linked, points, along, settings):
    """Where to open a scan of the full circle: after a gap, or else where its straight runs have their first cut."""
    for n in range(len(linked)):
        if not linked[n]:
            return (n + 1) % len(linked)
    sums = np.empty((len(linked) + 1, 6))
    running_sums(points, along, settings[ROUGHNESS] ** 2, sums)
    cuts = straight_runs(sums, linked, settings[SPLIT_COST])
    return cuts[1] % len(linked)


@njit(cache=True, nogil=True, error_model="numpy")
def goes_on(coef, cov, origin, scale, sigma, points, along, across, other):
    """Whether point `other` lies where the piece would go on, three standard deviations allowed but no more than
    `_ASIDE`: a wall whose points have become too far apart to follow."""
    x, y = points[other, 0], points[other, 1]
    away, _gx, _gy = signed_distance(coef, origin[0], origin[1], scale, x, y)
    row = np.empty((1, 10))
    distance_rows(coef, origin[0], origin[1], scale, points[other : other + 1], row)
    variance = sigma * sigma + max(along[other], across[other])
    for i in range(10):
        for j in range(10):
            variance += row[0, i] * cov[i, j] * row[0, j]
    return abs(away) <= min(_ASIDE, 3.0 * math.sqrt(variance))


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def face_sensor(coef, origin, scale, x, y, settings):
    """Turn the signs so that p grows from the curve at (x, y) towards the sensor."""
    _p, a, b = evaluate(coef, (x - origin[0]) / scale, (y - origin[1]) / scale)
    if a * (settings[MOUNT_X] - x) + b * (settings[MOUNT_Y] - y) < 0.0:
        coef *= -1.0


@njit(cache=True, nogil=True, error_model="numpy")
def cut_and_fit(ranges, bearings, settings):
    """Pieces of contour in one scan: ranges (B,) m, bearings (B,) rad, settings as in `contour_layout`.

    Returns coef (K, 10), cov (K, 10, 10), origin (K, 2), scale (K,), order (K,), sigma (K,), first and last beam (K,),
    ends (K, 2, 2), kinds (K, 2), lengths (K,), points (N, 2), piece (N,) and beam (N,) of every point.
    """
    order = order_beams(bearings)
    place, points, rays, along, across = locate_beams(ranges, bearings, order, settings)
    count = len(place)
    full = False
    if len(order) > 2:
        span = bearings[order[-1]] - bearings[order[0]]
        full = 2.0 * math.pi - span <= _CLOSED * span / (len(order) - 1)
    linked = link_beams(ranges, bearings, order, place, points, along, full, settings)
    if full and count > 1:
        start = ring_start(linked, points, along, settings)
        linked, place = np.roll(linked, -start), np.roll(place, -start)
        turned = np.arange(count)
        turned = (turned + start) % count
        points, rays, along, across = points[turned], rays[turned], along[turned], across[turned]
    rough, price, highest = settings[ROUGHNESS] ** 2, settings[SPLIT_COST], int(settings[MAX_ORDER])
    sums = np.empty((count + 1, 6))
    running_sums(points, along, rough, sums)
    cuts = straight_runs(sums, linked, price)
    most = len(cuts) - 1
    coef, cov = np.zeros((most, 10)), np.zeros((most, 10, 10))
    origin, scale, sigma = np.zeros((most, 2)), np.ones(most), np.zeros(most)
    degree, bounds = np.ones(most, dtype=np.int64), np.zeros((most, 2), dtype=np.int64)
    ends, lengths = np.zeros((most, 2, 2)), np.zeros(most)
    piece = np.full(count, -1, dtype=np.int64)
    k, run = 0, 0
    while run < most:
        a = cuts[run]
        if cuts[run + 1] - a < 2:
            run += 1
            continue
        run, degree[k], scale[k], excess = shape_run(
            cuts,
            run,
            sums,
            linked,
            points,
            rays,
            along,
            across,
            rough,
            price,
            highest,
            coef[k],
            cov[k],
            origin[k],
        )
        b = cuts[run]
        lengths[k] = end_points(degree[k], coef[k], origin[k], scale[k], points[a:b], ends[k])
        if b - a < settings[MIN_POINTS] or not lengths[k] >= settings[MIN_LENGTH]:
            continue
        face_sensor(coef[k], origin[k], scale[k], points[(a + b) // 2, 0], points[(a + b) // 2, 1], settings)
        sigma[k] = math.sqrt(max(excess, rough))
        bounds[k, 0], bounds[k, 1] = a, b - 1
        piece[a:b] = k
        k += 1
    kinds = np.zeros((k, 2), dtype=np.int64)
    first, last = np.zeros(k, dtype=np.int64), np.zeros(k, dtype=np.int64)
    for i in range(k):
        for side in range(2):
            n, way = bounds[i, side], 2 * side - 1
            onward = goes_on(
                coef[i], cov[i], origin[i], scale[i], sigma[i], points, along, across, (n + way) % count
            )
            kinds[i, side] = end_kind(n, way, linked, piece, place, ranges, order, full, onward)
        first[i], last[i] = order[place[bounds[i, 0]]], order[place[bounds[i, 1]]]
    return (
        coef[:k],
        cov[:k],
        origin[:k],
        scale[:k],
        degree[:k],
        sigma[:k],
        first,
        last,
        ends[:k],
        kinds,
        lengths[:k],
        points,
        piece,
        order[place],
    )
