"""The simplest curve through measured points: a line if that explains them, else a conic, else a cubic."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.geometry.curves import Curve

_FREE = (0, 2, 5, 9)  # coefficients of each order, but for one common factor
_SURPRISE = 3.0  # standard deviations by which chi-square may exceed its mean
_MARGIN = 0.05  # m beyond the ends in which a curve must still be sound


class CurveFit(msgspec.Struct, frozen=True, eq=False):
    """curve: with its covariance. residuals: (N,) m, signed distances of the points. chi2: their sum of squares by the
    points' noise. freedom: what chi2 is on average. roughness: m, standard deviation that the noise does not explain.
    explained: whether chi2 is no surprise."""

    curve: Curve
    residuals: np.ndarray
    chi2: float
    freedom: int
    roughness: float
    explained: bool


def fit_curve(
    points: np.ndarray,
    along: np.ndarray,
    *,
    rays: np.ndarray | None = None,
    across: np.ndarray | None = None,
    max_order: int = 3,
) -> CurveFit:
    """The curve of lowest order that explains points (N, 2) m, which follow one another along a contour.

    along: (N,) variances, m^2. With rays (N, 2), unit vectors, `along` holds along them and `across`, or nothing,
    square to them; without, in every direction.

    A conic or cubic counts only if it is sound: its gradient does not vanish near the points, it passes between them
    and has no bend sharper than they show. Where nothing explains the points, the order with the least chi-square plus
    twice the logarithm of N for each coefficient is taken, and `explained` is false. A fit is meant between its end
    points and a few centimetres beyond.

    Raises `ValueError` for shapes that do not match, fewer than two different points, numbers that are not finite and
    variances that are not positive.
    """
    points, along, rays, across = _checked(points, along, rays, across)
    best: CurveFit | None = None
    least = math.inf
    for order in range(1, max_order + 1):
        fit = _fit(points, rays, along, across, order)
        if fit is None:
            continue
        if fit.explained:
            return fit
        cost = fit.chi2 + 2.0 * math.log(len(points)) * _FREE[order]
        if cost < least:
            best, least = fit, cost
    assert best is not None  # a line always is
    return best


def _fit(
    points: np.ndarray, rays: np.ndarray, along: np.ndarray, across: np.ndarray, order: int
) -> CurveFit | None:
    """The fit of that order; None where there are too few points for one, or it is not sound."""
    from kalmap.kernels.contour_curves import fit_polynomial, is_sound
    from kalmap.kernels.contour_fit import fit_line

    count = len(points)
    coef, cov, origin, residuals = np.empty(10), np.empty((10, 10)), np.empty(2), np.empty(count)
    if order == 1:
        scale, chi, rough = fit_line(points, rays, along, across, coef, cov, origin)
    else:
        if count <= _FREE[order] + 1:
            return None
        scale, chi, rough, exists = fit_polynomial(
            points, rays, along, across, order, math.inf, 0.0, coef, cov, origin, residuals
        )
        noise = math.sqrt(float(np.maximum(along, across).max()))
        if not (exists and is_sound(coef, origin, scale, points, noise, _MARGIN)):
            return None
    curve = Curve(coef, origin, scale, order, cov)
    freedom = max(0, count - _FREE[order])
    explained = chi <= freedom + _SURPRISE * math.sqrt(2.0 * freedom) + 1e-9
    return CurveFit(curve, curve.distance(points), float(chi), freedom, math.sqrt(rough), explained)


def _checked(
    points: np.ndarray, along: np.ndarray, rays: np.ndarray | None, across: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    points = np.ascontiguousarray(points, dtype=np.float64)
    along = np.ascontiguousarray(along, dtype=np.float64)
    if points.ndim != 2 or points.shape[1:] != (2,) or along.shape != (len(points),):
        raise ValueError(f"points (N, 2) and variances (N,) are needed, got {points.shape} and {along.shape}")
    if across is None:
        across = along if rays is None else np.zeros(len(points))
    across = np.ascontiguousarray(across, dtype=np.float64)
    directions = np.zeros_like(points) if rays is None else np.ascontiguousarray(rays, dtype=np.float64)
    if directions.shape != points.shape or across.shape != along.shape:
        raise ValueError(
            f"as many rays and variances as points are needed, got {directions.shape}, {across.shape}"
        )
    if not all(np.isfinite(a).all() for a in (points, along, across, directions)):
        raise ValueError("points, rays and variances must be finite")
    if not ((along > 0.0).all() and (across >= 0.0).all()):
        raise ValueError("variances must be positive")
    if len(points) < 2 or not np.ptp(points, axis=0).any():
        raise ValueError("a curve needs two or more different points")
    return points, along, directions, across
