"""Sums over all associations of a frame: against every matching written out, in exact fractions where sizes differ."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from finite_sets import matchings, pairs_over_matchings, sum_over_matchings
from kalmap.kernels.association_sums import (
    EXACT_PAIRS,
    EXACT_SIDE,
    log_sum_of_associations,
    marginals,
    messages,
)

SIZES = [(m, f) for m in range(6) for f in range(6)]
SUMS = (log_sum_of_associations, lambda odds: by_marginals(odds)[2], lambda odds: by_messages(odds)[2])


def by_marginals(odds):
    pairs, free = np.full(odds.shape, np.nan), np.full(odds.shape[1], np.nan)
    log_sum = marginals(odds, pairs, free)
    return pairs, free, log_sum


def by_messages(odds):
    pairs, free = np.full(odds.shape, np.nan), np.full(odds.shape[1], np.nan)
    log_sum = messages(odds, pairs, free)
    return pairs, free, log_sum


def exact_log_sum(odds: np.ndarray) -> float:
    """ln of the sum over all matchings in exact fractions."""
    total = Fraction(0)
    for choice in matchings(odds > 0.0):
        value = Fraction(1)
        for i, j in enumerate(choice):
            value *= Fraction(float(odds[i, j])) if j >= 0 else 1
        total += value
    return math.log(total.numerator) - math.log(total.denominator)


def exact_pairs(odds: np.ndarray) -> np.ndarray:
    """Probability of every pair in exact fractions."""
    count, features = odds.shape
    whole, pairs = Fraction(0), [[Fraction(0)] * features for _ in range(count)]
    for choice in matchings(odds > 0.0):
        value = Fraction(1)
        for i, j in enumerate(choice):
            value *= Fraction(float(odds[i, j])) if j >= 0 else 1
        whole += value
        for i, j in enumerate(choice):
            if j >= 0:
                pairs[i][j] += value
    return np.array([[float(pairs[i][j] / whole) for j in range(features)] for i in range(count)]).reshape(
        count, features
    )


def random_odds(rng, count: int, features: int, share: float, low: float = -3, high: float = 3) -> np.ndarray:
    odds = 10.0 ** rng.uniform(low, high, (count, features))
    return np.where(rng.random((count, features)) < share, odds, 0.0)


def random_forest(rng, count: int, features: int, low: float, high: float) -> np.ndarray:
    """Odds whose pairs form no loop: pairs in random order, each kept if it joins two trees."""
    odds, tree = np.zeros((count, features)), np.arange(count + features)
    for k in rng.permutation(count * features):
        i, j = divmod(int(k), features)
        a, b = tree[i], tree[count + j]
        if a != b and rng.random() < 0.8:
            tree[tree == b] = a
            odds[i, j] = 10.0 ** rng.uniform(low, high)
    return odds


@pytest.mark.parametrize("count, features", SIZES)
def test_exact_sum_equals_every_matching_written_out(count, features):
    """Oracle: the sum over all matchings, from no pair to every pair possible; also turned over."""
    rng = np.random.default_rng(10 * count + features)
    for share in [0.0, 0.3, 0.6, 1.0]:
        for _ in range(10):
            odds = random_odds(rng, count, features, share)
            expected = np.log(sum_over_matchings(odds))
            assert log_sum_of_associations(odds) == pytest.approx(expected, rel=1e-12, abs=1e-13)
            turned = np.ascontiguousarray(odds.T)
            assert log_sum_of_associations(turned) == pytest.approx(expected, rel=1e-12, abs=1e-13)


@pytest.mark.parametrize("scale", [(-300, -290), (-12, 12), (0, 12), (10, 12), (-300, 12), (15, 60)])
def test_messages_are_exact_where_there_is_no_loop(scale):
    """Oracle: sum and probabilities over all matchings in exact fractions, on random forests up to 5 x 5."""
    rng = np.random.default_rng(21)
    for _ in range(60):
        count, features = rng.integers(1, 6, 2)
        odds = random_forest(rng, count, features, *scale)
        expected = exact_pairs(odds)
        for pairs, free, log_sum in (by_messages(odds), by_marginals(odds)):
            np.testing.assert_allclose(pairs, expected, rtol=1e-6, atol=1e-12)
            np.testing.assert_allclose(free, 1.0 - expected.sum(axis=0), atol=1e-9)
            assert log_sum == pytest.approx(exact_log_sum(odds), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("scale", [(-3, 3), (-300, 12), (10, 12), (-12, 40)])
def test_marginals_of_small_clusters_are_exact(scale):
    """Oracle: every matching in exact fractions, dense problems with loops up to 5 x 5."""
    rng = np.random.default_rng(28)
    for _ in range(60):
        odds = random_odds(rng, *rng.integers(1, 6, 2), rng.choice([0.5, 0.8, 1.0]), *scale)
        pairs, free, log_sum = by_marginals(odds)
        expected = exact_pairs(odds)
        np.testing.assert_allclose(pairs, expected, rtol=1e-11, atol=1e-300)
        np.testing.assert_allclose(free, 1.0 - expected.sum(axis=0), atol=1e-12)
        assert log_sum == pytest.approx(exact_log_sum(odds), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("shape", [(7, 6), (6, 9), (8, 3), (12, 2), (7, 7), (9, 8)])
def test_marginals_on_either_side_of_the_exact_ones(shape):
    """Oracle: every matching written out, a band of pairs along the diagonal with one loop at most, where the smaller
    side has as many members as are summed exactly, and more: messages are near with so few loops."""
    rng = np.random.default_rng(29)
    odds = np.zeros(shape)
    for k in range(max(shape)):
        odds[min(k, shape[0] - 1), min(k, shape[1] - 1)] = 10.0 ** rng.uniform(-1, 3)
        odds[min(k + 1, shape[0] - 1), min(k, shape[1] - 1)] = 10.0 ** rng.uniform(-1, 3)
    odds[0, -1] = 0.5 * (min(shape) <= EXACT_PAIRS)
    expected, alone = pairs_over_matchings(odds)
    pairs, free, log_sum = by_marginals(odds)
    np.testing.assert_allclose(pairs, expected, atol=1e-8)
    np.testing.assert_allclose(free, alone, atol=1e-8)
    assert log_sum == pytest.approx(np.log(sum_over_matchings(odds)), rel=1e-8)


def test_messages_where_there_are_loops():
    """Oracle: every matching written out, dense problems up to 5 x 5. Loopy belief propagation is not exact: a pair is
    within 0.02 on the average and within a half always; its sum lies below the true one, by less than sqrt(2) for each
    member of the smaller side (Gurvits & Samorodnitsky's bound on the Bethe permanent); no probability is invented."""
    rng = np.random.default_rng(22)
    errors = []
    for _ in range(150):
        odds = random_odds(rng, *rng.integers(2, 6, 2), 0.7)
        expected, alone = pairs_over_matchings(odds)
        pairs, free, log_sum = by_messages(odds)
        assert (pairs >= 0.0).all()
        assert ((pairs > 0.0) <= (odds > 0.0)).all()
        np.testing.assert_allclose(pairs.sum(axis=0) + free, 1.0, atol=1e-12)
        assert (pairs.sum(axis=1) <= 1.0 + 1e-6).all()
        errors.append(max(np.abs(pairs - expected).max(), np.abs(free - alone).max()))
        exact = np.log(sum_over_matchings(odds))
        assert exact - 0.5 * np.log(2.0) * min(odds.shape) <= log_sum <= exact + 1e-6
    assert np.mean(errors) < 0.02
    assert np.max(errors) < 0.5


@pytest.mark.parametrize("method", [by_messages, by_marginals], ids=["messages", "marginals"])
def test_usual_ambiguity_within_two_hundredths(method):
    """Oracle: as above; each sighting is near one landmark and now and then a little near its neighbour."""
    rng = np.random.default_rng(23)
    for _ in range(60):
        size = int(rng.integers(2, 6))
        odds = random_odds(rng, size, size, 0.3, -3.0, 0.0) + np.diag(10.0 ** rng.uniform(2, 5, size))
        expected, alone = pairs_over_matchings(odds)
        pairs, free, log_sum = method(odds)
        np.testing.assert_allclose(pairs, expected, atol=0.02)
        np.testing.assert_allclose(free, alone, atol=0.02)
        assert log_sum == pytest.approx(np.log(sum_over_matchings(odds)), abs=0.02)


def test_clusters_multiply():
    """Oracle: the sum of a block-diagonal problem is the product of its blocks', however they are shuffled; features
    and sightings without any pair change nothing."""
    rng = np.random.default_rng(24)
    blocks = [random_odds(rng, *rng.integers(1, 4, 2), 0.9) for _ in range(6)]
    count, features = sum(len(b) for b in blocks) + 2, sum(b.shape[1] for b in blocks) + 3
    odds = np.zeros((count, features))
    i = j = 0
    for block in blocks:
        odds[i : i + len(block), j : j + block.shape[1]] = block
        i, j = i + len(block), j + block.shape[1]
    rows, columns = rng.permutation(count), rng.permutation(features)
    shuffled = np.ascontiguousarray(odds[rows][:, columns])
    expected = sum(np.log(sum_over_matchings(b)) for b in blocks)
    assert log_sum_of_associations(shuffled) == pytest.approx(expected, rel=1e-12)
    pairs, free, _ = by_marginals(odds)
    again, free_again, _ = by_marginals(shuffled)
    np.testing.assert_allclose(again, pairs[rows][:, columns], atol=1e-12)
    np.testing.assert_allclose(free_again, free[columns], atol=1e-12)
    assert (free[-3:] == 1.0).all()


@pytest.mark.parametrize("total", SUMS, ids=["exact", "marginals", "messages"])
@pytest.mark.parametrize("shape", [(0, 0), (0, 4), (4, 0), (3, 3)])
def test_nothing_to_associate(total, shape):
    """Oracle: the empty matching alone, ln 1."""
    assert total(np.zeros(shape)) == 0.0


@pytest.mark.parametrize("scale", [(-300, -290), (-300, 12), (11, 12), (30, 40), (-320, -305), (100, 140)])
@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (2, 2), (5, 2), (4, 4)])
def test_any_size_of_odds_is_exact(scale, shape):
    """Oracle: exact fractions and their logarithm, which know no overflow."""
    rng = np.random.default_rng(25)
    for _ in range(5):
        odds = random_odds(rng, *shape, 0.9, *scale)
        assert log_sum_of_associations(odds) == pytest.approx(exact_log_sum(odds), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("size", [9, 10, 11, 14])
def test_large_dense_clusters_do_not_overflow(size):
    """Oracle: odds u_i v_j all at 1e60: the sum is sum_k e_k(u) e_k(v) k!, of which k = size is all that counts."""
    rng = np.random.default_rng(26)
    u, v = 10.0 ** rng.uniform(29, 31, size), 10.0 ** rng.uniform(29, 31, size)
    expected = np.log(u).sum() + np.log(v).sum() + math.lgamma(size + 1)
    got = log_sum_of_associations(np.outer(u, v))
    assert np.isfinite(got)
    if size <= EXACT_SIDE:
        assert got == pytest.approx(expected, rel=1e-12)
    else:  # messages: Bethe's permanent lies below the true one by less than a factor sqrt(2)^size
        assert expected - 0.5 * np.log(2.0) * size <= got <= expected + 1e-6


@pytest.mark.parametrize("outer", [40, 300])
def test_two_sightings_of_many_places(outer):
    """Oracle: elementary sums: 1 + sum of all + sum over pairs of different features, in logarithms."""
    rng = np.random.default_rng(27)
    odds = 10.0 ** rng.uniform(10, 12, (2, outer))
    pairs = odds[0].sum() * odds[1].sum() - (odds[0] * odds[1]).sum()
    expected = np.log(1.0 + odds.sum() + pairs)
    assert log_sum_of_associations(odds) == pytest.approx(expected, rel=1e-12)
    turned = np.ascontiguousarray(odds.T)
    assert log_sum_of_associations(turned) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("method", [by_messages, by_marginals], ids=["messages", "marginals"])
@pytest.mark.parametrize("great", [1e12, 1e17, 1e30, 1e100])
def test_a_sure_pair_does_not_drown_its_rivals(method, great):
    """Oracle: three sightings in a chain over two features, every matching in exact fractions: what a sighting gets
    depends on its rivals' odds of 1e3 even beside a pair that is all but certain."""
    odds = np.array([[great, 0.0], [1e3, 5e2], [0.0, 2e3]])
    pairs, free, log_sum = method(odds)
    expected = exact_pairs(odds)
    np.testing.assert_allclose(pairs, expected, rtol=1e-9)
    np.testing.assert_allclose(free, 1.0 - expected.sum(axis=0), atol=1e-12)
    assert log_sum == pytest.approx(exact_log_sum(odds), rel=1e-12)


@pytest.mark.parametrize("method", [by_messages, by_marginals], ids=["messages", "marginals"])
@pytest.mark.parametrize("odds", [1.0, 1e3, 1e6, 1e12])
def test_two_alike(method, odds):
    """Oracle: two sightings of two landmarks, all four pairs alike: Z = 1 + 4 L + 2 L^2; messages lose up to half."""
    pairs, _, log_sum = method(np.full((2, 2), odds))
    whole = 1.0 + 4.0 * odds + 2.0 * odds**2
    np.testing.assert_allclose(pairs, (odds + odds**2) / whole, atol=0.02)
    assert np.log(whole) - np.log(2.0) - 1e-6 <= log_sum <= np.log(whole) + 1e-6
