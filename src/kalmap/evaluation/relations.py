"""Errors of relative motions that are known between pairs of instants (Kuemmerle et al. 2009).

A trajectory is judged by what it says of the motion between two instants, not by where it lies: no alignment is
needed, and an error made once is not counted again at every later pose. For a relation d* and the same one out of the
estimate, d = x1^-1 x2, the error is e = (d*)^-1 d (their equation 4, with translation and rotation kept apart).
"""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.geometry.se2 import compose, inverse
from kalmap.records import Relations

LARGEST_GAP = 1e-3
"""s, how far a relation's stamp may lie from the nearest pose's."""
LOOP = 100.0
"""s: relations over this time or more close loops, shorter ones join neighbours."""

Metrics = dict[str, float | int | None]


class RelationErrors(msgspec.Struct, frozen=True, eq=False):
    """Errors of the M relations whose both instants were found.

    translations: (M,) m, |trans e|. rotations: (M,) rad, |rot e| in [0, pi]. closing: (M,) bool, whether the relation
    closes a loop. missed: how many relations had an instant without a pose.
    """

    translations: np.ndarray
    rotations: np.ndarray
    closing: np.ndarray
    missed: int

    def __len__(self) -> int:
        return len(self.translations)


def relation_errors(stamps: np.ndarray, poses: np.ndarray, relations: Relations) -> RelationErrors:
    """How far a trajectory's motions are from the known ones.

    stamps: (F,) s as the log printed them, in any order; poses: (F, 3). An instant takes the pose of the same stamp,
    else of the nearest within `LARGEST_GAP`; of several with one stamp, the first.
    """
    first, second = rows_of(stamps, relations.first), rows_of(stamps, relations.second)
    found = np.flatnonzero((first >= 0) & (second >= 0))
    motions = compose(inverse(poses[first[found]]), poses[second[found]])
    errors = compose(inverse(relations.poses[found]), motions)
    return RelationErrors(
        translations=np.hypot(errors[:, 0], errors[:, 1]),
        rotations=np.abs(errors[:, 2]),
        closing=np.abs(relations.second - relations.first)[found] >= LOOP,
        missed=len(relations.first) - len(found),
    )


def rows_of(stamps: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(K,) the row of `stamps` (F,) nearest to each of `wanted` (K,), -1 where none lies within `LARGEST_GAP`."""
    if not len(stamps):
        return np.full(len(wanted), -1, dtype=np.int64)
    order = np.argsort(stamps, kind="stable")
    ordered = stamps[order]
    after = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(ordered[before] - wanted) < np.abs(ordered[after] - wanted)
    chosen = np.searchsorted(ordered, ordered[np.where(nearer, before, after)])  # the first of equal ones
    return np.where(np.abs(ordered[chosen] - wanted) <= LARGEST_GAP, order[chosen], -1)


def relation_metrics(errors: RelationErrors) -> Metrics:
    """Flat numbers, None where there is no relation to take them from.

    `relations_found` and `_missed`; mean and standard deviation (over the relations, divisor M) of |trans e| in m, of
    |rot e| in deg and of their squares: `relations_translation_mean_m`, ..., `relations_rotation_squared_std_deg2`;
    the same for those that join neighbours (`relations_local_*`) and those that close loops (`relations_loop_*`).
    """
    metrics: Metrics = {"relations_found": len(errors), "relations_missed": errors.missed}
    every = np.ones(len(errors), dtype=bool)
    for name, chosen in (("", every), ("local_", ~errors.closing), ("loop_", errors.closing)):
        if name:
            metrics[f"relations_{name}found"] = int(chosen.sum())
        kinds = (("translation", "m", errors.translations), ("rotation", "deg", np.degrees(errors.rotations)))
        for kind, unit, values in kinds:
            before = f"relations_{name}{kind}"
            metrics |= _spread(values[chosen], before, unit)
            metrics |= _spread(values[chosen] ** 2, f"{before}_squared", f"{unit}2")
    return metrics


def _spread(values: np.ndarray, name: str, unit: str) -> Metrics:
    known = len(values) > 0
    return {
        f"{name}_mean_{unit}": float(values.mean()) if known else None,
        f"{name}_std_{unit}": float(values.std()) if known else None,
    }
