"""Were sightings given to the landmarks they belong to? A verdict for each, and pairs of sightings."""

from __future__ import annotations

from enum import IntEnum

import msgspec
import numpy as np

from kalmap.records import NEW, SPURIOUS


class Verdict(IntEnum):
    """What became of a sighting.

    RIGHT: joined to a landmark that the same feature founded. WRONG: joined to another's, though its own
    feature had one. MISSED_NEW: joined to another's landmark, and its own feature had none yet.
    RIGHT_NEW: founded the first landmark of its feature. FALSE_NEW: founded one more landmark of a feature
    that had one. UNUSED: a sighting of a feature that was left aside.
    FALSE_REJECTED: known to be no feature, and left aside. FALSE_ADMITTED: known to be no feature, and
    joined to a landmark or founded one. UNSCORED: nobody says what it was.
    """

    RIGHT = 0
    WRONG = 1
    MISSED_NEW = 2
    RIGHT_NEW = 3
    FALSE_NEW = 4
    UNUSED = 5
    FALSE_REJECTED = 6
    FALSE_ADMITTED = 7
    UNSCORED = 8


class AssociationScore(msgspec.Struct, frozen=True, eq=False):
    """How many sightings met each verdict, and the shares of right decisions.

    accuracy: decisions that were right (right, right_new, false_rejected) over all sightings that can be
        scored: leaving a feature's sighting aside is no right decision. None if none can be scored.
    accuracy_used: the same over those only that were not left aside: (right + right_new) / used.
    verdicts: (M,) int8, a `Verdict` for each sighting.
    """

    right: int
    wrong: int
    missed_new: int
    right_new: int
    false_new: int
    unused: int
    false_rejected: int
    false_admitted: int
    unscored: int
    accuracy: float | None
    accuracy_used: float | None
    verdicts: np.ndarray


def score_association(
    truth: np.ndarray, assigned: np.ndarray, *, false_ids: bool = False
) -> AssociationScore:
    """Judge each sighting, in order of time, by its true id and the landmark it was given to, both (M,) ints.

    truth: the feature's id; negative: known to be no feature if `false_ids`, else nobody says what it was.
    assigned: the landmark's lasting number, also of the sighting that founded it; `NEW` founds a landmark
    that never gets a number, `SPURIOUS` leaves the sighting aside.

    A landmark is its founder's: that of the first sighting with its number. The verdicts judge decisions
    as they came, and what a landmark is at that moment is what it was founded on; `landmark_owners` judges
    the final map, by majority. Sightings of which nobody says what they were do not take part at all: the
    verdicts of the others are as if they had not been made, so that a landmark founded by one of them is
    that of its first known sighting.

    Zhou, Zhao and Zhang 2010 report an accuracy without defining it; `AssociationScore.accuracy` is the
    reading taken here. Raises `ValueError` for lists of different length or of other than whole numbers.
    """
    truth, assigned = label_pair(truth, assigned)
    verdicts = np.full(len(truth), Verdict.UNSCORED, dtype=np.int8)
    scored = (truth >= 0) | false_ids
    verdicts[scored] = _verdicts(truth[scored], assigned[scored])
    counts = np.bincount(verdicts, minlength=len(Verdict)).tolist()
    right, wrong, missed_new, right_new, false_new, unused, rejected, admitted, unscored = counts
    decided = len(truth) - unscored
    used = decided - unused - rejected
    return AssociationScore(
        right=right,
        wrong=wrong,
        missed_new=missed_new,
        right_new=right_new,
        false_new=false_new,
        unused=unused,
        false_rejected=rejected,
        false_admitted=admitted,
        unscored=unscored,
        accuracy=(right + right_new + rejected) / decided if decided else None,
        accuracy_used=(right + right_new) / used if used else None,
        verdicts=verdicts,
    )


def label_pair(truth: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both as (M,) int64. Raises `ValueError` if they differ in length or are no whole numbers."""
    truth, labels = whole_numbers(truth), whole_numbers(labels)
    if len(truth) != len(labels):
        raise ValueError(f"two lists of the same length are needed, got {len(truth)} and {len(labels)}")
    if len(labels) and labels.min() < SPURIOUS:
        raise ValueError(
            f"{labels.min()} is no landmark: expected 0 or more, NEW ({NEW}) or SPURIOUS ({SPURIOUS})"
        )
    return truth, labels


def whole_numbers(values: np.ndarray) -> np.ndarray:
    """(M,) int64. Raises `ValueError` for another shape or type."""
    values = np.asarray(values)
    if values.ndim != 1 or (len(values) and not np.issubdtype(values.dtype, np.integer)):
        raise ValueError(f"a list of whole numbers is needed, got {values.dtype} of shape {values.shape}")
    return values.astype(np.int64)


def _verdicts(feature: np.ndarray, landmark: np.ndarray) -> np.ndarray:
    """(M,) verdicts of sightings that can all be scored; a negative feature is none."""
    rows = np.arange(len(feature))
    founder = rows.copy()
    numbered = np.flatnonzero(landmark >= 0)
    founder[numbered] = numbered[_first_alike(landmark[numbered])]
    used = landmark != SPURIOUS
    founds = used & (founder == rows)
    features, which = np.unique(feature, return_inverse=True)
    begun = np.full(len(features), len(rows))
    np.minimum.at(begun, which[founds], rows[founds])
    had_one = begun[which] < rows
    real = feature >= 0
    return np.select(
        [
            ~real & ~used,
            ~real,
            ~used,
            founds & had_one,
            founds,
            feature[founder] == feature,
            had_one,
        ],
        [
            Verdict.FALSE_REJECTED,
            Verdict.FALSE_ADMITTED,
            Verdict.UNUSED,
            Verdict.FALSE_NEW,
            Verdict.RIGHT_NEW,
            Verdict.RIGHT,
            Verdict.WRONG,
        ],
        Verdict.MISSED_NEW,
    )


def _first_alike(values: np.ndarray) -> np.ndarray:
    """(n,) for each value the index of the first one that equals it."""
    _, first, which = np.unique(values, return_index=True, return_inverse=True)
    return first[which]


class PairScore(msgspec.Struct, frozen=True):
    """Pairs of sightings that are of one feature, and those said to be of one landmark.

    true_pairs: both; said_pairs: said to be; real_pairs: are. precision = true / said, recall = true / real,
    None over nothing. f1: their harmonic mean 2 true / (said + real), None if there is no pair of either kind.
    """

    true_pairs: int
    said_pairs: int
    real_pairs: int
    precision: float | None
    recall: float | None
    f1: float | None


def score_pairs(truth: np.ndarray, labels: np.ndarray, *, false_ids: bool = False) -> PairScore:
    """Judge "same landmark" over all pairs of sightings: no landmark need be matched with a feature for it.

    truth, labels: (M,) as for `score_association`. A pair is said to be one landmark if both labels are the
    same number; sightings left aside or `NEW` are in no such pair, and so count against recall only. A pair
    is one feature if both true ids are the same and not negative. Sightings of which nobody says what they
    were are left out. With `false_ids` those known to be no feature stay in: a pair that holds one is said
    wrongly, also if both come from the same moving thing.

    Counted exactly, from the table of how often each feature went to each landmark, in O(M log M) (Hubert
    and Arabie 1985). Raises `ValueError` as `score_association` does.
    """
    truth, labels = label_pair(truth, labels)
    real = truth >= 0
    said = (labels >= 0) & (real | false_ids)
    both = said & real
    _, feature = np.unique(truth[both], return_inverse=True)
    landmarks, landmark = np.unique(labels[both], return_inverse=True)
    true_pairs = _pairs(feature * len(landmarks) + landmark)
    said_pairs, real_pairs = _pairs(labels[said]), _pairs(truth[real])
    return PairScore(
        true_pairs,
        said_pairs,
        real_pairs,
        precision=true_pairs / said_pairs if said_pairs else None,
        recall=true_pairs / real_pairs if real_pairs else None,
        f1=2 * true_pairs / (said_pairs + real_pairs) if said_pairs + real_pairs else None,
    )


def _pairs(values: np.ndarray) -> int:
    """How many pairs of equal values there are."""
    _, counts = np.unique(values, return_counts=True)
    return int(np.sum(counts * (counts - 1) // 2))
