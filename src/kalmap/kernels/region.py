"""Landmarks in a neighbourhood, through cells of a grid: the cost does not grow with the map."""

import math

import numpy as np

from kalmap.kernels.compiled import compiled

_SHIFT = 1 << 31  # cells are numbered x first, so that a column's cells stand together


@compiled
def cell_key(x, y, cell):
    """The number of the cell that holds (x, y) m; cells are `cell` m wide and sorted by x, then y."""
    return np.int64(math.floor(x / cell)) * (2 * _SHIFT) + np.int64(math.floor(y / cell)) + _SHIFT


@compiled
def cell_keys(mean, robot, count, cell, out):
    """out (count,): the cell of every landmark."""
    for j in range(count):
        out[j] = cell_key(mean[robot + 2 * j], mean[robot + 2 * j + 1], cell)


@compiled
def _inside(mean, at, x, y, cosine, sine, reach, front):
    dx, dy = mean[at] - x, mean[at + 1] - y
    return dx * dx + dy * dy < reach * reach and dx * cosine + dy * sine > front


@compiled
def landmarks_within(mean, robot, count, keys, order, sensor, reach, front, cell, slack):
    """Indices, ascending, of the landmarks nearer than `reach` m and ahead of the front line.

    Equation (10) of Zhou, Zhao & Zhang 2010: |l - s| < reach and (l - s) . (cos, sin) > front.
    keys: (S,) sorted cells of the first S landmarks when they were filed, order: (S,) which landmark each is; those
    from S on are looked at one by one. slack: m that landmarks may have moved since.
    """
    x, y, heading = sensor
    cosine, sine = math.cos(heading), math.sin(heading)
    filed = len(keys)
    found = np.empty(count, dtype=np.int64)
    n = 0
    low_x, high_x = np.floor((x - reach - slack) / cell), np.floor((x + reach + slack) / cell)
    low_y, high_y = np.floor((y - reach - slack) / cell), np.floor((y + reach + slack) / cell)
    if not (high_x - low_x) <= filed:  # a reach beyond all bounds: every landmark is looked at
        for j in range(filed):
            if _inside(mean, robot + 2 * j, x, y, cosine, sine, reach, front):
                found[n] = j
                n += 1
    else:
        for column in range(int(low_x), int(high_x) + 1):
            base = np.int64(column) * (2 * _SHIFT) + _SHIFT
            last = base + np.int64(high_y)
            at = np.searchsorted(keys, base + np.int64(low_y))
            while at < filed and keys[at] <= last:
                j = order[at]
                if _inside(mean, robot + 2 * j, x, y, cosine, sine, reach, front):
                    found[n] = j
                    n += 1
                at += 1
    for j in range(filed, count):
        if _inside(mean, robot + 2 * j, x, y, cosine, sine, reach, front):
            found[n] = j
            n += 1
    return np.sort(found[:n])


@compiled
def tally_by_range(ranges, seen, expected, reach, counts):
    """Add to counts (B, 2), for each of B bins of the range up to `reach` m, how many were seen of those expected."""
    bins = len(counts)
    for k in range(len(ranges)):
        if expected[k]:
            place = min(bins - 1, int(bins * ranges[k] / reach))
            counts[place, 0] += seen[k]
            counts[place, 1] += 1.0


@compiled
def in_sector(z, least, reach, half, out):
    """out (C,) bool: `least` to `reach` m away and less than `half` rad to either side; z: (C, 2) range, bearing."""
    for c in range(len(z)):
        out[c] = least <= z[c, 0] < reach and (half >= math.pi or abs(z[c, 1]) < half)


@compiled
def near_pairs(points, radius):
    """Places (P,), (P,) of the pairs i < j of points (K, 2) nearer to each other than `radius` m."""
    count = len(points)
    first, second = np.empty(count * count, dtype=np.int64), np.empty(count * count, dtype=np.int64)
    found = 0
    for i in range(count):
        for j in range(i + 1, count):
            dx, dy = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]
            if dx * dx + dy * dy < radius * radius:
                first[found], second[found] = i, j
                found += 1
    return first[:found], second[:found]


@compiled
def contested_by(squared, fate, undecided, gate, out):
    """out (C,) bool: an undecided sighting lies inside the candidate's gate, so that it may have been seen.

    squared: (M, C). fate: (M,). undecided: fates from this number on.
    """
    for c in range(squared.shape[1]):
        out[c] = False
    for m in range(squared.shape[0]):
        if fate[m] >= undecided:
            for c in range(squared.shape[1]):
                if squared[m, c] < gate:
                    out[c] = True
