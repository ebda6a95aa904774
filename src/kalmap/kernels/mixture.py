"""Reducing a Gaussian mixture: prune, merge, cap. The result does not depend on the order of its components."""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.looks import lower_root
from kalmap.kernels.set_layout import (
    CAP,
    COLUMNS,
    ID,
    L11,
    L21,
    L22,
    MERGE,
    PRUNE,
    SEEN,
    WEIGHT,
    X,
    Y,
)


@compiled
def _before(first, second):
    """Whether a component goes before another: by weight, then by place and root: ties do not depend on order."""
    if first[WEIGHT] != second[WEIGHT]:
        return first[WEIGHT] > second[WEIGHT]
    for k in range(1, COLUMNS):
        if first[k] != second[k]:
            return first[k] < second[k]
    return False


@compiled
def by_weight(rows, count):
    """The order of `count` components, heaviest first, ties by place: (count,) int64."""
    order = np.argsort(rows[:count, X], kind="mergesort")
    order = order[np.argsort(-rows[order, WEIGHT], kind="mergesort")]
    for a in range(1, count):  # what ties in weight and x alone is out of place
        k = a
        while k > 0 and _before(rows[order[k]], rows[order[k - 1]]):
            order[k], order[k - 1] = order[k - 1], order[k]
            k -= 1
    return order


@compiled
def squared_distance(centre, other):
    """(m_o - m_c)' P_c^-1 (m_o - m_c), P_c the covariance of `centre`."""
    a = (other[X] - centre[X]) / centre[L11]
    b = (other[Y] - centre[Y] - centre[L21] * a) / centre[L22]
    return a * a + b * b


@compiled
def merged(rows, members, count, out):
    """One component from several: the mixture's weight, mean and covariance, the root from stacked columns."""
    weight, x, y, seen = 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        row = rows[members[k]]
        weight += row[WEIGHT]
        x += row[WEIGHT] * row[X]
        y += row[WEIGHT] * row[Y]
        seen += row[WEIGHT] * row[SEEN]
    first, second = np.empty(3 * count), np.empty(3 * count)
    x, y, seen = x / weight, y / weight, seen / weight
    for k in range(count):
        row = rows[members[k]]
        share = math.sqrt(row[WEIGHT] / weight)
        first[3 * k], second[3 * k] = share * row[L11], share * row[L21]
        first[3 * k + 1], second[3 * k + 1] = 0.0, share * row[L22]
        first[3 * k + 2], second[3 * k + 2] = share * (row[X] - x), share * (row[Y] - y)
    out[WEIGHT], out[X], out[Y], out[SEEN] = weight, x, y, seen
    out[L11], out[L21], out[L22] = lower_root(first, second, 3 * count)
    out[ID] = rows[members[0], ID]


@compiled
def reduce(rules, rows, count, out):
    """Prune below PRUNE, merge what lies within MERGE of a heavier component, keep at most CAP. Returns how many.

    Heaviest first: each takes in every lighter one, not yet taken, whose mean is within squared distance MERGE of its
    own, by its own covariance; neighbours are found in the order of x. The merged component keeps the heaviest's id.
    """
    order = by_weight(rows, count)
    kept = 0
    while kept < count and rows[order[kept], WEIGHT] >= rules[PRUNE]:
        kept += 1
    place = np.empty(kept)
    for a in range(kept):
        place[a] = rows[order[a], X]
    across = np.argsort(place, kind="mergesort")
    sorted_place = place[across]
    taken = np.zeros(kept, np.bool_)
    members = np.empty(kept, np.int64)
    ranks = np.empty(kept, np.int64)
    most, total = int(rules[CAP]), 0
    for a in range(kept):
        if taken[a]:
            continue
        if total == most:
            break
        centre = rows[order[a]]
        reach = math.sqrt(rules[MERGE]) * centre[L11]
        low = np.searchsorted(sorted_place, centre[X] - reach)
        found = 0
        while low < kept and sorted_place[low] <= centre[X] + reach:
            b = across[low]
            if not taken[b] and (b == a or squared_distance(centre, rows[order[b]]) < rules[MERGE]):
                ranks[found] = b
                found += 1
            low += 1
        ranks[:found].sort()  # heaviest first again
        for k in range(found):
            taken[ranks[k]] = True
            members[k] = order[ranks[k]]
        if found == 1:
            out[total] = centre
        else:
            merged(rows, members, found, out[total])
        total += 1
    return total
