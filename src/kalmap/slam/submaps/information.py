"""Joined maps in information form: every map that was never joined is one factor, the rest is sparse.

Huang, Wang, Dissanayake & Frese, "Iterated SLSJF" (ACRA 2008; SLSJF: IEEE T-RO 24(5), 2008). The unknowns are where
the maps began and ended, and the landmarks that two or more of them hold. What only one map holds is left out without
any loss, also without any linearisation: in its own frame that map is exactly Gaussian, so leaving a landmark out is
dropping its rows, and it follows from the others in the end.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from kalmap.gaussian.roots import NotPositiveError
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import quarter_turn, rotate
from kalmap.slam.submaps.acceleration import Accelerated
from kalmap.slam.submaps.join import NotSettledError, turn_columns
from kalmap.slam.submaps.local_map import Part
from kalmap.slam.submaps.sparse_cholesky import SparseCholesky

_ITERATIONS = 100
TOLERANCE = 1e-12  # of the squared Mahalanobis length of the next step: far below what any map can tell


class Leaf(msgspec.Struct, frozen=True, eq=False):
    """One map as a factor on its start, its end and its shared landmarks.

    part: the map and its rows. shared, private: rows of its own landmarks, the shared ones in the unknowns'
    order. mean: (k,) end and shared landmarks; information: (k, k). columns: (k,) of these among the unknowns;
    start: (3,) of its start, empty where that is the origin.
    """

    part: Part
    shared: np.ndarray
    private: np.ndarray
    mean: np.ndarray
    information: np.ndarray
    columns: np.ndarray
    start: np.ndarray


class Linearised(msgspec.Struct, eq=False):
    """The normal equations at a state: cost (sum of squares), upper triangle of the matrix, gradient (half of it)."""

    cost: float
    matrix: Any
    gradient: np.ndarray


class Information:
    """The joint problem of some maps. parts: in the order of the drive; count: how many landmarks there are in all.

    Unknowns: T_start_frame of the second, third, ... part and of the end of the last one (3 each), then the shared
    landmarks (2 each). Raises NotPositiveError if a map's covariance is singular: it has no information form.
    """

    def __init__(self, parts: tuple[Part, ...], count: int) -> None:
        self.parts, self.count = parts, count
        seen = np.bincount(np.concatenate([part.rows for part in parts]), minlength=count)
        self.shared = np.flatnonzero(seen > 1)
        self._column = np.full(count, -1, dtype=np.int64)
        self._column[self.shared] = 3 * len(parts) + 2 * np.arange(len(self.shared))
        self.size = 3 * len(parts) + 2 * len(self.shared)
        self.leaves = [self._leaf(number, part) for number, part in enumerate(parts)]
        self._pattern()

    def _leaf(self, number: int, part: Part) -> Leaf:
        columns = self._column[part.rows]
        private = np.flatnonzero(columns < 0)
        shared = np.flatnonzero(columns >= 0)
        shared = shared[np.argsort(columns[shared])]
        entries = np.concatenate([np.arange(3), (3 + 2 * shared[:, None] + np.arange(2)).ravel()])
        frame = np.arange(3 * number, 3 * number + 3)
        return Leaf(
            part=part,
            shared=shared,
            private=private,
            mean=part.map.mean[entries],
            information=_inverse(part.map.dense()[np.ix_(entries, entries)]),
            columns=np.concatenate([frame, (columns[shared][:, None] + np.arange(2)).ravel()]),
            start=frame - 3 if number else frame[:0],
        )

    def _pattern(self) -> None:
        """Where each leaf's numbers go in the matrix."""
        rows, columns = [], []
        for leaf in self.leaves:
            index = np.concatenate([leaf.start, leaf.columns])  # ascending, so that upper stays upper
            upper = np.triu_indices(len(index))
            rows.append(index[upper[0]].astype(np.int32))
            columns.append(index[upper[1]].astype(np.int32))
        self._rows, self._columns = np.concatenate(rows), np.concatenate(columns)

    def column(self, rows: np.ndarray) -> np.ndarray:
        """Where shared landmarks are among the unknowns; -1 for one that a single map holds."""
        return self._column[rows]

    # --- the solution -----------------------------------------------------------------------------------------

    def solve(
        self, frames: np.ndarray, landmarks: np.ndarray, tolerance: float = TOLERANCE
    ) -> tuple[np.ndarray, np.ndarray, float, SparseCholesky]:
        """The most likely state, by Gauss-Newton from a first guess.

        frames: (parts, 3), the end last; landmarks: (count, 2) of all landmarks. Returns both, the sum of squares
        there, and the factored information matrix. Raises NotSettledError if it does not settle.
        """
        state = np.concatenate([frames.ravel(), landmarks[self.shared].ravel()])
        here = self.linearised(state)
        accelerated = Accelerated()
        for _ in range(_ITERATIONS):
            factor = SparseCholesky(here.matrix)
            step = -factor.solve(here.gradient)
            length = -float(here.gradient @ step)
            if not np.isfinite(length) or length < -1e-9 * (1.0 + here.cost):
                raise NotPositiveError("the information matrix of the joined maps is not positive definite")
            if length <= tolerance:
                return *self._state(state + step), here.cost - max(length, 0.0), factor
            state, here = self._step(state, step, here, accelerated)
        raise NotSettledError("the joint solution of the local maps does not settle")

    def _step(
        self, state: np.ndarray, step: np.ndarray, here: Linearised, accelerated: Accelerated
    ) -> tuple[np.ndarray, Linearised]:
        """The accelerated step, or as much of the plain one as makes the cost smaller."""
        bound = here.cost * (1.0 + 1e-9) + 1e-9
        there = state + accelerated.step(state, step)
        found = self.linearised(there)
        scale = 1.0
        while found.cost > bound and scale > 1e-3:
            accelerated.clear()
            there = state + scale * step
            found = self.linearised(there)
            scale *= 0.5
        return there, found

    def linearised(self, state: np.ndarray) -> Linearised:
        """The normal equations at a state."""
        poses = np.concatenate([np.zeros(3), state[: 3 * len(self.parts)]]).reshape(-1, 3)
        gradient, cost, pieces = np.zeros(self.size), 0.0, []
        for number, leaf in enumerate(self.leaves):
            T_map_start = poses[number]
            there = state[leaf.columns]
            residual = self._local(T_map_start, there) - leaf.mean
            residual[2] = wrap(residual[2])
            pulled = leaf.information @ residual
            cost += float(residual @ pulled)
            pulled = turn_columns(pulled[None], T_map_start[2], 3)[0]
            gradient[leaf.columns] += pulled
            turned = turn_columns(leaf.information, T_map_start[2], 3)
            turned = turn_columns(turned.T, T_map_start[2], 3)
            if len(leaf.start):
                by_start = start_matrix(T_map_start, there)
                gradient[leaf.start] -= by_start.T @ pulled
                side = by_start.T @ turned
                turned = np.block([[side @ by_start, -side], [-side.T, turned]])
            pieces.append(turned[np.triu_indices(len(turned))])
        return Linearised(cost, self._matrix(pieces), gradient)

    def _matrix(self, pieces: list[np.ndarray]) -> Any:
        from scipy.sparse import csc_matrix

        entries = np.concatenate(pieces), (self._rows, self._columns)
        return csc_matrix(entries, shape=(self.size, self.size))

    @staticmethod
    def _local(T_map_start: np.ndarray, there: np.ndarray) -> np.ndarray:
        """(k,) end and landmarks of a part, given in the map, in its own frame."""
        local = np.array(there)
        local[2] -= T_map_start[2]
        local[:2] -= T_map_start[:2]
        local[3:].reshape(-1, 2)[:] -= T_map_start[:2]
        return turn_columns(local[None], -T_map_start[2], 3)[0]

    def _state(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frames (parts, 3) and all landmarks (count, 2), those of one map alone as they follow from the others."""
        frames = state[: 3 * len(self.parts)].reshape(-1, 3).copy()
        landmarks = np.zeros((self.count, 2))
        landmarks[self.shared] = state[3 * len(self.parts) :].reshape(-1, 2)
        poses = np.concatenate([np.zeros((1, 3)), frames])
        for number, leaf in enumerate(self.leaves):
            if not len(leaf.private):
                continue
            residual = self._local(poses[number], state[leaf.columns]) - leaf.mean
            residual[2] = wrap(residual[2])
            local = leaf.part.map.landmarks[leaf.private] + (gain_of(leaf) @ residual).reshape(-1, 2)
            landmarks[leaf.part.rows[leaf.private]] = poses[number, :2] + rotate(poses[number, 2], local)
        frames[:, 2] = wrap(frames[:, 2])
        return frames, landmarks


def start_matrix(T_map_start: np.ndarray, there: np.ndarray) -> np.ndarray:
    """(k, 3): how end and landmarks (k,) go along when a part's start moves and they stay where they are in it."""
    matrix = np.zeros((len(there), 3))
    points = np.concatenate([there[None, :2], there[3:].reshape(-1, 2)]) - T_map_start[:2]
    lever = quarter_turn(points)
    x = np.concatenate([[0], np.arange(3, len(there), 2)])
    matrix[x, 0] = matrix[x + 1, 1] = matrix[2, 2] = 1.0
    matrix[x, 2], matrix[x + 1, 2] = lever[:, 0], lever[:, 1]
    return matrix


def private_entries(leaf: Leaf) -> np.ndarray:
    """(2 p,) where a leaf's private landmarks are in its own state."""
    return (3 + 2 * leaf.private[:, None] + np.arange(2)).ravel()


def kept_entries(leaf: Leaf) -> np.ndarray:
    """(k,) where its end and shared landmarks are in its own state."""
    return np.concatenate([np.arange(3), (3 + 2 * leaf.shared[:, None] + np.arange(2)).ravel()])


def gain_of(leaf: Leaf) -> np.ndarray:
    """(2 p, k): what the private landmarks follow from end and shared ones, in the leaf's own frame."""
    covariance = leaf.part.map.dense()
    return covariance[np.ix_(private_entries(leaf), kept_entries(leaf))] @ leaf.information


def _inverse(covariance: np.ndarray) -> np.ndarray:
    try:
        root = np.linalg.inv(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError as problem:
        raise NotPositiveError(
            "a local map's covariance is singular: it has no information form"
        ) from problem
    return root.T @ root
