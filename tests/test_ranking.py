"""The most probable associations of a frame against brute force and scipy's assignment."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from kalmap.kernels.ranking import DROP, best_associations
from matchings import matchings


def ranked(odds):
    """(ln of the product of odds, association) of every possible one, best first."""
    out = []
    for given in matchings(*odds.shape):
        product = math.prod(odds[i, j] for i, j in enumerate(given) if j >= 0)
        if product > 0.0:
            out.append((math.log(product), given))
    return sorted(out, reverse=True)


@pytest.mark.parametrize("seed", range(40))
def test_best_associations_are_those_of_brute_force(seed):
    rng = np.random.default_rng(seed)
    count, features = rng.integers(0, 5), rng.integers(0, 6)
    odds = np.exp(rng.normal(0.5, 2.5, (count, features))) * (
        rng.random((count, features)) < 0.2 * (seed % 6)
    )
    expected = ranked(odds)
    for most in (1, 2, 5, 60):
        given, scores = np.empty((most, count), np.int64), np.empty(most)
        made = best_associations(odds, given, scores)
        wanted = [each for each in expected[:most] if each[0] > expected[0][0] - DROP]
        assert [tuple(row) for row in given[:made].tolist()] == [each[1] for each in wanted]
        np.testing.assert_allclose(scores[:made], [each[0] for each in wanted], atol=1e-12)


def test_every_association_once_where_all_are_equally_probable():
    given, scores = np.empty((600, 4), np.int64), np.empty(600)
    made = best_associations(np.ones((4, 5)), given, scores)
    assert made == 501
    assert sorted(map(tuple, given[:made].tolist())) == sorted(matchings(4, 5))
    np.testing.assert_array_equal(scores[:made], 0.0)


@pytest.mark.parametrize("seed", range(10))
def test_single_best_of_many_is_the_assignment_of_scipy(seed):
    rng = np.random.default_rng(seed)
    odds = np.exp(rng.normal(0.0, 4.0, (25, 30))) * (rng.random((25, 30)) < 0.3)
    value = np.zeros((25, 55))
    value[:, :30] = np.log(odds, out=np.full(odds.shape, -1e4), where=odds > 0.0)
    rows, columns = linear_sum_assignment(value, maximize=True)
    given, scores = np.empty((1, 25), np.int64), np.empty(1)
    assert best_associations(odds, given, scores) == 1
    np.testing.assert_array_equal(given[0], np.where(columns < 30, columns, -1))
    assert scores[0] == pytest.approx(value[rows, columns].sum(), rel=1e-12)
