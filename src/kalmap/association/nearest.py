"""Nearest neighbour: every sighting for itself, or the best one-to-one set."""

from __future__ import annotations

import numpy as np

from kalmap.association.associator import Predicted
from kalmap.association.gated import Gated, Matching, Table
from kalmap.kernels import nearest as kernel
from kalmap.records import Reason


class Nearest(Gated, frozen=True, kw_only=True, tag=True):
    """The nearest landmark by normalised distance nu' S^-1 nu + ln det S, of those inside the gate.

    Section 2 of Zhou, Zhao & Zhang 2010. one_to_one: False is the paper's: two sightings of a frame may take
    the same landmark. True takes the one-to-one set with the most pairs and, of those, the least total distance
    (Kuhn 1955).
    """

    one_to_one: bool = False

    def _match(self, table: Table, predicted: Predicted) -> Matching:
        if self.one_to_one:
            return _assigned(table)
        columns = np.full(len(table.squared), kernel.FREE, dtype=np.int64)
        everyone = np.ones(len(columns), dtype=np.bool_)
        kernel.nearest(table.squared, table.normalised, table.gate, everyone, ~table.trial, columns)
        return Matching(columns)


class Likelihood(Gated, frozen=True, kw_only=True, tag=True):
    """Maximum likelihood: the one-to-one set with the most pairs inside the gate and the least total normalised
    distance.

    Pairs compete by nu' S^-1 nu + ln det S, twice the negative log-likelihood but for a constant.
    """

    def _match(self, table: Table, predicted: Predicted) -> Matching:
        return _assigned(table)


def _assigned(table: Table) -> Matching:
    """The best one-to-one set of a frame."""
    columns = np.full(len(table.squared), kernel.FREE, dtype=np.int64)
    assign(table.squared, table.normalised, table.gate, ~table.trial, columns)
    return Matching(columns, Reason.ASSIGNED)


def assign(
    squared: np.ndarray, normalised: np.ndarray, gate: float, usable: np.ndarray, matched: np.ndarray
) -> None:
    """Write the one-to-one assignment of least total normalised distance, most pairs first, into `matched` (M,).

    squared, normalised: (M, C). usable: (C,) bool, candidates that may be taken.
    """
    possible = (squared <= gate) & usable
    rows, columns = np.flatnonzero(possible.any(axis=1)), np.flatnonzero(possible.any(axis=0))
    if len(rows) == 0:
        return
    inside = possible[np.ix_(rows, columns)]
    cost = normalised[np.ix_(rows, columns)]
    if inside.sum() == len(rows) == len(columns):
        # Nobody competes: every sighting has one candidate and every candidate one sighting.
        matched[rows] = columns[inside.argmax(axis=1)]
        return
    from scipy.optimize import linear_sum_assignment

    span = float(cost[inside].max() - cost[inside].min()) + 1.0
    penalty = span * (min(inside.shape) + 1)  # dearer than any exchange of possible pairs
    left, right = linear_sum_assignment(np.where(inside, cost - cost[inside].min(), penalty))
    for row, column in zip(left, right, strict=True):
        if inside[row, column]:
            matched[rows[row]] = columns[column]
