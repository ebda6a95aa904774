"""How good the map of features is: errors of matched ones, and what is missing, false or double."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.evaluation.trajectory import rms
from kalmap.geometry.alignment import align, apply

Motion = tuple[float, np.ndarray]

_STAY: Motion = (0.0, np.zeros(2))
# rounds of matching and aligning again; the pairs settle after one or two
_ROUNDS = 5


class MapScore(msgspec.Struct, frozen=True):
    """rmse, aligned_rmse: m over the matched features, None if there are none; aligned means after the
    rigid motion that fits the matched features best.

    matched + spurious = features estimated; matched + missed = features of the reference.
    doubled: reference features that two or more estimates claim (one of them counts as matched, the
    others as spurious).
    """

    rmse: float | None
    aligned_rmse: float | None
    matched: int
    missed: int
    spurious: int
    doubled: int


def pair_by_id(ids: np.ndarray, reference_ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (K,) of both lists that name the same feature, each at most once (its first mention)."""
    _, rows, reference_rows = np.intersect1d(ids, reference_ids, return_indices=True)
    return rows, reference_rows


def pair_by_nearest(
    positions: np.ndarray, reference: np.ndarray, cutoff: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (K,) of the one-to-one pairing of (N, 2) with (M, 2) of least total distance.

    Pairs as far apart as `cutoff` (m) or farther are no pairs; distances are capped there, so one
    feature without a partner does not push the others out of theirs.
    """
    from scipy.optimize import linear_sum_assignment

    distance = np.minimum(_distances(positions, reference), cutoff)
    rows, columns = linear_sum_assignment(distance)
    near = distance[rows, columns] < cutoff
    return rows[near], columns[near]


def score_by_id(
    ids: np.ndarray,
    positions: np.ndarray,
    reference_ids: np.ndarray,
    reference: np.ndarray,
    motion: Motion = _STAY,
) -> MapScore:
    """Score features (N,), (N, 2) whose ids are those of the reference (M,), (M, 2).

    motion: angle and translation that bring the estimate into the reference's frame first.
    """
    rows, columns = pair_by_id(ids, reference_ids)
    _, mentions = np.unique(ids[np.isin(ids, reference_ids)], return_counts=True)
    return _score(positions, reference, rows, columns, motion, doubled=int(np.sum(mentions > 1)))


def score_by_nearest(
    positions: np.ndarray,
    reference: np.ndarray,
    cutoff: float = 2.0,
    motion: Motion = _STAY,
    pair_after: Motion | None = None,
) -> MapScore:
    """Score features (N, 2) whose names say nothing against the reference (M, 2).

    They are paired by distance after the motion `pair_after` (None: `motion`), such as the one that aligns
    the trajectory; the map is then aligned on its pairs and paired again until the pairs stay, so that a
    map that is only turned or shifted still finds its features. `rmse` is that after `motion` all the same.
    An estimate doubles a reference feature if it lies within `cutoff` of it, nearer than to any other,
    and is not the only one.
    """
    settled = motion if pair_after is None else pair_after
    rows, columns = pair_by_nearest(apply(*settled, positions), reference, cutoff)
    for _ in range(_ROUNDS):
        if len(rows) < 3:  # two pairs fit any rigid motion and prove nothing
            break
        best = align(positions[rows], reference[columns])
        again = pair_by_nearest(apply(*best, positions), reference, cutoff)
        if len(again[0]) < len(rows):
            break
        settled, same = best, np.array_equal(again, (rows, columns))
        rows, columns = again
        if same:
            break
    distance = _distances(apply(*settled, positions), reference)
    claimed = np.zeros(len(reference), dtype=int)
    if distance.size:
        near = distance.min(axis=1) < cutoff
        np.add.at(claimed, distance.argmin(axis=1)[near], 1)
    return _score(positions, reference, rows, columns, motion, doubled=int(np.sum(claimed > 1)))


def _score(
    positions: np.ndarray,
    reference: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    motion: Motion,
    doubled: int,
) -> MapScore:
    mine, theirs = positions[rows], reference[columns]
    return MapScore(
        rmse=rms(np.hypot(*(apply(*motion, mine) - theirs).T)),
        aligned_rmse=rms(np.hypot(*(apply(*align(mine, theirs), mine) - theirs).T)),
        matched=len(rows),
        missed=len(reference) - len(rows),
        spurious=len(positions) - len(rows),
        doubled=doubled,
    )


def _distances(positions: np.ndarray, reference: np.ndarray) -> np.ndarray:
    return np.asarray(
        np.hypot(positions[:, None, 0] - reference[None, :, 0], positions[:, None, 1] - reference[None, :, 1])
    )
