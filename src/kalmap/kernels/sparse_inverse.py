"""The inverse of a sparse symmetric matrix, where its factor has entries (Takahashi, Fagan & Chin 1973)."""

import numpy as np

from kalmap.kernels.compiled import compiled


@compiled
def selected_inverse(starts, rows, lower, d, inverse, diagonal):
    """Z = (L D L')^-1 on the pattern of L, from the last column to the first.

    starts (n + 1,), rows, lower: the strictly lower part of the unit triangular L by columns, rows ascending.
    d: (n,). inverse: as long as lower, and diagonal (n,): the result. Z[S, j] = -Z[S, S] L[S, j] with S the rows of
    column j, Z[j, j] = 1 / d[j] - L[S, j]' Z[S, j]; S x S is inside the pattern. As much work as the factor took.
    """
    n = len(d)
    place = np.full(n, -1, dtype=np.int64)
    for j in range(n - 1, -1, -1):
        begin, end = starts[j], starts[j + 1]
        for a in range(begin, end):
            inverse[a] = 0.0
            place[rows[a]] = a
        for a in range(begin, end):
            k, factor = rows[a], lower[a]
            inverse[a] -= diagonal[k] * factor
            for q in range(starts[k], starts[k + 1]):
                other = place[rows[q]]
                if other >= 0:
                    inverse[other] -= inverse[q] * factor
                    inverse[a] -= inverse[q] * lower[other]
        total = 0.0
        for a in range(begin, end):
            total += inverse[a] * lower[a]
            place[rows[a]] = -1
        diagonal[j] = 1.0 / d[j] - total


@compiled
def entries_of(starts, rows, inverse, diagonal, first, second, out):
    """out[k] = Z[first[k], second[k]] for places on the pattern. Returns the first one that is not on it, or -1."""
    for k in range(len(first)):
        column, row = min(first[k], second[k]), max(first[k], second[k])
        if column == row:
            out[k] = diagonal[column]
            continue
        low, high = starts[column], starts[column + 1]
        end = high
        while low < high:
            middle = (low + high) // 2
            if rows[middle] < row:
                low = middle + 1
            else:
                high = middle
        if low == end or rows[low] != row:
            return k
        out[k] = inverse[low]
    return -1
