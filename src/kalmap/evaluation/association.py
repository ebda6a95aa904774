"""Were sightings given to the landmarks they belong to?"""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.records import NEW, SPURIOUS


class AssociationScore(msgspec.Struct, frozen=True):
    """What became of the sightings whose truth is known.

    right: joined to a landmark that the same feature founded. wrong: joined to another feature's, though
    its own feature had one. missed_new: joined to another feature's landmark, and its own had none yet.
    right_new: founded the first landmark of its feature. false_new: founded one more landmark of a feature
    that had one. unused: left aside.
    accuracy: (right + right_new) over all sightings that were not left aside, None if there were none.
    """

    right: int
    wrong: int
    missed_new: int
    right_new: int
    false_new: int
    unused: int
    accuracy: float | None


def score_association(truth: np.ndarray, assigned: np.ndarray) -> AssociationScore:
    """Score each sighting, in order of time: its true id and the landmark it was given to, both (M,) ints.

    A landmark's true identity is the id of the sighting that founded it: the first one with its number.
    `NEW` founds a landmark that never gets a number, `SPURIOUS` leaves the sighting aside. Sightings with a
    negative true id are not scored, but what they found stays somebody else's landmark.
    """
    owner: dict[int, int] = {}
    founded: set[int] = set()
    right = wrong = missed_new = right_new = false_new = unused = 0
    for feature, landmark in zip(np.asarray(truth).tolist(), np.asarray(assigned).tolist(), strict=True):
        founds = landmark == NEW or (landmark != SPURIOUS and landmark not in owner)
        had_one = feature in founded
        if founds:
            founded.add(feature)
            if landmark != NEW:
                owner[landmark] = feature
        if feature < 0:
            continue
        if landmark == SPURIOUS:
            unused += 1
        elif founds:
            right_new, false_new = right_new + (not had_one), false_new + had_one
        elif owner[landmark] == feature:
            right += 1
        else:
            wrong, missed_new = wrong + had_one, missed_new + (not had_one)
    used = right + wrong + missed_new + right_new + false_new
    accuracy = (right + right_new) / used if used else None
    return AssociationScore(right, wrong, missed_new, right_new, false_new, unused, accuracy)
