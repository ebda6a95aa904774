"""The samples of a contour in the order in which they follow each other."""

from __future__ import annotations

import numpy as np


def strands(pairs: np.ndarray, count: int) -> list[np.ndarray]:
    """Rows in order along each contour, of `count` samples of which `pairs` (S, 2) are neighbours.

    No sample may have more than two neighbours. A closed ring is opened at its lowest row and repeats that row at the
    end. Samples without a neighbour are in none.
    """
    beside = np.full((count, 2), -1, dtype=np.int64)
    for a, b in pairs:
        beside[a, int(beside[a, 0] >= 0)] = b
        beside[b, int(beside[b, 0] >= 0)] = a
    degree = (beside >= 0).sum(axis=1)
    seen = np.zeros(count, dtype=bool)
    found = []
    for start in (*np.flatnonzero(degree == 1), *np.flatnonzero(degree == 2)):  # open ones first, then rings
        if not seen[start]:
            found.append(_walk(int(start), beside, seen, bool(degree[start] == 2)))
    return found


def _walk(start: int, beside: np.ndarray, seen: np.ndarray, ring: bool) -> np.ndarray:
    rows, at = [start], start
    seen[start] = True
    while True:
        onward = [int(row) for row in beside[at] if row >= 0 and not seen[row]]
        if not onward:
            return np.array([*rows, start] if ring else rows)
        at = onward[0]
        seen[at] = True
        rows.append(at)
