"""Covariances of a map in information form, on demand: of chosen poses and landmarks, or of each by itself."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.slam.submaps.information import (
    Information,
    Leaf,
    gain_of,
    kept_entries,
    private_entries,
    start_matrix,
)
from kalmap.slam.submaps.join import turn_columns
from kalmap.slam.submaps.local_map import LocalMap
from kalmap.slam.submaps.sparse_cholesky import SparseCholesky


class Recovery:
    """The factored information of a joined map, linearised where the map says. map_: one with parts."""

    def __init__(self, map_: LocalMap) -> None:
        self.map = map_
        self.information = Information(map_.leaves, len(map_))
        poses = np.concatenate([map_.frames, map_.end[None]])
        self.poses = np.concatenate([np.zeros((1, 3)), poses])
        shared = map_.landmarks[self.information.shared]
        self.state = np.concatenate([poses.ravel(), shared.ravel()])
        self.factor = SparseCholesky(self.information.linearised(self.state).matrix)
        self._owner = np.full(len(map_), -1)  # of landmarks that one part alone holds
        for number, leaf in enumerate(self.information.leaves):
            self._owner[leaf.part.rows[leaf.private]] = number

    def joint(self, poses: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
        """(3 P + 2 L, the same) by as many solutions. poses: numbers of `frames`, the end last; landmarks: rows."""
        size = 3 * len(poses) + 2 * len(landmarks)
        reads = np.zeros((self.information.size, size))  # what each number wanted reads of the unknowns
        own = np.zeros((size, size))  # and what it has of its own
        index = (3 * np.asarray(poses)[:, None] + np.arange(3)).ravel()
        reads[index, np.arange(len(index))] = 1.0
        place = 3 * len(poses) + 2 * np.arange(len(landmarks))
        owner = self._owner[landmarks]
        common = np.flatnonzero(owner < 0)
        columns = self.information.column(landmarks[common])
        reads[columns, place[common]] = reads[columns + 1, place[common] + 1] = 1.0
        for number in np.unique(owner[owner >= 0]):
            leaf, which = self.information.leaves[number], np.flatnonzero(owner == number)
            columns, matrix, spread = self._private(leaf, number)
            chosen = np.searchsorted(leaf.part.rows[leaf.private], landmarks[which], sorter=self._order(leaf))
            chosen = self._order(leaf)[chosen]
            entries = (2 * chosen[:, None] + np.arange(2)).ravel()
            targets = (place[which][:, None] + np.arange(2)).ravel()
            reads[np.ix_(columns, targets)] = matrix[entries].T
            own[np.ix_(targets, targets)] = spread[np.ix_(entries, entries)]
        whole = reads.T @ self.factor.solve(reads) + own
        return 0.5 * (whole + whole.T)

    def dense(self) -> LocalMap:
        """The map with the full covariance of frames, end, landmarks."""
        poses = np.arange(len(self.map.frames) + 1)
        covariance = self.joint(poses, np.arange(len(self.map)))
        return msgspec.structs.replace(self.map, covariance=covariance)

    def landmarks(self) -> np.ndarray:
        """(N, 2, 2) of every landmark, from the inverse on the factor's own pattern: about as much work as it took."""
        out = np.empty((len(self.map), 2, 2))
        shared = self.information.shared
        first = self.information.column(shared)
        rows = np.concatenate([first, first, first + 1])
        columns = np.concatenate([first, first + 1, first + 1])
        xx, xy, yy = self.factor.inverse_entries(rows, columns).reshape(3, -1)
        out[shared] = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
        for number, leaf in enumerate(self.information.leaves):
            if not len(leaf.private):
                continue
            index, matrix, spread = self._private(leaf, number)
            i, j = np.meshgrid(index, index, indexing="ij")
            block = self.factor.inverse_entries(i.ravel(), j.ravel()).reshape(len(index), -1)
            count = len(leaf.private)
            matrices = matrix.reshape(count, 2, -1)
            both = matrices @ block @ matrices.transpose(0, 2, 1)
            spread = spread.reshape(count, 2, count, 2)[np.arange(count), :, np.arange(count)]
            out[leaf.part.rows[leaf.private]] = both + spread
        return out

    def frames(self) -> np.ndarray:
        """(K + 1, 3, 3) of the frames and of the end."""
        first = 3 * np.arange(len(self.map.frames) + 1)
        i, j = np.meshgrid(np.arange(3), np.arange(3), indexing="ij")
        rows, columns = (first[:, None] + each.ravel()[None] for each in (i, j))
        return self.factor.inverse_entries(rows.ravel(), columns.ravel()).reshape(-1, 3, 3)

    def _order(self, leaf: Leaf) -> np.ndarray:
        return np.argsort(leaf.part.rows[leaf.private])

    def _private(self, leaf: Leaf, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How a leaf's private landmarks follow from the unknowns: index (k,), matrix (2 p, k), spread (2 p, 2 p).

        In the map's frame: they turn and move with the leaf's start, and lean on its end and shared landmarks.
        """
        T_map_start, there = self.poses[number], self.state[leaf.columns]
        gain = gain_of(leaf)
        covariance = leaf.part.map.dense()
        entries = private_entries(leaf)
        spread = covariance[np.ix_(entries, entries)] - gain @ covariance[np.ix_(kept_entries(leaf), entries)]
        spread = turn_columns(turn_columns(spread, T_map_start[2], 0).T, T_map_start[2], 0)
        gain = turn_columns(gain, T_map_start[2], 3)  # reads end and landmarks as they lie in the map
        gain = turn_columns(gain.T, T_map_start[2], 0).T
        if not len(leaf.start):
            return leaf.columns, gain, spread
        points = self.map.landmarks[leaf.part.rows[leaf.private]]
        own = start_matrix(T_map_start, np.concatenate([np.zeros(3), points.ravel()]))[3:]
        by_start = own - gain @ start_matrix(T_map_start, there)
        return np.concatenate([leaf.start, leaf.columns]), np.concatenate([by_start, gain], axis=1), spread
