"""Linearisers: from a function and a Gaussian to mean, covariance and regression matrix.

Every Kalman-family filter of kalmap is a linear regression of its models; which one is a value handed in. The
compiled kernels carry the same four rules for the built-in models; this is the general form, for any function
and any dimension, and the kernels' slow twin in the tests.
"""

from __future__ import annotations

from typing import ClassVar, Protocol, runtime_checkable

import msgspec
import numpy as np

from kalmap.gaussian.roots import semidefinite_root, solve_right


class Function(Protocol):
    """What a lineariser can linearise: motion, sensor, a change of frame, the distance to a curve."""

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """(..., n) -> (..., m): a batch of points at once."""
        ...

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """(n,) -> (m, n)."""
        ...

    def minus(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """a - b of outputs (..., m), angles wrapped: nobody else wraps."""
        ...


class Regression(msgspec.Struct, frozen=True):
    """y = mean + matrix (x - x_mean) + e, e independent of x.

    mean: (m,). covariance: (m, m) of y. matrix: (m, n). residual: (m, m) covariance of e, what the linear
    part leaves unexplained: covariance = matrix P matrix' + residual.
    """

    mean: np.ndarray
    covariance: np.ndarray
    matrix: np.ndarray
    residual: np.ndarray


@runtime_checkable
class Lineariser(Protocol):
    """Jacobian(), Unscented(...), CentralDifference(h), Cubature()."""

    def __call__(self, f: Function, mean: np.ndarray, cov: np.ndarray) -> Regression: ...


class Jacobian(msgspec.Struct, frozen=True, tag=True):
    """First-order Taylor expansion at the mean: the extended Kalman filter."""

    code: ClassVar[int] = 0
    samples: ClassVar[bool] = False

    def rule(self) -> tuple[float, float, float]:
        """The three parameters that the kernels read."""
        return 0.0, 0.0, 0.0

    def __call__(self, f: Function, mean: np.ndarray, cov: np.ndarray) -> Regression:
        """cov must be symmetric; it may be semi-definite."""
        matrix = f.jacobian(mean)
        m = len(matrix)
        return Regression(f(mean), matrix @ cov @ matrix.T, matrix, np.zeros((m, m)))


def _regress(
    f: Function,
    mean: np.ndarray,
    cov: np.ndarray,
    s: float,
    w_mean: float,
    w_zero: float,
    w_even: float,
    centred: bool,
) -> Regression:
    """The scheme shared by all sigma-point rules (see `kalmap.kernels.regression`)."""
    root = semidefinite_root(cov)
    y0 = f(mean)
    plus = f.minus(f(mean + s * root.T), y0)
    minus = f.minus(f(mean - s * root.T), y0)
    odd, even = (plus - minus) / (2.0 * s), 0.5 * (plus + minus)
    offset = 2.0 * w_mean * even.sum(axis=0)
    spread = even - offset if centred else even
    residual = w_even * spread.T @ spread + w_zero * np.outer(offset, offset)
    residual = 0.5 * (residual + residual.T)
    return Regression(y0 + offset, odd.T @ odd + residual, solve_right(odd.T, root), residual)


class Unscented(msgspec.Struct, frozen=True, tag=True):
    """Scaled unscented transform (Julier & Uhlmann; Wan & van der Merwe).

    kappa None means 3 - n, so that the points sit at sqrt(3) sigma in every dimension. alpha = 1 and
    beta = 0 give the plain transform.
    """

    alpha: float = 1.0
    beta: float = 0.0
    kappa: float | None = None
    code: ClassVar[int] = 1
    samples: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not self.alpha > 0.0:
            raise ValueError(f"alpha: expected more than 0, got {self.alpha}")

    def rule(self) -> tuple[float, float, float]:
        """The three parameters that the kernels read."""
        return self.alpha, self.beta, float("nan") if self.kappa is None else self.kappa

    def __call__(self, f: Function, mean: np.ndarray, cov: np.ndarray) -> Regression:
        """Raises EstimationError if cov is indefinite."""
        n = len(mean)
        kappa = 3.0 - n if self.kappa is None else self.kappa
        spread = self.alpha**2 * (n + kappa)
        w_zero = (spread - n) / spread + 1.0 - self.alpha**2 + self.beta
        return _regress(f, mean, cov, spread**0.5, 0.5 / spread, w_zero, 1.0 / spread, centred=True)


class CentralDifference(msgspec.Struct, frozen=True, tag=True):
    """Second-order Stirling interpolation (Norgaard et al. 2000); equations (11)-(16), Chen & Cheng 2012.

    h: step in standard deviations; sqrt(3) matches a Gaussian's kurtosis.
    """

    h: float = 3.0**0.5
    code: ClassVar[int] = 2
    samples: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not self.h > 0.0:
            raise ValueError(f"h: expected a step above 0, got {self.h}")

    def rule(self) -> tuple[float, float, float]:
        """The three parameters that the kernels read."""
        return self.h, 0.0, 0.0

    def __call__(self, f: Function, mean: np.ndarray, cov: np.ndarray) -> Regression:
        """Raises EstimationError if cov is indefinite."""
        h2 = self.h**2
        return _regress(f, mean, cov, self.h, 0.5 / h2, 0.0, (h2 - 1.0) / h2**2, centred=False)


class Cubature(msgspec.Struct, frozen=True, tag=True):
    """Third-degree spherical-radial cubature (Arasaratnam & Haykin 2009). Its spread grows with sqrt(n)."""

    code: ClassVar[int] = 3
    samples: ClassVar[bool] = True

    def rule(self) -> tuple[float, float, float]:
        """The three parameters that the kernels read."""
        return 0.0, 0.0, 0.0

    def __call__(self, f: Function, mean: np.ndarray, cov: np.ndarray) -> Regression:
        """Raises EstimationError if cov is indefinite."""
        n = len(mean)
        return _regress(f, mean, cov, n**0.5, 0.5 / n, 0.0, 1.0 / n, centred=True)


BuiltIn = Jacobian | Unscented | CentralDifference | Cubature
