"""A scan cut where its contour is not smooth: beams in order, gaps, and straight runs by least squares."""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.contour_layout import (
    GRAZING,
    MAX_RANGE,
    MIN_RANGE,
    RATIO_RANGE,
    SIGMA_RANGE,
    STEEPEST,
)

_SLACK = 4.5  # standard deviations that noise may add to a gap
_BRIDGED = 2  # beams without a range that a contour may go on across
_BRIDGE = 0.5  # m, least gap that is allowed there
_GRAZING_GAP = 1.0  # m, longest gap on a line seen at a steep angle


@compiled
def order_beams(bearings):
    """Indices of the finite bearings, ascending, of equal ones the first."""
    kept = np.empty(len(bearings), dtype=np.int64)
    count = 0
    rising = True
    for b in range(len(bearings)):
        if math.isfinite(bearings[b]):
            if count > 0 and not bearings[b] > bearings[kept[count - 1]]:
                rising = False
            kept[count] = b
            count += 1
    kept = kept[:count]
    if rising:
        return kept
    kept = kept[np.argsort(bearings[kept], kind="mergesort")]
    distinct = 1
    for k in range(1, count):
        if bearings[kept[k]] > bearings[kept[distinct - 1]]:
            kept[distinct] = kept[k]
            distinct += 1
    return kept[:distinct]


@compiled
def is_range(r, settings):
    return math.isfinite(r) and r > 0.0 and settings[MIN_RANGE] <= r < settings[MAX_RANGE]


@compiled
def range_variance(r, settings):
    """Of a range, m^2, by the sensor's sigmas."""
    return settings[SIGMA_RANGE] ** 2 + (settings[RATIO_RANGE] * r) ** 2


@compiled
def widest_gap(nearest, step, angle):
    """Distance between the ends of neighbouring beams, `step` rad apart, on a wall that makes `angle` rad with them."""
    angle = max(angle, 2.0 * step)
    return nearest * math.sin(step) / math.sin(angle - step)


@compiled
def _on_line(points, a, b, other, slack):
    """Whether point `other` lies within `slack` m of the line through points a and b."""
    dx, dy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
    across = dx * (points[other, 1] - points[a, 1]) - dy * (points[other, 0] - points[a, 0])
    return abs(across) <= slack * math.hypot(dx, dy)


@compiled
def are_linked(k, step, missing, ranges, points, noise, settings):
    """Whether points k and k + 1 (in a closed ring) lie on one contour: the adaptive breakpoint detector of
    Borges & Aldon 2004, and beyond it a wall at a steep angle that two points on either side bear out.

    step: rad between the two beams. missing: beams between them that brought no range back.
    """
    count = len(ranges)
    after = (k + 1) % count
    if missing > _BRIDGED or step >= math.pi / 4.0:
        return False
    gap = math.hypot(points[after, 0] - points[k, 0], points[after, 1] - points[k, 1])
    nearest = min(ranges[k], ranges[after])
    slack = _SLACK * math.sqrt(noise[k] + noise[after])
    if gap <= widest_gap(nearest, step, settings[GRAZING]) + slack:
        return missing == 0 or gap <= max(_BRIDGE, 1.5 * nearest * step) + slack
    before, beyond = (k - 1) % count, (k + 2) % count
    if (
        missing > 0
        or count < 4
        or gap > min(_GRAZING_GAP, widest_gap(nearest, step, settings[STEEPEST])) + slack
    ):
        return False
    for near, end in ((before, k), (beyond, after)):
        aside = math.hypot(points[near, 0] - points[end, 0], points[near, 1] - points[end, 1])
        if not 0.4 * gap <= aside <= 2.5 * gap or not _on_line(points, k, after, near, slack):
            return False
    return True


@compiled
def running_sums(points, noise, rough, sums):
    """sums (n + 1, 6): running weighted sums 1, x, y, xx, xy, yy about the first point."""
    sums[0] = 0.0
    for k in range(len(points)):
        w = 1.0 / (noise[k] + rough)
        x, y = points[k, 0] - points[0, 0], points[k, 1] - points[0, 1]
        sums[k + 1, 0] = sums[k, 0] + w
        sums[k + 1, 1] = sums[k, 1] + w * x
        sums[k + 1, 2] = sums[k, 2] + w * y
        sums[k + 1, 3] = sums[k, 3] + w * x * x
        sums[k + 1, 4] = sums[k, 4] + w * x * y
        sums[k + 1, 5] = sums[k, 5] + w * y * y


@compiled
def line_cost(sums, a, b):
    """Chi-square of the best line through points a to b - 1."""
    if b - a < 3:
        return 0.0
    w = sums[b, 0] - sums[a, 0]
    x, y = (sums[b, 1] - sums[a, 1]) / w, (sums[b, 2] - sums[a, 2]) / w
    xx = sums[b, 3] - sums[a, 3] - w * x * x
    xy = sums[b, 4] - sums[a, 4] - w * x * y
    yy = sums[b, 5] - sums[a, 5] - w * y * y
    return max(0.0, 0.5 * (xx + yy - math.hypot(xx - yy, 2.0 * xy)))


@compiled
def best_split(sums, a, b):
    """Where points a to b - 1 fall best into two lines, of two points at least: the place, and chi-square of both."""
    place, least = -1, math.inf
    for k in range(a + 2, b - 1):
        cost = line_cost(sums, a, k) + line_cost(sums, k, b)
        if cost < least:
            place, least = k, cost
    return place, least


@compiled
def split_runs(sums, a, b, price, cuts):
    """Cut points a to b - 1 in two, again and again, while that saves `price` of chi-square; cuts: starts and end.

    Returns how many of `cuts` are filled: one more than there are runs.
    """
    stack = np.empty((b - a + 2, 2), dtype=np.int64)
    stack[0, 0], stack[0, 1] = a, b
    waiting, filled = 1, 0
    while waiting > 0:
        waiting -= 1
        low, high = stack[waiting, 0], stack[waiting, 1]
        whole = line_cost(sums, low, high)
        if whole > price:
            place, both = best_split(sums, low, high)
            if place > 0 and whole - both > price:
                stack[waiting, 0], stack[waiting, 1] = place, high
                stack[waiting + 1, 0], stack[waiting + 1, 1] = low, place
                waiting += 2
                continue
        cuts[filled] = low
        filled += 1
    cuts[filled] = b
    return filled + 1


@compiled
def mend_runs(sums, price, cuts, filled):
    """Move every cut to where it is best between its neighbours, take out those that do not pay; returns `filled`."""
    for _ in range(3):
        changed = False
        for k in range(1, filled - 1):
            place, _cost = best_split(sums, cuts[k - 1], cuts[k + 1])
            if place > 0 and place != cuts[k]:
                cuts[k] = place
                changed = True
        k = 1
        while k < filled - 1:
            joined = line_cost(sums, cuts[k - 1], cuts[k + 1])
            if joined - line_cost(sums, cuts[k - 1], cuts[k]) - line_cost(sums, cuts[k], cuts[k + 1]) < price:
                for m in range(k, filled - 1):
                    cuts[m] = cuts[m + 1]
                filled -= 1
                changed = True
            else:
                k += 1
        if not changed:
            break
    return filled


@compiled
def straight_runs(sums, linked, price):
    """Starts of the straight runs of a scan's points, and its end: (R + 1,) int64. Runs never cross a missing link.

    sums: of `running_sums`. price: chi-square that a cut must save.
    """
    count = len(linked)
    cuts = np.empty(count + 1, dtype=np.int64)
    own = np.empty(count + 1, dtype=np.int64)
    filled = 0
    a = np.int64(0)  # of a bare 0 numba would compile `split_runs` once more, for that constant
    while a < count:
        b = a + 1
        while b < count and linked[b - 1]:
            b += 1
        held = split_runs(sums, a, b, price, own)
        held = mend_runs(sums, price, own, held)
        for k in range(held - 1):
            cuts[filled] = own[k]
            filled += 1
        a = b
    cuts[filled] = count
    return cuts[: filled + 1]
