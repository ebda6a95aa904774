"""The K most probable associations of a frame, best first: each sighting takes one feature or none, each feature one.

An association is as probable as the product of its pairs' odds (see `association_sums`). The frame falls into
clusters; in each the best are found by Murty's partition (An algorithm for ranking all the assignments in order of
increasing cost, 1968): the solutions without a known one are divided by the first row that departs from it, and the
best of each part is an assignment of its own. The K best of several clusters are among the combinations of the K
best of each. This is exact, and needs no more than 1 + (K - 1) n assignments in a cluster of n sightings.
"""

import math

import numpy as np

from kalmap.kernels.association_sums import clusters
from kalmap.kernels.compiled import compiled
from kalmap.kernels.matching import match

DROP = 10.0  # an association less probable than exp(-DROP) of the best is left out


@compiled
def _costs(odds, rows, columns, n, m):
    """Costs (n, m + n) of a cluster and the cost of what must not be: -ln odds, then each row's own way to be alone."""
    costs, most = np.zeros((n, m + n)), 0.0
    for a in range(n):
        for b in range(m):
            if odds[rows[a], columns[b]] > 0.0:
                costs[a, b] = -math.log(odds[rows[a], columns[b]])
                most = max(most, abs(costs[a, b]))
    forbidden = 2.0 * n * most + 1.0  # more than any two associations differ by
    for a in range(n):
        for b in range(m):
            if odds[rows[a], columns[b]] <= 0.0:
                costs[a, b] = forbidden
        for b in range(n):
            if b != a:
                costs[a, m + b] = forbidden
    return costs, forbidden


@compiled
def _solve(costs, forbidden, fixed, without, chosen):
    """Best assignment with the first `fixed` rows as in chosen (n,) and the next not in the columns `without`.

    Fills the rest of chosen and returns ln of its probability, -inf if there is none.
    """
    part = costs[fixed:].copy()
    for a in range(fixed):
        part[:, chosen[a]] = forbidden
    for b in range(len(without)):
        if without[b]:
            part[0, b] = forbidden
    rows, columns = part.shape
    match(part, chosen[fixed:], np.empty(rows), np.empty(columns))
    total = 0.0
    for a in range(len(costs)):
        if a >= fixed and part[a - fixed, chosen[a]] == forbidden:
            return -math.inf
        total -= costs[a, chosen[a]]
    return total


@compiled
def _rank(costs, forbidden, options, values):
    """The K best assignments of one cluster, options (K, n) and their ln values (K,), best first. Returns how many."""
    n, columns = costs.shape
    most = len(values)
    room = 1 + (most - 1) * n
    chosen, without = np.empty((room, n), np.int64), np.zeros((room, columns), np.bool_)
    fixed, value = np.zeros(room, np.int64), np.empty(room)
    value[0] = _solve(costs, forbidden, 0, without[0], chosen[0])
    nodes, least = 1, value[0] - DROP
    for k in range(most):
        best = np.argmax(value[:nodes])
        if value[best] <= least:
            return k
        options[k], values[k] = chosen[best], value[best]
        value[best] = -math.inf
        if k == most - 1:
            break
        for row in range(fixed[best], n):
            if row == fixed[best]:
                without[nodes] = without[best]
            without[nodes, chosen[best, row]] = True
            chosen[nodes, :row], fixed[nodes] = chosen[best, :row], row
            value[nodes] = _solve(costs, forbidden, row, without[nodes], chosen[nodes])
            nodes += 1
    return most


@compiled
def _combine(scores, count, values, found, parents, picks):
    """The best sums of one of scores (count,) and one of values (found,), both best first; overwrites scores (K,).

    parents, picks (K,): which of each. Returns how many.
    """
    place, sums = np.zeros(count, np.int64), np.empty(len(scores))
    least = scores[0] + values[0] - DROP
    total = 0
    while total < len(scores):
        best, most = -1, least
        for a in range(count):
            if place[a] < found and scores[a] + values[place[a]] > most:
                best, most = a, scores[a] + values[place[a]]
        if best < 0:
            break
        sums[total], parents[total], picks[total] = most, best, place[best]
        place[best] += 1
        total += 1
    scores[:total] = sums[:total]
    return total


@compiled
def best_associations(odds, given, scores):
    """The K most probable associations for odds (M, F), 0 where a pair is impossible. Returns how many.

    given (K, M): each sighting's feature or -1. scores (K,): ln of the product of the odds of the pairs, best first.
    """
    all_rows, all_columns, row_edges, column_edges = clusters(odds)
    most = len(scores)
    parents, picks, values = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    given[0], scores[0], total = -1, 0.0, 1
    for k in range(len(row_edges) - 1):
        rows = all_rows[row_edges[k] : row_edges[k + 1]]
        columns = all_columns[column_edges[k] : column_edges[k + 1]]
        n, m = len(rows), len(columns)
        costs, forbidden = _costs(odds, rows, columns, n, m)
        options = np.empty((most, n), np.int64)
        found = _rank(costs, forbidden, options, values)
        total = _combine(scores, total, values, found, parents, picks)
        before = given.copy()
        for h in range(total):
            given[h] = before[parents[h]]
            for a in range(n):
                taken = options[picks[h], a]
                given[h, rows[a]] = columns[taken] if taken < m else -1
    return total
