"""Association as a multi-Bernoulli map makes it: by the probability of every pair over whole-frame hypotheses."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np

from kalmap.association.associator import Predicted
from kalmap.association.checks import check
from kalmap.association.gated import Gated, Matching, Table
from kalmap.association.management import BuiltInManagement, Existence
from kalmap.geometry.angles import wrap
from kalmap.kernels import nearest as kernel
from kalmap.kernels.hypothesis_search import frame_hypotheses, view_shares
from kalmap.records import Association, Reason, Sightings

_FRAMES = 20.0  # that the stated rate of false sightings counts for
_LEAST = 1e-3  # false sightings a frame
_WIDE = 4.0  # det S / det R from which what a pair tells is worth a hypothesis of its own
_SLIGHT = 0.01  # share of the likeliest below which an option is left out
_SUREST = 1.0 - 1e-6
_DOUBLE = 25.0  # squared distance by the sensor's noise within which two landmarks look like one


class Option(msgspec.Struct, frozen=True):
    """One way to explain a frame: the association, and ln of the frame's likelihood under it."""

    association: Association
    log_likelihood: float


class Found(msgspec.Struct, frozen=True):
    """The hypotheses of a frame: sets (H, M) candidate or -1, weights (H,) summing to one, logs (H,), best first.

    seen, missed (C,): probability that each candidate is sighted, and that it is not: 1 for what may be hidden.
    density: of sightings that nothing explains, 1 / (m rad).
    """

    sets: np.ndarray
    weights: np.ndarray
    logs: np.ndarray
    seen: np.ndarray
    missed: np.ndarray
    density: float


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

    def options(self, memory: Any, sightings: Sightings, predicted: Predicted, most: int) -> list[Option]:
        """The likeliest ways to explain a frame, best first: one, unless a pair that tells much is in doubt."""
        table = self._table(memory, sightings, predicted)
        found = self._find(memory, table, predicted)
        options = []
        for columns, log in self._chosen(found, table, most):
            matching = Matching(columns.copy(), Reason.PROBABLE, Reason.IMPROBABLE)
            fate = np.empty(len(columns), dtype=np.int64)
            kernel.finish(
                table.squared, table.normalised, table.trial, table.gate, table.new_gate, columns, fate
            )
            log += _of_trials(found, table, columns, fate) + _excused(found, table, columns)
            options.append(Option(self._conclude(memory, table, matching, columns, fate, predicted), log))
        return sorted(options, key=lambda option: -option.log_likelihood)

    def _chosen(self, found: Found, table: Table, most: int) -> list[tuple[np.ndarray, float]]:
        """Candidate of every sighting (M,) and ln of the likelihood, of the hypotheses worth keeping.

        A pair in doubt that would hardly move anything is left aside instead of splitting the frame.
        """
        base = len(table.squared) * math.log(found.density) + float(np.log(found.missed).sum())
        pairs = _pair_probabilities(found, len(found.seen))
        plain = (pairs < self.sure) & ~self._telling(table)
        pooled: dict[bytes, tuple[np.ndarray, float]] = {}
        for columns, log in zip(found.sets, found.logs.tolist()):
            kept = columns.copy()
            taken = np.flatnonzero(kept >= 0)
            kept[taken[plain[taken, kept[taken]]]] = kernel.FREE
            key = kept.tobytes()
            before = pooled[key][1] if key in pooled else -math.inf
            pooled[key] = kept, float(np.logaddexp(before, log))
        chosen = sorted(pooled.values(), key=lambda entry: -entry[1])[:most]
        least = chosen[0][1] + math.log(_SLIGHT)
        return [(columns, base + log) for columns, log in chosen if log >= least]

    def _telling(self, table: Table) -> np.ndarray:
        """(M, C) bool: the pair's innovation is much wider than the sensor's noise, so that it would move the robot."""
        noise = np.linalg.det(table.noises)
        return np.exp(table.normalised - table.squared) > _WIDE * noise[:, None]

    def _match(self, memory: Any, table: Table, predicted: Predicted) -> Matching:
        found = self._find(memory, table, predicted)
        pairs = _pair_probabilities(found, len(table.expected.indices))
        columns = np.full(len(table.squared), kernel.FREE, dtype=np.int64)
        if pairs.size:
            best = pairs.argmax(axis=1)
            sure = pairs[np.arange(len(best)), best] >= self.sure
            columns[sure] = best[sure]
        notes = (f"{len(found.sets)} hypotheses",) if predicted.explain else ()
        return Matching(columns, Reason.PROBABLE, Reason.IMPROBABLE, notes)

    def _find(self, memory: Any, table: Table, predicted: Predicted) -> Found:
        """The hypotheses of a frame over the confirmed landmarks."""
        seen, missed, density = self._rates(memory, table, predicted)
        possible = (table.squared <= table.gate) & ~table.trial
        rows, wanted = np.flatnonzero(possible.any(axis=1)), np.flatnonzero(possible.any(axis=0))
        if not len(rows):
            none = np.full((1, len(possible)), kernel.FREE, dtype=np.int64)
            return Found(none, np.ones(1), np.zeros(1), seen, missed, density)
        expected = table.expected.take(wanted)
        nu = table.sightings.values[rows, None] - expected.z[None]
        nu[..., 1] = wrap(nu[..., 1])
        most = self.seeds * min(len(rows), len(wanted)) + 1
        sets, logs = np.empty((most, len(rows)), dtype=np.int64), np.empty(most)
        made = frame_hypotheses(
            nu,
            _as_matrix(predicted.cross(expected)),
            predicted.noises[rows],
            possible[np.ix_(rows, wanted)],
            np.log(seen[wanted] / missed[wanted]) - math.log(density),
            self.seeds,
            sets,
            logs,
        )
        whole = np.full((made, len(possible)), kernel.FREE, dtype=np.int64)
        whole[:, rows] = np.where(sets[:made] >= 0, wanted[sets[:made]], kernel.FREE)
        weights = np.exp(logs[:made] - logs[0])
        return Found(whole, weights / weights.sum(), logs[:made], seen, missed, density)

    def _rates(self, memory: Any, table: Table, predicted: Predicted) -> tuple[np.ndarray, np.ndarray, float]:
        """(C,) probability of each candidate to be sighted and to be missed; the density of unexplained sightings."""
        expected = table.expected
        false, frames = memory["false"]
        view = predicted.max_range * 2.0 * predicted.half_view
        if not math.isfinite(view):
            view = 2.0 * math.pi * max(float(table.sightings.values[:, 0].max(initial=1.0)), 1.0)
        seen = np.empty(len(expected.indices))
        view_shares(expected.z, expected.spreads, predicted.max_range, predicted.half_view, seen)
        seen *= self._detection(memory, expected, predicted)
        seen *= self._existence(memory, expected.indices, table.trial, false / frames)
        seen = np.clip(seen, 1.0 - _SUREST, _SUREST)
        missed = 1.0 - seen
        if len(seen) and self._hides(memory):
            missed[predicted.hidden(expected)] = 1.0
        return seen, missed, max(false / frames, _LEAST) / view

    def _detection(self, memory: Any, expected: Expected, predicted: Predicted) -> np.ndarray:
        """(C,) P_D at each candidate's range, as the management has learnt it."""
        at = getattr(self.management, "detection_at", None)
        if at is None:
            return np.full(len(expected.z), self.detection)
        reach, learnt = self.region.reach(predicted), memory["management"]
        return np.array([at(learnt, min(r, 0.999 * reach), reach) for r in expected.z[:, 0].tolist()])

    def _existence(self, memory: Any, indices: np.ndarray, trial: np.ndarray, clutter: float) -> np.ndarray:
        """(C,) probability that each candidate exists, for the frame's likelihood.

        One that has not been sighted again since its first time is as likely as a new landmark is among all sightings
        that nothing explains, whatever the management begins with: else every false sighting would cost a miss.
        """
        scores = np.array([memory["score"][i] for i in indices.tolist()])
        existence = np.array([self.management.existence(score) for score in scores.tolist()])
        once = trial & (scores <= self.management.first_score)
        prior = math.log(self.new_rate / max(clutter, _LEAST))
        odds = np.exp(np.minimum(prior + scores[once] - self.management.first_score, 0.0))
        existence[once] = odds / (1.0 + odds)
        return existence


def _pair_probabilities(found: Found, candidates: int) -> np.ndarray:
    """(M, C) over the hypotheses."""
    pairs = np.zeros((found.sets.shape[1], candidates))
    rows = np.arange(len(pairs))
    for columns, weight in zip(found.sets, found.weights.tolist()):
        taken = columns >= 0
        pairs[rows[taken], columns[taken]] += weight
    return pairs


def _of_trials(found: Found, table: Table, columns: np.ndarray, fate: np.ndarray) -> float:
    """ln of what sightings that go to landmarks on trial add to the frame's likelihood, each by itself."""
    total = 0.0
    for m in np.flatnonzero(fate == kernel.TRIAL).tolist():
        c = int(columns[m])
        density = -0.5 * float(table.normalised[m, c]) - math.log(2.0 * math.pi)
        total += math.log(found.seen[c] / found.missed[c]) + density - math.log(found.density)
    return total


def _excused(found: Found, table: Table, columns: np.ndarray) -> float:
    """ln of what the misses of doubles had cost: of two landmarks in one place, only one can have the sighting."""
    z, total = table.expected.z, 0.0
    taken = columns[columns >= 0]
    free = np.ones(len(z), dtype=bool)
    free[taken] = False
    for m in np.flatnonzero(columns >= 0).tolist():
        off = z - z[columns[m]]
        off[:, 1] = wrap(off[:, 1])
        squared = np.einsum("ci,ij,cj->c", off, np.linalg.inv(table.noises[m]), off)
        double = free & (squared < _DOUBLE)
        total -= float(np.log(found.missed[double]).sum())
        free &= ~double
    return total


def _as_matrix(blocks: np.ndarray) -> np.ndarray:
    """(C, C, 2, 2) blocks as one matrix (2 C, 2 C)."""
    count = len(blocks)
    return np.ascontiguousarray(blocks.transpose(0, 2, 1, 3)).reshape(2 * count, 2 * count)
