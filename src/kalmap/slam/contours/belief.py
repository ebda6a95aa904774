"""Whether a place of one map on another is believed, and why not: by itself, by the drive, by others."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec
import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import rotate
from kalmap.slam.contours.matching import Overlay

GATE = 16.3  # squared distance of three numbers that chance exceeds once in a thousand
LEAST_MATCHED = 8.0  # m of contour that must lie on each other
LEAST_AGREEMENT = 0.75
AMBIGUOUS = 0.8  # a second place this good, as a share of the best, leaves the loop open
ELSEWHERE, ELSEWHERE_TURN = 0.3, 0.1  # m and rad, from where on two places are two
SURE, SURE_TURN = 0.5, 0.1  # m and rad: where the place is known better than this, there is nothing to search
FARTHEST = 10.0 * GATE  # squared distance beyond which a place is not tried against the drive
TRIED_AGREEMENT = 0.85  # against the drive more must agree than with it
FLOOR = np.diag([0.01**2, 0.01**2, 0.002**2])  # of a relation's covariance: maps bend
ORIGIN = np.zeros(2)
CONTRADICTS = "the place contradicts the drive"


class Bar(msgspec.Struct, frozen=True):
    """What a place must come to: m that lie on each other, the share of what lies side by side that agrees, and how
    good, as a share of it, no other place may be."""

    matched: float
    agreement: float
    rival: float


CONTOURS = Bar(LEAST_MATCHED, LEAST_AGREEMENT, AMBIGUOUS)
POINTS = Bar(2.0, 0.85, 0.7)
"""Of places by single points (`sketch`). With `LEAST_THINGS` chosen so that none is wrong of 189 that pass, of 653
searched 0.5 m and 0.1 rad about the truth, in maps of eight simulated floors; with 5 things one is, with 4 five."""
LEAST_THINGS = 6  # that stand apart and lie on each other, where places are judged by points


class Verdict(msgspec.Struct, frozen=True, eq=False):
    """What was found of one map on another, and why it is not believed; None if it is."""

    found: Overlay
    why: str | None

    @property
    def is_doubted(self) -> bool:
        """Whether only the drive stands against it."""
        return self.why is not None and contradicts_drive(self.why)


def judged(
    places: Sequence[Overlay],
    guess: np.ndarray,
    covariance: np.ndarray,
    scale: float,
    *,
    following: bool = False,
    bar: Bar = CONTOURS,
    about: np.ndarray = ORIGIN,
) -> Verdict | None:
    """The verdict on the best of the places that were found; None if too little lies on each other for a place.

    places: best first. guess (3,), covariance (3, 3): where the drive has the map; scale: of the maps' own covariances.
    following: whether the one map begins where the other ends. about: (2,) m, see `is_elsewhere`.
    """
    if not places or places[0].matched < bar.matched:
        return None
    best = places[0]
    if best.agreement < bar.agreement:
        return Verdict(best, f"only {best.agreement:.0%} of what lies side by side agrees")
    for other in places[1:]:
        as_good = other.matched * other.agreement > bar.rival * best.matched * best.agreement
        if as_good and is_elsewhere(other.pose, best.pose, about=about):
            return Verdict(best, "another place is nearly as good")
    shift = best.pose - guess
    if following and np.hypot(shift[0], shift[1]) < SURE and abs(wrap(shift[2])) < SURE_TURN:
        # the odometry jumped, or the wheels slipped: both maps show the same place
        return Verdict(best, None)
    squared = squared_off(best, guess, covariance, scale)
    return Verdict(best, f"{CONTRADICTS}: squared distance {squared:.0f}" if squared > GATE else None)


def contradicts_drive(why: str) -> bool:
    """Whether that is why a place is not believed: others may bear it out."""
    return why.startswith(CONTRADICTS)


def may_be_tried(found: Overlay, squared: float) -> bool:
    """Whether a place may be believed against the drive, so far off by `squared`, if others bear it out: not if it is
    one of points, whose metres are no contour."""
    return found.freedom > 0 and found.agreement >= TRIED_AGREEMENT and squared < FARTHEST


def enough(matched: Sequence[float], least: int, contour: float) -> bool:
    """Whether so many places, that lie on each other by `matched` m of contour, bear each other out."""
    return len(matched) >= least and sum(matched) >= contour


def contradicted(overlays: Iterable[Overlay]) -> bool:
    """Whether maps that are laid on each other where a belief has brought them show something else."""
    matched = beside = 0.0
    for each in overlays:
        if each.matched < each.agreement * LEAST_MATCHED:
            continue
        if each.agreement < LEAST_AGREEMENT:
            return True
        matched, beside = matched + each.matched, beside + each.matched / each.agreement
    return matched < TRIED_AGREEMENT * beside


def is_elsewhere(
    pose: np.ndarray,
    other: np.ndarray,
    way: float = ELSEWHERE,
    turn: float = ELSEWHERE_TURN,
    about: np.ndarray = ORIGIN,
) -> bool:
    """Whether two places (3,) of one pair of maps are two, being more than `way` m or `turn` rad apart.

    about: (2,) m, the point of the second map that is asked where it lies.
    """
    apart = pose - other
    apart[:2] += rotate(pose[2], about) - rotate(other[2], about)
    return bool(np.hypot(apart[0], apart[1]) > way or abs(wrap(apart[2])) > turn)


def squared_off(found: Overlay, guess: np.ndarray, covariance: np.ndarray, scale: float = 1.0) -> float:
    """Squared Mahalanobis distance of a place that was found from where it was thought to be."""
    return squared_distance(found.pose, guess, covariance + scale * (found.covariance + FLOOR))


def squared_distance(pose: np.ndarray, guess: np.ndarray, covariance: np.ndarray) -> float:
    """Squared Mahalanobis distance of two poses (3,), whose difference has that covariance."""
    shift = pose - guess
    shift[2] = wrap(shift[2])
    return float(shift @ np.linalg.solve(covariance, shift))
