"""Association as a multi-Bernoulli map makes it: by the probability of every pair over whole-frame hypotheses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalmap.association.associator import Expected, Predicted
from kalmap.association.checks import check
from kalmap.association.gated import Gated, Matching, Table
from kalmap.association.management import BuiltInManagement, Existence
from kalmap.geometry.angles import wrap
from kalmap.kernels import nearest as kernel
from kalmap.kernels.hypothesis_search import pair_probabilities
from kalmap.records import Association, Reason

_FRAMES = 20.0  # that the stated rate of false sightings counts for
_LEAST = 1e-3  # false sightings a frame


class Pmb(Gated, frozen=True, kw_only=True, tag=True):
    """A sighting goes to a landmark if that is nearly sure, over all likely associations of the whole frame.

    Landmarks are Bernoulli components with a probability of existence (the management's), those never sighted a
    Poisson process; a pair is weighed by P_D r N(nu; 0, S) against a miss and a sighting that nothing explains, whose
    rate is learnt. The innovations of a frame hang together through the robot, so hypotheses are grown from the most
    likely pairs in the joint Gaussian (`hypothesis_search`) and each pair's probability is summed over them. A lone
    sighting in a wide gate, as likely clutter as landmark, is then not taken; several that agree are.

    sure: probability from which a pair is taken. detection: P_D. false_rate: false sightings a frame to start from.
    seeds: pairs that hypotheses are grown from.
    """

    sure: float = 0.95
    detection: float = 0.9
    false_rate: float = 0.5
    new_rate: float = 0.2
    seeds: int = 8
    management: BuiltInManagement = Existence()

    def __post_init__(self) -> None:
        Gated.__post_init__(self)
        check(0.5 <= self.sure < 1.0, "sure", "a probability from 0.5 on, below 1", self.sure)
        check(0.0 < self.detection < 1.0, "detection", "a probability between 0 and 1", self.detection)
        check(0.0 < self.false_rate < math.inf, "false_rate", "more than 0", self.false_rate)
        check(0.0 < self.new_rate < math.inf, "new_rate", "more than 0", self.new_rate)
        check(self.seeds >= 1, "seeds", "1 or more", self.seeds)

    def start(self) -> Any:
        """As every associator by place, and [false sightings, frames]."""
        return super().start() | {"false": [_FRAMES * self.false_rate, _FRAMES]}

    def settle(self, memory: Any, association: Association) -> None:
        """Count the sightings that no landmark in the map explains."""
        memory["false"][0] += float((association.matched < 0).sum())
        memory["false"][1] += 1.0
        super().settle(memory, association)

    def _match(self, memory: Any, table: Table, predicted: Predicted) -> Matching:
        columns = np.full(len(table.squared), kernel.FREE, dtype=np.int64)
        possible = (table.squared <= table.gate) & ~table.trial
        rows, wanted = np.flatnonzero(possible.any(axis=1)), np.flatnonzero(possible.any(axis=0))
        if not len(rows):
            return Matching(columns, Reason.PROBABLE, Reason.IMPROBABLE)
        expected = table.expected.take(wanted)
        nu = table.sightings.values[rows, None] - expected.z[None]
        nu[..., 1] = wrap(nu[..., 1])
        pairs = np.zeros((len(rows), len(wanted)))
        different = pair_probabilities(
            nu,
            _as_matrix(predicted.cross(expected)),
            predicted.noises[rows],
            possible[np.ix_(rows, wanted)],
            self._worth(memory, expected, predicted),
            self.seeds,
            pairs,
        )
        best = pairs.argmax(axis=1)
        sure = pairs[np.arange(len(rows)), best] >= self.sure
        columns[rows[sure]] = wanted[best[sure]]
        notes = (f"{different} hypotheses",) if predicted.explain else ()
        return Matching(columns, Reason.PROBABLE, Reason.IMPROBABLE, notes)

    def _worth(self, memory: Any, expected: Expected, predicted: Predicted) -> np.ndarray:
        """(C,) ln(P_D r / ((1 - P_D r) c)), c the density of sightings that no landmark explains."""
        false, frames = memory["false"]
        view = predicted.max_range * 2.0 * predicted.half_view
        if not math.isfinite(view):
            view = 2.0 * math.pi * float(expected.z[:, 0].max())
        density = max(false / frames, _LEAST) / view
        scores = np.array([memory["score"][i] for i in expected.indices.tolist()])
        seen = self.detection * 0.5 * (1.0 + np.tanh(0.5 * scores))
        return np.log(seen / (1.0 - seen)) - math.log(density)


def _as_matrix(blocks: np.ndarray) -> np.ndarray:
    """(C, C, 2, 2) blocks as one matrix (2 C, 2 C)."""
    count = len(blocks)
    return np.ascontiguousarray(blocks.transpose(0, 2, 1, 3)).reshape(2 * count, 2 * count)
