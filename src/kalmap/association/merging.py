"""Landmarks that are one and the same: found by joint compatibility, singly or several pairs at once.

Who was lost for a while maps anew what is mapped already. Each pair alone may be a coincidence while the robot
is unsure of its place; several pairs that fit together, after the first has taken the common error away, are
none.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np

from kalmap.association.associator import Predicted
from kalmap.association.checks import check
from kalmap.geometry.ellipses import chi_square_2
from kalmap.kernels.region import near_pairs

_MOST_PAIRS = 32  # looked at together
_EVERY = 5  # frames from one look for sets of pairs to the next
_CLOCK = "frames"


class Suspicion(msgspec.Struct, frozen=True):
    """What a frame says about pairs of landmarks, by lasting number (a < b).

    apart: pairs seen together by two sightings: two things. alike: pairs of which one was seen and the other,
    though it should have been, was not. merged: (kept, dropped, log odds) by index: pairs whose evidence is
    complete.
    """

    apart: tuple[tuple[int, int], ...] = ()
    alike: tuple[tuple[int, int], ...] = ()
    merged: tuple[tuple[int, int, float], ...] = ()


class Merging(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When landmarks become one by the noise-free constraint that they are the same point.

    A set of k pairs is judged by the log of its odds: the density of their differences by their joint
    covariance if they are the same, N(0; d, S), against k landmarks that stand where they stand by chance, at
    the density of the map. Every frame in which one of a pair was seen while the other should have been and was
    not adds `unseen`, up to `frames` of them; one frame that sees both parts them for ever.

    gate: probability inside which the difference of a single pair must lie. odds: log odds from which a set is
    merged, and by which it must beat every other set that contradicts it. radius: m, pairs farther apart are
    not looked at.
    """

    gate: float = 0.99
    odds: float = 7.0
    unseen: float = 1.5
    frames: int = 3
    radius: float = 10.0

    def __post_init__(self) -> None:
        check(0.0 <= self.gate < 1.0, "merging.gate", "a probability below 1", self.gate)
        for name in ("odds", "unseen", "frames", "radius"):
            value = getattr(self, name)
            check(0.0 <= value < math.inf, f"merging.{name}", "0 or more", value)

    def start(self) -> Any:
        """Memory: pairs "a b" of lasting numbers -> frames that speak for them being one, or -1 if they are two."""
        return {}

    def suspect(
        self,
        memory: Any,
        serials: list[int],
        predicted: Predicted,
        indices: np.ndarray,
        seen: np.ndarray,
        expected: np.ndarray,
        extent: float,
    ) -> Suspicion:
        """Look at the landmarks (K,) of a frame: which were seen, which should have been. extent: m, see `Gated`."""
        first, second = self._pairs(predicted, indices, seen)
        if not len(first):
            return Suspicion()
        squared = predicted.separations(indices[first], indices[second], extent)
        close = np.flatnonzero(squared < chi_square_2(self.gate))
        close = close[np.argsort(squared[close], kind="stable")[:_MOST_PAIRS]]
        apart, alike, open_pairs, evidence = [], [], [], []
        for k in close.tolist():
            one, other = int(first[k]), int(second[k])
            pair = _ordered(serials[indices[one]], serials[indices[other]])
            known = memory.get(_key(pair), 0)
            if known < 0:
                continue
            if seen[one] and seen[other]:
                apart.append(pair)
                continue
            if (seen[one] and expected[other]) or (seen[other] and expected[one]):
                alike.append(pair)
                known += 1
            open_pairs.append((one, other))
            evidence.append(self.unseen * min(known, self.frames))
        merged: tuple[tuple[int, int, float], ...] = ()
        if open_pairs and memory.get(_CLOCK, 0) % _EVERY == 0:
            density = len(indices) / (predicted.half_view * self._reach(predicted, indices) ** 2)
            chosen, odds = self._best_set(
                predicted, indices, np.array(open_pairs), np.array(evidence), density, extent
            )
            merged = tuple(
                (*_older_first(serials, int(indices[one]), int(indices[other])), odds)
                for one, other in chosen
            )
        return Suspicion(tuple(apart), tuple(alike), merged)

    def _pairs(
        self, predicted: Predicted, indices: np.ndarray, seen: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Places of near pairs."""
        if not seen.any():
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        return near_pairs(predicted.positions(indices), self.radius)

    def _reach(self, predicted: Predicted, indices: np.ndarray) -> float:
        """How far the sensor sees, m; one without limit as far as the farthest of the landmarks."""
        if math.isfinite(predicted.max_range):
            return predicted.max_range
        gap = predicted.positions(indices) - np.array(predicted.sensor_pose[:2])
        return max(self.radius, math.sqrt(float((gap**2).sum(axis=1).max())))

    def _best_set(
        self,
        predicted: Predicted,
        indices: np.ndarray,
        pairs: np.ndarray,
        evidence: np.ndarray,
        density: float,
        extent: float,
    ) -> tuple[list[tuple[int, int]], float]:
        """The set of pairs of greatest log odds, if they suffice and no contradicting set comes near; else none."""
        landmarks = np.unique(pairs)
        places = np.searchsorted(landmarks, pairs)
        mean, covariance = predicted.joint(indices[landmarks])
        difference, spread = _differences(mean, covariance, places, extent)
        chance = math.log(2.0 * math.pi * density)
        found: dict[tuple[int, ...], float] = {}
        for seed in range(len(pairs)):
            members, odds = _grow(seed, difference, spread, pairs, evidence, chance)
            found[members] = odds
        best = max(found, key=lambda members: found[members])
        rival = max(
            (odds for members, odds in found.items() if _contradicts(members, best, pairs)), default=0.0
        )
        if found[best] < self.odds or found[best] - max(rival, 0.0) < self.odds:
            return [], found[best]
        return [(int(pairs[k, 0]), int(pairs[k, 1])) for k in best], found[best]

    def settle(self, memory: Any, suspicion: Suspicion, serials: list[int]) -> None:
        """Count the frame and its evidence. serials: lasting numbers, those of merged landmarks still among them."""
        memory[_CLOCK] = memory.get(_CLOCK, 0) + 1
        for pair in suspicion.apart:
            memory[_key(pair)] = -1
        for pair in suspicion.alike:
            memory[_key(pair)] = memory.get(_key(pair), 0) + 1
        for keep, drop, _ in suspicion.merged:
            _inherit(memory, serials[keep], serials[drop])


def _differences(
    mean: np.ndarray, covariance: np.ndarray, places: np.ndarray, extent: float
) -> tuple[np.ndarray, np.ndarray]:
    """(K, 2) differences of the pairs and their joint covariance (2 K, 2 K), 2 extent^2 added for each pair."""
    count = len(places)
    chooser = np.zeros((2 * count, len(mean)))
    for k, (one, other) in enumerate(places.tolist()):
        for c in range(2):
            chooser[2 * k + c, 2 * one + c] = 1.0
            chooser[2 * k + c, 2 * other + c] = -1.0
    spread = chooser @ covariance @ chooser.T
    spread[np.diag_indices(2 * count)] += (
        2.0 * extent**2 + 1e-9
    )  # a tenth of a millimetre: two that were merged already
    return (chooser @ mean).reshape(count, 2), spread


def _grow(
    seed: int,
    difference: np.ndarray,
    spread: np.ndarray,
    pairs: np.ndarray,
    evidence: np.ndarray,
    chance: float,
) -> tuple[tuple[int, ...], float]:
    """Add to a first pair whichever raises the log odds most, given those before it, for as long as one does."""
    difference, spread = difference.copy(), spread.copy()
    free = np.ones(len(pairs), dtype=np.bool_)
    members: list[int] = []
    total, gain, best = 0.0, _gains(difference, spread, evidence, chance), seed
    while True:
        total += float(gain[best])
        members.append(best)
        free &= ~np.isin(pairs, pairs[best]).any(axis=1)
        if not free.any():
            break
        rows = slice(2 * best, 2 * best + 2)
        lever = np.linalg.solve(spread[rows, rows], spread[rows]).T
        difference = difference - (lever @ difference[best]).reshape(-1, 2)
        spread = spread - lever @ spread[rows]
        gain = np.where(free, _gains(difference, spread, evidence, chance), -np.inf)
        best = int(gain.argmax())
        if gain[best] <= 0.0:
            break
    return tuple(sorted(members)), total


def _gains(difference: np.ndarray, spread: np.ndarray, evidence: np.ndarray, chance: float) -> np.ndarray:
    """(K,) log odds of each pair by itself: ln N(d; 0, S) - ln density + evidence; -inf where S has no inverse."""
    at = 2 * np.arange(len(difference))
    a, b, c = spread[at, at], spread[at, at + 1], spread[at + 1, at + 1]
    determinant = a * c - b * b
    good = (determinant > 0.0) & (a > 0.0)
    safe = np.where(good, determinant, 1.0)
    dx, dy = difference.T
    squared = (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / safe
    return np.where(good, -0.5 * (squared + np.log(safe)) - chance + evidence, -np.inf)


def _contradicts(members: tuple[int, ...], best: tuple[int, ...], pairs: np.ndarray) -> bool:
    """Whether two sets of pairs cannot both be true: one gives a landmark to another partner than the other does."""
    extra = set(members) - set(best)
    landmarks = set(pairs[list(best)].ravel().tolist())
    return any(not landmarks.isdisjoint(pairs[k].tolist()) for k in extra)


def _inherit(memory: Any, keep: int, drop: int) -> None:
    """Forget a landmark that is another; who was seen together with it was seen together with the other."""
    for key in [key for key in memory if key != _CLOCK]:
        pair = tuple(map(int, key.split()))
        if drop in pair:
            other = pair[0] if pair[1] == drop else pair[1]
            if memory.pop(key) < 0 and other != keep:
                memory[_key(_ordered(keep, other))] = -1


def _older_first(serials: list[int], one: int, other: int) -> tuple[int, int]:
    return (one, other) if serials[one] < serials[other] else (other, one)


def _ordered(one: int, other: int) -> tuple[int, int]:
    return (one, other) if one < other else (other, one)


def _key(pair: tuple[int, int]) -> str:
    return f"{pair[0]} {pair[1]}"
