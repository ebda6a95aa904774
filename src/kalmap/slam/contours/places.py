"""Where the parts of one contour map lie on another: as association only, before anything is estimated.

A large map is no rigid body: where a drive comes back to where it began, the far end is off by all that the drive has
drifted, while the near end fits. So it is laid over the other in parts, each by itself, within its own uncertainty.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import rotate
from kalmap.slam.contours.closed import ClosedMap
from kalmap.slam.contours.matching import overlay, search
from kalmap.slam.contours.stacked import Solved, Stacked

PART = 8.0  # m, of the squares that a map is parted into
FEWEST = 15  # samples of a part
REACH = 3.0  # m beyond its uncertainty within which the other map must have something
SURE = 0.15  # m: a part whose place is known this well is looked for nowhere else
WIDEST, FARTHEST_TURN = 6.0, 0.5  # m and rad, the largest search
LEAST_MATCHED, LEAST_AGREEMENT = 5.0, 0.75
AMBIGUOUS = 0.8  # a second place this good, as a share of the best, leaves a part open
GATE = 13.8  # squared distance of two numbers that chance exceeds once in a thousand


class Part(msgspec.Struct, frozen=True, eq=False):
    """rows: samples of the second map. sigma: m, standard deviation of its place on the first, the wider way. near: m
    to the first's nearest sample."""

    rows: np.ndarray
    sigma: float
    near: float

    @property
    def is_sure(self) -> bool:
        """Whether there is nothing to look for."""
        return 3.0 * self.sigma < SURE


def parts_of(second: ClosedMap) -> list[np.ndarray]:
    """The rows of a map's samples, square by square; too few for a part of their own are left out."""
    cells = np.floor(second.samples / PART).astype(np.int64)
    _, number = np.unique(cells, axis=0, return_inverse=True)
    number = number.ravel()
    return [
        rows for k in range(number.max(initial=-1) + 1) if len(rows := np.flatnonzero(number == k)) >= FEWEST
    ]


def part_at(stacked: Stacked, solved: Solved, rows: np.ndarray, widen: float) -> tuple[Part, np.ndarray]:
    """A part, and the covariance (2, 2) of its place on the first map. widen: factor on variances."""
    places, samples = stacked.placed(solved.mean), stacked.first(solved.mean)
    centre = places[rows].mean(axis=0)
    middle = int(rows[np.hypot(*(places[rows] - centre).T).argmin()])
    tree = cKDTree(samples)
    nearest = int(tree.query(places[middle])[1])
    which = np.array([stacked.counts[0] + middle] * 2 + [nearest] * 2)
    reads = stacked.rows(solved.mean, which, np.tile(np.eye(2), (2, 1)))
    spread = solved.spread(stacked.covariance, reads)
    turn = np.array([[1.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, -1.0]])
    covariance = widen * turn @ spread @ turn.T
    closest = float(tree.query(places[rows])[0].min())
    return Part(rows, float(np.sqrt(max(0.0, np.linalg.eigvalsh(covariance)[-1]))), closest), covariance


def look_for(
    first: ClosedMap, second: ClosedMap, stacked: Stacked, solved: Solved, rows: np.ndarray, widen: float
) -> np.ndarray | None:
    """T_first_second (3,) as a part of the second map sees it; None where it is not found, or not surely."""
    part, covariance = part_at(stacked, solved, rows, widen)
    if part.near > 3.0 * part.sigma + REACH:
        return None
    guess = solved.mean[:3].copy()
    piece = _piece(second, stacked, solved, rows)
    whole = _whole(first, stacked, solved)
    half = min(WIDEST, 3.0 * part.sigma + 0.3)
    turn = min(FARTHEST_TURN, 3.0 * math.sqrt(widen * max(0.0, float(_turn_variance(stacked, solved)))) + 0.1)
    found = [overlay(whole, piece, place) for place in (guess, *search(whole, piece, guess, half, turn))]
    overlays = sorted(
        (each for each in found if each is not None), key=lambda each: -each.matched * each.agreement
    )
    if not overlays:
        return None
    best = overlays[0]
    if best.matched < LEAST_MATCHED or best.agreement < LEAST_AGREEMENT:
        return None
    for other in overlays[1:]:
        apart = _seen_at(other.pose, piece) - _seen_at(best.pose, piece)
        elsewhere = np.hypot(*apart) > 0.3 or abs(float(wrap(other.pose[2] - best.pose[2]))) > 0.1
        if elsewhere and other.matched * other.agreement > AMBIGUOUS * best.matched * best.agreement:
            return None
    shift = _seen_at(best.pose, piece) - _seen_at(guess, piece)
    squared = shift @ np.linalg.solve(covariance + 0.05**2 * np.eye(2), shift)
    return best.pose if squared <= GATE else None


def _seen_at(pose: np.ndarray, piece: ClosedMap) -> np.ndarray:
    """(2,) where the piece's middle lies."""
    return np.asarray(pose[:2] + rotate(pose[2], piece.samples.mean(axis=0)))


def _turn_variance(stacked: Stacked, solved: Solved) -> float:
    return float(stacked.covariance[2, 2] - solved.gain[:, 2] @ solved.gain[:, 2])


def _piece(second: ClosedMap, stacked: Stacked, solved: Solved, rows: np.ndarray) -> ClosedMap:
    columns = np.concatenate([np.arange(3), (3 + 2 * rows[:, None] + np.arange(2)).ravel()])
    mean = solved.mean[stacked.start :]
    return ClosedMap(
        mean[columns],
        second.covariance[np.ix_(columns, columns)],
        second.normals[rows],
        second.sightings[rows],
        second.spacing,
    )


def _whole(first: ClosedMap, stacked: Stacked, solved: Solved) -> ClosedMap:
    return msgspec.structs.replace(first, mean=solved.mean[: stacked.start])
