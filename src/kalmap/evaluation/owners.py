"""Which feature each landmark of the final map is: false landmarks, double ones, features without any."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.evaluation.association import label_pair, whole_numbers

FALSE = -1
"""Owner of a landmark that is known to be no feature."""
UNKNOWN = -2
"""Owner of a landmark of whose sightings nobody says what they were."""


class LandmarkScore(msgspec.Struct, frozen=True):
    """The final map's landmarks by what they are, and what it lacks.

    spurious: landmarks that are no feature, None where false sightings are not known as such.
    duplicates: surplus landmarks: of a feature that has n of them, n - 1. unknown: landmarks without any
    sighting whose truth is known. found: features that have a landmark: landmarks = found + duplicates +
    spurious + unknown. missed: features seen often enough that have none.
    """

    spurious: int | None
    duplicates: int
    unknown: int
    found: int
    missed: int


def landmark_owners(
    truth: np.ndarray, labels: np.ndarray, landmark_ids: np.ndarray, *, false_ids: bool = False
) -> np.ndarray:
    """(L,) int64: the feature that each landmark (its number in `labels`) is, `FALSE` or `UNKNOWN`.

    A landmark is the feature that most of its sightings are of, of several such the one that was given to
    it first. With `false_ids` it is `FALSE` if less than half of its sightings are of any feature. Not the
    founder decides here, as it does for the verdicts: where a landmark ends up is where most of its
    sightings drew it, and one stray sighting at its beginning makes it neither spurious nor a duplicate.

    truth, labels: (M,), false_ids: as for `score_association`, which see for `ValueError` too; it is also
    raised where `landmark_ids` names a landmark twice.
    """
    truth, labels = label_pair(truth, labels)
    landmarks, column = np.unique(whole_numbers(landmark_ids), return_inverse=True)
    if len(landmarks) < len(column):
        raise ValueError("a landmark is named twice")
    place = np.searchsorted(landmarks, labels)
    in_map = (labels >= 0) & np.isin(labels, landmarks)
    real, false = in_map & (truth >= 0), in_map & (truth < 0)
    owners = np.full(len(landmarks), UNKNOWN)
    if real.any():
        features, which = np.unique(truth[real], return_inverse=True)
        cells, first, counts = np.unique(
            place[real] * len(features) + which, return_index=True, return_counts=True
        )
        of, feature = np.divmod(cells, len(features))
        best = np.lexsort((first, -counts, of))
        owned, start = np.unique(of[best], return_index=True)
        owners[owned] = features[feature[best[start]]]
    if false_ids:
        reals, falses = (np.bincount(place[rows], minlength=len(landmarks)) for rows in (real, false))
        owners[reals < falses] = FALSE
    return owners[column]


def score_landmarks(
    truth: np.ndarray,
    labels: np.ndarray,
    landmark_ids: np.ndarray,
    *,
    false_ids: bool = False,
    least: int = 3,
) -> LandmarkScore:
    """Judge the landmarks of the final map, `landmark_ids` (L,), by their sightings: see `landmark_owners`.

    least: sightings from which on a feature is missed if no landmark is it.
    """
    owners = landmark_owners(truth, labels, landmark_ids, false_ids=false_ids)
    found, counts = np.unique(owners[owners >= 0], return_counts=True)
    truth = np.asarray(truth)
    seen, times = np.unique(truth[truth >= 0], return_counts=True)
    return LandmarkScore(
        spurious=int(np.sum(owners == FALSE)) if false_ids else None,
        duplicates=int(np.sum(counts - 1)),
        unknown=int(np.sum(owners == UNKNOWN)),
        found=len(found),
        missed=len(np.setdiff1d(seen[times >= least], found)),
    )
