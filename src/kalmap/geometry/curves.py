"""Implicit polynomial curves p(x, y) = 0 of order 1 to 3 in the plane.

p is ten coefficients on [1, u, v, u2, uv, v2, u3, u2v, uv2, v3], where u and v are x and y about an origin in units of
a scale, so that the numbers stay near one. Coefficients above the curve's order are zero.
"""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.geometry.se2 import rotate

POWERS = np.array([(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)])
"""(10, 2) powers of u and v in each term."""

TERMS_OF_ORDER = (1, 3, 6, 10)
"""How many terms a polynomial of that order has; they come first."""


def monomials(uv: np.ndarray, by: tuple[int, int] = (0, 0)) -> np.ndarray:
    """The terms (..., 10) at points (..., 2), or their derivative, taken `by` so many times along u and v."""
    result = np.ones((*uv.shape[:-1], 10))
    for axis in range(2):
        power = POWERS[:, axis]
        factor = np.ones(10)
        for k in range(by[axis]):
            factor = factor * np.maximum(power - k, 0)
        result = result * factor * uv[..., axis, None] ** np.maximum(power - by[axis], 0)
    return result


def substitution(matrix: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """S (10, 10) with p(matrix uv + offset) = (S c) . monomials(uv): the coefficients in other coordinates.

    matrix: (2, 2). offset: (2,). Exact: the terms are multiplied out.
    """
    result = np.zeros((10, 10))
    axes = [{(0, 0): offset[k], (1, 0): matrix[k, 0], (0, 1): matrix[k, 1]} for k in range(2)]
    place = {(int(i), int(j)): row for row, (i, j) in enumerate(POWERS)}
    for column, powers in enumerate(POWERS):
        product = {(0, 0): 1.0}
        for axis in range(2):
            for _ in range(powers[axis]):
                grown: dict[tuple[int, int], float] = {}
                for (i, j), a in product.items():
                    for (m, n), b in axes[axis].items():
                        grown[i + m, j + n] = grown.get((i + m, j + n), 0.0) + a * b
                product = grown
        for power, value in product.items():
            result[place[power], column] = value
    return result


class Curve(msgspec.Struct, frozen=True, eq=False):
    """A curve, with the uncertainty of its coefficients.

    coefficients: (10,). origin: (2,) m. scale: m. order: 1, 2 or 3. covariance: (10, 10) of the coefficients, of which
    those above the order have none; None: taken as exact. All methods take points (..., 2) m.
    """

    coefficients: np.ndarray
    origin: np.ndarray
    scale: float = 1.0
    order: int = 1
    covariance: np.ndarray | None = None

    def _at(self, points: np.ndarray) -> np.ndarray:
        return (np.asarray(points, dtype=float) - self.origin) / self.scale

    def value(self, points: np.ndarray) -> np.ndarray:
        """p (...)."""
        return monomials(self._at(points)) @ self.coefficients

    def gradient(self, points: np.ndarray) -> np.ndarray:
        """Derivatives of p by x and y (..., 2), 1/m."""
        at = self._at(points)
        sides = [monomials(at, by) @ self.coefficients for by in ((1, 0), (0, 1))]
        return np.stack(sides, axis=-1) / self.scale

    def hessian(self, points: np.ndarray) -> np.ndarray:
        """Second derivatives of p (..., 2, 2), 1/m^2."""
        at = self._at(points)
        xx, xy, yy = (monomials(at, by) @ self.coefficients for by in ((2, 0), (1, 1), (0, 2)))
        rows = [np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)]
        return np.stack(rows, axis=-2) / self.scale**2

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance g = p / |grad p| (...), m: exact for a line, to first order otherwise (Sun et al. 2010, (3)).

        NaN where the gradient vanishes.
        """
        return self.distance_and_gradient(points)[0]

    def distance_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """g (...) m, and its exact gradient (..., 2): grad p / |grad p| - p H grad p / |grad p|^3."""
        p, slope, hessian = self.value(points), self.gradient(points), self.hessian(points)
        squared = np.sum(slope**2, axis=-1)
        steep = np.sqrt(np.where(squared > 0.0, squared, np.nan))
        turned = np.einsum("...ij,...j->...i", hessian, slope)
        gradient = slope / steep[..., None] - (p / steep**3)[..., None] * turned
        return p / steep, gradient

    def noise_rows(self, points: np.ndarray) -> np.ndarray:
        """Derivative of the distance by the coefficients (..., 10) for points near the curve: phi / |grad p|, m."""
        steep = np.linalg.norm(self.gradient(points), axis=-1, keepdims=True)
        return monomials(self._at(points)) / steep

    def distance_covariance(self, points: np.ndarray) -> np.ndarray:
        """Of the distances at N points (N, 2), what the curve's own uncertainty makes it: (N, N) m^2."""
        if self.covariance is None:
            return np.zeros((len(points), len(points)))
        rows = self.noise_rows(points)
        return np.asarray(rows @ self.covariance @ rows.T)

    def curvature(self, points: np.ndarray) -> np.ndarray:
        """Signed curvature (...) 1/m of the level line through each point: positive for a circle whose p grows
        outwards."""
        slope, hessian = self.gradient(points), self.hessian(points)
        across = np.stack([-slope[..., 1], slope[..., 0]], axis=-1)
        bent = np.einsum("...i,...ij,...j->...", across, hessian, across)
        return bent / np.linalg.norm(slope, axis=-1) ** 3

    def project(self, points: np.ndarray, iterations: int = 12) -> np.ndarray:
        """The feet (..., 2) of points on the curve, by Newton's method on p = 0 and (point - foot) x grad p = 0.

        For points that are near the curve beside its radius of curvature; NaN where the method does not end on it.
        """
        target = np.asarray(points, dtype=float)
        foot = target.copy()
        for _ in range(iterations):
            away, slope, hessian = target - foot, self.gradient(foot), self.hessian(foot)
            across = away[..., 0] * slope[..., 1] - away[..., 1] * slope[..., 0]
            turned = away[..., :1] * hessian[..., 1, :] - away[..., 1:] * hessian[..., 0, :]
            second = turned + np.stack([-slope[..., 1], slope[..., 0]], axis=-1)
            det = slope[..., 0] * second[..., 1] - slope[..., 1] * second[..., 0]
            p = self.value(foot)
            with np.errstate(divide="ignore", invalid="ignore"):
                step = np.stack(
                    [
                        across * slope[..., 1] - p * second[..., 1],
                        p * second[..., 0] - across * slope[..., 0],
                    ],
                    axis=-1,
                )
                step = step / det[..., None]
                length = np.linalg.norm(step, axis=-1, keepdims=True) / self.scale
                foot = foot + np.where(length > 0.5, 0.5 / length, 1.0) * step
        with np.errstate(invalid="ignore"):
            on = np.abs(self.distance(foot)) < 1e-6 * self.scale
        return np.where(on[..., None], foot, np.nan)

    def moved(self, T_a_b: np.ndarray) -> Curve:
        """The same curve in frame a, itself in frame b, whose pose in a is T_a_b (3,). Exact, covariance included."""
        c, s = np.cos(T_a_b[2]), np.sin(T_a_b[2])
        origin = np.asarray(T_a_b[:2] + rotate(T_a_b[2], self.origin))
        return self._rewritten(np.array([[c, s], [-s, c]]), np.zeros(2), origin, self.scale)

    def recentred(self, origin: np.ndarray, scale: float) -> Curve:
        """The same curve about another origin (2,) m, in another scale m."""
        origin = np.asarray(origin, dtype=float)
        offset = (origin - self.origin) / self.scale
        return self._rewritten(np.eye(2) * scale / self.scale, offset, origin, scale)

    def _rewritten(self, matrix: np.ndarray, offset: np.ndarray, origin: np.ndarray, scale: float) -> Curve:
        change = substitution(matrix, offset)
        covariance = None if self.covariance is None else change @ self.covariance @ change.T
        return Curve(change @ self.coefficients, origin, scale, self.order, covariance)
