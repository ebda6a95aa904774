"""The best one-to-one pairing among candidate pairs, exactly and without a table of all of them."""

from __future__ import annotations

import numpy as np

# up to so many entries one table of all contested pairs is solved sooner than a table a group
_TABLE = 250_000


def best_pairing(
    rows: np.ndarray, columns: np.ndarray, cost: np.ndarray, unpaired: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns (P,) of the one-to-one pairing that saves most of `unpaired`, summed over its pairs.

    rows, columns: (K,) the candidate pairs, each once. cost: (K,) below `unpaired`; a pair saves
    unpaired - cost. Pairs whose partners have no other candidate are taken as they are; of the others,
    each group that hangs together is solved by itself where one table of them all would be large.
    """
    alone = (np.bincount(rows)[rows] == 1) & (np.bincount(columns)[columns] == 1)
    pairs = [np.stack([rows[alone], columns[alone]])]
    contested = np.flatnonzero(~alone)
    for members in _parts(rows, columns, contested):
        pairs.append(_solve(rows[members], columns[members], cost[members], unpaired))
    first, second = np.concatenate(pairs, axis=1)
    return first, second


def _parts(rows: np.ndarray, columns: np.ndarray, contested: np.ndarray) -> list[np.ndarray]:
    """Those of the pairs that are contested, in parts that share neither row nor column."""
    if not len(contested):
        return []
    if len(np.unique(rows[contested])) * len(np.unique(columns[contested])) <= _TABLE:
        return [contested]
    group = _groups(rows[contested], columns[contested])
    order = np.argsort(group, kind="stable")
    return np.split(contested[order], np.flatnonzero(np.diff(group[order])) + 1)


def _groups(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(K,) the number of the connected group that each pair belongs to; at least one pair."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = rows.max() + 1
    ends = size + columns
    total = ends.max() + 1
    graph = coo_array((np.ones(len(rows), dtype=bool), (rows, ends)), shape=(total, total))
    return np.asarray(connected_components(graph, directed=False)[1][rows])


def _solve(rows: np.ndarray, columns: np.ndarray, cost: np.ndarray, unpaired: float) -> np.ndarray:
    """(2, P) the best pairing of one part."""
    from scipy.optimize import linear_sum_assignment

    left, row = np.unique(rows, return_inverse=True)
    right, column = np.unique(columns, return_inverse=True)
    table = np.full((len(left), len(right)), unpaired)
    table[row, column] = cost
    first, second = linear_sum_assignment(table)
    near = table[first, second] < unpaired
    return np.stack([left[first[near]], right[second[near]]])
