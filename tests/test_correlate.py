"""Kernels that lay maps over each other. Oracles: brute force over cells, all places; scipy's least squares."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import least_squares

from kalmap.geometry.se2 import rotate
from kalmap.kernels import correlate

CELL, REACH, BLUR = 0.1, 0.4, 0.1
DIRECTIONS, LEVELS = 8, 4


def problem(seed, count=12):
    """Segments, their normals, the grid's corner, the segment and distance of each cell."""
    rng = np.random.default_rng(seed)
    base, angle = rng.uniform(0, 3, (count, 2)), rng.uniform(-np.pi, np.pi, count)
    ahead = np.column_stack([np.cos(angle), np.sin(angle)])
    segments = np.hstack([base, base + rng.uniform(0.0, 0.6, (count, 1)) * ahead])
    normals = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    low = np.array([-0.3, 0.1])  # some of it lies off the grid
    nearest = np.full((29, 36), -1, dtype=np.int32)
    distance = np.full(nearest.shape, REACH, dtype=np.float32)
    correlate.nearest_segments(segments, low, CELL, REACH, nearest, distance)
    return segments, normals, low, nearest, distance


def to_segments(points, segments):
    """(P, S) m."""
    base, way = segments[:, :2], segments[:, 2:] - segments[:, :2]
    length = np.maximum(1e-12, (way**2).sum(axis=1))
    t = np.clip(((points[:, None] - base) * way).sum(axis=-1) / length, 0.0, 1.0)
    return np.linalg.norm(points[:, None] - base - t[..., None] * way, axis=-1)


@pytest.mark.parametrize("seed", range(5))
def test_nearest_segments(seed):
    segments, _, low, nearest, distance = problem(seed)
    rows, columns = nearest.shape
    y, x = np.mgrid[:rows, :columns]
    middles = low + CELL * (np.column_stack([x.ravel(), y.ravel()]) + 0.5)
    d = to_segments(middles, segments)
    least = d.min(axis=1).reshape(rows, columns)
    sure = np.abs(least - REACH) > 1e-5
    assert np.array_equal((nearest >= 0)[sure], (least < REACH)[sure])
    reached = nearest >= 0
    assert (
        np.allclose(distance[reached], least[reached], atol=1e-6)
        and (distance[~reached] == np.float32(REACH)).all()
    )
    own = d.reshape(rows, columns, -1)[reached, nearest[reached]]
    assert np.allclose(own, least[reached], atol=1e-6) and reached.sum() > 100


@pytest.mark.parametrize("seed", range(3))
def test_fill_levels(seed):
    _, normals, _, nearest, distance = problem(seed)
    levels = np.zeros((LEVELS, DIRECTIONS, *nearest.shape), dtype=np.uint8)
    correlate.fill_levels(nearest, distance, normals, BLUR, levels)
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    facing = (np.column_stack([np.cos(angles), np.sin(angles)]) @ normals.T)[:, nearest] > 0.4
    plain = np.floor(255.0 * np.exp(-0.5 * (distance.astype(float) / BLUR) ** 2))
    expected = np.where(facing & (nearest >= 0), plain, 0.0)
    assert np.abs(levels[0] - expected).max() <= 1 and (levels[0] == expected).mean() > 0.99
    for level in range(1, LEVELS):
        size = 1 << level
        padded = np.pad(levels[0], ((0, 0), (0, size - 1), (0, size - 1)))
        windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size), axis=(1, 2))
        assert np.array_equal(levels[level], windows.max(axis=(3, 4)))


def exhaustive(level, low, points, normals, centre, angles, shifts):
    """The fit (A, S, S) of every angle and shift, point by point."""
    values = np.zeros((len(angles), len(shifts), len(shifts)))
    _, rows, columns = level.shape
    for a, angle in enumerate(angles):
        placed = rotate(angle, points) + centre
        column, row = np.floor((placed - low) / CELL).astype(int).T
        turned = rotate(angle, normals)
        turn = np.arctan2(turned[:, 1], turned[:, 0])
        direction = np.rint(turn / (2 * np.pi) * DIRECTIONS).astype(int) % DIRECTIONS
        for i, down in enumerate(shifts):
            for j, right in enumerate(shifts):
                r, c = row + down, column + right
                on = (r >= 0) & (r < rows) & (c >= 0) & (c < columns)
                values[a, i, j] = level[direction[on], r[on], c[on]].sum()
    return values / (255.0 * len(points))


def searched(seed, centre, angles, half, least, kept, apart=3.0):
    segments, normals, low, nearest, distance = problem(seed, 25)
    levels = np.zeros((LEVELS, DIRECTIONS, *nearest.shape), dtype=np.uint8)
    correlate.fill_levels(nearest, distance, normals, BLUR, levels)
    middle = 0.5 * (segments[:, :2] + segments[:, 2:])
    points = middle - middle.mean(axis=0)
    values, places = np.zeros(kept), np.zeros((kept, 3), dtype=np.int64)
    count = correlate.search_places(
        levels, low, CELL, points, normals, centre, angles, half, least, apart, values, places
    )
    return levels[0], low, points, normals, values[:count], places[:count], middle.mean(axis=0)


@pytest.mark.parametrize("off", [(0.0, 0.0), (0.31, -0.42), (-1.5, 0.7), (2.5, 2.5), (-3.0, -3.0)])
@pytest.mark.parametrize("seed", range(3))
def test_search_is_exact_on_its_lattice(seed, off):
    """The best of all places, for clouds that lie wholly or in part off the grid too."""
    angles, half = np.linspace(-0.3, 0.3, 7), 16
    middle = searched(seed, np.zeros(2), angles, 0, 2.0, 1)[-1]
    centre = middle + np.array(off)
    level, low, points, normals, values, places, _ = searched(seed, centre, angles, half, 0.05, 4)
    every = exhaustive(level, low, points, normals, centre, angles, np.arange(-half, half + 1))
    if every.max() < 0.05:
        assert not len(values)
        return
    assert values[0] == pytest.approx(every.max(), abs=1e-12)
    for value, (angle, row, column) in zip(values, places, strict=True):
        assert abs(row) <= half and abs(column) <= half
        assert value == pytest.approx(every[angle, row + half, column + half], abs=1e-12)
    assert (np.diff(values) <= 0).all()


@pytest.mark.parametrize("half", [0, 1, 5, 12])
def test_search_keeps_to_its_window(half):
    """Oracle: exhaustive search; windows that the coarsest step of 8 cells does not divide."""
    angles = np.linspace(-0.1, 0.1, 3)
    middle = searched(1, np.zeros(2), angles, 0, 2.0, 1)[-1]
    centre = middle + np.array([0.5, -0.3])
    level, low, points, normals, values, places, _ = searched(1, centre, angles, half, 0.01, 3)
    every = exhaustive(level, low, points, normals, centre, angles, np.arange(-half, half + 1))
    assert (np.abs(places[:, 1:]) <= half).all()
    assert values[0] == pytest.approx(every.max(), abs=1e-12)


def test_search_finds_all_places_that_are_as_good():
    """Three equal rooms in a row: three answers, as far apart as the rooms. Oracle: the plan."""
    room = np.array([[0, 0, 2, 0], [2, 0, 2, 1.2], [2, 1.2, 0, 1.2], [0, 1.2, 0, 0.0]])
    inside = np.array([[0, 1], [-1, 0], [0, -1], [1, 0.0]])
    segments = np.vstack([room + [x, 0, x, 0] for x in (0.0, 3.0, 6.0)])
    normals = np.tile(inside, (3, 1)).astype(float)
    low = np.array([-0.5, -0.5])
    nearest = np.full((24, 95), -1, dtype=np.int32)
    distance = np.full(nearest.shape, REACH, dtype=np.float32)
    correlate.nearest_segments(segments, low, CELL, REACH, nearest, distance)
    levels = np.zeros((LEVELS, DIRECTIONS, *nearest.shape), dtype=np.uint8)
    correlate.fill_levels(nearest, distance, normals, BLUR, levels)
    share = np.arange(0.05, 1.0, 0.1)
    points = np.vstack([wall[:2] + np.outer(share, wall[2:] - wall[:2]) for wall in room]) - [1.0, 0.6]
    values, places = np.zeros(5), np.zeros((5, 3), dtype=np.int64)
    count = correlate.search_places(
        levels, low, CELL, points, np.repeat(inside, len(share), axis=0).astype(float), np.array([4.0, 0.6]),
        np.array([0.0]), 40, 0.7, 10.0, values, places,
    )  # fmt: skip
    assert count >= 3 and np.array_equal(np.sort(places[:3, 2]), [-30, 0, 30]) and (places[:3, 1] == 0).all()
    assert values[2] == pytest.approx(values[0], abs=0.02) and (values[3:count] < 0.8 * values[0]).all()


@pytest.mark.parametrize("seed", range(6))
def test_align_points(seed):
    """Oracle: least squares of scipy on the same distances, with Cauchy's loss of the same scale."""
    rng = np.random.default_rng(seed)
    walls = np.array([[0, 0, 6, 0], [6, 0, 6, 4], [6, 4, 0, 4], [0, 4, 0, 0.0]])
    inside = np.array([[0, 1], [-1, 0], [0, -1], [1, 0.0]])
    segments = np.vstack(
        [
            np.hstack([w[:2] + (w[2:] - w[:2]) * t, w[:2] + (w[2:] - w[:2]) * (t + 0.1)])
            for w in walls
            for t in np.arange(10) / 10
        ]
    )
    normals = np.repeat(inside, 10, axis=0)
    low, nearest = np.array([-0.5, -0.5]), np.full((50, 70), -1, dtype=np.int32)
    correlate.nearest_segments(
        segments, low, CELL, REACH, nearest, np.full(nearest.shape, REACH, dtype=np.float32)
    )
    truth = rng.normal(0, [0.5, 0.5, 0.3])
    at = (
        np.repeat(walls[:, :2], 30, axis=0)
        + np.repeat(walls[:, 2:] - walls[:, :2], 30, axis=0) * np.tile(np.linspace(0.1, 0.9, 30), 4)[:, None]
    )
    facing = np.repeat(inside, 30, axis=0)
    at = at + facing * rng.normal(0, 0.02, (120, 1))
    points, point_normals = rotate(-truth[2], at - truth[:2]), rotate(-truth[2], facing)
    pose = truth + rng.normal(0, [0.08, 0.08, 0.02])
    beside, offsets, sigma = np.empty(120, dtype=np.int64), np.empty(120), 0.02
    matched, near, squares = correlate.align_points(
        pose, points, point_normals, segments, normals, nearest, low, CELL, np.array([0.3, 0.15]), 60, sigma,
        beside, offsets,
    )  # fmt: skip

    def distances(x):
        placed = rotate(x[2], points) + x[:2]
        return ((placed - segments[beside, :2]) * normals[beside]).sum(axis=1)

    assert matched == near == 120
    best = least_squares(
        distances, truth, loss="cauchy", f_scale=3.0 * sigma, xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    assert np.allclose(pose, best.x, rtol=0, atol=2e-5)
    assert squares == pytest.approx((distances(pose) ** 2).mean(), rel=1e-3)
    assert np.allclose(offsets, distances(pose), rtol=0, atol=1e-4)  # they are of the round before


def test_align_points_moves_nothing_that_nothing_holds():
    """Two parallel walls: along them the pose stays where it was put. Oracle: the geometry."""
    x = np.arange(0.0, 8.0, 0.3)
    segments = np.vstack(
        [np.column_stack([x, 0 * x, x + 0.3, 0 * x]), np.column_stack([x, 0 * x + 2, x + 0.3, 0 * x + 2])]
    )
    normals = np.repeat([[0.0, 1.0], [0.0, -1.0]], len(x), axis=0)
    low, nearest = np.array([-0.5, -0.5]), np.full((30, 95), -1, dtype=np.int32)
    correlate.nearest_segments(
        segments, low, CELL, REACH, nearest, np.full(nearest.shape, REACH, dtype=np.float32)
    )
    points = np.vstack([np.column_stack([x[5:15], 0 * x[5:15]]), np.column_stack([x[5:15], 0 * x[5:15] + 2])])
    pose = np.array([0.07, 0.12, 0.0])
    matched, _, squares = correlate.align_points(
        pose, points, np.repeat([[0.0, 1.0], [0.0, -1.0]], 10, axis=0), segments, normals, nearest, low, CELL,
        np.array([0.3, 0.08]), 30, 0.02, np.empty(20, dtype=np.int64), np.empty(20),
    )  # fmt: skip
    assert matched == 20 and squares < 1e-8
    assert abs(pose[0] - 0.07) < 0.01 and abs(pose[1]) < 1e-3 and math.isclose(pose[2], 0.0, abs_tol=1e-3)
