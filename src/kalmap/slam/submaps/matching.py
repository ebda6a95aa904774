"""Two finished landmark maps of one place, how they lie to each other unknown: found by the shapes that landmarks form.

Candidate alignments come from pairs of landmarks that are as far apart in one map as in the other, and vote; the best
are verified with the maps' full covariances by joint compatibility. An answer is only given where so many pairs are far
beyond chance, and where no other alignment explains nearly as many.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.geometry.alignment import align
from kalmap.geometry.angles import wrap
from kalmap.geometry.ellipses import chi_square
from kalmap.geometry.se2 import quarter_turn, rotate
from kalmap.records import KalmapError
from kalmap.slam.submaps.join import NotSettledError, join
from kalmap.slam.submaps.local_map import LocalMap
from kalmap.slam.submaps.pairing import ByPlace, Overlap, Pairs, poisson_tail

_NEIGHBOURS = 8  # of each landmark, with which it makes pairs
_SHORTEST = 1.0  # m between the two of a pair: nearer ones tell no direction
_BINS = 2.0, math.radians(4.0)  # m and rad of a vote
_LOOKED_AT = 200  # alignments whose near landmarks are counted
_VERIFIED = 12  # of these, the best, that are verified with all covariances
_WIDE = 1e2, 1e-2  # m^2 and rad^2 of what is known beforehand: far more than is left once pairs are found
_LOOSE = 4.0, 0.01  # the same while pairs are gathered around an alignment that has been found
_CHANCE = 1e-6  # that so many pairs are an accident, above which nothing is said
_RIVAL = 0.7  # share of the pairs that another alignment may have at most


class NoMatchError(KalmapError):
    """Two maps that do not overlap, or of which it cannot be told how they do."""


class Matched(msgspec.Struct, frozen=True, eq=False):
    """How two maps lie, and what follows. joined: in the first's frame. T_first_second: (3,) and its covariance.

    pairs: (M, 2) rows of the first and of the second. squared, degrees: the joint distance squared and in how many
    dimensions. chance: how likely so many pairs are by accident; 0 where identities were given.
    """

    joined: LocalMap
    T_first_second: np.ndarray
    covariance: np.ndarray
    pairs: np.ndarray
    squared: float
    degrees: int
    chance: float


def match_by_id(first: LocalMap, second: LocalMap, gate: float = 0.9999) -> Matched:
    """Join two maps whose landmarks share their numbers. Raises NoMatchError for too few of them or a contradiction."""
    _, rows, others = np.intersect1d(first.ids, second.ids, assume_unique=True, return_indices=True)
    pairs = np.column_stack([rows, others]).astype(np.int64)
    if len(pairs) < 2:
        raise NoMatchError(
            f"the maps have {len(pairs)} identities in common: two at least are needed to say how they lie"
        )
    return _joined(first, second, pairs, _fitted(first, second, pairs), 0.0, gate)


def match_by_place(first: LocalMap, second: LocalMap, gate: float = 0.9999) -> Matched:
    """Join two maps by where their landmarks stand. Raises NoMatchError where that leaves any doubt."""
    found = [_verified(first, second, alignment) for alignment in _likely(first, second)]
    found = sorted((each for each in found if len(each[0]) >= 3), key=lambda each: (-len(each[0]), each[1]))
    if not found:
        raise NoMatchError(
            "the maps have no group of landmarks in common: they do not overlap, as far as can be seen"
        )
    pairs, _, T_first_second = found[0]
    chance = _chance(first, second, pairs)
    if chance > _CHANCE:
        raise NoMatchError(
            f"the best alignment has {len(pairs)} pairs of landmarks, which may be chance (1 in {1.0 / chance:.0f}): "
            "the maps do not overlap, or too little"
        )
    for rival, _, other in found[1:]:
        if len(rival) > _RIVAL * len(pairs) and _apart(T_first_second, other, second):
            raise NoMatchError(
                f"the maps fit in more than one way ({len(pairs)} pairs of landmarks in one, {len(rival)} in another)"
            )
    return _joined(first, second, pairs, T_first_second, chance, gate)


def _joined(
    first: LocalMap, second: LocalMap, pairs: np.ndarray, guess: np.ndarray, chance: float, gate: float
) -> Matched:
    """Both as one, with next to nothing known beforehand of how they lie, around what was found first."""
    count = 2 * len(first)
    covariance = np.zeros((3 + count, 3 + count))
    covariance[:3, :3] = np.diag([_WIDE[0], _WIDE[0], _WIDE[1]])
    inside = 3 * len(first.frames) + 3
    covariance[3:, 3:] = first.dense()[inside:, inside:]
    for _ in range(2):
        loose = msgspec.structs.replace(
            first,
            end=guess,
            end_covariance=covariance[:3, :3],
            covariance=covariance,
            frames=np.zeros((0, 3)),
            parts=(),
        )
        try:
            joined = join(loose, second, pairs)
        except NotSettledError as problem:
            raise NoMatchError(f"the maps contradict each other: {problem}") from problem
        guess = joined.frames[0]
    degrees = 2 * len(pairs) - 3  # three went into how the maps lie
    if joined.squared > chi_square(gate, degrees):
        raise NoMatchError(
            f"the maps contradict each other: {len(pairs)} pairs of landmarks are {math.sqrt(joined.squared):.1f} "
            f"standard deviations apart, where {math.sqrt(chi_square(gate, degrees)):.1f} are possible"
        )
    return Matched(
        joined=joined,
        T_first_second=joined.frames[0],
        covariance=joined.dense()[:3, :3],
        pairs=pairs,
        squared=joined.squared,
        degrees=degrees,
        chance=chance,
    )


def _fitted(first: LocalMap, second: LocalMap, pairs: np.ndarray) -> np.ndarray:
    """(3,) the rigid motion that brings the second's landmarks nearest to the first's."""
    angle, translation = align(second.landmarks[pairs[:, 1]], first.landmarks[pairs[:, 0]])
    return np.array([*translation, angle])


def _likely(first: LocalMap, second: LocalMap) -> np.ndarray:
    """The alignments that bring most landmarks of the second near one of the first."""
    from scipy.spatial import cKDTree

    alignments, tree = _alignments(first, second), cKDTree(first.landmarks)
    near = []
    for T_first_second in alignments:
        moved = T_first_second[:2] + rotate(T_first_second[2], second.landmarks)
        apart, rows = tree.query(moved, distance_upper_bound=_BINS[0])
        near.append(len(np.unique(rows[np.isfinite(apart)])))
    return alignments[np.argsort(-np.array(near, dtype=np.int64), kind="stable")[:_VERIFIED]]


def _alignments(first: LocalMap, second: LocalMap) -> np.ndarray:
    """(H, 3) T_first_second with the most votes of pairs of landmarks, each way round, the most first."""
    a, b = _pairs_of(first), _pairs_of(second)
    if not len(a.ends) or not len(b.ends):
        return np.zeros((0, 3))
    order = np.argsort(a.lengths)
    low = np.searchsorted(a.lengths[order], b.lengths - 3.0 * b.sigmas - 3.0 * a.sigmas.max())
    high = np.searchsorted(a.lengths[order], b.lengths + 3.0 * b.sigmas + 3.0 * a.sigmas.max())
    of_b = np.repeat(np.arange(len(b.lengths)), high - low)
    within = np.arange(len(of_b)) - np.repeat(np.cumsum(high - low) - (high - low), high - low)
    of_a = order[low[of_b] + within]
    apart = np.abs(a.lengths[of_a] - b.lengths[of_b])
    good = apart <= 3.0 * np.hypot(a.sigmas[of_a], b.sigmas[of_b])
    of_a, of_b = of_a[good], of_b[good]
    here, there = first.landmarks[a.ends[of_a]], second.landmarks[b.ends[of_b]]
    angle = wrap(_direction(here) - _direction(there))
    centre = second.landmarks.mean(axis=0)
    moved = here.mean(axis=1) - rotate(
        angle, there.mean(axis=1) - centre
    )  # where the second's centre comes to lie
    return _voted(moved, angle, centre)


def _voted(moved: np.ndarray, angle: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """The fullest bins' mean alignments."""
    turns = round(2.0 * math.pi / _BINS[1])
    cells = np.column_stack(
        [np.floor(moved / _BINS[0]), np.floor((angle + math.pi) / (2.0 * math.pi) * turns) % turns]
    )
    _, bins, counts = np.unique(cells.astype(np.int64), axis=0, return_inverse=True, return_counts=True)
    bins = bins.ravel()
    fullest = np.argsort(-counts, kind="stable")[:_LOOKED_AT]
    out = []
    for number in fullest:
        inside = bins == number
        mean = math.atan2(np.sin(angle[inside]).mean(), np.cos(angle[inside]).mean())
        middle = moved[inside].mean(axis=0)
        out.append([*(middle - rotate(np.array(mean), centre)), mean])
    return np.array(out)


class _Ends(msgspec.Struct):
    """ends: (P, 2) rows of landmarks, both ways round; lengths and their standard deviations, m."""

    ends: np.ndarray
    lengths: np.ndarray
    sigmas: np.ndarray


def _pairs_of(map_: LocalMap) -> _Ends:
    """Pairs of near neighbours."""
    from scipy.spatial import cKDTree

    count = len(map_)
    if count < 2:
        return _Ends(np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0))
    _, near = cKDTree(map_.landmarks).query(map_.landmarks, min(_NEIGHBOURS + 1, count))
    ends = np.column_stack([np.repeat(np.arange(count), near.shape[1] - 1), near[:, 1:].ravel()])
    apart = map_.landmarks[ends[:, 1]] - map_.landmarks[ends[:, 0]]
    lengths = np.hypot(*apart.T)
    ends, apart, lengths = (each[lengths >= _SHORTEST] for each in (ends, apart, lengths))
    covariance, inside = map_.dense(), 3 * len(map_.frames) + 3
    i, j = (inside + 2 * column[:, None] + np.arange(2) for column in ends.T)

    def block(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return covariance[p[:, :, None], q[:, None, :]]

    spread = block(i, i) + block(j, j) - block(i, j) - block(j, i)
    along = apart / lengths[:, None]
    variances = np.einsum("pi,pij,pj->p", along, spread, along)
    return _Ends(ends, lengths, np.sqrt(np.maximum(variances, 0.0)))


def _direction(ends: np.ndarray) -> np.ndarray:
    apart = ends[:, 1] - ends[:, 0]
    return np.arctan2(apart[:, 1], apart[:, 0])


def _verified(
    first: LocalMap, second: LocalMap, T_first_second: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray]:
    """Pairs that are jointly compatible around an alignment, their distance, and the alignment that they have."""
    pairs = np.zeros((0, 2), dtype=np.int64)
    distance = math.inf
    for _ in range(3):  # until the same pairs come again
        overlap = _overlap(first, second, T_first_second)
        found = _gathered(overlap)
        index = np.array(sorted(found), dtype=np.int64).reshape(-1, 2)
        again = np.column_stack([overlap.rows[index[:, 0]], overlap.others[index[:, 1]]])
        if len(again) < 2:
            return again, math.inf, T_first_second
        distance, same = overlap.distance(found), np.array_equal(again, pairs)
        pairs, T_first_second = again, _fitted(first, second, again)
        if same:
            break
    return pairs, distance, T_first_second


def _gathered(overlap: Overlap) -> Pairs:
    """Begin with the two nearest pairs that suit each other; add what is near, given those before it."""
    every = np.indices((len(overlap.rows), len(overlap.others))).reshape(2, -1).T
    apart = np.linalg.norm(overlap.places[every[:, 0]] - overlap.targets[every[:, 1]], axis=1)
    near = every[apart < 2.0 * _BINS[0]]
    if len(near) < 3:
        return []
    rule, best = ByPlace(), Pairs()
    order = np.argsort(np.linalg.norm(overlap.places[near[:, 0]] - overlap.targets[near[:, 1]], axis=1))
    for seed in near[order[:3]]:
        found = rule.extended(overlap, [(int(seed[0]), int(seed[1]))], near)
        if len(found) > len(best):
            best = found
    return best


def _overlap(first: LocalMap, second: LocalMap, T_first_second: np.ndarray) -> Overlap:
    """Both maps' landmarks as seen from the second's frame, if it lies about there."""
    places = rotate(-T_first_second[2], first.landmarks - T_first_second[:2])
    low, high = second.landmarks.min(axis=0) - 5.0, second.landmarks.max(axis=0) + 5.0
    rows = np.flatnonzero(((places >= low) & (places <= high)).all(axis=1))
    others = np.arange(len(second))
    c, s = np.cos(T_first_second[2]), np.sin(T_first_second[2])
    back = np.kron(np.eye(len(rows)), np.array([[c, s], [-s, c]]))
    inside = 3 * len(first.frames) + 3
    entries = inside + (2 * rows[:, None] + np.arange(2)).ravel()
    by_frame = np.zeros((2 * len(rows), 3))
    by_frame[0::2, 0] = by_frame[1::2, 1] = 1.0
    # about the middle of what is compared, so that a turn moves nothing far away
    middle = places[rows].mean(axis=0) if len(rows) else np.zeros(2)
    by_frame[:, 2] = quarter_turn(places[rows] - middle).ravel()
    known = np.diag([_LOOSE[0], _LOOSE[0], _LOOSE[1]])
    own = 3 * len(second.frames) + 3
    return Overlap(
        rows=rows,
        others=others,
        places=places[rows],
        spread=back @ first.dense()[np.ix_(entries, entries)] @ back.T + by_frame @ known @ by_frame.T,
        targets=second.landmarks,
        own=second.dense()[own:, own:],
    )


def _apart(one: np.ndarray, other: np.ndarray, second: LocalMap) -> bool:
    """Whether two alignments bring the second map to different places."""
    centre = second.landmarks.mean(axis=0)
    places = [pose[:2] + rotate(pose[2], centre) for pose in (one, other)]
    return bool(
        np.linalg.norm(places[0] - places[1]) > 2.0 * _BINS[0]
        or abs(wrap(one[2] - other[2])) > 2.0 * _BINS[1]
    )


def _chance(first: LocalMap, second: LocalMap, pairs: np.ndarray) -> float:
    """How likely unrelated maps have an alignment with so many pairs.

    Two pairs fix an alignment; the others hit by accident with a chance that their windows and the first's density
    tell (Poisson). There are as many alignments to try as ways to lay one pair of neighbours on another.
    """
    overlap = _overlap(first, second, _fitted(first, second, pairs))
    place = {int(row): number for number, row in enumerate(overlap.rows)}
    given = [(place[int(row)], int(other)) for row, other in pairs if int(row) in place]
    if len(given) < 3:
        return 1.0
    far = _farthest(overlap, given)
    windows = [overlap.window(row, other, far) for row, other in given if (row, other) not in far]
    density = len(overlap.rows) / overlap.area
    each = density * math.pi * chi_square(0.999, 2) * float(np.mean(windows))
    expected = min(each, 1.0) * max(len(second) - 2, 1)
    ways = 2.0 * _NEIGHBOURS * len(first) * len(second)
    return min(1.0, ways * poisson_tail(len(given) - 2, expected))


def _farthest(overlap: Overlap, given: Pairs) -> Pairs:
    """The two pairs that lie farthest apart: they fix an alignment best."""
    points = overlap.places[[row for row, _ in given]]
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    i, j = np.unravel_index(int(np.argmax(apart)), apart.shape)
    return [given[int(i)], given[int(j)]]
