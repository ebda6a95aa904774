"""Sightings that could be either of two landmarks, even with the rest of the frame to help.

A wrong match is worse than none: it makes the filter sure of a wrong place. So a match is taken only if it is
clearly likelier than the next best, given the other matches of the frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kalmap.association.associator import Predicted
from kalmap.geometry.angles import wrap

if TYPE_CHECKING:
    from kalmap.association.gated import Table


def ambiguous(predicted: Predicted, table: Table, columns: np.ndarray, margin: float) -> np.ndarray:
    """(M,) bool: matched, but another free landmark inside the gate is nearly as likely.

    columns: (M,) candidate of each sighting or -1. margin: what nu' S^-1 nu + ln det S of the next best must
    exceed that of the match by, both conditioned on the frame's other matches: twice the log of their
    likelihood ratio.
    """
    doubtful = np.zeros(len(columns), dtype=np.bool_)
    matched = np.flatnonzero(columns >= 0)
    taken = table.trial.copy()
    taken[columns[matched]] = True
    rivals = (table.squared <= table.gate) & ~taken
    rows = matched[rivals[matched].any(axis=1)]
    if not len(rows):
        return doubtful
    wanted = np.unique(np.concatenate([columns[matched], np.flatnonzero(rivals[rows].any(axis=0))]))
    expected = table.expected.take(wanted)
    cross = predicted.cross(expected)
    place = np.full(len(taken), -1)
    place[wanted] = np.arange(len(wanted))
    z = table.sightings.values
    for m in rows.tolist():
        others = matched[(matched != m) & (columns[matched] != columns[m])]
        options = [place[columns[m]], *place[np.flatnonzero(rivals[m])].tolist()]
        costs = _conditioned(
            z, predicted.noises, expected.z, cross, m, options, others, place[columns[others]]
        )
        costs += table.extra[m, wanted[options]]
        doubtful[m] = costs[1:].min() - costs[0] < margin
    return doubtful


def _conditioned(
    z: np.ndarray,
    noises: np.ndarray,
    expected: np.ndarray,
    cross: np.ndarray,
    m: int,
    options: list[int],
    others: np.ndarray,
    places: np.ndarray,
) -> np.ndarray:
    """nu' S^-1 nu + ln det S of sighting m with each option, given that the others are matched as they are."""
    count = 2 * len(others)
    innovation = z[others] - expected[places]
    innovation[:, 1] = wrap(innovation[:, 1])
    joint = cross[np.ix_(places, places)].transpose(0, 2, 1, 3).reshape(count, count)
    for k, other in enumerate(others.tolist()):
        joint[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += noises[other]
    costs = np.empty(len(options))
    for n, option in enumerate(options):
        nu = z[m] - expected[option]
        nu[1] = wrap(nu[1])
        spread = cross[option, option] + noises[m]
        if count:
            towards = cross[option][places].transpose(1, 0, 2).reshape(2, count)
            gain = np.linalg.solve(joint, towards.T).T
            nu = nu - gain @ innovation.ravel()
            spread = spread - gain @ towards.T
        costs[n] = nu @ np.linalg.solve(spread, nu) + np.log(np.linalg.det(spread))
    return costs
