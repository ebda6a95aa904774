"""The packed lower triangle against dense numpy."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.kernels import packed
from slam_problems import random_covariance


def triangle(full: np.ndarray) -> np.ndarray:
    return full[np.tril_indices(len(full))].copy()


@pytest.mark.parametrize("rank", [4, 8, 12, 20])
def test_add_outer_equals_dense_for_every_size(rank):
    """Oracle: P + L'R by numpy, where L'R is symmetric by construction (L = D R, D diagonal)."""
    rng = np.random.default_rng(rank)
    for n in range(1, 71):
        full = random_covariance(rng, n)
        right = np.zeros((rank + 3, n + 5))
        right[:rank, :n] = rng.standard_normal((rank, n))
        left = right * rng.choice([-1.0, 1.0], len(right))[:, None]
        buffer = np.append(triangle(full), 7.5)
        packed.add_outer(buffer, n, left, right, rank)
        expected = triangle(full + left[:rank, :n].T @ right[:rank, :n])
        np.testing.assert_allclose(buffer[:-1], expected, atol=1e-12, rtol=1e-12)
        assert buffer[-1] == 7.5  # nothing beyond the triangle is touched


def test_add_outer_beyond_one_strip():
    """Oracle: dense numpy at a size that needs two cache strips (2048 columns each)."""
    rng, n = np.random.default_rng(0), 2101
    right = rng.standard_normal((8, n))
    buffer = np.zeros(n * (n + 1) // 2)
    packed.add_outer(buffer, n, -right, right, 8)
    np.testing.assert_allclose(buffer, triangle(-right.T @ right), atol=1e-12)


def test_add_outer_keeps_nan_visible():
    """Fast maths must not optimise a NaN away. Oracle: IEEE arithmetic."""
    right = np.ones((4, 9))
    right[2, 3] = np.nan
    buffer = np.zeros(45)
    packed.add_outer(buffer, 9, right, right, 4)
    full = np.empty((9, 9))
    packed.unpack(buffer, 9, full)
    assert np.isnan(full[3]).all() and np.isfinite(np.delete(np.delete(full, 3, 0), 3, 1)).all()


@pytest.mark.parametrize("n", [1, 2, 3, 7, 16, 33])
def test_pack_and_unpack(n):
    """Oracle: the dense matrix itself."""
    full = random_covariance(np.random.default_rng(n), n)
    buffer, back = np.zeros(n * (n + 1) // 2), np.zeros((n, n))
    packed.pack(full, n, buffer)
    packed.unpack(buffer, n, back)
    np.testing.assert_array_equal(buffer, triangle(full))
    np.testing.assert_array_equal(np.tril(back), np.tril(full))
    np.testing.assert_array_equal(back, back.T)


@pytest.mark.parametrize("d", [1, 3, 5])
def test_transform_leading(d):
    """Oracle: dense T P T' with T = diag(phi, I), of which the cross-covariance is transformed;
    phi is used up."""
    rng, n = np.random.default_rng(d), 17
    full, phi = random_covariance(rng, n), rng.standard_normal((d, d))
    buffer = triangle(full)
    used = phi.copy()
    packed.transform_leading(buffer, n, d, used)
    np.testing.assert_array_equal(used, np.eye(d))
    expected = full.copy()
    expected[d:, :d] = full[d:, :d] @ phi.T
    np.testing.assert_allclose(buffer, triangle(expected), atol=1e-13)


@pytest.mark.parametrize(("first", "count"), [(0, 1), (3, 2), (5, 4), (9, 2), (10, 1), (0, 11)])
def test_remove(first, count):
    """Oracle: np.delete of rows and columns: marginalising a Gaussian drops them."""
    rng, n = np.random.default_rng(3), 11
    full, vector = random_covariance(rng, n), rng.standard_normal(n)
    buffer, mean = triangle(full), vector.copy()
    gone = slice(first, first + count)
    assert packed.remove(buffer, mean, n, first, count) == n - count
    m = n - count
    np.testing.assert_array_equal(mean[:m], np.delete(vector, gone))
    expected = np.delete(np.delete(full, gone, 0), gone, 1)
    np.testing.assert_array_equal(buffer[: m * (m + 1) // 2], triangle(expected))
