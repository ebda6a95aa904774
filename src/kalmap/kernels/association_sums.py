"""Sums over all associations of a frame: each sighting takes one feature or none, each feature one sighting or none.

With L_ij the odds of the pair (sighting i, feature j) against both being alone, the sum is
Z = sum over matchings of the product of L over their pairs: the set likelihood of a multi-feature map, and the
normaliser of a multi-Bernoulli update. Pairs beyond the gate have L = 0, so the problem falls into clusters.

Clusters are summed exactly by dynamic programming over the subsets of their smaller side, as long as that is small, and
else by `messages`, loopy belief propagation (Williams & Lau, Approximate evaluation of marginal association
probabilities with belief propagation, 2014), exact where a cluster has no loop. Both know the probability of each pair.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled

EXACT_SIDE = 10  # most members of the smaller side of a cluster that is summed exactly
EXACT_PAIRS = 6  # the same, where the probability of each pair is asked for

_LARGE = 1e50
_ROUNDS = 200
_SETTLED = 1e-9


@compiled
def messages(odds, pairs, free):
    """Probability of every pair, pairs (M, F), and of every feature to stay alone, free (F,); returns ln Z (Bethe)."""
    count, features = odds.shape
    to_feature = np.ones((count, features))  # nu
    to_sighting = np.zeros((count, features))  # mu
    others = np.empty(max(count, features) + 1)
    for _ in range(_ROUNDS):
        change = 0.0
        for j in range(features):
            others[count] = 0.0  # sums over the others: a difference would lose small rivals of a great pair
            for i in range(count - 1, -1, -1):
                others[i] = others[i + 1] + odds[i, j] * to_feature[i, j]
            before = 1.0
            for i in range(count):
                if odds[i, j] > 0.0:
                    to_sighting[i, j] = odds[i, j] / (before + others[i + 1])
                    before += odds[i, j] * to_feature[i, j]
        for i in range(count):
            others[features] = 0.0
            for j in range(features - 1, -1, -1):
                others[j] = others[j + 1] + to_sighting[i, j]
            before = 1.0
            for j in range(features):
                if odds[i, j] > 0.0:
                    value = 1.0 / (before + others[j + 1])
                    change = max(change, abs(value - to_feature[i, j]) / value)
                    to_feature[i, j] = value
                    before += to_sighting[i, j]
        if change < _SETTLED:
            break
    log_sum = 0.0
    for j in range(features):
        total = 1.0
        for i in range(count):
            total += odds[i, j] * to_feature[i, j]
        free[j] = 1.0 / total
        log_sum += math.log(total)
        for i in range(count):
            pairs[i, j] = odds[i, j] * to_feature[i, j] / total
    for i in range(count):
        total = 1.0
        for j in range(features):
            total += to_sighting[i, j]
            log_sum -= math.log(1.0 + to_sighting[i, j] * to_feature[i, j])
        log_sum += math.log(total)
    return log_sum


@compiled
def _cluster(odds, start, of_sighting, of_feature, rows, columns):
    """The cluster around sighting `start`; marks its members and lists them. Returns (rows, columns) counts."""
    count, features = odds.shape
    rows[0], n, m = start, 1, 0
    of_sighting[start] = True
    done_rows, done_columns = 0, 0
    while done_rows < n or done_columns < m:
        if done_rows < n:
            i = rows[done_rows]
            done_rows += 1
            for j in range(features):
                if odds[i, j] > 0.0 and not of_feature[j]:
                    of_feature[j] = True
                    columns[m] = j
                    m += 1
            continue
        j = columns[done_columns]
        done_columns += 1
        for i in range(count):
            if odds[i, j] > 0.0 and not of_sighting[i]:
                of_sighting[i] = True
                rows[n] = i
                n += 1
    return n, m


@compiled
def clusters(odds):
    """The clusters of odds (M, F) that hold a pair, one after the other.

    Returns rows (M,) and columns (F,), cluster by cluster, and the edges (K + 1,) of each cluster's part of them.
    """
    count, features = odds.shape
    of_sighting, of_feature = np.zeros(count, np.bool_), np.zeros(features, np.bool_)
    rows, columns = np.empty(count, np.int64), np.empty(features, np.int64)
    row_edges, column_edges = np.zeros(count + 1, np.int64), np.zeros(count + 1, np.int64)
    found = 0
    for start in range(count):
        if of_sighting[start]:
            continue
        low, first = row_edges[found], column_edges[found]
        n, m = _cluster(odds, start, of_sighting, of_feature, rows[low:], columns[first:])
        if m > 0:
            row_edges[found + 1], column_edges[found + 1] = low + n, first + m
            found += 1
    return rows, columns, row_edges[: found + 1], column_edges[: found + 1]


@compiled
def _oriented(odds, rows, columns, n, m):
    """A cluster's odds with its smaller side across: (outer, inner), sightings down if there are more of them."""
    turned = m < n
    part = np.empty((n, m)) if turned else np.empty((m, n))
    for a in range(n):
        for b in range(m):
            if turned:
                part[a, b] = odds[rows[a], columns[b]]
            else:
                part[b, a] = odds[rows[a], columns[b]]
    return part


@compiled
def _scaled(sums):
    """Divide by the greatest where the sums grow large; returns its logarithm, else zero."""
    most = sums.max()
    if most < _LARGE:
        return 0.0
    sums /= most
    return math.log(most)


@compiled
def _join(sums, pair):
    """One more member of the outer side, with odds pair (inner,), takes a free member of the inner side or none."""
    for subset in range(len(sums) - 1, -1, -1):
        value = sums[subset]
        if value == 0.0:
            continue
        for a in range(len(pair)):
            if subset >> a & 1 == 0 and pair[a] > 0.0:
                sums[subset | 1 << a] += value * pair[a]
    return _scaled(sums)


@compiled
def _exact(part):
    """ln Z of a cluster of odds part (outer, inner), inner <= EXACT_SIDE: over subsets of the inner side."""
    sums = np.zeros(1 << part.shape[1])
    sums[0] = 1.0
    scale = 0.0
    for b in range(len(part)):
        scale += _join(sums, part[b])
    return scale + math.log(sums.sum())


@compiled
def _exact_pairs(part, pairs, alone, alone_inside):
    """ln Z of a cluster, the probability of each pair (outer, inner) and of each member of a side to stay alone.

    Sums over who has chosen before a member of the outer side, times sums over who chooses after it.
    """
    outer, inner = part.shape
    before = np.zeros((outer + 1, 1 << inner))
    scales = np.zeros(outer + 1)
    before[0, 0] = 1.0
    for b in range(outer):
        before[b + 1] = before[b]
        scales[b + 1] = scales[b] + _join(before[b + 1], part[b])
    whole = before[outer].sum()
    log_sum = scales[outer] + math.log(whole)
    for a in range(inner):
        total = 0.0
        for subset in range(1 << inner):
            if subset >> a & 1 == 0:
                total += before[outer, subset]
        alone_inside[a] = total / whole
    after = np.ones(1 << inner)
    scale = 0.0
    for b in range(outer - 1, -1, -1):
        share = math.exp(scales[b] + scale - log_sum)
        pairs[b] = 0.0
        total = 0.0
        for subset in range(
            1 << inner
        ):  # ascending: what stands further on is still that of the member after
            value, rest = before[b, subset], after[subset]
            total += value * rest
            for a in range(inner):
                if subset >> a & 1 == 0 and part[b, a] > 0.0:
                    taken = part[b, a] * after[subset | 1 << a]
                    pairs[b, a] += value * taken
                    rest += taken
            after[subset] = rest
        alone[b] = total * share
        pairs[b] *= share
        scale += _scaled(after)
    return log_sum


@compiled
def log_sum_of_associations(odds):
    """ln Z of odds (M, F): exact cluster by cluster, by messages where a cluster is too large on both sides."""
    all_rows, all_columns, row_edges, column_edges = clusters(odds)
    total = 0.0
    for k in range(len(row_edges) - 1):
        rows = all_rows[row_edges[k] : row_edges[k + 1]]
        columns = all_columns[column_edges[k] : column_edges[k + 1]]
        n, m = len(rows), len(columns)
        if min(n, m) <= EXACT_SIDE:
            total += _exact(_oriented(odds, rows, columns, n, m))
            continue
        part = np.empty((n, m))
        for a in range(n):
            for b in range(m):
                part[a, b] = odds[rows[a], columns[b]]
        total += messages(part, np.empty((n, m)), np.empty(m))
    return total


@compiled
def marginals(odds, pairs, free):
    """ln Z and what `messages` says, cluster by cluster and exact in small ones.

    pairs (M, F) is zero beyond the clusters, free (F,) one for features without pair.
    """
    all_rows, all_columns, row_edges, column_edges = clusters(odds)
    pairs[:, :] = 0.0
    free[:] = 1.0
    total = 0.0
    for k in range(len(row_edges) - 1):
        rows = all_rows[row_edges[k] : row_edges[k + 1]]
        columns = all_columns[column_edges[k] : column_edges[k + 1]]
        n, m = len(rows), len(columns)
        if n == 1 and m == 1:
            value = odds[rows[0], columns[0]]
            pairs[rows[0], columns[0]] = value / (1.0 + value)
            free[columns[0]] = 1.0 / (1.0 + value)
            total += math.log(1.0 + value)
            continue
        if min(n, m) <= EXACT_PAIRS:
            part = _oriented(odds, rows, columns, n, m)
            part_pairs = np.empty(part.shape)
            outside, inside = np.empty(part.shape[0]), np.empty(part.shape[1])
            total += _exact_pairs(part, part_pairs, outside, inside)
            for b in range(m):
                free[columns[b]] = inside[b] if m < n else outside[b]
                for a in range(n):
                    pairs[rows[a], columns[b]] = part_pairs[a, b] if m < n else part_pairs[b, a]
            continue
        part, part_pairs, part_free = np.empty((n, m)), np.empty((n, m)), np.empty(m)
        for a in range(n):
            for b in range(m):
                part[a, b] = odds[rows[a], columns[b]]
        total += messages(part, part_pairs, part_free)
        for b in range(m):
            free[columns[b]] = part_free[b]
            for a in range(n):
                pairs[rows[a], columns[b]] = part_pairs[a, b]
    return total
