"""Ray casting: ranges to circles and walls."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.records import ConfigError
from kalmap.simulate.raycast import SICK, URG, cast, cast_hits, noisy

ORIGIN = np.zeros((1, 3))
NO_CIRCLES = np.zeros((0, 3))


def brute_circle(origin, direction, circle):
    """Smallest positive root of |o + t u - c|^2 = r^2, by `numpy.roots`."""
    away = origin - circle[:2]
    roots = np.roots([1.0, 2.0 * direction @ away, away @ away - circle[2] ** 2])
    real = roots[np.abs(roots.imag) < 1e-12].real
    return min(real[real > 0], default=np.inf)


def brute_segment(origin, direction, segment):
    """Solve o + t u = a + w (b - a) with `numpy.linalg.solve`."""
    a, b = segment[:2], segment[2:]
    t, w = np.linalg.solve(np.column_stack([direction, a - b]), a - origin)
    return t if t > 0 and 0 <= w <= 1 else np.inf


def brute(poses, bearings, max_range, circles, moving, segments):
    out = np.full((len(poses), len(bearings)), np.inf)
    name = np.full(out.shape, -1)
    for f, pose in enumerate(poses):
        for b, bearing in enumerate(bearings):
            u = np.array([np.cos(pose[2] + bearing), np.sin(pose[2] + bearing)])
            reached = [brute_circle(pose[:2], u, c) for c in [*circles, *moving[f]]]
            reached += [brute_segment(pose[:2], u, s) for s in segments]
            if min(reached) <= max_range:
                out[f, b], name[f, b] = min(reached), int(np.argmin(reached))
    return out, name


@pytest.mark.parametrize("seed", range(4))
def test_ranges_and_targets_are_those_of_brute_force(seed):
    """Oracle: roots of the quadratic and a linear system for every pair; beams in disorder over 1.5 turns,
    headings of several turns, sensors inside circles."""
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(-8, 8, (6, 2)), rng.uniform(-20, 20, 6)])
    circles = np.column_stack([rng.uniform(-10, 10, (12, 2)), rng.uniform(0.05, 2.5, 12)])
    moving = np.concatenate([rng.uniform(-10, 10, (6, 3, 2)), np.full((6, 3, 1), 0.3)], axis=2)
    segments = rng.uniform(-10, 10, (4, 4))
    circles[0, :2] = poses[0, :2] + 0.01
    bearings = rng.permutation(np.linspace(-1.5 * np.pi, 1.5 * np.pi, 80))
    ranges, targets = cast_hits(poses, circles, bearings, 9.0, moving=moving, segments=segments)
    expected, names = brute(poses, bearings, 9.0, circles, moving, segments)
    assert np.isfinite(expected).any() and np.isinf(expected).any()
    assert np.array_equal(np.isinf(ranges), np.isinf(expected)) and np.array_equal(targets, names)
    hit = np.isfinite(expected)
    assert np.allclose(ranges[hit], expected[hit], rtol=0, atol=1e-9)


def test_one_circle_in_closed_form():
    """Oracle: c cos b - sqrt(r^2 - c^2 sin^2 b), and the tangent's bearing asin(r / c)."""
    ranges = cast(ORIGIN, np.array([[10.0, 0.0, 0.5]]), SICK.bearings, SICK.max_range)[0]
    inside = np.abs(SICK.bearings) < np.arcsin(0.05)
    expected = 10 * np.cos(SICK.bearings) - np.sqrt(
        np.where(inside, 0.25 - 100 * np.sin(SICK.bearings) ** 2, 0)
    )
    assert inside.sum() == 11
    assert np.allclose(ranges[inside], expected[inside], atol=1e-12) and np.isinf(ranges[~inside]).all()


def test_the_nearest_wins():
    circles = np.array([[10.0, 0.0, 1.0], [5.0, 0.0, 0.5], [-5.0, 0.0, 0.5]])
    wall = np.array([[3.0, -1.0, 3.0, 1.0]])
    ahead = np.zeros(1)
    assert cast(ORIGIN, circles, ahead, 80.0)[0, 0] == pytest.approx(4.5)
    assert cast(ORIGIN, circles, ahead, 80.0, segments=wall)[0, 0] == pytest.approx(3.0)
    movers = np.array([[[2.0, 0.0, 0.25]]])
    assert cast(ORIGIN, circles, ahead, 80.0, segments=wall, moving=movers)[0, 0] == pytest.approx(1.75)
    assert np.isinf(cast(ORIGIN, circles, ahead, 1.7, segments=wall, moving=movers)[0, 0])
    assert cast(np.array([[0, 0, np.pi]]), circles, ahead, 80.0)[0, 0] == pytest.approx(4.5)


def test_edges_of_what_can_be_hit():
    """From inside a circle its far wall is seen; a wall is not seen along itself; a circle exactly at the
    largest range still is; a point never is."""
    ahead = np.zeros(1)
    assert cast(ORIGIN, np.array([[0.5, 0.0, 2.0]]), ahead, 80.0)[0, 0] == pytest.approx(2.5)
    along = np.array([[1.0, 0.0, 2.0, 0.0]])
    assert np.isinf(cast(ORIGIN, NO_CIRCLES, ahead, 80.0, segments=along)[0, 0])
    assert cast(ORIGIN, np.array([[5.0, 0.0, 1.0]]), ahead, 4.0)[0, 0] == 4.0
    assert np.isinf(cast(ORIGIN, np.array([[5.0, 0.001, 0.0]]), ahead, 80.0)[0, 0])


def test_moving_circles_stand_where_each_pose_has_them():
    poses = np.zeros((3, 3))
    moving = np.array([[[2.0, 0, 0.5]], [[3.0, 0, 0.5]], [[4.0, 9, 0.5]]])
    ranges = cast(poses, NO_CIRCLES, np.zeros(1), 80.0, moving=moving)
    assert np.allclose(ranges[:2, 0], [1.5, 2.5]) and np.isinf(ranges[2, 0])


@pytest.mark.parametrize(("frames", "beams"), [(0, 5), (3, 0), (0, 0), (2, 1)])
def test_nothing_to_see(frames, beams):
    ranges = cast(np.zeros((frames, 3)), NO_CIRCLES, np.linspace(-1, 1, beams), 10.0)
    assert ranges.shape == (frames, beams) and np.isinf(ranges).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"poses": np.zeros(3)}, "poses must be"),
        ({"poses": np.full((1, 3), np.nan)}, "poses must be finite"),
        ({"circles": np.zeros((1, 2))}, "circles must be"),
        ({"circles": np.array([[1.0, 0, -0.1]])}, "radii"),
        ({"moving": np.zeros((2, 1, 3))}, r"moving must be \(1, n, 3\)"),
        ({"moving": np.array([[[1.0, 0, -1]]])}, "moving must have radii"),
        ({"segments": np.array([[0, 0, np.inf, 1]])}, "segments must be finite"),
        ({"bearings": np.array([0.0, np.nan])}, "bearings must be finite"),
        ({"max_range": np.nan}, "max_range"),
        ({"max_range": 0.0}, "max_range"),
    ],
)
def test_bad_input_is_refused(change, said):
    good = {"poses": ORIGIN, "circles": np.zeros((1, 3)), "bearings": np.zeros(2), "max_range": 5.0}
    with pytest.raises(ConfigError, match=said):
        cast(**{**good, **change})


def test_scanners_point_where_their_makers_say():
    assert len(SICK.bearings) == 361 and SICK.max_range == 80.0
    assert np.allclose(np.rad2deg(SICK.bearings[[0, 180, 360]]), [-90, 0, 90])
    assert len(URG.bearings) == 683 and URG.max_range == 4.0
    assert np.rad2deg(np.ptp(URG.bearings)) == pytest.approx(240, abs=0.3) and URG.bearings[341] == 0


def test_noise_has_its_sigma_and_leaves_misses_alone():
    """Oracle: sample mean and deviation of 40,000 draws, within five standard errors."""
    exact = np.full((100, 500), 7.0)
    exact[:, ::5] = np.inf
    measured = noisy(exact, 0.03, np.random.default_rng(1))
    error = (measured - 7.0)[np.isfinite(exact)]
    assert np.isinf(measured[:, ::5]).all()
    assert abs(error.mean()) < 5 * 0.03 / np.sqrt(error.size)
    assert error.std() == pytest.approx(0.03, abs=5 * 0.03 / np.sqrt(2 * error.size))
    again = noisy(np.full((100, 500), 7.0), 0.03, np.random.default_rng(1))
    assert np.array_equal(again[np.isfinite(exact)], measured[np.isfinite(exact)])
    assert np.array_equal(noisy(exact, 0.0, np.random.default_rng(1)), exact)
    for sigma in (-1.0, np.nan, np.inf):
        with pytest.raises(ConfigError, match="sigma"):
            noisy(exact, sigma, np.random.default_rng(1))
