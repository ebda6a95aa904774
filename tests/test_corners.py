"""Corners of two fitted lines. Oracles: central differences, the appendix's own y = k x + b, a rotated frame."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.geometry.corners import corner
from kalmap.geometry.se2 import rotate


def walls(rng, first, second, noise=0.01, count=12):
    """Noisy points on two walls that start at (3, 2) in the directions `first` and `second`, rad."""
    sets = []
    for angle in (first, second):
        along = rng.uniform(0.2, 3.0, count)
        points = np.array([3.0, 2.0]) + along[:, None] * [np.cos(angle), np.sin(angle)]
        sets.append(points + noise * rng.standard_normal((count, 2)))
    return sets


@pytest.mark.parametrize(
    "angles", [(0.2, 1.9), (0.0, np.pi / 2), (np.pi / 2, np.pi), (1.5, 2.2), (-3.0, -1.2)]
)
def test_the_jacobians_are_those_of_central_differences(angles):
    first, second = walls(np.random.default_rng(1), *angles, count=7)
    found = corner(first, second)
    np.testing.assert_allclose(found.position, [3.0, 2.0], atol=0.1)
    step = 1e-6
    for points, jacobian, which in ((first, found.first, 0), (second, found.second, 1)):
        for n in range(len(points)):
            for axis in range(2):
                moved = [points.copy(), points.copy()]
                for sign, side in zip((1.0, -1.0), moved):
                    side[n, axis] += sign * step
                ends = [
                    corner(side, second).position if which == 0 else corner(first, side).position
                    for side in moved
                ]
                slope = (ends[0] - ends[1]) / (2.0 * step)
                np.testing.assert_allclose(jacobian[n, :, axis], slope, atol=1e-7)


def test_exact_points_give_the_papers_corner():
    """Equations (A1) to (A3) of Sun et al. 2010; without noise both fits are the same line."""
    first, second = walls(np.random.default_rng(2), 0.3, 1.1, noise=0.0)
    lines = [
        np.linalg.lstsq(np.column_stack([p[:, 0], np.ones(len(p))]), p[:, 1], rcond=None)[0]
        for p in (first, second)
    ]
    (k1, b1), (k2, b2) = lines
    expected = np.linalg.solve([[-k1, 1.0], [-k2, 1.0]], [b1, b2])
    np.testing.assert_allclose(corner(first, second).position, expected, atol=1e-9)


def test_small_noise_across_flat_walls_moves_both_corners_alike():
    """For lines near the x axis the paper's regression and total least squares agree to first order in the slope; its
    numerical derivatives (A5) by y then are ours."""
    rng = np.random.default_rng(3)
    x1, x2 = np.sort(rng.uniform(-2.0, 0.0, 9)), np.sort(rng.uniform(0.0, 2.0, 9))
    first, second = np.column_stack([x1, 0.01 * x1]), np.column_stack([x2, -0.01 * x2])

    def papers(y1, y2):
        (k1, b1), (k2, b2) = (np.polyfit(x, y, 1) for x, y in ((x1, y1), (x2, y2)))
        return np.linalg.solve([[-k1, 1.0], [-k2, 1.0]], [b1, b2])

    found, step = corner(first, second), 1e-7
    for n in range(9):
        y = first[:, 1].copy()
        y[n] += step
        slope = (papers(y, second[:, 1]) - papers(first[:, 1], second[:, 1])) / step
        np.testing.assert_allclose(found.first[n, :, 1], slope, rtol=2e-3, atol=2e-3)


def test_the_corner_turns_with_its_walls():
    first, second = walls(np.random.default_rng(5), 0.4, 2.0)
    found, angle = corner(first, second), np.pi / 2 - 0.4
    turned = corner(*(np.asarray(rotate(angle, points)) for points in (first, second)))
    np.testing.assert_allclose(turned.position, rotate(angle, found.position), atol=1e-12)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(turned.first, turn @ found.first @ turn.T, atol=1e-12)


def test_moving_every_point_moves_the_corner_as_much():
    first, second = walls(np.random.default_rng(6), 0.4, 2.0)
    found = corner(first, second)
    np.testing.assert_allclose(found.first.sum(axis=0) + found.second.sum(axis=0), np.eye(2), atol=1e-12)


def test_what_has_no_corner_is_refused():
    line = np.column_stack([np.arange(4.0), np.zeros(4)])
    with pytest.raises(ValueError, match="parallel"):
        corner(line, line + [0.0, 1.0])
    with pytest.raises(ValueError, match="direction"):
        corner(np.array([[1.0, 1.0], [1.0, 1.0]]), line)
    with pytest.raises(ValueError, match="two or more"):
        corner(line[:1], line)
