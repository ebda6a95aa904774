"""Confidence ellipses of 2 x 2 covariances, in closed form and for many at once."""

from __future__ import annotations

import functools
import math

import numpy as np

# A smallest eigenvalue this far below zero, relative to the trace, is rounding and not an error.
_ROUNDING = 1e-9


def chi_square_2(probability: float) -> float:
    """The chi-square quantile with two degrees of freedom: -2 ln(1 - p). `probability` in [0, 1)."""
    if not 0.0 <= probability < 1.0:
        raise ValueError(f"a probability in [0, 1) is needed, not {probability}")
    return -2.0 * math.log1p(-probability)


@functools.cache
def chi_square(probability: float, degrees: int) -> float:
    """The chi-square quantile with any degrees of freedom; 0 for probability 0 and infinity for 1."""
    if probability >= 1.0:
        return math.inf
    if degrees == 2 or probability <= 0.0:
        return chi_square_2(max(probability, 0.0))
    return float(chi_square_quantiles(probability, degrees))


def chi_square_quantiles(probability: float, degrees: np.ndarray | float) -> np.ndarray:
    """The chi-square quantiles with these degrees of freedom, any shape; NaN stays NaN."""
    from scipy.special import gammaincinv  # the quantile itself; scipy.stats takes a second to import

    return np.asarray(2.0 * gammaincinv(0.5 * np.asarray(degrees, dtype=np.float64), probability))


def ellipse_axes(covariances: np.ndarray, probability: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Semi-axes and direction of the ellipses that hold `probability` of a Gaussian.

    covariances: (..., 2, 2), symmetric and semi-definite; zero is fine and gives a point.
    Returns the semi-axes (..., 2), the major one first, in the root of the covariance's unit, and the
    angle (...) of the major axis, rad in (-pi/2, pi/2].
    Raises ValueError if a covariance is not finite or not semi-definite.

    With a = (p_xx + p_yy) / 2 and r = hypot((p_xx - p_yy) / 2, p_xy) the eigenvalues are a + r and
    det / (a + r); the quotient keeps its digits where a - r would cancel.
    """
    covariances = np.asarray(covariances, dtype=np.float64)
    if covariances.shape[-2:] != (2, 2):
        raise ValueError(f"covariances of shape (..., 2, 2) are needed, not {covariances.shape}")
    xx, xy, yy = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    _check_semi_definite(xx, xy, yy)
    half_difference = 0.5 * (xx - yy)
    major = 0.5 * (xx + yy) + np.hypot(half_difference, xy)
    determinant = np.maximum(xx * yy - xy * xy, 0.0)
    minor = np.divide(determinant, major, out=np.zeros_like(major), where=major > 0.0)
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    roots = np.sqrt(np.stack([np.maximum(major, 0.0), minor], axis=-1))
    return math.sqrt(chi_square_2(probability)) * roots, angle


def ellipse_points(
    centres: np.ndarray, covariances: np.ndarray, probability: float = 0.95, count: int = 48
) -> np.ndarray:
    """The ellipses as polygons: (..., count, 2), counter-clockwise from the major axis, not closed.

    centres: (..., 2); covariances: (..., 2, 2) as for `ellipse_axes`, which names the errors.
    """
    axes, angle = ellipse_axes(covariances, probability)
    turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    along = axes[..., 0:1] * np.cos(turn)
    across = axes[..., 1:2] * np.sin(turn)
    cos, sin = np.cos(angle)[..., None], np.sin(angle)[..., None]
    points = np.stack([cos * along - sin * across, sin * along + cos * across], axis=-1)
    return np.asarray(centres, dtype=np.float64)[..., None, :] + points


def _check_semi_definite(xx: np.ndarray, xy: np.ndarray, yy: np.ndarray) -> None:
    """Raise ValueError, naming the first bad one, unless every covariance is semi-definite."""
    slack = _ROUNDING * (np.abs(xx) + np.abs(yy))
    # Written so that NaN fails a comparison and is caught too.
    good = (xx >= -slack) & (yy >= -slack) & np.isfinite(xx) & np.isfinite(yy)
    good &= np.abs(xy) <= np.sqrt(np.maximum(xx, 0.0)) * np.sqrt(np.maximum(yy, 0.0)) + slack
    if not np.all(good):
        first = np.flatnonzero(~np.atleast_1d(good).ravel())[0]
        raise ValueError(f"covariance {first} is not finite and semi-definite")
