"""Two contour maps as one Gaussian, and linear constraints on it: the algebra of joins."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from scipy.linalg import lapack, solve_triangular
from scipy.sparse import csr_array

from kalmap.gaussian import NotPositiveError
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, quarter_turn, rotate
from kalmap.slam.contours.closed import ClosedMap

_DEAD = 1e-10  # share of a constraint's own variance, given the others, below which it is implied by them
_NEGATIVE = -1e-7  # the same share where rounding cannot explain it any more


class Constraint(msgspec.Struct, frozen=True, eq=False):
    """M scalars that are 0 but for their noise.

    matrix: (M, n) sparse. value: (M,) where it was linearised. noise: (M, M).
    """

    matrix: Any
    value: np.ndarray
    noise: np.ndarray


class Stacked:
    """Equations (14) to (16): the first map, then the second, each pose and samples in its own frame.

    mean: (n,). covariance: (n, n). The second's frame is the first's end pose, `mean[:3]`.
    """

    def __init__(self, first: ClosedMap, second: ClosedMap) -> None:
        self.counts = len(first.samples), len(second.samples)
        self.start = len(first.mean)  # of the second map
        self.mean = np.concatenate([first.mean, second.mean])
        size = len(self.mean)
        self.covariance = np.zeros((size, size))
        self.covariance[: self.start, : self.start] = first.covariance
        self.covariance[self.start :, self.start :] = second.covariance

    def first(self, mean: np.ndarray) -> np.ndarray:
        """(N1, 2) samples of the first map."""
        return mean[3 : self.start].reshape(-1, 2)

    def second(self, mean: np.ndarray) -> np.ndarray:
        """(N2, 2) samples of the second map, in its own frame."""
        return mean[self.start + 3 :].reshape(-1, 2)

    def placed(self, mean: np.ndarray) -> np.ndarray:
        """(N2, 2) samples of the second map in the first's frame."""
        return mean[:2] + rotate(mean[2], self.second(mean))

    def rows(self, mean: np.ndarray, which: np.ndarray, slopes: np.ndarray) -> Any:
        """(M, n) sparse: derivatives of slope . place of samples, in the first map's frame.

        which: (M,) row of the sample, those of the second map counted on behind the first's. slopes: (M, 2).
        """
        which, slopes = np.asarray(which, dtype=np.int64), np.asarray(slopes, dtype=float)
        of_second = which >= self.counts[0]
        columns = np.where(of_second, self.start + 3 + 2 * (which - self.counts[0]), 3 + 2 * which)
        own = np.where(of_second[:, None], rotate(-mean[2], slopes), slopes)
        number = np.arange(len(which))
        arms = rotate(mean[2], self.second(mean)[which[of_second] - self.counts[0]])
        turn = (slopes[of_second] * quarter_turn(arms)).sum(axis=1)
        values = [own[:, 0], own[:, 1], slopes[of_second, 0], slopes[of_second, 1], turn]
        at = [number, number, *[number[of_second]] * 3]
        to = [columns, columns + 1, *(np.full(int(of_second.sum()), axis) for axis in range(3))]
        shape = (len(which), len(mean))
        return csr_array((np.concatenate(values), (np.concatenate(at), np.concatenate(to))), shape=shape)


class Solved(msgspec.Struct, frozen=True, eq=False):
    """A conditioned Gaussian: mean (n,), squared distance of the constraints, its degrees of freedom.

    gain: (k, n): the covariance is `prior - gain' gain`.
    """

    mean: np.ndarray
    distance: float
    freedom: int
    gain: np.ndarray

    def covariance(self, prior: np.ndarray) -> np.ndarray:
        """(n, n)."""
        return prior - self.gain.T @ self.gain

    def spread(self, prior: np.ndarray, rows: Any) -> np.ndarray:
        """(M, M) covariance of linear functions `rows` (M, n) sparse."""
        part = rows @ self.gain.T
        return np.asarray(rows @ (rows @ prior).T) - part @ part.T


def condition(
    prior_mean: np.ndarray, prior: np.ndarray, constraints: list[Constraint], at: np.ndarray
) -> Solved:
    """One block update (equations (7) to (11)) from the prior, the constraints linearised `at` (n,).

    Where constraints follow from each other, as zero-noise ones may, the redundant ones are passed over: Cholesky's
    factor with pivots, on the innovation covariance scaled to ones. Raises NotPositiveError if that is indefinite.
    """
    if not sum(len(each.value) for each in constraints):
        return Solved(prior_mean.copy(), 0.0, 0, np.zeros((0, len(prior_mean))))
    off = difference(prior_mean, at)
    spread = np.concatenate([each.matrix @ prior for each in constraints])
    innovation = np.concatenate([-each.value - each.matrix @ off for each in constraints])
    total = np.concatenate([np.asarray(each.matrix @ spread.T) for each in constraints])
    begin = 0
    for each in constraints:
        end = begin + len(each.value)
        total[begin:end, begin:end] += each.noise
        begin = end
    root, order, scale = _pivoted_root(0.5 * (total + total.T))
    right = np.column_stack([spread, innovation])[order] / scale[order, None]
    white = solve_triangular(root, right, lower=True, check_finite=False)
    mean = prior_mean + white[:, :-1].T @ white[:, -1]
    return Solved(mean, float(white[:, -1] @ white[:, -1]), len(order), white[:, :-1])


def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a - b; the first heading, the only one that constraints read, wrapped."""
    away = a - b
    away[2] = wrap(away[2])
    return away


def _pivoted_root(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower root (k, k) of the rows `order` (k,) that do not follow from the others, of the matrix scaled by 1 / scale.

    Raises NotPositiveError if the matrix is indefinite.
    """
    diagonal = np.diagonal(matrix)
    if not (diagonal >= 0.0).all():
        raise NotPositiveError("the innovation covariance of a join is indefinite")
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = matrix / np.outer(scale, scale)
    factor, pivots, rank, _ = lapack.dpstrf(scaled, tol=_DEAD, lower=1)
    order = pivots[:rank] - 1
    root = np.tril(factor[:rank, :rank])
    rest = pivots[rank:] - 1
    if len(rest):
        below = np.tril(factor)[rank:, :rank]
        left = np.diagonal(scaled)[rest] - (below**2).sum(axis=1)
        if left.min() < _NEGATIVE:
            raise NotPositiveError("the innovation covariance of a join is indefinite")
    return root, order, scale


def in_first_frame(
    stacked: Stacked, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Equation (23): end of the second map, samples of the first, samples of the second, all in the first's frame.

    Returns mean (3 + 2 (N1 + N2),) and covariance, by the exact Jacobian.
    """
    begin, n1 = stacked.start, stacked.counts[0]
    end = compose(mean[:3], mean[begin : begin + 3])
    joined = np.concatenate([end, stacked.first(mean).ravel(), stacked.placed(mean).ravel()])
    half = _moved_rows(stacked, mean, covariance, end, n1)
    moved = _moved_rows(stacked, mean, np.ascontiguousarray(half.T), end, n1)
    return joined, 0.5 * (moved + moved.T)


def _moved_rows(
    stacked: Stacked, mean: np.ndarray, matrix: np.ndarray, end: np.ndarray, n1: int
) -> np.ndarray:
    """Jacobian times a matrix (n, m): (3 + 2 (N1 + N2), m)."""
    begin = stacked.start
    pose, own = matrix[:3], matrix[begin : begin + 3]
    c, s = np.cos(mean[2]), np.sin(mean[2])
    out = np.empty((len(matrix) - 3, matrix.shape[1]))
    arm = quarter_turn(end[:2] - mean[:2])
    out[0] = pose[0] + arm[0] * pose[2] + c * own[0] - s * own[1]
    out[1] = pose[1] + arm[1] * pose[2] + s * own[0] + c * own[1]
    out[2] = pose[2] + own[2]
    out[3 : 3 + 2 * n1] = matrix[3:begin]
    samples = matrix[begin + 3 :].reshape(-1, 2, matrix.shape[1])
    arms = quarter_turn(stacked.placed(mean) - mean[:2])
    there = out[3 + 2 * n1 :].reshape(-1, 2, matrix.shape[1])
    there[:, 0] = pose[0] + arms[:, :1] * pose[2] + c * samples[:, 0] - s * samples[:, 1]
    there[:, 1] = pose[1] + arms[:, 1:] * pose[2] + s * samples[:, 0] + c * samples[:, 1]
    return out
