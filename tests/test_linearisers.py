"""One contract over all linearisers, against exact Gaussian moments,
Gauss-Hermite quadrature and Theorem 1."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from kalmap.gaussian import CentralDifference, Cubature, Jacobian, Lineariser, NotPositiveError, Unscented
from kalmap.gaussian.roots import semidefinite_root
from kalmap.kernels import layout
from kalmap.kernels.regression import regress, square_root, weights
from slam_problems import LINEARISERS, random_covariance

SAMPLED = {name: rule for name, rule in LINEARISERS.items() if name != "jacobian"}


class Plain:
    """A function without angles, its Jacobian by central differences."""

    def __init__(self, f, angles: bool = False) -> None:
        self.f, self.angles = f, angles

    def __call__(self, x):
        return self.f(x)

    def jacobian(self, x):
        steps = 1e-6 * np.eye(len(x))
        return np.array([self.minus(self.f(x + d), self.f(x - d)) / 2e-6 for d in steps]).T

    def minus(self, a, b):
        return (a - b + np.pi) % (2 * np.pi) - np.pi if self.angles else a - b


class Affine(Plain):
    def __init__(self, matrix, offset) -> None:
        super().__init__(lambda x: x @ matrix.T + offset)
        self.matrix = matrix

    def jacobian(self, x):
        return self.matrix


def quadrature(f, mean, cov, order=12):
    """Gaussian mean and covariance of f by a Gauss-Hermite product rule: the independent oracle."""
    nodes, w = np.polynomial.hermite_e.hermegauss(order)
    root = np.linalg.cholesky(cov)
    points = np.array(list(itertools.product(nodes, repeat=len(mean)))) @ root.T + mean
    weight = np.prod(np.array(list(itertools.product(w, repeat=len(mean)))), axis=1)
    weight /= weight.sum()
    y = f(points)
    centre = weight @ y
    return centre, (y - centre).T @ ((y - centre) * weight[:, None])


@pytest.mark.parametrize("name", LINEARISERS)
@pytest.mark.parametrize("n", range(1, 9))
def test_exact_on_affine_functions(name, n):
    """Oracle: A m + b and A P A', the exact moments of an affine map, for a dense random P."""
    rng = np.random.default_rng(100 * n)
    matrix, offset = rng.standard_normal((3, n)), rng.standard_normal(3)
    mean, cov = rng.standard_normal(n), random_covariance(rng, n, 2.0) + 0.1 * np.eye(n)
    r = LINEARISERS[name](Affine(matrix, offset), mean, cov)
    assert isinstance(LINEARISERS[name], Lineariser)
    np.testing.assert_allclose(r.mean, matrix @ mean + offset, atol=1e-12)
    np.testing.assert_allclose(r.covariance, matrix @ cov @ matrix.T, atol=1e-12, rtol=1e-12)
    np.testing.assert_allclose(r.matrix, matrix, atol=1e-11)
    np.testing.assert_allclose(r.residual, 0.0, atol=1e-12)


@pytest.mark.parametrize("name", LINEARISERS)
@pytest.mark.parametrize("rank", [0, 1, 3])
def test_semidefinite_priors_are_exact_on_affine_functions(name, rank):
    """Oracle: the exact moments; a zero or rank-deficient prior must give no NaN and need no jitter."""
    rng = np.random.default_rng(rank)
    matrix, mean = rng.standard_normal((2, 5)), rng.standard_normal(5)
    cov = random_covariance(rng, 5, 1.0, rank) if rank else np.zeros((5, 5))
    r = LINEARISERS[name](Affine(matrix, np.ones(2)), mean, cov)
    assert np.isfinite(r.matrix).all()
    np.testing.assert_allclose(r.mean, matrix @ mean + 1.0, atol=1e-12)
    np.testing.assert_allclose(r.covariance, matrix @ cov @ matrix.T, atol=1e-7)
    np.testing.assert_allclose(r.matrix @ cov, matrix @ cov, atol=1e-7)


@pytest.mark.parametrize("name", ["unscented", "central", "cubature", "unscented-scaled", "central-2"])
def test_mean_of_a_quadratic_is_exact(name):
    """Oracle: E x'Qx = m'Qm + tr(QP), for every rule of third degree."""
    rng = np.random.default_rng(5)
    q = rng.standard_normal((4, 4))
    mean, cov = rng.standard_normal(4), random_covariance(rng, 4, 1.5) + 0.1 * np.eye(4)
    r = SAMPLED[name](Plain(lambda x: np.einsum("...i,ij,...j->...", x, q, x)[..., None]), mean, cov)
    np.testing.assert_allclose(r.mean[0], mean @ q @ mean + np.trace(q @ cov), rtol=1e-12)
    np.testing.assert_allclose(r.matrix[0], mean @ (q + q.T), rtol=1e-10)


def test_covariance_of_a_square_follows_each_rules_theory():
    """Oracle: f = x^2 on N(0, 1) by hand; the true variance is 2 and h^2 = 3 hits it.

    Central differences: (h^2 - 1)/h^4 e^2 with e = h^2, so h^2 - 1. Unscented: w_0 mu^2 + ...
    with spread s^2:
    s^2 - 1. Cubature in one dimension has both points at +-1 and sees no spread at all.
    """
    square, zero, one = Plain(lambda x: x**2), np.zeros(1), np.eye(1)
    for h in (3**0.5, 2.0, 1.2):
        np.testing.assert_allclose(
            CentralDifference(h)(square, zero, one).covariance[0, 0], h * h - 1, rtol=1e-12
        )
    for kappa in (2.0, 1.0, 3.0):
        np.testing.assert_allclose(
            Unscented(kappa=kappa)(square, zero, one).covariance[0, 0], kappa, rtol=1e-12
        )
    scaled = Unscented(alpha=0.5, beta=2.0, kappa=2.0)(square, zero, one).covariance[0, 0]
    np.testing.assert_allclose(scaled, (0.5**2 * 3 - 1) + (1 - 0.25 + 2.0), rtol=1e-12)
    np.testing.assert_allclose(Cubature()(square, zero, one).covariance[0, 0], 0.0, atol=1e-14)


def test_separable_quadratics_have_the_exact_covariance_at_kurtosis_three():
    """Oracle: var(sum a_i x_i^2 + b'x) = 2 sum a_i^2 + b'b on N(0, I): CDKF, h = sqrt 3,
    sees each axis exactly."""
    a, b = np.array([0.5, -1.0, 2.0]), np.array([1.0, 0.2, -0.7])
    f = Plain(lambda x: (x**2 @ a + x @ b)[..., None])
    r = CentralDifference()(f, np.zeros(3), np.eye(3))
    np.testing.assert_allclose(r.covariance[0, 0], 2 * a @ a + b @ b, rtol=1e-12)
    np.testing.assert_allclose(
        r.residual[0, 0], 2 * a @ a, rtol=1e-12
    )  # the equation (14): 2/9 sum (3 a_i)^2


@pytest.mark.parametrize("name", ["unscented", "central", "cubature"])
def test_mild_nonlinearity_against_gauss_hermite(name):
    """Oracle: a 12-point Gauss-Hermite product rule. The points must beat the Jacobian's mean clearly."""
    f = Plain(lambda x: np.stack([np.hypot(x[..., 0], x[..., 1]), np.arctan2(x[..., 1], x[..., 0])], -1))
    mean, cov = np.array([10.0, 3.0]), np.array([[1.0, 0.3], [0.3, 1.5]])
    true_mean, true_cov = quadrature(f, mean, cov)
    r = SAMPLED[name](f, mean, cov)
    np.testing.assert_allclose(r.mean, true_mean, atol=1e-3)
    np.testing.assert_allclose(r.covariance, true_cov, atol=0.015)
    first_order = Jacobian()(f, mean, cov)
    assert np.abs(r.mean - true_mean)[0] < 0.02 * np.abs(first_order.mean - true_mean)[0]


@pytest.mark.parametrize("name", LINEARISERS)
def test_bearing_across_the_cut(name):
    """Oracle: the same problem turned by 180 degrees, where nothing wraps."""
    behind = Plain(lambda x: np.arctan2(x[..., 1], x[..., 0])[..., None], angles=True)
    ahead = Plain(lambda x: np.arctan2(-x[..., 1], -x[..., 0])[..., None], angles=True)
    mean, cov = np.array([-8.0, 0.01]), np.array([[0.5, 0.1], [0.1, 0.4]])
    r, expected = LINEARISERS[name](behind, mean, cov), LINEARISERS[name](ahead, mean, cov)
    np.testing.assert_allclose(behind.minus(r.mean - np.pi, expected.mean), 0.0, atol=1e-12)
    np.testing.assert_allclose(r.covariance, expected.covariance, rtol=1e-9)
    np.testing.assert_allclose(r.matrix, expected.matrix, rtol=1e-6)
    assert r.covariance[0, 0] < 0.02


@pytest.mark.parametrize(
    "matrix",
    [
        [[1.0, 2.0], [2.0, 1.0]],
        [[1.0, 0.0], [0.0, -1.0]],
        [[0.0, 1.0], [1.0, 1.0]],  # a zero pivot whose column is not zero
        [[1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]],
        [[float("nan"), 0.0], [0.0, 1.0]],
    ],
)
@pytest.mark.parametrize("name", SAMPLED)
def test_indefinite_covariances_are_refused(name, matrix):
    """Oracle: each matrix has a negative eigenvalue (or a NaN), checked here;
    nothing may repair it quietly."""
    cov = np.array(matrix)
    assert np.isnan(cov).any() or np.linalg.eigvalsh(cov)[0] < -0.1
    with pytest.raises(NotPositiveError):
        SAMPLED[name](Plain(lambda x: x), np.zeros(len(cov)), cov)


@pytest.mark.parametrize("rank", range(1, 6))
def test_semidefinite_root_squares_back(rank):
    """Oracle: S S' = P, with S lower triangular."""
    cov = random_covariance(np.random.default_rng(rank), 5, 3.0, rank)
    root = semidefinite_root(cov)
    np.testing.assert_allclose(root @ root.T, cov, atol=1e-7)
    assert (np.triu(root, 1) == 0).all()


@pytest.mark.parametrize("name", ["central", "unscented"])
@pytest.mark.parametrize("rest", [1, 4, 20])
def test_theorem_1_reduced_equals_full(name, rest):
    """Oracle: Theorem 1, Chen & Cheng 2012: the regression on the part read, zero on the rest."""
    rng = np.random.default_rng(rest)
    cov = random_covariance(rng, 3 + rest) + 0.1 * np.eye(3 + rest)
    mean = rng.standard_normal(3 + rest)
    f = Plain(lambda x: np.stack([np.sin(x[..., 0]) * x[..., 1], np.cos(x[..., 2])], -1))
    full, reduced = SAMPLED[name](f, mean, cov), SAMPLED[name](f, mean[:3], cov[:3, :3])
    np.testing.assert_allclose(full.mean, reduced.mean, atol=1e-12)
    np.testing.assert_allclose(full.covariance, reduced.covariance, atol=1e-12)
    np.testing.assert_allclose(full.matrix[:, :3], reduced.matrix, atol=1e-10)
    np.testing.assert_allclose(full.matrix[:, 3:], 0.0, atol=1e-12)
    spread = Cubature()(f, mean, cov).mean - Cubature()(f, mean[:3], cov[:3, :3]).mean
    assert np.abs(spread).max() > 1e-4  # cubature's spread grows with n: no such equality


@pytest.mark.parametrize("name", SAMPLED)
@pytest.mark.parametrize("rank", [2, 4])
def test_compiled_regression_equals_its_numpy_twin(name, rank):
    """Oracle: the general lineariser on the same function, with a dense and a rank-deficient prior."""
    rng = np.random.default_rng(11)
    f = Plain(lambda x: np.stack([np.sin(x[..., 0] * x[..., 3]), x[..., 1] ** 2 - x[..., 2]], -1))
    mean, cov = rng.standard_normal(4), random_covariance(rng, 4, 0.7, rank)
    setup = np.zeros(layout.SETUP_LENGTH)
    setup[layout.RULE] = SAMPLED[name].code
    setup[layout.RULE_A : layout.RULE_C + 1] = SAMPLED[name].rule()
    root, matrix, residual, offset = np.zeros((4, 4)), np.zeros((2, 4)), np.zeros((2, 2)), np.zeros(2)
    assert square_root(cov, 4, root)
    step = weights(setup, 4)[0] * root.T
    regress(
        setup, f(mean + step) - f(mean), f(mean - step) - f(mean), 4, 2, root, offset, matrix, residual, 0
    )
    twin = SAMPLED[name](f, mean, cov)
    np.testing.assert_allclose(f(mean) + offset, twin.mean, atol=1e-11)
    np.testing.assert_allclose(residual, twin.residual, atol=1e-11)
    np.testing.assert_allclose(matrix @ root, twin.matrix @ root, atol=1e-7)


@pytest.mark.parametrize(("rule", "words"), [
    (lambda: CentralDifference(h=0.0), "h: "), (lambda: Unscented(alpha=-1.0), "alpha: "),
])  # fmt: skip
def test_a_step_that_draws_no_points_is_refused(rule, words):
    """Oracle: the definition; a spread of zero or less has no points."""
    with pytest.raises(ValueError, match=words):
        rule()
