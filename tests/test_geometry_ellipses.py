"""Confidence ellipses against numpy's eigenvalues and against Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from kalmap.geometry.ellipses import chi_square_2, ellipse_axes, ellipse_points


def random_covariances(count: int = 200) -> np.ndarray:
    half = np.random.default_rng(1).standard_normal((count, 2, 2))
    return half @ np.swapaxes(half, 1, 2)


@pytest.mark.parametrize("probability", [0.0, 0.5, 0.95, 0.999999])
def test_quantile_is_scipys(probability):
    assert chi_square_2(probability) == pytest.approx(chi2.ppf(probability, 2), rel=1e-12)


@pytest.mark.parametrize("probability", [-0.1, 1.0, float("nan")])
def test_quantile_refuses_what_is_no_probability(probability):
    with pytest.raises(ValueError, match="probability"):
        chi_square_2(probability)


def test_axes_are_roots_of_eigenvalues():
    covariances = random_covariances()
    axes, angle = ellipse_axes(covariances)
    expected = np.sqrt(chi_square_2(0.95) * np.linalg.eigvalsh(covariances)[:, ::-1])
    np.testing.assert_allclose(axes, expected, rtol=1e-6, atol=1e-9)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    spread = np.einsum("ni,nij,nj->n", along, covariances, along) * chi_square_2(0.95)
    np.testing.assert_allclose(spread, axes[:, 0] ** 2, rtol=1e-9)


def test_points_lie_at_one_mahalanobis_distance_and_turn_left():
    covariances = random_covariances()
    centres = np.random.default_rng(2).standard_normal((len(covariances), 2))
    points = ellipse_points(centres, covariances, 0.9, count=17)
    assert points.shape == (200, 17, 2)
    offset = points - centres[:, None]
    squared = np.einsum("nki,nij,nkj->nk", offset, np.linalg.inv(covariances), offset)
    np.testing.assert_allclose(squared, chi_square_2(0.9), rtol=1e-5)
    following = np.roll(offset, -1, axis=1)
    assert (offset[..., 0] * following[..., 1] > offset[..., 1] * following[..., 0]).all()


def test_small_eigenvalue_keeps_its_digits():
    axes, angle = ellipse_axes(np.diag([1e-14, 1e6]), 1 - np.exp(-0.5))
    np.testing.assert_allclose(axes, [1e3, 1e-7], rtol=1e-12)
    assert abs(angle) == pytest.approx(np.pi / 2)


def test_semi_definite_is_fine():
    axes, _ = ellipse_axes(np.zeros((3, 2, 2)))
    assert (axes == 0).all()
    line, angle = ellipse_axes(np.ones((2, 2)))
    assert line[1] == 0
    assert angle == pytest.approx(np.pi / 4)
    assert ellipse_points(np.zeros((0, 2)), np.zeros((0, 2, 2))).shape == (0, 48, 2)


@pytest.mark.parametrize(
    "bad", [[[1, 2], [2, 1]], [[-1, 0], [0, 1]], [[np.nan, 0], [0, 1]], [[1, np.inf], [np.inf, 1]]]
)
def test_indefinite_is_refused_by_number(bad):
    with pytest.raises(ValueError, match="covariance 1 "):
        ellipse_axes(np.array([np.eye(2), bad]))
