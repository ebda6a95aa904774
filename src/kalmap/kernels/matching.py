"""Two-sided matching where everybody may stay alone: the part of an assignment problem that is easy.

Shortest augmenting paths with dual prices (Jonker & Volgenant 1987, in the form of Crouse 2016).
"""

import numpy as np

from kalmap.kernels.compiled import compiled


@compiled
def match(cost, column_of, row_dual, column_dual):
    """Give every row a column of its own at least total cost; cost (R, C), finite, R <= C.

    Writes column_of (R,) and duals with row_dual + column_dual <= cost, equal on the matched pairs,
    column_dual <= 0 everywhere and 0 on the columns left over and on one more.
    """
    rows, columns = cost.shape
    row_of = np.full(columns, -1, np.int64)
    shortest, previous = np.empty(columns), np.empty(columns, np.int64)
    open_columns, closed_columns = np.empty(columns, np.int64), np.empty(columns, np.int64)
    column_of[:] = -1
    row_dual[:] = 0.0
    column_dual[:] = 0.0
    for start in range(rows):
        for c in range(columns):
            shortest[c], open_columns[c] = np.inf, c
        left, closed, row, length, sink = columns, 0, start, 0.0, -1
        while sink < 0:
            nearest, at = np.inf, -1
            for k in range(left):
                c = open_columns[k]
                reach = length + cost[row, c] - row_dual[row] - column_dual[c]
                if reach < shortest[c]:
                    shortest[c], previous[c] = reach, row
                if shortest[c] < nearest or (shortest[c] == nearest and row_of[c] < 0):
                    nearest, at = shortest[c], k
            length, c = nearest, open_columns[at]
            left -= 1
            open_columns[at] = open_columns[left]
            if row_of[c] < 0:
                sink = c
            else:
                closed_columns[closed] = c
                closed += 1
                row = row_of[c]
        row_dual[start] += length
        for k in range(closed):
            c = closed_columns[k]
            row_dual[row_of[c]] += length - shortest[c]
            column_dual[c] -= length - shortest[c]
        c = sink
        while True:
            row = previous[c]
            row_of[c] = row
            column_of[row], c = c, column_of[row]
            if row == start:
                break


@compiled
def match_or_leave(values, partner, row_price, column_price):
    """Least-cost matching of rows and columns that may stay alone.

    values (R + 1, C + 1): the cost of each pair (inf: not possible); the last column is what a row costs
    alone and the last row what a column costs alone, both at most 0; the last corner is not read.
    Writes partner (R,), -1 for alone, and prices >= 0 whose sum is minus the least cost, with
    row price + column price >= -value for every pair, and each price >= minus its own value alone.
    """
    rows, columns = values.shape[0] - 1, values.shape[1] - 1
    flip = rows > columns
    gain = np.empty((columns, rows)) if flip else np.empty((rows, columns))
    for r in range(rows):
        for c in range(columns):
            extra = min(0.0, values[r, c] - values[r, columns] - values[rows, c])
            if flip:
                gain[c, r] = extra
            else:
                gain[r, c] = extra
    short, long = gain.shape
    mate, short_dual, long_dual = np.empty(short, np.int64), np.empty(short), np.empty(long)
    match(gain, mate, short_dual, long_dual)
    for r in range(rows):
        partner[r] = -1
        row_price[r] = max(0.0, -values[r, columns] - (long_dual[r] if flip else short_dual[r]))
    for c in range(columns):
        column_price[c] = max(0.0, -values[rows, c] - (short_dual[c] if flip else long_dual[c]))
    for s in range(short):
        if gain[s, mate[s]] < 0.0:
            if flip:
                partner[mate[s]] = s
            else:
                partner[s] = mate[s]
