"""The covariance of frames from the information that relations give them: whole, or as much as is asked for."""

from __future__ import annotations

from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.sparse import coo_matrix, triu

from kalmap.slam.submaps.sparse_cholesky import SparseCholesky

DENSE_FRAMES = 150
"""Up to so many frames a full inverse is quicker than a sparse factor and its columns."""


class Spread(Protocol):
    """What is asked of the information matrix of frames 1 to n; frame 0 is known exactly."""

    def solve(self, right: np.ndarray) -> np.ndarray:
        """(3 n,) information^-1 right."""
        ...

    def block(self, first: int, second: int) -> np.ndarray:
        """(3, 3) covariance of two frames, zero where one of them is frame 0."""
        ...

    def own(self) -> np.ndarray:
        """(n + 1, 3, 3) of every frame."""
        ...


def spread_of(rows: np.ndarray, columns: np.ndarray, values: np.ndarray, count: int) -> Spread:
    """From triplets of the information matrix of `count` numbers, which add up: dense while that is quicker."""
    matrix = coo_matrix((values, (rows, columns)), shape=(count, count))
    return (
        Dense(matrix.toarray()) if count <= 3 * DENSE_FRAMES else Sparse(triu(matrix.tocsc(), format="csc"))
    )


class Dense:
    """By a full inverse, once a covariance is asked for: to solve takes a quarter of its time."""

    def __init__(self, information: np.ndarray) -> None:
        self._information = information

    @cached_property
    def _covariance(self) -> np.ndarray:
        return np.linalg.inv(self._information)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """See `Spread`."""
        return np.linalg.solve(self._information, right)

    def block(self, first: int, second: int) -> np.ndarray:
        """See `Spread`."""
        if not first or not second:
            return np.zeros((3, 3))
        return self._covariance[3 * first - 3 : 3 * first, 3 * second - 3 : 3 * second].copy()

    def own(self) -> np.ndarray:
        """See `Spread`."""
        count = len(self._covariance) // 3
        blocks = self._covariance.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count)]
        return np.concatenate([np.zeros((1, 3, 3)), blocks])


class Sparse:
    """By a sparse Cholesky factor: each frame's own covariance from the selected inverse, of two frames by columns.

    upper: the upper triangle as a csc matrix.
    """

    def __init__(self, upper: object) -> None:
        self._factor = SparseCholesky(upper)
        self._columns: dict[int, np.ndarray] = {}
        self._own: np.ndarray | None = None

    def solve(self, right: np.ndarray) -> np.ndarray:
        """See `Spread`."""
        return self._factor.solve(right)

    def block(self, first: int, second: int) -> np.ndarray:
        """See `Spread`."""
        if not first or not second:
            return np.zeros((3, 3))
        if first == second:
            return np.asarray(self.own()[first])
        return self._column(second)[3 * first - 3 : 3 * first].copy()

    def own(self) -> np.ndarray:
        """See `Spread`."""
        if self._own is None:
            entries = np.arange(self._factor.n).reshape(-1, 3)
            low, high = np.broadcast_arrays(entries[:, :, None], entries[:, None, :])
            rows, columns = np.minimum(low, high).ravel(), np.maximum(low, high).ravel()
            try:
                blocks = self._factor.inverse_entries(rows, columns).reshape(-1, 3, 3)
            except ValueError:  # not every factor keeps all entries of the matrix: by columns, then
                count = self._factor.n // 3
                blocks = np.array([self._column(k)[3 * k - 3 : 3 * k] for k in range(1, count + 1)])
            self._own = np.concatenate([np.zeros((1, 3, 3)), blocks])
        return self._own

    def _column(self, frame: int) -> np.ndarray:
        """(3 n, 3) of the covariance."""
        if frame not in self._columns:
            unit = np.zeros((self._factor.n, 3))
            unit[3 * frame - 3 : 3 * frame] = np.eye(3)
            self._columns[frame] = self._factor.solve(unit)
        return self._columns[frame]
