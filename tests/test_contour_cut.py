"""Cutting into straight runs. Oracles: singular values for every cost, brute force for every split, numpy's sorting."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from kalmap.kernels.contour_cut import (
    best_split,
    line_cost,
    order_beams,
    running_sums,
    straight_runs,
    widest_gap,
)

ROUGH = 1e-5


def cost(points, noise, a, b):
    """Weighted sum of squared distances from the best line: the smaller singular value squared."""
    if b - a < 3:
        return 0.0
    weights = 1.0 / (noise[a:b] + ROUGH)
    centre = weights @ points[a:b] / weights.sum()
    return np.linalg.svd((points[a:b] - centre) * np.sqrt(weights)[:, None])[1][1] ** 2


def zigzag(rng, turns, each=12, sigma=0.01):
    """Points along straight legs of 1 m that turn by turn change direction."""
    at, angle, points = np.array([20.0, -30.0]), 0.0, []
    for turn in turns:
        angle += turn
        way = np.array([np.cos(angle), np.sin(angle)])
        points += [at + s * way for s in np.arange(each) / each]
        at = at + way
    points = np.array(points) + sigma * rng.standard_normal((len(points), 2))
    return points, sigma**2 * rng.uniform(0.8, 1.2, len(points))


def summed(points, noise):
    sums = np.empty((len(points) + 1, 6))
    running_sums(points, noise, ROUGH, sums)
    return sums


def test_the_cost_of_a_run_is_its_smaller_singular_value():
    points, noise = zigzag(np.random.default_rng(0), [0.3, 1.0, -0.8])
    sums = summed(points, noise)
    for a, b in itertools.combinations(range(0, 37, 3), 2):
        assert line_cost(sums, a, b) == pytest.approx(cost(points, noise, a, b), rel=1e-6, abs=1e-6)


def test_the_best_split_is_that_of_brute_force():
    for seed in range(10):
        rng = np.random.default_rng(seed)
        points, noise = zigzag(rng, rng.uniform(-1.5, 1.5, 2))
        place, least = best_split(summed(points, noise), 0, 24)
        tried = [cost(points, noise, 0, k) + cost(points, noise, k, 24) for k in range(2, 23)]
        assert place == 2 + int(np.argmin(tried))
        assert least == pytest.approx(min(tried), rel=1e-5, abs=1e-6)


def optimum(points, noise, price):
    """Least total of costs and prices over all cuts into runs of two or more, by dynamic programming."""
    least = np.full(len(points) + 1, np.inf)
    least[0] = 0.0
    for b in range(2, len(points) + 1):
        least[b] = min(least[a] + price + cost(points, noise, a, b) for a in range(b - 1))
    return least[-1]


def test_runs_are_as_good_as_those_of_dynamic_programming():
    """Halving and mending is greedy: of 40 chains of walls it is best on nearly all, and never off by a cut's price."""
    price, exact = 25.0, 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        points, noise = zigzag(rng, rng.uniform(0.4, 2.0, 5) * rng.choice([-1, 1], 5), each=9)
        linked = np.ones(len(points), dtype=bool)
        cuts = straight_runs(summed(points, noise), linked, price)
        total = sum(cost(points, noise, a, b) + price for a, b in itertools.pairwise(cuts))
        best = optimum(points, noise, price)
        assert total < best + price
        exact += total < best + 1e-3
    assert exact >= 34


def test_a_straight_wall_is_hardly_ever_cut():
    """1,000 walls of 60 points whose noise is as said: a cut would be chance."""
    rng = np.random.default_rng(1)
    cuts = 0
    for _ in range(1000):
        points, noise = zigzag(rng, [0.7], each=60)
        noise[:] = 1e-4
        cuts += len(straight_runs(summed(points, noise), np.ones(60, dtype=bool), 25.0)) - 2
    assert cuts <= 5


def test_runs_do_not_cross_a_missing_link():
    points, noise = zigzag(np.random.default_rng(2), [0.0], each=20)
    linked = np.ones(20, dtype=bool)
    linked[[6, 7]] = False
    assert list(straight_runs(summed(points, noise), linked, 25.0)) == [0, 7, 8, 20]


def test_beams_are_ordered_once_each():
    rng = np.random.default_rng(3)
    bearings = rng.permutation(np.repeat(np.linspace(-1.0, 1.0, 30), 2))
    bearings[[4, 9]] = np.nan
    finite = np.flatnonzero(np.isfinite(bearings))
    _values, first = np.unique(bearings[finite], return_index=True)
    np.testing.assert_array_equal(order_beams(bearings), finite[first])


def test_the_widest_gap_is_where_neighbouring_beams_meet_a_wall():
    """Oracle: the triangle of the sensor and both points, by the law of sines."""
    for step, angle in ((0.01, 0.2), (0.017, 0.5), (0.005, 1.2)):
        near = np.array([3.0, 0.0])
        inner = angle - step  # the triangle's angles: step at the sensor, pi - angle at the near point
        far = 3.0 * np.sin(np.pi - angle) / np.sin(inner)
        end = far * np.array([np.cos(step), np.sin(step)])
        assert widest_gap(3.0, step, angle) == pytest.approx(np.linalg.norm(end - near))
