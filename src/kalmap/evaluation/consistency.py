"""Does the error have the size that the covariance claims? NEES, NIS and their chi-square bands."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.geometry.ellipses import chi_square_quantiles

# least eigenvalue of a correlation matrix that still counts as positive definite
_FLAT = 1e-12


class NisSummary(msgspec.Struct, frozen=True):
    """mean: of NIS per degree of freedom over the frames (1 is right). pooled: sum of NIS over the sum of
    the degrees of freedom; low, high: the 95 % chi-square band of `pooled`. inside: the share of frames
    whose NIS lies in its own 95 % band. frames: how many had an innovation."""

    mean: float
    pooled: float
    low: float
    high: float
    inside: float
    frames: int


def pose_error(truth: np.ndarray, poses: np.ndarray, coordinates: str = "additive") -> np.ndarray:
    """(F, 3) errors x, y, heading of `poses` (F, 3) in the coordinates that the covariance speaks of.

    "additive": true minus estimated, the heading wrapped. "invariant": xi_theta is the wrapped heading
    difference and xi_p = V(xi_theta)^-1 (p_true - p_hat) with V(t) = [[sin t, cos t - 1], [1 - cos t,
    sin t]] / t: the right-invariant error of SE(2), centred at the robot (Barrau and Bonnabel 2017).
    Raises `ValueError` for other coordinates.
    """
    turn = wrap(truth[:, 2] - poses[:, 2])
    dx, dy = (truth[:, :2] - poses[:, :2]).T
    if coordinates == "additive":
        return np.column_stack([dx, dy, turn])
    if coordinates != "invariant":
        raise ValueError(f"coordinates must be 'additive' or 'invariant', got {coordinates!r}")
    a = np.sinc(turn / np.pi)  # sin t / t
    b = turn / 2 * np.sinc(turn / (2 * np.pi)) ** 2  # (1 - cos t) / t, without loss near 0
    scale = a * a + b * b
    return np.column_stack([(a * dx + b * dy) / scale, (a * dy - b * dx) / scale, turn])


def pose_nees(
    truth: np.ndarray, poses: np.ndarray, covariances: np.ndarray, coordinates: str = "additive"
) -> np.ndarray:
    """(F,) normalised estimation error squared e' P^-1 e of each pose; 3 is right on average.

    covariances: (F, 3, 3) in the same coordinates. NaN where the covariance is not positive definite (as
    at a known start) or anything is not finite. Bar-Shalom, Li and Kirubarajan 2001, section 5.4.
    """
    errors = pose_error(truth, poses, coordinates)
    nees = np.full(len(errors), np.nan)
    rows = np.nonzero(np.isfinite(errors).all(axis=1) & _positive_definite(covariances))[0]
    if len(rows):
        e = errors[rows]
        nees[rows] = np.einsum("ki,ki->k", e, np.linalg.solve(covariances[rows], e[:, :, None])[:, :, 0])
    return nees


def _positive_definite(covariances: np.ndarray) -> np.ndarray:
    """(F,) judged on the correlations, so that metres and radians weigh the same."""
    deviations = np.sqrt(np.maximum(np.einsum("kii->ki", covariances), 0.0))
    usable = np.isfinite(covariances).all(axis=(1, 2)) & (deviations > 0).all(axis=1)
    if usable.any():
        scale = deviations[usable]
        correlations = covariances[usable] / (scale[:, :, None] * scale[:, None, :])
        usable[usable] = np.linalg.eigvalsh(correlations)[:, 0] > _FLAT
    return usable


def mean_nees(nees: np.ndarray) -> float | None:
    """Mean over the frames that have one; None if none has."""
    known = nees[np.isfinite(nees)]
    return float(known.mean()) if len(known) else None


def chi2_band(dof: float, runs: int = 1, level: float = 0.95) -> tuple[float, float]:
    """The two-sided band of the mean of `runs` independent chi-square numbers of `dof` degrees of freedom.

    With runs = 1 the band of one frame's NEES; with M runs that of a frame's mean over the runs. Frames of
    one run are not independent: a run's mean over time scatters more than any such band says.
    """
    low, high = _quantiles(np.array([dof * runs]), level) / runs
    return float(low[0]), float(high[0])


def _quantiles(dof: np.ndarray, level: float) -> np.ndarray:
    """(2, F): the two chi-square quantiles between which a share of `level` lies."""
    tail = (1.0 - level) / 2.0
    return np.stack([chi_square_quantiles(tail, dof), chi_square_quantiles(1.0 - tail, dof)])


def share_inside(values: np.ndarray, dof: float, runs: int = 1, level: float = 0.95) -> float | None:
    """Share of the finite `values` inside `chi2_band`; `level` is right. None without values."""
    known = values[np.isfinite(values)]
    low, high = chi2_band(dof, runs, level)
    return float(np.mean((known >= low) & (known <= high))) if len(known) else None


def nis_summary(nis: np.ndarray, dof: np.ndarray, level: float = 0.95) -> NisSummary | None:
    """Summary of normalised innovations squared (F,) with their degrees of freedom (F,).

    Frames without an innovation (NaN, or no degrees of freedom) are passed over; None if all are.
    Innovations of a right filter are white, so their sum has a chi-square band (Bar-Shalom et al. 2001).
    """
    used = np.isfinite(nis) & (np.asarray(dof) > 0)
    nis, dof = nis[used], np.asarray(dof, dtype=float)[used]
    if len(nis) == 0:
        return None
    total = float(dof.sum())
    low, high = chi2_band(total, 1, level)
    lows, highs = _quantiles(dof, level)
    return NisSummary(
        mean=float(np.mean(nis / dof)),
        pooled=float(nis.sum() / total),
        low=low / total,
        high=high / total,
        inside=float(np.mean((nis >= lows) & (nis <= highs))),
        frames=len(nis),
    )
