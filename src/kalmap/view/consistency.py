"""Chi-square bands: where a normalised squared error belongs if the stated covariance is honest."""

from __future__ import annotations

import numpy as np

from kalmap.geometry.ellipses import chi_square_quantiles


def chi_square_band(dof: np.ndarray | float, probability: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """The central interval that holds `probability` of a chi-square variable: lower and upper bounds.

    dof: degrees of freedom, any shape; NaN where it is not positive.
    """
    dof = np.asarray(dof, dtype=np.float64)
    dof, tail = np.where(dof > 0, dof, np.nan), (1.0 - probability) / 2.0
    return chi_square_quantiles(tail, dof), chi_square_quantiles(1.0 - tail, dof)


def shares(
    values: np.ndarray, dof: np.ndarray | float, probability: float = 0.95
) -> tuple[float, float, float]:
    """The shares of the finite values below, inside and above the chi-square band; NaN without any."""
    lower, upper = chi_square_band(dof, probability)
    known = np.isfinite(values) & np.isfinite(lower)
    if not known.any():
        return float("nan"), float("nan"), float("nan")
    below = float((values < lower)[known].mean())
    above = float((values > upper)[known].mean())
    return below, 1.0 - below - above, above
