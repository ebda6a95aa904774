"""Square roots of covariances, semi-definite ones too."""

from __future__ import annotations

import numpy as np

from kalmap.kernels.regression import square_root


class NotPositiveError(ArithmeticError):
    """A matrix that should be a covariance is indefinite."""


def semidefinite_root(cov: np.ndarray) -> np.ndarray:
    """Lower triangular S with S S' = cov; a zero pivot gives a zero column, so a known start needs no jitter.

    cov: (n, n) symmetric. Raises NotPositiveError if it is indefinite.
    """
    n = len(cov)
    try:
        root = np.linalg.cholesky(cov)
        if np.isfinite(root).all():  # numpy hands a NaN through
            return root
    except np.linalg.LinAlgError:
        pass
    root = np.zeros((n, n))
    if not square_root(np.ascontiguousarray(cov, dtype=float), n, root):
        raise NotPositiveError(f"a {n} x {n} covariance is not positive semi-definite")
    return root


def solve_right(right: np.ndarray, root: np.ndarray) -> np.ndarray:
    """X with X root = right, root lower triangular; directions of zero spread get a zero coefficient.

    right: (m, n). root: (n, n). Returns (m, n).
    """
    from scipy.linalg import solve_triangular

    live = np.diagonal(root) > 0.0
    solution = np.zeros_like(right)
    if live.all():
        return solve_triangular(root, right.T, lower=True, trans="T", check_finite=False).T
    part = root[np.ix_(live, live)]
    solution[:, live] = solve_triangular(part, right[:, live].T, lower=True, trans="T", check_finite=False).T
    return solution
