"""A sparse positive definite matrix, factored: by QDLDL (Apache-2) where it is installed, else by SciPy's SuperLU."""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmap.gaussian.roots import NotPositiveError
from kalmap.kernels import sparse_inverse


class SparseCholesky:
    """P A P' = L D L'. upper: the upper triangle of A, a scipy CSC matrix with every diagonal entry.

    Raises NotPositiveError if A is not positive definite. library: "qdldl", "superlu", None for what there is.
    """

    def __init__(self, upper: Any, library: str | None = None) -> None:
        self.n = upper.shape[0]
        self._lower: tuple[np.ndarray, ...] | None = None
        self._selected: tuple[np.ndarray, np.ndarray] | None = None
        self._solver = _superlu(upper) if (library or _library()) == "superlu" else _qdldl(upper)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """A^-1 right for (n,) or (n, q)."""
        if right.ndim == 1:
            return np.asarray(self._solver.solve(right))
        return np.column_stack([self._solver.solve(np.ascontiguousarray(column)) for column in right.T])

    def inverse_entries(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Entries of A^-1 where A itself has entries, (K,), without the rest of it."""
        starts, indices, lower, d, order = self._factors()
        if self._selected is None:
            inverse, diagonal = np.empty(len(lower)), np.empty(self.n)
            sparse_inverse.selected_inverse(starts, indices, lower, d, inverse, diagonal)
            self._selected = inverse, diagonal
        inverse, diagonal = self._selected
        place = np.empty(self.n, dtype=np.int64)
        place[order] = np.arange(self.n)
        out = np.empty(len(rows))
        missing = sparse_inverse.entries_of(
            starts, indices, inverse, diagonal, place[rows], place[columns], out
        )
        if missing >= 0:
            raise ValueError(f"entry {rows[missing]}, {columns[missing]} is not on the factor's pattern")
        return out

    def _factors(self) -> tuple[np.ndarray, ...]:
        """Column starts, rows and values of the strictly lower L, D, and the order of elimination."""
        if self._lower is None:
            lower, d, order = self._solver.factors()
            lower.sort_indices()
            starts, rows = lower.indptr.astype(np.int64), lower.indices.astype(np.int64)
            self._lower = starts, rows, lower.data, np.asarray(d), np.asarray(order, dtype=np.int64)
        return self._lower


def _library() -> str:
    from importlib.util import find_spec

    return "superlu" if find_spec("qdldl") is None else "qdldl"


def _qdldl(upper: Any) -> Any:
    import qdldl

    try:
        solver = qdldl.Solver(upper, upper=True)
    except (ValueError, RuntimeError) as problem:  # a zero pivot
        raise NotPositiveError(
            "the information matrix of the joined maps is not positive definite"
        ) from problem
    return solver


class _superlu:
    """SuperLU in its symmetric mode: with the pivots on the diagonal, U = D L'."""

    def __init__(self, upper: Any) -> None:
        from scipy.sparse import triu
        from scipy.sparse.linalg import splu

        whole = (upper + triu(upper, 1).T).tocsc()
        options = {"SymmetricMode": True, "Equil": False}
        try:
            self._lu = splu(whole, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        except RuntimeError as problem:
            raise NotPositiveError(
                "the information matrix of the joined maps is not positive definite"
            ) from problem

    def solve(self, right: np.ndarray) -> np.ndarray:
        return self._lu.solve(right)

    def factors(self) -> tuple[Any, np.ndarray, np.ndarray]:
        from scipy.sparse import tril

        return tril(self._lu.L, -1).tocsc(), self._lu.U.diagonal(), np.argsort(self._lu.perm_c)
