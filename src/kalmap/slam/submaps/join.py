"""Two consecutive local maps become one, with their full covariance: O(n^2) a pair.

Paz, Tardos & Neira, "Divide and Conquer: EKF SLAM in O(n)", IEEE T-RO 24(5), 2008: the two states are stacked, what
is the same in both is forced to be equal by an observation without noise, the second is moved into the first's frame,
and what is there twice is dropped. The observation is linearised again until nothing moves any more, so that the
result is the most likely state given both maps and not only a step towards it.
"""

from __future__ import annotations

import numpy as np

from kalmap.gaussian.roots import NotPositiveError
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, quarter_turn, rotate
from kalmap.records import EstimationError
from kalmap.slam.submaps.acceleration import Accelerated
from kalmap.slam.submaps.local_map import LocalMap, Part

_ITERATIONS = 100
_SETTLED = 1e-9  # of the state's own scale: what is left then is rounding


class NotSettledError(EstimationError):
    """Two maps contradict each other so much that no iteration finds the state between them."""


def join(first: LocalMap, second: LocalMap, pairs: np.ndarray) -> LocalMap:
    """The map of both drives, in the first's frame.

    second starts where first ends. pairs: (M, 2) int64: row of a landmark in the first, row of the same one in the
    second, one-to-one. The result's `squared` and `degrees` are those of both and of this join (2 M more).

    Raises NotPositiveError if the pairs' innovation covariance is singular, NotSettledError if the iteration does not
    settle, EstimationError if a map holds no covariance.
    """
    pairs = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    stacked = _Stacked(first, second, pairs)
    squared = stacked.solve() if len(pairs) else 0.0
    mean, covariance = stacked.in_first_frame()
    return joined_record(first, second, pairs, mean, covariance, squared)


def joined_record(
    first: LocalMap,
    second: LocalMap,
    pairs: np.ndarray,
    mean: np.ndarray,
    covariance: np.ndarray | None,
    squared: float,
    end_covariance: np.ndarray | None = None,
) -> LocalMap:
    """What the joined map is beside its numbers. mean: (n,) frames, end, landmarks (first's, then what is new)."""
    frames = len(first.frames) + 1 + len(second.frames)
    fresh = unpaired(second, pairs)
    rows = np.empty(len(second), dtype=np.int64)
    rows[pairs[:, 1]] = pairs[:, 0]
    rows[fresh] = len(first) + np.arange(len(fresh))
    counts = first.sightings.copy()
    counts[pairs[:, 0]] += second.sightings[pairs[:, 1]]
    renamed = np.column_stack([second.ids[pairs[:, 1]], first.ids[pairs[:, 0]]])
    renamed = renamed[renamed[:, 0] != renamed[:, 1]]
    end = slice(3 * frames, 3 * frames + 3)
    if end_covariance is None:
        assert covariance is not None
        end_covariance = covariance[end, end].copy()
    return LocalMap(
        end=mean[end].copy(),
        ids=np.concatenate([first.ids, second.ids[fresh]]),
        landmarks=mean[end.stop :].reshape(-1, 2).copy(),
        sightings=np.concatenate([counts, second.sightings[fresh]]),
        covariance=covariance,
        end_covariance=end_covariance,
        frames=mean[: end.start].reshape(-1, 3).copy(),
        parts=(*first.leaves, *(Part(part.map, rows[part.rows]) for part in second.leaves)),
        squared=first.squared + second.squared + squared,
        degrees=first.degrees + second.degrees + 2 * len(pairs),
        aliases=np.concatenate([first.aliases, second.aliases, renamed]),
    )


def unpaired(second: LocalMap, pairs: np.ndarray) -> np.ndarray:
    """Rows of the second map's landmarks that are in no pair."""
    return np.setdiff1d(np.arange(len(second)), pairs[:, 1], assume_unique=True)


class _Stacked:
    """Both maps' states side by side: u (first) and v (second), with covariances and their cross-covariance."""

    def __init__(self, first: LocalMap, second: LocalMap, pairs: np.ndarray) -> None:
        self.first, self.second, self.pairs = first, second, pairs
        self.u, self.v = first.mean, second.mean
        self.cov_u, self.cov_v = first.dense(), second.dense()
        self.cross: np.ndarray | None = None  # none yet: independent
        last = 3 * len(first.frames)
        self.end = np.arange(last, last + 3)
        self.in_u = last + 3 + 2 * pairs[:, :1] + np.arange(2)  # (M, 2) entries of the pairs' landmarks
        self.in_v = 3 * len(second.frames) + 3 + 2 * pairs[:, 1:] + np.arange(2)

    def solve(self) -> float:
        """Force the pairs to be equal. Returns the distance squared that this took."""
        u0, v0 = self.u, self.v
        accelerated = Accelerated()
        for _ in range(_ITERATIONS):
            left, right, innovation, reach = self._linearised(u0, v0)
            factor = _factor(innovation)
            step = _solve(factor, reach)
            move = np.concatenate([u0 - left @ step - self.u, v0 - right @ step - self.v])
            moved = np.abs(move).max()
            move = accelerated.step(np.concatenate([self.u, self.v]), move)
            self.u, self.v = self.u + move[: len(u0)], self.v + move[len(u0) :]
            if not np.isfinite(moved):
                raise NotSettledError("the join of two maps has left all bounds")
            if moved <= _SETTLED * max(1.0, np.abs(self.u).max(), np.abs(self.v).max()):
                break
        else:
            raise NotSettledError("the join of two maps does not settle")
        from scipy.linalg import solve_triangular

        left = solve_triangular(factor, left.T, lower=True, check_finite=False)
        right = solve_triangular(factor, right.T, lower=True, check_finite=False)
        self.cov_u = self.cov_u - left.T @ left
        self.cov_v = self.cov_v - right.T @ right
        self.cross = -left.T @ right
        return float(reach @ step)

    def _linearised(self, u0: np.ndarray, v0: np.ndarray) -> tuple[np.ndarray, ...]:
        """P_u H_u' (n, 2 M), P_v H_v', H P H' (2 M, 2 M) and h(x) + H (x0 - x), linearised at the current state.

        h = l_u - (t + R l_v) for every pair, with t, R of the first's end.
        """
        t, angle = self.u[self.end[:2]], self.u[self.end[2]]
        in_v = self.v[self.in_v]
        turned = rotate(angle, in_v)
        lever = quarter_turn(turned)
        h = self.u[self.in_u] - t - turned
        end = -np.concatenate([np.broadcast_to(np.eye(2), (len(h), 2, 2)), lever[..., None]], axis=2)
        end = end.reshape(-1, 3)  # (2 M, 3)
        back = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])  # R'
        u_rows = self.in_u.ravel()
        left = self.cov_u[:, u_rows] + self.cov_u[:, self.end] @ end.T
        right = -(self.cov_v[:, self.in_v.ravel()].reshape(-1, len(h), 2) @ back).reshape(len(self.v), -1)
        turned_rows = right[self.in_v.ravel()].reshape(len(h), 2, -1)
        innovation = left[u_rows] + end @ left[self.end]
        innovation -= np.einsum("ji,mjk->mik", back, turned_rows).reshape(2 * len(h), -1)
        gone_u, gone_v = u0 - self.u, v0 - self.v
        reach = h.ravel() + gone_u[u_rows] + end @ gone_u[self.end]
        reach -= rotate(angle, gone_v[self.in_v]).ravel()
        return left, right, innovation, reach

    def in_first_frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of frames, end, landmarks of the joined map."""
        fresh = unpaired(self.second, self.pairs)
        poses = 3 * len(self.second.frames) + 3
        kept = np.concatenate([np.arange(poses), (poses + 2 * fresh[:, None] + np.arange(2)).ravel()])
        T_start_end, v = self.u[self.end], self.v[kept]
        moved = compose(T_start_end, v[:poses].reshape(-1, 3))
        points = T_start_end[:2] + rotate(T_start_end[2], v[poses:].reshape(-1, 2))
        places = np.concatenate([moved[:, :2], points]) - T_start_end[:2]
        levers = quarter_turn(places)
        by_end = np.zeros((len(v), 3))  # d moved / d T_start_end
        x = np.concatenate([np.arange(0, poses, 3), np.arange(poses, len(v), 2)])
        by_end[x, 0] = by_end[x + 1, 1] = 1.0
        by_end[x, 2], by_end[x + 1, 2] = levers[:, 0], levers[:, 1]
        by_end[np.arange(2, poses, 3), 2] = 1.0
        n, m = len(self.u), len(v)
        whole = np.empty((n + m, n + m))
        whole[:n, :n] = self.cov_u
        cross = self.cov_u[:, self.end] @ by_end.T
        if self.cross is not None:
            cross += turn_columns(self.cross[:, kept], T_start_end[2], poses)
        own = turn_columns(self.cov_v[np.ix_(kept, kept)], T_start_end[2], poses)
        own = turn_columns(own.T, T_start_end[2], poses)
        mixed = by_end @ (cross[self.end] - 0.5 * self.cov_u[np.ix_(self.end, self.end)] @ by_end.T)
        own += mixed + mixed.T
        whole[:n, n:], whole[n:, :n], whole[n:, n:] = cross, cross.T, own
        order = np.concatenate([np.arange(self.end[-1] + 1), n + np.arange(poses)])
        order = np.concatenate([order, np.arange(self.end[-1] + 1, n), n + np.arange(poses, m)])
        mean = np.concatenate([self.u, moved.ravel(), points.ravel()])[order]
        headings = np.arange(2, self.end[-1] + 1 + poses, 3)
        mean[headings] = wrap(mean[headings])
        whole = whole[np.ix_(order, order)]
        return mean, 0.5 * (whole + whole.T)


def turn_columns(matrix: np.ndarray, angle: float, poses: int) -> np.ndarray:
    """matrix (q, n) with every x, y of its columns turned; the first `poses` columns are x, y, heading triples."""
    turned = np.array(matrix)
    x = np.concatenate([np.arange(0, poses, 3), np.arange(poses, matrix.shape[1], 2)])
    c, s = np.cos(angle), np.sin(angle)
    turned[:, x] = c * matrix[:, x] - s * matrix[:, x + 1]
    turned[:, x + 1] = s * matrix[:, x] + c * matrix[:, x + 1]
    return turned


def _factor(innovation: np.ndarray) -> np.ndarray:
    """The lower Cholesky factor."""
    try:
        factor = np.linalg.cholesky(0.5 * (innovation + innovation.T))
    except np.linalg.LinAlgError:
        factor = np.full((1, 1), np.nan)
    if not np.isfinite(factor).all():
        raise NotPositiveError("the innovation covariance of a join is not positive definite")
    return factor


def _solve(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    from scipy.linalg import cho_solve

    return cho_solve((factor, True), right, check_finite=False)
