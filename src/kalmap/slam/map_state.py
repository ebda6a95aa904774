"""What taking a frame changes: the belief, and what is known of every landmark in it."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from kalmap.association import Associator
from kalmap.gaussian import Belief
from kalmap.records import NEW, SPURIOUS, Association, Frame, Managed, Sightings
from kalmap.slam.engines import Engine
from kalmap.slam.region import LandmarkIndex


class MapRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A `MapState` at one moment, on its own: O(n^2), as much as an update. memory: the associator's, in msgpack."""

    belief: Belief
    memory: bytes
    ids: list[int]
    counts: list[int]
    on_trial: list[int]
    founded: int
    merged: dict[int, int]
    rejected: list[int]
    frames: int


class MapState:
    """The belief, the landmarks' lasting numbers and counts, and the associator's memory, always in step.

    merged: lasting number of each landmark that was merged away -> of the one it went into. rejected: numbers of
    landmarks that were removed before they were ever confirmed.
    """

    def __init__(self, engine: Engine, belief: Belief, association: Associator) -> None:
        self.association = association
        self._engine, self._belief, self._index = engine, belief, LandmarkIndex()
        self._memory: Any = association.start()
        self._ids: list[int] = []
        self._counts: list[int] = []
        self._on_trial: set[int] = set()  # lasting numbers of landmarks that are not confirmed yet
        self._founded = 0
        self._frames = 0
        self.merged: dict[int, int] = {}
        self.rejected: set[int] = set()

    @property
    def on_trial(self) -> set[int]:
        """Lasting numbers of the landmarks that are not confirmed yet; a copy."""
        return set(self._on_trial)

    def snapshot(self) -> MapRecord:
        """Everything, copied."""
        return MapRecord(
            copy_belief(self._belief),
            msgspec.msgpack.encode(self._memory),
            self._ids.copy(),
            self._counts.copy(),
            sorted(self._on_trial),
            self._founded,
            self.merged.copy(),
            sorted(self.rejected),
            self._frames,
        )

    def restore(self, record: MapRecord) -> None:
        """Be again what a record says, to the last bit. The record can be used again."""
        self._belief = copy_belief(record.belief)
        self._memory = msgspec.msgpack.decode(record.memory)
        self._ids, self._counts = record.ids.copy(), record.counts.copy()
        self._on_trial, self._founded = set(record.on_trial), record.founded
        self.merged, self.rejected = record.merged.copy(), set(record.rejected)
        self._frames = record.frames
        self._index.clear()

    # --- one frame, step by step ------------------------------------------------------------------------------

    def _apply(self, frame: Sightings, noises: np.ndarray, association: Association) -> tuple[float, int]:
        """Update with what was matched and found what is new. Returns the NIS and how many sightings it is of."""
        z, matched, count = frame.values, association.matched.tolist(), len(self._ids)
        held = self._on_trial.difference(self._ids[index] for index in association.confirmed)
        old = [m for m, index in enumerate(matched) if 0 <= index < count]
        used = [m for m in old if self._ids[matched[m]] not in held] if held else old
        nis = self._correct(z, matched, used, noises) if used else float("nan")
        for m in old:
            self._counts[matched[m]] += 1
        fresh = [m for m, index in enumerate(matched) if index == NEW]
        if fresh:
            self._engine.append(self._belief, *_pick(z, fresh), *_pick(noises, fresh))
            for m in fresh:
                known = self.association.uses_ids and frame.ids is not None
                self._ids.append(int(frame.ids[m]) if known else self._founded)  # type: ignore[index]
                self._counts.append(1)
                if association.on_trial:
                    self._on_trial.add(self._ids[-1])
                self._founded += 1
        again = [m for m, index in enumerate(matched) if index >= count]
        if again:  # seen twice in the frame that founds it
            self._correct(z, matched, again, noises)
            for m in again:
                self._counts[matched[m]] += 1
        return nis, len(used)

    def _correct(self, z: np.ndarray, matched: list[int], used: list[int], noises: np.ndarray) -> float:
        """Apply matched sightings, and tell the index how far that moved the map. Returns the NIS."""
        belief = self._belief
        indices = np.array([belief.robot + 2 * matched[m] for m in used], dtype=np.int64)
        before = self._filed().copy()
        nis = self._engine.update(belief, *_pick(z, used), indices, *_pick(noises, used))
        self._index.moved(_furthest(before, self._filed()))
        return nis

    def _filed(self) -> np.ndarray:
        """x, y, x, y, ... m of the landmarks whose moves the index has to be told of."""
        belief = self._belief
        return belief.mean[belief.robot : belief.robot + 2 * self._index.filed]

    def _settle(self, association: Association) -> None:
        """Bring the associator's memory up to the frame, and believe whom it believes now."""
        self.association.settle(self._memory, association)
        for index in association.confirmed:
            self._on_trial.discard(self._ids[index])

    def _tidy(self, association: Association) -> None:
        """Merge and remove: the frame is done."""
        for keep, drop in association.merged:
            self._merge(keep, drop)
        gone = {*association.retired, *(drop for _, drop in association.merged)}
        for index in sorted(gone, reverse=True):
            self._remove(index)
        self._frames += 1

    def _merge(self, keep: int, drop: int) -> None:
        """Two landmarks become one: what was known of each is known of it."""
        belief = self._belief
        before = self._filed().copy()
        extent = getattr(self.association, "extent", 0.0)
        self._engine.merge(belief, belief.robot + 2 * keep, belief.robot + 2 * drop, extent)
        self._index.moved(_furthest(before, self._filed()))
        self._counts[keep] += self._counts[drop]
        self.merged[self._ids[drop]] = self._ids[keep]

    def _remove(self, index: int) -> None:
        self._belief.remove(self._belief.robot + 2 * index, 2)
        self._index.removed(index)
        if self._ids[index] in self._on_trial:
            self.rejected.add(self._ids[index])
        self._on_trial.discard(self._ids[index])
        del self._ids[index], self._counts[index]

    # --- numbers that last ------------------------------------------------------------------------------------

    def _labels_of(self, matched: np.ndarray) -> np.ndarray:
        """(M,) lasting numbers of what a frame that has just been applied was matched with, SPURIOUS where unused."""
        labels = matched.copy()
        fresh = len(self._ids) - int((matched == NEW).sum())
        for m, index in enumerate(matched.tolist()):
            if index == NEW:
                labels[m] = self._ids[fresh]
                fresh += 1
            elif index >= 0:
                labels[m] = self._ids[index]
        return labels

    def _decision(self, association: Association, labels: np.ndarray, before: Frame) -> Frame:
        """The frame's entry in the audit trail: `before` with what became of the sightings."""
        assert association.why is not None
        founded = tuple(
            Managed(label, "founded", f"by sighting {m}")
            for m, (label, index) in enumerate(zip(labels.tolist(), association.matched.tolist()))
            if index == NEW
        )
        managed = tuple(
            Managed(
                self._ids[entry.landmark],
                entry.action,
                entry.why,
                -1 if entry.into < 0 else self._ids[entry.into],
            )
            for entry in association.why.managed
        )
        return msgspec.structs.replace(
            before,
            number=self._frames,
            labels=labels.copy(),
            trial=np.array([label in self._on_trial for label in labels.tolist()], dtype=np.bool_),
            why=msgspec.structs.replace(before.why, managed=founded + managed),
        )

    def last_number(self, number: int) -> int:
        """The lasting number of what a landmark has become by mergers."""
        while number in self.merged:
            number = self.merged[number]
        return number

    def settled_labels(self, labels: np.ndarray) -> np.ndarray:
        """Labels given during the run as the map has them now: mergers followed, landmarks never confirmed left out."""
        settled = labels.copy()
        for number in np.unique(labels[labels >= 0]).tolist():
            last = self.last_number(number)
            if last in self.rejected or last in self._on_trial:
                last = SPURIOUS
            if last != number:
                settled[labels == number] = last
        return settled


def copy_belief(belief: Belief) -> Belief:
    """A belief of its own with the same numbers."""
    twin = Belief(belief.mean[: belief.robot], np.zeros((belief.robot, belief.robot)))
    n = belief.n
    twin.reserve(n)
    twin.mean[:n] = belief.mean[:n]
    twin.packed[: n * (n + 1) // 2] = belief.packed[: n * (n + 1) // 2]
    twin.n, twin.pending = n, belief.pending
    twin.phi[:] = belief.phi
    return twin


def _furthest(before: np.ndarray, after: np.ndarray) -> float:
    """An upper bound on how far (m) any point of two lists of x, y, x, y, ... has moved."""
    return 1.5 * float(np.abs(after - before).max(initial=0.0))


def _pick(rows: np.ndarray, chosen: list[int]) -> tuple[np.ndarray]:
    """The chosen rows, without a copy when they are all."""
    return (rows,) if len(chosen) == len(rows) else (rows[chosen],)
