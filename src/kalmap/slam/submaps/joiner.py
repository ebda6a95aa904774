"""How landmark maps are joined: which pairs, in which form, and whether the join is believed."""

from __future__ import annotations

from typing import Protocol

import msgspec
import numpy as np

from kalmap.geometry.ellipses import chi_square
from kalmap.geometry.se2 import compose, rotate
from kalmap.slam.submaps.information import TOLERANCE, Information
from kalmap.slam.submaps.join import NotSettledError, join, joined_record, unpaired
from kalmap.slam.submaps.local_map import LocalMap


class Pairing(Protocol):
    """Says which landmarks of two consecutive maps are the same."""

    def __call__(self, first: LocalMap, second: LocalMap) -> np.ndarray | None:
        """(M, 2) int64 rows of the first and of the second, one-to-one; None where nothing fits together."""
        ...


class ById(msgspec.Struct, frozen=True):
    """The same number is the same landmark."""

    def __call__(self, first: LocalMap, second: LocalMap) -> np.ndarray:
        _, rows, others = np.intersect1d(first.ids, second.ids, assume_unique=True, return_indices=True)
        return np.column_stack([rows, others]).astype(np.int64)


class LandmarkJoiner(msgspec.Struct, frozen=True):
    """Joins two consecutive landmark maps, or says that they do not fit.

    pairing: which landmarks are the same. gate: probability that the joint distance of a right join stays inside;
    beyond it the join is refused. dense_limit: size of the joined state from which on the full covariance is given up
    for the information form. tolerance: of that form's iteration (see `information`).
    """

    pairing: Pairing = ById()
    gate: float = 0.9999
    dense_limit: int = 600
    tolerance: float = TOLERANCE

    def __call__(self, first: LocalMap, second: LocalMap) -> LocalMap | None:
        """The joined map, None where it is refused: outside the gate, or nothing between the two maps settles."""
        pairs = self.pairing(first, second)
        if pairs is None:
            return None
        joined = self._joined(first, second, pairs)
        if joined is None or not len(pairs):
            return joined
        squared = joined.squared - first.squared - second.squared
        return None if squared > chi_square(self.gate, 2 * len(pairs)) else joined

    def _joined(self, first: LocalMap, second: LocalMap, pairs: np.ndarray) -> LocalMap | None:
        """In the form that suits the size; the other one where maps joined before are linearised too far away."""
        size = first.size + second.size - 2 * len(pairs)
        if first.covariance is not None and second.covariance is not None and size <= self.dense_limit:
            try:
                return join(first, second, pairs)
            except NotSettledError:
                pass
        try:
            return join_sparse(first, second, pairs, self.tolerance)
        except NotSettledError:
            return None


def chained(first: LocalMap, second: LocalMap, tolerance: float = TOLERANCE) -> LocalMap:
    """Both maps in the first's frame, with nothing in common but the place where one ends and the other begins."""
    none = np.zeros((0, 2), dtype=np.int64)
    if first.covariance is not None and second.covariance is not None:
        return join(first, second, none)
    return join_sparse(first, second, none, tolerance)


def join_sparse(
    first: LocalMap, second: LocalMap, pairs: np.ndarray, tolerance: float = TOLERANCE
) -> LocalMap:
    """`join` in information form: all parts of both maps solved together, linearised where they are now.

    Also the way from one form to the other: dense maps that are joined so are solved again from their parts. Where a
    part's covariance is singular (a drive without noise in some direction) there is no such form: NotPositiveError.
    """
    mean = _first_guess(first, second, pairs)
    return relinearised(joined_record(first, second, pairs, mean, None, 0.0, first.end_covariance), tolerance)


def relinearised(joined: LocalMap, tolerance: float = TOLERANCE) -> LocalMap:
    """The map solved from all its parts at once, in information form: the most likely state given all of them."""
    if not joined.parts:
        return joined
    information = Information(joined.parts, len(joined))
    poses = np.concatenate([joined.frames, joined.end[None]])
    poses, landmarks, cost, factor = information.solve(poses, joined.landmarks, tolerance)
    last = 3 * len(joined.frames) + np.arange(3)
    unit = np.zeros((information.size, 3))
    unit[last, np.arange(3)] = 1.0
    end_covariance = factor.solve(unit)[last]
    return msgspec.structs.replace(
        joined,
        frames=poses[:-1],
        end=poses[-1],
        landmarks=landmarks,
        squared=cost,
        covariance=None,
        end_covariance=0.5 * (end_covariance + end_covariance.T),
    )


def _first_guess(first: LocalMap, second: LocalMap, pairs: np.ndarray) -> np.ndarray:
    """(n,) frames, end, landmarks with the second map where the first ends."""
    poses = compose(first.end, np.concatenate([second.frames, second.end[None]]))
    landmarks = first.end[:2] + rotate(first.end[2], second.landmarks[unpaired(second, pairs)])
    return np.concatenate(
        [first.frames.ravel(), first.end, poses.ravel(), first.landmarks.ravel(), landmarks.ravel()]
    )
