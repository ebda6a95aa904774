"""Association as a multi-Bernoulli map makes it: by the probability of every pair over whole-frame hypotheses."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np

from kalmap.association.associator import Predicted
from kalmap.association.checks import check
from kalmap.association.explained import (
    Found,
    Rates,
    as_matrix,
    excused,
    of_trials,
    pair_probabilities,
    probability,
)
from kalmap.association.gated import Gated, Matching, Settling, Table
from kalmap.association.management import BuiltInManagement, Existence
from kalmap.geometry.angles import wrap
from kalmap.kernels import nearest as kernel
from kalmap.kernels.hypothesis_search import frame_hypotheses, view_shares
from kalmap.kernels.set_layout import SUREST
from kalmap.records import Association, Reason, Sightings

_FRAMES = 20.0  # that the stated rate of false sightings counts for
_LEAST = 1e-3  # false sightings a frame
_WIDE = 4.0  # det S / det R from which what a pair tells is worth a hypothesis of its own
_SLIGHT = 0.01  # share of the likeliest below which an option is left out

_MOST = 12.0  # ln odds beyond which existence is not believed or doubted further
_BELIEVED = 0.0  # least ln odds of a landmark that the management believes: misses in a row have one cause
_RINGS = 6
_DETECTION = 0.05, 0.98  # bounds of what is learnt


class Option(msgspec.Struct, frozen=True):
    """One way to explain a frame: the association, and ln of the frame's likelihood under it."""

    association: Association
    log_likelihood: float


class Beliefs(msgspec.Struct, frozen=True):
    """What a frame changes: ln odds of existence of candidates (index, odds) and of what it founds, and the tally of
    detections (BINS, 2): believed landmarks sighted, and those that should have been."""

    odds: tuple[tuple[int, float], ...]
    new: float
    tally: np.ndarray


class Pmb(Gated, frozen=True, kw_only=True, tag=True):
    """A sighting goes to a landmark if that is nearly sure, over all likely associations of the whole frame.

    Landmarks are Bernoulli components with a probability of existence, those never sighted a Poisson process; a pair
    is weighed by P_D r N(nu; 0, S) against a miss and a sighting that nothing explains. P_D in rings of range and the
    rate of what nothing explains are learnt. The innovations of a frame hang together through the robot, so hypotheses
    are grown from the most likely pairs in the joint Gaussian (`hypothesis_search`) and each pair's probability is
    summed over them. A lone sighting in a wide gate, as likely clutter as landmark, is then not taken; several that
    agree are. Which landmarks are used for correcting is the management's business, as everywhere.

    sure: probability from which a pair is taken. detection: P_D, false_rate: sightings a frame that nothing explains,
    both to start from; new_rate: first sightings a frame. seeds: pairs that hypotheses are grown from.
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
        """As every associator by place; ln odds of each landmark's existence; [unexplained sightings, frames]; and
        for each ring of range [sightings, frames in view] of landmarks believed in."""
        own = {
            "odds": [],
            "false": [_FRAMES * self.false_rate, _FRAMES],
            "detected": [[_FRAMES * self.detection, _FRAMES] for _ in range(_RINGS)],
        }
        return super().start() | own

    def _lists(self, memory: Any) -> tuple[list[Any], ...]:
        """As every associator by place, and the odds."""
        return (*super()._lists(memory), memory["odds"])

    def existence(self, memory: Any) -> list[float]:
        """The probability that each landmark is real."""
        return probability(np.array(memory["odds"])).tolist()

    def settle(self, memory: Any, association: Association) -> None:
        """Take in existence, detections, and the sightings that no landmark in the map explains."""
        change: Settling = association.change
        beliefs: Beliefs = change.beliefs
        memory["false"][0] += float((association.matched < 0).sum())
        memory["false"][1] += 1.0
        for entry, (seen, frames) in zip(memory["detected"], beliefs.tally.tolist(), strict=True):
            entry[0] += seen
            entry[1] += frames
        for index, odds in beliefs.odds:
            memory["odds"][index] = odds
        memory["odds"] += [beliefs.new] * change.founded
        for keep, drop in association.merged:
            memory["odds"][keep] = max(memory["odds"][keep], memory["odds"][drop])
        super().settle(memory, association)

    def associate(self, memory: Any, sightings: Sightings, predicted: Predicted) -> Association:
        """Decide a frame: the pairs that are nearly sure."""
        table = self._table(memory, sightings, predicted)
        found = self._find(memory, table, predicted)
        pairs = pair_probabilities(found, len(table.expected.indices))
        columns = np.full(len(table.squared), kernel.FREE, dtype=np.int64)
        if pairs.size:
            best = pairs.argmax(axis=1)
            sure = pairs[np.arange(len(best)), best] >= self.sure
            columns[sure] = best[sure]
        return self._concluded(memory, table, found, columns, predicted, table.squared)[0]

    def options(self, memory: Any, sightings: Sightings, predicted: Predicted, most: int) -> list[Option]:
        """The likeliest ways to explain a frame, best first: one, unless a pair that tells much is in doubt.

        Where such a pair is left out, its sighting is something else for certain: it may found a landmark, whereas
        `associate` leaves it unused. Else a wrong answer, sure of its place, would be the only one that can follow
        what it sees.
        """
        table = self._table(memory, sightings, predicted)
        found = self._find(memory, table, predicted)
        squared = np.where(self._telling(table) & ~table.trial, np.inf, table.squared)
        options = []
        for columns, log in self._chosen(found, table, most):
            association, more = self._concluded(memory, table, found, columns, predicted, squared)
            options.append(Option(association, log + more))
        return sorted(options, key=lambda option: -option.log_likelihood)

    def _concluded(
        self,
        memory: Any,
        table: Table,
        found: Found,
        columns: np.ndarray,
        predicted: Predicted,
        squared: np.ndarray,
    ) -> tuple[Association, float]:
        """What follows from pairs with confirmed landmarks (M,), and ln of what the rest adds to the likelihood.

        squared (M, C): what may not found a landmark is inside the gate of a confirmed one.
        """
        notes = (f"{len(found.sets)} hypotheses",) if predicted.explain else ()
        matching = Matching(columns.copy(), Reason.PROBABLE, Reason.IMPROBABLE, notes)
        fate = np.empty(len(columns), dtype=np.int64)
        kernel.finish(squared, table.normalised, table.trial, table.gate, table.new_gate, columns, fate)
        more = of_trials(found, table, columns, fate) + excused(found, table, columns)
        association = self._conclude(memory, table, matching, columns, fate, predicted)
        beliefs = self._beliefs(memory, table, found, columns, association.change)
        change = msgspec.structs.replace(association.change, beliefs=beliefs)
        return msgspec.structs.replace(association, change=change), more

    def _beliefs(
        self, memory: Any, table: Table, found: Found, columns: np.ndarray, change: Settling
    ) -> Beliefs:
        """Bernoulli update of the candidates: a sighting multiplies the odds by P_D N / c, a miss by 1 - P_D."""
        odds = found.odds.copy()
        missed = change.should & ~change.seen
        odds[missed] += np.log1p(-found.detection[missed])
        for m in np.flatnonzero(columns >= 0).tolist():
            c = columns[m]
            density = -0.5 * table.normalised[m, c] - math.log(2.0 * math.pi)
            odds[c] += math.log(found.detection[c]) + max(density - math.log(found.density), 0.0)
        odds = np.clip(odds, np.where(table.trial, -_MOST, _BELIEVED), _MOST)
        changed = np.flatnonzero(change.seen | missed)
        tally = np.zeros((_RINGS, 2))
        believed = ~table.trial & (change.should | change.seen) & (found.odds >= 0.0)
        ring = np.minimum(found.rings[believed], _RINGS - 1)
        np.add.at(tally, (ring, 0), change.seen[believed])
        np.add.at(tally, (ring, 1), 1.0)
        indices = table.expected.indices
        pairs = zip(indices[changed].tolist(), odds[changed].tolist(), strict=True)
        return Beliefs(tuple(pairs), self._new_odds(memory), tally)

    def _new_odds(self, memory: Any) -> float:
        """ln odds that a sighting which nothing explains is a landmark's first."""
        false, frames = memory["false"]
        return math.log(self.new_rate / max(false / frames, _LEAST))

    def _chosen(self, found: Found, table: Table, most: int) -> list[tuple[np.ndarray, float]]:
        """Candidate of every sighting (M,) and ln of the likelihood, of the hypotheses worth keeping.

        A pair in doubt that would hardly move anything is left aside instead of splitting the frame.
        """
        base = len(table.squared) * math.log(found.density) + float(np.log(found.missed).sum())
        pairs = pair_probabilities(found, len(found.seen))
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
        """(M, C) bool: the pair's innovation is much wider than sensor and extent, so that it would move the robot."""
        size = self.extent / np.maximum(table.expected.z[:, 0], max(self.extent, 1e-9))
        across = table.noises[:, None, 0, 0] + self.extent**2
        along = table.noises[:, None, 1, 1] + size[None] ** 2
        noise = across * along - table.noises[:, None, 0, 1] ** 2
        return np.exp(table.normalised - table.squared) > _WIDE * noise

    def _find(self, memory: Any, table: Table, predicted: Predicted) -> Found:
        """The hypotheses of a frame over the confirmed landmarks."""
        rates = self._rates(memory, table, predicted)
        known = msgspec.structs.asdict(rates)
        possible = (table.squared <= table.gate) & ~table.trial
        rows, wanted = np.flatnonzero(possible.any(axis=1)), np.flatnonzero(possible.any(axis=0))
        if not len(rows):
            none = np.full((1, len(possible)), kernel.FREE, dtype=np.int64)
            return Found(sets=none, weights=np.ones(1), logs=np.zeros(1), **known)
        expected = table.expected.take(wanted)
        nu = table.sightings.values[rows, None] - expected.z[None]
        nu[..., 1] = wrap(nu[..., 1])
        most = self.seeds * min(len(rows), len(wanted)) + 1
        sets, logs = np.empty((most, len(rows)), dtype=np.int64), np.empty(most)
        made = frame_hypotheses(
            nu,
            as_matrix(predicted.cross(expected)),
            predicted.noises[rows],
            possible[np.ix_(rows, wanted)],
            np.log(rates.seen[wanted] / rates.missed[wanted]) - math.log(rates.density),
            self.seeds,
            sets,
            logs,
        )
        whole = np.full((made, len(possible)), kernel.FREE, dtype=np.int64)
        whole[:, rows] = np.where(sets[:made] >= 0, wanted[sets[:made]], kernel.FREE)
        weights = np.exp(logs[:made] - logs[0])
        return Found(sets=whole, weights=weights / weights.sum(), logs=logs[:made], **known)

    def _rates(self, memory: Any, table: Table, predicted: Predicted) -> Rates:
        """What is to be expected of every candidate, and of sightings that none of them explains."""
        expected = table.expected
        false, frames = memory["false"]
        reach = predicted.max_range
        if not math.isfinite(reach):
            reach = max(float(table.sightings.values[:, 0].max(initial=1.0)), 1.0)
        depth = reach - predicted.min_range
        density = max(false / frames, _LEAST) / (depth * 2.0 * predicted.half_view)
        detection = np.empty(len(expected.indices))
        near, far = predicted.min_range, predicted.max_range
        view_shares(expected.z, expected.spreads, near, far, predicted.half_view, detection)
        learnt = np.array([seen / looked for seen, looked in memory["detected"]])
        rings = (expected.z[:, 0] / reach * _RINGS).astype(np.int64)
        detection *= np.clip(learnt, *_DETECTION)[np.minimum(rings, _RINGS - 1)]
        detection = np.clip(detection, 1.0 - SUREST, SUREST)
        odds = np.array([memory["odds"][i] for i in expected.indices.tolist()])
        seen = detection * np.asarray(probability(odds))
        missed = 1.0 - seen
        if len(seen) and self._hides(memory):
            missed[predicted.hidden(expected)] = 1.0
        return Rates(detection, odds, seen, missed, density, rings)
