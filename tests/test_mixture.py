"""Reducing mixtures: moments by hand, the same greedy rule by brute force, and no trace of the order."""

from __future__ import annotations

import numpy as np
import pytest

import finite_sets as plain
from finite_sets import rules_of
from kalmap.kernels import set_layout as sets
from kalmap.kernels.mixture import by_weight, merged, reduce, squared_distance


def reduced(rules, rows) -> np.ndarray:
    out = np.full(rows.shape, np.nan)
    count = reduce(rules, rows, len(rows), out)
    return out[:count].copy()


def moments(rows) -> tuple[float, np.ndarray, np.ndarray]:
    """Weight, mean and covariance of a whole mixture."""
    weights = rows[:, sets.WEIGHT]
    places = rows[:, [sets.X, sets.Y]]
    mean = weights @ places / weights.sum()
    off = places - mean
    inner = np.array([plain.covariance(row) for row in rows])
    spread = np.einsum("n,nij->ij", weights, inner) + (weights[:, None] * off).T @ off
    return weights.sum(), mean, spread / weights.sum()


def by_brute_force(rules, rows) -> np.ndarray:
    """The greedy rule with every distance looked at; moments of each group."""
    rows = rows[rows[:, sets.WEIGHT] >= rules[sets.PRUNE]]
    rows = rows[np.lexsort((*rows.T[:0:-1], -rows[:, sets.WEIGHT]))]
    taken, result = np.zeros(len(rows), bool), []
    for a, centre in enumerate(rows):
        if taken[a] or len(result) == int(rules[sets.CAP]):
            continue
        off = rows[:, [sets.X, sets.Y]] - centre[[sets.X, sets.Y]]
        distances = np.einsum("ni,ij,nj->n", off, np.linalg.inv(plain.covariance(centre)), off)
        members = ~taken & (distances < rules[sets.MERGE])
        members[a] = True
        taken |= members
        weight, mean, spread = moments(rows[members])
        seen = rows[members, sets.WEIGHT] @ rows[members, sets.SEEN] / weight
        result.append(
            [weight, *mean, *np.linalg.cholesky(spread)[[0, 1, 1], [0, 0, 1]], centre[sets.ID], seen]
        )
    return np.array(result).reshape(-1, sets.COLUMNS)


def random_rows(rng, count: int, ties: bool) -> np.ndarray:
    return np.array(
        [
            plain.component(
                rng.choice([0.1, 0.5]) if ties else 10.0 ** rng.uniform(-7, 0),
                rng.integers(0, 6, 2) if ties else rng.uniform(0, 12, 2),
                np.eye(2) * 0.25 if ties and rng.random() < 0.5 else plain.random_spread(rng, 2, 0.6),
                rng.integers(4) if ties else rng.integers(10_000),
                rng.integers(1, 5),
            )
            for _ in range(count)
        ]
    )


@pytest.mark.parametrize("count", [1, 2, 7, 30])
def test_merging_keeps_weight_mean_and_covariance(count):
    """Oracle: the moments of the mixture, written out; the id of the first."""
    rng = np.random.default_rng(count)
    for _ in range(20):
        rows, out = random_rows(rng, count, False), np.empty(sets.COLUMNS)
        merged(rows, np.arange(count), count, out)
        weight, mean, spread = moments(rows)
        assert out[sets.WEIGHT] == pytest.approx(weight, rel=1e-13)
        np.testing.assert_allclose(out[[sets.X, sets.Y]], mean, rtol=1e-12)
        np.testing.assert_allclose(plain.covariance(out), spread, rtol=1e-10, atol=1e-10 * spread.max())
        assert out[sets.ID] == rows[0, sets.ID]
        assert out[sets.SEEN] == pytest.approx(rows[:, 0] @ rows[:, sets.SEEN] / weight, rel=1e-12)
        assert min(out[sets.L11], out[sets.L22]) > 0.0


def test_reducing_keeps_the_moments_of_the_whole():
    """Oracle: weight, mean and covariance of the mixture before, where nothing is pruned or capped."""
    rng = np.random.default_rng(31)
    for _ in range(20):
        rows = random_rows(rng, 60, False)
        got = reduced(rules_of(MERGE=rng.choice([0.5, 4.0, 50.0])), rows)
        assert len(got) < 60
        for after, before in zip(moments(got), moments(rows)):
            np.testing.assert_allclose(after, before, rtol=1e-10)


@pytest.mark.parametrize("ties", [False, True], ids=["plain", "ties"])
@pytest.mark.parametrize("cap", [3, 10_000])
def test_equals_the_greedy_rule_by_brute_force(ties, cap):
    """Oracle: heaviest first, every distance computed by the inverse covariance, numpy's moments; prune and cap."""
    rng = np.random.default_rng(32)
    for _ in range(60):
        rows = random_rows(rng, int(rng.integers(1, 80)), ties)
        rules = rules_of(MERGE=rng.uniform(0.3, 9.0), PRUNE=1e-4, CAP=cap)
        got, expected = reduced(rules, rows), by_brute_force(rules, rows)
        assert got.shape == expected.shape
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("ties", [False, True], ids=["plain", "ties"])
def test_the_order_of_the_components_leaves_no_trace(ties):
    """Oracle: the same mixture in thirty random orders, bit for bit."""
    rng = np.random.default_rng(33)
    for _ in range(10):
        rows = random_rows(rng, 60, ties)
        rules = rules_of(MERGE=4.0, PRUNE=1e-4, CAP=20)
        first = reduced(rules, rows)
        for _ in range(30):
            np.testing.assert_array_equal(reduced(rules, rows[rng.permutation(60)]), first)


def test_order_by_weight_then_by_everything_else():
    """Oracle: numpy's lexicographic sort of all columns."""
    rng = np.random.default_rng(34)
    rows = random_rows(rng, 300, True)
    order = by_weight(rows, len(rows))
    expected = np.lexsort((*rows.T[:0:-1], -rows[:, sets.WEIGHT]))
    np.testing.assert_array_equal(rows[order], rows[expected])
    assert sorted(order) == list(range(300))


def test_squared_distance_is_mahalanobis():
    """Oracle: d' P^-1 d by numpy, P of the centre alone."""
    rng = np.random.default_rng(35)
    for a, b in zip(random_rows(rng, 50, False), random_rows(rng, 50, False)):
        off = b[[sets.X, sets.Y]] - a[[sets.X, sets.Y]]
        expected = off @ np.linalg.solve(plain.covariance(a), off)
        assert squared_distance(a, b) == pytest.approx(expected, rel=1e-9)


def test_prune_cap_and_nothing():
    """Oracle: by hand: lighter than PRUNE goes, the CAP heaviest stay, as they are where none is near."""
    rows = np.array(
        [plain.component(w, (10.0 * k, 0.0), np.eye(2), k) for k, w in enumerate([0.2, 0.9, 0.01, 0.5])]
    )
    np.testing.assert_array_equal(reduced(rules_of(PRUNE=0.01, MERGE=4.0), rows), rows[[1, 3, 0, 2]])
    np.testing.assert_array_equal(reduced(rules_of(PRUNE=0.0101, MERGE=4.0), rows), rows[[1, 3, 0]])
    np.testing.assert_array_equal(reduced(rules_of(CAP=2, MERGE=4.0), rows), rows[[1, 3]])
    assert len(reduced(rules_of(PRUNE=1.0), rows)) == 0
    assert len(reduced(rules_of(), rows[:0])) == 0


@pytest.mark.parametrize("alike", [False, True], ids=["different", "alike"])
def test_twenty_thousand_components(alike):
    """Oracle: the moments of the whole; and the heaviest first, ties by x."""
    rng = np.random.default_rng(36)
    rows = np.zeros((20_000, sets.COLUMNS))
    rows[:, sets.WEIGHT] = 0.01 if alike else rng.uniform(0.01, 1.0, 20_000)
    rows[:, [sets.X, sets.Y]] = rng.uniform(0.0, 500.0, (20_000, 2))
    rows[:, [sets.L11, sets.L22]] = rng.uniform(0.5, 1.0, (20_000, 2))
    rules = rules_of(MERGE=4.0, CAP=20_000)
    got = reduced(rules, rows)
    assert len(got) < 20_000
    for after, before in zip(moments(got), moments(rows)):
        np.testing.assert_allclose(after, before, rtol=1e-9)
    order = by_weight(rows, 20_000)
    np.testing.assert_array_equal(order, np.lexsort((rows[:, sets.X], -rows[:, sets.WEIGHT])))
