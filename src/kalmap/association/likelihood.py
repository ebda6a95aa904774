"""Maximum-likelihood association with gates, one-to-one within a frame."""

from __future__ import annotations

from typing import Any, ClassVar

import msgspec
import numpy as np

from kalmap.association.associator import Predicted
from kalmap.geometry.ellipses import chi_square_2
from kalmap.records import NEW, SPURIOUS, Association, Sightings


class Likelihood(msgspec.Struct, frozen=True, tag=True):
    """Pairs inside the gate compete by normalised distance nu' S^-1 nu + ln det S; the best one-to-one set wins.

    gate: probability inside which a pair is possible. new_gate: probability beyond which, from every landmark,
    a sighting founds a new one; between the two it is left unused (Bailey's reject and augment gates).
    confirm: sightings that a new landmark needs within `confirm_window` frames that could see it; else it is
    removed again as spurious. 1 keeps every landmark.
    """

    gate: float = 0.999
    new_gate: float = 0.999999
    confirm: int = 1
    confirm_window: int = 30
    uses_ids: ClassVar[bool] = False

    def start(self) -> Any:
        """Memory: for each landmark [sightings, frames in view] until it is confirmed, then None."""
        return []

    def associate(self, memory: Any, sightings: Sightings, predicted: Predicted) -> tuple[Association, Any]:
        """Never fails: a frame that matches nothing founds landmarks, an empty one does nothing."""
        matched = np.full(len(sightings.values), NEW, dtype=np.int64)
        if predicted.count and len(matched):
            squared, log_volume = predicted.innovations(np.arange(predicted.count))
            near = squared.min(axis=1) < chi_square_2(self.new_gate)
            matched[near] = SPURIOUS
            _assign(squared, squared + log_volume, chi_square_2(self.gate), matched)
        memory = [None if trial is None else list(trial) for trial in memory]
        confirmed, retired = self._review(memory, matched, predicted)
        return Association(matched, self.confirm > 1, confirmed, retired), memory

    def _review(
        self, memory: Any, matched: np.ndarray, predicted: Predicted
    ) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Count the frame for every landmark on trial; retire those whose time is up."""
        memory.extend([[1, 1] if self.confirm > 1 else None for _ in range(int((matched == NEW).sum()))])
        trial = [i for i in range(predicted.count) if memory[i] is not None]
        if not trial:
            return (), ()
        seen, view = set(matched.tolist()), predicted.in_view(0.1)
        confirmed, retired = [], []
        for i in trial:
            memory[i][0] += i in seen
            memory[i][1] += bool(view[i]) or i in seen
            if memory[i][0] >= self.confirm:
                memory[i] = None
                confirmed.append(i)
            elif memory[i][1] >= self.confirm_window:
                retired.append(i)
        for i in reversed(retired):
            del memory[i]
        return tuple(confirmed), tuple(retired)


def _assign(squared: np.ndarray, normalised: np.ndarray, gate: float, matched: np.ndarray) -> None:
    """Write the one-to-one assignment of least total normalised distance, most pairs first, into `matched`."""
    possible = squared < gate
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
