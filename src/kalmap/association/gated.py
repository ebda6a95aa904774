"""What all associators that go by place share: region, gates, landmarks on trial, mergers, the reasons.

A frame is decided in two stages. First the associator's own rule gives sightings to confirmed landmarks. What
is left and lies near none of them goes one-to-one to landmarks on trial, and what lies near none of these
either founds one. So a landmark that nobody believes in yet takes nothing from one that is believed in.
"""

from __future__ import annotations

from bisect import bisect_left
from typing import Any, ClassVar

import msgspec
import numpy as np

from kalmap.association.ambiguity import ambiguous
from kalmap.association.associator import Expected, Predicted
from kalmap.association.attributes import Attribute, unknown
from kalmap.association.checks import check
from kalmap.association.local import Region
from kalmap.association.management import BuiltInManagement, Keep, Review, Verdict
from kalmap.association.merging import Merging, Suspicion
from kalmap.geometry.ellipses import chi_square
from kalmap.kernels import nearest as kernel
from kalmap.kernels.region import contested_by
from kalmap.records import NEW, Association, Managed, Reason, Sightings, Why

_WIDEST = 1e6  # m; no landmark is wider
_HIDING_PRIOR = 20.0  # landmarks behind something that are taken for unseen before any has been looked at


class Table(msgspec.Struct, frozen=True):
    """A frame against its candidates.

    sightings: the frame. expected: the candidates (C). trial: (C,) bool, those not confirmed yet. squared,
    normalised: (M, C) distance squared, and that plus ln det S; both with what the attributes add, `extra` (M,
    C). noises: (M, 2, 2) the sensor's. gate, new_gate: squared distances. in_view: (C,) bool, candidates in the
    sensor's field of view.
    """

    sightings: Sightings
    expected: Expected
    trial: np.ndarray
    squared: np.ndarray
    normalised: np.ndarray
    extra: np.ndarray
    noises: np.ndarray
    gate: float
    new_gate: float
    in_view: np.ndarray


class Matching(msgspec.Struct, frozen=True):
    """What a rule decided.

    columns: (M,) candidate or -1. reason: of those matched, one for all or (M,). lost: of those that had a
    candidate inside the gate and did not get it. notes: on the frame. squared, normalised: (M, C) if the rule
    moved the sightings.
    """

    columns: np.ndarray
    reason: Any = Reason.NEAREST
    lost: Reason = Reason.CONTEST_LOST
    notes: tuple[str, ...] = ()
    squared: np.ndarray | None = None
    normalised: np.ndarray | None = None


class Settling(msgspec.Struct, frozen=True):
    """What the memory takes in after a frame."""

    founded: int
    verdict: Verdict
    suspicion: Suspicion | None
    learned: tuple[tuple[int, int, float], ...]  # attribute, index, value
    seen: np.ndarray  # (C,) candidates that got a sighting
    should: np.ndarray  # (C,) candidates that should have
    hiding: tuple[float, float]  # landmarks behind something that were seen all the same, and all of them
    beliefs: Any = None  # an associator's own


class Gated(msgspec.Struct, frozen=True, kw_only=True):
    """An associator by place. gate: probability inside which a pair is possible. new_gate: probability beyond which,
    from every landmark, a sighting founds a new one; between the two it is left unused. extent: m, how far
    apart two sightings of the same landmark from different sides are beside the sensor's noise, as a standard
    deviation: the size of what is no point. It widens the gates, and mergers force no more than that. ambiguity:
    by how much the next best landmark must be worse in nu' S^-1 nu + ln det S, else a sighting is left unused;
    0: not asked. patience: frames after which a landmark still on trial is given up. management: here `Keep`, in `Djnn`
    `Counter`, in `Mda` `Trial`; a configuration that names none has `Existence`, but for djnn. merging: here none, in
    a configuration `Merging()`. The rest: see the classes.
    """

    gate: float = 0.999
    new_gate: float = 0.999999
    extent: float = 0.0
    ambiguity: float = 0.0
    patience: int = 100
    region: Region = Region()
    management: BuiltInManagement = Keep()
    merging: Merging | None = None
    attributes: tuple[Attribute, ...] = ()
    uses_ids: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for name in ("gate", "new_gate"):
            check(0.0 <= getattr(self, name) <= 1.0, name, "a probability", getattr(self, name))
        check(0.0 <= self.extent <= _WIDEST, "extent", f"0 to {_WIDEST:g} m", self.extent)
        check(self.ambiguity >= 0.0, "ambiguity", "0 or more", self.ambiguity)
        check(self.patience >= 1, "patience", "1 or more frames", self.patience)

    def start(self) -> Any:
        """Memory: a list of each thing known of the landmarks, by index, and what management and merging remember."""
        return {
            "confirmed": [],
            "score": [],
            "serial": [],
            "known": [[] for _ in self.attributes],
            "founded": 0,
            "hiding": [0.0, 0.0],
            "frames": 0,
            "waiting": [],
            "management": self.management.start(),
            "merging": {} if self.merging is None else self.merging.start(),
        }

    def fits(self, memory: Any, count: int) -> bool:
        """Whether every list has an entry for each of `count` landmarks."""
        return all(len(values) == count for values in self._lists(memory))

    def _lists(self, memory: Any) -> tuple[list[Any], ...]:
        """What the memory holds of each landmark, in the map's order: founded, removed and checked together."""
        return (memory["confirmed"], memory["score"], memory["serial"], *memory["known"])

    def existence(self, memory: Any) -> list[float]:
        """The probability that each landmark is real, as the management has it."""
        return [self.management.existence(score) for score in memory["score"]]

    def associate(self, memory: Any, sightings: Sightings, predicted: Predicted) -> Association:
        """Decide a frame. Raises EventError if an attribute that is to be used is not there."""
        table = self._table(memory, sightings, predicted)
        matching = self._match(table, predicted)
        doubtful = None
        if self.ambiguity > 0.0:
            doubtful = ambiguous(predicted, table, matching.columns, self.ambiguity)
        columns, fate = matching.columns.copy(), np.empty(len(sightings.values), dtype=np.int64)
        kernel.finish(
            table.squared if matching.squared is None else matching.squared,
            table.normalised if matching.normalised is None else matching.normalised,
            table.trial,
            table.gate,
            table.new_gate,
            columns,
            fate,
        )
        if doubtful is not None and doubtful.any():
            fate[doubtful] = kernel.DOUBTFUL
        return self._conclude(memory, table, matching, columns, fate, predicted)

    def _match(self, table: Table, predicted: Predicted) -> Matching:
        """The associator's own rule: which confirmed candidate each sighting gets."""
        raise NotImplementedError(f"{type(self).__name__} has no rule")

    def _table(self, memory: Any, sightings: Sightings, predicted: Predicted) -> Table:
        expected = predicted.expect(self.region.candidates(predicted)).widened(self.extent)
        squared, log_volume = predicted.distances(expected)
        confirmed = memory["confirmed"]
        extra = np.zeros_like(squared)
        for attribute, known in zip(self.attributes, memory["known"], strict=True):
            extra += attribute.cost(known, expected.indices, attribute.values(sightings))
        squared += extra
        degrees = 2 + sum(not attribute.classes for attribute in self.attributes)
        return Table(
            sightings=sightings,
            expected=expected,
            trial=~np.frombuffer(
                bytes(map(confirmed.__getitem__, expected.indices.tolist())), dtype=np.bool_
            ),
            squared=squared,
            normalised=squared + log_volume,
            extra=extra,
            noises=predicted.noises,
            gate=chi_square(self.gate, degrees),
            new_gate=chi_square(max(self.new_gate, self.gate), degrees),
            in_view=self.region.in_view(predicted, expected),
        )

    def _conclude(
        self,
        memory: Any,
        table: Table,
        matching: Matching,
        columns: np.ndarray,
        fate: np.ndarray,
        predicted: Predicted,
    ) -> Association:
        """Management, mergers and reasons once it is known who got what.

        columns: (M,) candidate of each sighting whose fate (M,) is MATCHED or TRIAL.
        """
        indices = table.expected.indices
        matched, seen = np.empty(len(fate), dtype=np.int64), np.empty(len(indices), dtype=np.bool_)
        founded = kernel.outcome(columns, fate, indices, matched, seen)
        hidden = table.in_view & predicted.hidden(table.expected)
        should = table.in_view & ~hidden if self._hides(memory) else table.in_view
        if (fate >= kernel.LOST).any():  # what an undecided sighting may have shown was not missed
            maybe = np.empty(len(indices), dtype=np.bool_)
            contested_by(table.squared, fate, kernel.LOST, table.gate, maybe)
            should = should & (seen | ~maybe)
        reach = self.region.reach(predicted)
        review = Review(indices, seen, should, ~table.trial, table.expected.z[:, 0], reach)
        verdict = self.management.review(memory["score"], memory["confirmed"], memory["management"], review)
        suspicion = None
        if self.merging is not None:
            sure = ~table.trial
            suspicion = self.merging.suspect(
                memory["merging"],
                memory["serial"],
                predicted,
                indices[sure],
                seen[sure],
                should[sure],
                self.extent,
            )
        merged: tuple[tuple[int, int], ...] = ()
        expired = self._expired(memory, verdict)
        retired = (*(index for index, _ in verdict.retired), *expired)
        if suspicion is not None and suspicion.merged:
            merged = tuple((keep, drop) for keep, drop, _ in suspicion.merged)
            paired = {index for pair in merged for index in pair}
            retired = tuple(index for index in retired if index not in paired)
        return Association(
            matched=matched,
            on_trial=self.management.tries,
            confirmed=tuple(index for index, _ in verdict.confirmed),
            retired=retired,
            merged=merged,
            change=Settling(
                founded,
                verdict,
                suspicion,
                self._learned(table.sightings, matched),
                seen,
                should,
                _hiding(hidden, seen, table.trial),
            ),
            why=_explain(table, matching, fate, verdict, retired, suspicion) if predicted.explain else None,
        )

    def _hides(self, memory: Any) -> bool:
        """Whether this sensor's landmarks hide each other: learned, as bar codes under a ceiling do not and trunks do.

        From how many landmarks behind something were seen all the same, and how many were behind something.
        """
        seen, behind = memory["hiding"]
        return bool(seen <= 0.3 * (behind + _HIDING_PRIOR))

    def _expired(self, memory: Any, verdict: Verdict) -> tuple[int, ...]:
        """Landmarks that have been on trial for too long, out of view as a rule: nobody would ever retire them."""
        expired: list[int] = []
        decided = {index for index, _ in (*verdict.retired, *verdict.confirmed)}
        for serial, born in memory["waiting"]:
            if memory["frames"] - born <= self.patience:
                break
            index = bisect_left(
                memory["serial"], serial
            )  # serials ascend: landmarks are appended and removed
            there = index < len(memory["serial"]) and memory["serial"][index] == serial
            if there and not memory["confirmed"][index] and index not in decided:
                expired.append(index)
        return tuple(expired)

    def _learned(self, sightings: Sightings, matched: np.ndarray) -> tuple[tuple[int, int, float], ...]:
        """Attribute values for landmarks; those that the frame founds count on from the map's end (index -1 - k)."""
        learned: list[tuple[int, int, float]] = []
        for number, attribute in enumerate(self.attributes):
            fresh = 0
            for index, value in zip(matched.tolist(), attribute.values(sightings).tolist(), strict=True):
                if index == NEW:
                    learned.append((number, -1 - fresh, value))
                    fresh += 1
                elif index >= 0:
                    learned.append((number, index, value))
        return tuple(learned)

    def settle(self, memory: Any, association: Association) -> None:
        """Bring the memory up to a decision that the filter has carried out."""
        change: Settling = association.change
        count = len(memory["score"])
        for _ in range(change.founded):
            memory["confirmed"].append(not self.management.tries)
            memory["score"].append(self.management.first_score)
            memory["serial"].append(memory["founded"])
            if self.management.tries:
                memory["waiting"].append([memory["founded"], memory["frames"]])
            memory["founded"] += 1
            for known in memory["known"]:
                known.append(unknown())
        for number, index, value in change.learned:
            self.attributes[number].learn(
                memory["known"][number], index if index >= 0 else count - 1 - index, value
            )
        for index, score in change.verdict.scores:
            memory["score"][index] = score
        for index in association.confirmed:
            memory["confirmed"][index] = True
        self.management.settle(memory["management"], change.verdict.extra)
        while memory["waiting"] and memory["frames"] - memory["waiting"][0][1] > self.patience:
            memory["waiting"].pop(0)
        memory["frames"] += 1
        memory["hiding"][0] += change.hiding[0]
        memory["hiding"][1] += change.hiding[1]
        if self.merging is not None and change.suspicion is not None:
            self.merging.settle(memory["merging"], change.suspicion, memory["serial"])
        for keep, drop in association.merged:
            memory["score"][keep] = max(memory["score"][keep], memory["score"][drop])
            for attribute, known in zip(self.attributes, memory["known"], strict=True):
                attribute.pool(known, keep, drop)
        removed = {*association.retired, *(drop for _, drop in association.merged)}
        for index in sorted(removed, reverse=True):
            for values in self._lists(memory):
                del values[index]


def _hiding(hidden: np.ndarray, seen: np.ndarray, trial: np.ndarray) -> tuple[float, float]:
    """How many believed landmarks behind something were seen all the same, and how many there were."""
    if not hidden.any():
        return 0.0, 0.0
    hidden = hidden & ~trial
    return float((seen & hidden).sum()), float(hidden.sum())


def _explain(
    table: Table,
    matching: Matching,
    fate: np.ndarray,
    verdict: Verdict,
    retired: tuple[int, ...],
    suspicion: Suspicion | None,
) -> Why:
    """The reasons in a form that can be kept: every pair within the wider gate, or three times the gate."""
    by_fate = np.array(
        [
            0,
            Reason.NEAREST,
            Reason.FOUNDED,
            matching.lost,
            Reason.BETWEEN_GATES,
            Reason.AMBIGUOUS,
            Reason.CONTEST_LOST,
        ],
        dtype=np.int64,
    )
    rows, columns = np.nonzero(table.squared < max(table.new_gate, 3.0 * table.gate))
    indices = table.expected.indices
    squared = table.squared[rows, columns]
    managed = [Managed(index, "confirmed", why) for index, why in verdict.confirmed]
    reasons = dict(verdict.retired)
    managed += [Managed(index, "retired", reasons.get(index, "on trial for too long")) for index in retired]
    if suspicion is not None:
        managed += [
            Managed(drop, "merged", f"log odds {odds:.1f} of {len(suspicion.merged)} pairs", keep)
            for keep, drop, odds in suspicion.merged
        ]
    return Why(
        gate=table.gate,
        new_gate=table.new_gate,
        reasons=np.where(fate == kernel.MATCHED, matching.reason, by_fate[fate]),
        pairs=np.stack([rows, indices[columns]], axis=1),
        squared=squared,
        log_volume=table.normalised[rows, columns] - squared,
        notes=matching.notes,
        managed=tuple(managed),
    )
