"""Is one method better than another on the same seeds?"""

from __future__ import annotations

import math

import msgspec
import numpy as np


class PairedTest(msgspec.Struct, frozen=True):
    """mean_difference: of first minus second; low, high: its Student confidence interval, None for fewer
    than two pairs. p_value: two-sided Wilcoxon signed-rank, 1 where no pair differs. n: pairs used.
    better: pairs in which the first is smaller."""

    mean_difference: float
    low: float | None
    high: float | None
    p_value: float
    n: int
    better: int


def paired_test(first: np.ndarray, second: np.ndarray, level: float = 0.95) -> PairedTest | None:
    """Compare two methods' errors (M,), pair by pair on the same seeds.

    Pairs of which one is not finite are left out; None if none is left. Pairs that do not differ count in
    the mean and its interval but not in the rank test (Wilcoxon 1945). Raises `ValueError` for lists of
    different length.
    """
    first, second = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    if first.shape != second.shape or first.ndim != 1:
        raise ValueError(f"two lists of the same length are needed, got {first.shape} and {second.shape}")
    both = np.isfinite(first) & np.isfinite(second)
    differences = first[both] - second[both]
    n = len(differences)
    if n == 0:
        return None
    mean = float(differences.mean())
    low, high = _interval(differences, level) if n > 1 else (None, None)
    return PairedTest(mean, low, high, _signed_rank(differences), n, int(np.sum(differences < 0)))


def _interval(differences: np.ndarray, level: float) -> tuple[float, float]:
    from scipy.special import stdtrit

    n = len(differences)
    mean, error = float(differences.mean()), float(differences.std(ddof=1)) / math.sqrt(n)
    reach = float(stdtrit(n - 1, 0.5 + level / 2.0)) * error
    return mean - reach, mean + reach


def _signed_rank(differences: np.ndarray) -> float:
    from scipy.stats import wilcoxon

    differing = differences[differences != 0]
    return float(wilcoxon(differing).pvalue) if len(differing) else 1.0
