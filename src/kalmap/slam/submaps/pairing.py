"""Which landmarks of two consecutive maps are the same, by place: randomised joint compatibility.

Paz, Tardos & Neira 2008, section IV: a few random landmarks of the second map are paired by branch and bound; what
that says about how the maps lie decides the others, nearest first; the best of several tries counts.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.gaussian.roots import NotPositiveError
from kalmap.geometry.ellipses import chi_square
from kalmap.geometry.se2 import quarter_turn, rotate
from kalmap.slam.submaps.local_map import LocalMap
from kalmap.slam.submaps.recovery import Recovery

Pairs = list[tuple[int, int]]


class Overlap(msgspec.Struct, eq=False):
    """Landmarks of two maps that may be the same, both as seen from where the second begins.

    rows, others: of the first (R) and of the second (S). places (R, 2), spread (2 R, 2 R): of the first's, the
    uncertainty of that pose in it; targets (S, 2), own (2 S, 2 S): of the second's. area: m^2 that they cover.
    """

    rows: np.ndarray
    others: np.ndarray
    places: np.ndarray
    spread: np.ndarray
    targets: np.ndarray
    own: np.ndarray

    @property
    def area(self) -> float:
        sides = np.ptp(self.places, axis=0) + 1.0
        return float(sides[0] * sides[1])

    def innovation(self, pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
        """(2 k,) differences of pairs (place in rows, place in others) and their joint covariance."""
        index = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        difference = (self.places[index[:, 0]] - self.targets[index[:, 1]]).ravel()
        a, b = (_entries(column) for column in index.T)
        return difference, self.spread[np.ix_(a, a)] + self.own[np.ix_(b, b)]

    def distance(self, pairs: Pairs) -> float:
        """Joint Mahalanobis distance squared."""
        difference, covariance = self.innovation(pairs)
        return float(difference @ _solved(covariance, difference))

    def distances(self, candidates: np.ndarray, given: Pairs) -> np.ndarray:
        """(C,) squared Mahalanobis distances of candidate pairs (C, 2), each by itself, once `given` are true."""
        difference = self.places[candidates[:, 0]] - self.targets[candidates[:, 1]]
        a, b = (2 * column[:, None] + np.arange(2) for column in candidates.T)
        covariance = self.spread[a[:, :, None], a[:, None, :]] + self.own[b[:, :, None], b[:, None, :]]
        if given:
            known, between = self.innovation(given)
            index = np.array(given, dtype=np.int64)
            i, j = (_entries(column) for column in index.T)
            cross = self.spread[a[:, :, None], i] + self.own[b[:, :, None], j]  # (C, 2, 2 k)
            gain = _solved(between, cross.reshape(-1, len(known)).T).T.reshape(cross.shape)
            difference = difference - gain @ known
            covariance = covariance - gain @ cross.transpose(0, 2, 1)
        inverse = _inverse_2(covariance)
        return np.einsum("ci,cij,cj->c", difference, inverse, difference)

    def window(self, place: int, other: int, given: Pairs) -> float:
        """Root of the determinant of one candidate's covariance once `given` are true, m^2."""
        a, b = _entries(np.array([place])), _entries(np.array([other]))
        covariance = self.spread[np.ix_(a, a)] + self.own[np.ix_(b, b)]
        if given:
            _, between = self.innovation(given)
            i, j = (_entries(column) for column in np.array(given, dtype=np.int64).T)
            cross = self.spread[np.ix_(a, i)] + self.own[np.ix_(b, j)]
            covariance = covariance - cross @ _solved(between, cross.T)
        return math.sqrt(max(float(np.linalg.det(covariance)), 0.0))


class ByPlace(msgspec.Struct, frozen=True):
    """Randomised joint compatibility between two consecutive maps.

    gate, joint_gate: probabilities of the individual and of the joint test. drawn: landmarks that a try begins with.
    good: share of them that truly are in both maps, at least; wrong: how likely all tries may miss. chance: how likely
    so many pairs may be by accident; above it the maps are not joined yet. seed: of the draws.
    """

    gate: float = 0.999
    joint_gate: float = 0.999
    drawn: int = 4
    good: float = 0.6
    wrong: float = 1e-3
    chance: float = 1e-3
    seed: int = 1

    def __call__(self, first: LocalMap, second: LocalMap) -> np.ndarray | None:
        """(M, 2) int64 rows; no row where the maps do not overlap; None where it is in doubt which pairs are right."""
        overlap = overlap_of(first, second)
        if overlap is None:
            return np.zeros((0, 2), dtype=np.int64)
        pairs = self.pairs(overlap)
        if pairs is None:
            return None
        index = np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
        return np.column_stack([overlap.rows[index[:, 0]], overlap.others[index[:, 1]]])

    def pairs(self, overlap: Overlap) -> Pairs | None:
        """Pairs of places in the overlap."""
        every = np.indices((len(overlap.rows), len(overlap.others))).reshape(2, -1).T
        candidates = every[overlap.distances(every, []) <= chi_square(self.gate, 2)]
        if not len(candidates):
            return []
        best = self._best(overlap, candidates)
        doubtful = len(candidates) > len(np.unique(candidates[:, 1]))
        if doubtful and best and self._by_chance(overlap, best, candidates) > self.chance:
            return None
        return best

    def _best(self, overlap: Overlap, candidates: np.ndarray) -> Pairs:
        """The best of as many tries as make a miss unlikely, judged by the share of pairs found so far."""
        rng = np.random.default_rng(self.seed)
        others = np.unique(candidates[:, 1])
        drawn = min(self.drawn, len(others))
        best: Pairs = []
        least, done, tries = math.inf, 0, 1.0
        while done < tries:
            some = rng.choice(others, drawn, replace=False)
            found = self.extended(overlap, self._searched(overlap, candidates, some), candidates)
            distance = overlap.distance(found) if found else math.inf
            if (-len(found), distance) < (-len(best), least):
                best, least = found, distance
            done += 1
            if len(others) > drawn:
                share = min(max(self.good, len(best) / len(others)), 0.99)
                tries = math.log(self.wrong) / math.log1p(-(share**drawn))
        return best

    def _searched(self, overlap: Overlap, candidates: np.ndarray, some: np.ndarray) -> Pairs:
        """The largest jointly compatible set for a few landmarks of the second map, by branch and bound."""
        options = [candidates[candidates[:, 1] == other, 0].tolist() for other in some]
        best: tuple[int, float, Pairs] = (0, 0.0, [])

        def deeper(level: int, pairs: Pairs, distance: float) -> None:
            nonlocal best
            if (-len(pairs), distance) < (-best[0], best[1]):
                best = len(pairs), distance, pairs
            if level == len(some) or len(pairs) + len(some) - level < best[0]:
                return
            taken = {row for row, _ in pairs}
            for row in options[level]:
                if row not in taken:
                    more = [*pairs, (row, int(some[level]))]
                    further = overlap.distance(more)
                    if further <= chi_square(self.joint_gate, 2 * len(more)):
                        deeper(level + 1, more, further)
            deeper(level + 1, pairs, distance)

        deeper(0, [], 0.0)
        return best[2]

    def extended(self, overlap: Overlap, pairs: Pairs, candidates: np.ndarray) -> Pairs:
        """Add what is nearest given the pairs before it, as many again at a time, while the whole stays compatible."""
        if not pairs:
            return []
        gate = chi_square(self.gate, 2)
        left = candidates
        while True:
            taken = np.array(pairs)
            left = left[~np.isin(left[:, 0], taken[:, 0]) & ~np.isin(left[:, 1], taken[:, 1])]
            if not len(left):
                return pairs
            near = overlap.distances(left, pairs)
            left, near = left[near <= gate], near[near <= gate]
            if not len(left):
                return pairs
            nearest = _one_to_one(left[np.argsort(near, kind="stable")])
            for more in (pairs + nearest[: len(pairs)], pairs + nearest[:1]):
                if overlap.distance(more) <= chi_square(self.joint_gate, 2 * len(more)):
                    break
            else:
                return pairs
            pairs = more

    def _by_chance(self, overlap: Overlap, pairs: Pairs, candidates: np.ndarray) -> float:
        """How likely it is that unrelated landmarks give as many pairs, in any of the ways that two could be chosen.

        Two pairs fix how the maps lie; each other landmark then hits one by accident with a chance that its window and
        how dense the landmarks are tell; the number of hits is Poisson's.
        """
        if len(pairs) < 3:
            return 1.0
        given = pairs[:2]
        density = len(overlap.rows) / overlap.area
        windows = [overlap.window(row, other, given) for row, other in pairs[2:]]
        each = min(1.0, density * math.pi * chi_square(self.gate, 2) * float(np.mean(windows)))
        unlucky = poisson_tail(len(pairs) - 2, each * max(len(overlap.others) - 2, 1))
        ways = max(1.0, (len(candidates) / len(np.unique(candidates[:, 1]))) ** 2)
        return min(1.0, ways * unlucky)


def _one_to_one(ordered: np.ndarray) -> Pairs:
    """Of pairs (C, 2) in order of preference those whose both ends are still free."""
    rows, others, kept = set[int](), set[int](), []
    for row, other in ordered.tolist():
        if row not in rows and other not in others:
            kept.append((row, other))
            rows.add(row)
            others.add(other)
    return kept


def poisson_tail(least: int, mean: float) -> float:
    """Probability of `least` or more where `mean` are expected."""
    from scipy.special import gammainc

    return 1.0 if least <= 0 else float(gammainc(least, mean))


def overlap_of(first: LocalMap, second: LocalMap) -> Overlap | None:
    """The landmarks of both maps that are near each other given all uncertainty; None where there are none."""
    if not len(first) or not len(second):
        return None
    from scipy.spatial import cKDTree

    places = rotate(-first.end[2], first.landmarks - first.end[:2])
    own = second.dense() if second.covariance is not None else None
    reach = _reach(first, second, own)
    near = cKDTree(places).query_ball_point(second.landmarks, reach)
    others = np.array([j for j, found in enumerate(near) if found], dtype=np.int64)
    if not len(others):
        return None
    rows = np.unique(np.concatenate([np.array(near[j], dtype=np.int64) for j in others]))
    joint = _block(first, rows)
    to_places = _seen_from_end(first, rows, places[rows])
    return Overlap(
        rows=rows,
        others=others,
        places=places[rows],
        spread=to_places @ joint @ to_places.T,
        targets=second.landmarks[others],
        own=_block(second, others)[3:, 3:],
    )


def _reach(first: LocalMap, second: LocalMap, own: np.ndarray | None) -> np.ndarray:
    """(S,) m within which the second's landmarks may have their like, seen from where it begins."""
    lever = np.linalg.norm(second.landmarks, axis=1)
    end = first.end_covariance
    variance = np.linalg.eigvalsh(end[:2, :2])[-1] + lever**2 * end[2, 2]
    if own is not None:
        diagonal = np.diagonal(own)[3 * len(second.frames) + 3 :].reshape(-1, 2)
        variance = variance + diagonal.sum(axis=1)
    return 5.0 * np.sqrt(variance) + 3.0


def _block(map_: LocalMap, rows: np.ndarray) -> np.ndarray:
    """(3 + 2 R, the same) joint covariance of the end and some landmarks."""
    if map_.covariance is None:
        return Recovery(map_).joint(np.array([len(map_.frames)]), rows)
    first = 3 * len(map_.frames)
    entries = np.concatenate([first + np.arange(3), first + 3 + _entries(rows)])
    return map_.covariance[np.ix_(entries, entries)]


def _seen_from_end(first: LocalMap, rows: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(2 R, 3 + 2 R): how landmarks as seen from the end change with the end and with themselves."""
    c, s = np.cos(first.end[2]), np.sin(first.end[2])
    back = np.array([[c, s], [-s, c]])
    count = len(rows)
    matrix = np.zeros((2 * count, 3 + 2 * count))
    matrix[:, :2] = np.tile(-back, (count, 1))
    matrix[:, 2] = -quarter_turn(places).ravel()
    for place in range(count):
        matrix[2 * place : 2 * place + 2, 3 + 2 * place : 5 + 2 * place] = back
    return matrix


def _entries(rows: np.ndarray) -> np.ndarray:
    return (2 * rows[:, None] + np.arange(2)).ravel()


def _solved(covariance: np.ndarray, right: np.ndarray) -> np.ndarray:
    from scipy.linalg import cho_factor, cho_solve

    try:
        return cho_solve(cho_factor(covariance, check_finite=False), right, check_finite=False)
    except np.linalg.LinAlgError as problem:
        raise NotPositiveError(
            "the innovation covariance of some pairs is not positive definite"
        ) from problem


def _inverse_2(matrices: np.ndarray) -> np.ndarray:
    a, b, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    determinant = a * d - b * b
    if not (determinant > 0.0).all():
        raise NotPositiveError("the innovation covariance of a pair is not positive definite")
    adjugate = np.stack([np.stack([d, -b], -1), np.stack([-b, a], -1)], -2)
    return adjugate / determinant[:, None, None]
