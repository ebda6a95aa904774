"""Round things that stand free in one laser scan: clusters of returns, tests on them, and a circle through each.

A cluster is a run low <= h < high of the hits; `hits` (R,) are the indices of the beams with a return, ascending.
A circle is three numbers: range to its centre m, bearing of its centre rad, radius m. Angles from one beam to the
next are taken where the cluster is, so beams need not be evenly spaced.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled

# Where each number stands in `settings`; what they mean is told in `kalmap.perception.trees`.
MIN_RANGE = 0
MAX_RANGE = 1
MIN_DIAMETER = 2
MAX_DIAMETER = 3
CLEARANCE = 4
SIGMA_RANGE = 5
MAX_MISFIT = 6

_ROUNDS = 20  # of Gauss-Newton at most; all but one in a thousand real trunks move by less than 1 cm after it
_SETTLED = 1e-9  # m and rad
_MEAN_CHORD = (
    math.pi / 4
)  # mean of sqrt(1 - u^2), -1 < u < 1: how far before its centre, in radii, a trunk is met
_UNIFORM = 1.0 / math.sqrt(12.0)  # standard deviation of a uniform number, over its interval


@compiled
def first_bad_bearing(bearings):
    """Index of the first bearing that is not finite or not above the one before; -1 if there is none."""
    for k in range(len(bearings)):
        if not math.isfinite(bearings[k]) or (k > 0 and bearings[k] <= bearings[k - 1]):
            return k
    return -1


@compiled
def returns(ranges, max_range):
    """Indices of the beams whose range is above zero and below `max_range`."""
    hits = np.empty(len(ranges), dtype=np.int64)
    count = 0
    for k in range(len(ranges)):
        if 0.0 < ranges[k] < max_range:  # false for NaN
            hits[count] = k
            count += 1
    return hits[:count]


@compiled
def group(ranges, hits, max_step):
    """Where each cluster begins among the hits, and at the end len(hits): (C + 1,).

    Two hits belong together if at most one beam without a return lies between them and their ranges differ by no
    more than `max_step` m.
    """
    first = np.empty(len(hits) + 1, dtype=np.int64)
    clusters = 0
    for h in range(len(hits)):
        if h == 0 or hits[h] - hits[h - 1] > 2 or abs(ranges[hits[h]] - ranges[hits[h - 1]]) > max_step:
            first[clusters] = h
            clusters += 1
    first[clusters] = len(hits)
    return first[: clusters + 1]


@compiled
def cut_off(ranges, hits, low, high):
    """Whether an edge of the cluster is not its own: the scan ends there, or the next beam meets something nearer."""
    right, left = hits[low], hits[high - 1]
    if right == 0 or left == len(ranges) - 1:
        return True
    if low > 0 and hits[low - 1] == right - 1 and ranges[right - 1] < ranges[right]:
        return True
    return high < len(hits) and hits[high] == left + 1 and ranges[left + 1] < ranges[left]


@compiled
def crowded(ranges, bearings, hits, low, high, clearance):
    """Whether a return beside the cluster lies nearer than `clearance` m to the cluster's last return on that side."""
    for direction in (-1, 1):
        end = hits[low] if direction < 0 else hits[high - 1]
        distance = ranges[end]
        h = low - 1 if direction < 0 else high
        while 0 <= h < len(hits):
            turn = abs(bearings[hits[h]] - bearings[end])
            if turn >= math.pi / 2 or distance * math.sin(turn) >= clearance:
                break
            along, across = ranges[hits[h]] - distance * math.cos(turn), distance * math.sin(turn)
            if along * along + across * across < clearance * clearance:
                return True
            h += direction
    return False


@compiled
def edges(bearings, right, left):
    """Bearings of a cluster's right and left edge, half-way to the beams outside, and what one beam covers, rad."""
    below = bearings[right] - bearings[right - 1]
    above = bearings[left + 1] - bearings[left]
    return bearings[right] - 0.5 * below, bearings[left] + 0.5 * above, 0.5 * (below + above)


@compiled
def mean_range(ranges, hits, low, high):
    """Mean range of a cluster's returns, m."""
    total = 0.0
    for h in range(low, high):
        total += ranges[hits[h]]
    return total / (high - low)


@compiled
def trunk_sized(ranges, bearings, hits, low, high, settings):
    """Whether a trunk of an allowed diameter may have caught these beams and no more.

    A thing of width w is hit by n beams, b rad from one to the next, at the range r if (n - 1) b r < w < (n + 1) b r.
    That interval has to reach into the allowed diameters. A single beam tells of no width at all but this upper bound;
    so it counts only where the bound itself is a trunk.
    """
    right_edge, left_edge, beam = edges(bearings, hits[low], hits[high - 1])
    distance, width = mean_range(ranges, hits, low, high), left_edge - right_edge
    if distance < settings[MIN_RANGE] or width >= math.pi / 2:
        return False
    least, most = distance * (width - beam), distance * (width + beam)
    if high - low == 1 and most > settings[MAX_DIAMETER]:
        return False
    return least <= settings[MAX_DIAMETER] and most >= settings[MIN_DIAMETER]


@compiled
def circle_from_width(distance, right_edge, left_edge, circle):
    """The circle between two tangents whose surface is met `distance` m away by beams anywhere across it.

    Beams that meet a trunk of radius a at random do so pi/4 a before its centre on average. circle: (3,), filled.
    """
    sine = math.sin(0.5 * (left_edge - right_edge))
    radius = distance * sine / (1.0 - _MEAN_CHORD * sine)
    circle[0], circle[1], circle[2] = distance + _MEAN_CHORD * radius, 0.5 * (right_edge + left_edge), radius


@compiled
def solve3(a, b):
    """Solve a x = b for positive definite a (3, 3); x replaces b (3,), a is lost. Returns False if it fails."""
    for i in range(3):
        if not a[i, i] > 0.0:
            return False
        for j in range(i + 1, 3):
            factor = a[j, i] / a[i, i]
            for k in range(i, 3):
                a[j, k] -= factor * a[i, k]
            b[j] -= factor * b[i]
    for i in range(2, -1, -1):
        for k in range(i + 1, 3):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
    return True


@compiled
def add_residual(residual, row, sigma, normal, right_side):
    """Add one residual with its derivative `row` (3,) to the normal equations. Returns its square over sigma's."""
    for i in range(3):
        for j in range(3):
            normal[i, j] += row[i] * row[j] / sigma**2
        right_side[i] -= row[i] * residual / sigma**2
    return (residual / sigma) ** 2


@compiled
def normal_equations(ranges, bearings, hits, low, high, sigma_range, circle, normal, right_side):
    """Normal equations (3, 3), (3,) of the circle's corrections, and chi-square at the circle as it is.

    Residuals: the distance of every return from the circle; and of each of its two tangents from the cluster's edge,
    which lies anywhere between the last beam on the trunk and the first beside it.
    """
    centre, bearing, radius = circle[0], circle[1], circle[2]
    row = np.empty(3)
    normal[:, :] = 0.0
    right_side[:] = 0.0
    chi2 = 0.0
    for h in range(low, high):
        r, turn = ranges[hits[h]], bearings[hits[h]] - bearing
        along, across = centre - r * math.cos(turn), r * math.sin(turn)
        distance = math.hypot(along, across)
        row[0], row[1], row[2] = along / distance, -centre * across / distance, -1.0
        chi2 += add_residual(distance - radius, row, sigma_range, normal, right_side)
    right_edge, left_edge, beam = edges(bearings, hits[low], hits[high - 1])
    half, tangent = math.asin(radius / centre), math.sqrt(centre * centre - radius * radius)
    for sign, edge in ((-1.0, right_edge), (1.0, left_edge)):
        row[0], row[1], row[2] = -sign * radius / (centre * tangent), 1.0, sign / tangent
        chi2 += add_residual(bearing + sign * half - edge, row, _UNIFORM * beam, normal, right_side)
    return chi2


@compiled
def fit_circle(ranges, bearings, hits, low, high, sigma_range, circle):
    """Least squares of a circle through two or more returns. Returns chi-square per degree of freedom, inf if it fails.

    circle: (3,), the start, replaced by the fit. n returns and two edges determine three numbers: n - 1 degrees.
    """
    normal, step = np.empty((3, 3)), np.empty(3)
    chi2 = math.inf
    for _ in range(_ROUNDS):
        if not 0.0 < circle[2] < circle[0]:
            return math.inf
        chi2 = normal_equations(ranges, bearings, hits, low, high, sigma_range, circle, normal, step)
        if not solve3(normal, step):
            return math.inf
        for i in range(3):
            circle[i] += step[i]
        if abs(step[0]) + abs(step[1]) + abs(step[2]) < _SETTLED:
            break
    return chi2 / (high - low - 1) if 0.0 < circle[2] < circle[0] else math.inf


@compiled
def find_trunks(ranges, bearings, settings):
    """Trunks of a scan (B,), (B,) from right to left: (M, 4) range and bearing of the centre, diameter, beams.

    bearings: finite, ascending. settings: (7,), see above.
    """
    hits = returns(ranges, settings[MAX_RANGE])
    first = group(ranges, hits, 0.5 * settings[MAX_DIAMETER])
    out, circle = np.empty((len(first) - 1, 4)), np.empty(3)
    found = 0
    for c in range(len(first) - 1):
        low, high = first[c], first[c + 1]
        if cut_off(ranges, hits, low, high):
            continue
        if not trunk_sized(ranges, bearings, hits, low, high, settings):
            continue
        if crowded(ranges, bearings, hits, low, high, settings[CLEARANCE]):
            continue
        right_edge, left_edge, beam = edges(bearings, hits[low], hits[high - 1])
        circle_from_width(mean_range(ranges, hits, low, high), right_edge, left_edge, circle)
        if high - low > 1:
            misfit = fit_circle(ranges, bearings, hits, low, high, settings[SIGMA_RANGE], circle)
            if (
                not misfit <= settings[MAX_MISFIT]
                or 2.0 * circle[2] - beam * circle[0] > settings[MAX_DIAMETER]
            ):
                continue
        out[found, 0], out[found, 1], out[found, 2] = circle[0], circle[1], 2.0 * circle[2]
        out[found, 3] = high - low
        found += 1
    return out[:found].copy()
